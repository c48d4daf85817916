"""What every picture of a robot shares: its pose from `qpos`, where the camera stands, and the two velocity arrows.

Draws into a `mujoco.MjvScene` that somebody else owns; opens no window, no file and no OpenGL context.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from legged_mw.utils.errors import UserError

COMMAND_RGBA = (0.90, 0.38, 0.00, 1.0)  # ours: vermillion and sky blue of Okabe and Ito's palette, which the colour-blind tell apart
VELOCITY_RGBA = (0.20, 0.62, 0.95, 1.0)

ARROW_PER_SPEED = 1.3  # [robot radius per m/s] arrow length: at 1 m/s a little more than the robot is long from base to nose
ARC_PER_RATE = 1.0  # [rad per rad/s] the turn arrow shows one second of turning, at most ARC_MAX of it
ARC_MAX = 1.75 * math.pi  # [rad]
ARC_SEGMENTS = 12
SPEED_MIN, RATE_MIN = 0.03, 0.05  # [m/s], [rad/s] below these an arrow is a speck that flickers
AZIMUTH, ELEVATION = 130.0, -22.0  # [deg] front right of the robot, a little above it
DISTANCE = 2.4  # [robot radius] camera to base
FOLLOW_XY, FOLLOW_Z = 0.12, 0.04  # share of the way to the base per frame; slower in z, so that steps do not shake the picture
GROUPS_SHOWN = 3  # geom groups 0 ground, 1 and 2 what is meant to be seen; from 3 on collision shapes
JUMP = 3.0  # [robot radius] a base this far from where the camera looks was reset, not walked: cut instead of a swish

FloatArray = NDArray[np.float64]


class ViewError(UserError, RuntimeError):
    """Nothing can be shown or recorded as asked; the text says what this machine lacks and what to do."""


class Puppet:
    """A robot posed by `qpos` alone: kinematics and no dynamics. `radius` and `top` measure it in its first pose."""

    def __init__(self, model: mujoco.MjModel) -> None:
        if model.njnt == 0 or model.jnt_type[0] != mujoco.mjtJoint.mjJNT_FREE:
            first = "no joint at all" if model.njnt == 0 else f"{model.joint(0).name!r}, which is not one"
            raise ValueError(f"A viewer follows the robot's free joint, which must be the model's first joint; found {first}.")
        self.model = model
        self.data = mujoco.MjData(model)
        self.base = int(model.jnt_bodyid[0])
        self._forward()
        self.radius, self.top = self._measure()

    def pose(self, qpos: ArrayLike) -> None:
        """Copy `qpos` (nq,) and place every body, light and camera accordingly."""
        array = np.asarray(qpos, dtype=np.float64)
        if array.shape != (self.model.nq,):
            raise ValueError(f"qpos has shape {array.shape}; this model has nq = {self.model.nq}, so ({self.model.nq},) is needed.")
        if not np.isfinite(array).all():
            raise ValueError(f"qpos[{int(np.flatnonzero(~np.isfinite(array))[0])}] is not finite: the simulation diverged.")
        self.data.qpos[:] = array
        self._forward()

    @property
    def position(self) -> FloatArray:
        """Base position (3,) [m], world frame, a copy."""
        return np.array(self.data.xpos[self.base])

    @property
    def heading(self) -> float:
        """Direction in which the base's x axis points on the ground [rad]."""
        rotation = self.data.xmat[self.base]
        return math.atan2(rotation[3], rotation[0])

    def _forward(self) -> None:
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)  # tracking cameras and lights aim at the centre of mass
        mujoco.mj_camlight(self.model, self.data)

    def _measure(self) -> tuple[float, float]:
        """Largest distance of the robot's shown geometry from its base, and its height above the base [m]."""
        model, data, radius, top = self.model, self.data, 0.0, 0.0
        robot = model.body_rootid[model.geom_bodyid] == model.body_rootid[self.base]
        for geom in np.flatnonzero(robot & (model.geom_group < GROUPS_SHOWN)):
            rotation = data.geom_xmat[geom].reshape(3, 3)
            centre = data.geom_xpos[geom] + rotation @ model.geom_aabb[geom, :3] - data.xpos[self.base]
            half = np.abs(rotation) @ model.geom_aabb[geom, 3:]
            radius = max(radius, float(np.linalg.norm(np.abs(centre) + half)))
            top = max(top, float(centre[2] + half[2]))
        return (radius or 0.5), top  # a robot without geometry still needs a camera distance


class FollowCamera:
    """A free camera that stands at three quarters of the robot and glides after its base."""

    def __init__(self, puppet: Puppet) -> None:
        self.puppet = puppet
        self.camera = mujoco.MjvCamera()
        self._placed = False

    def update(self) -> mujoco.MjvCamera:
        """Move one frame's share towards the base; cut to it at the start and after a jump."""
        target, camera = self.puppet.position, self.camera
        gap = target - camera.lookat
        if not self._placed or float(np.linalg.norm(gap)) > JUMP * self.puppet.radius:
            place_camera(camera, self.puppet)
            self._placed = True
        else:
            camera.lookat[:] += gap * (FOLLOW_XY, FOLLOW_XY, FOLLOW_Z)
        return camera


def place_camera(camera: mujoco.MjvCamera, puppet: Puppet) -> None:
    """Look at the base from its front right, wherever it heads now."""
    camera.lookat[:] = puppet.position
    camera.distance = DISTANCE * puppet.radius
    camera.azimuth = math.degrees(puppet.heading) + AZIMUTH
    camera.elevation = ELEVATION


def set_options(option: mujoco.MjvOption) -> None:
    """Show the groups that are meant to be seen; hide collision shapes and sites."""
    option.geomgroup[:] = [group < GROUPS_SHOWN for group in range(len(option.geomgroup))]
    option.sitegroup[:] = 0


def draw_velocities(scene: mujoco.MjvScene, puppet: Puppet, command: ArrayLike | None, velocity: ArrayLike | None) -> None:
    """Append the commanded and the measured velocity, each (vx, vy, yaw rate) in the body frame, above the trunk."""
    for value, rgba, level in ((command, COMMAND_RGBA, 0.40), (velocity, VELOCITY_RGBA, 0.28)):
        if value is None:
            continue
        array = np.asarray(value, dtype=np.float64)
        if array.shape != (3,):
            raise ValueError(f"A velocity to draw is (vx, vy, yaw rate), shape (3,); got shape {array.shape}.")
        origin = puppet.position + (0.0, 0.0, puppet.top + level * puppet.radius)
        _draw_straight(scene, puppet, origin, array, rgba)
        _draw_turn(scene, puppet, origin, array[2], rgba)


def _draw_straight(scene: mujoco.MjvScene, puppet: Puppet, origin: FloatArray, velocity: FloatArray, rgba: tuple[float, ...]) -> None:
    """An arrow along (vx, vy); level even when the trunk is not, for commands are meant in the plane."""
    if math.hypot(velocity[0], velocity[1]) < SPEED_MIN:
        return
    cos, sin = math.cos(puppet.heading), math.sin(puppet.heading)
    along = np.array([cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1], 0.0])
    tip = origin + ARROW_PER_SPEED * puppet.radius * along
    _add(scene, mujoco.mjtGeom.mjGEOM_ARROW, 0.03 * puppet.radius, origin, tip, rgba)


def _draw_turn(scene: mujoco.MjvScene, puppet: Puppet, origin: FloatArray, rate: float, rgba: tuple[float, ...]) -> None:
    """A bent arrow around the vertical: it starts in front of the robot and turns with the yaw rate."""
    if abs(rate) < RATE_MIN:
        return
    angle = math.copysign(min(ARC_PER_RATE * abs(rate), ARC_MAX), rate)
    angles = puppet.heading + np.linspace(0.0, angle, ARC_SEGMENTS + 1)
    ring = 0.5 * puppet.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1) + origin
    width = 0.016 * puppet.radius
    for start, end in zip(ring[:-1], ring[1:], strict=True):
        _add(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, width, start, end, rgba)
    tangent = math.copysign(1.0, rate) * np.array([-math.sin(angles[-1]), math.cos(angles[-1]), 0.0])
    _add(scene, mujoco.mjtGeom.mjGEOM_ARROW, 2.0 * width, ring[-1], ring[-1] + 0.13 * puppet.radius * tangent, rgba)


def _add(scene: mujoco.MjvScene, kind: int, width: float, start: FloatArray, end: FloatArray, rgba: tuple[float, ...]) -> None:
    """One connector geom; dropped silently where the scene is full, as MuJoCo does with its own."""
    if scene.ngeom >= scene.maxgeom:
        return
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), np.asarray(rgba, dtype=np.float32))
    mujoco.mjv_connector(geom, kind, width, start, end)
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow on the robot
    geom.emission = 0.5  # reads the same in shade
    scene.ngeom += 1
