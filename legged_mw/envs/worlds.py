"""All that the worlds of an environment remember, as tensors by name: to go on another day as if nothing had been.

Found, not listed, so that a task's own buffers are there too: whatever is written in place, as the rules of the step demand.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from enum import Enum
from pathlib import PurePath
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.graph import StepGraph
from legged_mw.sim.simulation import CONSTANTS_READ, Simulation
from legged_mw.utils.config import Config

CONTAINERS = (dict, list, tuple, deque, TensorDictBase, nn.Module)
_PLAIN = (
    str,
    bytes,
    int,
    float,
    complex,
    slice,
    range,
    type,
    Enum,
    PurePath,
    torch.device,
    torch.dtype,
    np.generic,
    np.dtype,
)
_OTHERS = (*_PLAIN, Config, ModuleType, FunctionType, BuiltinFunctionType, MethodType, Simulation, StepGraph)
_LIBRARIES = ("torch", "numpy", "warp", "mujoco", "mujoco_warp", "tensordict", "rsl_rl")
_FACTS = ("robot", "terrain", "clips")  # of the task, which no step changes
_MODELS = ("MjModel", "MjSpec")  # nor these


def worlds_state(env: RobotTask) -> dict[str, Tensor]:
    """Copies on the host of what was ever written in place: in the simulation, and in whatever else ``env`` holds."""
    own = {name: value for name, (value, written) in _memory(env).items() if written}
    return {name: value.detach().to("cpu", copy=True) for name, value in (_simulation(env) | own).items()}


def put_worlds(env: RobotTask, state: dict[str, Tensor]) -> str:
    """Put back what ``worlds_state`` returned. Returns why that cannot be, and then nothing has changed; '' if it is done."""
    own = everything(env)
    for name, thing, _ in _reach(env, "", set()):
        if not isinstance(thing, Tensor):
            return f"what {name} remembers, a {type(thing).__name__}, is not kept"
    for name, value in state.items():
        if name not in own or own[name].shape != value.shape or own[name].dtype != value.dtype:
            return f"{name} is {_words(value)} there and {_words(own.get(name))} here"
    fields = [name for name in state if name.startswith("sim.model.")]
    with torch.inference_mode():
        for name in fields:
            own[name].copy_(state[name])
        if {name.removeprefix("sim.model.") for name in fields} & {*CONSTANTS_READ}:
            env.sim.set_constants()  # before the rest: it may touch the state
        for name in state.keys() - {*fields}:
            own[name].copy_(state[name])
    return ""


def everything(env: RobotTask) -> dict[str, Tensor]:
    """All memory that ``env`` reaches, by name: the simulation's, and whatever else it holds."""
    return _simulation(env) | {name: value for name, (value, _) in _memory(env).items()}


def _words(value: Tensor | None) -> str:
    return "missing" if value is None else f"{value.dtype} {(*value.shape,)}".removeprefix("torch.")


def _simulation(env: RobotTask) -> dict[str, Tensor]:
    return {f"sim.{name}": value for name, value in env.sim.memory().items()}


def _memory(env: RobotTask) -> dict[str, tuple[Tensor, bool]]:
    """Name -> a piece of memory that ``env`` reaches, all of it and flat, and whether it was ever written; not the simulation's."""
    seen = {value.untyped_storage().data_ptr() for value in env.sim.memory().values()}
    found: dict[str, tuple[Tensor, bool]] = {}
    for name, value, written in _reach(env, "", set()):
        if not isinstance(value, Tensor):
            continue
        storage = value.untyped_storage()
        if storage.nbytes() and storage.data_ptr() not in seen:
            seen.add(storage.data_ptr())
            found[name] = value.as_strided((storage.nbytes() // value.element_size(),), (1,), 0), written
    return found


def _reach(thing: Any, path: str, done: set[int]) -> Iterator[tuple[str, Any, bool]]:
    """(dotted name, tensor, whether it was ever written) of all tensors and arrays of numbers that ``thing`` holds.

    In the place of a tensor stands what may remember something and is not looked into.
    """
    if isinstance(thing, Tensor):
        yield path, thing, thing.is_inference() or thing._version > 0
    elif thing is None or isinstance(thing, _OTHERS) or id(thing) in done or type(thing).__name__ in _MODELS:
        return
    elif isinstance(thing, np.ndarray):
        if thing.flags.writeable:
            known = thing.flags.c_contiguous and thing.dtype.kind in "fib"
            yield path, torch.from_numpy(thing) if known else thing, True
    else:
        done.add(id(thing))
        held = parts(thing)
        library = type(thing).__module__.partition(".")[0] in _LIBRARIES
        empty = isinstance(thing, set | frozenset) and all(isinstance(each, _OTHERS) for each in thing)
        if not isinstance(thing, CONTAINERS) and not empty and (library or not (held or hasattr(thing, "__dict__"))):
            yield path, thing, True
            return
        for name, value in held.items():
            if name not in _FACTS or isinstance(thing, CONTAINERS):
                yield from _reach(value, f"{path}.{name}" if path else str(name), done)


def parts(thing: Any) -> dict[Any, Any]:
    """What ``thing`` holds, by key, place or name: a container, or an object with attributes or slots."""
    if isinstance(thing, dict | TensorDictBase):
        return dict(thing.items())
    if isinstance(thing, list | tuple | deque):
        return dict(enumerate(thing))
    state: Any = object.__getstate__(thing)  # attributes; or those, and slots
    return {
        name: value for held in (state if isinstance(state, tuple) else [state]) for name, value in (held or {}).items()
    }
