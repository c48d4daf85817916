"""A script of timed commands from a YAML file:

commands:
  - {time: 0, command: [0.5, 0, 0]}      # in the order of the task's commands, held until the next one
  - {time: 3, command: {lin_vel_x: 1.0, base_height: 0.25}}    # or by name; others get their defaults
  - {time: 6, push: [0, 1.5]}            # [m/s] jump of the horizontal velocity, world frame
  - {time: 9, reset: true}
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from legged_mw.utils.commands import VELOCITY, Command, with_units
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import unknown
from legged_mw.view.drive import NO_COMMANDS, PUSH_MAX, Pilot

FIELDS = ("time", "command", "push", "reset")
AFTER = 3.0  # [s] ours: time to watch after the last entry


class ScriptEntry(NamedTuple):
    """A command, a push or a reset at a time."""

    time: float  # [s]
    command: list[float] | None = None  # (C,)
    push: list[float] | None = None  # (2,) [m/s], world frame
    reset: bool = False


class Script:
    """Entries in the order of time. The pilot gets each entry at its time."""

    def __init__(self, entries: list[ScriptEntry]) -> None:
        self.entries = entries
        self._next = 0

    @property
    def seconds(self) -> float:
        """Duration of the script [s]."""
        return self.entries[-1].time + AFTER

    def play(self, time: float, pilot: Pilot) -> None:
        """Pass all entries up to `time` [s] to the pilot."""
        while self._next < len(self.entries) and self.entries[self._next].time <= time + 1e-9:
            entry = self.entries[self._next]
            self._next += 1
            if entry.command is not None:
                pilot.steer(entry.command)
            if entry.push is not None:
                pilot.push(entry.push)
            if entry.reset:
                pilot.ask("reset")


def load_script(path: Path | str, table: Sequence[Command]) -> Script:
    """Load a script for a task with these commands. A command outside the trained ranges is an error, not clipped.

    Raises ConfigError with the file and the entry.
    """
    loaded = load_yaml(path)
    listed = loaded.get("commands")
    if set(loaded) != {"commands"} or not isinstance(listed, list) or not listed:
        found = ", ".join(map(str, loaded)) or "nothing"
        example = "{time: 0, command: [0.5, 0, 0]}"
        raise ConfigError(f"{path}: write one list 'commands' with at least one entry, e.g. {example}; it has {found}")
    entries: list[ScriptEntry] = []
    for number, item in enumerate(listed, start=1):
        where = f"{path}: entry {number} of commands"
        entries.append(_entry(item, where, table))
        if number > 1 and entries[-1].time < entries[-2].time:
            raise ConfigError(
                f"{where}: its time {entries[-1].time:g} s is before the one above it, {entries[-2].time:g} s"
            )
    return Script(entries)


def _entry(item: Any, where: str, table: Sequence[Command]) -> ScriptEntry:
    if not isinstance(item, dict) or "time" not in item:
        raise ConfigError(f"{where}: write {{time: [s], ...}} with {', '.join(FIELDS[1:])}; it is {item!r}")
    wrong = [str(key) for key in item if key not in FIELDS]
    if wrong:
        raise ConfigError(f"{where}: there is no '{wrong[0]}'; there are: {', '.join(FIELDS)}")
    if len(item) == 1:
        raise ConfigError(f"{where}: nothing happens at {item['time']} s; say command, push or reset")
    [time] = _numbers(item["time"], [1], f"{where}: time", "seconds from the start")
    if time < 0:
        raise ConfigError(f"{where}: time = {time:g} s is before the start")
    command = _command(item["command"], f"{where}: command", table) if "command" in item else None
    push = _numbers(item["push"], [2], f"{where}: push", "[vx, vy] in m/s, world frame") if "push" in item else None
    if push is not None and math.hypot(*push) > PUSH_MAX * 2:
        raise ConfigError(f"{where}: a push of {math.hypot(*push):g} m/s; at most {PUSH_MAX * 2:g}")
    if not isinstance(item.get("reset", False), bool):
        raise ConfigError(f"{where}: reset is true or false, not {item['reset']!r}")
    return ScriptEntry(time, command, push, item.get("reset", False))


def _command(value: Any, where: str, table: Sequence[Command]) -> list[float]:
    """Values (C,) from a list in the order of the table, or from a mapping by name. Others get their defaults.

    A list has all commands, or vx, vy and yaw rate.
    """
    if not table:
        raise ConfigError(f"{where}: {NO_COMMANDS}")
    command, names = [each.default for each in table], [each.name for each in table]
    if isinstance(value, dict):
        for name, number in value.items():
            if name not in names:
                raise ConfigError(f"{where}: {unknown('command', str(name), names, 'this task')}")
            [command[names.index(name)]] = _numbers(number, [1], f"{where}: {name}", "a number")
    else:
        # the commands after the velocity may be left out
        whole = [len(table), *([len(VELOCITY)] if tuple(names[: len(VELOCITY)]) == VELOCITY else [])]
        values = _numbers(value, whole, where, f"a list of {with_units(table)}, or {{name: value}}")
        command[: len(values)] = values
    if wrong := outside(command, table):
        raise ConfigError(f"{where}: {wrong}")
    return command


def _numbers(value: Any, counts: Sequence[int], where: str, form: str) -> list[float]:
    values = value if isinstance(value, list) else [value]
    good = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)]
    if len(values) not in counts or len(good) != len(values):
        raise ConfigError(f"{where}: write {form}, not {value!r}")
    return [float(v) for v in good]


def parse_command(text: str, table: Sequence[Command]) -> list[float]:
    """Values (C,) from ``0.5,0,0`` in the order of the table, or from ``base_height=0.3``. Others get their defaults.

    Raises ConfigError for an unknown name, too many numbers, or a value outside its range.
    """
    names, values = [c.name for c in table], [c.default for c in table]
    for place, item in enumerate(text.split(",")):
        name, equals, number = item.partition("=")
        if equals and name.strip() not in names:
            raise ConfigError(f"--command {text}: {unknown('command', name.strip(), names, 'this task')}")
        if not equals and place >= len(table):
            have = f"this task has {len(table)} commands: {with_units(table) or 'none'}"
            raise ConfigError(f"--command {text}: {place + 1} numbers, but {have}")
        try:
            value = float(number if equals else item)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            write = f"--command={','.join(f'{c.default:g}' for c in table)} ({with_units(table)})"
            raise ConfigError(f"--command {text}: '{item.strip()}' is no number; write {write}")
        values[names.index(name.strip()) if equals else place] = value
    if wrong := outside(values, table):
        raise ConfigError(f"--command {text}: {wrong}")
    return values


def outside(values: Sequence[float], table: Sequence[Command]) -> str:
    """The first of the values (C,) outside its trained range, as text; "" if there is none."""
    for value, command in zip(values, table, strict=True):
        if not command.low - 1e-9 <= value <= command.high + 1e-9:
            unit = f" {command.unit}" if command.unit else ""
            trained = f"[{command.low:g}, {command.high:g}]{unit}"
            return f"{command.label} = {value:g}{unit} is outside of what was trained, {trained}"
    return ""
