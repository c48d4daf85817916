"""What a walk on leg odometry is worth beside one on the true velocity: the walking exam, with noise, and stairs.

python benchmarks/odometry.py go1_flat              # the exam, each way of finding feet on the ground
python benchmarks/odometry.py go1_flat --noise      # the same with the noise of sensors
python benchmarks/odometry.py go1_rough --stairs    # six seconds outwards from the middle of each square of terrain.mjz
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw import ROOT
from legged_mw.deploy import stage
from legged_mw.deploy.contract import TERRAIN_FILE, Contract, read_contract
from legged_mw.deploy.exam import run_exam
from legged_mw.deploy.odometry import CONTACTS, Odometry
from legged_mw.deploy.robot import Measurement
from legged_mw.deploy.simulated import read_scene
from legged_mw.deploy.stage import DeployStage

ACCELERATION, BIAS = 0.5, 0.2  # [m/s^2] standard deviation of each value, and of a constant a robot
GYRO_BIAS, FLIP = 0.02, 0.05  # [rad/s] likewise; share of foot contacts that are wrong
KICKS, KICK = (1.0, 2.0, 3.0), 0.2  # [m/s] by which they push, [s] that they last
SPEED, SECONDS, HEADINGS = 0.6, 6.0, 8  # [m/s], [s], of each square


class Noisy(Odometry):
    """Odometry of a robot whose sensors have noise: as trained on what the policy reads, and on the accelerometer and the feet."""

    truth = False  # the true velocity, with the noise that the policy was trained with

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self._rng = np.random.default_rng(0)
        self._biases = [self._rng.normal(0.0, sigma, self.velocity.shape) for sigma in (BIAS, GYRO_BIAS)]

    def __call__(self, measured: Measurement) -> Measurement:
        rng, felt = self._rng, measured.acceleration
        noise = {row.measured: row.noise for row in self.contract.rows if row.noise}
        noise["joint_pos"] = noise.pop("joint_offset", 0.0)
        values: dict[str, Any] = {
            n: getattr(measured, n) + rng.uniform(-a, a, getattr(measured, n).shape) for n, a in noise.items()
        }
        values["acceleration"] = felt + self._biases[0] + rng.normal(0.0, ACCELERATION, felt.shape)
        values["ang_vel"] = values.get("ang_vel", measured.ang_vel) + self._biases[1]
        values["foot_contact"] = np.abs(measured.foot_contact - (rng.random(measured.foot_contact.shape) < FLIP))
        noisy = replace(measured, **values)
        return noisy if self.truth else super().__call__(noisy)


class NoisyTruth(Noisy):
    truth = True


def line(name: str, folder: Path, contact: str | None) -> str:
    """A line of the table: the exam."""
    result = run_exam(folder, contact=contact)
    rms = result.get("estimate_rms") or (math.nan, math.nan)
    errors, pushes = ", ".join(f"{each:.3f}" for each in result["error"]), result["pushes"]
    shares = ", ".join(f"{pushes[speed]:.2f}" for speed in list(pushes)[:3])
    return f"| {name} | {rms[0]:.3f}, {rms[1]:.3f} | {errors} | {result['falls']} | {shares} |"


def kicks(folder: Path, contract: Contract, contact: str | None) -> str:
    """A line of the table: kicks from all sides while it walks ahead."""
    directions, count = 16, 16 * len(KICKS)
    walk = DeployStage(folder, count, (0.8, 0.0, 0.0), contact=contact)
    force, fell, missed = walk.fleet._batch.bind("xfrc_applied"), np.zeros(count, dtype=bool), []
    for step in range(round(6.0 / walk.dt)):
        force[:] = 0.0
        for i in range(count) if 2.0 <= step * walk.dt < 2.0 + KICK - 1e-9 else ():
            angle = 2.0 * math.pi * (i % directions) / directions
            strong = contract.mass * KICKS[i // directions] / KICK
            force[i].reshape(-1, 6)[1, :2] = strong * math.cos(angle), strong * math.sin(angle)
        velocity = walk.velocity()[:, :2]
        walk.step()
        fell |= walk.fell()
        estimate = walk.believed_velocity()
        if estimate is not None and 2.0 <= step * walk.dt < 3.0:
            missed.append(np.where(fell[:, None], np.nan, estimate - velocity))
    alive = [f"{share:.2f}" for share in 1.0 - fell.reshape(-1, directions).mean(axis=1)]
    wrong = np.array(missed or [np.full((count, 2), np.nan)]).reshape(-1, len(KICKS), directions, 2)
    return f"| {contact or 'truth'} | {', '.join(alive)} | {', '.join(f'{np.sqrt(np.nanmean(wrong[:, i] ** 2)):.3f}' for i in range(3))} |"


def stairs(folder: Path, contract: Contract, contact: str | None) -> str:
    """A line of the table: from the middle of each square of terrain.mjz in all directions."""
    model = read_scene(folder, contract, TERRAIN_FILE).model
    centre, middles = model.key_qpos[0][:3], squares(model)
    count = len(middles) * HEADINGS
    walk = DeployStage(folder, count, (SPEED, 0.0, 0.0), scene_file=TERRAIN_FILE, contact=contact)
    standing = centre[2] - ground(model, centre[:2])
    for i in range(count):
        (x, y), angle = middles[i // HEADINGS], 2.0 * math.pi * (i % HEADINGS) / HEADINGS
        walk.fleet.qpos[i, :7] = [
            x,
            y,
            ground(model, (x, y)) + standing,
            math.cos(angle / 2.0),
            0.0,
            0.0,
            math.sin(angle / 2.0),
        ]
    walk.fleet.refresh()
    walk.measured = walk.fleet.read()
    fell, missed, true = np.zeros(count, dtype=bool), [], []
    for step in range(round(SECONDS / walk.dt)):
        velocity = walk.velocity()[:, :2]
        walk.step()
        fell |= walk.fell()
        if step * walk.dt >= 1.0:
            estimate = walk.believed_velocity()
            missed.append(
                np.where(fell[:, None], np.nan, velocity - velocity if estimate is None else estimate - velocity)
            )
            true.append(np.where(fell, np.nan, velocity[:, 0]))
    by_kind = np.array(missed).reshape(len(missed), len(middles), HEADINGS, 2)
    rms = [f"{np.sqrt(np.nanmean(by_kind[:, i] ** 2)):.3f}" for i in range(len(middles))]
    x, y = np.sqrt(np.nanmean(np.array(missed) ** 2, axis=(0, 1)))
    return f"| {contact or 'truth'} | {x:.3f}, {y:.3f} | {np.nanmean(true):.2f} m/s | {fell.sum()} of {count} | {' '.join(rms)} |"


def squares(model: Any) -> list[tuple[float, float]]:
    """Middles of the squares of terrain.mjz, which are 8 m wide."""
    boxes = [
        i for i in range(model.ngeom) if model.geom_bodyid[i] == 0 and model.geom_type[i] == mujoco.mjtGeom.mjGEOM_BOX
    ]
    inside = [place for place in model.geom_pos[boxes, :2] if np.abs(place).max() < 12.0]
    return sorted({(8.0 * round(float(x) / 8.0), 8.0 * round(float(y) / 8.0)) for x, y in inside})


def ground(model: Any, place: Any) -> float:
    """Height [m] of the ground."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit = np.zeros(1, dtype=np.int32)
    return 5.0 - mujoco.mj_ray(
        model, data, np.array([*place, 5.0]), np.array([0.0, 0.0, -1.0]), [1, 0, 0, 0, 0, 0], 1, -1, hit
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="a shipped policy")
    parser.add_argument("--noise", action="store_true")
    parser.add_argument("--kicks", action="store_true")
    parser.add_argument("--stairs", action="store_true")
    args = parser.parse_args()
    folder = ROOT / "resources" / "policies" / args.task
    if args.stairs or args.kicks:
        for contact in (None, *CONTACTS):
            print((stairs if args.stairs else kicks)(folder, read_contract(folder), contact), flush=True)
        return
    print("| | estimate, rms [m/s] | error vx, vy, yaw rate | falls | survives pushes of 1, 2, 3 m/s |")
    stage.Odometry = NoisyTruth if args.noise else Odometry
    print(line("truth", folder, CONTACTS[0] if args.noise else None), flush=True)
    stage.Odometry = Noisy if args.noise else Odometry
    for contact in CONTACTS:
        print(line(contact, folder, contact), flush=True)


if __name__ == "__main__":
    main()
