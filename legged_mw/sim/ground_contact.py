"""Contacts between the robot and a height field for mujoco-warp: one kernel, called where it would filter its own contacts.

mujoco-warp 4.0.0 treats a height field as a heap of prisms: a sphere gets a contact from every triangle near it, tilted
ones at the edges between triangles of one plane, and now and then a deep one where there is none (docs/terrain.md has the
figures). Here a sphere touches the surface at its nearest point, and at a second one where another face turns away from
the first, as in the corner of a step. A geom is looked at in probes, which are spheres fixed to it.
"""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false, reportInvalidTypeForm=false
# ruff: noqa: UP018, SIM102
# (mujoco ships no type stubs, and warp compiles what it finds written here as its own language: float() makes a variable)
from __future__ import annotations

from collections.abc import Callable

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp
from mujoco_warp._src.collision_core import contact_material_params, write_contact
from mujoco_warp._src.math import make_frame
from mujoco_warp._src.types import vec5

from legged_mw.sim.model import ModelError
from legged_mw.sim.terrain import Terrain

wp.set_module_options({"enable_backward": False})

_CORNER_COS = wp.constant(0.9)  # of the angle from which on a second face is another contact: 26 deg
_DEEPEST = wp.constant(0.3)  # [m] how far around a probe under the ground its surface is looked for


def probes(model: mujoco.MjModel, ground: int) -> tuple[list[int], np.ndarray, list[float]]:
    """Spheres that stand for what can touch the geom ``ground``: their geoms, places in the geom's frame (P, 3), radii [m].

    A sphere is its own probe, a capsule its two ends, a box its eight corners. Raises ModelError for other shapes.
    """
    kinds = mujoco.mjtGeom
    geoms, places, radii = [], [], []
    for geom in range(model.ngeom):
        touches = model.geom_contype[ground] & model.geom_conaffinity[geom] or model.geom_contype[geom] & model.geom_conaffinity[ground]
        if geom == ground or not touches:
            continue
        kind, size = model.geom_type[geom], model.geom_size[geom]
        if kind == kinds.mjGEOM_SPHERE:
            found = [((0.0, 0.0, 0.0), size[0])]
        elif kind == kinds.mjGEOM_CAPSULE:
            found = [((0.0, 0.0, end * size[1]), size[0]) for end in (-1.0, 1.0)]
        elif kind == kinds.mjGEOM_BOX:
            found = [((x * size[0], y * size[1], z * size[2]), 0.0) for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)]
        else:
            shape = str(kinds(kind)).rsplit("_", 1)[-1].lower()
            raise ModelError(
                f"collider '{model.geom(geom).name}' is a {shape}: on terrain mujoco_warp knows spheres, capsules and boxes; "
                "leave it out of asset.colliders, give the MJCF one of those shapes there, or take sim.engine = mujoco"
            )
        for place, radius in found:
            geoms.append(geom)
            places.append(place)
            radii.append(float(radius))
    return geoms, np.array(places).reshape(-1, 3), radii


def touch_ground(model: mujoco.MjModel, ground: int, terrain: Terrain) -> Callable[[mjw.Model, mjw.Data], None]:
    """What ``Model.callback.contactfilter`` is to be, on the current device. The geom ``ground`` must not collide by itself."""
    geoms, places, radii = probes(model, ground)
    heights = wp.array(terrain.heights, dtype=float)
    geom, place, radius = wp.array(geoms, dtype=int), wp.array(places, dtype=wp.vec3), wp.array(radii, dtype=float)
    corner, per_cell = wp.vec2(*terrain.corner), 1.0 / terrain.cell

    def collide(m: mjw.Model, d: mjw.Data) -> None:
        wp.launch(
            _touch,
            dim=(d.nworld, len(geoms)),
            inputs=[
                *(heights, corner, per_cell, ground, geom, place, radius, d.geom_xpos, d.geom_xmat, d.naconmax),
                *(m.geom_condim, m.geom_priority, m.geom_solmix, m.geom_solref, m.geom_solimp, m.geom_friction, m.geom_adhesion),
                *(m.geom_margin, m.geom_gap),
                *(m.pair_dim, m.pair_solref, m.pair_solreffriction, m.pair_solimp, m.pair_adhesion, m.pair_friction),
            ],
            outputs=[
                *(d.contact.dist, d.contact.pos, d.contact.frame, d.contact.includemargin, d.contact.friction, d.contact.solref),
                *(d.contact.solreffriction, d.contact.solimp, d.contact.dim, d.contact.geom, d.contact.efc_address, d.contact.worldid),
                *(d.contact.type, d.contact.geomcollisionid, d.contact.adhesion, d.nacon),
            ],
        )

    return collide


@wp.func
def _vertex(heights: wp.array2d[float], corner: wp.vec2, per_cell: float, row: int, column: int) -> wp.vec3:
    return wp.vec3(corner[0] + float(column) / per_cell, corner[1] + float(row) / per_cell, heights[row, column])


@wp.func
def _surface(heights: wp.array2d[float], u: float, v: float) -> float:
    """Height [m] at column u, row v: triangles, as ``terrain.HeightMap``."""
    rows, columns = heights.shape[0], heights.shape[1]
    column = wp.clamp(int(wp.floor(u)), 0, columns - 2)
    row = wp.clamp(int(wp.floor(v)), 0, rows - 2)
    across, along = wp.clamp(u - float(column), 0.0, 1.0), wp.clamp(v - float(row), 0.0, 1.0)
    low, high = heights[row, column], heights[row + 1, column + 1]
    side = wp.where(across >= along, heights[row, column + 1], heights[row + 1, column])
    return low + (side - low) * wp.max(across, along) + (high - side) * wp.min(across, along)


@wp.func
def _nearest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """The point of the triangle that is nearest to p [Ericson, Real-Time Collision Detection, 5.1.5]."""
    ab, ac, ap = b - a, c - a, p - a
    d1, d2 = wp.dot(ab, ap), wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return a
    bp = p - b
    d3, d4 = wp.dot(ab, bp), wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        return a + ab * (d1 / (d1 - d3))
    cp = p - c
    d5, d6 = wp.dot(ab, cp), wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return a + ac * (d2 / (d2 - d6))
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and (d4 - d3) >= 0.0 and (d5 - d6) >= 0.0:
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    inverse = 1.0 / (va + vb + vc)
    return a + ab * (vb * inverse) + ac * (vc * inverse)


@wp.func
def _over_triangle(p: wp.vec3, n: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> bool:
    """Whether p, moved along the normal n, meets the triangle a, b, c (counterclockwise seen from above)."""
    return (
        wp.dot(wp.cross(b - a, p - a), n) >= 0.0 and wp.dot(wp.cross(c - b, p - b), n) >= 0.0 and wp.dot(wp.cross(a - c, p - c), n) >= 0.0
    )


@wp.kernel
def _touch(
    heights: wp.array2d[float],
    corner: wp.vec2,
    per_cell: float,
    ground: int,
    probe_geom: wp.array[int],
    probe_place: wp.array[wp.vec3],
    probe_radius: wp.array[float],
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    naconmax: int,
    geom_condim: wp.array[int],
    geom_priority: wp.array[int],
    geom_solmix: wp.array2d[float],
    geom_solref: wp.array2d[wp.vec2],
    geom_solimp: wp.array2d[vec5],
    geom_friction: wp.array2d[wp.vec3],
    geom_adhesion: wp.array2d[float],
    geom_margin: wp.array2d[float],
    geom_gap: wp.array2d[float],
    pair_dim: wp.array[int],
    pair_solref: wp.array2d[wp.vec2],
    pair_solreffriction: wp.array2d[wp.vec2],
    pair_solimp: wp.array2d[vec5],
    pair_adhesion: wp.array2d[float],
    pair_friction: wp.array2d[vec5],
    contact_dist: wp.array[float],
    contact_pos: wp.array[wp.vec3],
    contact_frame: wp.array[wp.mat33],
    contact_includemargin: wp.array[float],
    contact_friction: wp.array[vec5],
    contact_solref: wp.array[wp.vec2],
    contact_solreffriction: wp.array[wp.vec2],
    contact_solimp: wp.array[vec5],
    contact_dim: wp.array[int],
    contact_geom: wp.array[wp.vec2i],
    contact_efc_address: wp.array2d[int],
    contact_worldid: wp.array[int],
    contact_type: wp.array[int],
    contact_geomcollisionid: wp.array[int],
    contact_adhesion: wp.array[float],
    nacon: wp.array[int],
):
    world, probe = wp.tid()
    geom, radius = probe_geom[probe], probe_radius[probe]
    centre = geom_xpos[world, geom] + geom_xmat[world, geom] @ probe_place[probe]
    margins, gaps = world % geom_margin.shape[0], world % geom_gap.shape[0]
    margin = geom_margin[margins, ground] + geom_margin[margins, geom]
    gap = geom_gap[gaps, ground] + geom_gap[gaps, geom]
    u, v = (centre[0] - corner[0]) * per_cell, (centre[1] - corner[1]) * per_cell
    above = centre[2] - _surface(heights, u, v)  # [m] straight up from the ground; negative: under it
    touching = radius + margin + gap
    reach = wp.clamp(-above, touching, wp.max(touching, _DEEPEST)) * per_cell
    last_row, last_column = heights.shape[0] - 2, heights.shape[1] - 2
    row_0, row_1 = wp.clamp(int(wp.floor(v - reach)), 0, last_row), wp.clamp(int(wp.floor(v + reach)), 0, last_row)
    column_0, column_1 = wp.clamp(int(wp.floor(u - reach)), 0, last_column), wp.clamp(int(wp.floor(u + reach)), 0, last_column)

    nearest, distance, up = wp.vec3(0.0, 0.0, 0.0), float(1.0e9), wp.vec3(0.0, 0.0, 1.0)
    for row in range(row_0, row_1 + 1):
        for column in range(column_0, column_1 + 1):
            a, b = _vertex(heights, corner, per_cell, row, column), _vertex(heights, corner, per_cell, row, column + 1)
            c, d = _vertex(heights, corner, per_cell, row + 1, column), _vertex(heights, corner, per_cell, row + 1, column + 1)
            if centre[2] - touching > wp.max(wp.max(a[2], b[2]), wp.max(c[2], d[2])):
                continue
            for half in range(2):
                middle, end = wp.where(half == 0, b, d), wp.where(half == 0, d, c)
                point = _nearest_on_triangle(centre, a, middle, end)
                away = wp.length(centre - point)
                if away < distance:
                    nearest, distance, up = point, away, wp.normalize(wp.cross(middle - a, end - a))
    if distance > 1.0e8:
        return
    side = wp.where(above < 0.0, -1.0, 1.0)
    normal = wp.where(distance > 1.0e-6, side * (centre - nearest) / wp.max(distance, 1.0e-9), up)
    if wp.dot(normal, up) > 0.9999:
        normal = up  # over a face: its own normal, which far from the origin is more exact than a difference of places
    depth = side * distance - radius  # negative where it penetrates
    if depth >= margin + gap:
        return
    geoms = wp.vec2i(ground, geom)
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        geom_condim,
        geom_priority,
        geom_solmix,
        geom_solref,
        geom_solimp,
        geom_friction,
        geom_adhesion,
        pair_dim,
        pair_solref,
        pair_solreffriction,
        pair_solimp,
        pair_adhesion,
        pair_friction,
        geoms,
        -1,
        world,
    )
    # the second contact: the nearest face that turns away from the first and that the probe is right over
    second, second_normal = float(1.0e9), wp.vec3(0.0, 0.0, 1.0)
    if above >= 0.0:  # from under the ground there is one way out, the nearest
        for row in range(row_0, row_1 + 1):
            for column in range(column_0, column_1 + 1):
                a, b = _vertex(heights, corner, per_cell, row, column), _vertex(heights, corner, per_cell, row, column + 1)
                c, d = _vertex(heights, corner, per_cell, row + 1, column), _vertex(heights, corner, per_cell, row + 1, column + 1)
                for half in range(2):
                    middle, end = wp.where(half == 0, b, d), wp.where(half == 0, d, c)
                    face = wp.normalize(wp.cross(middle - a, end - a))
                    away = wp.dot(centre - a, face)
                    if wp.dot(face, normal) < _CORNER_COS and away >= 0.0 and away < second:
                        if _over_triangle(centre, face, a, middle, end):
                            second, second_normal = away, face
    for contact in range(2):
        if contact == 1:
            normal, depth = second_normal, second - radius
        if depth < margin + gap:
            write_contact(
                naconmax,
                contact,
                depth,
                centre - normal * (radius + 0.5 * depth),
                make_frame(normal),
                margin,
                gap,
                condim,
                friction,
                solref,
                solreffriction,
                solimp,
                adhesion,
                geoms,
                wp.vec2i(-1, -1),
                world,
                contact_dist,
                contact_pos,
                contact_frame,
                contact_includemargin,
                contact_friction,
                contact_solref,
                contact_solreffriction,
                contact_solimp,
                contact_dim,
                contact_geom,
                contact_efc_address,
                contact_worldid,
                contact_type,
                contact_geomcollisionid,
                contact_adhesion,
                nacon,
            )
