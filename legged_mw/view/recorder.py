"""Pictures without a screen: an offscreen renderer, and a viewer that records a video and a contact sheet.

`MUJOCO_GL` must be set before mujoco is imported. The package does that.
"""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np

from legged_mw.view.camera import RobotCamera
from legged_mw.view.overlay import draw
from legged_mw.view.posed_robot import PosedRobots, show_groups
from legged_mw.view.stage import Moment, ViewError
from legged_mw.view.video import Frame, VideoWriter, contact_sheet, save_png

# ours: edge of the shadow map [px]; the common value 8192 halves the frame rate of software OpenGL
SHADOW_MAX = 2048
GEOMS_MAX = 20_000
# [m] beyond the camera's distance: terrain tiles farther than that from its target are drawn coarse
FINE_REACH = 3.0
TINY, SMALL = 400, 800  # [px] pictures up to these widths get smaller fonts
SHEET_FRAMES, SHEET_COLUMNS, SHEET_WIDTH = 12, 4, 320  # pictures, pictures per row, largest width of a picture [px]
GIF_FPS, GIF_WIDTH = 12.5, 640  # GIF times are in 0.01 s; larger values make large files


class RobotRenderer:
    """Offscreen pictures of robots from a camera that follows one. Use it only on the thread that created it."""

    def __init__(self, spec: mujoco.MjSpec, width: int = 1280, height: int = 720, count: int = 1) -> None:
        self.robots = PosedRobots(spec, count)
        vis = self.robots.model.vis
        vis.global_.offwidth, vis.global_.offheight = width, height
        vis.quality.shadowsize = min(vis.quality.shadowsize, SHADOW_MAX)
        self.width, self.height = width, height
        self._camera = RobotCamera(mujoco.MjvCamera(), self.robots, by_hand=False)
        self._option = mujoco.MjvOption()
        show_groups(self._option)
        try:
            scale = mujoco.mjtFontScale
            font = (
                scale.mjFONTSCALE_50
                if width <= TINY
                else scale.mjFONTSCALE_100
                if width <= SMALL
                else scale.mjFONTSCALE_150
            )
            self._renderer = mujoco.Renderer(
                self.robots.model, height=height, width=width, max_geom=GEOMS_MAX, font_scale=font
            )
        except Exception as error:  # each OpenGL backend raises another type
            raise ViewError(no_context(error)) from error

    def frame(self, moment: Moment, frames: float = 1.0) -> Frame:
        """A picture (height, width, 3) as a new array. `frames`: video frames since the last call."""
        self.robots.pose(moment.qpos, moment.world)
        camera, scene = self._camera.update(moment.camera, moment.world, frames), self._renderer.scene
        if self.robots.ground is not None:
            self.robots.ground.refine(camera.lookat[:2], FINE_REACH + camera.distance)
        # MuJoCo draws an infinite floor around the camera's last position: update it, also for the first frame
        mujoco.mjv_updateCamera(self.robots.model, self.robots.data, camera, scene)
        self._renderer.update_scene(self.robots.data, camera, self._option)
        draw(scene, self.robots, moment)
        frame = self._renderer.render()  # a new array at each call
        return self._write(frame, moment.lines) if moment.lines else frame

    def _write(self, frame: Frame, lines: tuple[tuple[str, str], ...]) -> Frame:
        """Write the lines of text over the last picture, and read the picture again."""
        renderer = self._renderer
        names, values = ("\n".join(column) for column in zip(*lines, strict=True))
        place = mujoco.mjtGridPos.mjGRID_TOPLEFT
        mujoco.mjr_overlay(mujoco.mjtFont.mjFONT_NORMAL, place, renderer._rect, names, values, renderer._mjr_context)
        mujoco.mjr_readPixels(frame, None, renderer._rect, renderer._mjr_context)
        frame[:] = np.flipud(frame)
        return frame

    def close(self) -> None:
        """Free the OpenGL context. May be called twice."""
        self._renderer.close()


def no_context(error: Exception) -> str:
    """The advice for a machine without an OpenGL context for offscreen drawing."""
    state = ", ".join(f"{name}={os.environ.get(name)!r}" for name in ("MUJOCO_GL", "DISPLAY"))
    return (
        f"No OpenGL context for offscreen rendering ({state}): {type(error).__name__}: {error}\n"
        "Without a display set MUJOCO_GL=egl (NVIDIA driver or Mesa's libegl1) or MUJOCO_GL=osmesa (libosmesa6, slower) "
        "in the shell, before Python starts."
    )


class Recorder:
    """A viewer that writes files: `video` (MP4 or GIF), `sheet` (a PNG of pictures from the whole run), or both."""

    def __init__(
        self,
        spec: mujoco.MjSpec,
        count: int,
        dt: float,  # [s] time between two moments
        seconds: float,  # [s] length of the run; the pictures of the sheet are evenly spaced in it
        *,
        video: Path | None,
        sheet: Path | None,
        width: int = 1280,
        height: int = 720,
        fps: float = 25.0,
    ) -> None:
        self.video, self.sheet = video, sheet
        if video is not None and video.suffix.lower() == ".gif":
            fps, shrink = min(fps, GIF_FPS), max(1.0, width / GIF_WIDTH)
            width, height = round(width / shrink), round(height / shrink)
        self._every = max(1, round(1 / (fps * dt)))
        self._sheet_times = [index * seconds / SHEET_FRAMES for index in range(SHEET_FRAMES)] if sheet else []  # [s]
        self._pictures: list[Frame] = []
        self._turn = self._drawn = 0
        # check the file names before creating a context; if that fails, an old file stays
        self._writer = VideoWriter(video, width, height, 1 / (self._every * dt)) if video else None
        try:
            self._renderer = RobotRenderer(spec, width, height, count)
        except BaseException:
            self.abort()
            raise

    def show(self, moment: Moment) -> None:
        """Record a frame if its time has come."""
        film = self._writer is not None and self._turn % self._every == 0
        still = (
            len(self._pictures) < len(self._sheet_times)
            and moment.time >= self._sheet_times[len(self._pictures)] - 1e-9
        )
        self._turn += 1
        if not (film or still):
            return
        frame = self._renderer.frame(moment, (self._turn - self._drawn) / self._every)
        self._drawn = self._turn
        if film and self._writer is not None:
            self._writer.add(frame)
        if still:
            self._pictures.append(shrunk(frame, SHEET_WIDTH))

    def is_running(self) -> bool:
        """Always True: the user cannot close a file."""
        return True

    def close(self) -> None:
        """Finish the files. May be called twice."""
        self._renderer.close()
        if self._writer is not None:
            self._writer.close()
        if self.sheet is not None and self._pictures:
            save_png(self.sheet, contact_sheet(self._pictures, SHEET_COLUMNS))
            self._pictures = []

    def abort(self) -> None:
        """Discard the files. Older files with these names stay."""
        if self._writer is not None:
            self._writer.abort()


def shrunk(frame: Frame, width: int) -> Frame:
    """The frame, shrunk to at most `width` [px] by averaging square blocks of pixels."""
    factor = -(-frame.shape[1] // width)
    rows, columns = frame.shape[0] // factor, frame.shape[1] // factor
    squares = frame[: rows * factor, : columns * factor].reshape(rows, factor, columns, factor, 3)
    return squares.mean(axis=(1, 3)).astype(np.uint8)
