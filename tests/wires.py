"""For tests of the wire: a DDS domain that no other test on this machine uses, and both of its ends in one process, in lockstep."""

from __future__ import annotations

import contextlib
import fcntl
import gc
import itertools
import os
import tempfile
import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from legged_mw import ROOT
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.robot import Floats, RobotError
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.unitree.client import UnitreeRobot
from legged_mw.unitree.link import LEASE, Received, RobotEnd, Wire
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import STEP, SimulatedUnitree

POLICIES = ROOT / "resources" / "policies"


_next = itertools.count(os.getpid())


@contextlib.contextmanager
def locked_domain() -> Iterator[int]:
    """A domain that is locked meanwhile, and that nobody used for a while: what was killed there is counted until its lease is over."""
    for number in (100 + each % 130 for each in _next):
        with (Path(tempfile.gettempdir()) / f"legged_mw-dds-{number}").open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                time.sleep(0.05)
                continue
            used = os.fstat(file.fileno())
            if used.st_size and time.time() - used.st_mtime < LEASE:
                time.sleep(0.05)
                continue
            try:
                yield number
            finally:
                gc.collect()  # participants leave with their last reference
                file.truncate(0)
                file.write("used")
            return


@pytest.fixture
def domain() -> Iterator[int]:
    """Of one test."""
    with locked_domain() as number:
        yield number


class Owner:
    """The policy's end of a wire that leads nowhere: states that wait, and what is sent."""

    def __init__(self, *bodies: bytes, stamp: float = 0.0) -> None:
        self.states = deque(Received(body, stamp) for body in bodies)
        self.sent = list[bytes]()

    def receive(self) -> Received | None:
        return self.states.popleft() if self.states else None

    def arm(self, damping: bytes) -> None:
        self.sent.append(damping)

    def send(self, body: bytes, stamp: float, safe: bool) -> None:
        self.sent.append(body)

    def close(self, last: bytes) -> str:
        self.sent.append(last)
        return ""


class Direct:
    """A wire in this process, without a guard, for tests in lockstep."""

    def __init__(self, wire: Wire) -> None:
        self.wire = wire

    def receive(self) -> Received | None:
        if self.wire.other_commander():
            raise RobotError("another program sends commands to this robot, too")
        if why := self.wire.another_robot():
            raise RobotError(why)
        return self.wire.receive()

    def arm(self, damping: bytes) -> None: ...

    def send(self, body: bytes, stamp: float, safe: bool) -> None:
        self.wire.send(body)

    def close(self, last: bytes) -> str:
        for _ in range(5):
            self.wire.send(last)
        return ""


class Pair(NamedTuple):
    """A simulated robot and its client; time passes only in ``steps`` and what calls it."""

    sim: SimulatedUnitree
    robot: UnitreeRobot
    contract: Contract
    safety: Safety

    def steps(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP)):
            self.sim.step()

    def period(self) -> None:
        self.steps(self.contract.period)

    def rise(self, seconds: float = 1.5) -> None:
        """Stand, at three times the contract's stiffness."""
        begin, count = self.robot.read().joint_pos, round(seconds / self.contract.period)
        for k in range(1, count + 1):
            share = k / count
            self.robot.write(
                begin + share * (self.contract.default_pose - begin), stiffness=3 * share * self.contract.stiffness
            )
            self.period()

    def walk(self, controller: Any, command: Floats, seconds: float) -> Floats:
        """Follow a policy; returns how far (x, y) [m] the root came."""
        begin = self.sim.data.qpos[:2].copy()
        for _ in range(round(seconds / self.contract.period)):
            self.robot.write(controller.act(self.robot.read(), command)[0])
            self.period()
        return self.sim.data.qpos[:2] - begin


def pair(task: str, domain: int, **settings: Any) -> Pair:
    """Both ends of a shipped policy's robot, after what must be asked before the first command."""
    folder = POLICIES / task
    contract = read_contract(folder)
    package = machine_of(contract.joints).package
    sim = SimulatedUnitree(folder, contract, RobotEnd(package, "lo", domain), **settings)
    wire = Wire(package, "lo", domain, wait=sim.step, clock=lambda: sim.time)
    robot = UnitreeRobot(contract, Direct(wire), wire.prepare(listen=0.1), clock=lambda: sim.time)
    return Pair(sim, robot, contract, Safety(contract, Limits.of(folder, contract, robot.limits)))
