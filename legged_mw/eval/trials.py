"""The report's cases: those of the exam, a grid of commands, steps of the command, pushes while standing.

The exam's worlds come first, so their result equals that of the exam alone. Commands stay in the trained ranges.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.eval import exam
from legged_mw.eval.rollout import Case, holding
from legged_mw.eval.rules import PUSH_AT, ExamRules, Velocity

GRID = (13, 9, 9)  # number of values of vx, vy, yaw rate
STEP_SHARE = 2 / 3  # target of a step, as a share of the end of the range
STEPS_AT = (2.5, 5.0, 7.5)  # [s]: reverse, stop, start again
# [s] The first of 8 worlds starts to walk at STEP_BEGINS, each further one STEP_SHIFT later.
# So a step of the command meets each world in another phase of its gait.
STEP_BEGINS, STEP_REPEATS, STEP_SHIFT = 0.2, 8, 0.06
NAMES = ("vx", "vy", "yaw")


class Plan(NamedTuple):
    """All cases, the slice of each part, and the grid values."""

    cases: list[Case]
    parts: dict[str, slice]  # "commands", "transport" and "pushes" belong to the exam
    axes: dict[str, list[float]]  # grid values of vx, vy [m/s], yaw [rad/s]


def make_plan(cfg: LeggedRobotCfg, dt: float) -> Plan:
    """All cases of a report on a policy that was trained with ``cfg``."""
    ranges = cfg.commands.ranges
    limits = (ranges.lin_vel_x, ranges.lin_vel_y, ranges.ang_vel_yaw)
    axes = [np.unique(np.linspace(low, high, n).round(3)).tolist() for (low, high), n in zip(limits, GRID, strict=True)]
    rest = [min(max(0.0, low), high) for low, high in limits]  # zero, or the nearest value in the range
    rules = ExamRules.from_config(cfg)
    exams, commands, held = exam.cases(rules, dt), len(rules.commands()), len(rules.held())
    groups = {
        "commands": exams[:commands],
        "transport": exams[commands:held],  # empty if the exam has this command among the 22
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
    """Step the command along one axis: walk, reverse, stand, walk again. Each world starts a little later."""
    stand: Velocity = (0.0, 0.0, 0.0)
    low, high = ((*stand[:axis], round(STEP_SHARE * limit, 2), *stand[axis + 1 :]) for limit in limits)
    begins = [round((STEP_BEGINS + i * STEP_SHIFT) / dt) for i in range(STEP_REPEATS)]
    reverse, stop, again = (round(at / dt) for at in STEPS_AT)
    return [Case(((0, stand), (begin, high), (reverse, low), (stop, stand), (again, high))) for begin in begins]  # type: ignore[arg-type]
