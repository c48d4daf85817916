"""The walking exam over the wire: a policy drives a simulated Unitree robot through its DDS messages, both in this process.

    python benchmarks/unitree.py go2_flat
    python benchmarks/unitree.py g1_flat --fault delay=10,jitter=2,loss=5

Beside it stands the exam of `python -m legged_mw.deploy go2_flat --eval`: another servo law's rate (2 ms), all shapes of the robot on
the ground, MuJoCo's own number of solver iterations. Nothing waits for real time.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np

from legged_mw import ROOT
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.exam import contract_rules, run_exam
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.eval import walking
from legged_mw.eval.walking import ExamRules
from legged_mw.unitree.client import Direct, UnitreeRobot
from legged_mw.unitree.faults import Faults, parse_faults
from legged_mw.unitree.link import RobotEnd, Wire
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import STEP, SimulatedUnitree


def begin(sim: SimulatedUnitree, robot: UnitreeRobot) -> None:
    """Put the robot into its first keyframe, its servos on; a slow wire gets a period in which its first messages arrive."""
    sim.reset(after=1.0)
    sim.step()
    robot.write(robot.contract.default_pose)
    for _ in range(1 if sim.faults == Faults() else round(robot.contract.period / STEP)):
        sim.step()


def examine(folder: Path, contract: Contract, exam: ExamRules, domain: int, faults: Faults) -> dict[str, object]:
    """Every command that is held, one after the other, then pushes at the speed of its mark."""
    package = machine_of(contract.joints).package
    sim = SimulatedUnitree(folder, contract, RobotEnd(package, "lo", domain), faults=faults, hoist=False)
    wire = Wire(package, "lo", domain, wait=sim.step, clock=lambda: sim.time)
    robot = UnitreeRobot(contract, Direct(wire), wire.prepare(), clock=lambda: sim.time)
    safety = Safety(contract, Limits.of(folder, contract))
    controller, names = Controller(folder, contract), [command.name for command in contract.commands]
    signals, fell_at, last = defaultdict(list), [], []
    pushed = [(exam.push_vx, 0.0, 0.0)] * walking.PUSH_DIRECTIONS
    for world, held in enumerate([*exam.held(), *pushed]):
        command = np.array([each.default for each in contract.commands])
        command[[names.index(name) for name in walking.VELOCITY]] = held
        direction = world - len(exam.held())
        begin(sim, robot)
        controller.reset()
        one, fell = defaultdict(list), math.inf
        for step in range(round(walking.EXAM_SECONDS / contract.period)):
            velocity = [*sim._sensor("lin_vel")[:2], sim._sensor("ang_vel")[2]]
            values = (
                velocity,
                sim.data.qpos[:2].copy(),
                np.abs(sim.torque * sim.joint_vel).sum(),
                np.abs(sim.joint_vel).mean(),
            )
            for name, value in zip(("velocity", "position", "power", "joint_speed"), values, strict=True):
                one[name].append(value)
            if direction >= 0 and step == round(walking.PUSH_AT / contract.period) + direction:
                angle = 2 * math.pi * direction / walking.PUSH_DIRECTIONS
                sim.data.qvel[:2] += exam.push_mark * np.array([math.cos(angle), math.sin(angle)])
            robot.write(safety.held(controller.act(robot.read(), command)[0]))
            for _ in range(round(contract.period / STEP)):
                sim.step()
            if sim.upright < 0.0:
                fell = min(fell, step)
        for name, values in one.items():
            signals[name].append(values)
        fell_at.append(fell)
        last.append(sim.data.qpos[:2].copy())
    stacked = {name: np.swapaxes(np.array(values), 0, 1) for name, values in signals.items()}
    return exam.grade(
        stacked, last_position=np.array(last), fell_at=np.array(fell_at), mass=contract.mass, dt=contract.period
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a shipped policy, or the folder of an export")
    parser.add_argument("--fault", action="append", default=[], help="as `--serve` has it, from the start")
    parser.add_argument("--domain", type=int, default=99)
    args = parser.parse_args()
    folder = Path(args.policy) if Path(args.policy).is_dir() else ROOT / "resources" / "policies" / args.policy
    contract = read_contract(folder)
    faults = Faults()
    for fault in parse_faults(args.fault, contract.joints):
        fault.begin(faults)
    exam = replace(contract_rules(contract), push_speeds=(2.0,), push_mark=2.0)
    for where, result in (
        ("over the wire", examine(folder, contract, exam, args.domain, faults)),
        ("through --eval", run_exam(folder, exam)),
    ):
        print(f"{where}\n{walking.table(result)}", flush=True)


if __name__ == "__main__":
    main()
