"""Input sources: the robot's remote, a gamepad, the keys of a terminal, a file descriptor that stops the robot.

The loop polls each source once per step. A source must not block. It returns the buttons pressed since the last poll,
the command of its sticks, and a reason to stop. This module moves no robot.
"""

from __future__ import annotations

import contextlib
import os
import select
import struct
import sys
import termios
import tty
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import numpy as np

from legged_mw.deploy.robot import Floats, Health, Remote, RobotError
from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.view.drive import ACTIONS, BINDINGS, Pilot

START, WALK, END = "start", "A", "select"  # buttons that change the state [unitree_rl_gym]
STOP = frozenset({"L2", "B"})  # pressed together: emergency stop [unitree_rl_lab]
DEAD = 0.08  # [-] deadband of a stick around its centre
_STICKS = dict(zip(VELOCITY, (("ly", 1.0), ("lx", -1.0), ("rx", -1.0)), strict=True))  # command -> stick, sign


class DriveInput(NamedTuple):
    """The input of one step."""

    pressed: frozenset[str] = frozenset()  # of START, WALK, END, since the last step
    command: Floats | None = None  # (C,); None: this source gives no command now
    stop: str = ""  # reason to damp the robot at once


class InputSource(Protocol):
    """An input source. By default it gives no command of its own and holds nothing open."""

    def poll(self, health: Health) -> DriveInput:
        """The input since the last call."""
        ...

    def let_go(self) -> None:
        """Clear this source's command, because another source drives now, or the policy ended."""

    def close(self) -> None:
        """Release the terminal and close files. Safe to call twice."""


def from_sticks(remote: Remote, table: Sequence[Command]) -> Floats | None:
    """The command (C,) of the sticks; None if all are centred.

    The ends of a stick are the ends of the trained range. Its centre is the default.
    """
    command, moved = np.array([each.default for each in table]), False
    for column, each in enumerate(table):
        stick, sign = _STICKS.get(each.name, ("", 0.0))
        value = sign * getattr(remote, stick) if stick else 0.0
        if abs(value) > DEAD:
            end = each.high if value > 0 else each.low
            command[column] = each.default + min(abs(value), 1.0) * (end - each.default)
            moved = True
    return command if moved else None


class RobotRemote(InputSource):
    """The robot's own remote, as `health` reports it."""

    name = "the remote"

    def __init__(self, table: Sequence[Command]) -> None:
        self.table, self._held = tuple(table), frozenset[str]()

    def poll(self, health: Health) -> DriveInput:
        return self._wish(health.remote or Remote())

    def _wish(self, remote: Remote) -> DriveInput:
        pressed, self._held = remote.buttons - self._held, remote.buttons
        stop = f"{self.name}'s emergency stop (L2 + B)" if remote.buttons >= STOP else ""
        return DriveInput(frozenset(pressed & {START, WALK, END}), from_sticks(remote, self.table), stop)


class Gamepad(RobotRemote):
    """A gamepad with an Xbox layout on Linux's joystick interface, e.g. /dev/input/js0."""

    name = "the gamepad"
    _EVENT = struct.Struct("<IhBB")  # time [ms], value, kind, number [linux/joystick.h]
    _BUTTONS = ("A", "B", "X", "Y", "L1", "R1", "select", "start")
    _AXES = {0: ("lx", 1.0), 1: ("ly", -1.0), 3: ("rx", 1.0), 4: ("ry", -1.0)}  # down and right are positive
    _TRIGGERS = {2: "L2", 5: "R2"}  # -1 at rest

    def __init__(self, path: Path, table: Sequence[Command]) -> None:
        """Open the gamepad. Raises RobotError if this fails."""
        super().__init__(table)
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise RobotError(
                f"no gamepad at {path}: {error.strerror}; name one such as /dev/input/js0, or off"
            ) from None
        self.path, self._sticks = path, dict[str, float]()
        self._buttons, self._lost = set[str](), False

    def poll(self, health: Health) -> DriveInput:
        pressed, stop = frozenset[str](), ""
        while not self._lost and (event := self._event()):
            self._take(*event)
            wish = self._wish(self._remote())  # a press can begin and end between two steps
            pressed, stop = pressed | wish.pressed, stop or wish.stop
        if self._lost:
            return DriveInput(stop=f"{self.name} was unplugged")
        inputs = self._wish(self._remote())
        return inputs._replace(pressed=inputs.pressed | pressed, stop=stop or inputs.stop)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

    def _remote(self) -> Remote:
        return Remote(frozenset(self._buttons), **self._sticks)

    def _event(self) -> tuple[int, int, int] | None:
        """The value, kind and number of the next event; None if there is none yet."""
        try:
            data = os.read(self._file, self._EVENT.size)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        if len(data) < self._EVENT.size:
            self._lost = True
            return None
        return self._EVENT.unpack(data)[1:]

    def _take(self, value: int, kind: int, number: int) -> None:
        kind &= 0x7F  # the highest bit marks the initial state
        if kind == 2 and number in self._AXES:
            stick, sign = self._AXES[number]
            self._sticks[stick] = sign * value / 32767
        elif kind == 2 and number in self._TRIGGERS:
            self._hold(self._TRIGGERS[number], value > 0)
        elif kind == 1 and number < len(self._BUTTONS):
            self._hold(self._BUTTONS[number], value > 0)

    def _hold(self, button: str, down: bool) -> None:
        (self._buttons.add if down else self._buttons.discard)(button)


class TerminalKeys:
    """The keys of a terminal, one at a time until ``close``, or the characters of a pipe."""

    _ARROWS = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[D": "left", "\x1b[C": "right"}

    def __init__(self, file: int | None = None) -> None:
        """Read from the descriptor ``file`` (None: standard input)."""
        self._file, self.gone = sys.stdin.fileno() if file is None else file, False
        self._before = termios.tcgetattr(self._file) if os.isatty(self._file) else None
        if self._before is not None:
            tty.setcbreak(self._file)

    def read(self) -> list[str]:
        """The names of the keys pressed since the last call."""
        text = ""
        while not self.gone and select.select([self._file], [], [], 0)[0]:
            try:
                data = os.read(self._file, 256)
            except OSError:
                data = b""
            self.gone = not data
            text += data.decode("utf-8", "replace")
        keys = []
        while text:
            length = 3 if text[:3] in self._ARROWS else 1
            key, text = text[:length], text[length:]
            keys.append(self._ARROWS.get(key, {" ": "space"}.get(key, key)))
        return keys

    def close(self) -> None:
        """Restore the terminal."""
        if self._before is not None:
            with contextlib.suppress(OSError, termios.error):
                termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)
        self._before = None


class Keys(InputSource):
    """The keys of a terminal. Arrows, q, e, u, j, space and o drive as in the viewers."""

    STATES = {"s": START, "a": WALK, "x": END}
    # the other keys are for a simulation
    _DRIVE = {key for b in BINDINGS[: ACTIONS.index("own") + 1] for key in b.keys}

    def __init__(self, table: Sequence[Command], file: int | None = None) -> None:
        """``file``: see TerminalKeys."""
        self._keys, self._pilot = TerminalKeys(file), Pilot(table)

    def poll(self, health: Health) -> DriveInput:
        pressed, stop = frozenset[str](), ""
        for key in self._keys.read():
            if key == "\x1b":
                stop = "the emergency stop (key Esc)"
            elif key in self.STATES:
                pressed |= {self.STATES[key]}
            elif key in self._DRIVE:
                self._pilot.press(key)
        self._pilot.listen()
        command = self._pilot.command if self._pilot.driving else None
        return DriveInput(pressed, command, stop or ("the terminal is gone" if self._keys.gone else ""))

    def let_go(self) -> None:
        self._pilot.driving, self._pilot.command = False, self._pilot.default.copy()

    def close(self) -> None:
        self._keys.close()


class StopFile(InputSource):
    """Stops the robot when a file descriptor is readable or closed at its other end, for a switch or a watchdog."""

    def __init__(self, file: int) -> None:
        """Raises RobotError if the descriptor is not open."""
        try:
            os.fstat(file)
        except OSError as error:
            raise RobotError(f"--stop_fd {file}: {error.strerror}") from None
        self._file = file

    def poll(self, health: Health) -> DriveInput:
        return DriveInput(stop=f"file descriptor {self._file}" if select.select([self._file], [], [], 0)[0] else "")
