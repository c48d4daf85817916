"""Count the contacts (``nconmax``) and constraint rows (``njmax``) that a world needs on mujoco-warp.

mujoco-warp allocates them once. With too few it drops contacts and reports this; too many need memory and time.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.sim.ground import GROUND, PROBE_SPACING
from legged_mw.sim.surface_points import spheres_on

_TYPE, _EQUALITY = mujoco.mjtGeom, mujoco.mjtEq
# Number of contacts of one geom with a plane, as in collision_primitive.py of mujoco-warp 4.0.0.
_ON_PLANE = {_TYPE.mjGEOM_SPHERE: 1, _TYPE.mjGEOM_ELLIPSOID: 1, _TYPE.mjGEOM_CAPSULE: 2}  # others: 4, on a face
_ROWS = {1: 1, 3: 4, 4: 6, 6: 10}  # condim -> rows of a contact with a pyramidal cone
_EQUALITY_ROWS = {_EQUALITY.mjEQ_CONNECT: 3, _EQUALITY.mjEQ_WELD: 6}  # others: 1
_LEAST = 8  # least number of contacts; they need little memory, because all worlds share one buffer
_REST = 0.25  # ours: share of their contacts that links have at the same time, except the last links


class Capacity(NamedTuple):
    """Contacts and rows of one world, and a text on their causes."""

    contacts: int
    rows: int
    why: str


def count_capacity(model: mujoco.MjModel, terrain: bool) -> Capacity:
    """The capacity that ``model`` needs on its plane, or on ``terrain``.

    Assumptions: the last link of a limb has all its contacts, other links a quarter of theirs. Dry friction and limits
    need one row per joint. With self-collisions half of the geoms touch another geom, and as many are near another
    geom, which is also a contact.
    """
    geoms = [geom for geom in range(model.ngeom) if model.geom_bodyid[geom] and model.geom_conaffinity[geom] & 1]
    last = _last_links(model, {int(model.geom_bodyid[geom]) for geom in geoms})
    shares = [_contacts(model, geom, terrain) * (1.0 if model.geom_bodyid[geom] in last else _REST) for geom in geoms]
    on_ground = int(np.ceil(sum(shares)))
    own = len(geoms) // 2 if any(model.geom_contype[geom] for geom in geoms) else 0
    friction = int((model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum())
    limits = int(model.jnt_limited.sum() + model.tendon_limited.sum())
    equalities = sum(_EQUALITY_ROWS.get(_EQUALITY(kind), 1) for kind in model.eq_type)
    each = _ROWS[int(model.geom(GROUND).condim[0])]
    parts = {"dry friction": friction, "limits": limits, "equalities": equalities}
    rows = sum(parts.values()) + on_ground * each + own * _ROWS[3]
    why = [f"{count} {name}" for name, count in parts.items() if count]
    why += [f"{each} a contact with the ground ({on_ground})", *([f"4 a contact of its own ({own})"] if own else [])]
    return Capacity(max(on_ground + 2 * own, _LEAST), rows, ", ".join(why))


def _last_links(model: mujoco.MjModel, bodies: set[int]) -> set[int]:
    """The bodies of ``bodies`` without descendants among them."""
    above: set[int] = set()
    for body in bodies:
        while (body := int(model.body_parentid[body])) > 0:
            above.add(body)
    return bodies - above


def _contacts(model: mujoco.MjModel, geom: int, terrain: bool) -> int:
    """The most contacts of ``geom`` with the ground.

    On terrain: two for a sphere; one per probe of a row, and one more; else one per probe of one side.
    """
    kind = _TYPE(model.geom_type[geom])
    plane = _ON_PLANE.get(kind, 4)
    if not terrain:
        return plane
    if kind == _TYPE.mjGEOM_SPHERE:
        return 2
    probes, radius = spheres_on(model, geom, PROBE_SPACING)
    return max(plane, len(probes) + 1 if radius else len(probes) // 2)
