"""The robots of ``legged_mw.deploy --robot unitree`` and ``--serve unitree``: connect to one, or simulate one on the wire.

Deploy imports this module by the flag's value.
"""

from __future__ import annotations

import argparse
import gc
import math
import sys
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.loop import Spread, real_time
from legged_mw.deploy.robot import Robot
from legged_mw.unitree import client, need_dds
from legged_mw.unitree.faults import Fault, parse_faults
from legged_mw.unitree.handset import KEYS_HELP, Handset, load_remote
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import STEP, ServedRecord, SimulatedUnitree

BEHIND = 0.1  # [s] delay above which the simulation does not catch up
PRIORITY = 10  # ours, of a real-time process: lower than a policy's
UPRIGHT = 0.5  # cosine of the tilt from which a robot counts as fallen


def senses_feet(contract: Contract) -> bool:
    """True if the contract's robot measures foot contacts."""
    return bool(machine_of(contract.joints).feet_of(contract.feet))


def connect(folder: Path, contract: Contract, args: argparse.Namespace, odometry: bool) -> Robot:
    """Connect to the robot on the wire. Raises RobotError."""
    robot = client.connect(folder, contract, args.interface, args.domain, odometry=odometry)
    print(
        f"{robot.machine.name} at {args.interface}: {len(contract.joints)} joints, {robot.health().voltage or 0:.1f} V",
        flush=True,
    )
    return robot


def serve(folder: Path, contract: Contract, args: argparse.Namespace, lift: float) -> str:
    """Serve a simulated robot of the export, ``lift`` [m] above its start, until Ctrl-C. Returns a report as text."""
    need_dds()
    from legged_mw.unitree.link import RobotEnd, default_domain

    faults = parse_faults(args.fault or [], contract.joints)
    script = load_remote(Path(args.remote)) if args.remote else []
    keys = args.remote is None and sys.stdin.isatty()
    if keys:
        print(KEYS_HELP)
    with closing(Handset(script, keys)) as handset:
        real_time(PRIORITY, heirs=True)  # as on a robot, whose computer runs nothing else
        domain = default_domain(args.interface) if args.domain is None else args.domain
        machine = machine_of(contract.joints)
        end = RobotEnd(machine.package, args.interface, domain)
        hoist = None if args.hoist is None else args.hoist != "no"
        sim = SimulatedUnitree(folder, contract, end, watchdog=args.watchdog or math.inf, hoist=hoist, lift=lift)
        how = "on a hoist" if sim.hoist else "on the ground"
        where = f"in domain {domain} on {args.interface}"
        print(f"a simulated {machine.name}, limp, {how}, {where}; Ctrl-C ends it", flush=True)
        return run(sim, handset, args.time or math.inf, faults).text()


@dataclass
class Served:
    """The record of a served robot."""

    seconds: float  # [s] simulated
    wall: float  # [s] of real time
    upright: float  # cosine of its largest tilt while its servos were on
    latencies: list[float]  # [s] from a sent state to the first command that answers it
    place: tuple[float, float, float]  # [m] of the root at the end
    record: ServedRecord
    faults: Sequence[Fault]  # faults that began

    def text(self) -> str:
        record = self.record
        lines = [
            f"{self.seconds:.1f} s simulated in {self.wall:.1f} s; {record.commands} commands taken, {record.refused} refused"
        ]
        for fault in self.faults:
            if (after := record.damped_after(fault.time)) is not None:
                lines.append(
                    f"{fault.text}: its motors damped {1000 * after:.0f} ms later, and nothing drove them again"
                )
        if self.latencies:
            lines.append(f"from a state to the first command that answers it: {Spread.of(self.latencies)}")
        if record.watchdog:
            lines.append(f"the watchdog damped it {record.watchdog} times")
        tilt = math.degrees(math.acos(min(1.0, self.upright)))
        fell, (x, y, z) = self.upright < UPRIGHT, self.place
        how = (
            "it fell while its servos were on"
            if fell
            else f"with its servos on at most {tilt:.0f} degrees from upright"
        )
        if record.beyond:
            lines.append(f"a joint was {record.beyond:.3f} rad beyond its range at most")
        lines.append(f"{how}; at the end at {x:.1f}, {y:.1f} m, {z:.2f} m high")
        return "\n".join(lines)


class Latency:
    """Latencies from a sent state to its first command. A command has the tick of its state in ``reserve``."""

    def __init__(self) -> None:
        self.seconds: list[float] = []
        self._sent: dict[int, float] = {}  # tick -> [s] sent
        self._answered = 0

    def watch(self, sim: SimulatedUnitree) -> None:
        """Call after each step."""
        now = time.monotonic()
        self._sent[sim.tick] = now
        if sim.command is not None and (tick := int(np.ravel(sim.command["reserve"])[0])) > self._answered:
            self._answered = tick
            if tick in self._sent:
                self.seconds.append(now - self._sent[tick])
            self._sent = {sent: when for sent, when in self._sent.items() if sent > tick}


def run(sim: SimulatedUnitree, handset: Handset, seconds: float = math.inf, faults: Sequence[Fault] = ()) -> Served:
    """Step the robot in real time, with the remote of ``handset``. ``faults`` are sorted by time. Ctrl-C ends it."""
    latency, upright = Latency(), 1.0
    gc.collect()
    gc.freeze()
    gc.disable()
    began = start = time.monotonic()
    steps = begun = printed = 0
    try:
        while sim.time < seconds - 1e-9:
            sim.remote = handset.state(sim.time)
            sim.hoist = sim.hoist if handset.hoist is None else handset.hoist
            while begun < len(faults) and faults[begun].time <= sim.time + 1e-9:
                faults[begun].begin(sim.faults)
                begun += 1
            sim.step()
            latency.watch(sim)
            for why in list(sim.record.why.values())[printed:]:
                print(f"refused: {why}; more of its kind are counted", flush=True)
            printed = len(sim.record.why)
            if sim.acted["kp"].any():
                upright = min(upright, sim.upright)
            steps += 1
            ahead = start + steps * STEP - time.monotonic()
            if ahead > 0:
                time.sleep(ahead)
            elif ahead < -BEHIND:
                start -= ahead
    except KeyboardInterrupt:
        print("\nstopped", flush=True)
    finally:
        gc.unfreeze()
        gc.enable()
    x, y, z = (float(value) for value in sim.data.qpos[:3])
    return Served(sim.time, time.monotonic() - began, upright, latency.seconds, (x, y, z), sim.record, faults[:begun])
