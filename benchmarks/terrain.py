"""What rough ground costs mujoco-warp, and which contacts it finds: a plane, our kernel, its own height field, boxes.

    python benchmarks/terrain.py --num_envs 4096

Robots walk on the task's terrain for two seconds under the policy that ships with go1_flat; from there, each kind of ground is
stepped by bare physics (a control step, recorded, in turns), servos at the default pose. On a plane and on boxes the same
robots stand at the same heights above it. "first" is the time from the model to the end of the first recorded call: kernels
that no run before this one compiled are in it. Contacts and rows are of the first step. Feet are compared in that same state:
"wild" are those that the height field pushes more than 1 mm deeper than they are, as our kernel has it, "lost" those that it lets through.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import mujoco
import mujoco_warp as mjw
import numpy as np
import torch
import warp as wp
from step import timed

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.rl.policies import act, load_policy
from legged_mw.sim.graph import StepGraph
from legged_mw.sim.terrain import Terrain
from legged_mw.sim.warp_engine import make_model, record_warp
from legged_mw.utils.cli import pick_device, seed_everything
from legged_mw.utils.task import load_task


class Ground(NamedTuple):
    model: mujoco.MjModel
    terrain: Terrain | None  # with it: contacts by our kernel
    level: bool  # z = 0 everywhere
    nconmax: int
    njmax: int


class Variant:
    """Bare physics on one kind of ground, from the environment's state."""

    def __init__(self, env: LeggedRobot, ground: Ground) -> None:
        free, begun = free_memory(env.device), time.perf_counter()
        device = wp.get_device(env.device)
        with wp.ScopedDevice(device):
            model = make_model(ground.model, ground.terrain)
            model.opt.warn_overflow, model.opt.graph_conditional = 0, False
            self.data = mjw.make_data(ground.model, nworld=env.num_envs, nconmax=ground.nconmax, njmax=ground.njmax)
            self.reset = lambda: self._pose(env, ground.level)
            self.reset()
            mjw.step(model, self.data)
        count = int(self.data.nacon.numpy()[0])
        self.contacts, self.rows = count / env.num_envs, self.data.nefc.numpy()
        self.depth = self._depths(ground.model, env, count)

        def steps() -> None:
            for _ in range(env.cfg.control.decimation):
                mjw.step(model, self.data)

        if device.is_cpu:
            with wp.ScopedDevice(device):
                self.call: Callable[[], None] = record_warp(steps, device)
        else:
            graph = StepGraph(steps, env.device)
            for _ in range(4):
                graph()
            torch.cuda.synchronize()
            self.call = graph
        self.first, self.memory = time.perf_counter() - begun, (free - free_memory(env.device)) / 2**20

    def _pose(self, env: LeggedRobot, level: bool) -> None:
        for name in ("qpos", "qvel"):
            wp.to_torch(getattr(self.data, name)).copy_(getattr(env.sim, name))
        if level:
            wp.to_torch(self.data.qpos)[:, 2] = env.base_height
        wp.to_torch(self.data.ctrl).copy_(env.default_dof_pos.expand(env.num_envs, -1))

    def _depths(self, model: mujoco.MjModel, env: LeggedRobot, count: int) -> np.ndarray:
        """Deepest contact (N, F) of each foot [m], positive upwards; 1 where it has none."""
        feet = {model.geom(name).id: i for i, name in enumerate(env.cfg.asset.foot_names)}
        deepest = np.ones((env.num_envs, len(feet)))
        contact = self.data.contact
        for world, geoms, dist in zip(
            contact.worldid.numpy()[:count], contact.geom.numpy()[:count], contact.dist.numpy()[:count], strict=True
        ):
            foot = feet.get(int(geoms[1]), feet.get(int(geoms[0])))
            if foot is not None:
                deepest[world, foot] = min(deepest[world, foot], dist)
        return deepest


def with_boxes(env: LeggedRobot, count: int) -> mujoco.MjModel:
    """The robot on a plane among ``count`` boxes."""
    spec, rng = env.robot.spec.copy(), np.random.default_rng(0)
    floor = spec.geom("floor")
    floor.type, floor.size, floor.pos, floor.hfieldname = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.05], [0, 0, 0], ""
    for x, y in rng.uniform(-40.0, 40.0, (count, 2)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.5, 0.5, 0.05], pos=[x, y, 0], contype=1, conaffinity=0, priority=1
        )
    for extra in [*spec.lights, *spec.cameras]:
        spec.delete(extra)
    spec.compiler.discardvisual = True
    return spec.compile()


def free_memory(device: str) -> int:
    return 0 if device == "cpu" else torch.cuda.mem_get_info(device)[0]


def walked(task_name: str, num_envs: int, device: str) -> LeggedRobot:
    """Robots that walked for two seconds, at every level."""
    task = load_task(task_name)
    for path, value in {
        "env.num_envs": num_envs,
        "sim.engine": "mujoco_warp",
        "terrain.curriculum": False,
        "domain_rand.enable": False,
    }.items():
        task.set(path, value)
    task.set("perturbation.kick", False)
    task.set("perturbation.push", False)
    task.set("terrain.height_scan", [])
    env = task.env_class(task.cfg, device)
    policy = load_policy(ROOT / "resources/policies/go1_flat/policy.onnx", env, task.train, device)
    obs = env.get_observations()
    for _ in range(100):
        obs, *_ = env.step(act(policy, obs))
    return env


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_rough")
    parser.add_argument("--num_envs", type=int, default=4096)
    parser.add_argument("--device", default=None)
    parser.add_argument("--boxes", type=int, nargs="*", default=[200, 1000])
    parser.add_argument("--calls", type=int, default=20)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    device = pick_device(args.device)
    seed_everything(1)
    env = walked(args.task, args.num_envs, device)
    model, terrain = env.robot.physics, env.terrain
    grounds = {
        "plane": Ground(with_boxes(env, 0), None, True, 8, 40),
        "our kernel": Ground(model, terrain, False, 8, 56),
        "its height field": Ground(model, None, False, 16, 88),
        **{f"{count} boxes": Ground(with_boxes(env, count), None, True, 16, 88) for count in args.boxes},
    }
    name = torch.cuda.get_device_name(device) if device != "cpu" else "CPU"
    print(f"{args.task}, {args.num_envs} worlds on {name}; mujoco {mujoco.__version__}, warp {wp.__version__}")
    variants = {}
    for ground, asked in grounds.items():
        variants[ground] = Variant(env, asked)
    times: dict[str, list[float]] = {name: [] for name in variants}
    for _ in range(args.rounds):
        for name, variant in variants.items():
            variant.reset()
            times[name].append(timed(variant.call, args.calls, device))
    plane = statistics.median(times["plane"])
    print(
        f"{'ground':<18}{'step [ms]':>10}{'/ plane':>9}{'contacts':>10}{'rows':>7}{'most':>6}{'first [s]':>11}{'memory [MiB]':>14}"
    )
    for name, variant in variants.items():
        step = statistics.median(times[name])
        print(
            f"{name:<18}{step * 1e3:>10.2f}{step / plane:>9.2f}{variant.contacts:>10.2f}{variant.rows.mean():>7.1f}{variant.rows.max():>6}"
            f"{variant.first:>11.1f}{variant.memory:>14.0f}"
        )
    true, stock = variants["our kernel"].depth, variants["its height field"].depth
    touching = true < 0.0
    wild = touching & (stock < true - 1e-3)
    print(
        f"feet in contact {touching.sum()}: wild {wild.sum()} ({wild.sum() / max(touching.sum(), 1):.2%}, deepest by "
        f"{1e3 * (true - stock)[wild].max(initial=0.0):.0f} mm), lost {(touching & (true < -1e-3) & (stock > 0)).sum()}; "
        f"touching nothing, but pushed {((true > 0.0) & (stock < -1e-3)).sum()}"
    )


if __name__ == "__main__":
    main()
