"""The two protocols of watching: a stage moves robots, a viewer shows a moment of them. Types only.

A stage is the training environment or another physics; a viewer is a window, a web page or a file. Neither knows the
other: `session.py` steps the stage and passes moments to the viewer. In `view/` only `playing.py` imports torch.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.utils.errors import UserError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class ViewError(UserError, RuntimeError):
    """Showing or recording failed. The text names what this machine lacks and what to do."""


class Stage(Protocol):
    """N robots in N separate worlds, with C commands. With C = 0 it cannot be driven. Returned arrays are copies.

    A stage without an estimator, a reference motion, kinds of ground or pushes leaves those methods out.
    """

    spec: mujoco.MjSpec  # one robot with its scene, for drawing
    num_worlds: int
    dt: float  # control step [s]
    command_table: tuple[Command, ...]  # (C,) with the trained ranges

    def step(self, commands: FloatArray | None) -> None:
        """Do one control step of all worlds under `commands` (N, C). None: the stage's own commands."""

    def commands(self) -> FloatArray:
        """The current command of each robot (N, C)."""
        ...

    def velocity(self) -> FloatArray:
        """The measured velocity of each robot (N, 3): vx, vy, yaw rate at the IMU, body frame."""
        ...

    def believed_velocity(self) -> FloatArray | None:
        """The policy's estimate of vx, vy (N, 2) at its last action, as in `velocity`; None without an estimator."""
        return None

    def qpos(self) -> FloatArray:
        """Pose of each robot (N, nq), world frame."""
        ...

    def ghost(self) -> FloatArray | None:
        """The reference pose of each robot (N, nq), world frame; None without a reference motion."""
        return None

    def contacts(self) -> BoolArray:
        """Mask (N, G) of the foot geoms in contact, in the order of the model's first G contact sensors."""
        ...

    def fell(self) -> BoolArray:
        """Mask (N,) of the robots that fell in the last step."""
        ...

    def ground(self, world: int) -> str:
        """The kind of ground below a robot as text; empty for a plane."""
        return ""

    def push(self, world: int, velocity: FloatArray) -> None:
        """Add `velocity` (2,) [m/s], world frame, to the robot's horizontal velocity."""

    def reset(self, world: int) -> None:
        """Reset one robot to its start state."""


class Fall(NamedTuple):
    """The fall of a robot."""

    world: int
    place: FloatArray  # (3,) [m] of the base one step before, world frame


class Moment(NamedTuple):
    """The content of one picture."""

    time: float  # [s]
    qpos: FloatArray  # (N, nq)
    commands: FloatArray  # (N, C)
    target_velocity: FloatArray  # (N, 3) commanded vx, vy, yaw rate; NaN for a missing command
    velocity: FloatArray  # (N, 3) measured vx, vy, yaw rate
    contacts: BoolArray  # (N, G)
    falls: tuple[Fall, ...] = ()  # the latest ones
    world: int = 0  # index of the followed robot
    camera: str = "follow"  # one of drive.CAMERAS
    lines: tuple[tuple[str, str], ...] = ()  # text lines: (name, value)
    help: bool = False  # show the keys
    ghost: FloatArray | None = None  # (N, nq) reference poses
    top_speed: float = 1.0  # [m/s] fastest command; it scales the arrows


class Viewer(Protocol):
    """Shows moments until it is closed."""

    def show(self, moment: Moment) -> None:
        """Show one moment. Does nothing after the viewer is closed."""

    def is_running(self) -> bool:
        """False after the user has closed the viewer."""
        ...

    def close(self) -> None:
        """Free all resources. May be called twice."""


def velocity_columns(table: Sequence[Command]) -> dict[int, int]:
    """For each velocity command: column of the command -> column of the velocity (vx, vy, yaw rate)."""
    return {column: VELOCITY.index(command.name) for column, command in enumerate(table) if command.name in VELOCITY}


def top_speed(table: Sequence[Command]) -> float:
    """The largest commanded speed [m/s] along one axis; 1 without velocity commands."""
    ends = [abs(end) for command in table if command.name in VELOCITY[:2] for end in (command.low, command.high)]
    return max(ends, default=0.0) or 1.0


def target_velocity(table: Sequence[Command], commands: FloatArray) -> FloatArray:
    """Commanded vx, vy, yaw rate (N, 3) from `commands` (N, C); NaN for a missing command."""
    target = np.full((len(commands), len(VELOCITY)), np.nan)
    for column, component in velocity_columns(table).items():
        target[:, component] = commands[:, column]
    return target
