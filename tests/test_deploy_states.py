"""The states of a driven robot, who may change them, and the program that puts it all together."""

from __future__ import annotations

import math
import os
import pty
import re
import select
import signal
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from drivers import Script, Watched, driven

from legged_mw import ROOT
from legged_mw.deploy import __main__ as program
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import DriveInput, Gamepad, Keys, RobotRemote, StopFile, from_sticks
from legged_mw.deploy.log import read_log
from legged_mw.deploy.robot import Health, Measurement, Remote
from legged_mw.deploy.runner import run
from legged_mw.deploy.states import KEPT, STANDS, STEEP, States, at_odds, wrong_imu
from legged_mw.utils.errors import UserError

POLICIES = ROOT / "resources/policies"
GO1 = POLICIES / "go1_flat"


@pytest.fixture(scope="module")
def contract() -> Contract:
    return read_contract(GO1)


# ---- from lying to walking


@pytest.mark.parametrize(("name", "lies", "stands"), [("go1_flat", 0.12, 0.24), ("go2_flat", 0.1, 0.27)])
def test_from_lying_to_walking(name: str, lies: float, stands: float) -> None:
    """At zero torque it lies on its belly; it rises within 4 s without a jerk, walks, and sinks back at select."""
    contract, said = read_contract(POLICIES / name), []
    robot, controller = Watched(POLICIES / name, contract, whole=True), Controller(POLICIES / name, contract)
    source = Script({60: "start", 300: "A", 450: "select", 500: "A"}, command=[0.6, 0.0, 0.0])
    done, passed = driven(robot, controller, source, 11.0, said)
    assert passed == ["zero torque", "stand", "policy", "damping"] and not done.trips
    assert said == [
        "stand: 2 s to the default pose; then A: policy",
        "policy: select: damping",
        "damping: select was pressed",
    ]
    assert robot.done == ["limp"] * 60 + ["write"] * 390 + ["damp"] * 100
    heights, joints = np.array(robot.heights), np.array(robot.joints)
    assert heights[59] < lies and heights[299] > stands and heights[-1] < lies
    assert np.abs(joints[299] - contract.default_pose).max() < STANDS
    assert np.abs(np.diff(joints[60:300], axis=0)).max() < 0.12  # [rad] a period: no joint faster than 6 rad/s
    assert robot.fleet.qpos[0, 0] > 1.0  # it walked


def test_limits_judge_the_gains_that_a_robot_has(contract: Contract, monkeypatch: pytest.MonkeyPatch) -> None:
    """One that cannot change them stands up with the contract's, so the torque limit counts with those."""
    robot, judged = Watched(GO1, contract, whole=True), []
    robot.can_change_gains = False
    monkeypatch.setattr(
        "legged_mw.deploy.safety.Safety.asked", lambda _, measured, targets, *gains: judged.append(gains)
    )
    driven(robot, Controller(GO1, contract), Script({2: "start"}), 0.2, [])
    assert len(judged) == 8 and set(judged) == {(None, None)}


def test_standing_begins_where_the_joints_are(contract: Contract) -> None:
    """The first target is the measured pose, with a tenth of the stiffness; both reach their ends after 2 s."""
    controller, source = Controller(GO1, contract), Script({0: "start"})
    states = States(controller, [source], lambda _: np.zeros(3), lambda _: None)
    robot = Watched(GO1, contract)
    lying = contract.default_pose + np.linspace(-1.0, 1.0, 12)
    measured = replace(robot.read(), joint_pos=lying)
    orders = []
    for step in range(101):
        assert states.listen(Health(), 0.02 * step) is None
        orders.append(states.step(measured, 0.02 * step))
    np.testing.assert_allclose(orders[0].targets, lying)
    np.testing.assert_allclose(orders[0].stiffness, 0.1 * contract.stiffness)
    np.testing.assert_allclose(orders[50].targets, (lying + contract.default_pose) / 2)
    np.testing.assert_allclose(orders[100].targets, contract.default_pose)
    assert all((later.stiffness > before.stiffness).all() for before, later in zip(orders, orders[1:], strict=False))  # type: ignore[union-attr, operator]
    for step in range(101, 400):
        states.listen(Health(), 0.02 * step)
        last = states.step(measured, 0.02 * step)
    # the joints did not come: stiffer, but not without end
    np.testing.assert_allclose(last.stiffness, 3.0 * contract.stiffness)


def test_buttons_that_come_too_early(contract: Contract) -> None:
    """A at zero torque does nothing, A before it stands has to wait, start while it walks does nothing."""
    said: list[str] = []
    robot, controller = Watched(GO1, contract, hoisted=True), Controller(GO1, contract)
    source = Script(
        {1: "A", 5: "start", 50: "A", 120: "A", 130: "start", 140: "select", 150: "start", 155: "A", 160: "start"}
    )
    _, passed = driven(robot, controller, source, 3.4, said)
    assert passed == ["zero torque", "stand", "policy", "damping", "zero torque", "stand"]
    [waits] = [line for line in said if "wait" in line]
    assert waits.startswith("stand: A has to wait until the robot stands: ") and waits.endswith(
        " rad from its pose after 0.9 s"
    )


def test_after_a_trip_a_person_starts_again(contract: Contract) -> None:
    """Three buttons, and what was measured before counts no more."""
    robot, controller = Watched(GO1, contract, hoisted=True), Controller(GO1, contract)
    robot.health_at = lambda step: Health(voltage=20.0 if 60 <= step < 70 else 30.0)
    source = Script({5: "start", 100: "start", 105: "start", 220: "A"})
    done, passed = driven(robot, controller, source, 5.0, voltage=24.0)
    assert passed == ["zero torque", "stand", "damping", "zero torque", "stand", "policy"]
    assert [trip.limit for trip in done.trips] == ["voltage"]


# ---- who drives


def test_sticks_stay_within_what_was_trained(contract: Contract) -> None:
    """Their ends are the ends of the ranges: vx -1.5 to 1.5, vy -0.8 to 0.8, yaw rate -1.2 to 1.2; ahead, left, left are positive."""
    table = contract.commands
    assert from_sticks(Remote(ry=1.0), table) is None and from_sticks(Remote(lx=0.05), table) is None
    for remote, wanted in (
        (Remote(ly=1.0), [1.5, 0, 0]),
        (Remote(ly=-0.5), [-0.75, 0, 0]),
        (Remote(lx=1.0, rx=0.5), [0, -0.8, -0.6]),
        (Remote(lx=-7.0), [0, 0.8, 0]),
    ):
        np.testing.assert_allclose(from_sticks(remote, table), wanted)
    crouch = [table[0]._replace(low=0.2, high=0.6, default=0.3), table[1]]
    np.testing.assert_allclose(from_sticks(Remote(ly=-0.5, lx=0.5), crouch), [0.25, -0.4])
    assert from_sticks(Remote(lx=0.5), ()) is None


def test_the_robots_remote(contract: Contract) -> None:
    """A button counts once however long it is held; L2 and B together stop."""
    remote = RobotRemote(contract.commands)

    def poll(*buttons: str) -> DriveInput:
        return remote.poll(Health(remote=Remote(frozenset(buttons))))

    assert [poll("start", "X").pressed, poll("start").pressed, poll().pressed, poll("start").pressed] == [
        {"start"},
        set(),
        set(),
        {"start"},
    ]
    assert poll("L2").stop == poll("B").stop == "" and poll("L2", "B").stop == "the remote's emergency stop (L2 + B)"
    assert remote.poll(Health()) == DriveInput()


def test_keys(contract: Contract) -> None:
    read, write = os.pipe()
    keys = Keys(contract.commands, read)

    def press(text: str) -> DriveInput:
        os.write(write, text.encode())
        return keys.poll(Health())

    assert keys.poll(Health()) == DriveInput()
    assert press("s").pressed == {"start"} and press("a").pressed == {"A"} and press("x").pressed == {"select"}
    wish = press("\x1b[A\x1b[A\x1b[Cq")
    np.testing.assert_allclose(wish.command, [0.6, -0.16, 0.24])  # a fifth of the range each
    assert not wish.pressed and not wish.stop
    np.testing.assert_allclose(press(" ").command, 0.0)
    assert press("o").command is None  # back to the command without a driver
    assert press("\x1b").stop == "the emergency stop (key Esc)" and press("zp").pressed == set()
    press("\x1b[A")
    keys.let_go()
    assert keys.poll(Health()).command is None
    os.close(write)
    assert keys.poll(Health()).stop == keys.poll(Health()).stop == "the terminal is gone"
    keys.close()
    os.close(read)


def test_a_gamepad(contract: Contract, tmp_path: Path) -> None:
    fifo = tmp_path / "js0"
    os.mkfifo(fifo)
    keep = os.open(fifo, os.O_RDWR)
    pad = Gamepad(fifo, contract.commands)

    def feel(*events: tuple[int, int, int]) -> DriveInput:
        os.write(keep, b"".join(struct.pack("<IhBB", 0, *event) for event in events))
        return pad.poll(Health())

    assert feel((0, 0x81, 0), (0, 0x82, 1)) == DriveInput()  # as it is at the opening
    assert feel((1, 1, 7), (0, 1, 7)).pressed == {"start"}  # pressed and let go between two steps
    assert feel((1, 1, 0)).pressed == {"A"} and feel((1, 1, 6)).pressed == {"select"}
    np.testing.assert_allclose(feel((-32767, 2, 1), (32767, 2, 3)).command, [1.5, 0.0, -1.2])
    assert feel((32767, 2, 2), (1, 1, 1)).stop == "the gamepad's emergency stop (L2 + B)"
    assert feel((0, 1, 1), (-32767, 2, 2)).stop == ""
    tapped = feel((32767, 2, 2), (1, 1, 1), (0, 1, 1), (-32767, 2, 2))  # and let go between two steps
    assert tapped.stop == "the gamepad's emergency stop (L2 + B)" and feel().stop == ""
    os.close(keep)
    assert pad.poll(Health()).stop == "the gamepad was unplugged"
    pad.close()
    pad.close()


@pytest.mark.parametrize("how", ["written", "closed"])
def test_a_file_descriptor_stops(how: str) -> None:
    read, write = os.pipe()
    stop = StopFile(read)
    assert stop.poll(Health()) == DriveInput()
    os.write(write, b"!") if how == "written" else os.close(write)
    assert stop.poll(Health()).stop == f"file descriptor {read}"
    os.close(read)


def test_one_who_drives_goes_before_the_others(contract: Contract) -> None:
    """The sticks while they are out of their centre; what the keys had asked for before is forgotten then."""
    read, write = os.pipe()
    robot, controller = Watched(GO1, contract), Controller(GO1, contract)
    states = States(
        controller,
        [RobotRemote(contract.commands), Keys(contract.commands, read)],
        lambda _: np.full(3, 0.1),
        lambda _: None,
    )
    assert robot.read()

    def command(remote: Remote | None, keys: str = "") -> list[float]:
        os.write(write, keys.encode())
        states.listen(Health(remote=remote), 0.0)
        return [round(float(value), 3) for value in states.command]

    assert command(None) == [0.1, 0.1, 0.1]
    assert command(Remote(), "\x1b[A") == [0.3, 0.0, 0.0]
    assert command(Remote(ly=0.5)) == [0.75, 0.0, 0.0]
    assert command(Remote()) == [0.1, 0.1, 0.1]
    os.close(write)
    os.close(read)


def test_a_command_by_keys_ends_with_the_policy(contract: Contract) -> None:
    """Ahead, a stop; what is pressed while it lies does not count either: the next policy begins at rest."""
    read, write = os.pipe()
    typed = {5: "s", 230: "a", 240: 2 * "\x1b[A", 243: "x", 260: 5 * "\x1b[B", 300: "s", 305: "s", 540: "a"}

    class Typist(Keys):
        step = -1

        def poll(self, health: Health) -> DriveInput:
            self.step += 1
            os.write(write, typed.get(self.step, "").encode())
            return super().poll(health)

    robot, commands = Watched(GO1, contract, whole=True), dict[str, list[list[float]]]()
    keys, controller = Typist(contract.commands, read), Controller(GO1, contract)
    states = States(controller, [keys], lambda _: np.zeros(3))

    def watch(_now: float, _measured: Measurement | None) -> None:
        commands.setdefault(f"{states.state} from {states.since:.2f}", []).append(states.command.tolist())

    run(robot, controller, lambda _: np.zeros(0), 11.2, live=False, watch=watch, states=states)
    (first, second) = (each for name, each in commands.items() if name.startswith("policy"))
    assert first[-1] == [0.6, 0.0, 0.0] and second == [[0.0, 0.0, 0.0]] * 20
    os.close(write)
    os.close(read)


# ---- the program


def in_terminal(args: list[str], presses: list[tuple[str, bytes]]) -> tuple[int, str]:
    """Run the program in a terminal of its own; each press once its text was shown. Its code and what it showed."""
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(ROOT)
        os.execv(sys.executable, [sys.executable, "-m", "legged_mw.deploy", *args])
    shown, seen, until = "", 0, time.monotonic() + 300
    while time.monotonic() < until:
        if not select.select([terminal], [], [], 0.1)[0]:
            continue
        try:
            data = os.read(terminal, 4096)
        except OSError:
            break
        if not data:
            break
        shown += data.decode(errors="replace")
        while presses and presses[0][0] in shown[seen:]:
            seen = shown.index(presses[0][0], seen) + len(presses[0][0])
            os.write(terminal, presses.pop(0)[1])
    if time.monotonic() >= until:
        os.kill(process, signal.SIGKILL)
    _, status = os.waitpid(process, 0)
    os.close(terminal)
    return os.waitstatus_to_exitcode(status), shown


def test_it_is_driven_from_a_terminal(tmp_path: Path) -> None:
    log, script = tmp_path / "run.lmwlog", tmp_path / "script.yaml"
    script.write_text("commands: [{time: 0, command: [0.1, 0, 0]}, {time: 1, push: [0, 1]}, {time: 2, reset: true}]")
    presses = [
        ("zero torque: start", b"s"),
        ("stand: 2 s", b"a"),
        ("has to wait", b"\x1b[A"),
        ("+0.30 +0.00 +0.00", b"\x1b"),
    ]
    presses += [("emergency stop", b"\x03")]
    how = ["--hoist", "yes", "--log", str(log), "--limit", "late=off", "--commands", str(script)]
    code, shown = in_terminal([str(GO1), "--drive", *how], presses)
    assert code == 0 and not presses, shown
    assert "script.yaml: 2 of its pushes and resets are left out; a driven robot gets only commands" in shown
    assert "damping: the emergency stop (key Esc)" in shown and "late" in shown and "begin late by median" in shown
    assert f"the joints are damped; logged to {log}" in shown
    recording = read_log(log)
    assert next(text for _, text in recording.events) == "stop: the emergency stop (key Esc)"
    assert recording.header["robot"] == "simulated" and 1.0 in recording.rows["state"]


@pytest.mark.parametrize("ending", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_damps_and_ends(ending: signal.Signals, tmp_path: Path) -> None:
    args = [sys.executable, "-m", "legged_mw.deploy", str(GO1), "--drive", "--log", str(tmp_path / "x.lmwlog")]
    with subprocess.Popen(args, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout and process.stdout.readline().startswith("keys: s start, a policy")
        assert process.stdout.readline() == "zero torque: start: stand\n"
        time.sleep(0.5)
        process.send_signal(ending)
        rest = process.stdout.read()
    assert process.returncode == 0 and "the joints are damped; logged to" in rest


@pytest.mark.parametrize(
    "flags",
    [
        ["--limit", "tlit=45"],
        ["--limit", "tilt=4o"],
        ["--gamepad", "/no/js9"],
        ["--stop_fd", "999"],
        ["--log", ""],
    ],
)
def test_no_robot_is_touched_for_a_flag_that_is_wrong(
    flags: list[str], contract: Contract, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To connect ends the robot's own program, and what stands by it falls."""
    monkeypatch.setattr(sys, "argv", ["deploy", str(GO1), "--drive", *flags])
    touched = list[bool]()
    monkeypatch.setattr(program, "MujocoRobot", lambda *_, **__: touched.append(True))
    with pytest.raises(UserError):
        program.main()
    assert not touched


def swapped(one: int, other: int) -> Any:
    order = [0, 1, 2]
    order[one], order[other] = other, one
    return order


@pytest.mark.parametrize(
    ("parts", "order", "sign", "word"),
    [
        ([], [0, 1, 2], 1.0, ""),
        (["ang_vel"], [0, 1, 2], -1.0, "gyro"),
        (["ang_vel"], swapped(0, 1), 1.0, "gyro"),
        (["ang_vel"], swapped(1, 2), 1.0, "gyro"),
        (["ang_vel"], swapped(0, 2), 1.0, ""),  # it pitches alone: roll and yaw cannot be told apart
        (["ang_vel", "gravity"], swapped(0, 1), 1.0, "gyro"),
        (["acceleration"], swapped(0, 2), 1.0, "accelerometer"),
        (["acceleration"], swapped(1, 2), 1.0, "accelerometer"),
    ],
)
def test_an_imu_with_wrong_axes(parts: list[str], order: list[int], sign: float, word: str) -> None:
    """As a Go2 that stands up pitches: gravity must turn as the gyro says, and at rest be what the accelerometer feels."""
    seen, period = [], 0.02
    for step in range(120):
        pitch, quick = 0.05 * math.sin(2.0 * step * period), 0.1 * math.cos(2.0 * step * period)
        down = np.array([math.sin(pitch), 0.0, -math.cos(pitch)])
        values = {"ang_vel": np.array([0.001, quick, 0.001]), "gravity": down, "acceleration": -9.81 * down}
        values |= {name: sign * values[name][order] for name in parts}
        rest = {name: np.zeros(3) for name in ("lin_vel", "joint_pos", "joint_vel", "joint_torque", "foot_contact")}
        seen.append(Measurement(**rest, **values))
    said = wrong_imu(seen, period)
    assert bool(said) == bool(word) and word in said, said


def test_the_bias_of_a_gyro_does_not_add_up(contract: Contract) -> None:
    """0.03 rad/s on a robot that waits for a person for 20 s."""
    assert KEPT < 3.0
    rest = {name: np.zeros(3) for name in ("lin_vel", "joint_pos", "joint_vel", "joint_torque", "foot_contact")}
    still = Measurement(
        **rest, ang_vel=np.full(3, 0.03), gravity=np.array([0.0, 0.0, -1.0]), acceleration=np.array([0.0, 0.0, 9.81])
    )
    assert wrong_imu([still] * round(KEPT / contract.period), contract.period) == ""


@pytest.fixture(scope="module", params=["go1_flat", "go2_flat"])
def stood(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    """What the legs of a robot that stood up say of gravity (N, 3), and what its IMU does."""
    contract, seen = read_contract(POLICIES / request.param), []
    robot, controller = (
        Watched(POLICIES / request.param, contract, whole=True),
        Controller(POLICIES / request.param, contract),
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("legged_mw.deploy.states.at_odds", lambda *three: seen.append(three[:2]) or at_odds(*three))
        passed = driven(robot, controller, Script({40: "start", 180: "A"}), 4.0)[1]
    assert passed[-1] == "policy"
    return seen[0]


def about(axis: int, degrees: float) -> np.ndarray:
    """Turns row vectors about an axis."""
    turn, (one, other) = np.eye(3), [each for each in range(3) if each != axis]
    turn[one, one] = turn[other, other] = math.cos(math.radians(degrees))
    turn[one, other] = -math.sin(math.radians(degrees))
    turn[other, one] = -turn[one, other]
    return turn


@pytest.mark.parametrize(
    ("wrong", "word"),
    [
        (np.eye(3), ""),
        (about(0, 10.0), ""),  # a slope
        (about(1, 10.0), ""),
        (about(2, 15.0), ""),
        (about(0, STEEP + 5.0), "degrees from where"),
        (np.eye(3)[swapped(0, 1)], "pitched"),
        (np.eye(3)[swapped(1, 2)], "pitched|rolled"),
        (np.eye(3)[swapped(0, 2)], "pitched|rolled"),
        (about(2, 90.0), "pitched"),
        (about(2, -90.0), "pitched"),
        (about(2, 180.0), "pitched"),
        (np.diag([-1.0, 1.0, 1.0]), "pitched"),
        (np.diag([1.0, -1.0, 1.0]), "rolled"),
        (np.diag([1.0, 0.0, 1.0]), "rolled"),  # a quaternion's x and z swapped: heading is read as roll
        (np.diag([1.0, 1.0, -1.0]), "degrees from where"),
    ],
)
def test_gravity_that_is_not_that_of_the_legs(
    stood: tuple[np.ndarray, np.ndarray], wrong: np.ndarray, word: str
) -> None:
    """The whole IMU has wrong axes, and agrees with itself: pitch and roll of the legs tell, of which it rolls by a sway."""
    legs, gravity = stood
    rng = np.random.default_rng(0)
    said = at_odds(legs, gravity @ wrong + 0.005 * rng.standard_normal(gravity.shape), 0.02)
    assert bool(said) == bool(word) and re.search(word, said), said
    assert at_odds(np.full_like(legs, np.nan), gravity @ wrong, 0.02) == ""


@pytest.mark.parametrize("rate", [50, 125, 250])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_the_imu_is_judged_for_as_long_at_any_rate(contract: Contract, rate: int, sign: float) -> None:
    """Gravity's y of the wrong sign shows in the roll of the second half of standing up, however often is measured."""
    quick = replace(contract, period=1.0 / rate, decimation=round(1.0 / rate / contract.timestep))
    robot, controller, rng = Watched(GO1, quick, whole=True), Controller(GO1, quick), np.random.default_rng(0)
    robot.changed = lambda _, measured: replace(
        measured, gravity=(measured.gravity + 0.005 * rng.standard_normal(3)) * [1.0, sign, 1.0]
    )
    said: list[str] = []
    driven(robot, controller, Script({round(0.2 * rate): "start", round(4.2 * rate): "A"}), 4.3, said)
    assert said[-1].startswith("policy" if sign > 0.0 else "stand: A is refused"), said


def test_a_robot_that_hangs_is_not_judged_by_its_legs(contract: Contract) -> None:
    robot, controller = Watched(GO1, contract, hoisted=True, lift=0.3), Controller(GO1, contract)
    robot.changed = lambda _, measured: replace(
        measured, **{name: getattr(measured, name)[[1, 0, 2]] for name in ("gravity", "ang_vel")}
    )
    assert driven(robot, controller, Script({5: "start", 130: "A"}), 2.7)[1][-1] == "policy"
