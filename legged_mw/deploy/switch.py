"""Two policies on one robot: the first until it falls, the second until it stands again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import OWN, Contract, Ends, read_contract
from legged_mw.deploy.policy import Controller
from legged_mw.deploy.robot import Floats, Measurement
from legged_mw.deploy.stage import DeployStage
from legged_mw.utils.errors import UserError

# [deg] between the robot's z axis and the vertical: the second policy takes over [ours: a walker does not come back]
FELL = 60.0
# It stands again, so that the first takes over, while it is [ours]:
UP, NEAR, SLOW = 10.0, 0.3, 1.0  # [deg] tilted; [rad] from the first's default pose; [rad/s] of joints; means over them
HOLD = 0.5  # [s] for so long


class SwitchStage(DeployStage):
    """Robots that follow the policy in ``first``; one that falls follows that in ``second`` until it stands.

    None is put back, but those that MuJoCo cannot step.
    """

    def __init__(
        self, first: Path, second: Path, num_worlds: int = 1, command: Any = None, edited: bool = False
    ) -> None:
        """``edited``: see read_contract. Raises UserError for policies of two robots, ContractError for broken ones."""
        # its body touches the ground
        super().__init__(first, num_worlds, command, ends=Ends(max_tilt=FELL), whole=True, edited=edited)
        other = read_contract(second, edited)
        check_same(self.contract, other)
        self.rescuer = Controller(second, other, num_worlds)
        self.rescued = np.zeros(num_worlds, dtype=bool)  # (N,) robots that follow the second policy
        self._standing = np.zeros(num_worlds, dtype=int)  # (N,) periods that it has stood
        self._none = np.array([[each.default for each in other.commands]] * num_worlds).reshape(num_worlds, -1)

    def step(self, commands: Floats | None = None) -> None:
        self._commands = (
            self._own.copy() if commands is None else np.array(commands, dtype=float).reshape(self._own.shape)
        )
        self._seen, rescued = self.measured, self.rescued[:, None]
        targets = self.controller.act(self._seen, self._commands), self.rescuer.act(self._seen, self._none)
        self.fleet.write(np.where(rescued, targets[1], targets[0]))
        self.measured = self.fleet.read()
        broken = self.fleet.broken | ~np.isfinite(self.fleet.qvel).all(axis=1)
        for world in np.flatnonzero(broken):  # nothing is left of it that could stand up
            self.reset(int(world))
        tilted = self.contract.ends.tilted(self.measured.gravity)
        self._fell, stood = tilted & ~self.rescued, self._stood(self.measured)
        back = self.rescued & stood
        self.rescued = (self.rescued | self._fell) & ~back
        # it begins anew when it takes over, and remembers nothing until then
        self.controller.reset(self.rescued | back)
        self.rescuer.reset(~self.rescued | self._fell)
        self._fell |= broken

    def _stood(self, measured: Measurement) -> np.ndarray:
        """(N,) Upright, near the first policy's default pose and slow, for HOLD."""
        upright = ~Ends(max_tilt=UP).tilted(measured.gravity)
        near = np.abs(measured.joint_pos - self.contract.default_pose).mean(axis=1) < NEAR
        slow = np.abs(measured.joint_vel).mean(axis=1) < SLOW
        self._standing = np.where(upright & near & slow, self._standing + 1, 0)
        return self._standing >= round(HOLD / self.dt)

    def reset(self, world: int) -> None:
        """Back to the start, with the first policy."""
        super().reset(world)
        self.rescuer.reset([world])
        self.rescued[world], self._standing[world] = False, 0


def check_same(first: Contract, second: Contract) -> None:
    """Raises UserError where two policies cannot drive one robot in turns."""
    own = sorted({row.name for row in second.rows if row.measured in OWN} - {row.name for row in first.rows})
    for what, here, there in (
        ("joints", first.joints, second.joints),
        ("period", first.period, second.period),
        ("stiffness", first.stiffness.tolist(), second.stiffness.tolist()),
        ("damping", first.damping.tolist(), second.damping.tolist()),
        ("motors", first.motors, second.motors),
        ("rows with sensors of their own", [], own),
    ):
        if here != there:
            raise UserError(
                f"--switch: {what} of {first.task} and {second.task} differ, so they cannot drive one robot: {here} and {there}"
            )
