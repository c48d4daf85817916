"""Points and spheres on the surface of collision shapes, for contacts with a height field and for lowest points."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.sim.joints import posed
from legged_mw.utils.errors import ModelError

SPACING = 0.01  # [m] between points, to find the lowest one
_LEVEL = 0.001  # [m] height of points that count as lowest, so that a flat side has its site in the middle
Points = NDArray[np.float64]  # (P, 3) [m], in the geom's frame

_KINDS = mujoco.mjtGeom


def spheres_on(model: mujoco.MjModel, geom: int, spacing: float) -> tuple[Points, float]:
    """Centres of spheres on the surface of ``geom``, with distances up to about ``spacing`` [m], and their radius [m].

    A sphere is one sphere, a capsule or a thin rod a row of spheres, other shapes are points. Raises ModelError for
    unknown shapes.
    """
    kind, size = _KINDS(model.geom_type[geom]), model.geom_size[geom]
    if kind == _KINDS.mjGEOM_MESH:
        return _on_mesh(model, int(model.geom_dataid[geom]), spacing), 0.0
    if kind not in _POINTS:
        shape = str(kind).rsplit("_", 1)[-1].lower()
        known = "spheres, capsules, boxes, cylinders, ellipsoids and meshes"
        text = (
            f"geom '{model.geom(geom).name}' is a {shape}: its surface is not known as points, as those of {known} are"
        )
        raise ModelError(f"{text}. Give the MJCF one of those there, or take the engine mujoco")
    radius = float(size[0]) if kind in (_KINDS.mjGEOM_SPHERE, _KINDS.mjGEOM_CAPSULE) else 0.0
    if kind == _KINDS.mjGEOM_CYLINDER and 4.0 * size[0] <= spacing and size[0] <= size[1]:
        return np.array([(0.0, 0.0, z) for z in _spaced(size[1] - size[0], spacing)]), float(size[0])  # a rod
    return np.array(_POINTS[kind](size, spacing), dtype=float).reshape(-1, 3), radius


def _on_box(size: Points, spacing: float) -> list[tuple[float, ...]]:
    grid = itertools.product(*(_spaced(half, spacing) for half in size))
    return [place for place in grid if any(abs(at) == half for at, half in zip(place, size, strict=True))]


def _on_cylinder(size: Points, spacing: float) -> list[tuple[float, ...]]:
    inner = np.linspace(0.0, size[0], math.ceil(size[0] / spacing) + 1)[:-1]
    rings = [(size[0], z) for z in _spaced(size[1], spacing)]
    rings += [(radius, z) for z in (-size[1], size[1]) for radius in inner]
    return [(x, y, z) for radius, z in rings for x, y in _ring(radius, spacing)]


def _on_ellipsoid(size: Points, spacing: float) -> list[tuple[float, ...]]:
    """Points on rings around z, scaled along x and y."""
    largest = float(size.max())
    angles = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 2 * max(3, math.ceil(0.5 * math.pi * largest / spacing)) + 1)
    rings = [(math.cos(angle) if abs(angle) < 1.57 else 0.0, math.sin(angle)) for angle in angles]
    return [
        (x / largest * size[0], y / largest * size[1], z * size[2])
        for radius, z in rings
        for x, y in _ring(radius * largest, spacing)
    ]


def _on_mesh(model: mujoco.MjModel, mesh: int, spacing: float) -> Points:
    """The convex hull's outermost vertices in 26 directions, and its points on a grid of lines along each axis."""
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices, faces = model.mesh_vert[first : first + count].astype(float), model.mesh_face[model.mesh_faceadr[mesh] :]
    faces = faces[: model.mesh_facenum[mesh]]
    # the hull: numvert, numface, vert_edgeadr, vert_globalid, edge_localid (numvert + 3 numface), face_globalid
    if (start := model.mesh_graphadr[mesh]) >= 0:
        (count, number), graph = model.mesh_graph[start : start + 2], model.mesh_graph[start + 2 :]
        faces = graph[3 * count + 3 * number :][: 3 * number].reshape(-1, 3)
    corners = vertices[np.unique(faces)]
    middle, half = 0.5 * (corners.max(axis=0) + corners.min(axis=0)), 0.5 * np.ptp(corners, axis=0)
    outwards = np.array([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(way)]) / half.clip(1e-6)
    kept = corners[np.unique((outwards @ corners.T).argmax(axis=1))]
    for axis in range(3):
        across = [(axis + 1) % 3, (axis + 2) % 3]
        lines = np.array(list(itertools.product(*(_spaced(0.999 * half[i], spacing) for i in across)))) + middle[across]
        for place in _where_lines_meet(vertices[faces], lines, axis, across):
            if np.linalg.norm(kept - place, axis=1).min() > 0.1 * spacing:
                kept = np.concatenate([kept, place[None]])
    return kept


def _where_lines_meet(triangles: Points, lines: Points, axis: int, across: list[int]) -> Points:
    """Points (P, 3) of ``triangles`` (T, 3, 3) on lines along ``axis``, at ``lines`` (L, 2) ``across`` it."""
    a, ab, ac = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    (au, av), (bu, bv), (cu, cv) = a[:, across].T, ab[:, across].T, ac[:, across].T
    # a triangle parallel to the lines has no area in the projection, and meets no line
    area = np.where(np.abs(bu * cv - bv * cu) > 1e-12, bu * cv - bv * cu, np.inf)
    u, v = lines[:, :1] - au, lines[:, 1:] - av
    share_b, share_c = (u * cv - v * cu) / area, (v * bu - u * bv) / area
    inside = (share_b >= 0.0) & (share_c >= 0.0) & (share_b + share_c <= 1.0) & np.isfinite(area)
    return (a + share_b[..., None] * ab + share_c[..., None] * ac)[inside]


def _spaced(half: float, spacing: float) -> list[float]:
    """Evenly spaced values from ``-half`` to ``half`` [m]."""
    return np.linspace(-half, half, max(2, math.ceil(2.0 * half / spacing) + 1)).tolist()


def _ring(radius: float, spacing: float) -> list[tuple[float, float]]:
    """Points x, y on a circle [m]; its centre if the radius is 0."""
    count = max(12, 4 * math.ceil(0.5 * math.pi * radius / spacing)) if radius else 1
    return [(radius * math.cos(a), radius * math.sin(a)) for a in (2.0 * math.pi * i / count for i in range(count))]


_POINTS: dict[int, Callable[[Points, float], list[tuple[float, ...]]]] = {
    _KINDS.mjGEOM_SPHERE: lambda size, spacing: [(0.0, 0.0, 0.0)],
    _KINDS.mjGEOM_CAPSULE: lambda size, spacing: [(0.0, 0.0, z) for z in _spaced(size[1], spacing)],
    _KINDS.mjGEOM_BOX: _on_box,
    _KINDS.mjGEOM_CYLINDER: _on_cylinder,
    _KINDS.mjGEOM_ELLIPSOID: _on_ellipsoid,
}


# ---- lowest points, and new sites


def surfaces(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[str]) -> dict[str, Points]:
    """Geom -> points on its underside [m, world frame]."""
    points: dict[str, Points] = {}
    for name in geoms:
        geom = model.geom(name).id
        places, radius = spheres_on(model, geom, SPACING)
        points[name] = data.geom_xpos[geom] + places @ data.geom_xmat[geom].reshape(3, 3).T - [0.0, 0.0, radius]
    return points


def add_sites(
    spec: mujoco.MjSpec, sites: Mapping[str, Sequence[str]], angles: Sequence[float], where: str, notes: list[str]
) -> None:
    """Add the sites (name -> geoms) that are not in ``spec``, at the joint angles ``angles`` (D,) [rad].

    A site of one geom is at its centre. A site of several geoms is in the middle of their lowest points, on the lowest
    body. Raises ModelError for a missing site without geoms.
    """
    missing = {name: geoms for name, geoms in sites.items() if spec.site(name) is None}
    if not missing:
        return
    copy = spec.copy()
    copy.compiler.fusestatic = False
    model = copy.compile()
    data = posed(model, angles)
    for name, geoms in missing.items():
        if not geoms:
            raise ModelError(f"site '{name}' is not in {where} and no geom is given for it")
        if len(geoms) == 1:
            geom, place = geoms[0], model.geom(geoms[0]).pos
        else:
            geom, place = _lowest(model, data, geoms)
        spec.geom(geom).parent.add_site(name=name, pos=place, group=3)  # viewers hide group 3
        notes.append(f"site '{name}' made at {'the lowest point of ' if len(geoms) > 1 else ''}{', '.join(geoms)}")


def _lowest(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[str]) -> tuple[str, np.ndarray]:
    """The geom with the lowest point, and the middle of the lowest points of its body [m, body frame]."""
    points = surfaces(model, data, geoms)
    lowest = min(points, key=lambda name: round(points[name][:, 2].min(), 6))  # the first one of equal height
    body = model.geom(lowest).bodyid[0]
    there = np.concatenate([places for name, places in points.items() if model.geom(name).bodyid[0] == body])
    low = there[there[:, 2] < there[:, 2].min() + _LEVEL]
    middle = 0.5 * (low.min(axis=0) + low.max(axis=0))
    return lowest, (middle - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
