"""The table of faults, one at a time, and both sides of the wire while they happen, in lockstep by a simulated clock."""

from __future__ import annotations

import contextlib
import gc
import os
import signal
import socket
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller, Network
from legged_mw.deploy.inputs import Gamepad, Keys, RobotRemote, StopFile
from legged_mw.deploy.robot import Floats, Measurement, RobotError
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.states import States
from legged_mw.unitree.client import UnitreeRobot
from legged_mw.unitree.codec import WireMessage, encode_remote
from legged_mw.unitree.faults import Faults, parse_faults
from legged_mw.unitree.guard import Board, Guarded, WireGuard
from legged_mw.unitree.link import RobotEnd, Wire
from legged_mw.unitree.serve import STEP, ServedRecord, SimulatedUnitree

ALONE = 0.22  # [s] of 12 measurements, in which a part that is frozen alone can be known
SOON = 0.1  # [s] within which joints must be damped
RISE, WALK = 0.1, 0.2  # [s] in lockstep: to stand up, as it stands at first, and to walk before the fault


@cache
def network_of(folder: Path) -> Network:
    return Network(folder, read_contract(folder))


@cache
def limits_of(folder: Path) -> Limits:
    return Limits.of(folder, read_contract(folder))


class Killed(BaseException):
    """The policy's process has ended: nothing of it runs any more."""


class Side:
    """The robot's side: its remote stands it up and starts the policy; then comes the fault."""

    def __init__(
        self, sim: SimulatedUnitree, case: Case, other: Wire | None = None, second: Callable[[], RobotEnd] | None = None
    ) -> None:
        """``other``: another commander's end of the wire; ``second`` switches another robot on."""
        self.sim, self.case, self.other, self.second = sim, case, other, second
        self.end: RobotEnd | None = None  # the other robot's
        self.walking: float | None = None  # [s] when the policy began
        self.held: tuple[str, ...] | None = None  # buttons, from the fault on
        self.injected: float | None = None  # [s] when the fault began
        self.still: WireMessage | None = None  # what another robot sends
        self.tilted: float | None = None  # [s] when it was tilted by more than 60 degrees
        self._begun: float | None = None  # [s] of the first command

    def before(self) -> None:
        """Before each step of the robot."""
        sim, now = self.sim, self.sim.time
        if self.end:
            self.end.answer()
        if self._begun is None and sim.record.commands:
            self._begun = now
        since = now - self._begun if self._begun is not None else -1.0
        button = "start" if 0.0 < since < 0.05 else "A" if since > 0.1 and since % 0.08 < 0.04 else ""
        sim.remote = encode_remote(([button] if button else []) if self.held is None else self.held)
        begins = self.case.from_start or (self.walking is not None and now > self.walking + WALK)
        if self.case.robot and self.injected is None and begins:
            self.injected = now
            if isinstance(self.case.robot, str):
                for fault in parse_faults([self.case.robot], sim.contract.joints):
                    fault.begin(sim.faults)
        if self.injected is not None and callable(self.case.robot):
            self.case.robot(self, now - self.injected)
        if self.tilted is None and sim.upright < 0.5:
            self.tilted = now


class Rig:
    """The policy's side: its sources, states and limits, and what may go wrong there."""

    def __init__(
        self, robot: UnitreeRobot, folder: Path, clock: Callable[[], float], sleep: Callable[[float], None], work: float
    ) -> None:
        """``work``: [s] that a step of the policy takes."""
        self.robot, self.clock, self.sleep, self.work = robot, clock, sleep, work
        self.contract, self.said, self.read_at = robot.contract, list[str](), 0.0
        self.injected: float | None = None
        self.change: Callable[[Measurement, Floats], Floats] = lambda measured, targets: targets
        self.controller = Controller(folder, self.contract, network=network_of(folder))
        self.folder = folder
        self.act, self._read, self._steps = self.controller.act, robot.read, 0
        keys, self.keys = os.pipe()
        stop, self.stop = os.pipe()
        with tempfile.TemporaryDirectory() as folder_of_pad:
            os.mkfifo(pad := Path(folder_of_pad) / "js0")
            self.pad = os.open(pad, os.O_RDWR)
            table = self.contract.commands
            sources = [RobotRemote(table), StopFile(stop), Gamepad(pad, table), Keys(table, keys)]
        self._files = [keys, stop]
        ahead = np.array([0.3, *[0.0] * (len(table) - 1)])
        self.states = States(self.controller, sources, lambda _: ahead, self.say)

    def say(self, line: str) -> None:
        self.said.append(line)

    def run(self, case: Case, seconds: float) -> None:
        """Drive the robot, with the fault once it has walked."""

        def act(measured: Measurement, commands: Floats) -> Floats:
            if not self._steps:
                self.walks()
            self._steps += 1
            if case.policy and self.injected is None and self._steps > WALK / self.contract.period:
                self.begin()
                case.policy(self)
            self.sleep(self.work)
            self.act(measured, commands)
            self.controller.last_targets = self.change(measured, self.controller.last_targets)
            return self.controller.last_targets

        def read() -> Measurement:
            if self.states.armed:
                self.read_at = self.clock()
            return self._read()

        self.controller.act, self.robot.read = act, read  # type: ignore[method-assign]
        safety = Safety(self.contract, limits_of(self.folder).but({**self.robot.limits, **case.limits}, "the table"))
        try:
            run(self.robot, self.controller, lambda _: np.zeros(0), seconds, safety=safety, states=self.states)
        except RobotError as error:
            self.say(str(error))
        finally:
            for file in (*self._files, self.keys, self.stop, self.pad):
                if file >= 0:
                    os.close(file)

    def walks(self) -> None:
        """The policy begins."""

    def begin(self) -> None:
        """The fault begins now."""
        self.injected = self.clock()

    def close(self, name: str) -> None:
        """Close one of our ends: keys, stop or pad."""
        os.close(getattr(self, name))
        setattr(self, name, -1)

    def clock_jumps(self, seconds: float) -> None:
        """That of the policy's process alone."""
        self.robot._clock = lambda: self.clock() + seconds

    def kill(self) -> None:
        """Kill the policy's process."""
        raise NotImplementedError

    def signal_guard(self, number: int, seconds: float = 0.0) -> None:
        """Send the guard a signal; one that is stopped goes on after ``seconds``."""
        raise NotImplementedError

    def computer_sleeps(self, seconds: float) -> None:
        raise NotImplementedError


class Stepped(Guarded):
    """A guard that runs when somebody waits for it."""

    guard: WireGuard

    def _answer(self) -> dict[str, Any]:
        if hasattr(self, "guard"):
            self.guard.turn()
        return super()._answer()


class Lockstep(Rig):
    """Policy, guard and robot in one process: the robot's clock is everybody's, and sleeping moves it on."""

    def __init__(self, side: Side, wire: Wire, folder: Path) -> None:
        self.side, self.sim, self.asleep = side, side.sim, 0.0
        self.now = self._due = self.sim.time
        wire.clock = self.late_clock
        contract, package = self.sim.contract, self.sim.machine.package
        with tempfile.TemporaryFile() as file:
            file.truncate(8192)
            here, there = socket.socketpair()
            board = Board(file.fileno(), len(self.sim._state.body))
            self.guard = WireGuard(
                wire, there, Board(file.fileno(), len(self.sim._state.body)), package, clock=self.late_clock
            )
        self.sim.step()
        while (state := wire.receive()) is None:
            self.sim.step()
        self.now = self._due = self.sim.time
        self.guard.board.put(self.now, state.body, self.now)
        self.guard.tell({"ready": True})
        owner, self._turns = Stepped(here, board, wire, clock=self.late_clock), 0.0
        owner.guard = self.guard
        super().__init__(
            UnitreeRobot(contract, owner, owner.first, clock=self.late_clock),
            folder,
            self.read_clock,
            self.pass_,
            0.001,
        )

    def walks(self) -> None:
        self.side.walking = self.now

    def read_clock(self) -> float:
        return self.now

    def late_clock(self) -> float:
        """It goes on while the computer sleeps."""
        return self.now + self.asleep

    def pass_(self, seconds: float) -> None:
        """Let time pass for the robot and the guard."""
        end = self.now + seconds
        while self._due <= end + 1e-9:
            self.now = self._due
            self.side.before()
            if self.now >= self._turns:
                self.guard.turn()
            self.sim.step()
            self._due += STEP
        self.now = end

    def kill(self) -> None:
        self.robot._owner._channel.close()  # type: ignore[attr-defined]
        raise Killed

    def signal_guard(self, number: int, seconds: float = 0.0) -> None:
        if number not in (signal.SIGKILL, signal.SIGSTOP):
            self.guard.stop(number)
            return
        self._turns = self.now + seconds if number == signal.SIGSTOP else np.inf  # [s] when the guard turns again
        if number == signal.SIGKILL:
            self.guard.channel.close()

    def computer_sleeps(self, seconds: float) -> None:
        self.asleep = seconds


def lockstep(case: Case, sim: SimulatedUnitree, wire: Wire, folder: Path, patch: Any, **others: Any) -> Lockstep:
    """Run one fault; the robot's record and what was said are in what comes back. ``patch``: pytest's monkeypatch."""
    for name, value in () if case.from_start else (("RISE", RISE), ("STANDS", 1.0)):
        patch.setattr(f"legged_mw.deploy.states.{name}", value)
    sim.faults, sim.record, sim.remote, sim._rng = Faults(), ServedRecord(), encode_remote(), np.random.default_rng(0)
    sim.reset(after=1.0)
    while wire.receive() or wire.other_commander() or sim.end.receive():  # of the fault before
        pass
    rig = Lockstep(Side(sim, case, **others), wire, folder)
    patch.setattr("time.perf_counter", rig.read_clock)
    patch.setattr("time.sleep", rig.pass_)
    patch.setattr("gc.collect", lambda: None)  # for speed
    with contextlib.suppress(Killed):
        rig.run(case, 0.3 + WALK + case.known_after + SOON + 0.1)
    rig.pass_(0.1)
    patch.undo()
    if rig.side.end:
        rig.side.end = None
        gc.collect()  # another robot's publisher leaves
    if rig.injected is None:
        rig.injected = rig.side.injected
    return rig


# ---- the table


class Case(NamedTuple):
    """One fault."""

    said: str  # a pattern of the line
    # at the robot's side: a text of --fault, or what is done in each step since
    robot: str | Callable[[Side, float], None] = ""
    policy: Callable[[Any], None] | None = None  # at the policy's side
    known: Callable[[Lockstep], float] | None = None  # [s] when it can be known; None: when it begins
    known_after: float = 0.0  # [s] after it begins, at most
    limits: Mapping[str, float] = {}  # of the safety layer, other than the defaults
    task: str = "go2_flat"
    misplaced: bool = False  # the fault itself brings right commands to wrong joints
    from_start: bool = False  # the fault is there before it stands up, as it does in life: slowly
    in_lockstep: bool = False  # nothing that a real process could do here


def puts(joint: int, value: float) -> Callable[[Rig], None]:
    """From now on, the target of a joint [rad]."""

    def fault(rig: Rig) -> None:
        def change(measured: Measurement, targets: Floats) -> Floats:
            changed = targets.copy()
            changed[..., joint] = value
            return changed

        rig.change = change

    return fault


def acts(factor: float) -> Callable[[Rig], None]:
    """From now on, each action times a factor: of a network that is broken."""

    def fault(rig: Rig) -> None:
        right = rig.controller._network
        rig.controller._network = lambda *seen: factor * right(*seen)  # type: ignore[assignment]

    return fault


def takes(seconds: float) -> Callable[[Rig], None]:
    """From now on each step of the policy takes so long."""
    return lambda rig: setattr(rig, "work", seconds)


def holds(*buttons: str) -> Callable[[Side, float], None]:
    return lambda side, since: setattr(side, "held", buttons)


def rolls(side: Side, since: float) -> None:
    """It is pushed over."""
    if since < 0.2 and side.tilted is None:
        side.sim.data.qvel[3] = 9.0


def commands_too(side: Side, since: float) -> None:
    """For a moment another program repeats the last command."""
    if since < 0.03 and side.other and side.sim.command:
        side.other.send(side.sim.command.body)


def pauses(side: Side, since: float) -> None:
    side.sim.faults.silent = since < 0.06


def answers_too(ahead: float = 0.0) -> Callable[[Side, float], None]:
    """Another robot is switched on. It stands still, with its clock so far ahead [s]."""

    def fault(side: Side, since: float) -> None:
        if side.end is None and side.second:
            side.end, side.still = side.second(), WireMessage(side.sim._state.layout, side.sim._state.body)
        if side.end and side.still:
            side.still["tick"] = max(1, round(1000 * (side.sim.time + ahead)))
            side.end.send(side.still.seal())

    return fault


def ends_guard(number: int, seconds: float = 0.0) -> Callable[[Rig], None]:
    return lambda rig: rig.signal_guard(number, seconds)


def all_stop(seconds: float) -> Callable[[Rig], None]:
    """Guard and policy."""

    def fault(rig: Rig) -> None:
        rig.signal_guard(signal.SIGSTOP, seconds)
        rig.sleep(seconds)

    return fault


def interrupts(rig: Rig) -> None:
    raise KeyboardInterrupt


def frozen_alone(rig: Rig) -> float:
    return (rig.injected or 0.0) + ALONE


TWO = "two robots answer: 2 programs publish rt/lowstate in domain [0-9]+ on lo"
SILENT = r"the guard of the wire was silent for [0-9]+ ms; this process damps|nothing was sent for [0-9]+ ms: the guard stood still"
OLD = r"the newest measurement is [0-9]+ ms old, more than 40"
CASES: dict[str, Case] = {
    # the limits of the safety layer
    "angle beyond its range": Case("FL_hip_joint is at .* rad, .* beyond its range", "joint_bias=2"),
    "target beyond the range": Case(
        "FL_calf_joint is told to go to 0.20 rad, 1.04 beyond its range", policy=puts(2, 0.2), limits={"target": 1.0}
    ),
    "targets that jump": Case(
        "FL_thigh_joint is told to step by .* rad from one target to the next", policy=puts(1, 3.6)
    ),
    "more torque than there is": Case(
        "FL_thigh_joint is asked for .* N m, more than 23.7", policy=puts(1, 2.6), limits={"torque": 1.0}
    ),
    "encoder that counts wrong": Case("FL_hip_joint turns at .* rad/s, more than 60.0", "joint_speed=100"),
    "pushed over": Case(
        "the body is tilted by [0-9]+ degrees, more than 60", rolls, known=lambda rig: rig.side.tilted or 0.0
    ),
    "IMU upside down": Case("the body is tilted by 1[0-9]+ degrees, more than 60", "imu_tilt=180"),
    "hot motor": Case("FL_hip_joint has a motor of 95 deg C, more than 85", "hot_motor=95"),
    "low battery": Case("the battery has 20.0 V, less than 24", "low_battery=20"),
    "states that stay away for 60 ms": Case(OLD, pauses),
    "frozen state": Case("4 measurements in a row are the same", "frozen"),
    "frozen joints": Case(
        "joint_(pos|vel) is the same in 12 measurements in a row",
        "stuck=q,stuck=dq",
        known=frozen_alone,
        known_after=ALONE,
    ),
    "frozen angles": Case(
        "joint_pos is the same in 12 measurements in a row", "stuck=q", known=frozen_alone, known_after=ALONE
    ),
    "frozen speeds": Case(
        "joint_vel is the same in 12 measurements in a row", "stuck=dq", known=frozen_alone, known_after=ALONE
    ),
    "frozen IMU": Case(
        "(ang_vel|gravity) is the same in 12 measurements in a row",
        "stuck=gyroscope,stuck=quaternion",
        known=frozen_alone,
        known_after=ALONE,
    ),
    "frozen gyro": Case(
        "ang_vel is the same in 12 measurements in a row", "stuck=gyroscope", known=frozen_alone, known_after=ALONE
    ),
    "frozen orientation": Case(
        "gravity is the same in 12 measurements in a row", "stuck=quaternion", known=frozen_alone, known_after=ALONE
    ),
    "stuck encoder": Case(
        "the angle of FL_calf_joint is the same in 12 measurements in a row",
        "stuck=FL_calf_joint",
        known=lambda rig: rig.read_at,
        known_after=0.5,
    ),
    "slow policy": Case(
        "[56] steps within a second began late", policy=takes(0.035), known=lambda rig: rig.read_at, known_after=0.5
    ),
    "remote lost": Case(
        "the remote was not heard for 3.0 s",
        "no_remote",
        known_after=3.0,
        known=lambda rig: (rig.injected or 0.0) + 2.98,
    ),
    "NaN from the policy": Case("the target of FL_hip_joint is not finite: nan", policy=acts(np.nan)),
    "infinity from the policy": Case("the target of FL_hip_joint is not finite: nan", policy=acts(np.inf)),
    "NaN from an encoder": Case("a measured value is not finite: joint_pos", "nan=q"),
    "NaN of a speed": Case("a measured value is not finite: joint_vel", "nan=dq"),
    "NaN from the gyro": Case("a measured value is not finite: ang_vel", "nan=gyroscope"),
    "NaN of the orientation": Case("a measured value is not finite: gravity", "nan=quaternion"),
    "dead motor": Case(
        "the motor of FL_calf_joint reports a fault: it lost [0-9]+ messages in a period", "motor_fault=FL_calf_joint"
    ),
    # a person
    "emergency stop of the remote": Case(r"the remote's emergency stop \(L2 \+ B\)", holds("L2", "B")),
    "select": Case("select was pressed", holds("select")),
    "emergency stop by key": Case(r"the emergency stop \(key Esc\)", policy=lambda rig: os.write(rig.keys, b"\x1b")),
    "terminal closed": Case("the terminal is gone", policy=lambda rig: rig.close("keys")),
    "stop by file descriptor": Case("file descriptor [0-9]+", policy=lambda rig: os.write(rig.stop, b"!")),
    "stop descriptor closed": Case("file descriptor [0-9]+", policy=lambda rig: rig.close("stop")),
    "gamepad unplugged": Case("the gamepad was unplugged", policy=lambda rig: rig.close("pad")),
    "Ctrl-C": Case("", policy=interrupts),
    # the wire
    "silent robot": Case(OLD, "silent"),
    "90 % of messages lost": Case(OLD, "loss=90", known=lambda rig: rig.read_at, known_after=1.0),
    "wrong checksums": Case(
        "[0-9]+ states in a row have a wrong checksum: the newest good one is [0-9]+ ms old", "bad_crc"
    ),
    "robot started again": Case(
        "the robot's clock went back by 1.0 s: it was started again, or two robots answer", "clock_jump=-1"
    ),
    "two robots": Case(TWO, answers_too(-10.0)),
    "two robots with one clock": Case(TWO, answers_too()),
    "two robots, one 20 ms ahead": Case(TWO, answers_too(0.02)),
    "two robots, one 50 ms behind": Case(TWO, answers_too(-0.05)),
    "another body": Case(
        "mode_machine was 5 and is 4: the robot has another body, or two robots answer",
        "mode_machine=4",
        task="g1_flat",
    ),
    "dead motor of a G1": Case(
        "the motor of left_knee_joint reports a fault: error 0x1", "motor_fault=left_knee_joint", task="g1_flat"
    ),
    "second commander": Case("another program sends commands to this robot, too", commands_too),
    "motors in another order": Case("F._.*_joint is at .* rad, .* beyond its range", "joint_order=1", misplaced=True),
    "motor that turns the other way": Case(
        "FL_calf_joint is at .* rad, .* beyond its range", "joint_sign=FL_calf_joint", misplaced=True
    ),
    # processes and clocks
    "policy killed": Case("the policy's process ended", policy=lambda rig: rig.kill()),
    "policy hangs": Case(
        "no targets for 6[0-9] ms: the policy's process hangs or is late", policy=lambda rig: rig.sleep(0.5)
    ),
    "policy late": Case("no targets for 6[0-9] ms: the policy's process hangs or is late", policy=takes(0.07)),
    "guard told to end": Case(r"the guard was stopped \(SIGTERM\)", policy=ends_guard(signal.SIGTERM)),
    **{
        f"guard that gets {name}": Case(rf"the guard was stopped \({name}\)", policy=ends_guard(getattr(signal, name)))
        for name in ("SIGHUP", "SIGUSR1", "SIGUSR2", "SIGABRT", "SIGQUIT")
    },
    "guard killed": Case(
        "the guard of the wire is gone; this process damps the joints in its place", policy=ends_guard(signal.SIGKILL)
    ),
    "guard stopped for 200 ms": Case(SILENT, policy=ends_guard(signal.SIGSTOP, 0.2), known_after=0.2),
    "guard stopped for 2000 ms": Case(SILENT, policy=ends_guard(signal.SIGSTOP, 2.0), known_after=2.0),
    "guard and policy stopped for 200 ms": Case(
        SILENT, policy=all_stop(0.2), known=lambda rig: (rig.injected or 0.0) + 0.2, known_after=0.2
    ),
    "clock ahead": Case("the newest measurement is 100[0-9][0-9] ms old", policy=lambda rig: rig.clock_jumps(10.0)),
    "clock back": Case(
        "the newest measurement comes from .* ms ahead: a clock went back", policy=lambda rig: rig.clock_jumps(-10.0)
    ),
    "computer that slept": Case(
        "nothing was sent for 600[0-9][0-9] ms: the guard stood still, or this computer slept",
        policy=lambda rig: rig.computer_sleeps(60.0),
        in_lockstep=True,
    ),
}
# it stands up and does not walk
REFUSED: dict[str, Case] = {
    f"IMU with {axes[0]} and {axes[1]} swapped": Case(
        f"A is refused: while it stood up it {moved} by .* rad by its legs, by gravity .* do not agree",
        f"imu_swap={axes}",
        from_start=True,
        known_after=4.0,
    )
    for axes, moved in (("xy", "(pitched|rolled)"), ("xz", "rolled"), ("yz", "pitched"))
}
