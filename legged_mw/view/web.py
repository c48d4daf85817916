"""A web page: MuJoCo Studio's web viewer, with our panel. Served from this process, without anything from the net.

It has neither password nor encryption, so it is bound to 127.0.0.1 unless another host is asked for; from afar it is
reached through `ssh -L`. Studio is young: what is used of it beyond its documented shape is in `_held_to`, and checked.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import errno
import getpass
import logging
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco

from legged_mw.view.drive import Pilot
from legged_mw.view.puppet import Cast
from legged_mw.view.stage import Moment, ViewError

LOCAL = "127.0.0.1"
FIRST_PORT, PORTS = 8080, 20
START_SECONDS = 20.0


def missing() -> str | None:
    """Why no page can be served here; None if one can."""
    try:
        from mujoco.studio import launch_web, web_viewer  # noqa: F401
    except ImportError as error:
        return f"this mujoco ({mujoco.__version__}) brings no web viewer: {error}"
    return None


class WebViewer:
    """Serves the page until it is closed. `url` is where."""

    def __init__(
        self, model: mujoco.MjModel, pilot: Pilot, count: int = 1, *, host: str = LOCAL, port: int = 0, title: str = "legged_mw"
    ) -> None:
        if (reason := missing()) is not None:
            raise ViewError(f"--viewer web: {reason}")
        from mujoco.studio import launch_web, viewer_protocol

        from legged_mw.view.face import Face  # imports what a mujoco without web viewer lacks

        self.cast = Cast(model, count)
        port = free_port(host, port)
        self._face = Face(self.cast, pilot, title)
        config = viewer_protocol.ViewerConfig(title=title, gfx="web", http_port=port)
        with _held_to(host):
            self._handle: Any = launch_web.launch(config, plugins=[self._face])
            self._wait(host, port)
        self.url = f"http://{'localhost' if host == LOCAL else host}:{port}/"
        self.port = port

    def show(self, moment: Moment) -> None:
        """Send one moment to whoever looks."""
        if self.is_running():
            self.cast.pose(moment.qpos, moment.world)
            self._face.show(moment)
            self._handle.sync(self.cast.model, self.cast.data)

    def is_running(self) -> bool:
        """Until `close`; a page that somebody closes may be opened again."""
        return bool(self._handle.is_running())

    def close(self) -> None:
        """Stop serving; again is allowed."""
        self._handle.close()

    def __enter__(self) -> WebViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _wait(self, host: str, port: int) -> None:
        """Until the page is served, and on no other interface than the one asked for."""
        until = time.monotonic() + START_SECONDS
        while not self._listens() and time.monotonic() < until and self._handle.is_running():  # which raises what its thread raised
            time.sleep(0.02)
        if not self._listens():
            self._handle.close()
            raise ViewError("--viewer web: MuJoCo's web viewer did not start")
        bound = self._face.viewer._http_sock.getsockname()
        if host == LOCAL and bound[0] != LOCAL:
            self._handle.close()
            raise ViewError(f"--viewer web: the page would be open to the network ({bound[0]}:{port}); this mujoco binds it otherwise")

    def _listens(self) -> bool:
        """Its server is one more thread, which begins to listen after the viewer is there."""
        return self._face.begun.is_set() and self._face.viewer._http_sock.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) == 1


@contextmanager
def _held_to(host: str) -> Iterator[None]:
    """Studio binds all interfaces and has no setting for it: while it starts, its socket is bound to `host` instead. It also says less."""
    from mujoco.studio import web_viewer
    from mujoco.studio.web import web_server

    bind = getattr(web_server, "bind_public_socket", None)
    if bind is None:
        raise ViewError(f"--viewer web: the page of this mujoco ({mujoco.__version__}) cannot be held to {host}")
    logging.getLogger("WebServer").setLevel(logging.WARNING)
    web_viewer.print = lambda *_, **__: None  # type: ignore[attr-defined]  # its banner names all interfaces
    web_server.bind_public_socket = lambda _, port=0: bind(host, port)
    try:
        yield
    finally:
        web_server.bind_public_socket = bind


def free_port(host: str, port: int = 0) -> int:
    """`port` if nobody listens on it, or the first free one from FIRST_PORT on. Raises ViewError."""
    candidates = [port] if port else range(FIRST_PORT, FIRST_PORT + PORTS)
    for candidate in candidates:
        with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host, candidate))
            except OSError as error:
                if isinstance(error, socket.gaierror) or error.errno == errno.EADDRNOTAVAIL:
                    raise ViewError(f"--host {host}: this machine has no such address ({error.strerror})") from None
                if isinstance(error, PermissionError):
                    raise ViewError(f"--port {candidate}: this user may not listen there; ports from 1024 on are free for all") from None
                continue
            return candidate
    if port:
        raise ViewError(f"--port {port} is in use on {host}; leave it out and the first free one from {FIRST_PORT} is taken")
    raise ViewError(f"--viewer web: ports {FIRST_PORT} to {FIRST_PORT + PORTS - 1} are all in use; name another with --port")


def tunnel_line(port: int) -> str:
    """What to paste into a terminal on the desk, to see the page of this machine there."""
    user = getpass.getuser()
    client = os.environ.get("SSH_CONNECTION", "").split()  # client's address and port, then ours as the client knows them
    if len(client) == 4:
        way = f"-p {client[3]} " if client[3] != "22" else ""
        return f"ssh {way}-L {port}:{LOCAL}:{port} {user}@{client[2]}"
    return f"ssh -L {port}:{LOCAL}:{port} {user}@{socket.gethostname()}"
