"""Check in a second on a CPU, before a training, that a task's step can be recorded; name the line that breaks a law.

A recorded step is replayed without change. So it may not read a value to the host, copy from the host, or have a shape
that depends on data (``check/recordable.py``). No tensor may move and no Python number may change, in a step and in the
calls that a training makes between steps. The step may not use Python's or numpy's random numbers; rewards only read.
"""

from __future__ import annotations

import copy
import functools
import inspect
import random
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from operator import delitem, setitem
from types import FrameType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from legged_mw.check.held import CONTAINERS, Lost, parts
from legged_mw.check.own_class import own_classes
from legged_mw.check.recordable import Births, Guard, recordable
from legged_mw.envs.robot_task import RobotTask, check_term
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.envs.statistics import BOUND
from legged_mw.utils.errors import (
    NotRecordable,
    StepError,
    UserError,
    in_short,
    is_library,
    line_of,
    line_to_blame,
    place_of,
)
from legged_mw.utils.task import LoadedTask

_WORLDS, _STEPS = 4, 3

_DRAWN = "draws Python's or numpy's random numbers, but a replay repeats what was recorded"
_DRAWN += "; write torch.rand(..., device=self.device)"

Path = tuple[str | int, ...]  # attributes, keys and indices from the environment to one of its values


def check_recordable(task: LoadedTask) -> str:
    """Run a few steps of a tiny environment of ``task`` on the CPU under the guard, in less than a second.

    Raises NotRecordable for an operation that a CUDA graph cannot record, and StepError for a method that raises, or
    returns NaN or the wrong shape: one line with the user's file, line and method. Random states are restored. Returns
    in words the first value that the step writes and that a resumed run would lack; '' if there is none.
    """
    guard = Guard()
    for kind in own_classes(task.env_class):
        for name, value in (_of_file(kind) | dict(vars(kind))).items():
            if isinstance(value, Tensor):
                what = f"{name} is made where its file is read, on the host, and the step reads it; "
                what += "make it in _init_buffers, on self.device"
                guard.on_host[value.untyped_storage().data_ptr()] = value, what, kind.__name__
    with nothing_changed(), Births(guard):
        try:
            env = _watched(task.env_class, guard)(tiny_cfg(task.cfg), "cpu", True)
            for name in ("step", "reset"):  # the CPU's engine may use the host
                setattr(env.sim, name, _unwatched(getattr(env.sim, name), guard))
            _check_rows(env)
            lost = Lost(env)
            _check_steps(env, guard)
            return lost.named()
        except StepError as error:
            raise type(error)(error.what, f"{task.name}: {error.where or line_to_blame(error)[0]}") from None
        except UserError:
            raise
        except Exception as error:
            where, users = line_to_blame(error)
            own = [] if users else _own_methods(task.env_class)
            if not users and not own:
                raise
            what = in_short(error)
            if own:
                what += f" ({'this does' if len(own) == 1 else 'one of these does'} not fit: {'; '.join(own)})"
            raise StepError(what, f"{task.name}: {where}".removesuffix(": ")) from error


def not_remembered(task: LoadedTask) -> str:
    """As ``check_recordable`` returns it, for a step that is not recorded and so may break the laws."""
    with nothing_changed():
        env = task.env_class(tiny_cfg(task.cfg), "cpu", True)
        lost = Lost(env)
        for _ in range(_STEPS):
            _step(env)
        env.on_training_progress(0.5)
        env.domain_rand.redraw()
        env.load_training_state(env.training_state())
        return lost.named()


def tiny_cfg(cfg: RobotTaskCfg) -> RobotTaskCfg:
    """The same task in a few worlds, on a terrain of two tiles if it has one."""
    tiny = copy.deepcopy(cfg)
    tiny.env.num_envs, tiny.sim.engine, tiny.sim.threads = _WORLDS, "mujoco", 1
    if hasattr(tiny.terrain, "num_rows"):
        small = {"num_rows": 2, "num_cols": 1, "border_size": 1.0, "terrain_proportions": {"flat": 1.0}}
        tiny.update({"terrain": small}, where="the guard")
    return tiny


def _own_methods(env_class: type) -> list[str]:
    """What the user's classes override, each with its line. If our code fails, one of these may be the cause."""
    methods = []
    for kind in own_classes(env_class):
        names = [name for name in vars(kind) if name == "__init__" or not name.startswith(("__", "_abc"))]
        methods += [
            (kind, name, vars(kind)[name])
            for name in names
            if hasattr(kind.__mro__[1], name) or name.startswith("_reward_")
        ]
    return [
        place_of(value) if inspect.isroutine(value) else f"{kind.__name__}.{name} = {value!r:.40}"
        for kind, name, value in methods
    ]


def _of_file(kind: type) -> dict[str, Any]:
    """All names in the file of a class."""
    return vars(sys.modules[kind.__module__]) if kind.__module__ in sys.modules else {}


def _watched(env_class: type[RobotTask], guard: Guard) -> type[Any]:
    """The class with checks: its rewards only read and return finite numbers (N,); its own torques are finite."""

    def look(self: RobotTask, value: Tensor, method: Callable[..., Any]) -> None:
        watched = guard.on
        with guard.set(on=False):
            wrong = ~value.isfinite().reshape(self.num_envs, -1).all(dim=1)
            if watched and bool((wrong & ~self.broken).any()):
                what = "returned a value that is not finite; look for a division by 0 or a root of a negative number"
                raise StepError(what, place_of(method))

    def watch(method: Callable[[RobotTask], Any]) -> Callable[[RobotTask], Any]:
        @functools.wraps(method)
        def term(self: RobotTask) -> Any:
            with guard.set(on_write=functools.partial(_check_written, self)):
                value = check_term(functools.partial(method, self), self.num_envs)
            look(self, value, method)
            return value

        return term

    def watch_law(method: Callable[[RobotTask, Tensor], Any]) -> Callable[[RobotTask, Tensor], Any]:
        @functools.wraps(method)
        def law(self: RobotTask, actions: Tensor) -> Any:
            value = method(self, actions)
            if isinstance(value, Tensor) and value.shape == actions.shape:  # else the motors raise
                look(self, value, method)
            return value

        return law

    body: dict[str, Any] = {
        name: watch(getattr(env_class, name)) for name in dir(env_class) if name.startswith("_reward_")
    }
    if env_class._compute_torques is not RobotTask._compute_torques:
        body["_compute_torques"] = watch_law(env_class._compute_torques)
    body |= {"__module__": env_class.__module__, "__qualname__": env_class.__qualname__}
    return type(env_class.__name__, (env_class,), body)


def _unwatched(method: Callable[..., Any], guard: Guard, on: bool = False) -> Callable[..., Any]:
    """``method`` without the guard; its callbacks keep it: the engine's step calls back a motor law in Python."""

    def call(*args: Any) -> Any:
        back = [_unwatched(arg, guard, guard.on) if callable(arg) else arg for arg in args]
        with guard.set(on=on):
            return method(*back)

    return call


def _check_written(env: RobotTask, tensor: Tensor) -> None:
    """Raise NotRecordable if a reward writes to ``tensor`` and the environment holds it."""
    memory = tensor.untyped_storage().data_ptr()
    held = [
        (path, value)
        for path, value in _held(env)
        if isinstance(value, Tensor) and value.untyped_storage().data_ptr() == memory
    ]
    if held and memory:
        path, _ = min(held, key=lambda entry: _place(entry[1]) != _place(tensor))
        raise NotRecordable(f"writes to {_shown(path)}; a reward only reads: write to it in _update_state or _end_step")


def _check_rows(env: RobotTask) -> None:
    """Raise NotRecordable if a second call of observation_rows gives other tensors: values of rows must be buffers."""
    tables = env.observation_rows(), env.observation_rows()
    for group in tables[0]:
        for row, again in zip(tables[0][group], tables[1][group], strict=True):
            if not isinstance(row, str) and not isinstance(again, str) and _place(row.value) != _place(again.value):
                what = f"row '{row.name}' of '{group}' is computed when the table is made, which is once"
                raise NotRecordable(
                    f"{what}; give it a buffer, which _update_state writes in place", place_of(env.observation_rows)
                )


def _check_steps(env: RobotTask, guard: Guard) -> None:
    def step() -> None:
        _step(env, recordable(guard))

    def first() -> None:
        env.on_training_progress(0.0)
        _step(env)

    # On a GPU the first steps are not recorded. So they may make new tensors, but tensors of __init__ must stay.
    _check_kept(env, {path: value for path, value in _held(env) if isinstance(value, Tensor)}, first, alone=True)
    state = env.training_state()
    states = _draws(env)
    for _ in range(_STEPS):
        drawn = states()
        _check_kept(env, dict(_held(env)), step)
        if states() != drawn:
            raise NotRecordable(_DRAWN, _line_that_changes(step, states, type(env).__name__))
        for group, rows in env.observations.groups.items():
            for row in rows:
                bad = ~(row.value.float().abs() <= BOUND) & ~env.broken[:, None]  # the step replaces these by 0
                if not row.group and bool(bad.any()):
                    raise StepError(
                        f"row '{row.name}' of '{group}' is not finite, or beyond {BOUND:g}",
                        place_of(env.observation_rows),
                    )
    # A training makes these calls between recorded steps.
    for call in (lambda: env.on_training_progress(0.5), env.domain_rand.redraw, lambda: env.load_training_state(state)):
        _check_kept(env, dict(_held(env)), call)


def _step(env: RobotTask, watch: AbstractContextManager[Any] | None = None) -> None:
    """A step with random actions; every second episode ends in it."""
    env.episode_length_buf = torch.arange(_WORLDS, device=env.device) % 2 * env.max_episode_length
    actions = torch.rand(_WORLDS, env.num_actions, device=env.device).mul_(2.0).sub_(1.0)
    with watch or nullcontext():
        env.step(actions)


def _check_kept(env: RobotTask, before: dict[Path, Any], step: Callable[[], None], alone: bool = False) -> None:
    """Raise NotRecordable if ``step`` moves or changes a value held ``before``, or adds one, unless ``alone``."""
    places = {path: _place(value) for path, value in before.items()}
    step()
    after = {path: _place(value) for path, value in _held(env)}
    other = [path for path in (places if alone else places | after) if places.get(path) != after.get(path)]
    if other:
        path, now = other[0], _at(env, other[0])
        name = _shown(path)
        what = f"{name} becomes another tensor; make it once, in _init_buffers(), and write in place: {name}.copy_(...)"
        if isinstance(before.get(path, now), int | float):
            what = f"{name} is a Python number and changes, but a replay repeats what was recorded; make it a tensor"
        for each in reversed(other):
            _put_back(env, each, before)
        raise NotRecordable(what, _line_that_changes(step, lambda: _place(_at(env, path)), type(env).__name__))


def _draws(env: RobotTask) -> Callable[[], list[object]]:
    """A function that returns the states of Python's and numpy's generators: global ones, ``env``'s, the user's."""
    files = [value for kind in own_classes(type(env)) for value in _of_file(kind).values()]
    values = [*files, *(value for _, value in _held(env))]
    python = [value for value in values if isinstance(value, random.Random)]
    numpy = [value.bit_generator for value in values if isinstance(value, np.random.Generator)]
    return lambda: [
        random.getstate(),
        _position(np.random.get_state(legacy=False)),
        *(each.getstate() for each in python),
        *(_position(each.state) for each in numpy),
    ]


def _position(state: Mapping[str, Any]) -> object:
    """The state of a numpy generator, in few of its 624 numbers: it is compared after every line."""
    inner = state["state"]
    return (inner["pos"], *inner["key"][:2]) if "key" in inner else str(state)


@contextmanager
def nothing_changed() -> Iterator[None]:
    """Restore random states and the number of threads at the end. Inside, torch has one thread."""
    threads, python, numpy = torch.get_num_threads(), random.getstate(), np.random.get_state()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            yield
    finally:
        torch.set_num_threads(threads)
        random.setstate(python)
        np.random.set_state(numpy)


# ---- the values of an environment, and the line that changes one ---------------------------------------------------


def _held(owner: Any, path: Path = (), seen: set[int] | None = None) -> Iterator[tuple[Path, Any]]:
    """(path, value) of all tensors, numbers and generators in ``owner`` and its parts; of ``sim`` the tensors alone."""
    seen = set() if seen is None else seen
    for key, value in parts(owner).items():
        if isinstance(value, Tensor) or (
            isinstance(value, int | float | random.Random | np.random.Generator) and path[:1] != ("sim",)
        ):
            yield (*path, key), value
        elif _is_part(value) and id(value) not in seen:
            seen.add(id(value))
            yield from _held(value, (*path, key), seen)


def _is_part(value: Any) -> bool:
    """Whether it is a container, or an object of one of our classes or of the user's."""
    module = type(value).__module__
    file = getattr(sys.modules.get(module), "__file__", None) or "<built in>"
    return isinstance(value, CONTAINERS) or not is_library(module, file)


def _place(value: Any) -> object:
    """What must not change: the memory of a tensor, the value of a number."""
    if isinstance(value, Tensor):
        return value.data_ptr(), value.shape, value.stride(), value.dtype
    return repr(value)  # as text NaN equals NaN


def _at(owner: Any, path: Path) -> Any:
    for key in path:
        owner = None if owner is None else parts(owner).get(key)
    return owner


def _shown(path: Path) -> str:
    return "self" + "".join(f".{key}" if i == 0 or isinstance(key, str) else f"[{key}]" for i, key in enumerate(path))


def _put_back(owner: Any, path: Path, before: dict[Path, Any]) -> None:
    holder, key = _at(owner, path[:-1]), path[-1]
    put: Callable[..., Any]
    remove: Callable[..., Any]
    put, remove = (setattr, delattr) if isinstance(key, str) and not isinstance(holder, Mapping) else (setitem, delitem)
    with suppress(TypeError):  # of a tuple
        put(holder, key, before[path]) if path in before else remove(holder, key)


def _line_that_changes(step: Callable[[], None], look: Callable[[], object], otherwise: str) -> str:
    """Make another step, line by line. Return the line that changes the value of ``look``, if possible a user's."""
    place, last, line, own = look(), otherwise, "", sys._getframe()

    def users(frame: FrameType) -> FrameType:
        each: FrameType | None = frame
        while each and each is not own:
            if not _library(each) and not each.f_globals.get("__name__", "").startswith("legged_mw."):
                return each
            each = each.f_back
        return frame

    def trace(frame: FrameType, event: str, arg: object) -> Any:
        nonlocal last, line
        if not line and look() != place:
            line = last
        at = frame.f_back if event == "return" else frame
        if at and not _library(at):
            at = users(at)
            last = line_of(at.f_code, at.f_lineno)
        return None if _library(frame) else trace

    debugger = sys.gettrace()
    sys.settrace(trace)
    try:
        step()
    finally:
        sys.settrace(debugger)
    return line or otherwise


def _library(frame: FrameType) -> bool:
    return is_library(frame.f_globals.get("__name__", ""), frame.f_code.co_filename)
