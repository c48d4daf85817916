"""Sites that an MJCF lacks: at a geom, or at the lowest point of several."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

from legged_mw.sim.errors import ModelError
from legged_mw.sim.shapes import spheres_on

SPACING = 0.01  # [m] between points on a shape whose lowest one is looked for
LEVEL = 0.001  # [m] points so little above the lowest one are as low: a flat side has its site in the middle


def add_sites(spec: mujoco.MjSpec, sites: Mapping[str, Sequence[str]], angles: Sequence[float], where: str, notes: list[str]) -> None:
    """Add each site (name -> geoms) that ``spec`` lacks; which point is the lowest is asked with the joints at ``angles`` (D,) [rad].

    One geom has its site in its middle. Several have it at the middle of their lowest points, on the body of the lowest one.
    """
    missing = {name: geoms for name, geoms in sites.items() if spec.site(name) is None}
    if not missing:
        return
    copy = spec.copy()
    copy.compiler.fusestatic = False
    model = copy.compile()
    data = mujoco.MjData(model)
    data.qpos[3:] = [1.0, 0.0, 0.0, 0.0, *angles]
    mujoco.mj_kinematics(model, data)
    for name, geoms in missing.items():
        if not geoms:
            raise ModelError(f"site '{name}' is not in {where} and no geom is given for it")
        if len(geoms) == 1:
            geom, place = geoms[0], model.geom(geoms[0]).pos
        else:
            geom, place = _lowest(model, data, geoms)
        # group 3: viewers do not draw it unless asked to
        spec.geom(geom).parent.add_site(name=name, pos=place, group=3)
        notes.append(f"site '{name}' made at {'the lowest point of ' if len(geoms) > 1 else ''}{', '.join(geoms)}")


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[str]) -> tuple[str, np.ndarray]:
    """The geom whose surface is lowest, and the middle of the lowest points on its body [m, body frame]."""
    points: dict[str, np.ndarray] = {}  # world frame
    for name in geoms:
        geom = model.geom(name).id
        places, radius = spheres_on(model, geom, SPACING)
        points[name] = data.geom_xpos[geom] + places @ data.geom_xmat[geom].reshape(3, 3).T - [0.0, 0.0, radius]
    lowest = min(points, key=lambda name: round(points[name][:, 2].min(), 6))  # of equal ones the first
    body = model.geom(lowest).bodyid[0]
    there = np.concatenate([places for name, places in points.items() if model.geom(name).bodyid[0] == body])
    low = there[there[:, 2] < there[:, 2].min() + LEVEL]
    middle = 0.5 * (low.min(axis=0) + low.max(axis=0))
    return lowest, (middle - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
