"""Add the ground to a robot's MJCF: a plane or the height field of a terrain, with its contact parameters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.sim.terrain import LEVEL, Heights, Terrain

GROUND = "floor"  # name of the ground geom
PROBE_SPACING = 0.1  # [m] between the contact spheres of a geom on terrain, on mujoco-warp
MOST_BOXES = 1000  # largest number of boxes of a tile; a tile that needs more stays a height field


@dataclass(frozen=True)
class Ground:
    """The plane z = 0, or a height field. Contacts use its parameters, not those of the other geom (priority 1)."""

    friction: float = 0.6  # sliding [-]
    condim: int = 3  # 1 frictionless, 3 sliding, 4 also torsional, 6 also rolling
    contact_time: float = 0.0  # time constant (solref) [s]; 0: MuJoCo's 0.02
    terrain: Terrain | None = None  # None: the plane
    boxes: bool = False  # replace level pieces of the terrain by boxes, for MuJoCo's own engine
    slope: float = 0.0  # [deg] angle of gravity from -z towards x, as on a plane that slopes down along x


def add_ground(spec: mujoco.MjSpec, ground: Ground, notes: list[str]) -> None:
    """Add the plane or the height field to ``spec``."""
    floor = spec.worldbody.add_geom(name=GROUND, contype=1, conaffinity=0, priority=1, condim=ground.condim)
    floor.friction = [ground.friction, 0.005, 0.0001]
    if ground.contact_time:
        floor.solref = [ground.contact_time, 1.0]
    if ground.terrain:
        rows, columns = ground.terrain.heights.shape
        spec.add_hfield(name=GROUND, nrow=rows, ncol=columns)
        floor.type, floor.hfieldname = mujoco.mjtGeom.mjGEOM_HFIELD, GROUND
        _fill_height_field(spec, ground.terrain, ground.terrain.heights)
        shape = "height field of {} x {} tiles".format(*ground.terrain.origins.shape[:2])
    else:
        floor.type, floor.size, shape = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.05], "plane"
    notes.append(f"ground: {shape}, friction {ground.friction:g}, condim {ground.condim}, priority 1")
    if ground.slope:
        spec.option.gravity = leaning(spec.option.gravity, ground.slope)
        notes.append(f"gravity leans by {ground.slope:g} degrees, as on a slope down along x")


def leaning(gravity: Sequence[float], slope: float) -> list[float]:
    """``gravity`` (3,) in the frame of a plane that slopes down along x by ``slope`` [deg]."""
    size, angle = float(np.linalg.norm(gravity)), math.radians(slope)
    return [size * math.sin(angle), 0.0, -size * math.cos(angle)]


def _fill_height_field(spec: mujoco.MjSpec, terrain: Terrain, heights: Heights) -> None:
    """Write ``heights`` (R, C) [m], on the grid of ``terrain``, into the height field of ``spec``."""
    low, (rows, columns) = float(heights.min()), heights.shape
    span = max(float(np.ptp(heights)), 1e-3)  # MuJoCo scales the heights to 0..1 and requires a span above 0
    field = spec.hfield(GROUND)
    field.size = [(columns - 1) * terrain.cell / 2, (rows - 1) * terrain.cell / 2, span, 1.0]
    field.userdata = ((heights - low) / span).astype(np.float32).ravel()
    spec.geom(GROUND).pos = [0.0, 0.0, low]


def replace_level_pieces(spec: mujoco.MjSpec, terrain: Terrain, notes: list[str]) -> None:
    """Replace the level pieces of the height field by boxes, and lower the field under them.

    On a height field MuJoCo makes a tilted contact with every triangle near a geom, up to 12 for a small sphere. With
    few iterations the solver does not converge for them.
    """
    boxes, heights, _ = as_boxes(terrain)
    _fill_height_field(spec, terrain, heights)
    bottom = float(heights.min()) - 1.0
    for number, box in enumerate(boxes):
        add_ground_box(spec, np.array([*box.low, bottom]), np.array([*box.high, box.top])).name = f"{GROUND}/{number}"
    feel_all_ground(spec)
    for name, least in (("iterations", 20), ("ls_iterations", 50)):
        if (old := getattr(spec.option, name)) < least:
            notes.append(f"option {name}: {old:g} -> {least}, for the contacts of a height field")
            setattr(spec.option, name, least)
    notes.append(f"ground: {len(boxes)} boxes for its level pieces")


def add_ground_box(spec: mujoco.MjSpec, low: np.ndarray, high: np.ndarray) -> mujoco.MjsGeom:
    """Add a box between two corners (3,) [m], with the contact parameters of the ground."""
    floor, box_type = spec.geom(GROUND), mujoco.mjtGeom.mjGEOM_BOX
    box = spec.worldbody.add_geom(type=box_type, pos=(low + high) / 2, size=(high - low) / 2)
    for name in ("contype", "conaffinity", "priority", "condim", "friction", "solref", "solimp"):
        setattr(box, name, getattr(floor, name))
    return box


def feel_all_ground(spec: mujoco.MjSpec) -> None:
    """Let contact sensors of the ground geom sense all geoms of the world body."""
    for sensor in spec.sensors:
        if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT and sensor.refname == GROUND:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, "world"


# ---- level pieces of a terrain as boxes: MuJoCo's contacts with the top of a box are vertical


class Box(NamedTuple):
    """A block of ground with a level top."""

    low: tuple[float, float]  # corner with the lowest x, y [m, world]
    high: tuple[float, float]  # opposite corner [m, world]
    top: float  # height [m]


def as_boxes(terrain: Terrain) -> tuple[list[Box], Heights, list[str]]:
    """Boxes for tiles with few level pieces; the heights, 1 m lower under boxes; the kinds that stay a height field.

    A box ends in the middle between two vertices. There the height field has a slope of one cell's width.
    """
    heights, boxes, left = terrain.heights.copy(), [], set()
    n = round(terrain.tile / terrain.cell)
    for column, level in np.ndindex(len(terrain.kinds), terrain.levels):
        where, kind = terrain.vertices(level, column), terrain.kinds[column]
        is_level = kind in LEVEL or not np.ptp(terrain.heights[where])
        pieces = _level_pieces(np.round(terrain.heights[where], 6)) if is_level else []
        if not pieces or len(pieces) > MOST_BOXES:
            left.add(kind)
            continue
        for rows, columns, top in pieces:
            y = where[0].start + np.clip(rows, 0.5, n + 0.5) - 0.5
            x = where[1].start + np.clip(columns, 0.5, n + 0.5) - 0.5
            low, high = zip(terrain.corner[0] + x * terrain.cell, terrain.corner[1] + y * terrain.cell, strict=True)
            boxes.append(Box(low, high, top))
        inside = heights[where][1:-1, 1:-1]
        inside[...] = inside.min() - 1.0
    return boxes, heights, sorted(left)


def _level_pieces(patch: Heights) -> list[tuple[tuple[int, int], tuple[int, int], float]]:
    """Rectangles of vertices with equal height: (rows, columns, height), half-open spans; stops above MOST_BOXES."""
    taken = np.zeros(patch.shape, dtype=bool)
    pieces: list[tuple[tuple[int, int], tuple[int, int], float]] = []
    for row in range(patch.shape[0]):
        while not taken[row].all() and len(pieces) <= MOST_BOXES:
            first = int(np.argmin(taken[row]))
            differs = np.flatnonzero((patch[row, first:] != patch[row, first]) | taken[row, first:])
            last = first + int(differs[0]) if len(differs) else patch.shape[1]
            same = ((patch[row:, first:last] == patch[row, first]) & ~taken[row:, first:last]).all(axis=1)
            end = row + (int(np.argmin(same)) if not same.all() else len(same))
            taken[row:end, first:last] = True
            pieces.append(((row, end), (first, last), float(patch[row, first])))
    return pieces
