"""The program of `--serve unitree`: a simulated robot on the wire, in real time, until the end time or Ctrl-C."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.loop import Spread, real_time
from legged_mw.unitree import need_dds
from legged_mw.unitree.faults import Fault
from legged_mw.unitree.handset import Handset
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import STEP, ServedRecord, SimulatedUnitree

BEHIND = 0.1  # [s] delay above which the simulation does not catch up
PRIORITY = 10  # ours, of a real-time process: lower than a policy's
UPRIGHT = 0.5  # cosine of the tilt from which a robot counts as fallen


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
        handset.close()
    x, y, z = (float(value) for value in sim.data.qpos[:3])
    return Served(sim.time, time.monotonic() - began, upright, latency.seconds, (x, y, z), sim.record, faults[:begun])


def serve(
    folder: Path,
    contract: Contract,
    interface: str,
    domain: int | None,
    *,
    seconds: float = math.inf,
    handset: Handset | None = None,
    faults: Sequence[Fault] = (),
    watchdog: float = math.inf,
    hoist: bool | None = None,
    lift: float = 0.0,
) -> Served:
    """Serve a simulated robot of the export on a network interface."""
    need_dds()
    from legged_mw.unitree.link import RobotEnd, default_domain

    real_time(PRIORITY, heirs=True)  # as on a robot, whose computer runs nothing else
    domain = default_domain(interface) if domain is None else domain
    machine = machine_of(contract.joints)
    end = RobotEnd(machine.package, interface, domain)
    sim = SimulatedUnitree(folder, contract, end, watchdog=watchdog, hoist=hoist, lift=lift)
    how = "on a hoist" if sim.hoist else "on the ground"
    print(f"a simulated {machine.name}, limp, {how}, in domain {domain} on {interface}; Ctrl-C ends it", flush=True)
    return run(sim, handset or Handset(), seconds, faults)
