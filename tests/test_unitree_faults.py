"""Faults over the wire, one at a time: each leaves the joints of the simulated robot damped, by its own record, and says why in a line."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import pytest

from legged_mw import ROOT
from legged_mw.deploy.contract import read_contract
from legged_mw.unitree.link import RobotEnd, Wire
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import SimulatedUnitree
from tests.faults import CASES, REFUSED, SOON, Case, limits_of, lockstep
from tests.wires import POLICIES, locked_domain


class Ends(NamedTuple):
    """A simulated robot, the policy's end of its wire, that of another commander, and what switches another robot on."""

    sim: SimulatedUnitree
    wire: Wire
    other: Wire
    second: Callable[[], RobotEnd]


def make_ends(task: str, domain: int) -> Ends:
    contract = read_contract(POLICIES / task)
    package = machine_of(contract.joints).package
    sim = SimulatedUnitree(POLICIES / task, contract, RobotEnd(package, "lo", domain))
    wires = [Wire(package, "lo", domain, wait=sim.step, clock=lambda: sim.time) for _ in range(2)]
    wires[0].prepare(listen=0.1)
    return Ends(sim, *wires, partial(RobotEnd, package, "lo", domain))


@pytest.fixture(scope="module")
def ends() -> Iterator[dict[str, Ends]]:
    """No other name holds them: a robot that lives on would be a second one for whoever has the domain next."""
    with locked_domain() as domain:
        made = {task: make_ends(task, domain) for task in ("go2_flat", "g1_flat")}
        yield made
        made.clear()


@pytest.mark.parametrize("name", CASES)
def test_a_fault_damps(name: str, ends: dict[str, Ends], monkeypatch: pytest.MonkeyPatch) -> None:
    """Within 100 ms of when it can be known, for good, and no joint is moved beyond its limits."""
    case = CASES[name]
    sim, wire, other, second = ends[case.task]
    rig = lockstep(case, sim, wire, POLICIES / case.task, monkeypatch, other=other, second=second)
    lines = [*rig.said, rig.guard.tripped]
    assert any(line.startswith("policy: ") for line in lines), lines
    assert rig.injected is not None
    known = case.known(rig) if case.known else rig.injected
    assert rig.injected <= known <= rig.injected + case.known_after + 0.5
    after = sim.record.damped_after(known)
    assert after is not None and after <= SOON, (after, known, sim.record.changes, lines)
    said = [line for line in lines if re.search(case.said, line)]
    assert said and "\n" not in said[0], lines
    limits = limits_of(POLICIES / case.task)
    assert sim.record.beyond < limits.position and sim.record.fastest < limits.speed
    if not case.misplaced:
        assert sim.record.asked < limits.torque and sim.record.outside < 1e-6


@pytest.mark.parametrize("name", [*REFUSED, ""])
def test_a_fault_from_the_start_keeps_it_from_walking(
    name: str, ends: dict[str, Ends], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stands up and stays there, however often A is pressed; without a fault it walks."""
    case = REFUSED.get(name, Case("policy: ", from_start=True, known_after=4.0))
    sim, wire, other, second = ends[case.task]
    rig = lockstep(case, sim, wire, POLICIES / case.task, monkeypatch, other=other, second=second)
    assert (rig.side.walking is None) == (name in REFUSED), rig.said
    assert any(re.search(case.said, line) for line in rig.said), rig.said


def test_the_page_has_them_all() -> None:
    page = (ROOT / "docs/faults.md").read_text()
    assert [name for name in [*CASES, *REFUSED] if f"| {name} |" not in page] == []
    assert f"[{len(CASES)} faults](docs/faults.md)" in (ROOT / "README.md").read_text()
