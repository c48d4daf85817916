"""The two seams of watching: a stage has robots that move, a viewer shows a moment of it. Types only.

A stage may be the training environment or any other physics; a viewer may be a window, a web page or a file. Neither
knows the other: `session.py` steps the one and shows the other what there is to see. No torch here, nor below `view/`
but in `env_stage.py`.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.utils.errors import UserError

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]


class ViewError(UserError, RuntimeError):
    """Nothing can be shown or recorded as asked; the text says what this machine lacks and what to do."""


class Stage(Protocol):
    """N robots in N worlds of their own that follow commands. Arrays handed out are the caller's to keep."""

    model: mujoco.MjModel  # one robot with its scene, for drawing
    num_worlds: int
    dt: float  # control step [s]
    limits: FloatArray  # (2, 3) lowest and highest command as trained: vx, vy [m/s], yaw rate [rad/s]

    def step(self, commands: FloatArray | None) -> None:
        """One control step of all worlds under `commands` (N, 3); None: under the stage's own."""
        ...

    def commands(self) -> FloatArray:
        """What each robot follows now (N, 3)."""
        ...

    def velocity(self) -> FloatArray:
        """What each robot does (N, 3): vx, vy, yaw rate at the IMU, body frame."""
        ...

    def qpos(self) -> FloatArray:
        """Pose of each robot (N, nq), world frame."""
        ...

    def contacts(self) -> BoolArray:
        """Which feet stand (N, F), in the order of the model's first F contact sensors."""
        ...

    def fell(self) -> BoolArray:
        """Which robots fell in the last step (N,)."""
        ...

    def ground(self, world: int) -> str:
        """What a robot walks on, in words; empty where that is a plane."""
        ...

    def push(self, world: int, velocity: FloatArray) -> None:
        """Let the robot's horizontal velocity jump by (2,) [m/s], world frame."""
        ...

    def reset(self, world: int) -> None:
        """Set one robot up anew."""
        ...


class Fall(NamedTuple):
    """Where somebody fell."""

    world: int
    place: FloatArray  # (3,) of the base just before, that world's frame [m]


class Moment(NamedTuple):
    """All that a viewer shows of one instant."""

    time: float  # [s]
    qpos: FloatArray  # (N, nq)
    commands: FloatArray  # (N, 3)
    velocity: FloatArray  # (N, 3)
    contacts: BoolArray  # (N, F)
    falls: tuple[Fall, ...] = ()  # the latest, as long as they are to be seen
    world: int = 0  # the robot that is followed, driven and measured
    camera: str = "follow"  # one of drive.CAMERAS
    lines: tuple[tuple[str, str], ...] = ()  # what to say in words: (name, value)
    help: bool = False  # the keys are asked for


class Viewer(Protocol):
    """Shows moments until somebody closes it."""

    def show(self, moment: Moment) -> None:
        """Show one moment; does nothing once closed."""
        ...

    def is_running(self) -> bool:
        """False once there is nobody left to show anything to."""
        ...

    def close(self) -> None:
        """Free all that is held; again is allowed."""
        ...
