"""A script of timed commands: a YAML file that drives without anybody there. Reads and checks; drives nothing itself.

commands:
  - {time: 0, command: [0.5, 0, 0]}      # vx, vy [m/s], yaw rate [rad/s], held until the next one
  - {time: 3, command: [1.0, 0, 0.6]}
  - {time: 6, push: [0, 1.5]}            # jump of the horizontal velocity, world frame [m/s]
  - {time: 9, reset: true}
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.view.drive import PUSH_MAX, Pilot, outside
from legged_mw.view.stage import FloatArray

FIELDS = ("time", "command", "push", "reset")
AFTER = 3.0  # [s] ours: how long a script's last entry is watched


class Cue(NamedTuple):
    """What happens at a time."""

    time: float  # [s]
    command: tuple[float, ...] | None = None  # (3,)
    push: tuple[float, ...] | None = None  # (2,) [m/s], world frame
    reset: bool = False


class Script:
    """Cues in their order, each given to the pilot once its time has come."""

    def __init__(self, cues: list[Cue]) -> None:
        self.cues = cues
        self._next = 0

    @property
    def seconds(self) -> float:
        """How long to watch it."""
        return self.cues[-1].time + AFTER

    def play(self, time: float, pilot: Pilot) -> None:
        """Give the pilot all cues up to `time` [s]."""
        while self._next < len(self.cues) and self.cues[self._next].time <= time + 1e-9:
            cue = self.cues[self._next]
            self._next += 1
            if cue.command is not None:
                pilot.steer(cue.command)
            if cue.push is not None:
                pilot.push(cue.push)
            if cue.reset:
                pilot.ask("reset")


def load_script(path: Path | str, limits: FloatArray) -> Script:
    """The script in a file. What the policy was not trained for is refused: a script measures what it says, or nothing.

    Raises ConfigError that names the file and the entry.
    """
    loaded = load_yaml(path)
    entries = loaded.get("commands")
    if set(loaded) != {"commands"} or not isinstance(entries, list) or not entries:
        found = ", ".join(map(str, loaded)) or "nothing"
        example = "{time: 0, command: [0.5, 0, 0]}"
        raise ConfigError(f"{path}: write one list 'commands' with at least one entry, e.g. {example}; it has {found}")
    cues: list[Cue] = []
    for number, entry in enumerate(entries, start=1):
        where = f"{path}: entry {number} of commands"
        cues.append(_cue(entry, where, limits))
        if number > 1 and cues[-1].time < cues[-2].time:
            raise ConfigError(f"{where}: its time {cues[-1].time:g} s is before the one above it, {cues[-2].time:g} s")
    return Script(cues)


def _cue(entry: Any, where: str, limits: FloatArray) -> Cue:
    if not isinstance(entry, dict) or "time" not in entry:
        raise ConfigError(f"{where}: write {{time: [s], ...}} with {', '.join(FIELDS[1:])}; it is {entry!r}")
    unknown = [str(key) for key in entry if key not in FIELDS]
    if unknown:
        raise ConfigError(f"{where}: there is no '{unknown[0]}'; there are: {', '.join(FIELDS)}")
    if len(entry) == 1:
        raise ConfigError(f"{where}: nothing happens at {entry['time']} s; say command, push or reset")
    [time] = _numbers(entry["time"], 1, f"{where}: time", "seconds from the start")
    if time < 0:
        raise ConfigError(f"{where}: time = {time:g} s is before the start")
    command = push = None
    if "command" in entry:
        command = _numbers(entry["command"], 3, f"{where}: command", "[vx, vy, yaw rate] in m/s, m/s, rad/s")
        if (wrong := outside(command, limits)) is not None:
            raise ConfigError(f"{where}: {wrong}")
    if "push" in entry:
        push = _numbers(entry["push"], 2, f"{where}: push", "[vx, vy] in m/s, world frame")
        if math.hypot(*push) > PUSH_MAX * 2:
            raise ConfigError(f"{where}: a push of {math.hypot(*push):g} m/s; at most {PUSH_MAX * 2:g}")
    if not isinstance(entry.get("reset", False), bool):
        raise ConfigError(f"{where}: reset is true or false, not {entry['reset']!r}")
    return Cue(time, command, push, entry.get("reset", False))


def _numbers(value: Any, count: int, where: str, form: str) -> tuple[float, ...]:
    values = value if isinstance(value, list) else [value]
    good = [v for v in values if isinstance(v, int | float) and not isinstance(v, bool) and math.isfinite(v)]
    if len(values) != count or len(good) != count:
        raise ConfigError(f"{where}: write {form}, not {value!r}")
    return tuple(float(v) for v in good)
