"""What the tests of a driven robot share: a source that presses by a script, a robot that reports its health, and its record."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import DriveInput
from legged_mw.deploy.robot import Floats, Health, Measurement
from legged_mw.deploy.runner import Summary, run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.states import STATES, States


class Script:
    """Presses buttons, commands and stops at steps."""

    def __init__(self, presses: dict[int, str], command: Sequence[float] | None = None, stop: int = -1) -> None:
        self.presses, self.stop, self.step = presses, stop, -1
        self.command = None if command is None else np.array(command, dtype=float)

    def poll(self, health: Health) -> DriveInput:
        self.step += 1
        pressed = frozenset({self.presses[self.step]} if self.step in self.presses else ())
        return DriveInput(pressed, self.command, "the test" if self.step == self.stop else "")

    def let_go(self) -> None: ...

    def close(self) -> None: ...


class Watched(MujocoRobot):
    """A simulated robot that keeps its own record: what was done, and where its joints truly were after it."""

    def __init__(self, folder: Path, contract: Contract, **how: Any) -> None:
        super().__init__(folder, contract, **how)
        self.step = -1  # of the last read
        self.done: list[str] = []  # "write", "damp" or "limp" of each period
        self.heights: list[float] = []  # [m] of the base, after each
        self.joints: list[Floats] = []  # (D,) [rad], likewise
        self.health_at = lambda _: Health(age_s=0.0)  # by the step
        self.changed: Callable[[int, Measurement], Measurement] = lambda _, measured: measured

    def read(self) -> Measurement:
        self.step += 1
        return self.changed(self.step, super().read())

    def health(self) -> Health:
        return self.health_at(self.step)

    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        super().write(targets, stiffness=stiffness, damping=damping)
        self._keep("write")

    def damp(self) -> None:
        super().damp()
        self._keep("damp")

    def limp(self) -> None:
        super().limp()
        self._keep("limp")

    def _keep(self, what: str) -> None:
        self.done.append(what)
        self.heights.append(float(self.fleet.qpos[0, 2]))
        self.joints.append(super().read().joint_pos.copy())


def beyond(robot: Watched, limits: Limits) -> float:
    """[rad] by which the joints went beyond their range at most, by the robot's own record."""
    joints = np.array(robot.joints)
    return float(np.maximum(joints - limits.high, limits.low - joints).max())


def driven(
    robot: Watched, controller: Controller, source: Script, seconds: float, said: list[str] | None = None, **asked: Any
) -> tuple[Summary, list[str]]:
    """Run with states as fast as possible; the summary, and the states one after another."""
    contract = controller.contract
    states = States(
        controller, [source], lambda _: np.zeros(len(contract.commands)), (said if said is not None else []).append
    )
    passed: list[str] = []

    def watch(_now: float, _measured: Measurement) -> None:
        if passed[-1:] != [states.state]:
            assert states.state in STATES
            passed.append(states.state)

    safety = Safety(contract, Limits.of(controller.folder, contract, asked))
    done = run(robot, controller, lambda _: np.zeros(0), seconds, live=False, watch=watch, safety=safety, states=states)
    return done, [*passed, *([states.state] if passed[-1:] != [states.state] else [])]
