"""Roll out a policy in an environment, one case per world, and record signals.

A case is a sequence of commands and an optional push. All cases run in parallel, once. The exam, the report and the
exam during training differ only in their cases and signals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.students.estimator import believed_velocity
from legged_mw.rl.students.recurrent import forget, with_own_state
from legged_mw.sim.simulation import say_overflow

Policy = Callable[[TensorDict], Tensor]  # a recurrent policy is an rsl-rl network
Signal = Callable[[Any], Tensor]  # environment -> one value per world, (N, ...)


class Push(NamedTuple):
    """A jump of the base's horizontal velocity, between the action and the physics of control step ``step``."""

    step: int  # [control steps]
    speed: float  # [m/s]
    angle: float  # [rad] world frame, from the x axis


class Case(NamedTuple):
    """The commands and the push of one world."""

    # (first control step, values of the first commands of the task's table); further commands keep their defaults
    commands: tuple[tuple[int, tuple[float, ...]], ...]
    push: Push | None = None


def holding(command: tuple[float, ...], push: Push | None = None) -> Case:
    """A case with one constant command."""
    return Case(((0, command),), push)


class Record(NamedTuple):
    """N worlds over T control steps. Signals are sampled before each step, so the first sample is the start state."""

    dt: float  # [s] control step
    mass: float  # [kg]
    commands: NDArray[Any]  # (T, N, C)
    fell_at: NDArray[Any]  # (N,) control step of the first fall, or inf; later samples are of another episode
    last_position: NDArray[Any]  # (N, 2) [m] of the base after the last step
    signals: dict[str, NDArray[Any]]  # name -> (T, N, ...)

    def part(self, worlds: slice) -> Record:
        """The record of a range of worlds."""
        signals = {name: values[:, worlds] for name, values in self.signals.items()}
        return Record(
            self.dt, self.mass, self.commands[:, worlds], self.fell_at[worlds], self.last_position[worlds], signals
        )


def roll_out(
    env: RobotTask,
    policy: Policy,
    cases: Sequence[Case],
    steps: int,
    signals: Mapping[str, Signal],
    alone: int | None = None,
) -> Record:
    """Run each case in its own world for ``steps`` control steps.

    The actions of the first ``alone`` worlds do not depend on the number of further worlds.
    """
    if len(cases) != env.num_envs:
        raise ValueError(f"{len(cases)} cases need as many worlds; this environment has {env.num_envs}")
    env.reset()
    timeline = _timeline(cases, steps, [command.default for command in env.command_table])
    asked, pushes = torch.tensor(timeline, dtype=torch.float, device=env.device), _pushes_by_step(cases, env.device)
    commands = getattr(env, "commands", asked[0])  # a task without commands has no buffer; write to a spare one
    commands.copy_(asked[0])
    obs, actor = env.first_observations(), _Actor(policy, env.num_envs, alone)
    fell_at, kept = torch.full((env.num_envs,), math.inf, device=env.device), dict[str, Tensor]()
    for step in range(steps):
        sampled = {name: signal(env) for name, signal in signals.items()} | actor.believed(obs)
        for name, value in sampled.items():
            if name not in kept:
                kept[name] = torch.empty(steps, *value.shape, dtype=value.dtype, device=value.device)
            kept[name][step] = value
        actions = actor.act(obs)
        if step in pushes:
            worlds, jumps = pushes[step]
            env.root_lin_vel[worlds, :2] += jumps
        # set the next command before the step, because the observation at its end must already show it
        if step + 1 < steps:
            commands.copy_(asked[step + 1])
        obs, _, dones, _ = env.step(actions)
        actor.forget(dones)
        fell_at = torch.where(dones & (fell_at == math.inf), torch.full_like(fell_at, step), fell_at)
    say_overflow(env.sim, "this exam")
    return Record(
        dt=env.dt,
        mass=env.total_mass,
        commands=timeline,
        fell_at=fell_at.cpu().numpy(),
        last_position=env.root_pos[:, :2].cpu().numpy().copy(),
        signals={name: values.cpu().numpy() for name, values in kept.items()},
    )


class _Actor:
    """A policy for all worlds. The first ``alone`` worlds are a separate batch: rounding depends on the batch size."""

    def __init__(self, policy: Policy, worlds: int, alone: int | None) -> None:
        forget(policy)
        self._parts = [(policy, slice(alone or worlds))]
        if alone not in (None, worlds):
            self._parts.append((with_own_state(policy), slice(alone, worlds)))

    def act(self, obs: TensorDict) -> Tensor:
        """The actions (N, A)."""
        with torch.inference_mode():
            return torch.cat([policy(obs[worlds]) for policy, worlds in self._parts])

    def believed(self, obs: TensorDict) -> dict[str, Tensor]:
        """The signal "estimate" of a policy with a velocity estimator: vx, vy (N, 2) [m/s]. Else empty."""
        with torch.inference_mode():
            found = [
                value for policy, worlds in self._parts if (value := believed_velocity(policy, obs[worlds])) is not None
            ]
        return {"estimate": torch.cat(found)} if found else {}

    def forget(self, ended: Tensor) -> None:
        """Reset the memory of a recurrent policy in the worlds of the mask ``ended`` (N,)."""
        for policy, worlds in self._parts:
            forget(policy, ended[worlds])


def _timeline(cases: Sequence[Case], steps: int, default: Sequence[float]) -> NDArray[Any]:
    """The command of each world at each step, (T, N, C)."""
    timeline = np.tile(np.array(default, dtype=float), (steps, len(cases), 1))
    for world, case in enumerate(cases):
        for step, command in case.commands:
            timeline[step:, world, : len(command)] = command
    return timeline


def _pushes_by_step(cases: Sequence[Case], device: str) -> dict[int, tuple[Tensor, Tensor]]:
    """Control step -> pushed worlds (M,), and the jumps of their horizontal velocity (M, 2) [m/s, world frame]."""
    pushed, found = [(world, case.push) for world, case in enumerate(cases) if case.push], {}
    for step in {push.step for _, push in pushed}:
        now = [(world, push) for world, push in pushed if push.step == step]
        speeds = torch.tensor([[push.speed] for _, push in now], device=device)
        directions = torch.tensor([[math.cos(push.angle), math.sin(push.angle)] for _, push in now], device=device)
        found[step] = torch.tensor([world for world, _ in now], device=device), speeds * directions
    return found
