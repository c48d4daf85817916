"""The remote of a simulated robot, from a YAML script of timed inputs or from this terminal's keys.

remote:
  - {time: 1, press: [start]}            # buttons are held for a moment
  - {time: 5, press: [A]}
  - {time: 6, hoist: false}              # lower the robot from its hoist
  - {time: 8, ly: 0.5, rx: -0.2}         # a stick is held until the next entry that names it

Positive sticks: ahead (ly, ry) and right (lx, rx).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from legged_mw.deploy.inputs import TerminalKeys
from legged_mw.deploy.robot import BUTTONS
from legged_mw.unitree.codec import encode_remote
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import unknown

STICKS = ("lx", "ly", "rx", "ry")
HELD = 0.1  # [s] ours: duration of a button press
_STEP = 0.1  # stick change per key press
# key -> stick and its change, buttons, or a hoist action
KEYS = {
    "w": ("ly", _STEP),
    "s": ("ly", -_STEP),
    "a": ("lx", -_STEP),
    "d": ("lx", _STEP),
    "q": ("rx", -_STEP),
    "e": ("rx", _STEP),
}
PRESSED = {"1": ("start",), "2": ("A",), "x": ("select",), "!": ("L2", "B")}
KEYS_HELP = "keys: 1 start, 2 A (policy), x select (damping), ! L2+B (stop), w s a d q e sticks, space centres them, h hoist, r remote off"


class RemoteEvent(NamedTuple):
    """One timed input."""

    time: float  # [s]
    press: tuple[str, ...] = ()
    sticks: dict[str, float] = {}
    hoist: bool | None = None


def load_remote(path: Path) -> list[RemoteEvent]:
    """Read a script, sorted by time. Raises ConfigError."""
    listed = load_yaml(path).get("remote")
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{path}: write one list 'remote' with at least one entry, e.g. {{time: 1, press: [start]}}")
    return sorted((_entry(each, f"{path}: remote[{i}]") for i, each in enumerate(listed)), key=lambda entry: entry.time)


def _entry(values: Any, where: str) -> RemoteEvent:
    if not isinstance(values, dict) or not _number(values.get("time")) or values["time"] < 0:
        raise ConfigError(f"{where}: an entry is a mapping with a time [s] from 0, not {values!r}")
    for name in values:
        if name not in (known := ("time", "press", "hoist", *STICKS)):
            raise ConfigError(f"{where}: {unknown('field', name, known, 'an entry')}")
    press, sticks = values.get("press", []), {name: values[name] for name in STICKS if name in values}
    for name in press if isinstance(press, list) else [press]:
        if name not in BUTTONS:
            raise ConfigError(f"{where}: {unknown('button', name, BUTTONS, 'the remote')}")
    for name, value in sticks.items():
        if not _number(value) or abs(value) > 1:
            raise ConfigError(f"{where}: {name} is {value!r}; a stick is a number from -1 to 1")
    if not isinstance(values.get("hoist", False), bool):
        raise ConfigError(f"{where}: hoist is {values['hoist']!r}; it is true or false")
    return RemoteEvent(
        float(values["time"]), tuple(press) if isinstance(press, list) else (press,), sticks, values.get("hoist")
    )


def _number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


class Handset:
    """The current state of the remote."""

    def __init__(self, script: Sequence[RemoteEvent] = (), keys: bool = False) -> None:
        """``keys``: read keys from standard input, which must be a terminal."""
        self._script, self._next = list(script), 0
        self._sticks: dict[str, float] = dict.fromkeys(STICKS, 0.0)
        self._buttons, self._until = tuple[str, ...](), -math.inf
        self.off, self.hoist = False, None  # None: no input has set it
        self._keys = TerminalKeys() if keys else None

    def state(self, time: float) -> bytes:
        """The remote's 40 bytes at ``time`` [s], which must not decrease."""
        while self._next < len(self._script) and self._script[self._next].time <= time + 1e-9:
            entry = self._script[self._next]
            self._next += 1
            self._sticks |= entry.sticks
            self.hoist = self.hoist if entry.hoist is None else entry.hoist
            if entry.press:
                self._press(entry.press, time)
        for key in self._keys.read() if self._keys else ():
            self._key(key, time)
        if self.off:
            return bytes(40)
        return encode_remote(self._buttons if time < self._until else (), **self._sticks)

    def _press(self, buttons: tuple[str, ...], time: float) -> None:
        self._buttons, self._until = buttons, time + HELD

    def _key(self, key: str, time: float) -> None:
        if key in KEYS:
            stick, change = KEYS[key]
            self._sticks[stick] = max(-1.0, min(1.0, self._sticks[stick] + change))
        elif key in PRESSED:
            self._press(PRESSED[key], time)
        elif key == "space":
            self._sticks |= dict.fromkeys(STICKS, 0.0)
        elif key == "h":
            self.hoist = not self.hoist
        elif key == "r":
            self.off = not self.off

    def close(self) -> None:
        """Restore the terminal."""
        if self._keys:
            self._keys.close()
