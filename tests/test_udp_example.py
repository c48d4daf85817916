"""examples/udp_robot.py: the same walk over a network link, and what either end refuses."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from recorder import Recorder

from legged_mw import ROOT
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import RobotError
from legged_mw.deploy.runner import run
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.utils.errors import UserError

SHIPPED = ROOT / "resources/policies/go1_flat"
PROGRAM = ROOT / "examples/udp_robot.py"
AHEAD = np.array([0.8, 0.0, 0.0])

_spec = importlib.util.spec_from_file_location("udp_robot", PROGRAM)
assert _spec and _spec.loader
udp: Any = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(udp)


@pytest.fixture(scope="module")
def contract() -> Contract:
    return read_contract(SHIPPED)


@pytest.fixture
def served(contract: Contract) -> Iterator[tuple[Any, MujocoRobot, list[str]]]:
    """A server on a thread, and what it said."""
    said: list[str] = []
    robot = MujocoRobot(SHIPPED, contract)
    server = udp.UdpServer(robot, contract, ("127.0.0.1", 0), timeout=60.0)
    thread = threading.Thread(target=server.serve, args=(said.append,), daemon=True)
    thread.start()
    yield server, robot, said
    while thread.is_alive():  # a test's own client may have closed it
        with contextlib.suppress(RobotError):
            udp.UdpRobot(contract, server.address, timeout=0.5).close()
        thread.join(timeout=0.5)


def test_the_walk_is_the_same_over_udp(served: Any, contract: Contract) -> None:
    server, _, said = served
    runs = []
    for robot in (MujocoRobot(SHIPPED, contract), udp.UdpRobot(contract, server.address, timeout=60.0)):
        recorder = Recorder(robot)
        run(recorder, Controller(SHIPPED, contract), lambda _: AHEAD, 1.0, live=False)
        runs.append(recorder)
    here, there = runs
    np.testing.assert_array_equal(here.targets, there.targets)  # bit for bit
    np.testing.assert_array_equal([m.joint_torque for m in here.measured], [m.joint_torque for m in there.measured])
    for _ in range(3000):
        if len(said) == 2:
            break
        threading.Event().wait(0.02)
    assert said[0].endswith("took the robot") and said[1].endswith(
        "closed the link; the joints are damped, no longer servoed"
    )


def test_after_a_silent_client_the_servos_are_off(contract: Contract) -> None:
    robot, said = MujocoRobot(SHIPPED, contract), []
    server = udp.UdpServer(robot, contract, ("127.0.0.1", 0), timeout=2.0)
    thread = threading.Thread(target=server.serve, args=(said.append,), daemon=True)
    thread.start()
    client = udp.UdpRobot(contract, server.address, timeout=60.0)
    client.write(contract.default_pose)
    thread.join(timeout=120)
    assert said[-1].endswith("sent nothing for 2 s; the joints are damped, no longer servoed")
    robot.write(contract.default_pose)
    assert not robot.read().joint_torque.any()
    with pytest.raises(RobotError, match=r"robot at 127.0.0.1:\d+: .*; stopped \(start one with"):
        client.write(contract.default_pose)
    client.close()


def test_no_answer(contract: Contract) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = deaf.getsockname()[1]
        with pytest.raises(RobotError, match=f"robot at 127.0.0.1:{port}: no answer within 0.1 s; stopped"):
            udp.UdpRobot(contract, ("127.0.0.1", port), timeout=0.1)
        with pytest.raises(UserError, match=f"cannot listen at 127.0.0.1:{port}: "):
            udp.UdpServer(MujocoRobot(SHIPPED, contract), contract, ("127.0.0.1", port))


def test_a_client_of_another_contract_is_refused(served: Any, contract: Contract) -> None:
    server, robot, _ = served
    other = replace(contract, joints=contract.joints[::-1])
    assert udp.contract_digest(other) != udp.contract_digest(contract)
    with pytest.raises(
        RobotError, match="its export has other joints, measurements or another period; use one export at both ends"
    ):
        udp.UdpRobot(other, server.address, timeout=60.0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as raw:
        raw.settimeout(60.0)
        raw.sendto(b"hello?", server.address)  # not a packet of the link: no answer
        packet = bytearray(udp.pack(udp.HELLO, udp.contract_digest(contract), 0))
        packet[4] = 9
        raw.sendto(packet, server.address)
        answer = udp.unpack(raw.recv(1000))
        assert (
            answer is not None
            and answer.kind == udp.REFUSED
            and b"uses version 9 of the link, this one 1" in answer.body
        )
        raw.sendto(udp.pack(udp.TARGETS, udp.contract_digest(contract), 1, bytes(96)), server.address)
        answer = udp.unpack(raw.recv(1000))
        assert answer is not None and answer.kind == udp.REFUSED and answer.body == b"send a hello first"
    assert robot.fleet.qpos[0, 2] == 0.278  # it has not moved


def test_bad_targets_move_nothing(served: Any, contract: Contract) -> None:
    server, robot, _ = served
    client = udp.UdpRobot(contract, server.address, timeout=60.0)
    with pytest.raises(RobotError, match="targets must be 12 finite numbers, one a joint"):
        client.write(np.full(12, np.nan))
    assert robot.fleet.qpos[0, 2] == 0.278


def test_the_server_holds_targets_within_the_contracts_range(served: Any, contract: Contract) -> None:
    """Whoever the client is."""
    server, robot, _ = served
    written: list[Any] = []
    robot.write = lambda targets, **_: written.append(targets)
    client = udp.UdpRobot(contract, server.address, timeout=5.0)
    client.write(contract.default_pose + 5.0)
    client.close()
    np.testing.assert_array_equal(written, [contract.action.highest])


def test_another_scan_is_another_contract() -> None:
    seen, blind = (read_contract(ROOT / "resources/policies" / name) for name in ("go1_rough_scan", "go1_rough"))
    assert udp.contract_digest(seen) != udp.contract_digest(blind)


# The program on a computer that may be busy: what silence leads to is tested above.
PATIENT = f"""
import runpy, sys
from legged_mw.deploy import safety
safety.Safety._on_time = lambda *_: None  # a step that begins late, or not at all
program = runpy.run_path({str(PROGRAM)!r})
for end in ("UdpRobot", "UdpServer"):
    program[end].__init__.__defaults__ = (60.0,)  # its only default: timeout [s]
program["one_line_errors"]("udp_robot.py")(program["main"])()
"""


def test_the_program() -> None:
    """A server and a client, each a process of its own; and an address that is none."""
    serve = [sys.executable, "-c", PATIENT, str(SHIPPED), "--serve", "127.0.0.1:0"]
    here: dict[str, Any] = {"cwd": ROOT, "env": {**os.environ, "PYTHONPATH": str(ROOT)}, "text": True}
    wrong = subprocess.run(
        [sys.executable, str(PROGRAM), *serve[3:-1], "robot"], **here, capture_output=True, timeout=1200
    )
    assert (wrong.returncode, wrong.stderr) == (
        2,
        "udp_robot.py: 'robot' is no address; write HOST:PORT, e.g. 127.0.0.1:9870\n",
    )
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    with subprocess.Popen([*serve[:-1], address], **here, stdout=subprocess.PIPE) as server:
        assert (
            server.stdout
            and server.stdout.readline() == f"a simulated robot for go1_flat at {address}; Ctrl-C ends it\n"
        )
        drive = [*serve[:4], "--drive", address, "--command", "0.8,0,0", "--time", "2"]
        done = subprocess.run(drive, **here, capture_output=True, timeout=1200)
        assert done.returncode == 0, done.stderr
        assert (
            server.stdout.read().endswith("closed the link; the joints are damped, no longer servoed\n")
            and server.wait(300) == 0
        )
    assert (
        " steps of 0.02 s" in done.stdout
        and "commanded 0.80, 0.00, 0.00 (vx [m/s], vy [m/s], yaw rate [rad/s])" in done.stdout
    )
