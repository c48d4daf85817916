"""Move an `MjvCamera`: follow a robot, stay behind it, or show all robots. Hills do not hide the robot."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from legged_mw.view.posed_robot import Placement, PosedRobots, RoughGround

AZIMUTH, ELEVATION = 130.0, -22.0  # [deg] in front of the robot, to its right, a little above
ELEVATION_ALL = -35.0  # [deg]
DISTANCE = 2.4  # [robot radius] least distance from camera to base
BEHIND = 1.3 * DISTANCE  # the same for the camera behind the robot
ARROWS = 0.45  # [robot radius] room for the arrows above the robot's top
ROOM = 0.88  # largest share of the picture's height for robot and arrows
# Filter: share of the distance to the base per frame. z is slower, so that steps do not shake the picture.
FOLLOW_XY, FOLLOW_Z = 0.12, 0.04
FOLLOW_ALL = 0.04  # the same in mode "all": slow, because robots enter and leave the reach
REACH = 14.0  # [robot radius] mode "all" shows the robots within this distance of the followed one
REACH_HILLS = 24.0  # the same on hills, where each robot starts on a separate tile
TURN = 0.08  # filter: share of the angle to the heading per frame
# On hills the feet must be visible over a rise: steepest elevation [deg],
# clearance of the line of sight and depth of the feet below the base [robot radius].
STEEPEST, CLEARANCE, LOOK_BELOW = -60.0, 0.15, 0.6
LIFT = 0.06  # filter: share of the angle to this elevation per frame
JUMP = 3.0  # [robot radius] a larger move of the base in one frame is a reset, and the camera jumps too


def distance(placement: Placement, fovy: float, least: float = DISTANCE) -> float:
    """Distance from camera to base [m] at which robot and arrows fit into the picture.

    ``fovy`` [deg]: vertical field of view. ``least`` [robot radius]: distance to a robot that is not tall.
    """
    slope, down = ROOM * math.tan(math.radians(fovy) / 2), math.radians(-ELEVATION)
    # seen from above, points above the base are nearer than the base and points below it are farther away
    above = (placement.top + ARROWS * placement.radius) * (math.cos(down) / slope + math.sin(down))
    below = placement.bottom * (math.cos(down) / slope - math.sin(down))
    return max(least * placement.radius, above, below)


class RobotCamera:
    """Moves `camera`. If a mouse can turn it (`by_hand`), it is placed once and then MuJoCo tracks the robot."""

    def __init__(self, camera: mujoco.MjvCamera, robots: PosedRobots, by_hand: bool) -> None:
        self.camera, self.robots, self.by_hand = camera, robots, by_hand
        self._target: tuple[str, int] | None = None  # mode, world
        self._last_position = robots.placements[0].position  # of that world's robot
        self._frames = 1.0
        self._fovy = float(robots.model.vis.global_.fovy)

    def update(self, mode: str, world: int, frames: float = 1.0) -> mujoco.MjvCamera:
        """Move the camera in `mode`, one of drive.CAMERAS. `frames`: video frames since the last call."""
        self._frames = frames
        before, self._target = self._target, (mode, world)
        changed = before is None or before[0] != mode
        placement = self.robots.placements[world]
        jumped = (
            before == self._target
            and float(np.linalg.norm(placement.position - self._last_position)) > JUMP * placement.radius
        )
        self._last_position = placement.position
        if mode == "all":
            self._see_all(world, cut=changed or jumped)
        elif mode == "behind":
            self._follow(world, cut=before != self._target)
            self._turn(math.degrees(self.robots.placements[world].heading), cut=changed)
        elif self.by_hand:
            if changed:
                self._place(world)
                self.camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
                self.camera.trackbodyid = self.robots.base
        else:
            if changed:
                self._place(world)
            self._follow(world, cut=changed)
        return self.camera

    def _place(self, world: int) -> None:
        """Place the camera at the front right of the robot."""
        placement, camera = self.robots.placements[world], self.camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = placement.position
        camera.distance = distance(placement, self._fovy)
        camera.azimuth = math.degrees(placement.heading) + AZIMUTH
        camera.elevation = ELEVATION

    def _follow(self, world: int, cut: bool) -> None:
        """Move by one frame's share of the distance to the robot. `cut`: move by all of it."""
        camera, placement = self.camera, self.robots.placements[world]
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        gap = placement.position - camera.lookat
        if cut or float(np.linalg.norm(gap)) > JUMP * placement.radius:
            camera.lookat[:] = placement.position
        else:
            camera.lookat[:] += gap * [self._share(share) for share in (FOLLOW_XY, FOLLOW_XY, FOLLOW_Z)]
        if self.robots.ground is not None:
            gap = self._free_elevation(self.robots.ground, placement.radius) - camera.elevation
            camera.elevation += gap if cut else gap * self._share(LIFT)

    def _free_elevation(self, ground: RoughGround, radius: float) -> float:
        """The elevation [deg] at which no ground between camera and robot hides the feet."""
        camera = self.camera
        away = camera.distance * math.cos(math.radians(ELEVATION)) * np.linspace(0.3, 1.0, 8)
        azimuth = math.radians(camera.azimuth)
        places = camera.lookat[:2] - away[:, None] * [math.cos(azimuth), math.sin(azimuth)]
        rise = (
            np.array([ground.height(place) for place in places])
            + CLEARANCE * radius
            - (camera.lookat[2] - LOOK_BELOW * radius)
        )
        return max(min(ELEVATION, -math.degrees(float(np.arctan2(rise, away).max()))), STEEPEST)

    def _share(self, each: float) -> float:
        """The share of the distance after `self._frames` filter steps of `each`."""
        return 1.0 - (1.0 - each) ** self._frames

    def _turn(self, azimuth: float, cut: bool) -> None:
        camera = self.camera
        gap = (azimuth - camera.azimuth + 180.0) % 360.0 - 180.0
        camera.azimuth += gap if cut else gap * self._share(TURN)
        if cut:
            camera.distance, camera.elevation = distance(self.robots.placements[0], self._fovy, BEHIND), ELEVATION

    def _see_all(self, world: int, cut: bool) -> None:
        """Show all robots within reach of this one. Robots walk apart, and a view of all would make them too small."""
        places = np.array([placement.position for placement in self.robots.placements])
        limit = REACH if self.robots.ground is None else REACH_HILLS
        near = places[np.linalg.norm(places - places[world], axis=1) < limit * self.robots.radius]
        camera, middle = self.camera, (near.min(axis=0) + near.max(axis=0)) / 2
        reach = float(np.linalg.norm(near - middle, axis=1).max()) + self.robots.radius
        share = 1.0 if cut else self._share(FOLLOW_ALL)
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] += share * (middle - camera.lookat)
        camera.distance += share * (
            max(2.5 * reach, distance(self.robots.placements[world], self._fovy)) - camera.distance
        )
        if cut:
            camera.azimuth, camera.elevation = AZIMUTH, ELEVATION_ALL
