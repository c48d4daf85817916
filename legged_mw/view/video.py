"""Pictures into files: an offscreen renderer that follows a robot, an MP4 writer, a contact sheet and a PNG.

Knows nothing of windows or of who made the poses. `MUJOCO_GL` must be set before mujoco is imported; the package does it.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import contextlib
import copy
import math
import os
import shutil
import struct
import subprocess
import tempfile
import zlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from legged_mw.view.overlay import FollowCamera, Puppet, ViewError, draw_velocities, set_options

Frame = NDArray[np.uint8]  # (height, width, 3)

SHADOW_MAX = 2048  # ours: edge of the shadow map [px]; 8192, found in many scenes, halves the frame rate of software OpenGL
CRF = 20  # ours: x264's constant quality; 23 is its default and smears a dark checker floor


class RobotRenderer:
    """Offscreen pictures of one robot from a camera that follows it. To be used from the thread that made it."""

    def __init__(self, model: mujoco.MjModel, width: int = 1280, height: int = 720) -> None:
        model = copy.copy(model)  # frame buffer and shadows are ours to set, the caller's model is not
        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.quality.shadowsize = min(model.vis.quality.shadowsize, SHADOW_MAX)
        self.puppet = Puppet(model)
        self.width, self.height = width, height
        self._camera = FollowCamera(self.puppet)
        self._option = mujoco.MjvOption()
        set_options(self._option)
        try:
            self._renderer = mujoco.Renderer(model, height=height, width=width)
        except Exception as error:  # each OpenGL backend fails with a type of its own
            raise ViewError(_no_context(error)) from error

    def frame(self, qpos: ArrayLike, command: ArrayLike | None = None, velocity: ArrayLike | None = None) -> Frame:
        """One picture (height, width, 3), yours to keep. Velocities are (vx, vy, yaw rate) in the body frame."""
        self.puppet.pose(qpos)
        camera, scene = self._camera.update(), self._renderer.scene
        # MuJoCo lays an endless floor around where the camera was; told first, it lies right in the first frame too
        mujoco.mjv_updateCamera(self.puppet.model, self.puppet.data, camera, scene)
        self._renderer.update_scene(self.puppet.data, camera, self._option)
        draw_velocities(scene, self.puppet, command, velocity)
        return self._renderer.render()  # a new array each time

    def close(self) -> None:
        """Free the OpenGL context; again is allowed."""
        self._renderer.close()

    def __enter__(self) -> RobotRenderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _no_context(error: Exception) -> str:
    state = ", ".join(f"{name}={os.environ.get(name)!r}" for name in ("MUJOCO_GL", "DISPLAY"))
    return (
        f"No OpenGL context for offscreen rendering ({state}): {type(error).__name__}: {error}\n"
        "Without a display set MUJOCO_GL=egl (NVIDIA driver or Mesa's libegl1) or MUJOCO_GL=osmesa (libosmesa6, slower) "
        "in the shell, before Python starts."
    )


class VideoWriter:
    """H.264 in an MP4 that browsers play. The file appears under its name when it is whole, at `close`."""

    def __init__(self, path: Path | str, width: int, height: int, fps: float) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".mp4":
            raise ViewError(f"Cannot write {self.path.name!r}: the supported extension is .mp4 (H.264).")
        if width < 2 or height < 2 or width % 2 or height % 2:
            raise ViewError(f"A video of {width} x {height} cannot be encoded: yuv420p needs an even width and an even height.")
        if not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"fps = {fps}: a video needs a positive number of frames per second.")
        encoder = _choose_encoder()
        self.width, self.height, self.frames = width, height, 0
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._partial = self.path.with_name(f".{self.path.stem}.{os.getpid()}.part.mp4")
        self._encoder: _Ffmpeg | _PyAv | None = encoder(self._partial, width, height, Fraction(fps).limit_denominator(1001))

    def add(self, frame: Frame) -> None:
        """Append one frame (height, width, 3)."""
        if self._encoder is None:
            raise RuntimeError(f"{self.path} is closed: no frame can be added.")
        if frame.shape != (self.height, self.width, 3) or frame.dtype != np.uint8:
            raise ValueError(f"A frame of this video is uint8 {(self.height, self.width, 3)}; got {frame.dtype} {frame.shape}.")
        self._encoder.write(np.ascontiguousarray(frame))
        self.frames += 1

    def close(self) -> None:
        """Finish the file and give it its name; again is allowed."""
        if self._encoder is None:
            return
        if self.frames == 0:
            self.abort()
            raise ViewError(f"{self.path} was not written: no frame was added.")
        try:
            self._encoder.finish()
            os.replace(self._partial, self.path)
        except BaseException:
            self.abort()
            raise
        self._encoder = None

    def abort(self) -> None:
        """Drop what was encoded so far; nothing stays behind."""
        encoder, self._encoder = self._encoder, None
        if encoder is not None:
            with contextlib.suppress(Exception):  # we are here because something else went wrong, or by wish
                encoder.abort()
        self._partial.unlink(missing_ok=True)

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close() if kind is None else self.abort()


def _choose_encoder() -> type[_Ffmpeg] | type[_PyAv]:
    """`ffmpeg` on PATH, else PyAV; some builds of either come without libx264, so ask."""
    tried = []
    program = shutil.which("ffmpeg")
    if program is None:
        tried.append("ffmpeg: not on PATH")
    elif "libx264" in subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, text=True, check=False).stdout:
        return _Ffmpeg
    else:
        tried.append(f"{program}: built without libx264")
    try:
        import av  # an extra: heavy, and of no use to training
    except ImportError as error:
        tried.append(f"PyAV: {error}")
    else:
        if "libx264" in av.codecs_available:
            return _PyAv
        tried.append("PyAV: built without libx264")
    raise ViewError(f"No H.264 encoder ({'; '.join(tried)}). Install one: pip install av, or ffmpeg.")


class _Ffmpeg:
    """Raw frames through a pipe to the ffmpeg program."""

    def __init__(self, path: Path, width: int, height: int, fps: Fraction) -> None:
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
        target = ["-an", "-c:v", "libx264", "-crf", str(CRF), "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4", str(path)]
        self._log = tempfile.TemporaryFile()  # noqa: SIM115 (lives as long as ffmpeg; a pipe nobody reads would block it when full)
        self._process = subprocess.Popen(
            ["ffmpeg", "-y", "-loglevel", "error", *source, *target],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=self._log,
            start_new_session=True,  # Ctrl-C is for us; we then decide whether the video is finished or dropped
        )

    def write(self, frame: Frame) -> None:
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(frame.data)
        except BrokenPipeError:
            raise ViewError(self._failure()) from None

    def finish(self) -> None:
        self._hang_up()
        if self._process.wait() != 0:
            raise ViewError(self._failure())

    def abort(self) -> None:
        self._process.kill()
        self._hang_up()
        self._process.wait()

    def _hang_up(self) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it died; its exit status tells
            self._process.stdin.close()

    def _failure(self) -> str:
        code = self._process.wait()
        self._log.seek(0)
        return f"ffmpeg ended with status {code}: {self._log.read().decode(errors='replace').strip() or 'no message'}"


class _PyAv:
    """The same through the libraries that the `av` wheel brings."""

    def __init__(self, path: Path, width: int, height: int, fps: Fraction) -> None:
        import av

        self._av: Any = av
        self._container: Any = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        self._stream: Any = self._container.add_stream("libx264", rate=fps, options={"crf": str(CRF)})
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "yuv420p"

    def write(self, frame: Frame) -> None:
        self._container.mux(self._stream.encode(self._av.VideoFrame.from_ndarray(frame, format="rgb24")))

    def finish(self) -> None:
        self._container.mux(self._stream.encode(None))
        self._container.close()

    def abort(self) -> None:
        self._container.close()


def contact_sheet(frames: Sequence[Frame], columns: int) -> Frame:
    """Frames of one shape side by side, row after row; an unfinished last row ends in black."""
    if not frames or columns < 1:
        raise ValueError(f"A contact sheet needs frames and at least one column; got {len(frames)} frames, {columns} columns.")
    height, width = frames[0].shape[:2]
    rows = -(-len(frames) // columns)
    sheet = np.zeros((rows * height, columns * width, 3), dtype=np.uint8)
    for index, frame in enumerate(frames):
        row, column = divmod(index, columns)
        sheet[row * height : (row + 1) * height, column * width : (column + 1) * width] = frame
    return sheet


def save_png(path: Path | str, frame: Frame) -> None:
    """Write one frame as an RGB PNG: signature, header, one zlib stream with filter byte 0 before every row."""

    def chunk(tag: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + tag + body + struct.pack(">I", zlib.crc32(tag + body))

    height, width = frame.shape[:2]
    rows = np.hstack([np.zeros((height, 1), dtype=np.uint8), np.ascontiguousarray(frame).reshape(height, width * 3)])
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows.tobytes())) + chunk(b"IEND", b"")
    Path(path).write_bytes(data)
