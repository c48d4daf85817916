"""Guess a robot's feet: the lowest parts that carry no others."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.sim.errors import ModelError
from legged_mw.sim.model import RobotModel
from legged_mw.sim.shapes import spheres_on

_SAME, _SAME_SHARE = 0.03, 0.08  # [m], and of the robot's height: ends of limbs that are so much higher than the lowest are feet too
_SOLE = 0.015  # [m] parts of a foot that are so much higher than its lowest are of its sole
_SPACING = 0.02  # [m] between points on a surface


class Foot(NamedTuple):
    """A foot by a name that a task may use."""

    name: str  # of its only geom, or of a body with just these geoms, or of the body that has them among others
    geoms: tuple[str, ...]
    known: bool  # whether the name alone means these geoms


def guess_feet(robot: RobotModel, qpos: NDArray[np.float64]) -> list[Foot]:
    """Feet in the order of the file, with the robot at ``qpos`` (7 + D,). Raises ModelError if nothing touches."""
    model, data = robot.physics, mujoco.MjData(robot.physics)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    ground = robot.ground_geoms()
    low = {g: _lowest(model, data, g) for g in range(ground.stop, model.ngeom) if model.geom_conaffinity[g]}
    parents = {int(p) for p in model.body_parentid[1:]}
    ends = {int(model.geom_bodyid[g]) for g in low} - parents
    of_body = {body: {g: z for g, z in low.items() if model.geom_bodyid[g] == body} for body in sorted(ends)}
    if not of_body:
        raise ModelError("no part that ends a limb collides, so that no feet can be guessed; give the feet colliding geoms")
    lowest = min(min(these.values()) for these in of_body.values())
    near = lowest + max(_SAME, _SAME_SHARE * (float(qpos[2]) - lowest))
    feet = [(body, these) for body, these in of_body.items() if min(these.values()) <= near]
    return [_foot(robot, body, _sole(model, these)) for body, these in feet]


def _sole(model: mujoco.MjModel, low: dict[int, float]) -> list[int]:
    """Of a body's geoms, ``low`` [m, world] each, the lowest one and those of its kind that are about as low."""
    lowest = min(low, key=lambda geom: low[geom])
    return [g for g, z in low.items() if z <= low[lowest] + _SOLE and model.geom_type[g] == model.geom_type[lowest]]


def height_over(robot: RobotModel, pose: NDArray[np.float64], feet: Sequence[Foot]) -> float:
    """[m] of the upright root when the lowest of ``feet`` touches the ground, with the joints at ``pose`` (D,)."""
    data = mujoco.MjData(robot.physics)
    data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *pose]
    mujoco.mj_kinematics(robot.physics, data)
    return -min(_lowest(robot.physics, data, robot.id("geom", geom)) for foot in feet for geom in foot.geoms)


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """[m, world] of the geom's surface."""
    points, radius = spheres_on(model, geom, _SPACING)
    return float((data.geom_xpos[geom] + points @ data.geom_xmat[geom].reshape(3, 3).T)[:, 2].min()) - radius


def _foot(robot: RobotModel, body: int, geoms: list[int]) -> Foot:
    """A name for these geoms of ``body``."""
    names = tuple(robot.physics.geom(geom).name for geom in geoms)
    parts = [part for part, geoms in robot.names.bodies.items() if {*geoms} == {*names}]  # also such as are fused in what is stepped
    if parts:
        return Foot(parts[-1], names, True)
    return Foot(names[0], names, True) if len(names) == 1 else Foot(robot.physics.body(body).name, names, False)
