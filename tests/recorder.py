"""A robot of ``legged_mw.deploy`` that keeps what passes through it: shared by the tests of the seam and of the network link."""

from __future__ import annotations

import numpy as np

from legged_mw.deploy.robot import Floats, Health, Measurement, Robot


class Recorder(Robot):
    """Passes on to a robot and keeps what went through."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.targets, self.closed = robot, [], 0
        self.measured: list[Measurement] = []
        self.orders: list[str] = []  # "write", "damp" or "limp" of each period
        self.can_change_gains = robot.can_change_gains

    def read(self) -> Measurement:
        self.measured.append(self.robot.read())
        return self.measured[-1]

    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        self.targets.append(np.array(targets))
        self.orders.append("write")
        self.robot.write(targets, stiffness=stiffness, damping=damping)

    def damp(self) -> None:
        self.orders.append("damp")
        self.robot.damp()

    def limp(self) -> None:
        self.orders.append("limp")
        self.robot.limp()

    def health(self) -> Health:
        return self.robot.health()

    def close(self) -> None:
        self.closed += 1
        self.robot.close()
