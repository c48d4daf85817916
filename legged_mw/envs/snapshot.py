"""Save and restore every tensor of an environment, so that a resumed run continues bit-exactly.

The list has the tensors that the task registered by ``buffer`` and ``remember``, and the simulation's own.
"""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.simulation import CONSTANTS_READ


def memory(env: RobotTask) -> dict[str, Tensor]:
    """All tensors that a resumed run restores, by name."""
    return {f"sim.{name}": value for name, value in env.sim.memory().items()} | env.remembered()


def take_snapshot(env: RobotTask) -> dict[str, Tensor]:
    """Copies of ``memory`` on the host."""
    return {name: value.detach().to("cpu", copy=True) for name, value in memory(env).items()}


def put_snapshot(env: RobotTask, state: dict[str, Tensor]) -> str:
    """Restore ``state`` of ``take_snapshot``. Returns '', or why that is impossible; then nothing has changed."""
    own = memory(env)
    if env.not_remembered:
        return env.not_remembered
    for name in {**state, **own}:
        there, here = _words(state.get(name)), _words(own.get(name))
        if there != here:
            return f"{name} is {there} there and {here} here"
    fields = [name for name in state if name.startswith("sim.model.")]
    with torch.inference_mode():
        for name in fields:
            own[name].copy_(state[name])
        if {name.removeprefix("sim.model.") for name in fields} & {*CONSTANTS_READ}:
            env.sim.set_constants()  # before the rest: it may touch the state
        for name in state.keys() - {*fields}:
            own[name].copy_(state[name])
    return ""


def _words(value: Tensor | None) -> str:
    return "missing" if value is None else f"{value.dtype} {(*value.shape,)}".removeprefix("torch.")
