"""The two protocols of watching: a stage has moving robots, a viewer shows a moment of it. Types only.

A stage may be the training environment or any other physics; a viewer may be a window, a web page or a file. Neither
knows the other: `session.py` steps the stage and hands moments to the viewer. In `view/` only `env_stage.py` uses torch.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
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
    """Nothing can be shown or recorded as asked; the text says what this machine lacks and what to do."""


class Stage(Protocol):
    """N robots in N separate worlds. They follow C commands; a stage with C = 0 cannot be driven. Arrays handed out are the caller's."""

    spec: mujoco.MjSpec  # one robot with its scene, for drawing
    num_worlds: int
    dt: float  # control step [s]
    command_table: tuple[Command, ...]  # (C,) with the ranges as trained

    def step(self, commands: FloatArray | None) -> None:
        """One control step of all worlds under `commands` (N, C); None: under the stage's own."""

    def commands(self) -> FloatArray:
        """The command of each robot now (N, C)."""
        ...

    def velocity(self) -> FloatArray:
        """The measured velocity of each robot (N, 3): vx, vy, yaw rate at the IMU, body frame."""
        ...

    def believed_velocity(self) -> FloatArray | None:
        """vx, vy (N, 2) that the policy believed when it acted last, as in `velocity`; None if it estimates none."""
        ...

    def qpos(self) -> FloatArray:
        """Pose of each robot (N, nq), world frame."""
        ...

    def ghost(self) -> FloatArray | None:
        """What each robot is to follow (N, nq); None where it follows no motion."""
        ...

    def contacts(self) -> BoolArray:
        """Which geoms of the feet touch the ground (N, G), in the order of the model's first G contact sensors."""
        ...

    def fell(self) -> BoolArray:
        """Which robots fell in the last step (N,)."""
        ...

    def ground(self, world: int) -> str:
        """The ground below a robot, in words; empty where that is a plane."""
        ...

    def push(self, world: int, velocity: FloatArray) -> None:
        """Add (2,) [m/s], world frame, to the robot's horizontal velocity at once."""

    def reset(self, world: int) -> None:
        """Put one robot back to its start."""


class Fall(NamedTuple):
    """Where a robot fell."""

    world: int
    place: FloatArray  # (3,) of the base one step before, in that world's frame [m]


class Moment(NamedTuple):
    """All that a viewer shows of one instant."""

    time: float  # [s]
    qpos: FloatArray  # (N, nq)
    commands: FloatArray  # (N, C)
    target_velocity: FloatArray  # (N, 3) commanded vx, vy, yaw rate; NaN where there is no such command
    velocity: FloatArray  # (N, 3) measured
    contacts: BoolArray  # (N, G)
    falls: tuple[Fall, ...] = ()  # the latest ones
    world: int = 0  # the robot that is followed, driven and measured
    camera: str = "follow"  # one of drive.CAMERAS
    lines: tuple[tuple[str, str], ...] = ()  # text to show: (name, value)
    help: bool = False  # show the keys
    ghost: FloatArray | None = None  # (N, nq) what robots follow
    top_speed: float = 1.0  # [m/s] the fastest that robots can be commanded to go: arrows are drawn to fit it


class Viewer(Protocol):
    """Shows moments until it is closed."""

    def show(self, moment: Moment) -> None:
        """Show one moment; does nothing once closed."""

    def is_running(self) -> bool:
        """False once the user closed it."""
        ...

    def close(self) -> None:
        """Free all that is held; again is allowed."""


def velocity_columns(table: Sequence[Command]) -> dict[int, int]:
    """Column of the command -> column of the velocity (vx, vy, yaw rate), for the commands that are velocities."""
    return {column: VELOCITY.index(command.name) for column, command in enumerate(table) if command.name in VELOCITY}


def top_speed(table: Sequence[Command]) -> float:
    """The fastest [m/s] along one axis that the commands allow; 1 if none is a velocity."""
    ends = [abs(end) for command in table if command.name in VELOCITY[:2] for end in (command.low, command.high)]
    return max(ends, default=0.0) or 1.0


def target_velocity(table: Sequence[Command], commands: FloatArray) -> FloatArray:
    """Commanded vx, vy, yaw rate (N, 3) out of `commands` (N, C); NaN where there is no such command."""
    target = np.full((len(commands), len(VELOCITY)), np.nan)
    for column, component in velocity_columns(table).items():
        target[:, component] = commands[:, column]
    return target
