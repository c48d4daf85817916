"""User input while watching: keys, a script of timed commands, the flag --command.

Keys are defined only in the table `BINDINGS`, which the window, the web page and the documentation read.
Nothing here draws, steps or waits. The session reads the pilot once per turn.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from legged_mw.utils.commands import LABELS, VELOCITY, Command, with_units
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import unknown
from legged_mw.view.stage import FloatArray

CAMERAS = ("follow", "behind", "all")
STEPS = 5  # ours: key presses from a command's default to the farther end of its range
SPEEDS = (1.0, 0.5, 0.25, 0.1)  # shares of real time
PUSH_SPEED = 1.0  # [m/s] ours: clearly visible, and any walking policy survives it (the exam's mark is 2)
PUSH_MAX = 4.0  # [m/s]
NO_COMMANDS = "this task has no commands: its robots cannot be driven"


class Binding(NamedTuple):
    """An action, its keys and its description."""

    action: str
    keys: tuple[str, ...]
    text: str


# MuJoCo's window receives the same key presses. native.py reverts the options that they toggle there.
BINDINGS = (
    Binding("forward", ("up",), "faster ahead"),
    Binding("back", ("down",), "slower, then backwards"),
    Binding("left", ("left",), "sideways to the left"),
    Binding("right", ("right",), "sideways to the right"),
    Binding("turn_left", ("q",), "turn left"),
    Binding("turn_right", ("e",), "turn right"),
    Binding("raise", ("u",), "raise the first command beyond these"),
    Binding("lower", ("j",), "lower it"),
    Binding("stop", ("space",), "stop: all commands to their defaults"),
    Binding("own", ("o",), "back to the task's own commands"),
    Binding("push", ("p",), "push the robot sideways"),
    Binding("reset", ("r", "backspace"), "reset the robot"),
    Binding("next", ("n",), "go to the next robot"),
    Binding("everyone", ("a",), "drive all robots, or only this one"),
    Binding("pause", ("enter",), "pause and go on"),
    Binding("slower", ("-",), "slow motion"),
    Binding("faster", ("=",), "back towards real time"),
    Binding("camera", ("c",), "camera: follow, behind, all around"),
    Binding("help", ("h",), "show the keys"),
)
ACTIONS = tuple(binding.action for binding in BINDINGS)
KEY_ACTION = {key: binding.action for binding in BINDINGS for key in binding.keys}
_VX, _VY, _YAW_RATE = VELOCITY
_FURTHER = ""  # stands for the first command that is not in this table
_STEP = {  # command, sign
    "forward": (_VX, 1),
    "back": (_VX, -1),
    "left": (_VY, 1),
    "right": (_VY, -1),
    "turn_left": (_YAW_RATE, 1),
    "turn_right": (_YAW_RATE, -1),
    "raise": (_FURTHER, 1),
    "lower": (_FURTHER, -1),
}


class Pilot:
    """The user's input. `ask`, `press`, `steer`, `push` are thread-safe; only the session's thread may use the rest."""

    def __init__(
        self, table: Sequence[Command], num_worlds: int = 1, camera: str = "follow", only: Mapping[str, str] = {}
    ) -> None:
        """``only``: available action -> new description or ""; empty: all. Without "own" there is no driving."""
        self.table, self.num_worlds = tuple(table), num_worlds
        self.low, self.high, self.default = (
            np.array([getattr(command, end) for command in table], dtype=np.float64)
            for end in ("low", "high", "default")
        )
        self.command = self.default.copy()
        self.driving = False  # False: the stage follows its own commands
        self.everyone = False  # drive all robots; False: only `world`
        self.world, self.camera = 0, camera
        self.paused, self.help = False, False
        self.speed = SPEEDS[0]
        self.push_speed = PUSH_SPEED
        self.message = ""  # the reason why the last action had no effect
        self.bindings = tuple(
            b._replace(text=only.get(b.action) or b.text) for b in BINDINGS if not only or b.action in only
        )
        self.words, self.can = only, frozenset(binding.action for binding in self.bindings)
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._pushes: list[tuple[int, FloatArray]] = []
        self._resets: set[int] = set()
        self._random = np.random.default_rng(0)

    def ask(self, action: str) -> None:
        """Request one of ACTIONS for the session's next turn. One that this pilot cannot do has no effect."""
        if action in self.can:
            self._asked.put(lambda: self._do(action))

    def press(self, key: str) -> None:
        """Request the action of a key in the table. Other keys do nothing."""
        if key in KEY_ACTION:
            self.ask(KEY_ACTION[key])

    def steer(self, command: ArrayLike) -> None:
        """Drive by `command` (C,), clipped to its ranges, from the session's next turn on."""
        values = np.array(command, dtype=np.float64)
        self._asked.put(lambda: self._steer(values))

    def steer_one(self, column: int, value: float, own: FloatArray) -> None:
        """Drive by the command, at first the robot's `own` (C,), with `value` in this column, from the next turn on."""

        def change() -> None:
            values = np.array(self.command if self.driving else own)
            values[column] = value
            self._steer(values)

        self._asked.put(change)

    def push(self, velocity: ArrayLike | None = None) -> None:
        """Push the driven robots by `velocity` (2,) [m/s], world frame. None: `push_speed` in a random direction."""
        added = None if velocity is None else np.array(velocity, dtype=np.float64)
        self._asked.put(lambda: self._push(added))

    # ---- the session's side

    def follow(self, command: ArrayLike) -> None:
        """Copy the robot's own command (C,) while the user does not drive. Driving starts from this command."""
        if not self.driving:
            self.command = self._held(command)

    def listen(self) -> None:
        """Do all actions that were requested since the last turn."""
        while True:
            try:
                self._asked.get_nowait()()
            except queue.Empty:
                return

    def commands(self, own: FloatArray) -> FloatArray | None:
        """The commands (N, C) of the next step, given those of the stage. None: the stage's own."""
        if not self.driving:
            return None
        values = np.array(own, dtype=np.float64)
        values[self.driven()] = self.command
        return values

    def driven(self) -> list[int]:
        """The worlds that the user drives, pushes and resets."""
        return list(range(self.num_worlds)) if self.everyone else [self.world]

    def take_pushes(self) -> list[tuple[int, FloatArray]]:
        """The pushes since the last call, each (world, velocity (2,) [m/s])."""
        pushes, self._pushes = self._pushes, []
        return pushes

    def take_resets(self) -> list[int]:
        """The worlds to reset, without duplicates."""
        resets, self._resets = self._resets, set()
        return sorted(resets)

    # ---- the actions

    def _do(self, action: str) -> None:
        self.message = ""
        match action:
            case "stop":
                self._steer(self.default)
            case "own":
                self.driving = False
            case "push":
                self._push(None)
            case "reset":
                self._resets |= set(self.driven())
            case "next":
                self.world = (self.world + 1) % self.num_worlds
            case "everyone":
                self.everyone = not self.everyone
            case "pause":
                self.paused = not self.paused
            case "slower" | "faster":
                index = SPEEDS.index(self.speed) + (1 if action == "slower" else -1)
                self.speed = SPEEDS[min(max(index, 0), len(SPEEDS) - 1)]
            case "camera":
                self.camera = CAMERAS[(CAMERAS.index(self.camera) + 1) % len(CAMERAS)]
            case "help":
                self.help = not self.help
            case _:
                self._step(*_STEP[action])

    def _step(self, name: str, sign: int) -> None:
        """Change a command by one key press: a fifth of the span from the default to the farther end of its range."""
        columns = [i for i, each in enumerate(self.table) if (each.name == name if name else each.name not in VELOCITY)]
        if self.table and not columns:
            self.message = (
                f"this task has no command {LABELS[name] if name else 'beyond ' + ', '.join(LABELS.values())}"
            )
            return
        command = self.command.copy()
        for i in columns[:1]:
            command[i] += sign * max(self.high[i] - self.default[i], self.default[i] - self.low[i]) / STEPS
        # round, so that five steps up and five steps down end exactly at the default
        self._steer(np.where(np.abs(command - self.default) < 1e-9, self.default, command))

    def _push(self, velocity: FloatArray | None) -> None:
        for world in self.driven():
            angle = self._random.uniform(-math.pi, math.pi)
            sideways = self.push_speed * np.array([math.cos(angle), math.sin(angle)])
            self._pushes.append((world, sideways if velocity is None else velocity))

    def _steer(self, command: FloatArray) -> None:
        if not self.table:
            self.message = NO_COMMANDS
            return
        self.driving = True
        self.command = self._held(command)

    def _held(self, command: ArrayLike) -> FloatArray:
        return np.clip(np.asarray(command, dtype=np.float64), self.low, self.high)


# ---- commands as text: a YAML file of timed commands, and the flag --command

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


# share of the time, then shares of vx, vy and yaw rate: 1 the highest, -1 the lowest [ours]
TOUR = ((0.0, 0.6, 0.0, 0.0), (0.3, 0.5, 0.0, 0.5), (0.5, 0.0, 0.8, 0.0), (0.7, -0.5, 0.0, 0.0), (0.9, 0.0, 0.0, 0.0))


def tour(table: Sequence[Command], seconds: float) -> Script | None:
    """A script of ``seconds`` for a recording: ahead, in a curve, sideways, back, stand. None without velocities."""
    names = [each.name for each in table]
    if not set(VELOCITY) <= set(names):
        return None
    entries = []
    for at, *shares in TOUR:
        command = [each.default for each in table]
        for column, share in zip(map(names.index, VELOCITY), shares, strict=True):
            each = table[column]
            command[column] += abs(share) * ((each.high if share > 0.0 else each.low) - each.default)
        entries.append(ScriptEntry(at * seconds, command))
    return Script(entries)


def load_script(path: Path | str, table: Sequence[Command]) -> Script:
    """Load a script for a task with these commands. A command outside the trained ranges is an error, not clipped.

    commands:
      - {time: 0, command: [0.5, 0, 0]}      # in the order of the task's commands, held until the next one
      - {time: 3, command: {lin_vel_x: 1.0, base_height: 0.25}}    # or by name; others get their defaults
      - {time: 6, push: [0, 1.5]}            # [m/s] jump of the horizontal velocity, world frame
      - {time: 9, reset: true}

    Raises ConfigError with the file and the entry.
    """
    loaded = load_yaml(path)
    listed = loaded.get("commands")
    if set(loaded) != {"commands"} or not isinstance(listed, list) or not listed:
        content = ", ".join(map(str, loaded)) or "nothing"
        example = "{time: 0, command: [0.5, 0, 0]}"
        raise ConfigError(
            f"{path}: write one list 'commands' with at least one entry, e.g. {example}; it has {content}"
        )
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
