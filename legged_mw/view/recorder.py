"""Pictures without a screen: an offscreen renderer, a viewer that records a video and a contact sheet, and image files.

`MUJOCO_GL` must be set before mujoco is imported. The package does that.
"""

from __future__ import annotations

import contextlib
import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.utils.errors import shown
from legged_mw.view.camera import RobotCamera
from legged_mw.view.overlay import draw
from legged_mw.view.posed_robot import PosedRobots, show_groups
from legged_mw.view.stage import Moment, ViewError

Frame = NDArray[np.uint8]  # (height, width, 3)

# ours: edge of the shadow map [px]; the common value 8192 halves the frame rate of software OpenGL
SHADOW_MAX = 2048
LIVE = 0, 16, 8  # ours: samples per pixel, slices and stacks of a sphere; a G1 takes 21 ms of a core instead of 200
GEOMS_MAX = 20_000
# [m] beyond the camera's distance; terrain tiles farther away are drawn coarse
FINE_REACH = 3.0
TINY, SMALL = 400, 800  # [px] pictures up to these widths get smaller fonts
SHEET_FRAMES, SHEET_COLUMNS, SHEET_WIDTH = 12, 4, 320  # pictures, pictures per row, largest width of a picture [px]
GIF_FPS, GIF_WIDTH = 12.5, 640  # GIF times are in 0.01 s; larger values make large files


class RobotRenderer:
    """Offscreen pictures of robots from a camera that follows one. Use it only on the thread that created it.

    `robots`: a model of one robot, drawn `count` times; or posed robots, whose poses it changes. `live`: fast on a CPU,
    without shadows and smooth edges, and `move_camera` turns the camera.
    """

    def __init__(
        self,
        robots: mujoco.MjSpec | PosedRobots,
        width: int = 1280,
        height: int = 720,
        count: int = 1,
        *,
        live: bool = False,
    ) -> None:
        self.robots = robots if isinstance(robots, PosedRobots) else PosedRobots(robots, count)
        vis = self.robots.model.vis
        if live:
            vis.quality.offsamples, vis.quality.numslices, vis.quality.numstacks = LIVE
        vis.quality.shadowsize = min(vis.quality.shadowsize, SHADOW_MAX)
        self.width, self.height = width, height
        self._camera = RobotCamera(mujoco.MjvCamera(), self.robots, by_hand=live)
        self._option = mujoco.MjvOption()
        show_groups(self._option)
        font = mujoco.mjtFontScale.mjFONTSCALE_150
        if width <= SMALL:
            font = mujoco.mjtFontScale.mjFONTSCALE_50 if width <= TINY else mujoco.mjtFontScale.mjFONTSCALE_100
        self._renderer = make_renderer(self.robots.model, width, height, font, GEOMS_MAX)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = not live

    def move_camera(self, action: int, x: float, y: float) -> None:
        """Turn or zoom the camera as a mouse would: a mjtMouse, moved by x, y [picture height]."""
        mujoco.mjv_moveCamera(self.robots.model, action, x, y, self._camera.camera)

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


def make_renderer(
    model: mujoco.MjModel,
    width: int,
    height: int,
    font: mujoco.mjtFontScale = mujoco.mjtFontScale.mjFONTSCALE_150,
    geoms: int = 10_000,
) -> mujoco.Renderer:
    """A renderer of pictures without a screen. Raises ViewError if this machine has no OpenGL context for it."""
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    try:
        return mujoco.Renderer(model, height=height, width=width, max_geom=geoms, font_scale=font)
    except Exception as error:  # each OpenGL backend raises another type
        state = ", ".join(f"{name}={os.environ.get(name)!r}" for name in ("MUJOCO_GL", "DISPLAY"))
        raise ViewError(
            f"No OpenGL context for offscreen rendering ({state}): {type(error).__name__}: {error}\n"
            "Without a display set MUJOCO_GL=egl (NVIDIA driver or Mesa's libegl1) or MUJOCO_GL=osmesa (libosmesa6, slower) "
            "in the shell, before Python starts."
        ) from error


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
        waiting = self._sheet_times[len(self._pictures) :]
        still = bool(waiting) and moment.time >= waiting[0] - 1e-9
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


# ---- frames to files: MP4 or GIF with PyAV, a contact sheet, a PNG

CODECS = {".mp4": "libx264", ".gif": "gif"}
CRF = 20  # ours: constant quality of x264; its default 23 smears a dark checker floor
DITHER = "dither=bayer:bayer_scale=4:diff_mode=rectangle"  # constant where the picture is constant: small files


class VideoWriter:
    """Writes an MP4 (H.264 that browsers play) or a GIF, by the file's suffix. The file appears at `close`.

    A GIF has one palette for all frames, so the frames stay in memory until `close`.
    """

    def __init__(self, path: Path | str, width: int, height: int, fps: float) -> None:
        self.path = Path(path)
        check_format(self.path)
        kind = self.path.suffix.lower()
        if kind == ".mp4" and (width < 2 or height < 2 or width % 2 or height % 2):
            raise ViewError(
                f"A video of {width} x {height} cannot be encoded: yuv420p needs an even width and an even height."
            )
        if (reason := no_encoder(kind)) is not None:
            raise ViewError(reason)
        self.width, self.height, self.frames = width, height, 0
        # absolute: ffmpeg takes what precedes a colon in a relative path for a protocol; short: a name has 255 bytes
        self._partial = self.path.with_name(f".{self.path.stem[:40]}.{os.getpid()}.part{kind}").absolute()
        with _writing(self.path):
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self._open(kind, Fraction(fps).limit_denominator(1001))

    def add(self, frame: Frame) -> None:
        """Append one frame (height, width, 3)."""
        picture = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        picture.pts, picture.time_base = self.frames, self._time
        with _writing(self.path):
            self._palette.push(picture) if self._palette else self._write(picture)
        self.frames += 1

    def close(self) -> None:
        """Finish the file and rename it to its final name. May be called twice."""
        if self._container is None:
            return
        if self.frames == 0:
            self.abort()
            raise ViewError(f"{self.path} was not written: no frame was added.")
        try:
            with _writing(self.path):
                if self._palette:
                    self._palette.push(None)
                    with contextlib.suppress(self._av.error.EOFError):
                        while True:
                            self._write(self._palette.pull())
                self._write(None)
                self._container.close()
                os.replace(self._partial, self.path)
        except BaseException:
            self.abort()
            raise
        self._container = None

    def abort(self) -> None:
        """Discard the file. An older file with this name stays."""
        container, self._container = self._container, None
        if container is not None:
            with contextlib.suppress(Exception):  # closing fails in some states
                container.close()
        self._partial.unlink(missing_ok=True)

    def _open(self, kind: str, rate: Fraction) -> None:
        import av

        self._av: Any = av
        self._time = 1 / rate
        gif = kind == ".gif"
        self._container: Any = av.open(
            str(self._partial), "w", format=kind[1:], options={} if gif else {"movflags": "+faststart"}
        )
        self._stream: Any = self._container.add_stream(
            CODECS[kind], rate=rate, options={} if gif else {"crf": str(CRF)}
        )
        self._stream.width, self._stream.height = self.width, self.height
        self._stream.pix_fmt = "pal8" if gif else "yuv420p"
        self._palette: Any = self._palette_graph() if gif else None

    def _palette_graph(self) -> Any:
        """The filters that compute a palette from all frames and apply it to each frame."""
        graph = self._av.filter.Graph()
        source = graph.add_buffer(width=self.width, height=self.height, format="rgb24", time_base=self._time)
        split, palette, use, sink = (
            graph.add(*filter_)
            for filter_ in (("split",), ("palettegen", "stats_mode=full"), ("paletteuse", DITHER), ("buffersink",))
        )
        source.link_to(split)
        split.link_to(palette, 0, 0)
        split.link_to(use, 1, 0)
        palette.link_to(use, 0, 1)
        use.link_to(sink)
        graph.configure()
        return graph

    def _write(self, picture: Any) -> None:
        self._container.mux(self._stream.encode(picture))


def check_format(path: Path) -> None:
    """Raise ViewError if a file with this name cannot be written."""
    if path.suffix.lower() not in CODECS:
        raise ViewError(f"Cannot write {path.name!r}: the supported extensions are .mp4 (H.264) and .gif.")


def no_encoder(kind: str = ".mp4") -> str | None:
    """The reason why this machine cannot write this kind of video, or None."""
    try:
        import av  # an optional dependency: large, and not needed for training
    except ImportError as error:
        return f'Videos are written by PyAV ({error}). Install it: pip install "legged_mw[video]"'
    if CODECS[kind] not in av.codecs_available:
        return (
            f"PyAV {av.__version__} was built without {CODECS[kind]}. Install another: pip install --force-reinstall av"
        )
    return None


def contact_sheet(frames: Sequence[Frame], columns: int) -> Frame:
    """A picture of equally large frames in rows of `columns`. The rest of the last row is black."""
    height, width = frames[0].shape[:2]
    rows = -(-len(frames) // columns)
    sheet = np.zeros((rows * columns, height, width, 3), dtype=np.uint8)
    sheet[: len(frames)] = frames
    return sheet.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)


def as_png(frame: Frame) -> bytes:
    """One frame as an RGB PNG. Needs neither Pillow nor PyAV, which a robot's computer lacks."""

    def chunk(tag: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + tag + body + struct.pack(">I", zlib.crc32(tag + body))

    height, width = frame.shape[:2]
    rows = np.hstack([np.zeros((height, 1), dtype=np.uint8), np.ascontiguousarray(frame).reshape(height, width * 3)])
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes())) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + body


def save_png(path: Path | str, frame: Frame) -> None:
    """Write one frame as a PNG. Raises ViewError."""
    with _writing(path := Path(path)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(as_png(frame))


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Raise ViewError where a file cannot be written: a folder without permission, a full disk."""
    try:
        yield
    except OSError as error:  # also PyAV's
        raise ViewError(f"cannot write {shown(path)}: {error.strerror or error}") from None
