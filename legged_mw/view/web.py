"""The web page: MuJoCo Studio's web viewer with our panel, and our page of pictures. It loads nothing from the internet.

The page is not encrypted, so by default it is bound to 127.0.0.1; use `ssh -L` to reach it from another machine.
`Gate` controls the access. Undocumented parts of Studio are used in `_bound_to` and `_wait` only.
"""

from __future__ import annotations

import atexit
import errno
import getpass
import hmac
import ipaddress
import logging
import os
import re
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import mujoco

from legged_mw.view.drive import Pilot
from legged_mw.view.posed_robot import PosedRobots
from legged_mw.view.stage import Moment, ViewError
from legged_mw.view.stream import ADDED, PAGE, Stream

LOCAL = "127.0.0.1"
FIRST_PORT, PORTS = 8080, 20
START_SECONDS = 20.0


def missing() -> str | None:
    """The reason why this machine cannot serve a page, or None."""
    try:
        from mujoco.studio import launch_web, web_viewer  # noqa: F401
    except ImportError as error:
        return f"this mujoco ({mujoco.__version__}) brings no web viewer: {error}"
    return None


class WebViewer:
    """Serves the page at `url` until `close`. Once per process: after `close`, another one may crash in MuJoCo."""

    _opened = False  # by this process

    def __init__(
        self,
        spec: mujoco.MjSpec,
        pilot: Pilot,
        count: int = 1,
        *,
        host: str = LOCAL,
        port: int = 0,
        title: str = "legged_mw",
    ) -> None:
        if (reason := missing()) is not None:
            raise ViewError(f"--viewer web: {reason}")
        from mujoco.studio import launch_web, viewer_protocol

        from legged_mw.view.studio import StudioPlugin  # the import fails if mujoco lacks the web viewer

        self.robots = PosedRobots(spec, count)
        public = listen(host, port)
        # Studio's NetImgui client is a C++ global: a second one hangs while the first lives, and can crash afterwards
        if WebViewer._opened:
            public.close()
            raise ViewError(
                "--viewer web: this process has opened a page, and MuJoCo's web viewer opens one in a process: start another process"
            )
        self.port: int = public.getsockname()[1]
        self._plugin, gate = StudioPlugin(self.robots, pilot, title), Gate(host, self.port)
        self._stream = Stream(self.robots, self._plugin.panel)
        config = viewer_protocol.ViewerConfig(title=title, gfx="web", http_port=self.port)
        with _bound_to(public, gate, self._stream) as served:
            WebViewer._opened = True
            self._handle: Any = launch_web.launch(config, plugins=[self._plugin])
            self._wait(host, served)
        self.url = gate.url(host)
        atexit.register(self.close)  # an open page at exit is a segmentation fault

    def show(self, moment: Moment) -> None:
        """Send one moment to all browsers."""
        if self.is_running():
            with self._plugin.lock:
                self.robots.pose(moment.qpos, moment.world)
            self._plugin.show(moment)
            self._handle.sync(self.robots.model, self.robots.data)

    def is_running(self) -> bool:
        """True until `close`: the user may open a closed browser page again."""
        return bool(self._handle.is_running())

    def close(self) -> None:
        """Stop serving. May be called twice."""
        atexit.unregister(self.close)
        try:
            self._handle.close()
        finally:
            self._stream.close()

    def _wait(self, host: str, served: threading.Event) -> None:
        """Wait until the page is served. Refuse any interface other than `host`."""
        until = time.monotonic() + START_SECONDS
        # is_running raises the exception of the viewer's thread
        while not served.wait(0.02) and time.monotonic() < until and self._handle.is_running():
            pass
        if not (served.is_set() and self._plugin.begun.wait(max(0.0, until - time.monotonic()))):
            self.close()
            raise ViewError("--viewer web: MuJoCo's web viewer did not start")
        bound = self._plugin.viewer._http_sock.getsockname()  # pyright: ignore[reportAttributeAccessIssue]
        if host == LOCAL and bound[0] != LOCAL:
            self.close()
            raise ViewError(
                f"--viewer web: the page would be open to the network ({bound[0]}:{bound[1]}); this version of mujoco binds it differently"
            )


@contextmanager
def _bound_to(public: socket.socket, gate: Gate, stream: Stream) -> Iterator[threading.Event]:
    """While Studio starts: give it `public`, for which it has no setting, add our pages, and reduce its log.

    The event is set when Studio serves.
    """
    from mujoco.studio import web_viewer
    from mujoco.studio.web import web_server

    names, served = ("bind_public_socket", "bind_loopback_socket", "serve"), threading.Event()
    bind, inner, serve = (getattr(web_server, name, None) for name in names)
    if bind is None or inner is None or serve is None:
        public.close()
        raise ViewError(f"--viewer web: the page of this mujoco ({mujoco.__version__}) cannot be bound and guarded")

    def serve_guarded(handler: Any, **settings: Any) -> Any:
        served.set()
        return serve(stream.around(handler), **_guarded(settings, gate))

    logging.getLogger("WebServer").setLevel(logging.WARNING)
    web_viewer.print = lambda *_, **__: None  # type: ignore[attr-defined]  # Studio's banner would name all interfaces
    web_server.bind_public_socket = lambda *_, **__: public
    web_server.bind_loopback_socket = OwnSocket  # the link from the page's server to the panel, both in this process
    web_server.serve = serve_guarded
    try:
        yield served
    finally:
        del web_viewer.print  # pyright: ignore[reportAttributeAccessIssue]
        web_server.bind_public_socket, web_server.bind_loopback_socket, web_server.serve = bind, inner, serve


def _guarded(settings: dict[str, Any], gate: Gate) -> dict[str, Any]:
    """The settings of Studio's server, with `gate` before each request, our pages, and limits on a browser's messages."""
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    answer, finish = settings["process_request"], settings["process_response"]

    def answer_known(connection: Any, request: Any) -> Any:
        status, reason, extra = 403, gate.refusal(request.path, request.headers.get_all), {}
        if not reason and (extra := gate.greeting(request.path)):
            status, reason = 303, "welcome"
        path = request.path.partition("?")[0]
        if not reason and path == "/drawn":
            html = {"Content-Type": "text/html; charset=utf-8", "Content-Length": str(len(PAGE))}
            return Response(200, "OK", Headers({**html, "Cache-Control": "no-store"}), PAGE)
        if not reason and path == "/stream":
            return None  # continue with the handshake
        if not reason:
            response = answer(connection, request)
            whole = path in ("/", "/index.html") and response.status_code == 200
            return with_ours(response) if whole else response
        body = f"{reason}\n".encode()
        plain = {"Content-Type": "text/plain; charset=utf-8", "Content-Length": str(len(body))}
        plain |= {"Connection": "close", "Cache-Control": "no-store"}
        return Response(status, "Forbidden" if status == 403 else "See Other", Headers({**plain, **extra}), body)

    def with_ours(page: Any) -> Any:
        page.body = page.body.replace(b"<body>", b"<body>" + ADDED, 1)
        del page.headers["Content-Length"]
        page.headers["Content-Length"] = str(len(page.body))
        return page

    def finish_safely(connection: Any, request: Any, response: Any) -> Any:
        finish(connection, request, response)
        for name, value in {**HEADERS, "Access-Control-Allow-Origin": ""}.items():
            if name in response.headers:
                del response.headers[name]
            if value:
                response.headers[name] = value

    guard = {"process_request": answer_known, "process_response": finish_safely}
    return {**settings, **guard, "max_size": MOST, "open_timeout": PATIENCE}


def listen(host: str, port: int = 0) -> socket.socket:
    """A socket that listens on `port`; for 0 on the first free port from FIRST_PORT on. Raises ViewError.

    It listens from here on, so that another program that starts now takes another port.
    """
    if not host:  # an empty host would mean all interfaces
        raise ViewError(
            f"--host is empty; leave it out for {LOCAL} (this machine only), or name an interface (0.0.0.0: all)"
        )
    candidates = [port] if port else range(FIRST_PORT, FIRST_PORT + PORTS)
    for candidate in candidates:
        public = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        try:
            public.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if ":" in host:
                public.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 0)  # :: is all addresses, IPv4's too
            public.bind((host, candidate))
            public.listen()
            return public
        except (OSError, TypeError) as error:  # the latter for a name that no host can have
            public.close()
            if isinstance(error, socket.gaierror | TypeError) or error.errno == errno.EADDRNOTAVAIL:
                why = getattr(error, "strerror", None) or error
                raise ViewError(f"--host {host}: this machine has no such address ({why})") from None
            if isinstance(error, PermissionError):
                raise ViewError(
                    f"--port {candidate}: this user may not listen there; ports from 1024 on are free for all"
                ) from None
    if port:
        raise ViewError(
            f"--port {port} is in use on {host}; leave it out and the first free one from {FIRST_PORT} is taken"
        )
    raise ViewError(
        f"--viewer web: ports {FIRST_PORT} to {FIRST_PORT + PORTS - 1} are all in use; name another with --port"
    )


def tunnel_line(port: int) -> str:
    """The ssh command that forwards the page to the user's machine."""
    user = getpass.getuser()
    # SSH_CONNECTION: the client's address and port, then ours as the client sees them
    client = os.environ.get("SSH_CONNECTION", "").split()
    if len(client) == 4:
        port_flag = f"-p {client[3]} " if client[3] != "22" else ""
        return f"ssh {port_flag}-L {port}:{LOCAL}:{port} {user}@{client[2]}"
    return f"ssh -L {port}:{LOCAL}:{port} {user}@{socket.gethostname()}"


# ---- access control: a browser must open the page's own address, with its token if the page has one

SOCKETS = ("/ui", "/state", "/stream")  # paths of the pages' WebSockets
PAGES = ("/", "/drawn")
FRAMES = ("iframe", "frame", "embed", "object", "fencedframe")
MOST = 1 << 20  # [bytes] largest message from a browser; ours: 100 times the input of one second
PATIENCE = 10.0  # [s] time limit for a browser's request
HEADERS = {  # of every response: no other page may embed this one or read from it
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def is_local(host: str) -> bool:
    """Whether ``host`` is reachable from this machine only."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class Gate:
    """The access control of one page. A page that other machines can reach has a token."""

    def __init__(self, host: str, port: int) -> None:
        self.port, self.token = port, "" if is_local(host) else secrets.token_urlsafe(16)
        self._names = {"localhost", host.lower(), socket.gethostname().lower()}
        self._cookie = f"legged_mw_{port}"

    def url(self, host: str) -> str:
        """The address for the user's browser. For all interfaces (0.0.0.0, ::) it names this machine."""
        name = f"[{host}]" if ":" in host else host
        if host == LOCAL:
            name = "localhost"
        elif host in ("0.0.0.0", "::"):
            name = socket.gethostname()
        return f"http://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def refusal(self, target: str, header: Callable[[str], list[str]]) -> str:
        """The reason to refuse a request for ``target`` (path and query); empty to accept it.

        ``header``: name -> all values. DNS rebinding shows in Host; a page of another site in Origin or Sec-Fetch-Site.
        The browser sets these three headers, and no page can change them.
        """
        host, origin, path = header("Host"), header("Origin"), target.partition("?")[0]
        if len(host) != 1 or not self._known(host[0]):
            return f"this page answers to localhost, to this machine's name and to addresses in numbers: open http://localhost:{self.port}/"
        if any(one not in (f"http://{host[0]}", f"https://{host[0]}") for one in origin) or (
            path in SOCKETS and len(origin) != 1
        ):
            return "a page of another site may not reach this one"
        opened = header("Sec-Fetch-Mode") == ["navigate"] and not {*header("Sec-Fetch-Dest")} & {*FRAMES}
        if {*header("Sec-Fetch-Site")} & {"cross-site", "same-site"} and not opened:
            return "a page of another site may not show this one or read from it"
        if path == "/drop":
            return "models cannot be dropped on this page"
        if (
            self.token
            and not self._shown(self.asked(target))
            and not any(map(self._shown, self._kept(header("Cookie"))))
        ):
            return "this page has a token: open the address that the program printed, with ?token="
        return ""

    def asked(self, target: str) -> str:
        """The token in the query of ``target``."""
        match = re.search(r"[?&]token=([\w-]*)", target)
        return match[1] if match else ""

    def greeting(self, target: str) -> dict[str, str]:
        """Headers for a first visit with the right token: set a cookie, drop the token from the address. Else empty."""
        path = target.partition("?")[0]
        if not self.token or path not in PAGES or not self._shown(self.asked(target)):
            return {}
        return {"Location": path, "Set-Cookie": f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"}

    def _shown(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(errors="replace"), self.token.encode())

    def _kept(self, cookies: list[str]) -> list[str]:
        pairs = (pair.strip().partition("=") for line in cookies for pair in line.split(";"))
        return [value for name, _, value in pairs if name == self._cookie]

    def _known(self, host: str) -> bool:
        """Whether a Host header is ours: a known name, or a numeric address, which DNS cannot rebind."""
        match = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[^:\[\]]+)(?::\d{1,5})?", host)
        if not match:
            return False
        name = match[1].strip("[]").lower()
        try:
            return bool(ipaddress.ip_address(name))
        except ValueError:
            return name.rstrip(".") in self._names


class OwnSocket(socket.socket):
    """A listening socket that accepts only this process on Linux, and only this machine on other systems."""

    def __init__(self, port: int = 0) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self.bind((LOCAL, port))
        self.listen()

    def accept(self) -> tuple[socket.socket, Any]:
        """Accept a connection. Raises BlockingIOError, as without a connection, for another process."""
        connection, peer = super().accept()
        if not is_own(peer[1], self.getsockname()[1]):
            connection.close()
            raise BlockingIOError
        return connection, peer


def is_own(port: int, listener: int) -> bool:
    """Whether a socket of this process has ``port`` and is connected to ``listener`` on this machine."""
    try:
        lines = [line.split() for line in Path("/proc/self/net/tcp").read_text().splitlines()]
    except OSError:
        return True
    inodes = {line[9] for line in lines if line[1:3] == [f"0100007F:{port:04X}", f"0100007F:{listener:04X}"]}
    for each in os.listdir("/proc/self/fd"):
        with suppress(OSError):
            if os.readlink(f"/proc/self/fd/{each}") in {f"socket:[{inode}]" for inode in inodes}:
                return True
    return False
