"""Where the camera stands: it follows the chosen robot, walks behind it, or sees all; over hills. Moves somebody else's `MjvCamera`."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math

import mujoco
import numpy as np

from legged_mw.view.hills import Hills
from legged_mw.view.puppet import Cast

AZIMUTH, ELEVATION = 130.0, -22.0  # [deg] front right of the robot, a little above it
ELEVATION_ALL = -35.0  # [deg]
DISTANCE = 2.4  # [robot radius] camera to base
FOLLOW_XY, FOLLOW_Z = 0.12, 0.04  # share of the way to the base per frame; slower in z, so that steps do not shake the picture
FOLLOW_ALL = 0.04  # the same for all: slow, for robots come into reach and leave it
REACH = 14.0  # [robot radius] how far a robot may be from the followed one and still be among all
REACH_HILLS = 24.0  # the same on hills, where each begins on a tile of its own
TURN = 0.08  # share of the way to the heading per frame
STEEPEST, CLEARANCE, LOOK_BELOW = -60.0, 0.15, 0.6  # [deg], [robot radius]: on hills it sees the feet, that far below the base, over a rise
LIFT = 0.06  # share of the way to the elevation that this needs per frame
JUMP = 3.0  # [robot radius] a base this far from where the camera looks was reset, not walked: cut instead of a swish


class CameraMan:
    """Moves `camera`. Where a mouse can turn it (`by_hand`), it is placed once and then tracks the robot by itself."""

    def __init__(self, camera: mujoco.MjvCamera, cast: Cast, by_hand: bool) -> None:
        self.camera, self.cast, self.by_hand = camera, cast, by_hand
        self._shot: tuple[str, int] | None = None  # what it shows: mode, world
        self._place_then = cast.anchors[0].position  # of that world's robot
        self._frames = 1.0

    def update(self, mode: str, world: int, frames: float = 1.0) -> mujoco.MjvCamera:
        """Be where `mode` wants it: one of drive.CAMERAS. `frames` of a video passed since the last call, most not drawn."""
        self._frames = frames
        before, self._shot = self._shot, (mode, world)
        changed = before is None or before[0] != mode
        anchor = self.cast.anchors[world]
        jumped = before == self._shot and float(np.linalg.norm(anchor.position - self._place_then)) > JUMP * anchor.radius
        self._place_then = anchor.position
        if mode == "all":
            self._see_all(world, cut=changed or jumped)
        elif mode == "behind":
            self._follow(world, cut=before != self._shot)
            self._turn(math.degrees(self.cast.anchors[world].heading), cut=changed)
        elif self.by_hand:
            if changed:
                self._place(world)
                self.camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
                self.camera.trackbodyid = self.cast.base
        else:
            if changed:
                self._place(world)
            self._follow(world, cut=changed)
        return self.camera

    def _place(self, world: int) -> None:
        """Look at the robot from its front right, wherever it heads now."""
        anchor, camera = self.cast.anchors[world], self.camera
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] = anchor.position
        camera.distance = DISTANCE * anchor.radius
        camera.azimuth = math.degrees(anchor.heading) + AZIMUTH
        camera.elevation = ELEVATION

    def _follow(self, world: int, cut: bool) -> None:
        """One frame's share of the way to the robot; all of it after a jump."""
        camera, anchor = self.camera, self.cast.anchors[world]
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        gap = anchor.position - camera.lookat
        if cut or float(np.linalg.norm(gap)) > JUMP * anchor.radius:
            camera.lookat[:] = anchor.position
        else:
            camera.lookat[:] += gap * [self._share(share) for share in (FOLLOW_XY, FOLLOW_XY, FOLLOW_Z)]
        if self.cast.hills is not None:
            gap = self._free_elevation(self.cast.hills, anchor.radius) - camera.elevation
            camera.elevation += gap if cut else gap * self._share(LIFT)

    def _free_elevation(self, hills: Hills, radius: float) -> float:
        """From how high [deg] the robot is seen over the ground between it and the camera."""
        camera = self.camera
        away = camera.distance * math.cos(math.radians(ELEVATION)) * np.linspace(0.3, 1.0, 8)
        azimuth = math.radians(camera.azimuth)
        places = camera.lookat[:2] - away[:, None] * [math.cos(azimuth), math.sin(azimuth)]
        rise = np.array([hills.height(place) for place in places]) + CLEARANCE * radius - (camera.lookat[2] - LOOK_BELOW * radius)
        return max(min(ELEVATION, -math.degrees(float(np.arctan2(rise, away).max()))), STEEPEST)

    def _share(self, each: float) -> float:
        """Of the way, after ``self._frames`` steps of the share ``each``."""
        return 1.0 - (1.0 - each) ** self._frames

    def _turn(self, azimuth: float, cut: bool) -> None:
        camera = self.camera
        gap = (azimuth - camera.azimuth + 180.0) % 360.0 - 180.0
        camera.azimuth += gap if cut else gap * self._share(TURN)
        if cut:
            camera.distance, camera.elevation = 1.3 * DISTANCE * self.cast.radius, ELEVATION

    def _see_all(self, world: int, cut: bool) -> None:
        """All robots that are not out of reach of this one; they walk apart, and from too far they are specks."""
        places = np.array([anchor.position for anchor in self.cast.anchors])
        limit = REACH if self.cast.hills is None else REACH_HILLS
        near = places[np.linalg.norm(places - places[world], axis=1) < limit * self.cast.radius]
        camera, middle = self.camera, (near.min(axis=0) + near.max(axis=0)) / 2
        reach = float(np.linalg.norm(near - middle, axis=1).max()) + self.cast.radius
        share = 1.0 if cut else self._share(FOLLOW_ALL)
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat[:] += share * (middle - camera.lookat)
        camera.distance += share * (2.5 * reach - camera.distance)
        if cut:
            camera.azimuth, camera.elevation = AZIMUTH, ELEVATION_ALL
