"""What a pilot does: the command, held to what the policy was trained for, and the things one can ask for while watching.

The table `BINDINGS` is the only place that states a key; windows, the web page, the help text and the documentation's
table are made from it. Nothing here draws, steps or waits; a session asks the pilot what is wanted.
"""

from __future__ import annotations

import math
import queue
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from legged_mw.view.stage import FloatArray

COMPONENTS = ("vx", "vy", "yaw rate")
UNITS = ("m/s", "m/s", "rad/s")
CAMERAS = ("follow", "behind", "all")
STEPS = 5  # ours: presses of a key from standing to the limit
SPEEDS = (1.0, 0.5, 0.25, 0.1)  # shares of real time
PUSH_SPEED = 1.0  # [m/s] ours: seen well, and survived by any policy that walks (the exam asks for 2)
PUSH_MAX = 4.0  # [m/s]


class Binding(NamedTuple):
    """One thing that can be asked for, the keys that ask for it and the words for it."""

    action: str
    keys: tuple[str, ...]
    text: str


# Keys are chosen around what MuJoCo's window does with the same press; what remains is undone there (native.py).
BINDINGS = (
    Binding("forward", ("up",), "faster ahead"),
    Binding("back", ("down",), "slower, then backwards"),
    Binding("left", ("left",), "sideways to the left"),
    Binding("right", ("right",), "sideways to the right"),
    Binding("turn_left", ("q",), "turn left"),
    Binding("turn_right", ("e",), "turn right"),
    Binding("stop", ("space",), "stop: command zero"),
    Binding("own", ("o",), "give the robot back to the task's own commands"),
    Binding("push", ("p",), "push the robot sideways"),
    Binding("reset", ("r", "backspace"), "set the robot up anew"),
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
_DIRECTION = {  # component, sign
    "forward": (0, 1),
    "back": (0, -1),
    "left": (1, 1),
    "right": (1, -1),
    "turn_left": (2, 1),
    "turn_right": (2, -1),
}


def help_text() -> str:
    """The table of keys, a line each."""
    return "\n".join(f"{' or '.join(binding.keys):<16}{binding.text}" for binding in BINDINGS)


def outside(command: Sequence[float], limits: FloatArray) -> str | None:
    """What is wrong with a command that the policy was not trained for, in words; None if nothing is."""
    for name, unit, value, low, high in zip(COMPONENTS, UNITS, command, limits[0], limits[1], strict=True):
        if not (math.isfinite(value) and low - 1e-6 <= value <= high + 1e-6):
            return f"{name} = {value:g} {unit} is outside of what the policy was trained for, {low:g} to {high:g}"
    return None


class Pilot:
    """What is wanted now. `ask` and `steer` may be called from any thread; the rest belongs to the session's."""

    def __init__(self, limits: FloatArray, num_worlds: int = 1, camera: str = "follow") -> None:
        self.limits, self.num_worlds = np.array(limits, dtype=np.float64), num_worlds
        self.command = np.zeros(3)
        self.driving = False  # else the stage follows its own commands
        self.everyone = False  # drive all robots, else only `world`
        self.world, self.camera = 0, camera
        self.paused, self.help = False, False
        self.speed = SPEEDS[0]
        self.push_speed = PUSH_SPEED
        self._asked: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._pushes: list[tuple[int, FloatArray | None]] = []
        self._resets: list[int] = []
        self._random = np.random.default_rng(0)

    def ask(self, action: str) -> None:
        """One of ACTIONS, done at the session's next turn."""
        if action not in ACTIONS:
            raise ValueError(f"no action '{action}'; there are: {', '.join(ACTIONS)}")
        self._asked.put(lambda: self._do(action))

    def press(self, key: str) -> None:
        """A key of the table; others do nothing."""
        if key in KEY_ACTION:
            self.ask(KEY_ACTION[key])

    def steer(self, command: ArrayLike) -> None:
        """Drive by `command` (3,), held to the limits, from the session's next turn on."""
        wanted = np.array(command, dtype=np.float64)
        self._asked.put(lambda: self._steer(wanted))

    def stick(self, deflection: ArrayLike) -> None:
        """Drive by a stick's deflection (3,) in [-1, 1]: 1 is the highest command, -1 the lowest."""
        share = np.clip(np.asarray(deflection, dtype=np.float64), -1.0, 1.0)
        self.steer(np.where(share >= 0.0, share * self.limits[1], -share * self.limits[0]))

    def push(self, velocity: ArrayLike | None = None) -> None:
        """Push the driven robots by (2,) [m/s], world frame; None: at `push_speed` in a random direction."""
        jump = None if velocity is None else np.array(velocity, dtype=np.float64)
        self._asked.put(lambda: self._push(jump))

    def follow(self, command: ArrayLike) -> None:
        """Take over where the robot is: what a pilot who begins to drive finds."""
        if not self.driving:
            self.command = self._held(command)

    # ---- the session's side

    def listen(self) -> None:
        """Do all that was asked since the last turn."""
        while True:
            try:
                self._asked.get_nowait()()
            except queue.Empty:
                return

    def commands(self, own: FloatArray) -> FloatArray | None:
        """What to step with, given what each robot follows now (N, 3); None: the stage's own commands."""
        if not self.driving:
            return None
        wanted = np.array(own, dtype=np.float64)
        wanted[self.driven()] = self.command
        return wanted

    def driven(self) -> list[int]:
        """The worlds that are driven, pushed and reset."""
        return list(range(self.num_worlds)) if self.everyone else [self.world]

    def take_pushes(self) -> list[tuple[int, FloatArray]]:
        """(world, velocity (2,) [m/s]) of each push asked for since."""
        pushes, self._pushes = self._pushes, []
        return [(world, self._random_push() if velocity is None else velocity) for world, velocity in pushes]

    def take_resets(self) -> list[int]:
        """Worlds to reset, each once."""
        resets, self._resets = self._resets, []
        return sorted(set(resets))

    # ---- what the actions do

    def _do(self, action: str) -> None:
        if action in _DIRECTION:
            component, sign = _DIRECTION[action]
            command = self.command.copy()
            command[component] += sign * float(np.abs(self.limits[:, component]).max()) / STEPS
            command[np.abs(command) < 1e-9] = 0.0  # five steps ahead and five back are a stop
            self._steer(command)
        elif action in ("slower", "faster"):
            index = SPEEDS.index(self.speed) + (1 if action == "slower" else -1)
            self.speed = SPEEDS[min(max(index, 0), len(SPEEDS) - 1)]
        else:
            getattr(self, f"_{action}")()

    def _stop(self) -> None:
        self._steer(np.zeros(3))

    def _own(self) -> None:
        self.driving = False

    def _reset(self) -> None:
        self._resets += self.driven()

    def _next(self) -> None:
        self.world = (self.world + 1) % self.num_worlds

    def _everyone(self) -> None:
        self.everyone = not self.everyone

    def _pause(self) -> None:
        self.paused = not self.paused

    def _camera(self) -> None:
        self.camera = CAMERAS[(CAMERAS.index(self.camera) + 1) % len(CAMERAS)]

    def _help(self) -> None:
        self.help = not self.help

    def _push(self, velocity: FloatArray | None = None) -> None:
        self._pushes += [(world, velocity) for world in self.driven()]

    def _random_push(self) -> FloatArray:
        angle = self._random.uniform(-math.pi, math.pi)
        return self.push_speed * np.array([math.cos(angle), math.sin(angle)])

    def _steer(self, command: FloatArray) -> None:
        self.driving = True
        self.command = self._held(command)

    def _held(self, command: ArrayLike) -> FloatArray:
        return np.clip(np.asarray(command, dtype=np.float64), self.limits[0], self.limits[1])
