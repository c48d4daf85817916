"""A default pose for a robot file without one: bent knees, each foot under its hip, level soles.

A straight leg cannot push, and its servos have no preferred direction to bend. The first two joints of a leg about the
sideways axis are assumed to be hip and knee, and the leg to be straight with both at 0. A third one, the ankle, keeps
the sole level.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.robot.feet import Foot
from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel

# Ours: knee angle [rad] about the axis to the left, by number of feet. A quadruped leans its thighs back (Go1 0.9 and
# -1.8), a biped forwards.
KNEE = {2: 0.6}
KNEE_ELSE = -1.6
WALKS, ANKLE, HELD = 0.02, 0.05, 0.5  # from configs/g1_flat.py
_SIDEWAYS = 0.9  # least |y| of the axis of a sideways joint
_BEHIND = 0.03  # [m] with the foot this far behind the knee, the leg bends the other way (ANYmal's hind legs)
_MARGIN = 0.05  # [rad] distance to the limits of a joint


def bent(robot: RobotModel, pose: NDArray[np.float64], feet: Sequence[Foot]) -> NDArray[np.float64] | None:
    """``pose`` (D,) with all legs bent; None if a leg has fewer than two sideways joints."""
    model, found = robot.physics, pose.copy()
    data = posed(model, pose)
    for foot in feet:
        legs = [joint for joint in _joints_to(model, foot) if abs(data.xaxis[joint][1]) > _SIDEWAYS]
        if len(legs) < 2:
            return None
        hip, knee, *ankle = legs
        turn = KNEE.get(len(feet)) or KNEE_ELSE * _forward(data, model, knee, foot)
        signs = np.sign(data.xaxis[legs, 1])
        angles = [_within(model, knee, sign * turn * signs[1]) for sign in (1.0, -1.0)]
        found[knee - 1] = max(angles, key=abs) if abs(angles[0]) < 0.5 * abs(turn) else angles[0]
        found[hip - 1] = _over(model, found, hip, foot)
        for joint, sign in zip(ankle[:1], signs[2:], strict=False):
            leaning = found[hip - 1] * signs[0] + found[knee - 1] * signs[1]
            found[joint - 1] = _within(model, joint, -sign * leaning)
    return found


def pose_weights(robot: RobotModel, pose: Sequence[float], feet: Sequence[Foot]) -> list[float]:
    """Weights (D,) of a biped's pose reward: smallest for hip and knee, small for the ankle, large for all others."""
    model, data = robot.physics, posed(robot.physics, pose)
    weights = [HELD] * len(robot.joint_names)
    for foot in feet:
        legs = _joints_to(model, foot)
        sideways = [joint for joint in legs if abs(data.xaxis[joint][1]) > _SIDEWAYS]
        for joint in sideways[:2]:
            weights[joint - 1] = WALKS
        for joint in legs[legs.index(sideways[1]) + 1 :] if len(sideways) > 1 else ():
            weights[joint - 1] = ANKLE
    return weights


def _forward(data: mujoco.MjData, model: mujoco.MjModel, knee: int, foot: Foot) -> float:
    """The direction of the knee: 1.0 if the foot of the straight leg is below or ahead of the knee, -1.0 if behind."""
    ahead = data.geom_xpos[model.geom(foot.geoms[0]).id, 0] - data.xanchor[knee, 0]
    return -1.0 if ahead < -_BEHIND else 1.0


def _joints_to(model: mujoco.MjModel, foot: Foot) -> list[int]:
    """The joints from the root to the foot, without the root joint."""
    body, joints = int(model.geom(foot.geoms[0]).bodyid[0]), []
    while body:
        first = int(model.body_jntadr[body])
        joints += [joint for joint in range(first, first + int(model.body_jntnum[body])) if joint > 0]
        body = int(model.body_parentid[body])
    return sorted(joints)


def _within(model: mujoco.MjModel, joint: int, angle: float) -> float:
    """The nearest angle within the joint's limits."""
    if not model.jnt_limited[joint]:
        return float(angle)
    low, high = model.jnt_range[joint]
    margin = min(_MARGIN, 0.25 * (high - low))
    return float(np.clip(angle, low + margin, high - margin))


def _over(model: mujoco.MjModel, pose: NDArray[np.float64], hip: int, foot: Foot) -> float:
    """The hip angle [rad] at which the foot is under the hip: the best of 200 angles within 90 deg."""
    geoms = [model.geom(name).id for name in foot.geoms]
    off = {}
    for angle in np.linspace(-1.57, 1.57, 200):
        trial = pose.copy()
        trial[hip - 1] = allowed = _within(model, hip, angle)
        data = posed(model, trial)
        middle = data.geom_xpos[geoms].mean(axis=0)
        away = middle - data.xanchor[hip]
        off[allowed] = abs(float(away[0])) + (10.0 if away[2] > 0.0 else 0.0)
    return round(min(off, key=lambda angle: off[angle]), 2)
