"""Moves an `MjvCamera`: it follows the chosen robot, stays behind it, or sees all robots, and looks over hills."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math

import mujoco
import numpy as np

from legged_mw.view.posed_robot import Placement, PosedRobots, RoughGround

AZIMUTH, ELEVATION = 130.0, -22.0  # [deg] front right of the robot, a little above it
ELEVATION_ALL = -35.0  # [deg]
DISTANCE = 2.4  # [robot radius] camera to base, at least
BEHIND = 1.3 * DISTANCE  # likewise from behind
ARROWS = 0.45  # [robot radius] above its top: the picture has room for the arrows there
ROOM = 0.88  # share of the picture's height that robot and arrows take, at most
# share of the way to the base per frame; slower in z, so that steps do not shake the picture
FOLLOW_XY, FOLLOW_Z = 0.12, 0.04
FOLLOW_ALL = 0.04  # the same for all: slow, because robots come into reach and leave it
REACH = 14.0  # [robot radius] from the followed robot; "all" shows the robots within it
REACH_HILLS = 24.0  # the same on hills, where each begins on a tile of its own
TURN = 0.08  # share of the way to the heading per frame
# [deg], [robot radius]: on hills it sees the feet, so far below the base, over a rise
STEEPEST, CLEARANCE, LOOK_BELOW = -60.0, 0.15, 0.6
LIFT = 0.06  # share of the way to the elevation that this needs per frame
JUMP = 3.0  # [robot radius] a base that moved this far at once was reset: the camera cuts to it


def distance(placement: Placement, fovy: float, least: float = DISTANCE) -> float:
    """Camera to base [m], so that all of the robot and its arrows are in the picture; ``fovy`` [deg] is the picture's height.

    ``least`` [robot radius] is the distance to a robot that is not tall.
    """
    slope, down = ROOM * math.tan(math.radians(fovy) / 2), math.radians(-ELEVATION)
    # seen from above, what is above the base is nearer and what is below it farther away
    above = (placement.top + ARROWS * placement.radius) * (math.cos(down) / slope + math.sin(down))
    below = placement.bottom * (math.cos(down) / slope - math.sin(down))
    return max(least * placement.radius, above, below)


class RobotCamera:
    """Moves `camera`. Where a mouse can turn it (`by_hand`), it is placed once and then tracks the robot by itself."""

    def __init__(self, camera: mujoco.MjvCamera, robots: PosedRobots, by_hand: bool) -> None:
        self.camera, self.robots, self.by_hand = camera, robots, by_hand
        self._target: tuple[str, int] | None = None  # mode, world
        self._last_position = robots.placements[0].position  # of that world's robot
        self._frames = 1.0
        self._fovy = float(robots.model.vis.global_.fovy)

    def update(self, mode: str, world: int, frames: float = 1.0) -> mujoco.MjvCamera:
        """Move as `mode` says, one of drive.CAMERAS. `frames` of a video passed since the last call."""
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
        """Look at the robot from its front right."""
        placement, camera = self.robots.placements[world], self.camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = placement.position
        camera.distance = distance(placement, self._fovy)
        camera.azimuth = math.degrees(placement.heading) + AZIMUTH
        camera.elevation = ELEVATION

    def _follow(self, world: int, cut: bool) -> None:
        """Move one frame's share of the way to the robot; all of it after a jump."""
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
        """Elevation [deg] from which the ground between camera and robot hides nothing."""
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
        """Share of the way after `self._frames` steps of `each`."""
        return 1.0 - (1.0 - each) ** self._frames

    def _turn(self, azimuth: float, cut: bool) -> None:
        camera = self.camera
        gap = (azimuth - camera.azimuth + 180.0) % 360.0 - 180.0
        camera.azimuth += gap if cut else gap * self._share(TURN)
        if cut:
            camera.distance, camera.elevation = distance(self.robots.placements[0], self._fovy, BEHIND), ELEVATION

    def _see_all(self, world: int, cut: bool) -> None:
        """Show all robots within reach of this one: robots walk apart, and from too far they are specks."""
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
