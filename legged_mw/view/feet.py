"""The contact patch of each foot, for any shape of its geoms. Needs numpy and a posed model; draws nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.view.stage import FloatArray

# [smallest half extent of the foot's geoms] margin around the contact points: a sphere touches at a single point
MARGIN = 2.2
MARGIN_MIN, MARGIN_MAX = 0.045, 0.15  # [robot radius]
FLAT = 0.5  # [margin] points up to this height above the lowest one count as contact: a slightly tilted sole is flat
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


class Patch(NamedTuple):
    """An upright ellipse on the ground."""

    place: FloatArray  # (3,) [m] its centre, at the height of the foot's lowest point
    turn: FloatArray  # (3, 3) rotation to the world frame: x is the foot's x axis on the ground, z is up
    half: FloatArray  # (2,) [m] half length, half width


def feet_of(model: mujoco.MjModel, geoms: Sequence[int]) -> list[list[int]]:
    """For each foot, the indices of its geoms in ``geoms``. The geoms of one body are one foot."""
    feet: dict[int, list[int]] = {}
    for place, geom in enumerate(geoms):
        feet.setdefault(int(model.geom_bodyid[geom]), []).append(place)
    return list(feet.values())


def patch(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int], radius: float) -> Patch:
    """The patch of one foot; ``geoms`` are its geoms in contact, ``radius`` [m] is the robot's size."""
    points = np.concatenate([lowest_points(model, data, geom) for geom in geoms])
    thin = min(float(model.geom_aabb[geom, 3:].min()) for geom in geoms)
    margin = min(max(MARGIN * thin, MARGIN_MIN * radius), MARGIN_MAX * radius)
    low = float(points[:, 2].min())
    axis = data.xmat[model.geom_bodyid[geoms[0]]]
    heading = math.atan2(axis[3], axis[0])
    cos, sin = math.cos(heading), math.sin(heading)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    touching = points[points[:, 2] <= low + FLAT * margin] @ turn
    ends = np.stack([touching.min(axis=0), touching.max(axis=0)])
    place = turn @ ends.mean(axis=0)
    place[2] = low
    return Patch(place, turn, (ends[1] - ends[0])[:2] / 2 + margin)


def lowest_points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> FloatArray:
    """Points (P, 3) [m] of a geom that include its lowest one: corners, for a box and other kinds of geom."""
    centre, rotation, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
    kind, down = model.geom_type[geom], np.array([0.0, 0.0, -1.0])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return (centre + size[0] * down)[None]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return centre + np.outer([-1.0, 1.0], rotation[:, 2] * size[1]) + size[0] * down
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        towards = size * (rotation.T @ down)
        return (centre + rotation @ (size * towards) / np.linalg.norm(towards))[None]
    box = model.geom_aabb[geom]
    return centre + (box[:3] + CORNERS * box[3:]) @ rotation.T
