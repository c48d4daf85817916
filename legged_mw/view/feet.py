"""Where feet touch the ground: the patch of each, whatever it is made of. numpy and a posed model; nothing is drawn here."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.view.stage import FloatArray

# [smallest half extent of the foot's geoms] by which a patch is larger than what touches: a ball touches in a point
MARGIN = 2.2
MARGIN_MIN, MARGIN_MAX = 0.045, 0.15  # [robot radius]
FLAT = 0.5  # [margin] above its lowest point a foot still touches: a sole that is tilted a little is flat
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


class Patch(NamedTuple):
    """An upright ellipse on the ground."""

    place: FloatArray  # (3,) of its middle, at the foot's lowest height [m]
    turn: FloatArray  # (3, 3) from its axes to the world's: x is the foot's, on the ground, z is up
    half: FloatArray  # (2,) half its length and its width [m]


def feet_of(model: mujoco.MjModel, geoms: Sequence[int]) -> list[list[int]]:
    """Places in ``geoms`` of the geoms of each foot: those of one body are one foot."""
    feet: dict[int, list[int]] = {}
    for place, geom in enumerate(geoms):
        feet.setdefault(int(model.geom_bodyid[geom]), []).append(place)
    return list(feet.values())


def patch(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int], radius: float) -> Patch:
    """The patch below those ``geoms`` of one foot that touch the ground; ``radius`` [m] is the robot's size."""
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
    """Points (P, 3) [m] with the lowest one among them: of a box, and of what is as good as one, its corners."""
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
