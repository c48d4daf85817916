"""A policy that another task trained, in this one: what it reads here, and why its actions may mean something else."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from inspect import getfile
from typing import Any

from legged_mw.envs.observations import Observations, Row
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.utils.commands import command_table
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

# Fields that must be equal, since an action or a row means something else where they are not; those that a task has.
_SAME = ("control.action_origin", "normalization.clip_actions", "gait.period", "gait.offsets")
_SAME_SCAN = ("terrain.measured_points_x", "terrain.measured_points_y")


def class_in(env: RobotTask, kind: type[RobotTask]) -> type[RobotTask] | None:
    """``kind`` among the classes of ``env``; by its name and file, since a task's file may have been imported twice."""
    return next(
        (
            each
            for each in type(env).__mro__
            if each.__qualname__ == kind.__qualname__ and getfile(each) == getfile(kind)
        ),
        None,
    )


def observe_as(
    env: RobotTask, kind: type[RobotTask], cfg: RobotTaskCfg, groups: Sequence[str], name: str
) -> Observations:
    """Observations of ``env`` as a ``kind`` with the config ``cfg`` has them; ``name`` is what a policy reads in ``groups``.

    They are exact and not delayed: noise would only blur what is to be learned from the policy. Raises ConfigError for a
    group that the table does not have.
    """
    with _config_of(env, cfg):  # the rows go by the section noise and others
        table = kind.observation_rows(env)
    for group in groups:
        if group not in table:
            raise ConfigError(unknown("observation group", group, table, kind.__name__))
    exact = {
        group: [row if isinstance(row, str) else row._replace(noise=0.0) for row in rows]
        for group, rows in table.items()
    }
    return Observations({**exact, name: [*groups]}, cfg.observations, 0.0, env.num_envs, env.device, lambda width: None)


def in_words(rows: Iterable[Row]) -> str:
    """``base_ang_vel 3, dof_pos 12 x 5 frames``"""
    return ", ".join(
        f"{row.name} {row.value.shape[1]}" + (f" x {row.history} frames" if row.history > 1 else "") for row in rows
    )


def differences(env: RobotTask, cfg: RobotTaskCfg, rows: Iterable[Row]) -> list[str]:
    """What keeps a policy of the config ``cfg``, which reads ``rows``, from meaning the same in ``env``: a clause for each."""
    kinds = [_field(each, "control.actuator") for each in (cfg, env.cfg)]
    found = [_differ("control.actuator", *kinds)] if "torque" in kinds else []
    there, here = (
        ", ".join(command.name for command in table) or "none" for table in (command_table(cfg), env.command_table)
    )
    found.append(_differ("the list of commands", there, here))
    if any(found):
        return [text for text in found if text]
    with _config_of(env, cfg):
        theirs, ours = env._load_robot("mujoco"), env.robot
    if theirs.joint_names != ours.joint_names:
        return [
            f"its robot is another one, with the joints {_few(theirs.joint_names)}; here they are {_few(ours.joint_names)}"
        ]
    found = [_joint("default angle", ours.joint_names, theirs.pose, ours.pose, " rad")]
    there, here = (robot.tables["control.action_scale"] for robot in (theirs, ours))
    found.append(_joint("control.action_scale", ours.joint_names, there, here, ""))
    there, here = (f"{1.0 / (each.sim.dt * each.control.decimation):g} Hz" for each in (cfg, env.cfg))
    found.append(_differ("the control rate", there, here))
    found.append(_differ("asset.imu_site", theirs.imu, ours.imu))
    scan = [row for row in rows if row.name == "height_scan"]
    if scan and not scan[0].value.shape[1]:
        found.append(
            "it reads the height scan, which is off here: name a group in terrain.height_scan, such as privileged_state"
        )
    found += [
        _differ(path, _field(cfg, path), _field(env.cfg, path)) for path in (*_SAME, *(_SAME_SCAN if scan else ()))
    ]
    return [text for text in found if text]


@contextmanager
def _config_of(env: RobotTask, cfg: RobotTaskCfg) -> Iterator[None]:
    """``env`` with another config, on a plane, for what only reads it."""
    own = env.cfg, env.terrain
    env.cfg, env.terrain = cfg, None
    try:
        yield
    finally:
        env.cfg, env.terrain = own


def _field(cfg: RobotTaskCfg, path: str) -> Any:
    """A field by its path; None where the task has none of that name."""
    value: Any = cfg
    for name in path.split("."):
        value = getattr(value, name, None)
    return value


def _differ(what: str, there: Any, here: Any) -> str:
    return "" if there == here else f"{what} is {there} there and {here} here"


def _joint(what: str, names: Sequence[str], there: Sequence[float], here: Sequence[float], unit: str) -> str:
    """The first joint that differs."""
    for name, theirs, ours in zip(names, there, here, strict=True):
        if abs(theirs - ours) > 1e-6:
            return f"{what} of joint {name} is {theirs:g}{unit} there and {ours:g}{unit} here"
    return ""


def _few(names: Sequence[str]) -> str:
    """The first three names and how many there are."""
    return f"{', '.join(names[:3])} ... ({len(names)})" if len(names) > 3 else ", ".join(names)
