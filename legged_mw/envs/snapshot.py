"""Save and restore all tensors of an environment, so that a resumed run is bit-exact.

These are the tensors that the task registered with ``buffer`` and ``remember``, and those of the simulation.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.simulation import CONSTANTS_READ

MOST = 1e10  # largest valid value of a state: MuJoCo's mjMAXVAL
# sections of the config that a resumed run may change
_FREE = ("rewards", "noise", "viewer", "exam", "ratings", "termination")


def memory(env: RobotTask) -> dict[str, Tensor]:
    """Name -> tensor, for all tensors that a resumed run restores."""
    return {f"sim.{name}": value for name, value in env.sim.memory().items()} | env.remembered()


def take_snapshot(env: RobotTask) -> dict[str, Tensor]:
    """Copies of ``memory`` on the host."""
    return {name: value.detach().to("cpu", copy=True) for name, value in memory(env).items()}


def put_snapshot(env: RobotTask, state: dict[str, Tensor]) -> str:
    """Restore ``state`` from ``take_snapshot``. If this is not possible, change nothing and return why; else ''."""
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
            env.sim.set_constants()  # first, because it may change the state
        for name in state.keys() - {*fields}:
            own[name].copy_(state[name])
    return ""


def _words(value: Tensor | None) -> str:
    return "missing" if value is None else f"{value.dtype} {(*value.shape,)}".removeprefix("torch.")


def same_worlds(env: RobotTask) -> dict[str, Any]:
    """Engine, device and config, which must be equal for an exact resume."""
    config = {name: section for name, section in env.cfg.to_dict().items() if name not in _FREE}
    return {"engine": env.sim.engine, "device": str(env.device).partition(":")[0], "config": config}


def first_difference(there: Any, here: Any, path: str = "") -> str:
    """Text ``PATH was A and is B`` for the first value that differs, or ''."""
    if isinstance(there, dict) and isinstance(here, dict):
        for name in [*here, *(name for name in there if name not in here)]:
            inner = f"{path}.{name}" if path else str(name)
            if text := first_difference(there.get(name), here.get(name), inner):
                return text
        return ""
    return "" if there == here else f"{path.removeprefix('config.')} was {there} and is {here}"


def beyond(saved: dict[str, Tensor], own: dict[str, Tensor]) -> str:
    """The first name with a value not finite or above ``MOST`` in ``saved`` but not in ``own``, or ''."""
    return next((name for name, value in saved.items() if name in own and _sane(own[name]) and not _sane(value)), "")


def _sane(value: Tensor) -> bool:
    return not value.is_floating_point() or bool((value.abs() <= MOST).all())


def random_state(device: str) -> dict[str, Tensor]:
    """States of torch's random generators on host and device."""
    state = {"cpu": torch.get_rng_state()}
    if device.startswith("cuda"):
        state["cuda"] = torch.cuda.get_rng_state(device)
    return state


def set_random_state(state: dict[str, Tensor], device: str) -> None:
    """Restore the states from ``random_state``."""
    if "cpu" in state:
        torch.set_rng_state(state["cpu"].cpu())
    if "cuda" in state and device.startswith("cuda"):
        torch.cuda.set_rng_state(state["cuda"].cpu(), device)
