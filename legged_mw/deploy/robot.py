"""The seam: what a robot promises to a policy. ``simulated`` has a simulated one, ``examples/udp_robot.py`` one behind a network link.

A real robot's SDK plugs in here: write one class with the three methods of ``Robot`` and hand it to ``runner.run``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import ATTITUDE, OWN, PLACE, POSITION, Contract, quantity_size
from legged_mw.utils.errors import UserError

Floats = NDArray[np.float64]


class RobotError(UserError, RuntimeError):
    """A robot that does not answer, or not as the contract wants; the text states what happened and what was done."""


@dataclass(frozen=True)
class Measurement:
    """What one robot measures at one moment; D joints in the contract's order, F feet. Many robots: (N, ...) each.

    What no observation row of the contract needs may stay zero.
    """

    lin_vel: (
        Floats  # (3,) of the IMU, body frame (x forward, y left, z up) [m/s]; on a real robot from a state estimator
    )
    ang_vel: Floats  # (3,) gyro, body frame [rad/s]
    gravity: Floats  # (3,) direction of gravity, body frame, unit length: standing level it is (0, 0, -1)
    joint_pos: Floats  # (D,) [rad], the angle itself: the contract's default pose is taken off later
    joint_vel: Floats  # (D,) [rad/s]
    joint_torque: Floats  # (D,) [N m]
    acceleration: Floats  # (3,) of the IMU, body frame: standing level it is (0, 0, 9.81) [m/s^2]
    foot_contact: Floats  # (F,) 1 where a foot touches the ground, else 0
    # rows with sensors of their own, a height scan: row -> (size,); for a motion the root's attitude and, if a row asks for it, position
    others: Mapping[str, Floats] = field(default_factory=dict)

    def of(self, robot: int) -> Measurement:
        """That of one robot of many."""
        own = {name: getattr(self, name)[robot] for name in QUANTITIES}
        return Measurement(**own, others={name: values[robot] for name, values in self.others.items()})


@dataclass(frozen=True)
class Remote:
    """A remote or gamepad as it is held now."""

    buttons: frozenset[str] = frozenset()  # pressed, of BUTTONS
    lx: float = 0.0  # left stick to the right, in -1..1, as the others
    ly: float = 0.0  # left stick ahead
    rx: float = 0.0  # right stick to the right
    ry: float = 0.0  # right stick ahead


# [Unitree] names and order of the buttons on its remotes
BUTTONS = ("R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left")


@dataclass(frozen=True)
class Health:
    """What a robot tells about itself beside its measurement; None: it does not tell."""

    age_s: float | None = None  # of the newest measurement [s]
    temperatures: Floats | None = None  # (D,) of the motors [deg C]
    voltage: float | None = None  # of the battery [V]
    remote: Remote | None = None  # None too where a remote is switched off or out of reach
    motor_faults: Mapping[str, str] = field(default_factory=dict)  # joint -> what its motor reports


DAMPING = 3.0  # [N m s/rad] at least, of a joint that is only damped [unitree_rl_lab, Passive]
QUANTITIES = tuple(f.name for f in fields(Measurement) if f.name != "others")


def layout(contract: Contract) -> dict[str, int]:
    """Values of each part of a measurement, the rows with sensors of their own last."""
    own = {row.name: row.size for row in contract.rows if row.measured in OWN and row.measured}
    own |= ({ATTITUDE: 4} if contract.motion else {}) | (
        {POSITION: 3} if any(row.measured == PLACE for row in contract.rows) else {}
    )
    return {**{name: quantity_size(contract, name) for name in QUANTITIES}, **own}


def damped(contract: Contract) -> Floats:
    """(D,) [N m s/rad] of joints that are only damped: the contract's, and at least DAMPING."""
    return np.maximum(contract.damping, DAMPING)


class Robot(ABC):
    """One robot. The caller calls ``read``, then ``write``, once a ``contract.period``, and keeps the time.

    Both calls must return well within the period. Joints are in the contract's order, not in the machine's own.
    The methods that are not abstract are there for robots that have no more to offer.
    """

    can_change_gains = False  # whether `write` obeys stiffness and damping
    motors: Mapping[str, int] = {}  # joint -> number of its motor, where motors have numbers
    limits: Mapping[str, float] = {}  # of this machine, which no contract knows: names and units as in safety.Limits
    report: str = ""  # after `close`: what happened on the way to it, in words

    @abstractmethod
    def read(self) -> Measurement:
        """The newest measurement. Raises RobotError if there is none younger than the robot can be trusted with."""

    @abstractmethod
    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        """Servo targets (D,) [rad] for the next period, held by position servos.

        ``stiffness`` (D,) [N m/rad] and ``damping`` (D,) [N m s/rad]; None: the contract's. A robot that cannot change them
        takes the contract's, and says so by `can_change_gains`.
        Where the contract's action has the origin "torque" the targets are torques [N m].
        """

    @abstractmethod
    def close(self) -> None:
        """Switch the servos off, so that joints are only damped, and close links. Safe to call twice, and after an error."""

    def damp(self) -> None:
        """For the next period: no stiffness, joints only damped. Here it closes the robot, which ends the run."""
        self.close()

    def limp(self) -> None:
        """For the next period: no torque at all. Here as ``damp``."""
        self.damp()

    def health(self) -> Health:
        """What it tells about itself, now; nothing by default."""
        return Health()

    def fell(self) -> bool:
        """Whether it fell by a rule of the contract that only the robot can judge; the tilt is judged from ``read``."""
        return False

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
