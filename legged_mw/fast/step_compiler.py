"""Fuse a step: trace it, compile it, and compare it with the original before its use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from legged_mw.check.held import everything
from legged_mw.envs.robot_task import RobotTask
from legged_mw.fast.trace import Call, Trace, alike

_WORTH = 5_000  # control steps; with fewer, compiling on a CPU (seconds, once per machine) does not save time
# tolerance and share of outliers of a step's writes: physics amplifies rounding, and a comparison may flip
_CLOSE, _STRAYS = 1e-3, 0.01


def fuse(env: RobotTask, steps: int) -> None:
    """Fuse the step of ``env``: on a CPU now, if that saves time over ``steps``; on a GPU before the recording."""
    if not env.cfg.sim.fuse or env.eager:
        return
    if str(env.device) != "cpu":
        env._graph.better = lambda: fused_step(env)
    elif steps >= _WORTH:
        with torch.inference_mode():
            env._graph.improve(fused_step(env))


def fused_step(env: RobotTask) -> Callable[[], None]:
    """The fused step of ``env``, or the original step. It changes no world and draws no random number."""
    state = env.sim.memory()
    fields = [value for name, value in state.items() if name.startswith("model.")] if env.sim.engine == "mujoco" else []
    return fused(env._step, env.num_envs, everything(env), fields)


def fused(
    fn: Callable[[], None], worlds: int, memory: Mapping[str, Tensor], watched: Iterable[Tensor] = ()
) -> Callable[[], None]:
    """Fuse the step ``fn`` of ``worlds``. If that fails, print the reason and return ``fn``. No world changes.

    ``memory``: all tensors that ``fn`` writes, by name. Only torch may write tensors in ``watched``.
    """
    put_back = None
    try:
        put_back = remember(memory)
        program, reason = _fused(fn, worlds, memory, watched, put_back), ""
    except Exception as error:  # any error of a compiler, or no memory for a copy: keep the original step
        program, reason = None, " ".join(f"{error}".split())[:200] or type(error).__name__
    if put_back:
        put_back()
    if program:
        return program
    print(f"the step is not fused: {reason}", flush=True)
    return fn


def _fused(
    fn: Callable[[], None],
    worlds: int,
    memory: Mapping[str, Tensor],
    watched: Iterable[Tensor],
    put_back: Callable[[], None],
) -> Callable[[], None]:
    from legged_mw.fast.fused import Fused  # it needs warp

    with (trace := _Recorder(memory, watched)):
        fn()
    expected = {name: value.clone() for name, value in memory.items()}
    put_back()
    program = Fused(trace, worlds, str(next(iter(memory.values())).device))
    program.compile()
    if wrong := program.verify():
        print(f"{wrong} of {len(program.parts)} parts of the step are not fused: they gave other values", flush=True)
    put_back()
    for block in trace.made:  # the step writes each of them before it reads it
        trace.blocks[block].fill_(float("nan") if trace.blocks[block].is_floating_point() else 1)
    other, calls = set[str](), iter(trace.calls)

    def compare(wanted: Mapping[str, Tensor]) -> None:
        other.update(name for name, value in wanted.items() if not alike(value, memory[name], _CLOSE, _STRAYS))

    for part in program.parts:
        if not isinstance(part, Call):
            part()
            continue
        before, after = next(calls)
        compare(before)
        part.run()
        for name, value in after.items():
            memory[name].copy_(value)
    compare(expected)
    if other:
        names = sorted(other, key=lambda name: (name.startswith("sim."), name))  # the task's tensors first
        shown = ", ".join(names[:5]) + ", ..." * (len(names) > 5)
        are = "is another" if len(names) == 1 else "are others"
        raise RuntimeError(
            f"{shown} {are} than by the step as it is written; does it do something that torch does not see?"
        )
    return program


class _Recorder(Trace):
    """A trace that also stores the parts of ``memory`` that each call of the simulator changes, before and after.

    A simulator may not be reproducible: on a GPU the order of contacts is random, and an overflow drops random ones.
    So a fused step is compared between these calls, and the recorded result replaces each call.
    """

    def __init__(self, memory: Mapping[str, Tensor], watched: Iterable[Tensor]) -> None:
        super().__init__(watched)
        self._memory, self.calls = memory, list[tuple[dict[str, Tensor], dict[str, Tensor]]]()

    def call(self, run: Callable[[], object], given: Iterable[Tensor] = ()) -> Any:
        self._paused = True
        before = {name: value.clone() for name, value in self._memory.items()}
        result = super().call(run, given)
        self._paused = True
        after = {name: value.clone() for name, value in self._memory.items() if not torch.equal(value, before[name])}
        self._paused = False
        self.calls.append(({name: before[name] for name in after}, after))
        return result


def remember(memory: Mapping[str, Tensor]) -> Callable[[], None]:
    """Save ``memory`` and torch's random states. Returns a function that restores them."""
    kept, draws = {name: value.clone() for name, value in memory.items()}, torch.get_rng_state()
    device = next(iter(memory.values())).device
    draws_there = torch.cuda.get_rng_state(device) if device.type == "cuda" else None

    def put_back() -> None:
        for name, value in kept.items():
            if not torch.equal(memory[name], value):  # unchanged memory must not be marked as written
                memory[name].copy_(value)
        torch.set_rng_state(draws)
        if draws_there is not None:
            torch.cuda.set_rng_state(draws_there, device)

    return put_back
