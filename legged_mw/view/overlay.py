"""What is drawn into a picture besides the robots: arrows of command and velocity, feet that stand, places of falls.

Draws into a `mujoco.MjvScene` that somebody else owns; opens no window, no file and no OpenGL context.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from legged_mw.view.puppet import GROUPS_SHOWN, Anchor, Cast
from legged_mw.view.stage import FloatArray, Moment

# ours: vermillion, sky blue, bluish green and reddish purple of Okabe and Ito's palette, which the colour-blind tell apart
COMMAND_RGBA = (0.90, 0.38, 0.00, 1.0)
VELOCITY_RGBA = (0.20, 0.62, 0.95, 1.0)
CONTACT_RGBA = (0.00, 0.75, 0.52, 0.9)
FALL_RGBA = (0.90, 0.20, 0.45, 0.45)

ARROW_PER_SPEED = 1.3  # [robot radius per m/s] arrow length: at 1 m/s a little more than the robot is long from base to nose
ARC_PER_RATE = 1.0  # [rad per rad/s] the turn arrow shows one second of turning, at most ARC_MAX of it
ARC_MAX = 1.75 * math.pi  # [rad]
ARC_SEGMENTS = 12
SPEED_MIN, RATE_MIN = 0.03, 0.05  # [m/s], [rad/s] below these an arrow is a speck that flickers
ROBOTS_WITH_ARROWS = 32  # more of them would be a thicket; a web page gets some 300 bytes a geom and picture


def set_options(option: mujoco.MjvOption) -> None:
    """Show the groups that are meant to be seen; hide collision shapes and sites."""
    option.geomgroup[:] = [group < GROUPS_SHOWN for group in range(len(option.geomgroup))]
    option.sitegroup[:] = 0


def draw(scene: mujoco.MjvScene, cast: Cast, moment: Moment) -> None:
    """Append all that belongs to `moment` to what `scene` holds."""
    for world in range(min(cast.count, ROBOTS_WITH_ARROWS)):
        draw_velocities(scene, cast.anchors[world], moment.commands[world], moment.velocity[world], turn=world == moment.world)
    _draw_contacts(scene, cast, moment)
    for fall in moment.falls:
        if fall.world < cast.count:
            _draw_fall(scene, fall.place + cast.offsets[fall.world], cast.radius)


def draw_velocities(scene: mujoco.MjvScene, anchor: Anchor, command: ArrayLike, velocity: ArrayLike, turn: bool = True) -> None:
    """Append the commanded and the measured velocity, each (vx, vy, yaw rate) in the body frame, above the trunk.

    `turn`: the yaw rate too.
    """
    for value, rgba, level in ((command, COMMAND_RGBA, 0.40), (velocity, VELOCITY_RGBA, 0.28)):
        array = np.asarray(value, dtype=np.float64)
        if array.shape != (3,):
            raise ValueError(f"A velocity to draw is (vx, vy, yaw rate), shape (3,); got shape {array.shape}.")
        origin = anchor.position + (0.0, 0.0, anchor.top + level * anchor.radius)
        _draw_straight(scene, anchor, origin, array, rgba)
        if turn:
            _draw_turn(scene, anchor, origin, array[2], rgba)


def _draw_straight(scene: mujoco.MjvScene, anchor: Anchor, origin: FloatArray, velocity: FloatArray, rgba: tuple[float, ...]) -> None:
    """An arrow along (vx, vy); level even when the trunk is not, for commands are meant in the plane."""
    if math.hypot(velocity[0], velocity[1]) < SPEED_MIN:
        return
    cos, sin = math.cos(anchor.heading), math.sin(anchor.heading)
    along = np.array([cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1], 0.0])
    tip = origin + ARROW_PER_SPEED * anchor.radius * along
    _connect(scene, mujoco.mjtGeom.mjGEOM_ARROW, 0.03 * anchor.radius, origin, tip, rgba)


def _draw_turn(scene: mujoco.MjvScene, anchor: Anchor, origin: FloatArray, rate: float, rgba: tuple[float, ...]) -> None:
    """A bent arrow around the vertical: it starts in front of the robot and turns with the yaw rate."""
    if abs(rate) < RATE_MIN:
        return
    angle = math.copysign(min(ARC_PER_RATE * abs(rate), ARC_MAX), rate)
    angles = anchor.heading + np.linspace(0.0, angle, ARC_SEGMENTS + 1)
    ring = 0.5 * anchor.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1) + origin
    width = 0.016 * anchor.radius
    for start, end in zip(ring[:-1], ring[1:], strict=True):
        _connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, width, start, end, rgba)
    tangent = math.copysign(1.0, rate) * np.array([-math.sin(angles[-1]), math.cos(angles[-1]), 0.0])
    _connect(scene, mujoco.mjtGeom.mjGEOM_ARROW, 2.0 * width, ring[-1], ring[-1] + 0.13 * anchor.radius * tangent, rgba)


def _draw_contacts(scene: mujoco.MjvScene, cast: Cast, moment: Moment) -> None:
    """A disc under each foot that stands."""
    radius = cast.foot_radius()
    for place in cast.standing(moment.contacts):
        _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (2.2 * radius, 0.003, 0.0), place - (0.0, 0.0, radius - 0.004), CONTACT_RGBA)


def _draw_fall(scene: mujoco.MjvScene, place: FloatArray, radius: float) -> None:
    """A ball where the robot was when it fell, with the word."""
    _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, (0.35 * radius,) * 3, place, FALL_RGBA, "fell")


def _connect(scene: mujoco.MjvScene, kind: int, width: float, start: FloatArray, end: FloatArray, rgba: tuple[float, ...]) -> None:
    geom = _add(scene, kind, (0.0, 0.0, 0.0), start, rgba)
    if geom is not None:
        mujoco.mjv_connector(geom, kind, width, start, end)


def _add(
    scene: mujoco.MjvScene, kind: int, size: tuple[float, ...], place: FloatArray, rgba: tuple[float, ...], label: str = ""
) -> mujoco.MjvGeom | None:
    """One geom; dropped silently where the scene is full, as MuJoCo does with its own."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.array(size), place, np.eye(3).ravel(), np.asarray(rgba, dtype=np.float32))
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow on the robot
    geom.emission = 0.5  # reads the same in shade
    geom.label = label
    scene.ngeom += 1
    return geom
