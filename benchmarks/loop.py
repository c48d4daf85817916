"""How the control loop keeps its time: a robot is driven in real time as `--drive` does it, with states, limits and a log.

    python benchmarks/loop.py go2_flat --time 10m
    python benchmarks/loop.py go2_flat --rate 200

The robot is simulated in the same process, so the step's work is said with and without it. Another rate than the policy's is made
by another number of physics steps a period: the policy acts more often than it was trained to, which is enough for its time.
The limit of late steps is off, so that all are counted.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path
from types import FrameType

import numpy as np
import onnxruntime  # before threads are counted: the package starts one of its own, which sleeps

from legged_mw.deploy.__main__ import find
from legged_mw.deploy.contract import CONTRACT_FILE, SCENE_FILE, Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import START, WALK, DriveInput
from legged_mw.deploy.log import Log, read_log
from legged_mw.deploy.loop import Loop, Spread
from legged_mw.deploy.robot import Floats, Health, Measurement
from legged_mw.deploy.runner import _Step, run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.states import POLICY, STATES, States
from legged_mw.utils.cli import duration, one_line_errors
from legged_mw.utils.config import load_yaml, save_yaml

PHYSICS = 0.0025  # [s] of a physics step at another rate
EVERY = 3.0  # [s] a command is held
_WAIT, _STEP = Loop._end_step.__code__, _Step.take.__code__
MINUTE = 60.0  # [s] after which memory is looked at first


def at_rate(folder: Path, rate: int, to: Path) -> Path:
    """The export with ``rate`` steps of the policy a second."""
    steps = round(1.0 / (rate * PHYSICS))
    shutil.copytree(folder, to)
    said = load_yaml(to / CONTRACT_FILE)
    said["period"], said["physics"] = steps * PHYSICS, said["physics"] | {"timestep": PHYSICS, "decimation": steps}
    save_yaml(to / CONTRACT_FILE, said)
    scene = (to / SCENE_FILE).read_text()
    (to / SCENE_FILE).write_text(re.sub(r'timestep="[^"]*"', f'timestep="{PHYSICS}"', scene, count=1))
    return to


class Walker:
    """Presses start and A, then commands half of each trained range, one after the other, with rests between."""

    def __init__(self, contract: Contract) -> None:
        self._rest = np.array([each.default for each in contract.commands])
        self._ends = [0.5 * np.array([getattr(each, side) for each in contract.commands]) for side in ("high", "low")]
        self._period, self._step = contract.period, -1

    def poll(self, health: Health) -> DriveInput:
        self._step += 1
        now = self._step * self._period
        pressed = {round(1.0 / self._period): START, round(4.0 / self._period): WALK}.get(self._step)
        turn = int(now / EVERY)
        command = self._rest.copy()
        if turn % 2:
            place = turn // 2 % len(command)
            command[place] = self._ends[turn // 2 // len(command) % 2][place]
        return DriveInput(frozenset([pressed] if pressed else ()), command)

    def let_go(self) -> None: ...

    def close(self) -> None: ...


class TimedRobot(MujocoRobot):
    """Counts what the simulation takes of each step."""

    def __init__(self, folder: Path, contract: Contract, seconds: float) -> None:
        super().__init__(folder, contract, whole=True, hoisted=len(contract.feet) == 2)
        self.took, self._step = np.full(round(seconds / contract.period) + 1, 0.0), -1  # [s] of each step

    def read(self) -> Measurement:
        began = time.perf_counter()
        measured = super().read()
        self._step += 1
        self.took[self._step] = time.perf_counter() - began
        return measured

    def _move(self, targets: Floats, stiffness: Floats, damping: Floats) -> None:
        began = time.perf_counter()
        super()._move(targets, stiffness, damping)
        self.took[self._step] += time.perf_counter() - began


class Collections:
    """Counts runs of the garbage collector: those while the loop waits, and those within a step."""

    def __init__(self) -> None:
        self.between = self.within = 0

    def __call__(self, phase: str, _: dict[str, int]) -> None:
        if phase != "start":
            return
        frame: FrameType | None = sys._getframe(1)
        while frame and frame.f_code not in (_WAIT, _STEP):
            frame = frame.f_back
        if frame:
            self.between, self.within = self.between + (frame.f_code is _WAIT), self.within + (frame.f_code is _STEP)


def resident() -> int:
    """[kB] of this process that are in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() // 1024


def stolen() -> float:
    """[s] that the machine under this one took of its cores since it started."""
    return int(Path("/proc/stat").read_text().split()[8]) / os.sysconf("SC_CLK_TCK")


def threads() -> int:
    """Of this process, as the system counts them."""
    return len(os.listdir("/proc/self/task"))


def measure(folder: Path, seconds: float, path: Path) -> str:
    """Drive for so long, with a log at ``path``; what was found, in lines."""
    contract, before = read_contract(folder, edited=True), threads()  # by at_rate
    controller = Controller(folder, contract)
    started, robot = threads() - before, TimedRobot(folder, contract, seconds)
    said: list[str] = []
    states = States(controller, [Walker(contract)], lambda _: np.zeros(len(contract.commands)), said.append)
    count, memory = Collections(), [0, 0]  # [kB] after MINUTE, and now
    safety, log = (
        Safety(contract, Limits.of(folder, contract, asked={"late": "off"})),
        Log(path, contract, folder, "simulated"),
    )

    def watch(now: float, _: Measurement) -> None:
        if now % 1.0 < contract.period:
            memory[now >= MINUTE] = resident()

    taken = stolen()
    gc.callbacks.append(count)
    try:
        done = run(
            robot, controller, lambda _: np.zeros(0), seconds, watch=watch, safety=safety, states=states, log=log
        )
    finally:
        gc.callbacks.remove(count)
    rows = read_log(path).rows
    own = rows["work"][1:, 0] - robot.took[: len(rows["work"]) - 1]  # a row has the work of the step before
    walked = float((rows["state"] == STATES.index(POLICY)).mean())
    rate, load, taken = 1.0 / contract.period, os.getloadavg()[0], stolen() - taken
    return "\n".join(
        (
            f"{contract.task} at {rate:g} Hz for {seconds:g} s, the policy {walked:.0%} of it",
            f"{done.timing}",
            f"work of a step without the simulation: {Spread.of(own)}",
            f"garbage was collected {count.between} times while the loop waited, {count.within} times within a step",
            f"memory: {memory[0]} kB after {min(seconds, MINUTE):g} s, {memory[1] or memory[0]} kB at the end",
            f"load {load:.1f} on {os.cpu_count()} cores, of which the machine under this one took {taken:.2f} s",
            f"threads that the network started (onnxruntime {onnxruntime.__version__}): {started}; states: {'; '.join(said)}",
        )
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a shipped policy, or the folder of an export")
    parser.add_argument("--rate", type=float, metavar="HZ", help="of the policy (default: the contract's)")
    parser.add_argument("--time", type=duration, default=60.0, metavar="T")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        folder = at_rate(find(args.policy), args.rate, Path(scratch) / "export") if args.rate else find(args.policy)
        print(measure(folder, args.time, Path(scratch) / "run.lmwlog"))


if __name__ == "__main__":
    with one_line_errors():
        main()
