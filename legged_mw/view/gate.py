"""Access control of the web page: a browser must open the page's own address, with its token if the page has one.

Takes request headers, returns a refusal. Independent of MuJoCo.
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
SOCKETS = ("/ui", "/state")  # paths of the page's WebSockets in Studio
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
        found = re.search(r"[?&]token=([\w-]*)", target)
        return found[1] if found else ""

    def greeting(self, target: str) -> dict[str, str]:
        """Headers for a first visit with the right token: set a cookie, drop the token from the address. Else empty."""
        if not self.token or target.partition("?")[0] != "/" or not self._shown(self.asked(target)):
            return {}
        return {"Location": "/", "Set-Cookie": f"{self._cookie}={self.token}; Path=/; HttpOnly; SameSite=Lax"}

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
