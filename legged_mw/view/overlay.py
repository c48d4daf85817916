"""Extra geoms of a picture: velocity arrows, foot contacts, positions of falls, and the reference motion as ghosts.

Appends to a `mujoco.MjvScene`. Opens no window, no file and no OpenGL context.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from legged_mw.view.posed_robot import Patch, Placement, PosedRobots, show_groups
from legged_mw.view.stage import FloatArray, Moment

# ours: vermillion, sky blue, bluish green and reddish purple of Okabe and Ito's palette, safe for the colour-blind
COMMAND_RGBA = (0.90, 0.38, 0.00, 1.0)
VELOCITY_RGBA = (0.20, 0.62, 0.95, 1.0)
CONTACT_RGBA = (0.00, 0.75, 0.52, 0.9)
FALL_RGBA = (0.90, 0.20, 0.45, 0.45)
GHOST_RGBA = (0.55, 0.75, 0.95, 0.3)  # ours: pale blue

# [robot radius per m/s] arrow length. MuJoCo draws half of it: at 1 m/s a little more than from base to nose.
ARROW_PER_SPEED = 1.3
ARROW_MAX = 1.95  # [robot radius] length for the fastest command; a longer arrow would leave the picture
LEVELS = (0.36, 0.24)  # [robot radius] height above the robot's top of commanded and measured velocity
ARC_PER_RATE = 1.0  # [rad per rad/s] the arc shows the turn of one second, at most ARC_MAX
ARC_MAX = 1.75 * math.pi  # [rad]
ARC_SEGMENTS = 12
DISC = 0.006  # [robot radius] half thickness of a disc below a foot
SPEED_MIN, RATE_MIN = 0.03, 0.05  # [m/s], [rad/s] smaller velocities get no arrow: it would flicker
ROBOTS_WITH_ARROWS = 32  # at most: more arrows would hide the robots


def draw(scene: mujoco.MjvScene, robots: PosedRobots, moment: Moment) -> None:
    """Append all geoms of `moment` to `scene`, which already has the robots."""
    for world in range(min(robots.count, ROBOTS_WITH_ARROWS)):
        target, velocity, turn = moment.target_velocity[world], moment.velocity[world], world == moment.world
        draw_velocities(scene, robots.placements[world], target, velocity, turn, moment.top_speed)
    _draw_contacts(scene, robots, moment)
    if moment.ghost is not None:
        _draw_ghosts(scene, robots, moment.ghost)
    for fall in moment.falls:
        if fall.world < robots.count:
            place, size = fall.place + robots.offsets[fall.world], (0.35 * robots.radius,) * 3
            _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, size, place, FALL_RGBA, "fell")


def draw_velocities(
    scene: mujoco.MjvScene,
    placement: Placement,
    target: ArrayLike,
    velocity: ArrayLike,
    turn: bool = True,
    top_speed: float = 1.0,
) -> None:
    """Append arrows above the robot for the commanded and the measured velocity, (vx, vy, yaw rate) in the body frame.

    A component with target NaN gets no arrow. `turn`: draw the yaw rate too. `top_speed` [m/s]: gets the longest arrow.
    """
    target, velocity = np.asarray(target, dtype=np.float64), np.asarray(velocity, dtype=np.float64)
    for array, rgba, level in ((target, COMMAND_RGBA, LEVELS[0]), (velocity, VELOCITY_RGBA, LEVELS[1])):
        origin = placement.position + (0.0, 0.0, placement.top + level * placement.radius)
        if not np.isnan(target[:2]).any():
            _draw_straight(scene, placement, origin, array, min(ARROW_PER_SPEED, ARROW_MAX / top_speed), rgba)
        if turn and not np.isnan(target[2]):
            _draw_turn(scene, placement, origin, array[2], rgba)


def _draw_straight(
    scene: mujoco.MjvScene,
    placement: Placement,
    origin: FloatArray,
    velocity: FloatArray,
    per_speed: float,
    rgba: tuple[float, ...],
) -> None:
    """Append an arrow along (vx, vy). It is horizontal even if the trunk tilts. `per_speed`: [robot radius per m/s]."""
    speed = math.hypot(velocity[0], velocity[1])
    if speed < SPEED_MIN:
        return
    per_speed = min(per_speed, 1.1 * ARROW_MAX / speed)  # a pushed robot can be faster than any command
    cos, sin = math.cos(placement.heading), math.sin(placement.heading)
    along = np.array([cos * velocity[0] - sin * velocity[1], sin * velocity[0] + cos * velocity[1], 0.0])
    tip = origin + per_speed * placement.radius * along
    connect(scene, mujoco.mjtGeom.mjGEOM_ARROW, 0.03 * placement.radius, origin, tip, rgba)


def _draw_turn(
    scene: mujoco.MjvScene, placement: Placement, origin: FloatArray, rate: float, rgba: tuple[float, ...]
) -> None:
    """Append a bent arrow around the vertical. It starts in front of the robot and turns with the yaw rate."""
    if abs(rate) < RATE_MIN:
        return
    angle = math.copysign(min(ARC_PER_RATE * abs(rate), ARC_MAX), rate)
    angles = placement.heading + np.linspace(0.0, angle, ARC_SEGMENTS + 1)
    ring = 0.5 * placement.radius * np.stack([np.cos(angles), np.sin(angles), np.zeros_like(angles)], axis=1) + origin
    width = 0.016 * placement.radius
    for start, end in zip(ring[:-1], ring[1:], strict=True):
        connect(scene, mujoco.mjtGeom.mjGEOM_CAPSULE, width, start, end, rgba)
    tangent = math.copysign(1.0, rate) * np.array([-math.sin(angles[-1]), math.cos(angles[-1]), 0.0])
    connect(
        scene, mujoco.mjtGeom.mjGEOM_ARROW, 2.0 * width, ring[-1], ring[-1] + 0.13 * placement.radius * tangent, rgba
    )


def _draw_contacts(scene: mujoco.MjvScene, robots: PosedRobots, moment: Moment) -> None:
    """Append a disc under each foot in contact, with the length and width of its contact patch."""
    thick = DISC * robots.radius
    for place, turn, half in robots.patches(moment.contacts):
        draw_disc(scene, Patch(place + (0.0, 0.0, 1.3 * thick), turn, half), thick, CONTACT_RGBA)


def draw_disc(scene: mujoco.MjvScene, patch: Patch, thick: float, rgba: tuple[float, ...]) -> None:
    """Append a horizontal disc at the patch. ``thick``: half thickness [m]."""
    disc = _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (patch.half[0], thick, 0.0), patch.place, rgba)
    if disc is not None:
        disc.size[1] = patch.half[1]
        disc.mat[:] = patch.turn


def _draw_ghosts(scene: mujoco.MjvScene, robots: PosedRobots, qpos: FloatArray) -> None:
    """Append a transparent robot at each reference pose."""
    first, option = scene.ngeom, mujoco.MjvOption()
    show_groups(option)
    moving = mujoco.mjtCatBit.mjCAT_DYNAMIC.value
    mujoco.mjv_addGeoms(robots.model, robots.ghost(qpos), option, mujoco.MjvPerturb(), moving, scene)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:], geom.matid, geom.category = GHOST_RGBA, -1, mujoco.mjtCatBit.mjCAT_DECOR


def connect(
    scene: mujoco.MjvScene, kind: int, width: float, start: FloatArray, end: FloatArray, rgba: tuple[float, ...]
) -> None:
    """Append a capsule or an arrow from ``start`` to ``end``. MuJoCo draws an arrow at half of that length."""
    geom = _add(scene, kind, (0.0, 0.0, 0.0), start, rgba)
    if geom is not None:
        mujoco.mjv_connector(geom, kind, width, start, end)


def _add(
    scene: mujoco.MjvScene,
    kind: int,
    size: tuple[float, ...],
    place: FloatArray,
    rgba: tuple[float, ...],
    label: str = "",
) -> mujoco.MjvGeom | None:
    """Append one geom; None if the scene is full."""
    if scene.ngeom >= scene.maxgeom:
        return None
    geom = scene.geoms[scene.ngeom]
    mujoco.mjv_initGeom(geom, kind, np.array(size), place, np.eye(3).ravel(), np.asarray(rgba, dtype=np.float32))
    geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow on the robot
    geom.emission = 0.5  # same colour in shadow
    geom.label = label
    scene.ngeom += 1
    return geom
