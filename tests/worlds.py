"""What the environment's tests share: building a small one on the CPU, and looking at all of its tensors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.utils.task import load_task

QUIET = {"noise.level": 0.0, "commands.resampling_time": 0.0}  # nothing drawn within an episode
# a row of the group `state` of go1_flat -> its size
STATE = {
    "base_lin_vel": 3,
    "base_ang_vel": 3,
    "projected_gravity": 3,
    "dof_pos": 12,
    "dof_vel": 12,
    "last_actions": 12,
    "commands": 3,
}


def make_env(
    num_envs: int,
    overrides: Mapping[str, Any] | None = None,
    *,
    task: str = "go1_flat",
    env_class: type[LeggedRobot] | None = None,
) -> LeggedRobot:
    """A task's environment with fields overridden by their dotted path, always from the same seed; no kicks unless asked for."""
    loaded = load_task(task)
    for path, value in {"env.num_envs": num_envs, "perturbation.kick": False, **(overrides or {})}.items():
        loaded.set(path, value)
    torch.manual_seed(0)
    return (env_class or loaded.env_class)(loaded.cfg, "cpu")


def only_scales(**wanted: float) -> dict[str, float]:
    """Overrides that switch every reward term off but ``wanted``."""
    names = load_task("go1_flat").cfg.to_dict()["rewards"]["scales"]
    return {f"rewards.scales.{name}": wanted.get(name, 0.0) for name in {**names, **wanted}}


def layout(env: LeggedRobot) -> dict[str, dict[str, int]]:
    """Columns of each row of each observation group."""
    return {group: {row.name: row.size for row in rows} for group, rows in env.observations.groups.items()}


def tensors(env: LeggedRobot) -> dict[str, Tensor]:
    """Every tensor that ``env`` or its simulation holds, also inside dicts and lists, by its path."""

    def walk(path: str, value: Any) -> Iterator[tuple[str, Tensor]]:
        if isinstance(value, Tensor):
            yield path, value
        elif isinstance(value, Row):
            yield from walk(path, value.value)
        elif isinstance(value, dict):
            for key, inner in value.items():
                yield from walk(f"{path}.{key}", inner)
        elif isinstance(value, list | tuple):
            for i, inner in enumerate(value):
                yield from walk(f"{path}.{i}", inner)
        elif type(value).__module__.startswith("legged_mw.envs.") and value is not env:
            yield from walk(path, vars(value))

    own = {name: value for name, value in vars(env).items() if name != "_remembered"}  # which has them once more
    return dict(walk("env", own)) | dict(walk("sim", vars(env.sim)))


def snapshot(env: LeggedRobot) -> dict[str, Tensor]:
    """Copies of all tensors."""
    return {name: tensor.clone() for name, tensor in tensors(env).items()}


def same(a: Tensor, b: Tensor) -> bool:
    """Bit for bit, where NaN equals NaN."""
    return a.shape == b.shape and a.dtype == b.dtype and bool(((a == b) | ((a != a) & (b != b))).all())


def changed(env: LeggedRobot, before: Mapping[str, Tensor], worlds: Tensor | None = None) -> list[str]:
    """Names of tensors that differ from ``before``; with ``worlds`` (bool mask), in these worlds where a tensor has a row for each.

    A command's past has its worlds second, after the frames.
    """
    now = tensors(env)
    assert now.keys() == before.keys()
    n = env.num_envs

    def part(tensor: Tensor) -> Tensor:
        if worlds is not None and tensor.dim() == 3 and tensor.shape[0] != n and tensor.shape[1] == n:
            return tensor[:, worlds]
        return tensor[worlds] if worlds is not None and tensor.dim() and tensor.shape[0] == n else tensor

    return [name for name in now if not same(part(now[name]), part(before[name]))]
