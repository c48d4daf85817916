"""The guard: a small process that owns the wire, so that a robot is damped when the policy's process dies, hangs or is late.

The policy's process gives it finished commands and gets states back as they came. The guard repeats the newest command at the
robot's own rate. Once it has damped, it refuses every command: nothing resumes without a person.

A guard that is killed itself can damp nothing. Then the robot holds its last command, perhaps for ever.
"""

from __future__ import annotations

import contextlib
import gc
import json
import mmap
import select
import signal
import socket
import struct
import subprocess
import sys
import tempfile
from collections import deque
from collections.abc import Callable
from typing import Any

from legged_mw.deploy.loop import Spread, real_time
from legged_mw.deploy.robot import RobotError
from legged_mw.deploy.unitree import clock
from legged_mw.deploy.unitree.codec import LAYOUTS

LATE = 0.06  # [s] ours: three periods at 50 Hz without a command; docs/faults.md has what the joints then take to be damped
STILL = 0.1  # [s] ours, between two looks at the wire: this computer slept, or the guard was stopped
REPEAT = 0.002  # [s] between two messages to the robot [unitree_sdk2's examples]
AFTER = 1.0  # [s] ours: how long damping is sent before the wire is let go
START = 60.0  # [s] for a guard to find the robot
PRIORITY = 30  # ours, of a real-time process: before the policy's, which it must outlive
GONE = "the guard of the wire is gone: the robot may hold its last command. Press its emergency stop"
_TURN = 0.001  # [s] at most between two looks at the wire
_BOARD = struct.Struct("<QdI512s")  # changes of the board (odd: one is going on), stamp of the state, bytes of the text, text
_FRAME = struct.Struct("<Bd")  # kind, stamp of the state that a command answers
# Kinds of command: another must follow in time; may be repeated for ever; the last one; stored for a trip, not sent now.
MOVE, SAFE, CLOSE, ARM = 1, 2, 3, 4


class Board:
    """Memory of two processes: the guard writes states and a text, the policy's process reads the newest."""

    def __init__(self, file: int, size: int) -> None:
        self._map, self._size, self._seen = mmap.mmap(file, _BOARD.size + size), size, 0
        self._changes, self._stamp, self._text, self._body = 0, 0.0, b"", bytes(size)

    def put(self, body: bytes | None = None, stamp: float = 0.0, text: str = "") -> None:
        if body is not None:
            self._body, self._stamp = body, stamp
        self._text = text.encode()[:512] if text else self._text
        struct.pack_into("<Q", self._map, 0, self._changes + 1)
        self._map[_BOARD.size :] = self._body
        struct.pack_into("<dI512s", self._map, 8, self._stamp, len(self._text), self._text)
        self._changes += 2
        struct.pack_into("<Q", self._map, 0, self._changes)

    def get(self) -> tuple[bytes, float, str]:
        """State, stamp, text. What is being written meanwhile is read again. Raises RobotError if that does not end."""
        end = clock() + STILL
        while clock() < end:
            before, stamp, length, text = _BOARD.unpack_from(self._map)
            body = self._map[_BOARD.size :]
            if before % 2 == 0 and struct.unpack_from("<Q", self._map)[0] == before:
                return body, stamp, text[:length].decode(errors="replace")
        raise RobotError(GONE)


# ---- the policy's side ---------------------------------------------------------------------------------------------


class Guarded:
    """The wire as the policy's process sees it, through a guard (see ``client.Owner``)."""

    def __init__(self, channel: socket.socket, board: Board, process: subprocess.Popen[bytes] | None = None) -> None:
        """Of a guard at the other end of ``channel``; raises RobotError with its error if it does not take the robot over."""
        self._channel, self._board, self.process = channel, board, process
        self._channel.settimeout(START)
        said = self._answer()
        if "error" in said or not said:
            self._channel.close()
            why = f"the guard of the wire did not start: it ended, or took longer than {START:g} s; no command was sent"
            raise RobotError(said.get("error", why))
        self._channel.settimeout(0.5)
        self._last = 0.0
        self.first = self.receive()

    @classmethod
    def start(cls, package: str, interface: str, domain: int, *, lies_down: bool = False, late: float = LATE, find: float = 5.0) -> Guarded:
        """Start a guard, which takes the robot over (``lies_down`` as in ``link.Wire.prepare``).

        ``find``: [s] to wait for the robot's first state. Raises RobotError with the guard's error.
        """
        size = LAYOUTS[package, "LowState_"].size
        with tempfile.TemporaryFile() as file:
            file.truncate(_BOARD.size + size)
            board, (channel, theirs) = Board(file.fileno(), size), socket.socketpair()
            with theirs:
                settings = {"package": package, "interface": interface, "domain": domain, "late": late, "still": STILL, "find": find}
                settings |= {"lies_down": lies_down, "channel": theirs.fileno(), "board": file.fileno()}
                program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
                process = subprocess.Popen(
                    [sys.executable, "-c", program, json.dumps(settings)],
                    pass_fds=(theirs.fileno(), file.fileno()),
                    start_new_session=True,  # a Ctrl-C in the terminal is not for the guard
                )
        return cls(channel, board, process)

    def receive(self) -> Any:
        from legged_mw.deploy.unitree.link import Received

        body, stamp, text = self._board.get()
        if text:
            raise RobotError(text)
        if stamp == self._last:
            return None
        self._last = stamp
        return Received(body, stamp)

    def arm(self, damping: bytes) -> None:
        self._put(ARM, 0.0, damping)

    def send(self, body: bytes, stamp: float, safe: bool) -> None:
        self._put(SAFE if safe else MOVE, stamp, body)

    def close(self, last: bytes) -> str:
        """Returns the latency of measurements, as the guard saw it."""
        said: dict[str, Any] = {}
        if self._channel.fileno() >= 0:
            with contextlib.suppress(RobotError):
                if last:
                    self._put(CLOSE, 0.0, last)
                    self._channel.settimeout(AFTER + 2.0)
                    said = self._answer()
            self._channel.close()
        if self.process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(AFTER + 2.0)
        return said.get("report", "")

    def _put(self, kind: int, stamp: float, body: bytes) -> None:
        try:
            self._channel.sendall(_FRAME.pack(kind, stamp) + body)
        except OSError:
            if text := self._board.get()[2]:
                raise RobotError(text) from None
            raise RobotError(GONE) from None

    def _answer(self) -> dict[str, Any]:
        """A line of JSON from the guard; empty if none comes."""
        data = b""
        with contextlib.suppress(OSError):
            while not data.endswith(b"\n") and (more := self._channel.recv(65536)):
                data += more
        return json.loads(data) if data.endswith(b"\n") else {}


# ---- the guard's side ----------------------------------------------------------------------------------------------


class Guard:
    """The loop of the guard's process."""

    def __init__(
        self,
        wire: Any,
        channel: socket.socket,
        board: Board,
        package: str,
        late: float = LATE,
        clock: Callable[[], float] = clock,
        still: float = STILL,
    ) -> None:
        self.wire, self.channel, self.board, self.late, self.clock, self.still = wire, channel, board, late, clock, still
        self._size = _FRAME.size + LAYOUTS[package, "LowCmd_"].size
        self._buffer, self._latencies = b"", deque[float](maxlen=1 << 16)
        self._command, self._damping = b"", b""  # the command that is repeated; the one that replaces it after a trip
        self._moving, self._heard, self._until, self._due, self._looked = False, 0.0, float("inf"), 0.0, float("inf")
        self.tripped, self._stopped = "", False
        channel.setblocking(False)

    def stop(self, *_: object) -> None:
        """Damp, and end; a signal's handler."""
        self._stopped = True

    def run(self) -> None:
        """Run until AFTER [s] from the last command, from the end of the policy's process, or from `stop`."""
        while self.clock() < self._until:
            select.select([self.channel] if self.channel.fileno() >= 0 else [], [], [], _TURN)
            self.turn()

    def turn(self) -> None:
        """One look at both sides."""
        now = self.clock()
        still, self._looked = now - self._looked, now
        if self._moving and still > self.still:
            self.trip(f"nothing was sent for {1000 * still:.0f} ms: the guard stood still, or this computer slept")
        self._hear(now)
        if state := self.wire.receive():
            self.board.put(state.body, state.stamp)
        if self._moving and now - self._heard > self.late:
            self.trip(f"no targets for {1000 * (now - self._heard):.0f} ms: the policy's process hangs or is late")
        if self._command and self.wire.other_commander():
            self.trip("another program sends commands to this robot, too")
        if self._stopped:
            self.trip("the guard was stopped (SIGTERM)")
            self._until = min(self._until, now + AFTER)
        if self._command and now >= self._due:
            self.wire.send(self._command)
            self._due = now + REPEAT

    def _hear(self, now: float) -> None:
        """Take what the policy's process sent; the newest command counts."""
        if self.channel.fileno() < 0:
            return
        try:
            data = self.channel.recv(1 << 20)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if not data:
            self.channel.close()
            if self._until == float("inf"):
                self.trip("the policy's process ended")
                self._until = now + AFTER
            return
        self._buffer += data
        while len(self._buffer) >= self._size:
            frame, self._buffer = self._buffer[: self._size], self._buffer[self._size :]
            kind, stamp = _FRAME.unpack_from(frame)
            self._obey(kind, stamp, frame[_FRAME.size :], now)

    def _obey(self, kind: int, stamp: float, body: bytes, now: float) -> None:
        if kind == ARM:
            self._damping = body
        elif kind == CLOSE:
            self._command, self._moving, self._until = body, False, now + AFTER
            self.tell({"report": self._report()})
        elif not self.tripped:
            self._command, self._moving, self._heard = body, kind == MOVE, now
            self.wire.send(body)
            if kind == MOVE:
                self._latencies.append(self.clock() - stamp)

    def trip(self, why: str) -> None:
        """Damp from now on, and say why; the first reason counts."""
        if self._command:
            self._command = self._damping
            self.wire.send(self._command)
        if not self.tripped:
            self.tripped, self._moving = why, False
            done = f"{why}; the joints are damped" if self._command else why
            self.board.put(text=done)
            print(f"guard: {done}", file=sys.stderr, flush=True)

    def _report(self) -> str:
        lines = [f"{self.wire.dropped} states of another size dropped"] if getattr(self.wire, "dropped", 0) else []
        if self._latencies:
            lines.insert(0, f"from a measurement to its target: {Spread.of(self._latencies)} ({len(self._latencies)} targets)")
        return "; ".join(lines)

    def tell(self, what: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            self.channel.sendall(json.dumps(what).encode() + b"\n")


def main() -> None:
    from legged_mw.deploy.unitree.link import Wire, claim

    settings = json.loads(sys.argv[1])
    channel = socket.socket(fileno=settings["channel"])
    real_time(PRIORITY, heirs=True)  # before DDS starts its threads
    try:
        claimed = claim(settings["interface"], settings["domain"], 2 * AFTER)  # a guard before this one may still damp
        wire = Wire(settings["package"], settings["interface"], settings["domain"])
        first = wire.prepare(settings["find"], lies_down=settings["lies_down"])
    except RobotError as error:
        channel.sendall(json.dumps({"error": str(error)}).encode() + b"\n")
        return
    board = Board(settings["board"], len(first.body))
    board.put(first.body, first.stamp)
    guard = Guard(wire, channel, board, settings["package"], settings["late"], still=settings["still"])
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, guard.stop)
    guard.tell({"ready": True})
    gc.freeze()
    gc.disable()
    guard.run()
    if claimed:
        claimed.close()
