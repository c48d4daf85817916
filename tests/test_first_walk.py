"""The first walk: a right robot does the whole list, a wrong one is refused at the step that shows what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from drivers import Script

from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.first_walk import JOINTS, METRE, STANDING, STEPS, STOPPING, FirstWalk, first_walk, rehearse
from legged_mw.deploy.inputs import DriveInput
from legged_mw.deploy.joint_check import LIFT
from legged_mw.deploy.robot import Floats, Health, Measurement
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.simulated import MujocoRobot, trunk_of
from legged_mw.deploy.states import DAMPING, STAND
from legged_mw.utils.errors import UserError
from tests.wires import POLICIES

GO2 = POLICIES / "go2_flat"
CONTRACT = read_contract(GO2)
FL_HIP, FL_THIGH, _, FR_HIP = range(4)
Found = Mapping[tuple[str, str], Floats]


class Faulty(MujocoRobot):
    """A hanging Go2 with ``gains`` (D,) in shares of the right ones, and ``load`` [kg] on its trunk.

    Two motors are ``swapped``, with their encoders or without. Targets arrive after ``delay`` [s]; ``noise``: share of the
    hard exam's.
    """

    def __init__(
        self,
        gains: Mapping[int, float] | None = None,
        load: float = 0.0,
        swapped: tuple[int, int] | None = None,
        encoders: bool = False,
        delay: float = 0.0,
        noise: float = 0.0,
    ) -> None:
        self.shares, self.order = np.ones(12), np.arange(12)
        super().__init__(GO2, CONTRACT, whole=True, hoisted=True, lift=LIFT)
        for joint, share in (gains or {}).items():
            self.shares[joint] = share
        if swapped:
            self.order[[*swapped]] = self.order[[*swapped[::-1]]]
        self.encoders, self.noise = encoders, noise
        self.random = np.random.default_rng(1)
        self.fleet.add_load(trunk_of(self.fleet.model), np.array([load]))
        self.fleet.set_delay(np.array([delay]))

    def _set(self, *gains: Floats) -> None:
        super()._set(*(self.shares * gain for gain in gains))

    def write(self, targets: Floats, **gains: Any) -> None:
        super().write(
            targets[self.order], **{name: gain if gain is None else gain[self.order] for name, gain in gains.items()}
        )

    def read(self) -> Measurement:
        measured = super().read()
        values = {name: getattr(measured, name) for name in ("joint_pos", "joint_vel", "joint_torque", "ang_vel")}
        for name, size in (("joint_pos", 0.01), ("joint_vel", 1.5), ("ang_vel", 0.2)):
            values[name] = values[name] + self.noise * self.random.uniform(-size, size, values[name].shape)
        if self.encoders:
            values |= {name: values[name][self.order] for name in values if name != "ang_vel"}
        return replace(measured, **values)


@pytest.fixture(scope="module")
def exam() -> Found:
    return rehearse(GO2, CONTRACT)


def test_a_right_robot_does_the_whole_list(exam: Found) -> None:
    """With a delay of 10 ms, noise and 0.9 of its gains; each value within three quarters of what is allowed."""
    walk = first_walk(Faulty(dict.fromkeys(range(12), 0.9), delay=0.01, noise=1.0), GO2, CONTRACT, exam)
    assert walk.right and walk.over and walk.state == DAMPING and walk.report.startswith("\nfirst walk: all 6 steps")
    assert list(dict.fromkeys(value.step for value in walk.values)) == [*STEPS]
    assert max(abs(value.measured - value.exam) / value.allowed for value in walk.values) < 0.75
    assert walk.found[METRE, "time of a metre"][0] == pytest.approx(2.2, abs=0.6)


@pytest.mark.parametrize(
    ("fault", "step", "line"),
    [
        ({"swapped": (FL_HIP, FR_HIP)}, JOINTS, "FL_hip_joint: WRONG JOINT: FR_hip_joint moved in its place"),
        ({"swapped": (FL_HIP, FR_HIP), "encoders": True}, STANDING, "torque of F"),
        ({"gains": {FL_THIGH: 0.5}}, STANDING, "torque, less than asked of FL_thigh_joint"),
        ({"load": 4.0}, STANDING, "weight on the legs"),
    ],
)
def test_a_wrong_robot_is_refused(fault: dict[str, Any], step: str, line: str, exam: Found) -> None:
    walk = first_walk(Faulty(**fault), GO2, CONTRACT, exam)
    assert walk.over and not walk.right and walk.state == DAMPING
    assert walk.at == step and walk.ended.startswith(step) and line in walk.ended


@pytest.mark.parametrize(("press", "why"), [("select", "select was pressed"), ("stop", "the test")])
def test_a_person_ends_it(press: str, why: str, exam: Found) -> None:
    """Select always; the emergency stop ends the list wherever it is not the step itself."""
    controller, limits = Controller(GO2, CONTRACT), Limits.of(GO2, CONTRACT)
    source = Script({120: "start", 400: press}, stop=400 if press == "stop" else -1)
    walk = FirstWalk(controller, [source], lambda _: None, robot := Faulty(), limits, exam)
    run(robot, controller, lambda _: np.zeros(0), live=False, safety=Safety(CONTRACT, limits), states=walk)
    assert walk.at == JOINTS and walk.ended == why and not walk.right


def test_the_policy_waits_for_the_emergency_stop(exam: Found) -> None:
    """A before the stop was tried starts nothing."""
    controller, limits, said = Controller(GO2, CONTRACT), Limits.of(GO2, CONTRACT), list[str]()

    class Hasty(Script):
        def poll(self, health: Health) -> DriveInput:
            self.presses = {self.step + 1: "A" if walk.at == STOPPING else walk.wants}
            return super().poll(health)

    walk = FirstWalk(controller, [Hasty({})], said.append, robot := Faulty(), limits, exam)
    run(robot, controller, lambda _: np.zeros(0), 55.0, live=False, safety=Safety(CONTRACT, limits), states=walk)
    assert walk.state == STAND and said[-1] == "stand: A has to wait: emergency stop comes first"


def test_a_policy_without_velocity_has_no_first_walk() -> None:
    folder = POLICIES / "go1_getup"
    with pytest.raises(UserError, match="--first_walk needs a policy that follows lin_vel_x"):
        rehearse(folder, read_contract(folder))
