"""Frames into files: an MP4 or GIF writer, a contact sheet and a PNG. Knows nothing of robots or of who drew the frames."""

from __future__ import annotations

import contextlib
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

import numpy as np
from numpy.typing import NDArray

from legged_mw.view.stage import ViewError

Frame = NDArray[np.uint8]  # (height, width, 3)

FORMATS = (".mp4", ".gif")
# a palette from all frames, a dither that stands still where the picture does: small files
PALETTE = (("split", ""), ("palettegen", "stats_mode=full"), ("paletteuse", "dither=bayer:bayer_scale=4:diff_mode=rectangle"))
CRF = 20  # ours: x264's constant quality; 23 is its default and smears a dark checker floor


class VideoWriter:
    """H.264 in an MP4 that browsers play, or a GIF, by the name's ending. The file appears under its name when it is whole, at `close`.

    A GIF is made of all its frames at once: they stay in memory until then.
    """

    def __init__(self, path: Path | str, width: int, height: int, fps: float) -> None:
        self.path = Path(path)
        check_format(self.path)
        gif = self.path.suffix.lower() == ".gif"
        if not gif and (width < 2 or height < 2 or width % 2 or height % 2):
            raise ViewError(f"A video of {width} x {height} cannot be encoded: yuv420p needs an even width and an even height.")
        if not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"fps = {fps}: a video needs a positive number of frames per second.")
        encoder = _choose_encoder(gif)
        self.width, self.height, self.frames = width, height, 0
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._partial = self.path.with_name(f".{self.path.stem}.{os.getpid()}.part{self.path.suffix.lower()}")
        self._encoder: _Ffmpeg | _PyAv | _PyAvGif | None = encoder(self._partial, width, height, Fraction(fps).limit_denominator(1001))

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


def check_format(path: Path) -> None:
    """ViewError if a file of this name cannot be written."""
    if path.suffix.lower() not in FORMATS:
        raise ViewError(f"Cannot write {path.name!r}: the supported extensions are .mp4 (H.264) and .gif.")


def no_encoder() -> str | None:
    """Why no MP4 can be written here, or None."""
    try:
        _choose_encoder(gif=False)
    except ViewError as error:
        return str(error)
    return None


def _choose_encoder(gif: bool) -> type[_Ffmpeg] | type[_PyAv] | type[_PyAvGif]:
    """`ffmpeg` on PATH, else PyAV; some builds of either come without libx264, so ask."""
    codec, tried = "gif" if gif else "libx264", []
    program = shutil.which("ffmpeg")
    if program is None:
        tried.append("ffmpeg: not on PATH")
    elif codec in subprocess.run([program, "-hide_banner", "-encoders"], capture_output=True, text=True, check=False).stdout:
        return _Ffmpeg
    else:
        tried.append(f"{program}: built without {codec}")
    try:
        import av  # an extra: heavy, and of no use to training
    except ImportError as error:
        tried.append(f"PyAV: {error}")
    else:
        if codec in av.codecs_available:
            return _PyAvGif if gif else _PyAv
        tried.append(f"PyAV: built without {codec}")
    raise ViewError(f"No {'GIF' if gif else 'H.264'} encoder ({'; '.join(tried)}). Install one: pip install av, or ffmpeg.")


class _Ffmpeg:
    """Raw frames through a pipe to the ffmpeg program."""

    def __init__(self, path: Path, width: int, height: int, fps: Fraction) -> None:
        source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{width}x{height}", "-r", str(fps), "-i", "-"]
        if path.suffix == ".gif":
            split, palette, use = (f"{name}={options}" if options else name for name, options in PALETTE)
            coding = ["-filter_complex", f"{split}[a][b];[a]{palette}[p];[b][p]{use}", "-f", "gif"]
        else:
            coding = ["-c:v", "libx264", "-crf", str(CRF), "-pix_fmt", "yuv420p", "-movflags", "+faststart", "-f", "mp4"]
        target = ["-an", *coding, str(path)]
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


class _PyAvGif:
    """A GIF through the same libraries: a filter graph looks at all frames for the palette, then paints them in it."""

    def __init__(self, path: Path, width: int, height: int, fps: Fraction) -> None:
        import av

        self._av: Any = av
        self._container: Any = av.open(str(path), "w", format="gif")
        self._stream: Any = self._container.add_stream("gif", rate=fps)
        self._stream.width, self._stream.height, self._stream.pix_fmt = width, height, "pal8"
        self._time, self._frames = 1 / fps, 0
        self._graph: Any = self._av.filter.Graph()
        self._source: Any = self._graph.add_buffer(width=width, height=height, format="rgb24", time_base=self._time)
        split, palette, use = (self._graph.add(name, options) if options else self._graph.add(name) for name, options in PALETTE)
        self._sink: Any = self._graph.add("buffersink")
        self._source.link_to(split)
        split.link_to(palette, 0, 0)
        split.link_to(use, 1, 0)
        palette.link_to(use, 0, 1)
        use.link_to(self._sink)
        self._graph.configure()

    def write(self, frame: Frame) -> None:
        picture = self._av.VideoFrame.from_ndarray(frame, format="rgb24")
        picture.pts, picture.time_base = self._frames, self._time
        self._frames += 1
        self._source.push(picture)

    def finish(self) -> None:
        self._source.push(None)
        while True:
            try:
                painted = self._sink.pull()
            except (self._av.error.EOFError, self._av.error.BlockingIOError):
                break
            self._container.mux(self._stream.encode(painted))
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
