"""Guess a robot's feet: the lowest bodies without children, and bodies of the same family on other legs."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.sim.joints import family, posed
from legged_mw.sim.model import RobotModel
from legged_mw.sim.surface_points import surfaces
from legged_mw.utils.errors import ModelError

# [m], and share of the robot's height: ends of limbs up to this much higher than the lowest one are feet too
_SAME, _SAME_SHARE = 0.03, 0.08
_SOLE = 0.015  # [m] geoms up to this much higher than the lowest geom of a foot belong to its sole


class Foot(NamedTuple):
    """A foot with a name for the task's config."""

    name: str  # of its only geom, of a body with exactly these geoms, or of a body with more geoms
    geoms: tuple[str, ...]
    known: bool  # whether the name selects exactly these geoms


def guess_feet(robot: RobotModel, qpos: NDArray[np.float64]) -> list[Foot]:
    """The feet in the order of the file, for the robot at ``qpos`` (7 + D,).

    Raises ModelError if no end of a limb collides.
    """
    model, parents = robot.physics, {*robot.physics.body_parentid[1:]}
    colliding = [g for g in range(robot.ground_geoms().stop, model.ngeom) if model.geom_conaffinity[g]]
    names = [model.geom(g).name for g in colliding if model.geom_bodyid[g] not in parents]
    of_body: dict[int, dict[int, float]] = {}
    for name, points in surfaces(model, posed(model, qpos[7:], qpos[:7]), names).items():
        geom = model.geom(name)
        of_body.setdefault(int(geom.bodyid[0]), {})[geom.id] = float(points[:, 2].min())
    if not of_body:
        raise ModelError(
            "no part that ends a limb collides, so that no feet can be guessed; give the feet colliding geoms"
        )
    lowest = min(min(these.values()) for these in of_body.values())
    near = lowest + max(_SAME, _SAME_SHARE * (float(qpos[2]) - lowest))
    soles = {body: _sole(model, these) for body, these in of_body.items() if min(these.values()) <= near}
    for body, these in of_body.items():  # a lifted leg has the same kind of foot
        same = [
            other for other in soles if family(model.body(other).name) == family(model.body(body).name or str(body))
        ]
        if body not in soles and same and len(of_body[same[0]]) == len(these):
            soles[body] = [geom for geom, like in zip(these, of_body[same[0]], strict=True) if like in soles[same[0]]]
    return [_foot(robot, body, soles[body]) for body in sorted(soles)]


def _sole(model: mujoco.MjModel, low: dict[int, float]) -> list[int]:
    """The sole of a body: its lowest geom, and geoms of that type at about that height.

    ``low``: geom -> z of its lowest point [m, world frame].
    """
    lowest = min(low, key=lambda geom: low[geom])
    return [g for g, z in low.items() if z <= low[lowest] + _SOLE and model.geom_type[g] == model.geom_type[lowest]]


def _foot(robot: RobotModel, body: int, geoms: list[int]) -> Foot:
    """The foot with these geoms of ``body``, named by its geom or body."""
    names = tuple(robot.physics.geom(geom).name for geom in geoms)
    # also bodies that are fused in the simulated model
    parts = [part for part, geoms in robot.names.bodies.items() if {*geoms} == {*names}]
    if parts:
        return Foot(parts[-1], names, True)
    return Foot(names[0], names, True) if len(names) == 1 else Foot(robot.physics.body(body).name, names, False)
