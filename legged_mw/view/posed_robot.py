"""Robots posed by `qpos`, their contact patches and the ground: kinematics only. Opens no window, no OpenGL context."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from legged_mw.view.stage import FloatArray

GROUPS_SHOWN = 3  # geom groups 0 ground, 1 and 2 visuals; from 3 on collision shapes
SHADOW_MAX, SHADOW_SIZE = 8.0, 4096  # shadow map: half width [extent], edge [px]; at most 4 mm per pixel
# elements to delete, because attaching copies of a body would copy them too
SEVERAL_WITHOUT = ("sensors", "actuators", "equalities", "tendons", "pairs", "excludes")
PLAIN = (0.55, 0.57, 0.60, 1.0)  # colour of a link without visuals
SPACING = 3.0  # [robot radius] distance between robots side by side


class Placement(NamedTuple):
    """The place and the extent of a robot in the picture."""

    position: FloatArray  # (3,) [m] of the base
    heading: float  # [rad] of the base's x axis, about the vertical
    radius: float  # [m] size of the robot
    top: float  # [m] top of the robot above its base
    bottom: float = 0.0  # [m] lowest point below its base


class PosedRobots:
    """All robots of one picture as one `model` with its `data`, without dynamics.

    The first joint of `spec` must be the robot's free joint. The followed robot is always the first one in the model, so
    lights and cameras follow it and a camera can track its body `base`. `offsets` (N, 3) [m] place the robots side by
    side; on rough terrain they are zero. `radius`, `top` and `bottom` [m] are measured in the model's first pose.
    """

    def __init__(self, spec: mujoco.MjSpec, count: int = 1) -> None:
        single = spec.compile()
        self.count = count
        self.model, self._bases, self._feet = many_robots(spec, single, count)
        self.data, self.base = mujoco.MjData(self.model), self._bases[0]
        self._ghost: mujoco.MjData | None = None  # created for the first ghost
        self._forward()
        self.radius, self.top, self.bottom = self._measure()
        self.feet = self._feet[0]
        rough = has_places(self.model)
        self.offsets = np.zeros((count, 3)) if rough else side_by_side(count, SPACING * self.radius)
        if count > 1 and not rough:  # one shadow map for all; on rough terrain the robots are too far apart
            width = math.ceil(math.sqrt(count)) * SPACING * 0.5 / max(single.stat.extent, 1e-6)
            vis = self.model.vis
            vis.map.shadowclip = min(max(vis.map.shadowclip, width), SHADOW_MAX)
            vis.quality.shadowsize = max(vis.quality.shadowsize, SHADOW_SIZE)
        self.pose(np.tile(single.qpos0, (count, 1)))  # a window may draw before the first moment
        self.ground = RoughGround(self.model, self.data) if len(height_fields(self.model)) else None

    def pose(self, qpos: ArrayLike, world: int = 0) -> None:
        """Pose all robots by the rows of `qpos` (N, nq), and follow robot `world`."""
        array = np.atleast_2d(np.array(qpos, dtype=np.float64))[: self.count]
        if not np.isfinite(array).all():
            raise ValueError(
                f"qpos[{int(np.argwhere(~np.isfinite(array))[0, 1])}] is not finite: the simulation diverged."
            )
        array[:, :3] += self.offsets
        # index of the robot for each copy in the model
        self._order = [world, *(index for index in range(self.count) if index != world)]
        self.data.qpos[:] = array[self._order].ravel()
        self._forward()
        self.placements: list[Placement] = [self._placement(self._order.index(index)) for index in range(self.count)]

    def ghost(self, qpos: ArrayLike) -> mujoco.MjData:
        """The same robots posed by the rows of `qpos` (N, nq), in the order of the last `pose`."""
        array = np.array(qpos, dtype=np.float64)[: self.count]
        array[:, :3] += self.offsets
        data = self._ghost = self._ghost or mujoco.MjData(self.model)
        data.qpos[:] = array[self._order].ravel()
        mujoco.mj_kinematics(self.model, data)
        return data

    def patches(self, contacts: ArrayLike) -> list[Patch]:
        """The patches of the feet in contact. `contacts`: mask (N, G) of the first G geoms with a contact sensor."""
        touching = np.asarray(contacts, dtype=bool)[: self.count]
        if len(touching) < self.count or touching.shape[1] > len(self.feet):
            return []  # the model has fewer contact sensors
        result = []
        for world, marked in enumerate(touching):
            geoms = self._feet[self._order.index(world)][: len(marked)]
            for foot in feet_of(self.model, geoms):
                if down := [geoms[place] for place in foot if marked[place]]:
                    result.append(patch(self.model, self.data, down, self.radius))
        return result

    def _forward(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # tracking cameras and lights aim at the centre of mass
        mujoco.mj_camlight(self.model, self.data)

    def _placement(self, copy: int) -> Placement:
        body = self._bases[copy]
        rotation = self.data.xmat[body]
        return Placement(
            np.array(self.data.xpos[body]), math.atan2(rotation[3], rotation[0]), self.radius, self.top, self.bottom
        )

    def _measure(self) -> tuple[float, float, float]:
        """Extent of a robot's visuals and feet from its base [m]: largest distance, height above, depth below."""
        model = self.model
        robot = model.body_rootid[model.geom_bodyid] == model.body_rootid[self.base]
        seen = {*map(int, np.flatnonzero(robot & (model.geom_group < GROUPS_SHOWN))), *self._feet[0]}
        centres, halves = boxes(model, self.data, sorted(seen))
        centres = centres - self.data.xpos[self.base]
        radius = float(np.linalg.norm(np.abs(centres) + halves, axis=1).max(initial=0.0))
        top, bottom = (float(edges[:, 2].max(initial=0.0)) for edges in (centres + halves, halves - centres))
        return (radius or 0.5), top, bottom  # a robot without geometry still needs a camera distance


def boxes(model: mujoco.MjModel, data: mujoco.MjData, geoms: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Centres and half edges (G, 3) [m] of the axis-aligned boxes around ``geoms``, world frame."""
    rotation, box = data.geom_xmat[geoms].reshape(-1, 3, 3), model.geom_aabb[geoms]
    centres = data.geom_xpos[geoms] + (rotation @ box[:, :3, None])[..., 0]
    return centres, (np.abs(rotation) @ box[:, 3:, None])[..., 0]


def many_robots(
    spec: mujoco.MjSpec, single: mujoco.MjModel, count: int
) -> tuple[mujoco.MjModel, list[int], list[list[int]]]:
    """A model for drawing: `count` copies of the robot of `spec`. Nothing collides; one copy has lights and cameras.

    Also returns the base of each copy, and for each copy the geoms with a contact sensor, in the order of the sensors.
    """
    spec = spec.copy()
    contact, geom = mujoco.mjtSensor.mjSENS_CONTACT, mujoco.mjtObj.mjOBJ_GEOM
    feet = [sensor.objname for sensor in spec.sensors if sensor.type == contact and sensor.objtype == geom]
    for kind in ("keys", *(SEVERAL_WITHOUT if count > 1 else ())):
        for element in getattr(spec, kind):
            spec.delete(element)
    for body in spec.bodies[1:]:
        # a body without visuals: show its collision shapes
        if all(shape.group >= GROUPS_SHOWN for shape in body.geoms):
            for shape in body.geoms:
                shape.group, shape.rgba = GROUPS_SHOWN - 1, PLAIN
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.stat.extent, spec.stat.meansize = single.stat.extent, single.stat.meansize
    spec.stat.center = single.stat.center
    spec.copy_during_attach = True
    bases = [spec.joints[0].parent]
    for index in range(1, count):
        bases.append(spec.worldbody.add_frame().attach_body(bases[0], f"{index}/", ""))
        for element in (*bases[-1].find_all("light"), *bases[-1].find_all("camera")):
            spec.delete(element)
    model = spec.compile()
    prefixes = ["", *(f"{index}/" for index in range(1, count))]
    return model, [body.id for body in bases], [[model.geom(prefix + name).id for name in feet] for prefix in prefixes]


def has_places(model: mujoco.MjModel) -> bool:
    """Whether the ground has more than planes, so the place of a robot matters."""
    fixed = model.body_weldid[model.geom_bodyid] == 0
    return bool((fixed & (model.geom_group < GROUPS_SHOWN) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)).any())


def side_by_side(count: int, spacing: float) -> FloatArray:
    """Places (N, 3) [m] on a square grid: the first at the origin, the others in front of it and to its left."""
    columns = math.ceil(math.sqrt(count))
    index = np.arange(count)
    return np.stack([index // columns, index % columns, np.zeros(count)], axis=1).astype(np.float64) * spacing


def show_groups(option: mujoco.MjvOption) -> None:
    """Show the visuals; hide collision shapes and sites."""
    option.geomgroup[:] = [group < GROUPS_SHOWN for group in range(len(option.geomgroup))]
    option.sitegroup[:] = 0


class RoughGround:
    """All height fields of a model, with centres (T, 2) and half edges (T, 2) [m], world frame. They do not move.

    Of two height fields at the same place, one is a coarse copy of the other and is hidden at first.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        geoms = height_fields(model)
        vertices = model.hfield_nrow * model.hfield_ncol
        found: dict[tuple[float, float], list[int]] = {}
        for geom in sorted(geoms, key=lambda geom: -vertices[model.geom_dataid[geom]]):
            x, y = np.round(data.geom_xpos[geom, :2], 6)
            found.setdefault((x, y), []).append(int(geom))
        self._model = model
        # (T,) geoms; equal if there is no coarse copy
        self.fine, self.coarse = (np.array([same[which] for same in found.values()]) for which in (0, -1))
        self.places: FloatArray = np.array(list(found))
        self.halves: FloatArray = np.array([model.hfield_size[model.geom_dataid[geom], :2] for geom in self.fine])
        self._bottoms: FloatArray = np.array(data.geom_xpos[self.fine, 2])

    def height(self, place: FloatArray) -> float:
        """Height [m] of the vertex nearest to `place` (2,) [m]; 0 outside all tiles."""
        inside = np.flatnonzero((np.abs(self.places - place) <= self.halves).all(axis=1))
        if not len(inside):
            return 0.0
        tile, model = int(inside[0]), self._model
        field = int(model.geom_dataid[self.fine[tile]])
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        share = (place - self.places[tile] + self.halves[tile]) / (2 * self.halves[tile])
        column, row = np.round(share * [columns - 1, rows - 1]).astype(int)
        vertex = model.hfield_data[model.hfield_adr[field] + row * columns + column]
        return float(vertex * model.hfield_size[field, 2] + self._bottoms[tile])

    def refine(self, place: FloatArray, reach: float) -> None:
        """Draw the fine tiles within `reach` [m] of `place` (2,) [m], and the coarse ones elsewhere."""
        near = (np.maximum(np.abs(self.places - place) - self.halves, 0.0) ** 2).sum(axis=1) < reach**2
        self._model.geom_rgba[self.coarse, 3] = ~near
        self._model.geom_rgba[self.fine, 3] = near | (self.fine == self.coarse)


def height_fields(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Indices of the geoms that are height fields."""
    return np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)


# ---- the contact patch of each foot, for any shape of its geoms

# [smallest half extent of the foot's geoms] margin around the contact points: a sphere touches at a single point
MARGIN = 2.2
MARGIN_MIN, MARGIN_MAX = 0.045, 0.15  # [robot radius]
FLAT = 0.5  # [margin] points up to this height above the lowest one count as contact: a slightly tilted sole is flat
CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))


class Patch(NamedTuple):
    """An upright ellipse on the ground."""

    place: FloatArray  # (3,) [m] its centre, at the height of the foot's lowest point
    turn: FloatArray  # (3, 3) rotation to the world frame: x is the foot's x axis on the ground, z is up
    half: FloatArray  # (2,) [m] half length, half width


def feet_of(model: mujoco.MjModel, geoms: Sequence[int]) -> list[list[int]]:
    """For each foot, the indices of its geoms in ``geoms``. The geoms of one body are one foot."""
    feet: dict[int, list[int]] = {}
    for place, geom in enumerate(geoms):
        feet.setdefault(int(model.geom_bodyid[geom]), []).append(place)
    return list(feet.values())


def patch(model: mujoco.MjModel, data: mujoco.MjData, geoms: Sequence[int], radius: float) -> Patch:
    """The patch of one foot; ``geoms`` are its geoms in contact, ``radius`` [m] is the robot's size."""
    points = np.concatenate([lowest_points(model, data, geom) for geom in geoms])
    thin = min(float(model.geom_aabb[geom, 3:].min()) for geom in geoms)
    margin = min(max(MARGIN * thin, MARGIN_MIN * radius), MARGIN_MAX * radius)
    low = float(points[:, 2].min())
    axis = data.xmat[model.geom_bodyid[geoms[0]]]
    heading = math.atan2(axis[3], axis[0])
    cos, sin = math.cos(heading), math.sin(heading)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    touching = points[points[:, 2] <= low + FLAT * margin] @ turn
    ends = np.stack([touching.min(axis=0), touching.max(axis=0)])
    place = turn @ ends.mean(axis=0)
    place[2] = low
    return Patch(place, turn, (ends[1] - ends[0])[:2] / 2 + margin)


def lowest_points(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> FloatArray:
    """Points (P, 3) [m] of a geom that include its lowest one: corners, for a box and other kinds of geom."""
    centre, rotation, size = data.geom_xpos[geom], data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
    kind, down = model.geom_type[geom], np.array([0.0, 0.0, -1.0])
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return (centre + size[0] * down)[None]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return centre + np.outer([-1.0, 1.0], rotation[:, 2] * size[1]) + size[0] * down
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        towards = size * (rotation.T @ down)
        return (centre + rotation @ (size * towards) / np.linalg.norm(towards))[None]
    box = model.geom_aabb[geom]
    return centre + (box[:3] + CORNERS * box[3:]) @ rotation.T


def lowest_point(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Height [m] of a geom's lowest point: of its bounding box, if it is a mesh or a cylinder."""
    return float(lowest_points(model, data, geom)[:, 2].min())
