"""What a health page is about: a robot on level ground in its default pose, taken from a task."""

from __future__ import annotations

import copy
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.errors import ModelError
from legged_mw.sim.model import RobotModel
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import LoadedTask

TABLES: dict[str, Any] = {  # a number each joint must have: dotted path -> a table that fits any joint
    "control.stiffness": {"": 1.0},
    "control.damping": {"": 0.0},
    "control.action_scale": 1.0,
    "init_state.default_joint_angles": {"": 0.0},
    "rewards.pose_weights": {"": 1.0},
}


class Case(NamedTuple):
    """A robot as a task has it."""

    robot: RobotModel
    pose: list[float]  # (D,) [rad] of action 0
    place: list[float]  # (3,) [m] of the root at reset
    feet: dict[str, tuple[str, ...]]  # name -> geoms; none of a task without feet
    imu: str  # its site
    speeds: list[float | None]  # (D,) [rad/s]; None: nobody said
    decimation: int  # substeps a control step


def from_task(task: LoadedTask) -> Case:
    """The robot of ``task`` as its environment builds it, but one, and on a plane."""
    return from_env(_small(task))


def from_env(env: RobotTask) -> Case:
    feet = dict(env.foot_geoms) if isinstance(env, LeggedRobot) else {}
    return Case(
        env.robot,
        env.default_dof_pos.tolist(),
        env.init_pos.tolist(),
        feet,
        env.robot.imu,
        [speed if math.isfinite(speed) else None for speed in env.robot.speed_limits],
        env.cfg.control.decimation,
    )


def _small(task: LoadedTask, tables: Mapping[str, Any] | None = None) -> RobotTask:
    """One world of ``task`` on a plane, in MuJoCo's own engine, with other ``tables``: path -> value."""
    one = copy.deepcopy(task)
    for path, value in {"env.num_envs": 1, "sim.engine": "mujoco", **(tables or {})}.items():
        one.set(path, value)
    if isinstance(one.cfg.to_dict()["terrain"].get("mesh_type"), str):
        one.set("terrain.mesh_type", "plane")
    return one.env_class(one.cfg, "cpu")


@contextmanager
def naming_every_missing_key(task: LoadedTask) -> Iterator[None]:
    """Where joints have no number in several tables of the config, the error that ends the block names them all."""
    try:
        yield
    except (ModelError, ConfigError):
        found = dict.fromkeys(text for path in TABLES if (text := _wrong_with(task, path)))  # what is wrong elsewhere shows each time
        if len(found) < 2:
            raise
        raise ModelError("; ".join(found)) from None


def _wrong_with(task: LoadedTask, table: str) -> str:
    """The error that ``task`` has where its other tables fit any joint."""
    try:
        _small(task, {other: fits for other, fits in TABLES.items() if other != table})
    except (ModelError, ConfigError) as error:
        return str(error)
    return ""
