"""A gamepad on Linux, read from /dev/input/js* as the kernel documents it (Documentation/input/joydev/joystick-api.rst).

No library is needed: an event is eight bytes. The layout is that of the xpad driver (Xbox and most others).
"""

from __future__ import annotations

import contextlib
import os
import struct
from pathlib import Path

from legged_mw.view.drive import Pilot

EVENT = struct.Struct("=IhBB")  # time [ms], value, kind, number
BUTTON, AXIS, INITIAL = 0x01, 0x02, 0x80  # kind; INITIAL is added to what reports the state at opening
FULL = 32767.0  # value of an axis at its end
DEAD = 0.12  # ours: share of the way that a worn stick is off its middle
AXES = {1: (0, -1.0), 0: (1, -1.0), 3: (2, -1.0)}  # number -> component, sign: left stick vx, vy; right stick yaw rate
BUTTONS = {0: "stop", 1: "reset", 2: "push", 3: "next", 4: "slower", 5: "faster", 6: "camera", 7: "pause"}
LAYOUT = (
    "left stick: ahead and sideways; right stick: turn; "
    "A stop, B reset, X push, Y next robot, LB slower, RB faster, back camera, start pause"
)


def find_gamepad(folder: Path = Path("/dev/input")) -> Path | None:
    """The first that can be read."""
    return next((path for path in sorted(folder.glob("js*")) if os.access(path, os.R_OK)), None)


class Gamepad:
    """Sticks and buttons that speak to a pilot. Nothing is steered until a stick is moved."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file: int | None = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        self._rest = b""
        self._deflection = [0.0, 0.0, 0.0]

    def poll(self, pilot: Pilot) -> None:
        """Tell the pilot what happened since the last call; a pad that was unplugged stops the robot."""
        moved = False
        for value, kind, number in self._events():
            if kind & AXIS and number in AXES:
                component, sign = AXES[number]
                self._deflection[component] = sign * _beyond_dead_zone(value / FULL)
                moved |= not kind & INITIAL
            elif kind == BUTTON and value == 1 and number in BUTTONS:
                pilot.ask(BUTTONS[number])
        if moved:
            pilot.stick(self._deflection)
        if self._file is None and any(self._deflection):
            self._deflection = [0.0, 0.0, 0.0]
            pilot.ask("stop")

    def close(self) -> None:
        """Let go of the device; again is allowed."""
        if self._file is not None:
            os.close(self._file)
            self._file = None

    def _events(self) -> list[tuple[int, int, int]]:
        """(value, kind, number) of all events there are."""
        while self._file is not None:
            try:
                data = os.read(self._file, 64 * EVENT.size)
            except BlockingIOError:
                break
            except OSError:  # unplugged
                with contextlib.suppress(OSError):
                    self.close()
                break
            if not data:
                break
            self._rest += data
        whole = len(self._rest) // EVENT.size * EVENT.size
        events, self._rest = self._rest[:whole], self._rest[whole:]
        return [(value, kind, number) for _, value, kind, number in EVENT.iter_unpack(events)]


def _beyond_dead_zone(value: float) -> float:
    """A stick's way in [-1, 1], zero around the middle and whole at the end."""
    size = min(max((abs(value) - DEAD) / (1.0 - DEAD), 0.0), 1.0)
    return size if value > 0 else -size
