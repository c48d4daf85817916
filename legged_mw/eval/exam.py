"""The walking exam in the training environment; its commands, kicks and marks are in ``rules``.

Nominal model, no noise, no kicks but the exam's own, mean actions, start at rest in the default pose. It is a set of
config overrides and a roll-out, not a second environment: all tests run side by side as worlds of one environment.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import torch
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import rules
from legged_mw.eval.rules import KICK_AT, KICK_COMMAND, KICK_DIRECTIONS, KICK_SPEEDS, SECONDS, SETTLING, commands
from legged_mw.utils.task import LoadedTask

OVERRIDES: dict[str, Any] = {
    "env.episode_length_s": 1000.0,  # no time outs
    "noise.level": 0.0,
    "perturbation.enable": False,
    "perturbation.push": False,
    "domain_rand.enable": False,
    "commands.resampling_time": 0.0,
    "init_state.dof_pos_range": [1.0, 1.0],
    "init_state.pos_xy_range": 0.0,
    "init_state.yaw_range": 0.0,
    "init_state.lin_vel_range": 0.0,
    "init_state.ang_vel_range": 0.0,
    "termination.max_tilt": 90.0,  # [deg], a fall
}
SETS = {*OVERRIDES, "env.num_envs"} - {"domain_rand.enable"}  # what the exam decides; another robot than the nominal one may be asked for


def prepare(task: LoadedTask) -> None:
    """Turn ``task`` into the exam: one world a command and one a kick."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    task.cfg.env.num_envs = len(commands()) + len(KICK_SPEEDS) * KICK_DIRECTIONS


def run_exam(env: LeggedRobot, policy: Callable[[TensorDict], Tensor]) -> dict[str, Any]:
    """Grade ``policy`` in an environment made from a prepared task."""
    asked = torch.tensor(commands(), device=env.device)
    kicked = torch.arange(len(asked), env.num_envs, device=env.device)
    env.reset()
    env.commands[: len(asked)] = asked
    env.commands[kicked] = torch.tensor([KICK_COMMAND, 0.0, 0.0], device=env.device)
    env.compute_observations()
    obs = env.get_observations()
    wanted = env.commands.clone()
    fell_at = torch.full((env.num_envs,), math.inf, device=env.device)
    velocity, position, power, joint_speed = [], [], [], []
    steps = round(SECONDS / env.dt)
    for step in range(steps):
        velocity.append(torch.cat([env.base_lin_vel[:, :2], env.base_ang_vel[:, 2:]], dim=1))
        position.append(env.sim.qpos[:, :2].clone())
        power.append((env.torques * env.dof_vel).abs().sum(dim=1))
        joint_speed.append(env.dof_vel.abs().mean(dim=1))
        with torch.inference_mode():
            actions = policy(obs)
        _kick(env, kicked, step)
        obs, _, dones, _ = env.step(actions)
        fell_at = torch.where(dones & (fell_at == math.inf), torch.full_like(fell_at, step), fell_at)
    counted = slice(round(SETTLING / env.dt), None)
    error = (torch.stack(velocity)[counted] - wanted).abs().mean(dim=0)[: len(asked)]  # (22, 3)
    distance = (env.sim.qpos[:, :2] - torch.stack(position)[counted][0]).norm(dim=1)
    energy = torch.stack(power)[counted].sum(dim=0) * env.dt
    return rules.grade(
        error=error.cpu().numpy(),
        fell_at=fell_at.cpu().numpy(),
        distance=distance[: len(asked)].cpu().numpy(),
        energy=energy[: len(asked)].cpu().numpy(),
        standing_joint_speed=float(torch.stack(joint_speed[-50:])[:, 0].mean()),
        mass=env.total_mass,
        dt=env.dt,
    )


def _kick(env: LeggedRobot, worlds: Tensor, step: int) -> None:
    """At its step, direction k of every kick speed: the base's horizontal velocity jumps, world frame."""
    k = step - round(KICK_AT / env.dt)
    if 0 <= k < KICK_DIRECTIONS:
        angle = 2 * math.pi * k / KICK_DIRECTIONS
        speed = torch.tensor(KICK_SPEEDS, device=env.device)
        jump = speed[:, None] * torch.tensor([math.cos(angle), math.sin(angle)], device=env.device)
        env.sim.qvel[worlds[k::KICK_DIRECTIONS], :2] += jump
