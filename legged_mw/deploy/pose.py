"""A robot placed by what it measures: joints and tilt, its lowest shape on level ground. Nothing is stepped."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.robot import Floats


def place(model: Any, data: Any, joints: Sequence[str], angles: Floats, gravity: Floats, heading: float = 0.0) -> None:
    """Put the robot over its place (x, y) in ``data``: ``angles`` (D,) [rad] of ``joints``, ``gravity`` (3,) in the body, heading [rad]."""
    data.qpos[[model.joint(name).qposadr[0] for name in joints]] = angles
    up, tilt, turn = -gravity / np.linalg.norm(gravity), np.zeros(4), np.zeros(4)  # z axis of the world, in the body
    axis = np.cross(up, [0.0, 0.0, 1.0])
    mujoco.mju_axisAngle2Quat(tilt, axis / max(float(np.linalg.norm(axis)), 1e-9), math.acos(np.clip(up[2], -1.0, 1.0)))
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), heading)
    mujoco.mju_mulQuat(data.qpos[3:7], turn, tilt)
    mujoco.mj_kinematics(model, data)
    touching = np.flatnonzero((model.geom_conaffinity > 0) & (model.geom_bodyid > 0))
    lowest = [data.geom_xpos[i, 2] - _reach(model.geom_size[i], data.geom_xmat[i], model.geom_type[i]) for i in touching]
    data.qpos[2] -= min(lowest, default=0.0)


def _reach(size: Floats, turn: Floats, kind: int) -> float:
    """How far a sphere or capsule reaches down from its centre [m]; another shape about its largest size."""
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return size[0] + abs(turn[8]) * size[1]
    return size[0] if kind == mujoco.mjtGeom.mjGEOM_SPHERE else float(size.max())
