"""What the Python controller sees and does in a walk, as text for check.cpp: python examples/cpp/record.py go2_flat walk.txt

The first line names the columns and their sizes; then one line a step. Numbers are exact (17 digits).
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from legged_mw.deploy.__main__ import find
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import Floats, Measurement, layout
from legged_mw.deploy.simulated import MujocoRobot

HELD = 30  # steps of a command


def commands(contract: Contract) -> list[Floats]:
    """Rest, half of the highest, rest, half of the lowest: a gait clock stops and starts again."""
    rest, low, high = (
        np.array([getattr(each, name) for each in contract.commands]) for name in ("default", "low", "high")
    )
    return [rest, 0.5 * (rest + high), rest, 0.5 * (rest + low)]


def record(folder: Path, path: Path, steps: int) -> None:
    """Walk for ``steps`` in simulation, from the start again after half of them, and write each to ``path``."""
    contract = read_contract(folder)
    robot, controller, script = MujocoRobot(folder, contract), Controller(folder, contract), commands(contract)
    parts = layout(contract)
    joints = len(contract.joints)
    sizes = {"fresh": 1, **parts, "command": len(contract.commands), "observation": contract.size}
    sizes |= dict.fromkeys(("action", "wanted", "target"), joints)
    with path.open("w") as file:
        file.write(" ".join(f"{name} {size}" for name, size in sizes.items()) + "\n")
        for step in range(steps):
            fresh = step in (0, steps // 2)
            if fresh:
                robot.fleet.reset()
                controller.reset()
            command, measured = script[step // HELD % len(script)], robot.read()
            targets = controller.act(measured, command)[0]
            values = [np.array([fresh]), *(part(measured, name) for name in parts), command]
            values += [controller.last_observation[0], controller.last_actions[0], controller.last_targets[0], targets]
            file.write(" ".join(f"{value:.17g}" for value in np.concatenate(values)) + "\n")
            robot.write(targets)


def part(measured: Measurement, name: str) -> Floats:
    return measured.others[name] if name in measured.others else getattr(measured, name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", help="a shipped policy, or the folder of an export")
    parser.add_argument("record", type=Path, help="the file to write")
    parser.add_argument("--steps", type=int, default=240)
    args = parser.parse_args()
    record(find(args.policy), args.record, args.steps)
    print(f"{args.steps} steps of {args.policy} written to {args.record}")


if __name__ == "__main__":
    main()
