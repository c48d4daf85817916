"""Triangle meshes: read .stl, .obj and .dae, reduce the number of faces, write .stl.

The files are not trusted: their size is limited, a DOCTYPE is refused, and indices are checked.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

import numpy as np

MOST_BYTES = 128 << 20  # of one mesh file: a binary .stl of 2.6 million triangles
MOST_FACES = 4_000_000  # the same for faces, with all copies by a .dae's nodes
_MOST_NODES, _DEEPEST = 10_000, 200  # of a .dae, including copies; largest depth of nesting
_STL = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
_NO_CORNERS = np.zeros((0, 3, 3))


class Triangles(NamedTuple):
    """A triangle mesh."""

    points: np.ndarray  # (V, 3) float
    faces: np.ndarray  # (F, 3) int, indices of points


def read_triangles(path: Path) -> Triangles:
    """Read a .stl or .obj in the file's unit, or a .dae in [m], which states its unit.

    Raises ValueError for a file without triangles, and for a large file.
    """
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path.stat().st_size >> 20} MiB; {MOST_BYTES >> 20} are read at most")
    readers = {".stl": _read_stl, ".obj": _read_obj, ".dae": _read_dae}
    if path.suffix.lower() not in readers:
        raise ValueError(f"no reader for {path.suffix}")
    try:
        mesh = readers[path.suffix.lower()](path)
    except (IndexError, OverflowError) as error:
        raise ValueError(f"it is no {path.suffix}: {error}") from None
    if not len(mesh.faces) or not np.isfinite(mesh.points).all():
        raise ValueError("no triangles, or numbers that are not finite")
    if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.points):
        raise ValueError("a face with a missing point")
    if len(mesh.faces) > MOST_FACES:
        raise ValueError(f"{len(mesh.faces)} triangles; {MOST_FACES} are read at most")
    return mesh


@lru_cache(maxsize=256)
def thinned(path: Path, most: int) -> Triangles:
    """``thin`` of ``read_triangles``, cached. Raises ValueError."""
    return thin(read_triangles(path), most)


def _merged(corners: np.ndarray) -> Triangles:
    """The mesh of ``corners`` (F, 3, 3), with equal points merged."""
    points, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return Triangles(points, index.reshape(-1, 3))


def _read_stl(path: Path) -> Triangles:
    content = path.read_bytes()
    count = int.from_bytes(content[80:84], "little")
    if len(content) < 84 or len(content) < 84 + count * _STL.itemsize:
        return _read_text_stl(content)
    corners = np.frombuffer(content, _STL, count, 84)["corners"]
    if not np.isfinite(corners).all():
        raise ValueError("numbers that are not finite")
    return _merged(corners.astype(float))


def _read_text_stl(content: bytes) -> Triangles:
    if not content.lstrip().startswith(b"solid"):
        raise ValueError("it is no .stl")
    rows = [line.split()[1:4] for line in content.splitlines() if line.split()[:1] == [b"vertex"]]
    if len(rows) % 3:
        raise ValueError("a triangle is not complete")
    return _merged(np.array(rows, float).reshape(-1, 3, 3))


def _read_obj(path: Path) -> Triangles:
    points, faces = list[list[str]](), list[tuple[int, int, int]]()
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        kind, *rest = line.split() or [""]
        if kind == "v":
            points.append(rest[:3])
        elif kind == "f":
            corners = [int(part.partition("/")[0]) for part in rest]
            corners = [corner - 1 if corner > 0 else len(points) + corner for corner in corners]
            faces += [(corners[0], *corners[i : i + 2]) for i in range(1, len(corners) - 1)]
    return Triangles(np.array(points, float).reshape(-1, 3), np.array(faces, int).reshape(-1, 3))


# ---- COLLADA: https://www.khronos.org/files/collada_spec_1_4.pdf, only triangles and polygons


def _read_dae(path: Path) -> Triangles:
    """All geometries of the scene with the poses of their nodes. The up axis is ignored, as in RViz."""
    root = _parse(path)
    by_id = {element.get("id"): element for element in root.iter() if element.get("id")}
    unit = root.find("asset/unit")
    scale = 1.0 if unit is None else float(unit.get("meter", 1.0))
    corners = {geometry.get("id"): _corners(geometry, by_id) for geometry in root.iter("geometry")}
    scene = root.find("library_visual_scenes/visual_scene")
    parts, count = [_NO_CORNERS], 0
    for name, place in _placed(scene, by_id):
        part = corners.get(name, _NO_CORNERS)
        count += len(part)
        if count > MOST_FACES:
            raise ValueError(f"more than {MOST_FACES} triangles")
        turned = part @ place[:3, :3].T + place[:3, 3]
        parts.append(turned[:, ::-1] if np.linalg.det(place[:3, :3]) < 0.0 else turned)  # a mirrored face is reversed
    return _merged(scale * np.concatenate(parts))


def _parse(path: Path) -> Element:
    """The tree of an XML file without namespaces. Raises ValueError for a DOCTYPE, which may define entities."""
    builder, parser = TreeBuilder(), expat.ParserCreate("utf-8")

    def refuse(*_: object) -> None:
        raise ValueError("it has a DOCTYPE")

    depth = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth
        depth += 1
        if depth > _DEEPEST:
            raise ValueError("it is nested too deeply")
        builder.start(tag.rpartition(":")[2], attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag.rpartition(":")[2])

    parser.StartDoctypeDeclHandler, parser.StartElementHandler, parser.EndElementHandler = refuse, start, end
    parser.CharacterDataHandler = builder.data
    parser.buffer_text = True
    try:
        parser.Parse(path.read_bytes(), True)
        return builder.close()
    except expat.ExpatError as error:
        raise ValueError(f"it is no XML: {error}") from None


def _placed(scene: Element | None, by_id: dict[str | None, Element]) -> Iterator[tuple[str, np.ndarray]]:
    """The geometries of a scene, each with its pose (4, 4)."""
    if scene is None:
        return
    waiting, seen = [(node, np.eye(4)) for node in scene.findall("node")], 0
    while waiting:
        node, place = waiting.pop()
        seen += 1
        if seen > _MOST_NODES:
            raise ValueError(f"more than {_MOST_NODES} nodes")
        here = place @ _transform(node)
        for instance in node.findall("instance_geometry"):
            yield instance.get("url", "")[1:], here
        inside = [by_id.get(instance.get("url", "")[1:]) for instance in node.findall("instance_node")]
        waiting += [(child, here) for child in (*node.findall("node"), *inside) if child is not None]


def _transform(node: Element) -> np.ndarray:
    """The pose (4, 4) of a node in its parent."""
    place = np.eye(4)
    for step in node:
        if step.tag not in ("matrix", "translate", "scale", "rotate"):
            continue
        numbers, turn = np.array((step.text or "").split(), float), np.eye(4)
        if not np.isfinite(numbers).all():
            raise ValueError("numbers that are not finite")
        if step.tag == "matrix":
            turn = numbers.reshape(4, 4)
        elif step.tag == "translate":
            turn[:3, 3] = numbers
        elif step.tag == "scale":
            turn[:3, :3] = np.diag(numbers)
        else:
            x, y, z = numbers[:3] / np.linalg.norm(numbers[:3])
            angle, cross = np.radians(numbers[3]), np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            turn[:3, :3] += np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross
        place = place @ turn
    return place


def _corners(geometry: Element, by_id: dict[str | None, Element]) -> np.ndarray:
    """Corners (F, 3, 3) of a geometry's triangles and polygons."""
    parts = [_NO_CORNERS]
    for part in geometry.findall("mesh/*"):
        if part.tag not in ("triangles", "polylist", "polygons"):
            continue
        inputs = part.findall("input")
        of_points = next((each for each in inputs if each.get("semantic") == "VERTEX"), None)
        if of_points is None:
            raise ValueError("a face without points")
        stride = max(int(each.get("offset", 0)) for each in inputs) + 1
        rows = [np.array((text.text or "").split(), int).reshape(-1, stride) for text in part.findall("p")]
        indices = [each[:, int(of_points.get("offset", 0))] for each in rows]
        if part.tag == "polylist":
            counts = np.array((part.findtext("vcount") or "").split(), int)
            if len(indices) != 1 or counts.min(initial=0) < 0 or counts.sum() != len(indices[0]):
                raise ValueError("polygons that do not fit their corners")
            indices = np.split(indices[0], np.cumsum(counts)[:-1])
        if part.tag == "triangles":
            triangles = np.concatenate([np.zeros((0, 3), int), *(row.reshape(-1, 3) for row in indices)])
        else:
            fans = [(row[0], row[i], row[i + 1]) for row in indices for i in range(1, len(row) - 1)]
            triangles = np.array(fans, int).reshape(-1, 3)
        points = _points(of_points, by_id)
        if len(triangles) and not 0 <= triangles.min() <= triangles.max() < len(points):
            raise ValueError("a face with a missing point")
        parts.append(points[triangles])
    return np.concatenate(parts)


def _points(vertices: Element, by_id: dict[str | None, Element]) -> np.ndarray:
    """The points (V, 3) that an input of faces refers to."""
    named = by_id.get(vertices.get("source", "")[1:])
    positions = [] if named is None else [each for each in named.findall("input") if each.get("semantic") == "POSITION"]
    source = by_id.get(positions[0].get("source", "")[1:]) if positions else None
    if source is None:
        raise ValueError("a face without points")
    accessor = source.find("technique_common/accessor")
    stride = 3 if accessor is None else int(accessor.get("stride", 3))
    return np.array((source.findtext("float_array") or "").split(), float).reshape(-1, max(stride, 1))[:, :3]


# ---- reduction


def thin(mesh: Triangles, most: int) -> Triangles:
    """Reduce to at most ``most`` faces: the points in a cell of a grid become their mean (vertex clustering)."""
    if len(mesh.faces) <= most:
        return mesh
    low, extent = mesh.points.min(axis=0), float(np.ptp(mesh.points, axis=0).max()) or 1.0
    cells = 2.0 * most**0.5  # along the longest side; a closed surface has about its square of faces
    while True:
        places = np.floor((mesh.points - low) * (cells / extent)).astype(int)
        _, index, count = np.unique(places, axis=0, return_inverse=True, return_counts=True)
        index = index.reshape(-1)
        faces = index[mesh.faces]
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
        if len(first) <= most:
            break
        cells /= 1.2
    points = np.stack([np.bincount(index, mesh.points[:, i], len(count)) / count for i in range(3)], axis=1)
    return Triangles(points, faces[np.sort(first)])


def write_stl(mesh: Triangles, path: Path) -> None:
    """Write a binary .stl."""
    faces = np.zeros(len(mesh.faces), _STL)
    faces["corners"] = mesh.points[mesh.faces]
    path.write_bytes(b"\0" * 80 + len(faces).to_bytes(4, "little") + faces.tobytes())
