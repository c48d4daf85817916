"""Write frames to files: MP4 or GIF with PyAV, a contact sheet, a PNG. Independent of robots."""

from __future__ import annotations

import contextlib
import math
import os
import struct
import zlib
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.view.stage import ViewError

Frame = NDArray[np.uint8]  # (height, width, 3)

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
        if not (math.isfinite(fps) and fps > 0):
            raise ValueError(f"fps = {fps}: a video needs a positive number of frames per second.")
        if (reason := no_encoder(kind)) is not None:
            raise ViewError(reason)
        self.width, self.height, self.frames = width, height, 0
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._partial = self.path.with_name(f".{self.path.stem}.{os.getpid()}.part{kind}")
        self._open(kind, Fraction(fps).limit_denominator(1001))

    def add(self, frame: Frame) -> None:
        """Append one frame (height, width, 3)."""
        if self._container is None:
            raise RuntimeError(f"{self.path} is closed: no frame can be added.")
        if frame.shape != (self.height, self.width, 3) or frame.dtype != np.uint8:
            raise ValueError(
                f"A frame of this video is uint8 {(self.height, self.width, 3)}; got {frame.dtype} {frame.shape}."
            )
        picture = self._av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        picture.pts, picture.time_base = self.frames, self._time
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
        self._stream.width, self._stream.height, self._stream.pix_fmt = (
            self.width,
            self.height,
            "pal8" if gif else "yuv420p",
        )
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
    if not frames or columns < 1:
        raise ValueError(
            f"A contact sheet needs frames and at least one column; got {len(frames)} frames, {columns} columns."
        )
    height, width = frames[0].shape[:2]
    rows = -(-len(frames) // columns)
    sheet = np.zeros((rows * columns, height, width, 3), dtype=np.uint8)
    sheet[: len(frames)] = frames
    return sheet.reshape(rows, columns, height, width, 3).swapaxes(1, 2).reshape(rows * height, columns * width, 3)


def save_png(path: Path | str, frame: Frame) -> None:
    """Write one frame as an RGB PNG. Needs neither Pillow nor PyAV, which a robot's computer lacks."""

    def chunk(tag: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + tag + body + struct.pack(">I", zlib.crc32(tag + body))

    height, width = frame.shape[:2]
    rows = np.hstack([np.zeros((height, 1), dtype=np.uint8), np.ascontiguousarray(frame).reshape(height, width * 3)])
    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    data = (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows.tobytes()))
        + chunk(b"IEND", b"")
    )
    Path(path).write_bytes(data)
