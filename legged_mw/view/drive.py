"""User input while watching: the command, clipped to its trained range, and all other actions.

Keys are defined only in the table `BINDINGS`, which the window, the web page and the documentation read.
Nothing here draws, steps or waits. The session reads the pilot once per turn.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from legged_mw.utils.commands import LABELS, VELOCITY, Command
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
        """Request one of ACTIONS for the session's next turn."""
        if action not in ACTIONS:
            raise ValueError(f"no action '{action}'; there are: {', '.join(ACTIONS)}")
        if action in self.can:
            self._asked.put(lambda: self._do(action))

    def press(self, key: str) -> None:
        """Request the action of a key in the table. Other keys do nothing."""
        if key in KEY_ACTION:
            self.ask(KEY_ACTION[key])

    def steer(self, command: ArrayLike) -> None:
        """Drive by `command` (C,), clipped to its ranges, from the session's next turn on."""
        wanted = np.array(command, dtype=np.float64)
        self._asked.put(lambda: self._steer(wanted))

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
        wanted = np.array(own, dtype=np.float64)
        wanted[self.driven()] = self.command
        return wanted

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
