"""What contacts cost: the recorded step with feet only, with forces sensed, with the whole body, and with the body against itself.

    python benchmarks/contacts.py --task g1_flat --num_envs 4096
    python benchmarks/contacts.py --task g1_flat --device cpu --num_envs 256 --colliders "*[!13457]_collision"

All variants are built first and timed in turns, so that the ratios to the first one are of one run. Medians.
"""

from __future__ import annotations

import argparse
import statistics
from typing import Any

import torch
from step import timed

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.sim.capacity import count_capacity
from legged_mw.sim.engines import ENGINES, pick_engine
from legged_mw.utils.cli import pick_device
from legged_mw.utils.task import load_task

FORCES = {"asset.sense": ["contact_forces"]}


def variants(colliders: list[str]) -> dict[str, dict[str, Any]]:
    """What is compared: name -> overrides. The room for contacts is counted from the model."""
    whole = {"asset.colliders": colliders, "sim.nconmax": 0, "sim.njmax": 0}
    itself = {**whole, "asset.self_collisions": True}
    return {
        "as the task has it": {},
        "with contact forces": FORCES,
        "whole body": whole,
        "whole body and itself": itself,
        "the same, all sensed": {**itself, "asset.sense": ["contact_forces", "self_contacts", "angular_momentum"]},
    }


def make_env(task_name: str, num_envs: int, device: str, overrides: dict[str, Any], steps: int) -> LeggedRobot:
    """The task with ``overrides``, its step fused as for a training of so many ``steps``."""
    task = load_task(task_name)
    for path, value in {"env.num_envs": num_envs, **overrides}.items():
        task.set(path, value)
    env = task.env_class(task.cfg, device)
    env.fuse(steps)
    return env  # type: ignore[return-value]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="g1_flat")
    parser.add_argument("--num_envs", type=int, default=None, help="worlds; 256 on a CPU, else 4096")
    parser.add_argument("--device", default=None)
    parser.add_argument("--engine", choices=ENGINES, default="auto")
    parser.add_argument("--colliders", nargs="+", default=["*"], help="geoms of the whole body, as asset.colliders")
    parser.add_argument("--calls", type=int, default=40, help="calls a round")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    device = pick_device(args.device)
    torch.set_num_threads(1 if device == "cpu" else torch.get_num_threads())  # as train.py does
    num_envs = args.num_envs or (256 if device == "cpu" else 4096)
    name = torch.cuda.get_device_name(device) if device != "cpu" else "CPU"
    print(f"{args.task}, {num_envs} worlds on {name}, engine {pick_engine(args.engine, device)}")
    engine, steps = {"sim.engine": args.engine}, args.calls * args.rounds
    envs = {
        what: make_env(args.task, num_envs, device, engine | more, steps)
        for what, more in variants(args.colliders).items()
    }
    times: dict[str, list[float]] = {what: [] for what in envs}
    with torch.inference_mode():
        actions = 0.3 * torch.randn(num_envs, next(iter(envs.values())).num_actions, device=device)
        for env in envs.values():
            for _ in range(20):
                env.step(actions)
        for _ in range(args.rounds):
            for what, env in envs.items():
                times[what].append(timed(env._graph, args.calls, device))
    print(f"{'':<24}{'geoms':>7}{'nconmax':>9}{'njmax':>7}{'step [ms]':>11}{'ratio':>7}{'overflow':>10}")
    first = statistics.median(next(iter(times.values())))
    for what, env in envs.items():
        model, sim, step = env.robot.physics, env.cfg.sim, statistics.median(times[what])
        room = count_capacity(model, env.terrain is not None)
        geoms = int((model.geom_conaffinity & 1).sum())
        line = f"{what:<24}{geoms:>7}{sim.nconmax or room.contacts:>9}{sim.njmax or room.rows:>7}{step * 1e3:>11.2f}{step / first:>7.2f}"
        print(f"{line}{int(env.sim.overflowed_worlds()):>10}", flush=True)


if __name__ == "__main__":
    main()
