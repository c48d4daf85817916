"""Initial gains from a joint's load and effort, limited by the stability of the time step. Our rules.

kp [N m/rad]: full effort at a position error of 1 rad. This is within a factor of two of published gains: ANYmal 80 at
80 N m (legged_gym), G1's hip and knee 100 and 150 at 88 and 139 N m (unitree_rl_gym), Go2 20 and 40 at 23.5 and 45 N m
(unitree_rl_mjlab), Go1 35 at 23.7 N m (MuJoCo Playground). A lower bound is the kp that holds twice the torque at rest
with an error of 0.4 rad, because in a walk half of the feet carry the robot. Without a known effort, kp is this bound,
and at least the kp that swings the limb at 2 Hz.
kd [N m s/rad]: 25 ms of kp. Published: ANYmal 2 for kp 80, Go2 0.5 for 20, G1 2 for 100, Booster T1 5 for 200.
A robot with more than two feet that does not stand on these gains gets up to twice as much (draft.py).
Both are cut for stability: dt sqrt(kp / I) <= 0.5 and dt kd / I <= 0.5, with the joint's smallest inertia I.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from legged_mw.robot.measure import Joint
from legged_mw.sim.joints import family

FULL_EFFORT_AT = 1.0  # [rad]
LOAD, SAG = 2.0, 0.4  # multiple of the torque at rest, and position error [rad] at that torque
SWING = 2.0  # [Hz]
DAMPING_TIME = 0.025  # [s] kd / kp
MOST = 0.5  # upper bound of dt sqrt(kp / I) and of dt kd / I


class Gains(NamedTuple):
    """The gains of one joint."""

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    cut: bool  # whether the time step limits one of them


def suggest(joints: Sequence[Joint], dt: float, firmness: float = 1.0) -> list[Gains]:
    """Gains for each joint: ``firmness`` times the rules. Left and right joints of a pair get equal gains."""
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
    """Round to two significant digits."""
    return float(f"{value:.2g}")
