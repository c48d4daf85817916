"""The ground that is added to a robot's MJCF: a plane, or the height field of a terrain, with its contact parameters."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.sim.errors import ModelError
from legged_mw.sim.level_boxes import as_boxes
from legged_mw.sim.terrain import Heights, Terrain

GROUND = "floor"  # name of the ground geom


@dataclass(frozen=True)
class Ground:
    """The plane z = 0, or a height field. Its contact parameters win over the geom's that touches it (priority 1)."""

    friction: float = 0.6  # sliding [-]
    condim: int = 3  # 1 frictionless, 3 sliding, 4 and torsional, 6 and rolling
    terrain: Terrain | None = None  # None: the plane
    boxes: bool = False  # level pieces of the terrain as boxes, in what is stepped: for MuJoCo's own engine


def add_ground(spec: mujoco.MjSpec, ground: Ground, where: str, notes: list[str]) -> None:
    """Add the plane or the height field to ``spec``."""
    if any(geom.name == GROUND for geom in spec.geoms):
        raise ModelError(f"{where} brings a geom '{GROUND}'; the ground is added to the MJCF, so leave its own out")
    floor = spec.worldbody.add_geom(name=GROUND, contype=1, conaffinity=0, priority=1, condim=ground.condim)
    floor.friction = [ground.friction, 0.005, 0.0001]
    if ground.terrain:
        rows, columns = ground.terrain.heights.shape
        spec.add_hfield(name=GROUND, nrow=rows, ncol=columns)
        floor.type, floor.hfieldname = mujoco.mjtGeom.mjGEOM_HFIELD, GROUND
        _fill_height_field(spec, ground.terrain, ground.terrain.heights)
        shape = "height field of {} x {} tiles".format(*ground.terrain.origins.shape[:2])
    else:
        floor.type, floor.size, shape = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.05], "plane"
    notes.append(f"ground: {shape}, friction {ground.friction:g}, condim {ground.condim}, priority 1")


def _fill_height_field(spec: mujoco.MjSpec, terrain: Terrain, heights: Heights) -> None:
    """Put ``heights`` (R, C) [m] on the grid of ``terrain``."""
    low, (rows, columns) = float(heights.min()), heights.shape
    span = max(float(np.ptp(heights)), 1e-3)  # MuJoCo wants some; it scales what it is given to 0..1
    field = spec.hfield(GROUND)
    field.size = [(columns - 1) * terrain.cell / 2, (rows - 1) * terrain.cell / 2, span, 1.0]
    field.userdata = ((heights - low) / span).astype(np.float32).ravel()
    spec.geom(GROUND).pos = [0.0, 0.0, low]


def replace_level_pieces(spec: mujoco.MjSpec, terrain: Terrain, notes: list[str]) -> None:
    """Sink the height field where boxes are exact: MuJoCo makes a tilted contact with every triangle that is near.

    A small sphere has up to a dozen contacts with what stays a height field, which few iterations leave far from solved.
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
    """A box between two corners (3,) [m] that touches as the ground does."""
    box, floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=(low + high) / 2, size=(high - low) / 2), spec.geom(GROUND)
    for name in ("contype", "conaffinity", "priority", "condim", "friction", "solref", "solimp"):
        setattr(box, name, getattr(floor, name))
    return box


def feel_all_ground(spec: mujoco.MjSpec) -> None:
    """Contact sensors that ask for the geom of the ground ask for all geoms of the world instead."""
    for sensor in spec.sensors:
        if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT and sensor.refname == GROUND:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, "world"
