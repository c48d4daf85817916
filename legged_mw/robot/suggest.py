"""Gains to begin with, from what a joint bears and what the step bears. Rules of ours, held against what vendors publish.

kp: full effort at 1 rad off the target. That is within a factor of two of what is published: ANYmal 80 at 80 N m (legged_gym), G1's hip
and knee 100 and 150 at 88 and 139 N m (unitree_rl_gym), Go2 20 and 40 at 23.5 and 45 N m (unitree_rl_mjlab), Go1 35 at 23.7 N m (MuJoCo
Playground). It is at least what holds twice the load at rest, as half of the feet do in a walk, within 0.4 rad. Where nobody states an
effort, it is that, and at least what swings the limb at 2 Hz.
kd: 25 ms of kp: ANYmal 2 of 80, Go2 0.5 of 20, G1 2 of 100, Booster T1 5 of 200.
A robot on more than two feet that would not stand on these gets up to twice as much (draft.py).
Both are cut where the step would not bear them: dt sqrt(kp / I) at most 0.5 and dt kd / I at most 0.5, with the joint's smallest inertia.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from legged_mw.robot.measure import Joint
from legged_mw.sim.joints import family

FULL_EFFORT_AT = 1.0  # [rad]
LOAD, SAG = 2.0, 0.4  # times the torque at rest, held within so much [rad]
SWING = 2.0  # [Hz]
DAMPING_TIME = 0.025  # [s] kd / kp
MOST = 0.5  # of dt sqrt(kp / I) and of dt kd / I


class Gains(NamedTuple):
    """Of one joint."""

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    cut: bool  # whether the step, and not the robot, limits one of them


def suggest(joints: Sequence[Joint], dt: float, firmness: float = 1.0) -> list[Gains]:
    """Gains for each joint, ``firmness`` times the rule's; joints that differ in their side alone get the same ones."""
    wanted = [firmness * _wanted(joint) for joint in joints]
    most = [joint.inertia / dt for joint in joints]  # [kg m^2/s]
    gains = []
    for joint in joints:
        alike = [i for i, other in enumerate(joints) if family(other.name) == family(joint.name)]
        kp, most_kp = max(wanted[i] for i in alike), min(MOST**2 * most[i] / dt for i in alike)
        cut_kp = min(kp, most_kp)
        kd, most_kd = DAMPING_TIME * _round(cut_kp), min(MOST * most[i] for i in alike)
        gains.append(Gains(_round(cut_kp), _round(min(kd, most_kd)), kp > most_kp or kd > most_kd))
    return gains


def _wanted(joint: Joint) -> float:
    load = LOAD * abs(joint.torque) / SAG
    if math.isfinite(joint.effort):
        return max(joint.effort / FULL_EFFORT_AT, load)
    return max(joint.held * (2.0 * math.pi * SWING) ** 2, load)


def _round(value: float) -> float:
    """Two digits."""
    return float(f"{value:.2g}")
