"""Drives the environment through cases and records what it sees; what the cases are and what is made of a record is not here.

One case a world: its commands, and when it is pushed. All cases run side by side, once. Exam, report and the exam during
training differ in their cases and signals only.
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

Policy = Callable[[TensorDict], Tensor]  # one with a memory is an rsl-rl network
Signal = Callable[[Any], Tensor]  # a value a world, (N, ...)


class Push(NamedTuple):
    """The base's horizontal velocity jumps, after that step's action is computed and before its physics."""

    step: int  # [control steps]
    speed: float  # [m/s]
    angle: float  # in the world frame, from x [rad]


class Case(NamedTuple):
    """What one world is asked to do, and how it is pushed."""

    # from that control step on, the first of the task's table; the rest: default
    commands: tuple[tuple[int, tuple[float, ...]], ...]
    push: Push | None = None


def holding(command: tuple[float, ...], push: Push | None = None) -> Case:
    """One command throughout."""
    return Case(((0, command),), push)


class Record(NamedTuple):
    """N worlds over T control steps. Signals are sampled before each step, so the first sample is the start."""

    dt: float  # [s] a control step
    mass: float  # [kg]
    commands: NDArray[Any]  # (T, N, C), what each world was asked for
    fell_at: NDArray[Any]  # (N,) control step of the first fall, or inf; from there on the world is another episode
    last_position: NDArray[Any]  # (N, 2) of the base after the last step [m]
    signals: dict[str, NDArray[Any]]  # name -> (T, N, ...)

    def part(self, worlds: slice) -> Record:
        """The record of some of the worlds."""
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
    """Run each case in a world of its own for ``steps`` control steps.

    What is computed of the first ``alone`` worlds does not depend on how many others there are.
    """
    if len(cases) != env.num_envs:
        raise ValueError(f"{len(cases)} cases need as many worlds; this environment has {env.num_envs}")
    env.reset()
    timeline = _timeline(cases, steps, [command.default for command in env.command_table])
    asked, pushes = torch.tensor(timeline, dtype=torch.float, device=env.device), _pushes_by_step(cases, env.device)
    commands = getattr(env, "commands", asked[0])  # a task without commands has no buffer for them
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
        # the observation at the end of this step shows the next command: a second one would be a step of delay
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
    """A policy in all worlds. The first ``alone`` are a batch of their own: a matrix product may round differently in a larger one."""

    def __init__(self, policy: Policy, worlds: int, alone: int | None) -> None:
        forget(policy)
        self._parts = [(policy, slice(alone or worlds))]
        if alone not in (None, worlds):
            self._parts.append((with_own_state(policy), slice(alone, worlds)))

    def act(self, obs: TensorDict) -> Tensor:
        """Its actions (N, A)."""
        with torch.inference_mode():
            return torch.cat([policy(obs[worlds]) for policy, worlds in self._parts])

    def believed(self, obs: TensorDict) -> dict[str, Tensor]:
        """A further signal, "estimate", of a policy that estimates its velocity: vx, vy (N, 2) [m/s]."""
        with torch.inference_mode():
            found = [
                value for policy, worlds in self._parts if (value := believed_velocity(policy, obs[worlds])) is not None
            ]
        return {"estimate": torch.cat(found)} if found else {}

    def forget(self, ended: Tensor) -> None:
        """Nothing is remembered where ``ended`` (N,)."""
        for policy, worlds in self._parts:
            forget(policy, ended[worlds])


def _timeline(cases: Sequence[Case], steps: int, default: Sequence[float]) -> NDArray[Any]:
    """What each world is asked for at each step, (T, N, C)."""
    timeline = np.tile(np.array(default, dtype=float), (steps, len(cases), 1))
    for world, case in enumerate(cases):
        for step, command in case.commands:
            timeline[step:, world, : len(command)] = command
    return timeline


def _pushes_by_step(cases: Sequence[Case], device: str) -> dict[int, tuple[Tensor, Tensor]]:
    """Step -> worlds (M,) and the jumps of their horizontal velocity (M, 2) [m/s, world]."""
    pushed, found = [(world, case.push) for world, case in enumerate(cases) if case.push], {}
    for step in {push.step for _, push in pushed}:
        now = [(world, push) for world, push in pushed if push.step == step]
        speeds = torch.tensor([[push.speed] for _, push in now], device=device)
        directions = torch.tensor([[math.cos(push.angle), math.sin(push.angle)] for _, push in now], device=device)
        found[step] = torch.tensor([world for world, _ in now], device=device), speeds * directions
    return found
