"""Robots placed by `qpos` alone: kinematics, no dynamics. Opens no window, no file and no OpenGL context."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import copy
import math
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from legged_mw.view.rough_ground import RoughGround, height_fields
from legged_mw.view.stage import FloatArray

GROUPS_SHOWN = 3  # geom groups 0 ground, 1 and 2 visuals; from 3 on collision shapes
SHADOW_MAX, SHADOW_SIZE = 8.0, 4096  # [extent] half-width of the shadow map, [px] its edge: 4 mm a pixel at the most
SPACING = 3.0  # [robot radius] between robots that stand side by side


class Placement(NamedTuple):
    """Where a robot is in the picture."""

    position: FloatArray  # of its base (3,) [m]
    heading: float  # of its x axis on the ground [rad]
    radius: float  # its size [m]
    top: float  # its height above its base [m]


class PosedRobot:
    """One robot. `radius` and `top` are measured in the model's first pose."""

    def __init__(self, model: mujoco.MjModel) -> None:
        if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            first = "no joint at all" if model.njnt == 0 else f"{model.joint(0).name!r}, which is not one"
            raise ValueError(f"A viewer follows the robot's free joint, which must be the model's first joint; found {first}.")
        self.model = model
        self.data = mujoco.MjData(model)
        self.base = int(model.jnt_bodyid[0])
        self._forward()
        self.radius, self.top = self._measure()

    def pose(self, qpos: ArrayLike, offset: ArrayLike = 0.0) -> Placement:
        """Place all bodies, lights and cameras by `qpos` (nq,), with the base moved by `offset` (3,) [m]."""
        array = np.asarray(qpos, dtype=np.float64)
        if array.shape != (self.model.nq,):
            raise ValueError(f"qpos has shape {array.shape}; this model has nq = {self.model.nq}, so ({self.model.nq},) is needed.")
        if not np.isfinite(array).all():
            raise ValueError(f"qpos[{int(np.flatnonzero(~np.isfinite(array))[0])}] is not finite: the simulation diverged.")
        self.data.qpos[:] = array
        self.data.qpos[:3] += offset
        self._forward()
        rotation = self.data.xmat[self.base]
        return Placement(np.array(self.data.xpos[self.base]), math.atan2(rotation[3], rotation[0]), self.radius, self.top)

    def _forward(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # tracking cameras and lights aim at the centre of mass
        mujoco.mj_camlight(self.model, self.data)

    def lowest(self, geom: int) -> FloatArray:
        """The point (3,) below the middle of a geom, at its lowest height [m]."""
        centre, half = self._box(geom)
        return centre - (0.0, 0.0, min(half[2], self.model.geom_rbound[geom]))  # a sphere's box grows as it turns

    def _box(self, geom: int) -> tuple[FloatArray, FloatArray]:
        """Centre and half edges of the upright box around a geom, (3,) each [m]."""
        rotation, box = self.data.geom_xmat[geom].reshape(3, 3), self.model.geom_aabb[geom]
        return self.data.geom_xpos[geom] + rotation @ box[:3], np.abs(rotation) @ box[3:]

    def _measure(self) -> tuple[float, float]:
        """Largest distance of the visible geometry from the base, and its height above the base [m]."""
        model, radius, top = self.model, 0.0, 0.0
        robot = model.body_rootid[model.geom_bodyid] == model.body_rootid[self.base]
        for geom in map(int, np.flatnonzero(robot & (model.geom_group < GROUPS_SHOWN))):
            centre, half = self._box(geom)
            centre = centre - self.data.xpos[self.base]
            radius = max(radius, float(np.linalg.norm(np.abs(centre) + half)))
            top = max(top, float(centre[2] + half[2]))
        return (radius or 0.5), top  # a robot without geometry still needs a camera distance


class PosedRobots:
    """All robots of one picture. `data` holds the followed one, whose `base` a camera can track; `add_others` draws the rest.

    They stand side by side, `offsets` (N, 3) apart. On rough ground each stays where it is.
    """

    def __init__(self, model: mujoco.MjModel, count: int = 1) -> None:
        self.count, self.model = count, copy.copy(model)  # its shadows and colours change here, the caller's stay
        self._followed, self._other = PosedRobot(self.model), PosedRobot(self.model)
        self.data, self.base, self.radius = self._followed.data, self._followed.base, self._followed.radius
        self.feet = contact_geoms(model)
        self.foot_radius = float(np.median(model.geom_aabb[self.feet[0], 3:])) if self.feet else 0.0  # of the first one [m]
        rough = has_places(model)
        self.offsets = np.zeros((count, 3)) if rough else side_by_side(count, SPACING * self.radius)
        if count > 1 and not rough:  # one shadow map for all; on rough ground they are too far apart
            width = math.ceil(math.sqrt(count)) * SPACING * 0.5 / max(model.stat.extent, 1e-6)
            vis = self.model.vis
            vis.map.shadowclip = min(max(vis.map.shadowclip, width), SHADOW_MAX)
            vis.quality.shadowsize = max(vis.quality.shadowsize, SHADOW_SIZE)
        self._below_feet = np.zeros((count, len(self.feet), 3))
        self.pose(np.tile(model.qpos0, (count, 1)))  # a window may draw before the first moment is shown
        self.ground = RoughGround(self.model, self.data) if len(height_fields(model)) else None

    def pose(self, qpos: ArrayLike, world: int = 0) -> None:
        """Place all robots by the rows of `qpos` (N, nq), and follow robot `world`."""
        self._qpos, self._world = np.atleast_2d(np.array(qpos, dtype=np.float64)), world
        self.placements: list[Placement] = []
        for index in range(self.count):
            robot = self._followed if index == world else self._other
            self.placements.append(robot.pose(self._qpos[index], self.offsets[index]))
            self._place(index, robot)

    def _place(self, index: int, robot: PosedRobot) -> None:
        """Keep what the picture needs of the robot that was just posed."""
        for foot, geom in enumerate(self.feet):
            self._below_feet[index, foot] = robot.lowest(geom)

    def add_others(self, scene: mujoco.MjvScene, option: mujoco.MjvOption) -> None:
        """Append every robot but the followed one to `scene`."""
        for index in range(self.count):
            if index != self._world:
                self._other.pose(self._qpos[index], self.offsets[index])
                mujoco.mjv_addGeoms(self.model, self._other.data, option, mujoco.MjvPerturb(), mujoco.mjtCatBit.mjCAT_DYNAMIC, scene)

    def below_feet(self, contacts: ArrayLike) -> FloatArray:
        """Points (M, 3) below the geoms that `contacts` (N, G) marks, the first G with a contact sensor."""
        touching = np.asarray(contacts, dtype=bool)[: self.count]
        feet = self._below_feet[:, : touching.shape[1]]
        if touching.shape != feet.shape[:2]:
            return np.zeros((0, 3))  # the model has fewer contact sensors
        return feet[touching]


def contact_geoms(model: mujoco.MjModel) -> list[int]:
    """The geoms of the model's contact sensors, in the sensors' order."""
    geom = int(mujoco.mjtObj.mjOBJ_GEOM)
    contact = int(mujoco.mjtSensor.mjSENS_CONTACT)
    return [int(model.sensor_objid[i]) for i in range(model.nsensor) if model.sensor_type[i] == contact and model.sensor_objtype[i] == geom]


def has_places(model: mujoco.MjModel) -> bool:
    """Whether the ground is more than planes, so that it matters where a robot is."""
    fixed = model.body_weldid[model.geom_bodyid] == 0
    return bool((fixed & (model.geom_group < GROUPS_SHOWN) & (model.geom_type != mujoco.mjtGeom.mjGEOM_PLANE)).any())


def side_by_side(count: int, spacing: float) -> FloatArray:
    """Places (N, 3) on a square grid [m], the first at the origin, the others ahead of it and to its left."""
    columns = math.ceil(math.sqrt(count))
    index = np.arange(count)
    return np.stack([index // columns, index % columns, np.zeros(count)], axis=1).astype(np.float64) * spacing


def show_groups(option: mujoco.MjvOption) -> None:
    """Show the visuals; hide collision shapes and sites."""
    option.geomgroup[:] = [group < GROUPS_SHOWN for group in range(len(option.geomgroup))]
    option.sitegroup[:] = 0
