"""The walking exam in the training environment; its commands, kicks and marks are in ``rules``.

Nominal model, no noise, no kicks but the exam's own, mean actions, start at rest in the default pose. It is a set of
config overrides and a roll-out, not a second environment: all tests run side by side as worlds of one environment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import rules
from legged_mw.eval.rollout import Case, Kick, Policy, Record, Signal, holding, roll_out
from legged_mw.eval.rules import KICK_AT, KICK_COMMAND, KICK_DIRECTIONS, KICK_SPEEDS, SECONDS, SETTLING, commands
from legged_mw.utils.task import LoadedTask

OVERRIDES: dict[str, Any] = {
    "env.episode_length_s": 1000.0,  # no time outs
    "noise.level": 0.0,
    "perturbation.enable": False,
    "perturbation.push": False,
    "domain_rand.enable": False,
    "terrain.mesh_type": "plane",
    "commands.curriculum": False,
    "commands.resampling_time": 0.0,
    "init_state.dof_pos_range": [1.0, 1.0],
    "init_state.pos_xy_range": 0.0,
    "init_state.yaw_range": 0.0,
    "init_state.lin_vel_range": 0.0,
    "init_state.ang_vel_range": 0.0,
    "termination.max_tilt": 90.0,  # [deg], a fall
    "termination.min_base_height": 0.0,  # and nothing else
}
SETS = {*OVERRIDES, "env.num_envs"} - {"domain_rand.enable"}  # what the exam decides; another robot than the nominal one may be asked for
WORLDS = len(commands()) + len(KICK_SPEEDS) * KICK_DIRECTIONS

SIGNALS: dict[str, Signal] = {
    "velocity": lambda env: torch.cat([env.base_lin_vel[:, :2], env.base_ang_vel[:, 2:]], dim=1),  # at the IMU, body frame
    "position": lambda env: env.sim.qpos[:, :2],  # [m, world]
    "power": lambda env: (env.torques * env.dof_vel).abs().sum(dim=1),  # [W]
    "joint_speed": lambda env: env.dof_vel.abs().mean(dim=1),  # [rad/s]
}


def prepare(task: LoadedTask, worlds: int = WORLDS) -> None:
    """Turn ``task`` into the exam: one world a command and one a kick; more where more is looked at."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    task.cfg.env.num_envs = worlds


def cases(dt: float) -> list[Case]:
    """The exam's worlds, in the order that ``rules.grade`` expects."""
    return [*map(holding, commands()), *kicks((KICK_COMMAND, 0.0, 0.0), KICK_SPEEDS, round(KICK_AT / dt))]


def kicks(command: tuple[float, float, float], speeds: Sequence[float], step: int) -> list[Case]:
    """At ``step`` + k, direction k of every speed."""
    angles = [2 * math.pi * k / KICK_DIRECTIONS for k in range(KICK_DIRECTIONS)]
    return [holding(command, Kick(step + k, speed, angle)) for speed in speeds for k, angle in enumerate(angles)]


def run_exam(env: LeggedRobot, policy: Policy) -> dict[str, Any]:
    """Grade ``policy`` in an environment made from a prepared task."""
    return grade(roll_out(env, policy, cases(env.dt), round(SECONDS / env.dt), SIGNALS))


def grade(record: Record) -> dict[str, Any]:
    """What ``rules`` makes of a record whose worlds are the exam's."""
    asked, settled = slice(len(commands())), round(SETTLING / record.dt)
    velocity, position, power, joint_speed = (record.signals[name] for name in SIGNALS)
    error = abs(velocity[settled:, asked] - record.commands[settled:, asked]).mean(axis=0)  # (22, 3)
    away = record.last_position[asked] - position[settled, asked]
    return rules.grade(
        error=error,
        fell_at=record.fell_at,
        distance=(away**2).sum(axis=1) ** 0.5,
        energy=power[settled:, asked].sum(axis=0, dtype=float) * record.dt,
        standing_joint_speed=float(joint_speed[-round(1.0 / record.dt) :, 0].mean()),
        seconds=(len(velocity) - settled) * record.dt,
        mass=record.mass,
        dt=record.dt,
    )
