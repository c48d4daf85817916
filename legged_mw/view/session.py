"""The loop of a session: read the pilot, step the stage, show the moment, keep real time, count falls and velocities.

It depends only on the protocols of `stage.py`, not on any viewer or physics.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from legged_mw.utils.commands import LABELS, Command, with_units
from legged_mw.view.drive import Pilot, Script
from legged_mw.view.stage import BoolArray, Fall, FloatArray, Moment, Stage, Viewer, target_velocity, top_speed

FALL_SECONDS = 2.0  # ours: [s] display time of the position of a fall
SETTLING = 1.0  # [s] ours: start of a segment to leave out of its mean velocity, if it lasts longer than twice this
PACE_SECONDS = 0.5  # [s] interval for measuring the pace
PATIENT = 3.0  # [s] ours: a recording that takes longer prints its duration
MEASURED = ", ".join(LABELS.values())


class Segment(NamedTuple):
    """The time between two changes of the command."""

    start: float  # [s]
    seconds: float
    command: FloatArray  # (C,)
    velocity: FloatArray  # (3,) mean of vx, vy, yaw rate after settling


class Outcome(NamedTuple):
    """The result of a session. Segments are those of the followed robot."""

    seconds: float
    falls: int  # number of falls of all robots
    segments: list[Segment]
    table: Sequence[Command] = ()
    robots: int = 1

    def text(self) -> str:
        """A summary line, then a table of at most the last twenty segments."""
        of = f" of {self.robots} robots" if self.robots > 1 else ""
        lines = [f"{self.seconds:.1f} s, {self.falls} {'fall' if self.falls == 1 else 'falls'}{of}"]
        commanded = f"commanded: {with_units(self.table) or 'nothing'}"
        if self.segments:
            lines.append(f"{'from':>8}{'for':>8}   {commanded}   measured: {MEASURED}")
        for each in self.segments[-20:]:
            lines.append(
                f"{each.start:>6.1f} s{each.seconds:>6.1f} s   {signed(each.command):<{len(commanded)}}   {signed(each.velocity)}"
            )
        return "\n".join(lines)


def signed(values: FloatArray) -> str:
    """Numbers with sign, in constant width."""
    return " ".join(f"{value + 0.0:+.2f}" for value in np.round(values, 2))


class Pace:
    """Limits a loop to one turn every `dt` [s] of real time."""

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self._next = time.perf_counter() + dt

    def wait(self) -> None:
        """Sleep until the end of this turn. A late turn is not caught up."""
        now = time.perf_counter()
        if self._next > now:
            time.sleep(self._next - now)
            self._next += self.dt
        else:
            self._next = now + self.dt


class Session:
    """Show one stage in one viewer until the viewer is closed, `seconds` have passed, or Ctrl-C."""

    def __init__(
        self,
        stage: Stage,
        viewer: Viewer,
        pilot: Pilot,
        *,
        seconds: float | None = None,
        real_time: bool = True,
        script: Script | None = None,
    ) -> None:
        self.stage, self.viewer, self.pilot = stage, viewer, pilot
        self.seconds, self.real_time, self.script = seconds, real_time, script
        self.steps = self.falls = 0
        self._fallen: BoolArray = np.zeros(stage.num_worlds, dtype=bool)
        self._recent_falls: list[tuple[float, Fall]] = []
        self._segments: list[Segment] = []
        self._since, self._followed = 0.0, np.zeros(0)  # start [s] and command of the current segment
        self._velocities: list[FloatArray] = []  # and its velocities, one per step
        self._pace = Pace(stage.dt)
        self._measured = (time.perf_counter(), 0, 0.0)  # start of the interval, steps at that time, share of real time

    @property
    def time(self) -> float:
        """Simulated time [s]."""
        return self.steps * self.stage.dt

    def run(self) -> Outcome:
        """Run all turns. Ctrl-C ends the session as if the viewer were closed."""
        try:
            while self.viewer.is_running() and (self.seconds is None or self.time < self.seconds - 1e-9):
                self.turn()
        except KeyboardInterrupt:
            print("\nstopped", flush=True)
        self._end_segment()
        return Outcome(self.time, self.falls, self._segments, self.stage.command_table, self.stage.num_worlds)

    def turn(self) -> None:
        """Show the moment, then do one control step under the pilot's commands."""
        self._listen()
        commands = self.pilot.commands(self.stage.commands())
        self.viewer.show(self._moment(commands))
        if not self.pilot.paused:
            self._step(commands)
        if self.real_time:
            self._pace.dt = self.stage.dt / (1.0 if self.pilot.paused else self.pilot.speed)
            self._pace.wait()
        elif self.steps == round(1.0 / self.stage.dt):
            self._say_how_long()

    def _say_how_long(self) -> None:
        """Print the remaining duration, estimated from the first second: drawing without a GPU is slow."""
        begun, _, _ = self._measured
        left = (time.perf_counter() - begun) * ((self.seconds or 0.0) / self.time - 1.0)
        if left > PATIENT:
            print(f"  about {left:.0f} s to go", flush=True)

    def _listen(self) -> None:
        pilot, stage = self.pilot, self.stage
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
            self._recent_falls.append((self.time, Fall(int(world), before[world])))
        self._fallen = fell
        self._note(followed, stage.velocity()[self.pilot.world])

    def _note(self, command: FloatArray, velocity: FloatArray) -> None:
        """Add a step to the current segment, or start a new one if the command has changed."""
        if not self._velocities or not np.allclose(self._followed, command, atol=1e-6):
            self._end_segment()
            self._since, self._followed = self.time - self.stage.dt, np.array(command)
        self._velocities.append(velocity)

    def _end_segment(self) -> None:
        steps, settling = len(self._velocities), round(SETTLING / self.stage.dt)
        if steps:
            mean = np.mean(self._velocities[settling if steps > 2 * settling else 0 :], axis=0)
            self._segments.append(Segment(self._since, steps * self.stage.dt, self._followed, mean))
            self._velocities = []

    def _moment(self, commands: FloatArray | None) -> Moment:
        stage, pilot = self.stage, self.pilot
        self._recent_falls = [(when, fall) for when, fall in self._recent_falls if self.time - when < FALL_SECONDS]
        commands = stage.commands() if commands is None else commands
        velocity = stage.velocity()
        return Moment(
            time=self.time,
            qpos=stage.qpos(),
            ghost=stage.ghost(),
            commands=commands,
            target_velocity=target_velocity(stage.command_table, commands),
            velocity=velocity,
            contacts=stage.contacts(),
            falls=tuple(fall for _, fall in self._recent_falls),
            world=pilot.world,
            camera=pilot.camera,
            lines=self._lines(commands[pilot.world], velocity[pilot.world]),
            help=pilot.help,
            top_speed=top_speed(stage.command_table),
        )

    def _lines(self, command: FloatArray, velocity: FloatArray) -> tuple[tuple[str, str], ...]:
        pilot, stage = self.pilot, self.stage
        lines, believed = [("measured", signed(velocity))], stage.believed_velocity()
        if believed is not None:
            lines.append(("estimated", signed(believed[pilot.world])))
        if stage.command_table:
            lines = [("command", signed(command)), *lines, ("driven by", self._driver())]
        if news := getattr(stage, "news", ""):  # from a stage that reloads its policy
            lines.append(("policy", news))
        if stage.num_worlds > 1:
            lines.append(("robot", f"{pilot.world + 1} of {stage.num_worlds}"))
        if ground := stage.ground(pilot.world):
            lines.append(("ground", ground))
        lines.append(("falls" if stage.num_worlds == 1 else "falls, all", str(self.falls)))
        lines.append(("time", f"{self.time:.1f} s{self._tempo()}"))
        if pilot.message:
            lines.append(("note", pilot.message))
        return tuple(lines)

    def _driver(self) -> str:
        if not self.pilot.driving:
            return "the task's own commands"
        if self.script is not None:
            return "the script"
        return "you, all robots" if self.pilot.everyone and self.stage.num_worlds > 1 else "you"

    def _tempo(self) -> str:
        """The pace as text; empty without real time."""
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
