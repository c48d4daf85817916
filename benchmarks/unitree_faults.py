"""How long a Unitree robot's joints take to be damped after each fault of tests/faults.py: in lockstep, and with real processes.

    python benchmarks/unitree_faults.py --runs 5              # all of them, 40 minutes; the table in docs/faults.md
    python benchmarks/unitree_faults.py "policy killed" "frozen state"
    python benchmarks/unitree_faults.py --runs 0              # in lockstep alone

Live, this process is the robot, and each fault has a policy's process and a guard's of its own. Times are from when a fault can be
known to when the robot takes the command that damps it, by the robot's own record.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from pytest import MonkeyPatch

from legged_mw.deploy import states
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.loop import real_time
from legged_mw.unitree import clock
from legged_mw.unitree.client import connect
from legged_mw.unitree.link import RobotEnd, Wire
from legged_mw.unitree.program import PRIORITY
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import DAMPED, STEP, SimulatedUnitree
from tests.faults import CASES, Case, Rig, Side, lockstep
from tests.wires import POLICIES, locked_domain

LONGEST = 30.0  # [s] for one fault
AFTER = 0.3  # [s] that the robot goes on once it is damped: nothing may drive it again


class Live(Rig):
    """The policy's process."""

    def walks(self) -> None:
        report(walks=clock())

    def begin(self) -> None:
        super().begin()
        report(injected=self.injected)


def report(**values: Any) -> None:
    print(json.dumps(values), flush=True)


def policy(name: str, domain: int) -> None:
    """The policy's process: drive the robot until the fault has ended it, or for 10 s."""
    case, folder = CASES[name], POLICIES / CASES[name].task
    states.RISE = 1.0
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where it was started in the background
    robot = connect(folder, read_contract(folder), "lo", domain)
    rig = Live(robot, folder, clock, lambda seconds: time.sleep(seconds) if seconds else None, 0.0)
    rig.run(case, 10.0)
    report(read_at=rig.read_at, said=rig.said)


class Seen(NamedTuple):
    """What `Case.known` asks for, by the clock of all processes [s]."""

    injected: float
    read_at: float
    side: Any


@contextlib.contextmanager
def driven(name: str, domain: int, side: Side) -> Iterator[dict[str, Any]]:
    """A policy's process, and its reports."""
    reports: dict[str, Any] = {"said": []}
    program = [sys.executable, __file__, "--policy", name, "--domain", str(domain)]
    process = subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def listen() -> None:
        assert process.stdout
        for line in process.stdout:
            reports.update(json.loads(line) if line.startswith("{") else {})
            if "walks" in reports and side.walking is None:
                side.walking = side.sim.time

    def listen_to_errors() -> None:
        assert process.stderr
        reports["errors"] = process.stderr.read()

    threads = [threading.Thread(target=each, daemon=True) for each in (listen, listen_to_errors)]
    for thread in threads:
        thread.start()
    try:
        yield reports
    finally:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.send_signal(signal.SIGINT)
            process.wait(5.0)
        process.kill()
        for thread in threads:
            thread.join(5.0)


def live(name: str, domain: int) -> tuple[float, str]:
    """[ms] to damping with real processes, and the line that was printed."""
    case, contract = CASES[name], read_contract(POLICIES / CASES[name].task)
    package = machine_of(contract.joints).package
    sim = SimulatedUnitree(POLICIES / case.task, contract, RobotEnd(package, "lo", domain))
    side = Side(sim, case, Wire(package, "lo", domain), partial(RobotEnd, package, "lo", domain))
    goes_on = AFTER + (case.known_after if case.policy else 0.0)
    moments, times = list[float](), list[float]()  # [s] by the clock of all processes, and by the robot's
    with driven(name, domain, side) as reports:
        begun = due = clock()
        damped = None
        while damped is None or sim.time < damped + goes_on:
            side.before()
            sim.step()
            moments.append(clock())
            times.append(sim.time - STEP)
            since, what = sim.record.changes[-1]
            damped = since if what == DAMPED else None
            due = max(due + STEP, clock() - 0.05)
            time.sleep(max(0.0, due - clock()))
            if clock() > begun + LONGEST:
                raise RuntimeError(f"{name}: not damped after {LONGEST:g} s: {reports}, {sim.record.changes}")

    def moment(robots: float) -> float:
        return float(np.interp(robots, times, moments))

    injected = reports["injected"] if case.policy else moment(side.injected or 0.0)
    side.tilted = None if side.tilted is None else moment(side.tilted)
    known = case.known(Seen(injected, reports.get("read_at", 0.0), side)) if case.known else injected  # type: ignore[arg-type]
    lines = [*reports["said"], *reports["errors"].splitlines()]
    if not any(re.search(case.said, line) for line in lines):
        raise RuntimeError(f"{name}: another line was printed: {lines[-3:]}")
    return 1000 * (moment(damped) - known), line_of(case, lines)


def in_lockstep(name: str, domain: int) -> float:
    """[ms] to damping by the simulated clock."""
    case, contract = CASES[name], read_contract(POLICIES / CASES[name].task)
    package = machine_of(contract.joints).package
    sim = SimulatedUnitree(POLICIES / case.task, contract, RobotEnd(package, "lo", domain))
    wire, other = (Wire(package, "lo", domain, wait=sim.step, clock=lambda: sim.time) for _ in range(2))
    wire.prepare(listen=0.1)
    rig = lockstep(
        case,
        sim,
        wire,
        POLICIES / case.task,
        MonkeyPatch(),
        other=other,
        second=partial(RobotEnd, package, "lo", domain),
    )
    after = sim.record.damped_after(case.known(rig) if case.known else rig.injected or 0.0)
    return float("nan") if after is None else 1000 * after


def line_of(case: Case, lines: list[str]) -> str:
    """The first line that names the fault."""
    said = next((line for line in lines if case.said and re.search(case.said, line)), "")
    return said.removeprefix("damping: ").removeprefix("guard: ").removesuffix("; the joints are damped")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("faults", nargs="*", help="names of the table (default: all)")
    parser.add_argument("--runs", type=int, default=1, help="live runs of each fault")
    parser.add_argument("--policy", help=argparse.SUPPRESS)
    parser.add_argument("--domain", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.policy:
        policy(args.policy, args.domain)
        return
    real_time(PRIORITY, heirs=True)
    print(
        "| fault | `--fault` | the line | in lockstep | live: median | worst |\n| --- | --- | --- | --- | --- | --- |"
    )
    for name in args.faults or CASES:
        print(row(name, args.runs), flush=True)


def row(name: str, runs: int) -> str:
    """One row of the table."""
    case, took, said = CASES[name], " | ", ""
    exact = with_retries(in_lockstep, name)
    if runs and not case.in_lockstep:
        times, lines = zip(*(with_retries(live, name) for _ in range(runs)), strict=True)
        took, said = f"{np.median(times):.0f} | {max(times):.0f}", lines[0]
    flag = f"`{case.robot}`" if isinstance(case.robot, str) and case.robot else ""
    return f"| {name} | {flag} | {said and f'`{said}`'} | {exact:.0f} | {took} |"


def with_retries(measure: Callable[[str, int], Any], name: str) -> Any:
    """Measure, at most three times: each time in another domain, where no other program's guard is about to end."""
    for attempt in range(3):
        with locked_domain() as domain:
            try:
                return measure(name, domain)
            except RuntimeError as error:
                print(f"{name}: {error}", file=sys.stderr, flush=True)
                if attempt == 2:
                    raise
    raise AssertionError("not reached")


if __name__ == "__main__":
    main()
