"""Warp kernels for a height field: its heights, and its contacts, which replace mujoco-warp's in its contact filter.

mujoco-warp 4.0.0 treats a height field as many prisms. A sphere gets a contact from every near triangle, tilted ones at
edges inside a plane, and sometimes a false deep contact (figures in docs/terrain.md). Here a sphere has a contact at
the nearest point of the surface, and a second one on a face with another direction, as in the corner of a step. The
contacts of a geom are those of its probes, which are spheres fixed to it.
"""

# pyright: reportAttributeAccessIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false
# pyright: reportInvalidTypeForm=false, reportArgumentType=false, reportCallIssue=false, reportAssignmentType=false
# pyright: reportOperatorIssue=false, reportReturnType=false
# ruff: noqa: UP018, SIM102
# (warp compiles the kernels as its own language, in which float() makes a variable)
from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from mujoco_warp._src.collision_core import contact_material_params, write_contact
from mujoco_warp._src.math import make_frame
from mujoco_warp._src.types import Contact
from torch import Tensor

from legged_mw.sim.ground import PROBE_SPACING
from legged_mw.sim.surface_points import spheres_on
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.opaque import not_traced

wp.set_module_options({"enable_backward": False})

_CORNER_COS = wp.constant(0.9)  # two faces with a larger angle between them than this, 26 deg, give two contacts
_DEEPEST = wp.constant(0.3)  # [m] search radius for the surface around a probe under the ground


def probes(model: mujoco.MjModel, ground: int) -> tuple[list[int], np.ndarray, list[float]]:
    """Spheres on the geoms that can touch the geom ``ground``: geoms, centres (P, 3) [m, geom frame], radii [m].

    Their distance is at most ``PROBE_SPACING``. A thin edge of the ground may enter a geom between two by as much.
    """
    geoms, places, radii = [], [], []
    for geom in range(model.ngeom):
        touches = (
            model.geom_contype[ground] & model.geom_conaffinity[geom]
            or model.geom_contype[geom] & model.geom_conaffinity[ground]
        )
        if geom != ground and touches:
            centres, radius = spheres_on(model, geom, PROBE_SPACING)
            geoms += [geom] * len(centres)
            places.append(centres)
            radii += [radius] * len(centres)
    return geoms, np.concatenate([*places, np.zeros((0, 3))]), radii


def _field(terrain: Terrain) -> Any:
    field = _Field()
    field.heights = wp.array(terrain.heights, dtype=float)
    field.corner = wp.vec2(*terrain.corner)
    field.per_cell = 1.0 / terrain.cell
    return field


class HeightLookup:
    """``HeightMap`` as one kernel, which is faster on a GPU."""

    def __init__(self, terrain: Terrain, device: str) -> None:
        self._device = wp.get_device(device)
        with wp.ScopedDevice(self._device):
            self._field = _field(terrain)

    @not_traced
    def __call__(self, points: Tensor) -> Tensor:
        """Ground height [m] at ``points`` (..., 2) [m, world]; outside of the field the height of its edge."""
        heights = torch.empty(points.shape[:-1], device=points.device)
        places = wp.from_torch(points.reshape(-1, 2), dtype=wp.vec2)
        wp.launch(
            _look_up,
            dim=heights.numel(),
            inputs=[self._field, places],
            outputs=[wp.from_torch(heights.view(-1))],
            device=self._device,
        )
        return heights


def touch_ground(model: mujoco.MjModel, ground: int, terrain: Terrain) -> Callable[[mjw.Model, mjw.Data], None]:
    """The ``Model.callback.contactfilter`` on the current device. The geom ``ground`` must not collide in MuJoCo."""
    geoms, places, radii = probes(model, ground)
    field, spheres = _field(terrain), _Probes()
    spheres.geom, spheres.place, spheres.radius = (
        wp.array(values, dtype=kind) for values, kind in ((geoms, int), (places, wp.vec3), (radii, float))
    )

    def collide(m: mjw.Model, d: mjw.Data) -> None:
        wp.launch(
            _touch,
            dim=(d.nworld, len(geoms)),
            inputs=[field, spheres, ground, d.geom_xpos, d.geom_xmat, _gather(_Material, m), d.naconmax],
            outputs=[_gather(_Contacts, d.contact), d.nacon],
        )

    return collide


@wp.struct
class _Field:
    heights: wp.array2d[float]
    corner: wp.vec2
    per_cell: float


@wp.struct
class _Probes:
    geom: wp.array[int]
    place: wp.array[wp.vec3]
    radius: wp.array[float]


def _struct(source: type, names: str) -> Any:
    """A warp struct for arrays of a mujoco-warp dataclass, with their names and types."""
    kinds = {field.name: field.type for field in dataclasses.fields(source)}
    return wp.struct(
        type(f"_{source.__name__}", (), {"__annotations__": {name: kinds[name] for name in names.split()}})
    )


_Material = _struct(
    mjw.Model,
    "geom_condim geom_priority geom_solmix geom_solref geom_solimp geom_friction geom_adhesion geom_margin geom_gap "
    "pair_dim pair_solref pair_solreffriction pair_solimp pair_adhesion pair_friction",
)
_Contacts = _struct(
    Contact,
    "dist pos frame includemargin friction solref solreffriction solimp dim geom efc_address worldid type "
    "geomcollisionid adhesion",
)


def _gather(struct: Any, source: Any) -> Any:
    """A ``struct`` with the arrays of ``source``, without copies."""
    gathered = struct()
    for name in struct.vars:
        setattr(gathered, name, getattr(source, name))
    return gathered


@wp.func
def _vertex(field: _Field, row: int, column: int) -> wp.vec3:
    x, y = field.corner[0] + float(column) / field.per_cell, field.corner[1] + float(row) / field.per_cell
    return wp.vec3(x, y, field.heights[row, column])


@wp.func
def _surface(field: _Field, u: float, v: float) -> float:
    """Height [m] at column u, row v, on the triangles of ``HeightMap``; undefined if u or v is not finite."""
    column = wp.clamp(int(wp.floor(u)), 0, field.heights.shape[1] - 2)
    row = wp.clamp(int(wp.floor(v)), 0, field.heights.shape[0] - 2)
    across, along = wp.clamp(u - float(column), 0.0, 1.0), wp.clamp(v - float(row), 0.0, 1.0)
    low, high = field.heights[row, column], field.heights[row + 1, column + 1]
    side = wp.where(across >= along, field.heights[row, column + 1], field.heights[row + 1, column])
    return low + (side - low) * wp.max(across, along) + (high - side) * wp.min(across, along)


@wp.kernel
def _look_up(field: _Field, points: wp.array[wp.vec2], heights: wp.array[float]):
    i = wp.tid()
    place = (points[i] - field.corner) * field.per_cell
    heights[i] = _surface(field, place[0], place[1])


@wp.func
def _nearest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """The point of the triangle nearest to p [Ericson, Real-Time Collision Detection, 5.1.5]."""
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
    """Whether the line through p along the normal n meets the triangle a, b, c (counterclockwise from above)."""
    return (
        wp.dot(wp.cross(b - a, p - a), n) >= 0.0
        and wp.dot(wp.cross(c - b, p - b), n) >= 0.0
        and wp.dot(wp.cross(a - c, p - c), n) >= 0.0
    )


@wp.func
def _around(field: _Field, u: float, v: float, reach: float) -> wp.vec4i:
    """Cells within ``reach`` [cells] of column u, row v: first and last row, first and last column."""
    last_row, last_column = field.heights.shape[0] - 2, field.heights.shape[1] - 2
    return wp.vec4i(
        wp.clamp(int(wp.floor(v - reach)), 0, last_row),
        wp.clamp(int(wp.floor(v + reach)), 0, last_row),
        wp.clamp(int(wp.floor(u - reach)), 0, last_column),
        wp.clamp(int(wp.floor(u + reach)), 0, last_column),
    )


@wp.func
def _nearest(field: _Field, cells: wp.vec4i, centre: wp.vec3, lowest: float) -> tuple[wp.vec3, float, wp.vec3]:
    """Nearest point of the surface, its distance [m] and the normal of its face; cells below ``lowest`` are skipped."""
    nearest, distance, up = wp.vec3(0.0, 0.0, 0.0), float(1.0e9), wp.vec3(0.0, 0.0, 1.0)
    for row in range(cells[0], cells[1] + 1):
        for column in range(cells[2], cells[3] + 1):
            a, b = _vertex(field, row, column), _vertex(field, row, column + 1)
            c, d = _vertex(field, row + 1, column), _vertex(field, row + 1, column + 1)
            if lowest > wp.max(wp.max(a[2], b[2]), wp.max(c[2], d[2])):
                continue
            for half in range(2):
                middle, end = wp.where(half == 0, b, d), wp.where(half == 0, d, c)
                point = _nearest_on_triangle(centre, a, middle, end)
                away = wp.length(centre - point)
                if away < distance:
                    nearest, distance, up = point, away, wp.normalize(wp.cross(middle - a, end - a))
    return nearest, distance, up


@wp.func
def _other_face(field: _Field, cells: wp.vec4i, centre: wp.vec3, normal: wp.vec3) -> tuple[float, wp.vec3]:
    """Distance [m] and normal of the nearest face below the centre whose normal differs from ``normal``."""
    nearest, direction = float(1.0e9), wp.vec3(0.0, 0.0, 1.0)
    for row in range(cells[0], cells[1] + 1):
        for column in range(cells[2], cells[3] + 1):
            a, b = _vertex(field, row, column), _vertex(field, row, column + 1)
            c, d = _vertex(field, row + 1, column), _vertex(field, row + 1, column + 1)
            for half in range(2):
                middle, end = wp.where(half == 0, b, d), wp.where(half == 0, d, c)
                face = wp.normalize(wp.cross(middle - a, end - a))
                away = wp.dot(centre - a, face)
                if wp.dot(face, normal) < _CORNER_COS and away >= 0.0 and away < nearest:
                    if _over_triangle(centre, face, a, middle, end):
                        nearest, direction = away, face
    return nearest, direction


@wp.func
def _write(
    world: int,
    which: int,
    geoms: wp.vec2i,
    depth: float,
    place: wp.vec3,
    normal: wp.vec3,
    m: _Material,
    naconmax: int,
    out: _Contacts,
    nacon: wp.array[int],
):
    """Write one contact, with parameters combined by MuJoCo's rules."""
    allowance = _margin_and_gap(m, geoms, world)
    # fmt: off
    condim, friction, solref, solreffriction, solimp, adhesion = contact_material_params(
        m.geom_condim, m.geom_priority, m.geom_solmix, m.geom_solref, m.geom_solimp, m.geom_friction, m.geom_adhesion,
        m.pair_dim, m.pair_solref, m.pair_solreffriction, m.pair_solimp, m.pair_adhesion, m.pair_friction,
        geoms, -1, world,
    )
    write_contact(
        naconmax, which, depth, place, make_frame(normal), allowance[0], allowance[1],
        condim, friction, solref, solreffriction, solimp, adhesion, geoms, wp.vec2i(-1, -1), world,
        out.dist, out.pos, out.frame, out.includemargin, out.friction, out.solref, out.solreffriction, out.solimp,
        out.dim, out.geom, out.efc_address, out.worldid, out.type, out.geomcollisionid, out.adhesion, nacon,
    )
    # fmt: on


@wp.func
def _margin_and_gap(m: _Material, geoms: wp.vec2i, world: int) -> wp.vec2:
    """Margin and gap of a pair of geoms [m]."""
    margins, gaps = m.geom_margin[world % m.geom_margin.shape[0]], m.geom_gap[world % m.geom_gap.shape[0]]
    return wp.vec2(margins[geoms[0]] + margins[geoms[1]], gaps[geoms[0]] + gaps[geoms[1]])


@wp.kernel
def _touch(
    field: _Field,
    spheres: _Probes,
    ground: int,
    geom_xpos: wp.array2d[wp.vec3],
    geom_xmat: wp.array2d[wp.mat33],
    material: _Material,
    naconmax: int,
    contacts: _Contacts,
    nacon: wp.array[int],
):
    world, probe = wp.tid()
    geom, radius = spheres.geom[probe], spheres.radius[probe]
    geoms = wp.vec2i(ground, geom)
    centre = geom_xpos[world, geom] + geom_xmat[world, geom] @ spheres.place[probe]
    allowance = _margin_and_gap(material, geoms, world)
    farthest = allowance[0] + allowance[1]  # [m] largest distance of a contact
    u, v = (centre[0] - field.corner[0]) * field.per_cell, (centre[1] - field.corner[1]) * field.per_cell
    above = centre[2] - _surface(field, u, v)  # [m] vertical distance from the ground; negative under it
    touching = radius + farthest
    cells = _around(field, u, v, wp.clamp(-above, touching, wp.max(touching, _DEEPEST)) * field.per_cell)
    nearest, distance, up = _nearest(field, cells, centre, centre[2] - touching)
    side = wp.where(above < 0.0, -1.0, 1.0)
    depth = side * distance - radius  # [m] negative if it penetrates
    if distance > 1.0e8 or depth >= farthest:
        return
    normal = up
    if distance > 1.0e-6:
        away = side * (centre - nearest) / distance
        # above a face its normal is more exact than a difference of positions
        if wp.dot(away, up) < 0.9999:
            normal = away
    place = centre - normal * (radius + 0.5 * depth)
    _write(world, 0, geoms, depth, place, normal, material, naconmax, contacts, nacon)
    if above >= 0.0:  # a probe under the ground needs only one contact
        other, face = _other_face(field, cells, centre, normal)
        depth = other - radius
        if depth < farthest:
            place = centre - face * (radius + 0.5 * depth)
            _write(world, 1, geoms, depth, place, face, material, naconmax, contacts, nacon)
