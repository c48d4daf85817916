"""What the report looks at besides the exam: a grid of commands, steps of the command, pushes while standing. Cases only.

The exam's worlds come first, so that its result is the plain exam's. Commands are within the ranges that were trained.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.eval import exam
from legged_mw.eval.rollout import Case, holding
from legged_mw.eval.rules import PUSH_AT, ExamRules, Velocity

GRID = (13, 9, 9)  # values of vx, vy, yaw rate
STEP_SHARE = 2 / 3  # of the range's end, that a step goes to
STEPS_AT = (2.5, 5.0, 7.5)  # [s]: reverse, stop, start again
# [s] when the first of 8 worlds begins to walk, and each later by: the
STEP_BEGINS, STEP_REPEATS, STEP_SHIFT = 0.2, 8, 0.06
# steps meet them in other phases of their gait
NAMES = ("vx", "vy", "yaw")


class Plan(NamedTuple):
    """Cases, where each part of them is, and the values that the parts go over."""

    cases: list[Case]
    parts: dict[str, slice]  # "commands", "transport" and "pushes" are the exam's
    axes: dict[str, list[float]]  # vx, vy [m/s], yaw [rad/s] of the grids


def make_plan(cfg: LeggedRobotCfg, dt: float) -> Plan:
    """All worlds of a report on a policy that was trained with ``cfg``."""
    ranges = cfg.commands.ranges
    limits = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)
    axes = [np.unique(np.linspace(low, high, n).round(3)).tolist() for (low, high), n in zip(limits, GRID, strict=True)]
    rest = [min(max(0.0, low), high) for low, high in limits]  # zero, or the nearest to it
    rules = ExamRules.from_config(cfg)
    exams, commands, held = exam.cases(rules, dt), len(rules.commands()), len(rules.held())
    groups = {
        "commands": exams[:commands],
        "transport": exams[commands:held],  # empty if its command is one of the 22
        "pushes": exams[held:],
        "vx_yaw": [holding((vx, rest[1], yaw)) for yaw in axes[2] for vx in axes[0]],
        "vx_vy": [holding((vx, vy, rest[2])) for vy in axes[1] for vx in axes[0]],
        **{f"step_{name}": _stepping(i, limits[i], dt) for i, name in enumerate(NAMES)},
        "standing_pushes": exam.pushes(rules, (0.0, 0.0, 0.0), round(PUSH_AT / dt)),
    }
    parts, start = {}, 0
    for name, group in groups.items():
        parts[name] = slice(start, start := start + len(group))
    return Plan([case for group in groups.values() for case in group], parts, dict(zip(NAMES, axes, strict=True)))


def _stepping(axis: int, limits: list[float], dt: float) -> list[Case]:
    """Walk along one axis, then backwards, stand, and walk again; each world has begun a little later."""
    stand: Velocity = (0.0, 0.0, 0.0)
    low, high = ((*stand[:axis], round(STEP_SHARE * limit, 2), *stand[axis + 1 :]) for limit in limits)
    begins = [round((STEP_BEGINS + i * STEP_SHIFT) / dt) for i in range(STEP_REPEATS)]
    reverse, stop, again = (round(at / dt) for at in STEPS_AT)
    return [Case(((0, stand), (begin, high), (reverse, low), (stop, stand), (again, high))) for begin in begins]  # type: ignore[arg-type]
