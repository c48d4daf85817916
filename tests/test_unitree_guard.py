"""The guard of the wire: what it sends when the policy's process dies, hangs, is late or is not alone; then real processes."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.robot import RobotError
from legged_mw.unitree import client, clock, driver, guard, link
from legged_mw.unitree.codec import LAYOUTS, WireMessage, encode_remote
from legged_mw.unitree.faults import Faults, parse_faults
from legged_mw.unitree.guard import Board, Guarded, WireGuard
from legged_mw.unitree.handset import Handset
from legged_mw.unitree.link import STAND_DOWN, Received, RobotEnd
from legged_mw.unitree.serve import DAMPED, LOW_LEVEL, STEP, SimulatedUnitree
from tests.wires import POLICIES
from tests.wires import domain as domain

SIZE = LAYOUTS["unitree_go", "LowCmd_"].size
MOVING, DAMPING = b"m" * SIZE, b"d" * SIZE


class FakeWire:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent, self.state, self.other, self.robots = list[bytes](), None, False, ""

    def receive(self) -> Received | None:
        state, self.state = self.state, None
        return state

    def send(self, body: bytes) -> None:
        self.sent.append(body)

    def other_commander(self) -> bool:
        return self.other

    def another_robot(self) -> str:
        return self.robots


class Bench:
    """A guard in a thread, with the policy's end of its channel and board."""

    def __init__(self, late: float) -> None:
        self.wire = FakeWire()
        self._file = tempfile.TemporaryFile()  # noqa: SIM115
        self._file.truncate(4096)
        self.here, there = socket.socketpair()
        self.board, size = Board(self._file.fileno(), 64), 64
        self.guard = WireGuard(self.wire, there, Board(self._file.fileno(), size), "unitree_go", late)
        self._thread = threading.Thread(target=self.guard.run, daemon=True)
        self._thread.start()

    def send(self, kind: int, body: bytes, stamp: float = 0.0) -> None:
        self.here.sendall(guard._FRAME.pack(kind, stamp) + body)

    def ended(self, seconds: float = 60.0) -> bool:
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def close(self) -> None:
        self.guard._until = 0.0
        self.ended()
        self.here.close()
        self._file.close()


def until(true: Any, seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.001)
    return bool(true())


@pytest.fixture
def bench(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    monkeypatch.setattr(guard, "AFTER", 0.1)
    made = Bench(getattr(request, "param", 60.0))
    made.send(guard.ARM, DAMPING)
    yield made
    made.close()


def test_it_repeats_the_newest_command(bench: Bench) -> None:
    bench.send(guard.MOVE, MOVING)
    assert until(lambda: len(bench.wire.sent) > 20) and set(bench.wire.sent) == {MOVING}
    newer = b"n" * SIZE
    bench.send(guard.MOVE, newer)
    assert until(lambda: bench.wire.sent[-1] == newer)


def test_nothing_is_sent_before_the_first_command(bench: Bench) -> None:
    bench.wire.state = Received(b"s" * 64, 7.0)
    assert until(lambda: bench.board.get().stamp == 7.0) and bench.board.get()[:3] == (b"s" * 64, 7.0, "")
    assert not bench.wire.sent


@pytest.mark.parametrize("bench", [0.1], indirect=True)
def test_a_terminal_that_is_paused_does_not_stop_the_damping(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after Ctrl-S: whoever writes to it waits."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, bytes(4096))
    os.set_blocking(writer, True)
    with os.fdopen(reader, "rb") as terminal, os.fdopen(writer, "w") as paused:
        monkeypatch.setattr(sys, "stderr", paused)
        try:
            bench.send(guard.MOVE, MOVING)
            assert until(lambda: bench.board.get().text)
            before = len(bench.wire.sent)
            assert until(lambda: len(bench.wire.sent) > before + 10, 5.0) and bench.wire.sent[-1] == DAMPING
        finally:  # it goes on
            while not terminal.read1().endswith(b"\n"):
                pass


@pytest.mark.parametrize("bench", [0.1], indirect=True)
def test_a_late_policy_is_damped_and_does_not_resume(bench: Bench, capfd: pytest.CaptureFixture[str]) -> None:
    bench.send(guard.MOVE, MOVING)
    assert until(lambda: bench.guard.tripped) and until(lambda: bench.wire.sent[-1] == DAMPING)
    bench.send(guard.MOVE, MOVING)
    count = len(bench.wire.sent)
    assert until(lambda: len(bench.wire.sent) > count + 20) and set(bench.wire.sent[count:]) == {DAMPING}
    text = bench.board.get().text
    assert text.startswith("no targets for ") and text.endswith(
        " ms: the policy's process hangs or is late; the joints are damped"
    )
    said = list[str]()
    assert until(lambda: said.append(capfd.readouterr().err) or "guard: no targets for" in "".join(said))


@pytest.mark.parametrize("bench", [0.05], indirect=True)
def test_what_is_safe_may_hold_for_ever(bench: Bench) -> None:
    """Limp and damped joints need nobody: a person may take a while before the robot stands."""
    bench.send(guard.SAFE, b"l" * SIZE)
    assert until(lambda: len(bench.wire.sent) > 10)
    time.sleep(0.15)
    assert not bench.guard.tripped and bench.wire.sent[-1] == b"l" * SIZE


@pytest.mark.parametrize(
    ("happens", "text"),
    [
        (lambda bench: bench.here.close(), "the policy's process ended"),
        (lambda bench: setattr(bench.wire, "other", True), "another program sends commands to this robot, too"),
        (lambda bench: setattr(bench.wire, "robots", "two robots answer"), "two robots answer"),
    ],
    ids=["the policy dies", "a second commander", "another robot"],
)
def test_what_it_damps_for(happens: Callable[[Bench], object], text: str, bench: Bench) -> None:
    bench.send(guard.MOVE, MOVING)
    assert until(lambda: bench.wire.sent)
    happens(bench)
    assert until(lambda: bench.wire.sent[-1] == DAMPING) and until(lambda: bench.board.get().text)
    assert bench.board.get().text == f"{text}; the joints are damped"
    assert bench.here.fileno() >= 0 or bench.ended()


def test_a_guard_that_is_told_to_end_damps_first(bench: Bench) -> None:
    bench.send(guard.MOVE, MOVING)
    assert until(lambda: bench.wire.sent)
    bench.guard.stop()
    assert bench.ended() and bench.wire.sent[-1] == DAMPING


def test_a_clock_that_goes_back(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """The guard damps, and goes on to send: nothing waits until the clock is again where it was."""
    bench.send(guard.MOVE, MOVING)
    assert until(lambda: bench.wire.sent)
    bench.guard.clock = lambda: clock() - 3600.0
    assert until(lambda: bench.wire.sent[-1] == DAMPING)
    count = len(bench.wire.sent)
    assert until(lambda: len(bench.wire.sent) > count + 20) and set(bench.wire.sent[count:]) == {DAMPING}
    assert bench.board.get().text == "this computer's clock went back by 3600.0 s; the joints are damped"
    bench.send(guard.CLOSE, DAMPING)
    assert bench.ended()


def test_what_is_written_counts_when_it_is_whole() -> None:
    """In whatever order a processor lets its writes be seen: each byte alone makes a board that is not whole."""
    with tempfile.TemporaryFile() as file:
        file.truncate(4096)
        writer, reader = Board(file.fileno(), 64), Board(file.fileno(), 64)
        assert reader.get() == (bytes(64), 0.0, "", 0.0)
        writer.put(1.0, b"a" * 64, 0.5)
        before, old = bytes(writer._map[:]), reader.get()
        assert old == (b"a" * 64, 0.5, "", 1.0)
        writer.put(2.0, b"b" * 64, 1.5, text="why")
        after = bytes(writer._map[:])
        assert reader.get() == (b"b" * 64, 1.5, "why", 2.0)
        reader._posted = old
        for i in (i for i in range(len(after)) if before[i] != after[i]):
            writer._map[i] = before[i]  # not seen yet
            assert reader.get() == old
            writer._map[i] = after[i]
        assert reader.get().text == "why"


def test_the_end(bench: Bench) -> None:
    """The last command is sent for a while, and the latency of the others is reported."""
    bench.send(guard.MOVE, MOVING, stamp=clock())
    bench.send(guard.CLOSE, DAMPING)
    assert b"from a measurement to its target: median " in bench.here.recv(4096)
    assert DAMPING in bench.wire.sent  # the answer says that it is sent
    assert bench.ended() and bench.wire.sent[-1] == DAMPING and bench.guard.tripped == ""


class FakeCommander:
    """Keeps what the policy's process sends."""

    def __init__(self) -> None:
        self.sent = list[bytes]()

    def send(self, body: bytes) -> None:
        self.sent.append(body)


@pytest.fixture
def ends(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Guarded, FakeCommander, socket.socket]]:
    """The policy's side while the robot moves, and the guard's end of its channel, which nobody serves."""
    monkeypatch.setattr(guard, "AFTER", 0.1)
    with tempfile.TemporaryFile() as file:
        file.truncate(4096)
        here, there = socket.socketpair()
        there.sendall(b'{"ready": true}\n')
        owner = Guarded(here, Board(file.fileno(), 64), commander := FakeCommander())
        owner.arm(DAMPING)
        owner.send(MOVING, 0.0, False)
        with here, there:
            yield owner, commander, there


@pytest.mark.parametrize("ending", ["stopped", "killed before", "killed meanwhile"])
def test_a_guard_that_cannot_end_the_run_is_replaced(
    ending: str, ends: tuple[Guarded, FakeCommander, socket.socket]
) -> None:
    owner, commander, there = ends
    served = 3 * (guard._FRAME.size + SIZE) if ending == "killed meanwhile" else 0

    def take(left: int) -> None:
        while left > 0:
            left -= len(there.recv(left))
        there.close()

    thread = threading.Thread(target=take, args=(served,))
    if ending != "stopped":
        thread.start()
    if ending == "killed before":
        thread.join()
    why = guard.DEAF if ending == "stopped" else guard.GONE
    assert owner.close(DAMPING) == f"{why}; {guard.INSTEAD}"
    assert len(commander.sent) > 1 and set(commander.sent) == {DAMPING}


def test_a_guard_that_takes_nothing_more_is_not_gone(ends: tuple[Guarded, FakeCommander, socket.socket]) -> None:
    owner, commander, _ = ends
    owner._channel.settimeout(0.01)
    while not commander.sent:
        owner.send(MOVING, 0.0, False)
    with pytest.raises(RobotError, match=guard.DEAF):
        owner.receive()


def test_a_pause_of_the_policy_is_not_the_guards(ends: tuple[Guarded, FakeCommander, socket.socket]) -> None:
    """Between its look at the board and at the clock, either way round."""
    owner, commander, _ = ends
    now, get = [100.0], owner._board.get

    def pauses() -> guard.Posted:
        posted = get()._replace(turn=now[0])
        now[0] += 2.0 * guard.STILL
        return posted

    owner._clock, owner._board.get = lambda: now[0], pauses  # type: ignore[method-assign]
    assert owner.receive() is None and not commander.sent


# ---- processes

POLICY = """
import select, sys, time
from pathlib import Path
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.robot import RobotError
from legged_mw.unitree import client, clock, guard
folder, domain, fault = Path(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
contract = read_contract(folder)
# it damps for its fault, not because this computer is busy
guard.LATE = guard.STILL = client.TOO_OLD = 60.0 if fault == "dies" else 4.0
guard.Guarded.start.__func__.__kwdefaults__["find"] = 60.0
robot = client.connect(folder, contract, "lo", domain)
print("pid", robot._owner.process.pid, flush=True)
begun = False
while True:
    begun = begun or bool(select.select([sys.stdin], [], [], 0.0)[0])
    if fault == "clock" and begun:
        robot._clock = lambda: clock() + 10.0
    try:
        robot.read()
        robot.write(contract.default_pose)
    except RobotError:
        if fault != "dies":
            raise
    time.sleep(0.01)
"""

# The program on a computer that may be busy: nothing is late here, as what is late is tested above and in lockstep.
DEPLOY = """
from legged_mw.deploy import safety
from legged_mw.unitree import client, guard
guard.LATE = guard.STILL = client.TOO_OLD = 60.0
safety.LATE = 1e9  # [periods]
from legged_mw.deploy.__main__ import main
main()
"""


def deploy(domain: int, *flags: str) -> list[str]:
    """The command that drives a Go2."""
    where = ["--interface", "lo", "--domain", str(domain), "--log", "off"]
    return [sys.executable, "-c", DEPLOY, "go2_flat", "--robot", "unitree", *where, *flags]


def served(domain: int) -> SimulatedUnitree:
    folder = POLICIES / "go2_flat"
    return SimulatedUnitree(folder, read_contract(folder), RobotEnd("unitree_go", "lo", domain))


def live(sim: SimulatedUnitree, until: Any, seconds: float = 300.0) -> float:
    """Step in real time until something is true; returns how long it took [s]."""
    start = due = time.monotonic()
    while not until():
        sim.step()
        due = max(due + STEP, time.monotonic() - 0.05)
        time.sleep(max(0.0, due - time.monotonic()))
        assert time.monotonic() - start < seconds, "it did not happen"
    return time.monotonic() - start


@contextlib.contextmanager
def policy(domain: int, fault: str = "") -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-c", POLICY, str(POLICIES / "go2_flat"), str(domain), fault]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, **pipes, text=True, cwd=POLICIES.parents[1])
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def driven(sim: SimulatedUnitree, process: subprocess.Popen[str]) -> None:
    """Until the policy drives the robot."""
    live(sim, lambda: sim.acted["kp"].any() or process.poll() is not None)
    assert sim.acted["kp"].any(), process.communicate()[1]


def second(domain: int, sim: SimulatedUnitree) -> str:
    """The error of another program's guard for the same robot."""
    said = list[str]()

    def start() -> None:
        try:
            Guarded.start("unitree_go", "lo", domain).close(b"")
        except RobotError as error:
            said.append(str(error))

    thread = threading.Thread(target=start)
    thread.start()
    live(sim, lambda: not thread.is_alive())
    return said[0]


def test_a_robot_keeps_its_own_program_if_the_policy_ended_before(domain: int) -> None:
    """Ctrl-C while the guard waits for a robot, which is switched on then: nobody lets it fall."""
    sim, (here, there) = served(domain), socket.socketpair()
    with tempfile.TemporaryFile() as file, there:
        file.truncate(1 << 16)
        settings = {"package": "unitree_go", "interface": "lo", "domain": domain, "late": 0.06, "still": 0.04}
        settings |= {"find": 60.0, "lies_down": True, "channel": there.fileno(), "board": file.fileno()}
        command = [sys.executable, "-c", f"from {guard.__name__} import main; main()", json.dumps(settings)]
        process = subprocess.Popen(command, pass_fds=(there.fileno(), file.fileno()), start_new_session=True)
    here.close()
    live(sim, lambda: process.poll() is not None)
    assert process.returncode == 0 and sim.end.program == "normal" and not {STAND_DOWN} & {*sim.end.calls}


LATE = "no targets for [0-9]+ ms: the policy's process hangs or is late; the joints are damped"
STOOD = "nothing was sent for [0-9]+ ms: the guard stood still, or this computer slept; the joints are damped"
# a computer that is too busy is late, too, and stands still
PROCESSES: dict[str, tuple[signal.Signals | None, str]] = {
    "dies": (signal.SIGKILL, f"the policy's process ended; the joints are damped|{STOOD}"),
    "hangs": (signal.SIGSTOP, f"{LATE}|{STOOD}"),
    "clock": (None, f"the newest measurement is 1[0-9]{{4}} ms old|{LATE}|{STOOD}"),
}


@pytest.mark.parametrize("fault", PROCESSES)
def test_processes_of_a_policy_that_dies_or_hangs(fault: str, domain: int) -> None:
    """The guard is another process: it damps on the simulated robot's own record, where there is no watchdog."""
    (number, said), sim = PROCESSES[fault], served(domain)
    with policy(domain, fault) as process:
        driven(sim, process)
        if number == signal.SIGKILL:
            assert re.match(
                "another program sends rt/lowcmd in domain .*: end it first; nothing was sent", second(domain, sim)
            )
        if number:
            os.kill(process.pid, number)
        else:
            assert process.stdin
            print(file=process.stdin, flush=True)
        live(sim, lambda: sim.record.changes[-1][1] == DAMPED)
        live(sim, lambda begun=sim.time: sim.time > begun + 0.2)
        assert sim.record.changes[-1][1] == DAMPED and sim.record.beyond < 0.25
        process.kill()
        assert re.search(said, process.communicate()[1])


@pytest.mark.parametrize("name", ["SIGHUP", "SIGABRT"])
def test_a_signal_damps_before_it_ends_the_guard(name: str, domain: int) -> None:
    sim = served(domain)
    with policy(domain) as process:
        driven(sim, process)
        assert process.stdout
        os.kill(int(process.stdout.readline().split()[1]), getattr(signal, name))
        live(sim, lambda: sim.record.changes[-1][1] == DAMPED)
        live(sim, lambda begun=sim.time: sim.time > begun + 0.2)
        assert sim.record.changes[-1][1] == DAMPED
        process.kill()
        assert f"the guard was stopped ({name}); the joints are damped" in process.communicate()[1]


def test_what_ends_a_process_ends_the_guard_damped() -> None:
    caught = signal.valid_signals() - guard.KEPT
    names = (
        "HUP",
        "INT",
        "QUIT",
        "ABRT",
        "USR1",
        "USR2",
        "ALRM",
        "TERM",
        "TSTP",
        "TTIN",
        "XCPU",
        "XFSZ",
        "VTALRM",
        "PROF",
        "SYS",
        "TRAP",
    )
    assert {getattr(signal, f"SIG{name}") for name in names} <= caught
    assert {getattr(signal, f"SIG{name}") for name in ("KILL", "STOP", "SEGV", "CHLD")} <= guard.KEPT


@pytest.mark.parametrize(
    ("name", "said"), [("SIGKILL", "of the wire is gone; "), ("SIGSTOP", f"of the wire was silent for |{guard.DEAF}")]
)
def test_a_guard_that_can_do_nothing_is_replaced(name: str, said: str, domain: int) -> None:
    """The policy's process damps, with a publisher of its own. A guard that goes on damps, too: what waited for it is not obeyed."""
    sim = served(domain)
    with policy(domain) as process:
        driven(sim, process)
        assert process.stdout
        os.kill(pid := int(process.stdout.readline().split()[1]), getattr(signal, name))
        live(sim, lambda: sim.record.changes[-1][1] == DAMPED)
        if name == "SIGSTOP":
            os.kill(pid, signal.SIGCONT)
        live(sim, lambda: process.poll() is not None)
        errors = process.communicate()[1]
    live(sim, lambda begun=sim.time: sim.time > begun + 2.0)  # longer than a guard that goes on sends
    assert sim.record.changes[-1][1] == DAMPED
    assert re.search(said, errors) and guard.INSTEAD in errors, errors


def test_one_process_of_a_computer_commands_a_robot(domain: int) -> None:
    """Whether or not it has sent already, or is silent for a moment; the right ends with its holder."""
    begun, first = clock(), link.claim("lo", domain, 0.0)
    if first is None:
        pytest.skip("only Linux has abstract sockets")
    with pytest.raises(
        RobotError, match=f"another program sends rt/lowcmd in domain {domain} on lo: end it first; nothing was sent"
    ):
        link.claim("lo", domain, 0.2)
    assert clock() - begun >= 0.2
    first.close()
    again = link.claim("lo", domain, 0.0)
    assert again
    again.close()


def test_a_guard_that_ends_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", shutil.which("false"))
    with pytest.raises(
        RobotError, match="the guard of the wire did not start: it ended, or took longer than 60 s; no command was sent"
    ):
        Guarded.start("unitree_go", "lo", 0)


def test_a_guard_says_what_is_wrong(domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(RobotError, match="no robot: no rt/lowstate of unitree_go in domain"):
        Guarded.start("unitree_go", "lo", domain, find=0.2)
    contract = read_contract(POLICIES / "go1_flat")
    with pytest.raises(RobotError, match="which a go2 does not measure"):
        client.connect(POLICIES / "go1_flat", contract, "lo", domain)


def test_the_programs(domain: int, tmp_path: Path) -> None:
    """Two programs over loopback: the remote of the robot's side stands the robot up, starts the policy, walks and ends it."""
    press = [f"{{time: {0.5 * k}, press: [{button}]}}" for k, button in enumerate(["start", "A"] * 20, start=4)]
    (tmp_path / "remote.yaml").write_text(f"remote: [{{time: 0, ly: 0.4}}, {', '.join(press)}]")
    command = [
        sys.executable,
        *shlex.split("-m legged_mw.deploy go2_flat --interface lo --domain"),
        str(domain),
        "--serve",
        "unitree",
    ]
    where: dict[str, Any] = {
        "cwd": POLICIES.parents[1],
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
    }
    with contextlib.ExitStack() as stack:
        robot = subprocess.Popen([*command, "--remote", str(tmp_path / "remote.yaml")], **where)
        stack.callback(robot.kill)
        policy = subprocess.Popen(deploy(domain, "--time", "60s"), **where, env={**os.environ, "PYTHONUNBUFFERED": "1"})
        stack.callback(policy.kill)
        assert policy.stdout
        said = ""
        for line in policy.stdout:  # a busy machine takes longer to stand
            said += line
            if line.startswith("policy: "):
                break
        time.sleep(2.0)  # it walks
        policy.send_signal(signal.SIGINT)
        rest, errors = policy.communicate(timeout=1200)
        assert policy.returncode == 0, errors
        assert "go2 at lo: 12 joints, 32.8 V" in said and "from a measurement to its target: median " in rest, (
            said + rest + errors
        )
        assert "zero torque: " in said and "stand: " in said and "policy: select: damping" in said, said
        robot.send_signal(signal.SIGINT)
        said, errors = robot.communicate(timeout=1200)
        assert "from a state to the first command that answers it: median " in said and "0 refused" in said, errors
        assert "degrees from upright" in said


def test_the_program_with_motors_in_another_order(domain: int) -> None:
    """As soon as it would stand: the angles are not those of the joints."""
    sim = served(domain)
    sim.faults.joint_order = 1
    where: dict[str, Any] = {
        "cwd": POLICIES.parents[1],
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
    }
    with subprocess.Popen(deploy(domain, "--time", "1s"), **where) as policy:
        live(sim, lambda: sim.record.commands > 50)
        sim.remote = encode_remote(["start"])
        live(sim, lambda: policy.poll() is not None)
        said, errors = policy.communicate()
    assert policy.returncode == 0, errors
    assert re.search(
        "\ndamping: [FR][LR]_.*_joint is (at|told to go to) .* rad, .* beyond its range .*; (0.25|1.50) is the most\n",
        said,
    ), said
    assert sim.record.changes[-1][1] == DAMPED and sim.record.beyond < 0.25


def test_a_served_robot_says_why_it_refuses(domain: int, capsys: pytest.CaptureFixture[str]) -> None:
    """Once for each kind of mistake, when it is made; the rest are counted."""
    sim, command = served(domain), WireMessage(LAYOUTS["unitree_go", "LowCmd_"])
    bodies = [command.seal()] * 3 + [command.body[:-1]] * 2
    command["head"], command["level_flag"] = LOW_LEVEL[:2], LOW_LEVEL[2]
    bodies += [command.body] * 2  # the checksum of before
    command["motor_cmd.q"] = np.nan
    bodies += [command.seal()] * 2
    sim.end.receive = iter([*bodies, *[None] * 100]).__next__  # type: ignore[method-assign]
    done = driver.run(sim, Handset(), 0.04)
    refused = [line for line in capsys.readouterr().out.splitlines() if line.startswith("refused: ")]
    assert done.record.refused == len(bodies) and len(refused) == 4
    for line, word in zip(refused, ["level_flag (0, 0, 0)", "807 bytes", "checksum", "q is not finite"], strict=True):
        assert word in line


def test_a_served_robot_tells_what_its_faults_led_to(domain: int, capsys: pytest.CaptureFixture[str]) -> None:
    sim, faults = served(domain), parse_faults(["hot_motor@0.02,silent@0.02", "frozen@9"], [])
    zeros, kp = np.zeros(12), np.full(12, 1.0)
    sim._obey({"q": sim.joint_pos, "dq": zeros, "tau": zeros, "kp": kp, "kd": zeros})
    sim.record.changes.append((0.065, DAMPED))
    done = driver.run(sim, Handset(), 0.04, faults)
    assert sim.faults == Faults(temperature=95.0, silent=True) and len(done.faults) == 2
    assert (
        "hot_motor@0.02: its motors damped 45 ms later, and nothing drove them again\nsilent@0.02: its motors"
        in done.text()
    )
