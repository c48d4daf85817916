"""Find every tensor that an environment holds, by a walk over its objects: all that a step may write.

The guard uses it to find values that a resumed run would lack. The step compiler uses it to compare values. An exact
resume does not search: it reads the list ``BaseTask.remembered``.
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
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.config import Config
from legged_mw.utils.errors import LIBRARIES

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
_FACTS = ("robot", "terrain", "clips")  # attributes of the task that no step changes
_LIST = "_remembered"  # attribute of the task; its tensors are found under their own names
_MODELS = ("MjModel", "MjSpec")  # classes that no step changes


def everything(env: RobotTask) -> dict[str, Tensor]:
    """Name -> tensor of all memory that ``env`` reaches, the simulation's included."""
    return {f"sim.{name}": value for name, value in env.sim.memory().items()} | _memory(env)


class Lost:
    """Finds values that the steps of ``env`` write and a resumed run would lack. Make it before these steps."""

    def __init__(self, env: RobotTask) -> None:
        self._env, self._before = env, {name: _mark(value) for name, value in _memory(env).items()}

    def named(self) -> str:
        """Call it after the steps: the first such value, in words; '' if there is none."""
        for name, thing in _reach(self._env, "", set()):
            if not isinstance(thing, Tensor):
                return f"what self.{name} remembers, a {type(thing).__name__}, is not kept"
        remembered = self._env.remembered().values()
        kept = {value.data_ptr() for value in remembered if value.nbytes == value.untyped_storage().nbytes()}
        for name, value in _memory(self._env).items():
            if value.data_ptr() not in kept and not _same(_mark(value), self._before.get(name)):
                return f"self.{name} is written by the step and not made by self.buffer()"
        return ""


def _mark(value: Tensor) -> tuple[int, Tensor]:
    return 0 if value.is_inference() else value._version, value.clone()


def _same(mark: tuple[int, Tensor], before: tuple[int, Tensor] | None) -> bool:
    """Whether the tensor was not written since ``before``, by torch's counter and by its bits."""
    if before is None or mark[0] != before[0] or mark[1].shape != before[1].shape or mark[1].dtype != before[1].dtype:
        return False
    return torch.equal(mark[1].view(torch.uint8), before[1].view(torch.uint8))


def _memory(env: RobotTask) -> dict[str, Tensor]:
    """Name -> a whole storage that ``env`` reaches, flat; without the simulation's."""
    seen = {value.untyped_storage().data_ptr() for value in env.sim.memory().values()}
    storages: dict[str, Tensor] = {}
    for name, value in _reach(env, "", set()):
        if not isinstance(value, Tensor):
            continue
        storage = value.untyped_storage()
        if storage.nbytes() and storage.data_ptr() not in seen:
            seen.add(storage.data_ptr())
            storages[name] = whole(value)
    return storages


def whole(tensor: Tensor) -> Tensor:
    """The whole memory of a tensor as one row."""
    return tensor.as_strided((tensor.untyped_storage().nbytes() // tensor.element_size(),), (1,), 0)


def _reach(thing: Any, path: str, done: set[int]) -> Iterator[tuple[str, Any]]:
    """(dotted name, tensor) of all tensors and arrays of numbers that ``thing`` holds.

    Also (dotted name, object) of objects that may remember something and cannot be searched.
    """
    if isinstance(thing, Tensor):
        yield path, thing
    elif thing is None or isinstance(thing, _OTHERS) or id(thing) in done or type(thing).__name__ in _MODELS:
        return
    elif isinstance(thing, np.ndarray):
        if thing.flags.writeable:
            known = thing.flags.c_contiguous and thing.dtype.kind in "fib"
            yield path, torch.from_numpy(thing) if known else thing
    else:
        done.add(id(thing))
        held = parts(thing)
        library = type(thing).__module__.partition(".")[0] in LIBRARIES
        empty = isinstance(thing, set | frozenset) and all(isinstance(each, _OTHERS) for each in thing)
        if not isinstance(thing, CONTAINERS) and not empty and (library or not (held or hasattr(thing, "__dict__"))):
            yield path, thing
            return
        for name, value in held.items():
            if name not in _FACTS or isinstance(thing, CONTAINERS):
                yield from _reach(value, f"{path}.{name}" if path else str(name), done)


def parts(thing: Any) -> dict[Any, Any]:
    """The parts of a container by key or index, of an object by the names of its attributes and slots."""
    if isinstance(thing, dict | TensorDictBase):
        return dict(thing.items())
    if isinstance(thing, list | tuple | deque):
        return dict(enumerate(thing))
    state: Any = object.__getstate__(thing)  # attributes, or (attributes, slots)
    both = state if isinstance(state, tuple) else [state]
    return {name: value for held in both for name, value in (held or {}).items() if name != _LIST}
