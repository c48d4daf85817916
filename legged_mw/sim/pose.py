"""Where the parts of a robot are in a pose that stands upright: geometry of a compiled model, nothing is stepped."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.sim.model import RobotModel
from legged_mw.sim.shapes import surfaces

_UPRIGHT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # place and attitude of a root


class Upright(NamedTuple):
    """S sites of a robot whose root is upright at the world's origin, and the bodies that they are on."""

    places: np.ndarray  # (S, 3) of the sites in the root's frame [m]
    bodies: np.ndarray  # (S,) index of each site's body
    up: np.ndarray  # (S, 3) the vertical in the frame of each site's body


def posed(model: mujoco.MjModel, joints: Iterable[float], root: Iterable[float] = _UPRIGHT) -> mujoco.MjData:
    """Places of bodies, geoms and sites with the joints at the angles ``joints`` (D,) [rad] and the ``root`` (7,) there."""
    data = mujoco.MjData(model)
    data.qpos[:] = [*root, *joints]
    mujoco.mj_kinematics(model, data)
    return data


def upright(robot: RobotModel, joints: Sequence[float], sites: Sequence[str]) -> Upright:
    """``sites`` with the joints at the angles ``joints`` (D,) [rad]."""
    model, data = robot.physics, posed(robot.physics, joints)
    where = [robot.id("site", name) for name in sites]
    bodies = model.site_bodyid[where]
    return Upright(data.site_xpos[where].copy(), bodies.copy(), data.xmat[bodies].reshape(-1, 3, 3)[:, 2].copy())


def standing_height(robot: RobotModel, geoms: Sequence[str], joints: Sequence[float]) -> float:
    """How high the root is above a plane that the lowest of ``geoms`` touches, upright, with the joints at ``joints`` (D,) [m]."""
    points = surfaces(robot.physics, posed(robot.physics, joints), geoms)
    return -float(min(places[:, 2].min() for places in points.values()))
