"""Who drives a robot: its own remote, a gamepad, the keys of a terminal, a file descriptor that stops it. No robot moves here.

Each is asked once a step and must not block: it hands out what was pressed since, the command of its sticks, and a reason to stop.
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

START, WALK, END = "start", "A", "select"  # buttons of the states, as in unitree_rl_gym
STOP = frozenset({"L2", "B"})  # held together: the emergency stop [unitree_rl_lab]
DEAD = 0.08  # [-] of a stick near its centre that counts as the centre
_STICKS = dict(zip(VELOCITY, (("ly", 1.0), ("lx", -1.0), ("rx", -1.0)), strict=True))  # command -> stick, sign


class DriveInput(NamedTuple):
    """What is wanted in this step."""

    pressed: frozenset[str] = frozenset()  # of START, WALK, END, since the last step
    command: Floats | None = None  # (C,); None: this source does not drive now
    stop: str = ""  # why the robot must be damped at once


class InputSource(Protocol):
    """One who may drive."""

    def poll(self, health: Health) -> DriveInput:
        """Since the last call."""
        ...

    def let_go(self) -> None:
        """Another source drives now: forget what was commanded."""

    def close(self) -> None:
        """Free what is held; again is allowed."""


def from_sticks(remote: Remote, table: Sequence[Command]) -> Floats | None:
    """(C,) of the sticks: their ends are the ends of the trained ranges, their centre is the default; None where all are centred."""
    wanted, moved = np.array([each.default for each in table]), False
    for column, each in enumerate(table):
        stick, sign = _STICKS.get(each.name, ("", 0.0))
        value = sign * getattr(remote, stick) if stick else 0.0
        if abs(value) > DEAD:
            end = each.high if value > 0 else each.low
            wanted[column] = each.default + min(abs(value), 1.0) * (end - each.default)
            moved = True
    return wanted if moved else None


class RobotRemote:
    """The robot's own remote, as its health tells it."""

    name = "the remote"

    def __init__(self, table: Sequence[Command]) -> None:
        self.table, self._held = tuple(table), frozenset[str]()

    def poll(self, health: Health) -> DriveInput:
        return self._wish(health.remote or Remote())

    def let_go(self) -> None: ...

    def close(self) -> None: ...

    def _wish(self, remote: Remote) -> DriveInput:
        pressed, self._held = remote.buttons - self._held, remote.buttons
        stop = f"{self.name}'s emergency stop (L2 + B)" if remote.buttons >= STOP else ""
        return DriveInput(frozenset(pressed & {START, WALK, END}), from_sticks(remote, self.table), stop)


class Gamepad(RobotRemote):
    """A gamepad at Linux's joystick interface, e.g. /dev/input/js0, with the buttons of an Xbox pad."""

    name = "the gamepad"
    _EVENT = struct.Struct("<IhBB")  # time [ms], value, kind, number [linux/joystick.h]
    _BUTTONS = ("A", "B", "X", "Y", "L1", "R1", "select", "start")
    _AXES = {0: ("lx", 1.0), 1: ("ly", -1.0), 3: ("rx", 1.0), 4: ("ry", -1.0)}  # down and right are positive
    _TRIGGERS = {2: "L2", 5: "R2"}  # -1 at rest

    def __init__(self, path: Path, table: Sequence[Command]) -> None:
        """Raises RobotError if it cannot be opened."""
        super().__init__(table)
        try:
            self._file = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise RobotError(f"no gamepad at {path}: {error.strerror}") from None
        self.path, self._sticks = path, dict[str, float]()
        self._buttons, self._lost = set[str](), False

    def poll(self, health: Health) -> DriveInput:
        pressed = frozenset[str]()
        while not self._lost and (event := self._event()):
            self._take(*event)
            pressed |= self._wish(self._remote()).pressed  # a short press may begin and end between two steps
        if self._lost:
            return DriveInput(stop=f"{self.name} was unplugged")
        wish = self._wish(self._remote())
        return wish._replace(pressed=wish.pressed | pressed)

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
        self._file = -1

    def _remote(self) -> Remote:
        return Remote(frozenset(self._buttons), **self._sticks)

    def _event(self) -> tuple[int, int, int] | None:
        """Value, kind and number of the next event; None if there is none yet."""
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
        kind &= 0x7F  # the highest bit marks the state at the opening
        if kind == 2 and number in self._AXES:
            stick, sign = self._AXES[number]
            self._sticks[stick] = sign * value / 32767
        elif kind == 2 and number in self._TRIGGERS:
            self._hold(self._TRIGGERS[number], value > 0)
        elif kind == 1 and number < len(self._BUTTONS):
            self._hold(self._BUTTONS[number], value > 0)

    def _hold(self, button: str, down: bool) -> None:
        (self._buttons.add if down else self._buttons.discard)(button)


class Keys:
    """The keys of a terminal, or lines of a pipe. Arrows, q, e, u, j, space and o drive as in the viewers."""

    STATES = {"s": START, "a": WALK, "x": END}
    _ARROWS = {"\x1b[A": "up", "\x1b[B": "down", "\x1b[D": "left", "\x1b[C": "right"}
    _DRIVE = {key for b in BINDINGS[: ACTIONS.index("own") + 1] for key in b.keys}  # the others are of a simulation

    def __init__(self, table: Sequence[Command], file: int | None = None) -> None:
        """``file``: its descriptor (None: standard input); a terminal gives its keys at once until ``close``."""
        self._file = sys.stdin.fileno() if file is None else file
        self._pilot, self._closed = Pilot(table), False
        self._before = termios.tcgetattr(self._file) if os.isatty(self._file) else None
        if self._before is not None:
            tty.setcbreak(self._file)

    def poll(self, health: Health) -> DriveInput:
        pressed, stop = frozenset[str](), ""
        for key in self._read():
            if key == "\x1b":
                stop = "the emergency stop (key Esc)"
            elif key in self.STATES:
                pressed |= {self.STATES[key]}
            elif key in self._DRIVE:
                self._pilot.press(key)
        self._pilot.listen()
        return DriveInput(
            pressed,
            self._pilot.command if self._pilot.driving else None,
            stop or ("the terminal is gone" if self._closed else ""),
        )

    def let_go(self) -> None:
        self._pilot.driving, self._pilot.command = False, self._pilot.default.copy()

    def close(self) -> None:
        if self._before is not None:
            with contextlib.suppress(OSError, termios.error):
                termios.tcsetattr(self._file, termios.TCSADRAIN, self._before)
        self._before = None

    def _read(self) -> list[str]:
        """Keys pressed since the last call, by name."""
        text = ""
        while not self._closed and select.select([self._file], [], [], 0)[0]:
            try:
                data = os.read(self._file, 256)
            except OSError:
                data = b""
            self._closed = not data
            text += data.decode("utf-8", "replace")
        keys = []
        while text:
            length = 3 if text[:3] in self._ARROWS else 1
            key, text = text[:length], text[length:]
            keys.append(self._ARROWS.get(key, {" ": "space"}.get(key, key)))
        return keys


class StopFile:
    """Stops the robot as soon as a file descriptor can be read, or its other end is closed: for a switch, or a program that watches."""

    def __init__(self, file: int) -> None:
        """Raises RobotError if it is not open."""
        try:
            os.fstat(file)
        except OSError as error:
            raise RobotError(f"--stop_fd {file}: {error.strerror}") from None
        self._file = file

    def poll(self, health: Health) -> DriveInput:
        return DriveInput(stop=f"file descriptor {self._file}" if select.select([self._file], [], [], 0)[0] else "")

    def let_go(self) -> None: ...

    def close(self) -> None: ...
