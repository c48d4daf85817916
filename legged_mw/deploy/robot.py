"""The interface between a policy and a robot.

To add a real robot, write a subclass of ``Robot`` with the three abstract methods on its SDK and pass it to
``runner.run``. ``simulated`` has a simulated robot, ``examples/udp_robot.py`` a robot with a network link.
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
    """The robot does not answer, or its answer does not fit the contract. The text states cause and reaction."""


@dataclass(frozen=True)
class Measurement:
    """A measurement of one robot; D joints in the contract's order, F feet. Of N robots each is (N, ...).

    A value can stay zero if no observation row of the contract needs it.
    """

    lin_vel: Floats  # (3,) of the IMU, body frame (x forward, y left, z up) [m/s]; a real robot estimates it
    ang_vel: Floats  # (3,) gyro, body frame [rad/s]
    gravity: Floats  # (3,) direction of gravity, body frame, unit length: (0, 0, -1) when standing level
    joint_pos: Floats  # (D,) [rad] measured angle; the controller subtracts the default pose
    joint_vel: Floats  # (D,) [rad/s]
    joint_torque: Floats  # (D,) [N m]
    acceleration: Floats  # (3,) of the IMU, body frame: (0, 0, 9.81) [m/s^2] when standing level
    foot_contact: Floats  # (F,) 1 for a foot on the ground, else 0
    # Row -> (size,): rows that name their sensors, and the height scan. With a reference motion also the root's
    # attitude (4,) w x y z, and its position (3,) [m] if a row needs it.
    others: Mapping[str, Floats] = field(default_factory=dict)

    def of(self, robot: int) -> Measurement:
        """The measurement of one robot of many."""
        own = {name: getattr(self, name)[robot] for name in QUANTITIES}
        return Measurement(**own, others={name: values[robot] for name, values in self.others.items()})


@dataclass(frozen=True)
class Remote:
    """The state of a remote or gamepad. Sticks are in [-1, 1]."""

    buttons: frozenset[str] = frozenset()  # pressed buttons of BUTTONS
    lx: float = 0.0  # left stick, positive to the right
    ly: float = 0.0  # left stick, positive forward
    rx: float = 0.0  # right stick, positive to the right
    ry: float = 0.0  # right stick, positive forward


# [Unitree] names and order of a remote's buttons
BUTTONS = ("R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left")


@dataclass(frozen=True)
class Health:
    """The state of a robot's hardware; None: not reported."""

    age_s: float | None = None  # [s] age of the newest measurement
    temperatures: Floats | None = None  # (D,) [deg C] of the motors
    voltage: float | None = None  # [V] of the battery
    remote: Remote | None = None  # None also for a remote that is off or out of reach
    motor_faults: Mapping[str, str] = field(default_factory=dict)  # joint -> reported fault of its motor


DAMPING = 3.0  # [N m s/rad] smallest damping of a joint without stiffness [unitree_rl_lab, Passive]
QUANTITIES = tuple(f.name for f in fields(Measurement) if f.name != "others")


def layout(contract: Contract) -> dict[str, int]:
    """Number of values of each quantity of a measurement; the rows in ``Measurement.others`` are last."""
    own = {row.name: row.size for row in contract.rows if row.measured in OWN and row.measured}
    own |= ({ATTITUDE: 4} if contract.motion else {}) | (
        {POSITION: 3} if any(row.measured == PLACE for row in contract.rows) else {}
    )
    return {**{name: quantity_size(contract, name) for name in QUANTITIES}, **own}


def damped(contract: Contract) -> Floats:
    """Damping (D,) [N m s/rad] of joints without stiffness: the contract's, but at least DAMPING."""
    return np.maximum(contract.damping, DAMPING)


class Robot(ABC):
    """One robot. In each ``contract.period`` the caller calls ``read``, then ``write``, and waits.

    Both calls must take much less than a period. Joints are in the contract's order, not in the robot's.
    The methods that are not abstract are optional.
    """

    can_change_gains = False  # True if `write` applies stiffness and damping
    motors: Mapping[str, int] = {}  # joint -> number of its motor, if motors have numbers
    limits: Mapping[str, float] = {}  # limits of this robot; names and units as in safety.Limits
    # [s] between two measurements, if the robot sends them faster than the policy's rate; for the chirp
    step: float | None = None
    report: str = ""  # quality of the link during the run, in words; set by `close`

    @abstractmethod
    def read(self) -> Measurement:
        """The newest measurement. Raises RobotError if it is too old."""

    @abstractmethod
    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        """Servo targets (D,) [rad] for the next period, held by position servos.

        ``stiffness`` (D,) [N m/rad] and ``damping`` (D,) [N m s/rad]; None: the contract's. A robot that cannot change
        them uses the contract's and sets `can_change_gains` to False.
        If the contract's action has the origin "torque", the targets are torques [N m].
        """

    @abstractmethod
    def close(self) -> None:
        """Switch the servos off, so that joints are damped, and close links. Safe to call twice and after an error."""

    def damp(self) -> None:
        """Damp the joints without stiffness in the next period. By default it closes the robot.

        This ends the run. A robot that stays connected overrides it, and the run continues.
        """
        self.close()

    def limp(self) -> None:
        """Apply no torque in the next period. By default it calls ``damp``."""
        self.damp()

    def health(self) -> Health:
        """The robot's health; nothing is reported by default."""
        return Health()

    def fell(self) -> bool:
        """True for a fall by a rule that only the robot can check. The caller checks the tilt from ``read``."""
        return False

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
