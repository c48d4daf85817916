"""How well legged-mw fit finds the numbers of a robot: simulated ones whose numbers were changed, over the real wire.

    python -m benchmarks.fit go2_flat --seed 0
    python -m benchmarks.fit g1_flat --seed 1 --delay 6

A robot of random numbers, with noisy sensors, is served on loopback. legged-mw deploy --chirp drives it in a process
of its own, and the log is fitted. The table has each joint's true numbers and what was found.
"""

from __future__ import annotations

import argparse
import multiprocessing
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.__main__ import find
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.fit import PARAMETERS, Fit, fit_log, table
from legged_mw.deploy.joint_check import HOLD, LIFT, RAMP, REST, SETTLE
from legged_mw.deploy.loop import real_time
from legged_mw.deploy.robot import Floats
from legged_mw.deploy.simulated import read_scene
from legged_mw.unitree import driver
from legged_mw.unitree.handset import Handset, RemoteEvent
from legged_mw.unitree.link import RobotEnd
from legged_mw.unitree.robots import machine_of
from legged_mw.unitree.serve import SimulatedUnitree
from legged_mw.utils.cli import one_line_errors

START = 6.0  # [s] when the remote's start button is pressed
CHIRP = 61.0  # [s] of the way to the pose, and the sweeps
SPARE = 1.1  # more time than that, as a busy machine leaves periods out; the chirp ends by itself
ENCODER, SPEED, GYRO, FORCE = 0.001, 0.02, 0.005, 0.05  # [rad], [rad/s], [rad/s], [m/s^2] standard deviations of noise


@dataclass
class Change:
    """What another robot has in place of the scene's numbers: (D,) each."""

    delay: Floats  # [s] from a command to the motor
    armature: Floats  # [kg m^2]
    frictionloss: Floats  # [N m]
    damping: Floats  # [N m s/rad] beside the servo's
    gain: Floats  # factor on the servo's stiffness and damping
    offset: Floats  # [rad] of the encoder

    def table(self) -> Floats:
        """(D, 6) in the order of a fit's numbers; the delay in ms."""
        columns = (1000.0 * self.delay, self.armature, self.frictionloss, self.damping, self.gain, self.offset)
        return np.stack(columns, axis=1)

    @staticmethod
    def draw(contract: Contract, model: Any, seed: int, delay: float) -> Change:
        """A robot of random numbers, with one ``delay`` [s] for all its joints."""
        rng, count = np.random.default_rng(seed), len(contract.joints)
        dofs = [model.joint(name).dofadr[0] for name in contract.joints]
        uniform = lambda low, high: rng.uniform(low, high, count)  # noqa: E731
        return Change(
            np.full(count, delay),
            model.dof_armature[dofs] * uniform(1.5, 5.0),
            uniform(0.2, 0.7) * np.minimum(1.0, contract.stiffness / 20.0),
            uniform(0.1, 0.4) * np.minimum(1.0, contract.stiffness / 20.0),
            uniform(0.8, 1.2),
            uniform(-0.015, 0.015),
        )


class ChangedUnitree(SimulatedUnitree):
    """Its motors, encoders and noise."""

    def __init__(self, folder: Path, contract: Contract, end: Any, change: Change, **settings: Any) -> None:
        self._change, self._noise = change, np.random.default_rng(1)
        super().__init__(folder, contract, end, **settings)
        model, dofs = self.model, self._dofs
        model.dof_armature[dofs], model.dof_frictionloss[dofs] = change.armature, change.frictionloss
        model.dof_damping[dofs] = change.damping
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self.faults.joint_bias = change.offset
        self._waiting: list[tuple[float, dict[str, Floats]]] = []

    def _obey(self, acted: dict[str, Floats]) -> None:
        """A command waits for its delay; the servos' targets are of what the encoders say."""
        change = self._change
        self._waiting.append((self.time + float(change.delay[0]), acted))

    def _move(self) -> None:
        change = self._change
        while self._waiting and self._waiting[0][0] <= self.time + 1e-9:
            acted = self._waiting.pop(0)[1]
            moved = {"q": acted["q"] - change.offset, "kp": change.gain * acted["kp"], "kd": change.gain * acted["kd"]}
            super()._obey({**acted, **moved})
        super()._move()

    def _fill_own(self) -> None:
        super()._fill_own()
        state, noise, slots = self._state, self._noise, self._slots
        for name, size, where in (("q", ENCODER, slots), ("dq", SPEED, slots)):
            values = state[f"motor_state.{name}"].copy()
            values[where] += noise.normal(0.0, size, len(where))
            state[f"motor_state.{name}"] = values
        for name, size in (("gyroscope", GYRO), ("accelerometer", FORCE)):
            state[f"imu_state.{name}"] = state[f"imu_state.{name}"] + noise.normal(0.0, size, 3)


def serve(folder: Path, change: Change, domain: int, seconds: float) -> None:
    """Serve the robot on loopback, hanging, before all that is not real time."""
    real_time(driver.PRIORITY, heirs=True)
    contract = read_contract(folder)
    end = RobotEnd(machine_of(contract.joints).package, "lo", domain)
    sim = ChangedUnitree(folder, contract, end, change, hoist=True, lift=LIFT)
    print(driver.run(sim, Handset([RemoteEvent(START, ("start",), {}, None)]), seconds).text(), flush=True)


def record(folder: Path, change: Change, domain: int, log: Path) -> None:
    """Drive the robot, which another process serves, through its chirp."""
    joints = len(read_contract(folder).joints)
    seconds = SPARE * (START + SETTLE + joints * (2 * RAMP + HOLD + REST) + CHIRP)
    robot = multiprocessing.get_context("spawn").Process(target=serve, args=(folder, change, domain, seconds + START))
    robot.start()
    asked = ["--robot", "unitree", "--interface", "lo", "--domain", str(domain), "--chirp", "--log", str(log)]
    drive = [sys.executable, "-m", "legged_mw.deploy", str(folder), *asked, "--time", f"{seconds:.0f}"]
    subprocess.run(drive, preexec_fn=lambda: real_time(driver.PRIORITY, heirs=True))
    robot.terminate()
    robot.join()


def recovery(fit: Fit, change: Change) -> str:
    """A line per number: the largest and the median error over the joints."""
    true = change.table()[[each.joint for each in fit.joints]]
    lines = [f"{'':<24}{'true':>20}{'median error':>16}{'largest':>10}{'median deviation':>20}"]
    for column, each in enumerate(PARAMETERS):
        error, said = np.abs(fit.values[:, column] - true[:, column]), f"{each.name} [{each.unit}]"
        span = f"{true[:, column].min():.{each.digits}f} to {true[:, column].max():.{each.digits}f}"
        relative = each.name not in ("delay", "offset")
        error = 100.0 * error / true[:, column] if relative else error
        unit, digits = (" %", 1) if relative else ("", each.digits)
        texts = [f"{value:.{digits}f}{unit}" for value in (np.median(error), error.max())]
        deviation = f"{np.median(fit.deviation[:, column]):.{each.digits}f}"
        lines.append(f"{said:<24}{span:>20}{texts[0]:>16}{texts[1]:>10}{deviation:>20}")
    return "\n".join(lines)


@one_line_errors()
def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("exports", nargs="+", metavar="EXPORT")
    parser.add_argument("--seed", type=int, default=0, help="of the changed numbers")
    parser.add_argument("--delay", type=float, default=8.0, metavar="MS", help="from a command to the motors")
    parser.add_argument("--leave_out", action="append", default=[], metavar="NAME", help="as of legged-mw fit")
    parser.add_argument("--domain", type=int, default=77)
    parser.add_argument("--out", type=Path, default=Path("logs/fit"))
    args = parser.parse_args(argv)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.exports:
        folder, log = find(name), args.out / f"{Path(name).name}_{args.seed}.lmwlog"
        contract, model = read_contract(folder), read_scene(folder, read_contract(folder)).model
        change = Change.draw(contract, model, args.seed, args.delay / 1000.0)
        log.unlink(missing_ok=True)
        record(folder, change, args.domain, log)
        fit = fit_log(log, leave_out=args.leave_out)
        print(f"{table(fit)}\n\n{name}, seed {args.seed}\n{recovery(fit, change)}", flush=True)


if __name__ == "__main__":
    main()
