"""Drives the environment through cases and records what it sees; what the cases are and what is made of a record is not here.

One case a world: what it is told, when, and how it is kicked. All cases run side by side, once. Exam, report and the exam
during training differ in their cases and signals only.
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

from legged_mw.envs.legged_robot import LeggedRobot

Command = tuple[float, float, float]  # vx, vy [m/s], yaw rate [rad/s], body frame
Policy = Callable[[TensorDict], Tensor]
Signal = Callable[[LeggedRobot], Tensor]  # a value a world, (N, ...)


class Kick(NamedTuple):
    """The base's horizontal velocity jumps, after that step's action is computed and before its physics."""

    step: int  # [control steps]
    speed: float  # [m/s]
    angle: float  # in the world frame, from x [rad]


class Case(NamedTuple):
    """What one world is told, and how it is pushed."""

    commands: tuple[tuple[int, Command], ...]  # from that control step on; the first from step 0
    kick: Kick | None = None


def holding(command: Command, kick: Kick | None = None) -> Case:
    """One command throughout."""
    return Case(((0, command),), kick)


class Record(NamedTuple):
    """N worlds over T control steps. Signals are sampled before each step, so the first sample is the start."""

    dt: float  # [s] a control step
    mass: float  # [kg]
    commands: NDArray[Any]  # (T, N, 3), what each world was told [m/s, m/s, rad/s]
    fell_at: NDArray[Any]  # (N,) control step of the first fall, or inf; from there on the world is another episode
    last_position: NDArray[Any]  # (N, 2) of the base after the last step [m]
    signals: dict[str, NDArray[Any]]  # name -> (T, N, ...)

    def part(self, worlds: slice) -> Record:
        """The record of some of the worlds."""
        signals = {name: values[:, worlds] for name, values in self.signals.items()}
        return Record(self.dt, self.mass, self.commands[:, worlds], self.fell_at[worlds], self.last_position[worlds], signals)


def roll_out(
    env: LeggedRobot, policy: Policy, cases: Sequence[Case], steps: int, signals: Mapping[str, Signal], alone: int | None = None
) -> Record:
    """Run each case in a world of its own for ``steps`` control steps.

    The first ``alone`` worlds act as a batch of their own: a matrix product may round differently in a larger batch, and
    what is computed of these worlds must not depend on how many others there are.
    """
    if len(cases) != env.num_envs:
        raise ValueError(f"{len(cases)} cases need as many worlds; this environment has {env.num_envs}")
    env.reset()
    told, kicks = _commands_by_step(cases, env.device), _kicks_by_step(cases, env.device)
    worlds, commands = told.pop(0)
    env.commands[worlds] = commands
    env.compute_observations()
    obs = env.get_observations()
    fell_at = torch.full((env.num_envs,), math.inf, device=env.device)
    kept: dict[str, Tensor] = {}
    for step in range(steps):
        for name, signal in signals.items():
            value = signal(env)
            if name not in kept:
                kept[name] = torch.empty(steps, *value.shape, dtype=value.dtype, device=value.device)
            kept[name][step] = value
        actions = _act(policy, obs, alone)
        if step in kicks:
            worlds, jumps = kicks[step]
            env.sim.qvel[worlds, :2] += jumps
        if step + 1 in told:  # this step's end observes it; to observe anew would be a step of time for what is delayed
            worlds, commands = told[step + 1]
            env.commands[worlds] = commands
        obs, _, dones, _ = env.step(actions)
        fell_at = torch.where(dones & (fell_at == math.inf), torch.full_like(fell_at, step), fell_at)
    return Record(
        dt=env.dt,
        mass=env.total_mass,
        commands=_timeline(cases, steps),
        fell_at=fell_at.cpu().numpy(),
        last_position=env.sim.qpos[:, :2].cpu().numpy().copy(),
        signals={name: values.cpu().numpy() for name, values in kept.items()},
    )


def _act(policy: Policy, obs: TensorDict, alone: int | None) -> Tensor:
    with torch.inference_mode():
        if alone is None or alone == len(obs):
            return policy(obs)
        return torch.cat([policy(obs[:alone]), policy(obs[alone:])])


def _timeline(cases: Sequence[Case], steps: int) -> NDArray[Any]:
    """What each world is told at each step, (T, N, 3)."""
    timeline = np.zeros((steps, len(cases), 3))
    for world, case in enumerate(cases):
        for step, command in case.commands:
            timeline[step:, world] = command
    return timeline


def _commands_by_step(cases: Sequence[Case], device: str) -> dict[int, tuple[Tensor, Tensor]]:
    """Step -> worlds (M,) and their new commands (M, 3)."""
    changes: dict[int, list[tuple[int, Command]]] = {}
    for world, case in enumerate(cases):
        for step, command in case.commands:
            changes.setdefault(step, []).append((world, command))
    return {
        step: (torch.tensor([w for w, _ in rows], device=device), torch.tensor([c for _, c in rows], dtype=torch.float, device=device))
        for step, rows in changes.items()
    }


def _kicks_by_step(cases: Sequence[Case], device: str) -> dict[int, tuple[Tensor, Tensor]]:
    """Step -> worlds (M,) and the jumps of their horizontal velocity (M, 2) [m/s, world]."""
    kicks: dict[int, list[tuple[int, Kick]]] = {}
    for world, case in enumerate(cases):
        if case.kick:
            kicks.setdefault(case.kick.step, []).append((world, case.kick))
    by_step = {}
    for step, rows in kicks.items():
        speed = torch.tensor([[kick.speed] for _, kick in rows], device=device)
        jumps = speed * torch.tensor([[math.cos(kick.angle), math.sin(kick.angle)] for _, kick in rows], device=device)
        by_step[step] = torch.tensor([world for world, _ in rows], device=device), jumps
    return by_step
