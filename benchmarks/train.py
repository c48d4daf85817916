"""How fast a task trains, and what an iteration's time is spent on: python benchmarks/train.py --worlds 4096 16384

With --beside_rsl_rl each number of worlds is measured again with rsl-rl's own PPO. Of networks with a memory:
python benchmarks/train.py --worlds 4096 --set actor.class_name=RNNModel --set critic.class_name=RNNModel --set
runner.num_steps_per_env=24 --set symmetry.use_data_augmentation=false --beside_rsl_rl

The whole iteration is timed as training runs it (`Runner.learn`); then its parts are timed alone, in the same process:
physics (the substeps, recorded), the rest of `env.step`, the policy (acting, storing), the update (returns, minibatches,
normalisers). What is left of the iteration is called rest: waiting for the host, logging, the tails of kernels.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.learner_config import fit_cpu
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.cli import apply_overrides, make_parser, pick_device, seed_everything
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import load_task


class Times(NamedTuple):
    """Seconds an iteration."""

    whole: float
    physics: float
    step: float  # env.step without its physics
    policy: float
    update: float

    @property
    def rest(self) -> float:
        return self.whole - self.physics - self.step - self.policy - self.update


def seconds(fn: Callable[[], object], device: str, calls: int = 1) -> float:
    """Seconds a call, from an idle device to an idle device."""
    synchronize(device)
    start = time.perf_counter()
    for _ in range(calls):
        fn()
    synchronize(device)
    return (time.perf_counter() - start) / calls


def synchronize(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def physics_only(env: RobotTask, eager: bool) -> Callable[[], None]:
    """The recorded substeps of one control step, from the environment's present state."""
    graph = StepGraph(lambda: env.sim.step(env.cfg.control.decimation), env.device, eager)
    for _ in range(4):
        graph()
    return graph


def measure(runner: Runner, iterations: int, rounds: int, eager: bool) -> Times:
    """Medians over ``rounds``, after a warm-up in which everything is recorded."""
    env, alg, device = runner.env, runner.alg, runner.device
    steps = runner.cfg["num_steps_per_env"]
    with contextlib.redirect_stdout(io.StringIO()):
        runner.learn(5)
        whole = statistics.median(
            seconds(lambda: runner.learn(iterations, False), device) / iterations for _ in range(rounds)
        )
    parts: dict[str, list[float]] = {"step": [], "policy": [], "update": []}
    obs = env.get_observations()
    for _ in range(rounds):
        with torch.inference_mode():
            actions = alg.act(obs)
            step = seconds(lambda actions=actions: env.step(actions), device, steps) * steps
            result = env.step(actions)

            def act_and_store(result=result) -> None:
                alg.act(result[0])
                alg.process_env_step(*result)

            parts["policy"].append(seconds(act_and_store, device, steps) * steps)
            obs = result[0]
            returns = seconds(lambda: alg.compute_returns(obs), device)  # noqa: B023 (called at once)
        parts["step"].append(step)
        with runner.update_threads:
            parts["update"].append(returns + seconds(alg.update, device))
    bare = physics_only(env, eager)
    physics = statistics.median(seconds(bare, device, steps) * steps for _ in range(rounds))
    step, policy, update = (statistics.median(values) for values in parts.values())
    return Times(whole, physics, step - physics, policy, update)


def run(args: argparse.Namespace, device: str, worlds: int | None, algorithm: str | None = None) -> Times:
    """Measure the task as the flags say, perhaps with another algorithm, and print a line."""
    task = load_task(args.task)
    if device == "cpu":
        fit_cpu(task, usable_cores())  # as train.py does
    apply_overrides(task, args)
    if worlds is not None:
        task.cfg.env.num_envs = worlds
    if algorithm:
        task.train.algorithm.class_name = algorithm
    seed_everything(task.train.seed)
    with contextlib.redirect_stdout(io.StringIO()):
        env = task.env_class(task.cfg, device, eager=args.eager)
        env.fuse(steps=1_000_000)
        runner = make_runner(env, task.train, None, device)
    times = measure(runner, args.iterations, args.rounds, args.eager)
    speed = env.num_envs * runner.cfg["num_steps_per_env"] / times.whole
    parts = "".join(f"{1e3 * t:>{w}.1f}" for t, w in zip((*times, times.rest), (11, 9, 8, 8, 8, 8), strict=True))
    print(f"{env.num_envs:>8}{speed:>12.0f}{parts}", flush=True)
    return times


def main() -> None:
    parser = make_parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.set_defaults(task="go1_flat")
    parser.add_argument(
        "--worlds", type=int, nargs="+", help="worlds to measure, one after the other (default: the task's)"
    )
    parser.add_argument("--iterations", type=int, default=10, help="in one call of learn")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--beside_rsl_rl", action="store_true", help="measure with rsl-rl's own PPO too")
    args = parser.parse_args()
    device = pick_device(args.device)
    if device == "cpu":
        torch.set_num_threads(1)  # as train.py does
    else:
        torch.cuda.set_device(device)
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"CPU, {usable_cores()} cores"
    header = f"{'worlds':>8}{'steps/s':>12}{'iteration':>11}{'physics':>9}{'step':>8}{'policy':>8}{'update':>8}{'rest':>8}   [ms]"
    print(f"{args.task} on {name}; torch {torch.__version__}\n{header}")
    for worlds in args.worlds or [None]:
        ours = run(args, device, worlds)
        if args.beside_rsl_rl:
            theirs = run(args, device, worlds, "PPO")
            ratios = (
                theirs.whole / ours.whole,
                (theirs.policy + theirs.update) / (ours.policy + ours.update),
                theirs.update / ours.update,
            )
            print(
                "rsl-rl's own PPO, above, takes {:.2f} times as long an iteration; its learner {:.2f}, its update {:.2f}".format(
                    *ratios
                )
            )


if __name__ == "__main__":
    main()
