"""What the report looks at besides the exam: a grid of commands, steps of the command, kicks while standing. Cases only.

The exam's worlds come first, so that its result is the plain exam's. Commands are within the ranges that were trained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.eval import exam
from legged_mw.eval.rollout import Case, Command, holding
from legged_mw.eval.rules import KICK_AT, KICK_SPEEDS, commands

GRID = (13, 9, 9)  # values of vx, vy, yaw rate
STEP_SHARE = 2 / 3  # of the range's end, that a step goes to
STEP_AT, STEP_HOLDS = 1.5, (0.0, 2.5, 5.0, 8.0)  # [s] the first step; since then: there, reverse, stop, end
STEP_REPEATS, STEP_SHIFT = 8, 0.06  # worlds a step, each [s] later than the one before: they meet it in another phase of the gait
NAMES = ("vx", "vy", "yaw")


class Plan(NamedTuple):
    """Cases, where each part of them is, and the values that the parts go over."""

    cases: list[Case]
    parts: dict[str, slice]  # "commands" and "kicks" are the exam's
    axes: dict[str, list[float]]  # vx, vy [m/s], yaw [rad/s] of the grids
    steps: list[list[Command]]  # of each axis: there, reverse, stop


def make_plan(ranges: LeggedRobotCfg.commands.ranges, dt: float) -> Plan:
    """All worlds of a report on a policy that was trained on commands in ``ranges``."""
    limits = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)
    axes = [np.unique(np.linspace(low, high, n).round(3)).tolist() for (low, high), n in zip(limits, GRID, strict=True)]
    rest = [min(max(0.0, low), high) for low, high in limits]  # zero, or the nearest to it
    steps = [_steps(axis, limits[axis]) for axis in range(3)]
    exams = exam.cases(dt)
    groups = {
        "commands": exams[: len(commands())],
        "kicks": exams[len(commands()) :],
        "vx_yaw": [holding((vx, rest[1], yaw)) for yaw in axes[2] for vx in axes[0]],
        "vx_vy": [holding((vx, vy, rest[2])) for vy in axes[1] for vx in axes[0]],
        **{f"step_{name}": _stepping(steps[i], dt) for i, name in enumerate(NAMES)},
        "standing_kicks": exam.kicks((0.0, 0.0, 0.0), KICK_SPEEDS, round(KICK_AT / dt)),
    }
    parts, start = {}, 0
    for name, group in groups.items():
        parts[name] = slice(start, start := start + len(group))
    return Plan([case for group in groups.values() for case in group], parts, dict(zip(NAMES, axes, strict=True)), steps)


def _steps(axis: int, limits: list[float]) -> list[Command]:
    """There, reverse, stop: (vx, vy, yaw rate) of which one component moves."""
    low, high = (round(STEP_SHARE * limit, 2) for limit in limits)
    there, reverse, stop = [0.0] * 3, [0.0] * 3, (0.0, 0.0, 0.0)
    there[axis], reverse[axis] = high, low
    return [(there[0], there[1], there[2]), (reverse[0], reverse[1], reverse[2]), stop]


def _stepping(steps: list[Command], dt: float) -> list[Case]:
    """Stand, then the steps; in each world a little later."""
    begins = [round((STEP_AT + i * STEP_SHIFT) / dt) for i in range(STEP_REPEATS)]
    at = [round(after / dt) for after in STEP_HOLDS]
    return [Case(((0, (0.0, 0.0, 0.0)), *((begin + at[k], command) for k, command in enumerate(steps)))) for begin in begins]
