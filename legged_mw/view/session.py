"""The loop of watching: asks the pilot, steps the stage, shows the moment, keeps real time, and counts what happened.

Knows no viewer and no physics by name; both are seams of `stage.py`.
"""

from __future__ import annotations

import time
from typing import NamedTuple

import numpy as np

from legged_mw.view.drive import Pilot
from legged_mw.view.gamepad import Gamepad
from legged_mw.view.script import Script
from legged_mw.view.stage import BoolArray, Fall, FloatArray, Moment, Stage, Viewer

FALL_SECONDS = 2.0  # ours: how long the place of a fall is shown
SETTLING = 1.0  # [s] ours: after a change of command, left out of the mean of a leg if the leg is longer than twice that
PACE_SECONDS = 0.5  # the time that the measured pace is a mean of


class Leg(NamedTuple):
    """What one command gave, until the next one came."""

    start: float  # [s]
    seconds: float
    command: FloatArray  # (3,)
    velocity: FloatArray  # (3,) mean after settling


class Summary(NamedTuple):
    """What a session was, for the followed robot."""

    seconds: float
    falls: int  # of all robots
    legs: list[Leg]

    def text(self) -> str:
        """A table of legs, at most the last twenty."""
        unit = "vx, vy [m/s], yaw rate [rad/s]"
        rows = [f"{self.seconds:.1f} s, {self.falls} {'fall' if self.falls == 1 else 'falls'}"]
        if self.legs:
            rows.append(f"{'from':>8}{'for':>8}   {'commanded':<24}measured: {unit}")
        for leg in self.legs[-20:]:
            rows.append(f"{leg.start:>6.1f} s{leg.seconds:>6.1f} s   {shown(leg.command):<24}{shown(leg.velocity)}")
        return "\n".join(rows)


def shown(velocity: FloatArray) -> str:
    """Three numbers that do not jump about while they change."""
    return " ".join(f"{value + 0.0:+.2f}" for value in np.round(velocity, 2))


class Pace:
    """Holds a loop to one turn every `dt` seconds of real time."""

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self._next = time.perf_counter() + dt

    def wait(self) -> None:
        """Sleep until this turn is over. A late loop is not hurried afterwards: lost time stays lost."""
        now = time.perf_counter()
        if self._next > now:
            time.sleep(self._next - now)
            self._next += self.dt
        else:
            self._next = now + self.dt


class _Mean:
    """Of the velocities of a leg, without its beginning if it is long enough."""

    def __init__(self, start: float, command: FloatArray, settling: int) -> None:
        self.start, self.command, self.settling = start, np.array(command), settling
        self.count = 0
        self._all, self._settled = np.zeros(3), np.zeros(3)

    def add(self, velocity: FloatArray) -> None:
        self._all += velocity
        if self.count >= self.settling:
            self._settled += velocity
        self.count += 1

    def value(self) -> FloatArray:
        if self.count > 2 * self.settling:
            return self._settled / (self.count - self.settling)
        return self._all / self.count


class Session:
    """One stage before one viewer, until somebody closes it, `seconds` of it have passed, or Ctrl-C."""

    def __init__(
        self,
        stage: Stage,
        viewer: Viewer,
        pilot: Pilot,
        *,
        seconds: float | None = None,
        real_time: bool = True,
        script: Script | None = None,
        gamepad: Gamepad | None = None,
    ) -> None:
        self.stage, self.viewer, self.pilot = stage, viewer, pilot
        self.seconds, self.real_time = seconds, real_time
        self.script, self.gamepad = script, gamepad
        self.steps = self.falls = 0
        self._fallen: BoolArray = np.zeros(stage.num_worlds, dtype=bool)
        self._shown_falls: list[tuple[float, Fall]] = []
        self._legs: list[Leg] = []
        self._leg: _Mean | None = None
        self._pace = Pace(stage.dt)
        self._measured = (time.perf_counter(), 0, 0.0)  # since when, steps then, share of real time

    @property
    def time(self) -> float:
        """Of the stage [s]."""
        return self.steps * self.stage.dt

    def run(self) -> Summary:
        """Turn after turn; Ctrl-C ends it as closing the viewer does."""
        try:
            while self.viewer.is_running() and (self.seconds is None or self.time < self.seconds - 1e-9):
                self.turn()
        except KeyboardInterrupt:
            print("\nstopped", flush=True)
        self._end_leg()
        return Summary(self.time, self.falls, self._legs)

    def turn(self) -> None:
        """Show where things stand, then do what is wanted for one control step."""
        self._hear()
        commands = self.pilot.commands(self.stage.commands())
        self.viewer.show(self._moment(commands))
        if not self.pilot.paused:
            self._step(commands)
        if self.real_time:
            self._pace.dt = self.stage.dt / (1.0 if self.pilot.paused else self.pilot.speed)
            self._pace.wait()

    def _hear(self) -> None:
        pilot, stage = self.pilot, self.stage
        if self.gamepad is not None:
            self.gamepad.poll(pilot)
        if self.script is not None:
            self.script.play(self.time, pilot)
        pilot.follow(stage.commands()[pilot.world])
        pilot.listen()
        for world in pilot.take_resets():
            stage.reset(world)
            self._fallen[world] = False
        for world, velocity in pilot.take_pushes():
            stage.push(world, velocity)

    def _step(self, commands: FloatArray | None) -> None:
        stage, before = self.stage, self.stage.qpos()[:, :3]
        followed = (stage.commands() if commands is None else commands)[self.pilot.world]
        stage.step(commands)
        self.steps += 1
        fell = stage.fell()
        for world in np.flatnonzero(fell & ~self._fallen):
            self.falls += 1
            self._shown_falls.append((self.time, Fall(int(world), before[world])))
        self._fallen = fell
        self._note(followed, stage.velocity()[self.pilot.world])

    def _note(self, command: FloatArray, velocity: FloatArray) -> None:
        """Add to the leg, or begin one where the command changed."""
        if self._leg is None or not np.allclose(self._leg.command, command, atol=1e-6):
            self._end_leg()
            self._leg = _Mean(self.time - self.stage.dt, command, round(SETTLING / self.stage.dt))
        self._leg.add(velocity)

    def _end_leg(self) -> None:
        if self._leg is not None:
            self._legs.append(Leg(self._leg.start, self._leg.count * self.stage.dt, self._leg.command, self._leg.value()))
            self._leg = None

    def _moment(self, commands: FloatArray | None) -> Moment:
        stage, pilot = self.stage, self.pilot
        self._shown_falls = [(when, fall) for when, fall in self._shown_falls if self.time - when < FALL_SECONDS]
        commands = stage.commands() if commands is None else commands
        velocity = stage.velocity()
        return Moment(
            time=self.time,
            qpos=stage.qpos(),
            commands=commands,
            velocity=velocity,
            contacts=stage.contacts(),
            falls=tuple(fall for _, fall in self._shown_falls),
            world=pilot.world,
            camera=pilot.camera,
            lines=self._lines(commands[pilot.world], velocity[pilot.world]),
            help=pilot.help,
        )

    def _lines(self, command: FloatArray, velocity: FloatArray) -> tuple[tuple[str, str], ...]:
        pilot, count = self.pilot, self.stage.num_worlds
        driver = ("you, all robots" if pilot.everyone and count > 1 else "you") if pilot.driving else "nobody: own commands"
        if self.script is not None and pilot.driving:
            driver = "the script"
        lines = [("command", shown(command)), ("measured", shown(velocity)), ("driven by", driver)]
        if count > 1:
            lines.append(("robot", f"{pilot.world + 1} of {count}"))
        if ground := self.stage.ground(pilot.world):
            lines.append(("ground", ground))
        return (
            *lines,
            ("falls" if self.stage.num_worlds == 1 else "falls, all", str(self.falls)),
            ("time", f"{self.time:.1f} s{self._tempo()}"),
        )

    def _tempo(self) -> str:
        """How fast time passes, where that is a question."""
        if self.pilot.paused:
            return ", paused"
        if not self.real_time:
            return ""
        since, steps, share = self._measured
        now = time.perf_counter()
        if now - since > PACE_SECONDS:
            share = (self.steps - steps) * self.stage.dt / (now - since)
            self._measured = (now, self.steps, share)
        return f", x {share:.2f}" if share else ""
