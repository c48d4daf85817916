"""The walking exam in the training environment. ``rules`` has its commands, measures and pass marks.

The exam uses the nominal model without noise, the policy's mean actions, and no pushes except those of the exam.
The robot starts at rest in the default pose. The exam is a set of config overrides and one roll-out: each test is
one world of the same environment.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval.rollout import Case, Policy, Push, Record, Signal, holding, roll_out
from legged_mw.eval.rules import PUSH_AT, PUSH_DIRECTIONS, SECONDS, ExamRules, Velocity
from legged_mw.utils.task import LoadedTask

OVERRIDES: dict[str, Any] = {
    "env.episode_length_s": 1000.0,  # no time outs
    "noise.level": 0.0,
    "perturbation.kick": False,
    "perturbation.push": False,
    "domain_rand.enable": False,
    "terrain.mesh_type": "plane",
    "commands.curriculum": False,
    "commands.resampling_time": 0.0,
    "init_state.dof_pos_range": [1.0, 1.0],
    "init_state.dof_pos_offset": [0.0, 0.0],
    "init_state.dof_vel_range": 0.0,
    "gait.random_start": False,
    "init_state.pos_xy_range": 0.0,
    "init_state.yaw_range": 0.0,
    "init_state.lin_vel_range": 0.0,
    "init_state.ang_vel_range": 0.0,
    "termination.max_tilt": 90.0,  # [deg]; only a larger tilt is a fall
    "termination.min_base_height": 0.0,
}
# Config fields that the user may not override. Domain randomization may be: it exams other than the nominal robot.
SETS = {*OVERRIDES, "env.num_envs"} - {"domain_rand.enable"}

SIGNALS: dict[str, Signal] = {
    # at the IMU, body frame
    "velocity": lambda env: torch.cat([env.base_lin_vel[:, :2], env.base_ang_vel[:, 2:]], dim=1),
    "position": lambda env: env.root_pos[:, :2],  # [m, world]
    "power": lambda env: (env.torques * env.dof_vel).abs().sum(dim=1),  # [W]
    "joint_speed": lambda env: env.dof_vel.abs().mean(dim=1),  # [rad/s]
}


def prepare(task: LoadedTask, worlds: int | None = None) -> None:
    """Turn ``task`` into the exam with ``worlds`` worlds; by default one per command and one per push."""
    for path, value in OVERRIDES.items():
        task.set(path, value, where="exam")
    task.cfg.env.num_envs = worlds or ExamRules.from_config(task.cfg).worlds()


def cases(rules: ExamRules, dt: float, push_at: float | None = None) -> list[Case]:
    """The cases of the exam in the order of ``ExamRules.grade``. The first pushes come at ``push_at`` [s]."""
    at = PUSH_AT if push_at is None else push_at
    return [*map(holding, rules.held()), *pushes(rules, (rules.push_vx, 0.0, 0.0), round(at / dt))]


def pushes(rules: ExamRules, command: Velocity, step: int) -> list[Case]:
    """One push per case, at every speed and in every direction. Direction k comes at control step ``step`` + k."""
    angles = [2 * math.pi * k / PUSH_DIRECTIONS for k in range(PUSH_DIRECTIONS)]
    return [
        holding(command, Push(step + k, speed, angle)) for speed in rules.push_speeds for k, angle in enumerate(angles)
    ]


def run_exam(env: LeggedRobot, policy: Policy) -> dict[str, Any]:
    """Grade ``policy`` in the environment of a prepared task."""
    rules = ExamRules.from_config(env.cfg)
    return grade(rules, roll_out(env, policy, cases(rules, env.dt), round(SECONDS / env.dt), SIGNALS))


def grade(rules: ExamRules, record: Record) -> dict[str, Any]:
    """Grade a record of the exam's worlds by ``rules``."""
    return rules.grade(
        record.signals, last_position=record.last_position, fell_at=record.fell_at, mass=record.mass, dt=record.dt
    )
