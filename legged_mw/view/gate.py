"""Who may reach the web page: a browser that opened it by its own address, with its token where it has one.

Headers in, a refusal out. Nothing here knows MuJoCo.
"""

from __future__ import annotations

import hmac
import ipaddress
import os
import re
import secrets
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

LOCAL = "127.0.0.1"
SOCKETS = ("/ui", "/state")  # paths of Studio's WebSockets that a page needs
FRAMES = ("iframe", "frame", "embed", "object", "fencedframe")
MOST = 1 << 20  # [bytes] of one message from a browser; ours: input of a second is a hundredth of it
PATIENCE = 10.0  # [s] for a browser to say what it wants
HEADERS = {  # of every answer: no other page may show this one or read from it
    "X-Frame-Options": "DENY",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}


def is_local(host: str) -> bool:
    """Whether only this machine reaches ``host``."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"


class Gate:
    """Of one page. A page that others than this machine reach has a token."""

    def __init__(self, host: str, port: int) -> None:
        self.port, self.token = port, "" if is_local(host) else secrets.token_urlsafe(16)
        self._names = {"localhost", host.lower(), socket.gethostname().lower()}
        self._cookie = f"legged_mw_{port}"

    def url(self, host: str) -> str:
        """What the user opens. Of all interfaces (0.0.0.0, ::) it names this machine."""
        name = (
            "localhost"
            if host == LOCAL
            else socket.gethostname()
            if host in ("0.0.0.0", "::")
            else f"[{host}]"
            if ":" in host
            else host
        )
        return f"http://{name}:{self.port}/" + (f"?token={self.token}" if self.token else "")

    def refusal(self, target: str, header: Callable[[str], list[str]]) -> str:
        """Why a request for ``target`` (path and query) is not answered; empty if it is. ``header`` gives all values of a name.

        A name that was rebound to this machine's address (DNS rebinding) shows in Host, a page of another site in Origin or
        Sec-Fetch-Site. A browser sets these three itself; no page can.
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
        """The token in a query."""
        found = re.search(r"[?&]token=([\w-]*)", target)
        return found[1] if found else ""

    def greeting(self, target: str) -> dict[str, str]:
        """Headers that answer a first visit with its right token: keep the token, and leave it out of the address. Else empty."""
        if not self.token or target.partition("?")[0] != "/" or not self._shown(self.asked(target)):
            return {}
        return {"Location": "/", "Set-Cookie": f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"}

    def _shown(self, token: str) -> bool:
        return hmac.compare_digest(token.encode(errors="replace"), self.token.encode())

    def _kept(self, cookies: list[str]) -> list[str]:
        pairs = (pair.strip().partition("=") for line in cookies for pair in line.split(";"))
        return [value for name, _, value in pairs if name == self._cookie]

    def _known(self, host: str) -> bool:
        """Whether a Host is ours: a name that we have, or an address in numbers, which no name server can rebind."""
        match = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[^:\[\]]+)(?::\d{1,5})?", host)
        if not match:
            return False
        name = match[1].strip("[]").lower()
        try:
            return bool(ipaddress.ip_address(name))
        except ValueError:
            return name.rstrip(".") in self._names


class OwnSocket(socket.socket):
    """Listens on this machine for this process alone, where the system says whose a connection is (Linux); else for this machine."""

    def __init__(self, port: int = 0) -> None:
        super().__init__(socket.AF_INET, socket.SOCK_STREAM)
        self.bind((LOCAL, port))
        self.listen()

    def accept(self) -> tuple[socket.socket, Any]:
        """Raises BlockingIOError, as if nobody had come, for somebody else."""
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
