"""Faults over the wire, one at a time: each leaves the joints of the simulated robot damped, by its own record, and says why in a line."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from legged_mw.deploy import states
from legged_mw.deploy.inputs import RobotRemote
from legged_mw.deploy.policy import Controller
from legged_mw.deploy.robot import Floats
from legged_mw.deploy.runner import run
from legged_mw.deploy.states import POLICY, States
from legged_mw.deploy.unitree.client import Direct
from legged_mw.deploy.unitree.link import Wire
from legged_mw.deploy.unitree.remote import encode
from legged_mw.deploy.unitree.serve import SimulatedUnitree
from tests.wires import POLICIES, Pair, pair
from tests.wires import domain as domain

AT = 0.8  # [s] of the fault: the robot walks since 0.5
RISE = 0.2  # [s] to stand up: it stands from the start
SOON = 0.1  # [s] within which joints must be damped


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(states, "RISE", RISE)


class Scene:
    """A Go2 that is driven by the buttons of its own remote, in lockstep: each command moves it on by a period."""

    def __init__(self, both: Pair) -> None:
        self.both, self.sim = both, both.sim
        self.sim.reset(after=0.01)
        self.begin, self.damped, self.seen = both.sim.time, None, list[str]()
        self.fault: Callable[[SimulatedUnitree], None] = lambda sim: None
        self.hold: Callable[[float], bytes] | None = None  # the remote from AT on
        robot = both.robot
        for name in ("write", "damp", "limp"):
            setattr(robot, name, self._moving(getattr(robot, name)))
        contract = both.contract
        self.controller = Controller(POLICIES / "go2_flat", contract)
        self.states = States(self.controller, [RobotRemote(contract.commands)], lambda _: np.zeros(3), self.seen.append)

    @property
    def time(self) -> float:
        return self.sim.time - self.begin

    def _moving(self, send: Callable[..., None]) -> Callable[..., None]:
        def call(*args: Floats, **gains: Floats) -> None:
            send(*args, **gains)
            for _ in range(10):
                self._remote()
                if self.time >= AT and self.fault:
                    self.fault(self.sim)
                self.sim.step()
                if self.time > AT and self.damped is None and not self.sim.acted["kp"].any():
                    self.damped = self.time - AT

        return call

    def _remote(self) -> None:
        if self.hold and self.time >= AT:
            self.sim.remote = self.hold(self.time)
        else:
            press = ["start"] if self.time < 0.03 else ["A"] if 0.4 < self.time < 0.44 else []
            self.sim.remote = encode(press, ly=0.3 * (self.time > 0.5))

    def run(self, seconds: float = 4.2) -> Any:
        robot = self.both.robot
        return run(robot, self.controller, lambda _: np.zeros(3), seconds, live=False, safety=self.both.safety, states=self.states)


def fault(name: str, value: Any) -> Callable[[Scene], None]:
    def prepare(scene: Scene) -> None:
        scene.fault = lambda sim: setattr(sim.faults, name, value)

    return prepare


def held(*buttons: str) -> Callable[[Scene], None]:
    def prepare(scene: Scene) -> None:
        scene.hold = lambda time: encode(buttons)

    return prepare


def rolled(scene: Scene) -> None:
    scene.fault = lambda sim: sim.data.qvel.__setitem__(3, 9.0)


def fast(scene: Scene) -> None:
    scene.fault = lambda sim: sim.data.joint("FL_calf_joint").qvel.__setitem__(slice(None), 70.0)


FAULTS: dict[str, tuple[Callable[[Scene], None], float, str]] = {
    "silent robot": (fault("silent", True), SOON, "the newest measurement is .* ms old"),
    "wrong checksums": (fault("corrupt", True), SOON, "the newest measurement is .* ms old"),
    "frozen state": (fault("frozen", True), SOON, "measurements in a row are the same"),
    "dead motor": (fault("dead_motors", {"FL_calf_joint"}), SOON, "the motor of FL_calf_joint reports a fault: it lost [0-9]* messages"),
    "hot motor": (fault("temperature", 95.0), SOON, "motor of 95 deg C, more than 85"),
    "empty battery": (fault("voltage", 21.0), SOON, "the battery has 21.0 V, less than 24"),
    "shifted joints": (fault("joint_bias", 1.9), SOON, "beyond its range"),
    "lost remote": (fault("no_remote", True), 3.0 + SOON, "the remote was not heard for 3.0 s"),
    "emergency stop": (held("L2", "B"), SOON, r"the remote's emergency stop \(L2 \+ B\)"),
    "select": (held("select"), SOON, "select was pressed"),
    "rolled over": (rolled, 0.5, "tilted by"),
    "fast joint": (fast, SOON, "FL_calf_joint (turns at .* rad/s, more than 60|is at .* beyond its range)"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_damps(name: str, domain: int) -> None:
    prepare, soon, said = FAULTS[name]
    scene = Scene(pair("go2_flat", domain))
    prepare(scene)
    scene.run(AT + soon + 0.5)
    entered = [line for line in scene.seen if line.startswith("damping: ")]
    assert any(line.startswith(f"{POLICY}: ") for line in scene.seen), scene.seen
    assert scene.damped is not None and scene.damped <= soon, (scene.damped, scene.seen)
    assert len(entered) == 1 and "\n" not in entered[0]
    assert re.search(said, entered[0]), entered
    assert not scene.sim.acted["kp"].any() and scene.sim.acted["kd"].all()


def test_nothing_resumes_without_a_person(domain: int) -> None:
    scene = Scene(pair("go2_flat", domain))
    scene.fault = lambda sim: setattr(sim.faults, "voltage", 21.0 if scene.time < AT + 0.1 else None)
    scene.run(AT + 0.6)
    assert scene.states.state == "damping" and not scene.sim.acted["kp"].any()


def test_a_policy_that_is_not_finite(domain: int) -> None:
    scene = Scene(pair("go2_flat", domain))
    network = scene.controller._network
    scene.controller._network = lambda *seen: np.full((1, 12), np.nan) if scene.time > AT else network(*seen)  # type: ignore[assignment]
    scene.run(AT + 0.5)
    assert scene.damped is not None and scene.damped <= SOON
    assert any("the target of FL_hip_joint is not finite" in line for line in scene.seen)


def test_a_second_commander_is_noticed(domain: int) -> None:
    scene = Scene(pair("go2_flat", domain))
    wire, body = Wire("unitree_go", "lo", domain), scene.both.robot._command(q=np.zeros(12))
    scene.fault = lambda sim: wire.send(body) if scene.time < AT + 0.03 else None
    scene.run(AT + 0.5)
    assert isinstance(scene.both.robot._owner, Direct)
    assert scene.damped is not None and scene.damped <= SOON
    assert any("another program sends commands to this robot, too" in line for line in scene.seen)
