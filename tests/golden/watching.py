"""Viewers, videos and pictures."""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path
from types import SimpleNamespace

import av
import mujoco
import numpy as np

from golden.table import Table, patched, without
from legged_mw.rl.policies import NETWORK_FILE, PolicySource
from legged_mw.utils.commands import Command
from legged_mw.view import launch, native, playing, web
from legged_mw.view.drive import Pilot
from legged_mw.view.native import NativeViewer
from legged_mw.view.recorder import RobotRenderer, VideoWriter, save_png
from legged_mw.view.web import WebViewer, listen

SPEC = """<mujoco><worldbody><body><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""


def spec() -> mujoco.MjSpec:
    return mujoco.MjSpec.from_string(SPEC)


def no_frame(root: Path) -> None:
    VideoWriter(root / "a.mp4", 320, 240, 50).close()


def no_opengl(*_: object, **__: object) -> None:
    raise RuntimeError("gladLoadGL error")


def window(can: bool) -> None:
    run = patched(lambda root: NativeViewer(spec()), native, has_display=lambda: can, _can_open_window=lambda: False)
    patched(run, os, environ={**os.environ, "DISPLAY": ":99"})(Path())


def mac() -> None:
    import mujoco.viewer

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("`launch_passive` requires mjpython")

    patched(patched(lambda root: NativeViewer(spec()), mujoco.viewer, launch_passive=refuse), sys, platform="darwin")(
        Path()
    )


def taken(run: object = None) -> None:
    with socket.socket() as there:
        there.bind(("127.0.0.1", 0))
        there.listen()
        port = there.getsockname()[1]
        try:
            listen("127.0.0.1", port)
        except launch.ViewError as error:
            error.args = (str(error).replace(str(port), "<port>"),)
            raise


class Refusing(socket.socket):
    """As for a user who may not listen there, or where all ports are taken."""

    why: type[OSError] = PermissionError

    def bind(self, _: object) -> None:
        raise self.why(13, "Permission denied")


class Full(Refusing):
    why = OSError


def bound(kind: type[Refusing], port: int) -> None:
    patched(lambda root: listen("127.0.0.1", port), web.socket, socket=kind)(Path())


def followed() -> None:
    source = PolicySource(Path("export"), Path("export") / NETWORK_FILE, shipped=False)
    playing.watch(source, None, (), SimpleNamespace(follow=True))  # type: ignore[arg-type]


def unguarded() -> None:
    from mujoco.studio.web import web_server

    run = patched(lambda root: WebViewer(spec(), Pilot((), 1)), web_server, serve=None)  # type: ignore[arg-type]
    patched(run, web, mujoco=SimpleNamespace(__version__="0.0"))(Path())


def table() -> Table:
    made = Table()
    made.add("a video of no frame", no_frame)
    made.add(
        "a picture in a folder that is a file",
        lambda root: save_png(root / "a" / "b.png", np.zeros((1, 1, 3), np.uint8)),
        lambda root: (root / "a").write_text(""),
    )
    made.add("a video of odd width", lambda root: VideoWriter(root / "a.mp4", 321, 240, fps=50))
    made.add(
        "no encoder",
        patched(
            patched(lambda root: VideoWriter(root / "a.mp4", 320, 240, fps=50), av, codecs_available={"gif"}),
            av,
            __version__="0.0",
        ),
    )
    made.add("no PyAV", without("av", lambda root: VideoWriter(root / "a.mp4", 320, 240, fps=50)))
    egl = {**os.environ, "MUJOCO_GL": "egl"}
    made.add(
        "no OpenGL",
        patched(patched(lambda root: RobotRenderer(spec(), 64, 48), mujoco, Renderer=no_opengl), os, environ=egl),
    )
    made.calls(
        {
            "an export is followed": followed,
            "a window without a display": lambda: window(False),
            "a window that cannot be opened": lambda: window(True),
            "a window of a Mac": mac,
            "web: a port in use": taken,
            "web: a port of others": lambda: bound(Refusing, 80),
            "web: all ports in use": lambda: bound(Full, 0),
            "web: no name of a host": lambda: listen("\u00fc..b"),
            "web: no such address": lambda: listen("203.0.113.7"),
            "web: none in this mujoco": lambda: patched(
                lambda root: WebViewer(spec(), Pilot((), 1)), web, missing=lambda: "there is none"
            )(Path()),  # type: ignore[arg-type]
            "web: another one": lambda: patched(lambda root: WebViewer(spec(), Pilot((), 1)), WebViewer, _opened=True)(
                Path()
            ),
            "web: cannot be guarded": unguarded,
            "a command outside": lambda: launch.check_drive(
                SimpleNamespace(commands=None, command="base_height=0.1"),  # type: ignore[arg-type]
                (Command("lin_vel_x", -1.0, 1.0, "m/s"), Command("base_height", 0.18, 0.3, "m")),
            ),
            "a command of none": lambda: launch.check_drive(SimpleNamespace(commands=None, command="1"), ()),  # type: ignore[arg-type]
        }
    )
    return made
