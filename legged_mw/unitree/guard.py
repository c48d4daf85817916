"""The guard: a small process that owns the wire. It damps the robot if the policy's process dies, hangs or is late.

The policy's process sends it complete commands and reads raw states. The guard repeats the newest command at the
robot's own rate. After it has damped, it rejects all commands; only a person can start again.

On every signal that would end it, the guard first damps. A killed or stopped guard cannot damp. The policy's process
sees the time of the guard's last turn, so it detects this and sends damping itself.
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
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from legged_mw.deploy.loop import Spread, real_time
from legged_mw.deploy.robot import RobotError
from legged_mw.unitree import clock
from legged_mw.unitree.codec import LAYOUTS

# [s] ours: limit without a command, three periods at 50 Hz. docs/faults.md has the time until joints are damped
LATE = 0.06
# [s] ours: limit between two turns. Longer: the guard was stopped or this computer slept; the policy's process damps
STILL = 0.04
REPEAT = 0.002  # [s] between two messages to the robot [unitree_sdk2's examples]
AFTER = 1.0  # [s] ours: time of damping before the wire is closed
SIGN = 0.1  # [s] ours: limit for the guard's answer to the last command; then the policy's process damps, too
START = 60.0  # [s] limit for a guard to find the robot
PRIORITY = 30  # ours, of a real-time process: above the policy's, since the guard must outlive it
GONE = "the guard of the wire is gone"
DEAF = "the guard of the wire does not listen"
INSTEAD = "this process damps the joints in its place"
_TURN = 0.001  # [s] longest time between two turns without messages
# checksum of the rest, time of the guard's turn, stamp of the state, length of the text, text
_BOARD = struct.Struct("<IddI512s")
_SUM = 4  # [byte] of the checksum
_LOOKS = 10  # reads of a board during a write, before the last valid content is used
_FRAME = struct.Struct("<Bd")  # kind, stamp of the state that a command answers
# Kinds of command. MOVE: the next one must follow in time. SAFE: may be repeated forever. CLOSE: the last one.
# ARM: stored for a trip, not sent now.
MOVE, SAFE, CLOSE, ARM = 1, 2, 3, 4


class Posted(NamedTuple):
    """The content of the board."""

    body: bytes  # of the newest state
    stamp: float  # [s] arrival of the state
    text: str  # why the guard damped; "" if it did not
    turn: float  # [s] time of the guard's last turn


class Board:
    """Shared memory: the guard writes, the policy's process reads the newest content.

    Content is valid only with a correct checksum, because another processor may see the writes in any order.
    """

    def __init__(self, file: int, size: int) -> None:
        self._map, self._whole = mmap.mmap(file, _BOARD.size + size), bytearray(_BOARD.size + size)
        self._stamp, self._text, self._posted = 0.0, b"", Posted(bytes(size), 0.0, "", 0.0)

    def put(self, turn: float, body: bytes | None = None, stamp: float = 0.0, text: str = "") -> None:
        """Write. State and text stay until they are written again."""
        if body is not None:
            self._whole[_BOARD.size :], self._stamp = body, stamp
        self._text = text.encode()[:512] if text else self._text
        _BOARD.pack_into(self._whole, 0, 0, turn, self._stamp, len(self._text), self._text)
        struct.pack_into("<I", self._whole, 0, zlib.crc32(memoryview(self._whole)[_SUM:]))
        self._map[:] = self._whole

    def get(self) -> Posted:
        """The newest valid content. During a write, or after an incomplete one, it is the previous content."""
        for _ in range(_LOOKS):
            whole = self._map[:]
            right, turn, stamp, length, text = _BOARD.unpack_from(whole)
            if zlib.crc32(memoryview(whole)[_SUM:]) == right:
                self._posted = Posted(whole[_BOARD.size :], stamp, text[:length].decode(errors="replace"), turn)
                break
        return self._posted


def _closed(channel: socket.socket) -> bool:
    """True if the other end of ``channel`` is closed."""
    if channel.fileno() < 0:
        return True
    with contextlib.suppress(OSError):
        return bool(select.select([channel], [], [], 0.0)[0]) and not channel.recv(1, socket.MSG_PEEK)
    return True


# ---- the policy's side ---------------------------------------------------------------------------------------------


class Guarded:
    """The policy process's side of the wire, through a guard.

    If the guard ends, or is silent while the robot moves, this process sends damping instead, until the end.
    """

    def __init__(
        self,
        channel: socket.socket,
        board: Board,
        commander: Any,
        process: subprocess.Popen[bytes] | None = None,
        clock: Callable[[], float] = clock,
    ) -> None:
        """Connect to the guard at the other end of ``channel``.

        ``commander`` (``link.Commander``) sends if the guard fails.
        Raises RobotError with the guard's error if it cannot take the robot over.
        """
        self._channel, self._board, self._commander, self.process, self._clock = (
            channel,
            board,
            commander,
            process,
            clock,
        )
        self._channel.settimeout(START)
        answer = self._answer()
        if "error" in answer or not answer:
            self._channel.close()
            why = f"the guard of the wire did not start: it ended, or took longer than {START:g} s; no command was sent"
            raise RobotError(answer.get("error", why))
        self._channel.settimeout(0.5)
        self._last, self._damping, self._moving = 0.0, b"", False
        self._instead = ""  # why this process damps instead of the guard
        self.first = self.receive()

    @classmethod
    def start(
        cls,
        package: str,
        interface: str,
        domain: int,
        *,
        lies_down: bool = False,
        late: float = LATE,
        find: float = 5.0,
    ) -> Guarded:
        """Start a guard, which takes the robot over (``lies_down`` as in ``link.Wire.prepare``).

        ``find``: [s] to wait for the robot's first state. Raises RobotError with the guard's error.
        """
        from legged_mw.unitree.link import Commander

        size, commander = LAYOUTS[package, "LowState_"].size, Commander(package, interface, domain)
        with tempfile.TemporaryFile() as file:
            file.truncate(_BOARD.size + size)
            board, (channel, theirs) = Board(file.fileno(), size), socket.socketpair()
            with theirs:
                settings = {
                    "package": package,
                    "interface": interface,
                    "domain": domain,
                    "late": late,
                    "still": STILL,
                    "find": find,
                }
                settings |= {"lies_down": lies_down, "channel": theirs.fileno(), "board": file.fileno()}
                program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
                process = subprocess.Popen(
                    [sys.executable, "-c", program, json.dumps(settings)],
                    pass_fds=(theirs.fileno(), file.fileno()),
                    start_new_session=True,  # Ctrl-C in the terminal must not reach the guard
                )
        owner = cls(channel, board, commander, process)
        try:
            commander.wait(2, find)  # two readers: the robot and the guard, which listens for other commanders
        except RobotError:
            owner.close(b"")
            raise
        return owner

    def receive(self) -> Any:
        """The newest state with its stamp; None if no state arrived since the last call. Raises RobotError."""
        from legged_mw.unitree.link import Received

        now = self._clock()  # before reading the board, so that a pause here does not count as the guard's
        body, stamp, text, turn = self._board.get()
        silent, known = now - turn, self._instead
        if self._ended():
            self._damp_instead(GONE)
        elif self._moving and silent > STILL:
            self._damp_instead(f"the guard of the wire was silent for {1000 * silent:.0f} ms")
        if text or self._instead:
            # a running guard reports this process as another program; raise the first cause
            raise RobotError(known or text or self._instead)
        if stamp == self._last:
            return None
        self._last = stamp
        return Received(body, stamp)

    def arm(self, damping: bytes) -> None:
        """Store the command that damps this robot, to be sent if this process fails."""
        self._damping = damping
        self._put(ARM, 0.0, damping)

    def send(self, body: bytes, stamp: float, safe: bool) -> None:
        """Send a command computed from the state of ``stamp`` [s]. ``safe``: it may be repeated forever."""
        if not self._instead:
            self._moving = not safe
            self._put(SAFE if safe else MOVE, stamp, body)
        else:
            self._commander.send(self._damping)

    def close(self, last: bytes) -> str:
        """Send ``last`` for a while and close. Returns the guard's report of latencies, or why this process damped."""
        answer: dict[str, Any] = {}
        if sends_last := bool(last) and not self._instead and self._channel.fileno() >= 0:
            self._put(CLOSE, 0.0, last)
            self._channel.settimeout(SIGN)
            if not (answer := self._answer()):
                self._damp_instead(GONE if self._ended() else DEAF)
        end = self._clock() + AFTER
        while self._instead and self._clock() < end:
            self._commander.send(self._damping)
            time.sleep(REPEAT)
        if sends_last and not answer:
            answer = self._answer()  # a slow guard may answer now
        self._channel.close()
        if self.process:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(0.0 if self._instead else AFTER + 2.0)
        return answer.get("report", self._instead if sends_last else "")

    def _ended(self) -> bool:
        """True if the guard's end of the channel is closed."""
        return _closed(self._channel)

    def _damp_instead(self, why: str) -> None:
        """Send damping from this process from now on. A guard that still runs also damps, see ``WireGuard.turn``."""
        if self._damping and not self._instead:
            self._instead = f"{why}; {INSTEAD}"
            self._commander.send(self._damping)

    def _put(self, kind: int, stamp: float, body: bytes) -> None:
        try:
            self._channel.sendall(_FRAME.pack(kind, stamp) + body)
        except TimeoutError:
            self._damp_instead(DEAF)
        except OSError:
            self._damp_instead(GONE)

    def _answer(self) -> dict[str, Any]:
        """A line of JSON from the guard; empty if no line arrives."""
        data = b""
        with contextlib.suppress(OSError):
            while not data.endswith(b"\n") and (more := self._channel.recv(65536)):
                data += more
        return json.loads(data) if data.endswith(b"\n") else {}


# ---- the guard's side ----------------------------------------------------------------------------------------------


class WireGuard:
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
        self.wire, self.channel, self.board, self.late, self.clock, self.still = (
            wire,
            channel,
            board,
            late,
            clock,
            still,
        )
        self._size = _FRAME.size + LAYOUTS[package, "LowCmd_"].size
        self._buffer, self._latencies = b"", deque[float](maxlen=1 << 16)
        self._command, self._damping = b"", b""  # the repeated command; its replacement after a trip
        self._moving, self._heard, self._until, self._due, self._looked = False, 0.0, float("inf"), 0.0, clock()
        self.tripped, self._stopped = "", 0
        channel.setblocking(False)

    def stop(self, number: int = signal.SIGTERM, *_: object) -> None:
        """Signal handler: damp and end."""
        self._stopped = number

    def run(self) -> None:
        """Run until AFTER [s] from the last command, from the end of the policy's process, or from `stop`."""
        while self.clock() < self._until:
            select.select([self.channel] if self.channel.fileno() >= 0 else [], [], [], _TURN)
            self.turn()

    def turn(self) -> None:
        """Check wire and channel once. Commands come last: they may have waited while the guard was stopped."""
        now = self.clock()
        still, self._looked = now - self._looked, now
        if still < 0.0:  # the clock went back: shift all stored times
            self._heard, self._until, self._due = (each + still for each in (self._heard, self._until, self._due))
        if self._moving and still < 0.0:
            self.trip(f"this computer's clock went back by {-still:.1f} s")
        if self._moving and still > self.still:
            self.trip(f"nothing was sent for {1000 * still:.0f} ms: the guard stood still, or this computer slept")
        if self._command and self.wire.other_commander():
            self.trip("another program sends commands to this robot, too")
        if why := self.wire.another_robot():
            self.trip(why)
        self._hear(now)
        if self._moving and now - self._heard > self.late:
            self.trip(f"no targets for {1000 * (now - self._heard):.0f} ms: the policy's process hangs or is late")
        if self._stopped:
            self.trip(f"the guard was stopped ({_name(self._stopped)})")
            self._until = min(self._until, now + AFTER)
        if self._command and now >= self._due:
            self._send()
            self._due = now + REPEAT
        self.board.put(now, *(self.wire.receive() or ()))

    def _hear(self, now: float) -> None:
        """Read the messages of the policy's process. The newest command is used."""
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
            self.wire.send(body)  # before the answer: after it no other process sends this command
            self.tell({"report": self._report()})
        elif not self.tripped:
            self._command, self._moving, self._heard = body, kind == MOVE, now
            self._send()
            if kind == MOVE:
                self._latencies.append(self.clock() - stamp)

    def _send(self) -> None:
        """Send the command, unless the guard was stopped during this turn; then the next turn damps."""
        if self.clock() - self._looked <= self.still:
            self.wire.send(self._command)

    def trip(self, why: str) -> None:
        """Damp from now on and report why. Only the first reason is reported."""
        if self._command:
            self._command = self._damping
            self.wire.send(self._command)
        if not self.tripped:
            self.tripped, self._moving = why, False
            done = f"{why}; the joints are damped" if self._command else why
            self.board.put(self._looked, text=done)
            # on a thread: a terminal that is paused (Ctrl-S) must not stop the damping
            threading.Thread(target=_say, args=(f"guard: {done}",), daemon=True).start()

    def _report(self) -> str:
        lines = [f"{self.wire.dropped} states of another size dropped"] if getattr(self.wire, "dropped", 0) else []
        if self._latencies:
            lines.insert(
                0, f"from a measurement to its target: {Spread.of(self._latencies)} ({len(self._latencies)} targets)"
            )
        return "; ".join(lines)

    def tell(self, what: dict[str, Any]) -> None:
        with contextlib.suppress(OSError):
            self.channel.sendall(json.dumps(what).encode() + b"\n")


# Signals that keep their handlers: those that cannot be caught, those that end nothing, and those of the guard's own
# errors (a handler would return to the error forever).
KEPT = {
    getattr(signal, f"SIG{name}")
    for name in ("KILL", "STOP", "CHLD", "CONT", "URG", "WINCH", "PIPE", "SEGV", "BUS", "FPE", "ILL")
}


def _say(line: str) -> None:
    with contextlib.suppress(OSError):  # the terminal is closed
        print(line, file=sys.stderr, flush=True)


def _name(number: int) -> str:
    return signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"


def main() -> None:
    from legged_mw.unitree.link import Wire, claim

    settings = json.loads(sys.argv[1])
    channel = socket.socket(fileno=settings["channel"])
    real_time(PRIORITY, heirs=True)  # before DDS starts its threads

    def wait() -> None:
        """Wait a moment. Raises RobotError if the policy's process ended: then the robot keeps its own program."""
        time.sleep(0.001)
        if _closed(channel):
            raise RobotError("the policy's process ended")

    try:
        # the previous guard may still damp
        claimed = claim(settings["interface"], settings["domain"], 2 * AFTER)
        wire = Wire(settings["package"], settings["interface"], settings["domain"], wait)
        first = wire.prepare(settings["find"], lies_down=settings["lies_down"])
    except RobotError as error:
        with contextlib.suppress(OSError):  # the policy's process ended
            channel.sendall(json.dumps({"error": str(error)}).encode() + b"\n")
        return
    board = Board(settings["board"], len(first.body))
    board.put(first.stamp, first.body, first.stamp)
    guard = WireGuard(wire, channel, board, settings["package"], settings["late"], still=settings["still"])
    for number in signal.valid_signals() - KEPT:
        signal.signal(number, guard.stop)
    guard.tell({"ready": True})
    gc.freeze()
    gc.disable()
    guard.run()
    if claimed:
        claimed.close()
