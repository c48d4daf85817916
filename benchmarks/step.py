"""Environment steps a second, and as a ratio to bare physics measured in the same run.

    python benchmarks/step.py --num_envs 4096 16384
    python benchmarks/step.py --device cpu --num_envs 256 1024

Bare physics is the same engine stepping the same model `decimation` times on the same ground, all sensors on in every
substep, and nothing else. mujoco-warp: recorded as one graph, from the environment's state of the moment, servos at the
default pose, timed in turns with the environment. MuJoCo's own engine: the call of `Batch.step` inside of the environment's
step, for robots that thrash and fall take longer to step than robots that stand. Medians are compared.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.sim.engines import ENGINES, pick_engine
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.cli import pick_device
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import load_task


def inside_mujoco(env: LeggedRobot, actions: torch.Tensor, calls: int) -> tuple[float, float, float]:
    """Median seconds of the step, of `env.step`, and of the call of `Batch.step` inside of them."""
    batch, spent = env.sim._batch, []  # type: ignore[attr-defined]
    step_batch = batch.step
    batch.step = lambda **asked: spent.append(timed(lambda: step_batch(**asked), 1, "cpu"))
    step, whole = [], []
    for _ in range(calls):
        whole.append(timed(lambda: env.step(actions), 1, "cpu"))
        env.actions.copy_(actions)
        step.append(timed(env._graph, 1, "cpu"))
    del batch.step
    return statistics.median(step), statistics.median(whole), statistics.median(spent)


def bare_warp(env: LeggedRobot) -> Callable[[], None]:
    """A recorded call of `decimation` plain mujoco-warp steps, from the same state."""
    import mujoco_warp as mjw
    import warp as wp

    from legged_mw.sim.warp_engine import WarpSimulation, make_model, record_warp

    device, sim = wp.get_device(env.device), env.sim
    assert isinstance(sim, WarpSimulation)
    with wp.ScopedDevice(device):
        model = make_model(env.robot.physics, env.terrain)
        model.opt.warn_overflow, model.opt.graph_conditional = 0, False
        data = mjw.make_data(env.robot.physics, nworld=env.num_envs, nconmax=sim.nconmax, njmax=sim.njmax)
    for name in ("qpos", "qvel"):
        wp.to_torch(getattr(data, name)).copy_(getattr(env.sim, name))
    wp.to_torch(data.ctrl).copy_(env.default_dof_pos.expand(env.num_envs, -1))

    def steps() -> None:
        for _ in range(env.cfg.control.decimation):
            mjw.step(model, data)

    if device.is_cpu:
        return record_warp(steps, device)
    graph = StepGraph(steps, env.device)
    for _ in range(4):
        graph()
    return graph


def timed(fn: Callable[[], object], calls: int, device: str) -> float:
    """Seconds a call."""
    if device != "cpu":
        torch.cuda.synchronize()
    start = time.perf_counter()
    for _ in range(calls):
        fn()
    if device != "cpu":
        torch.cuda.synchronize()
    return (time.perf_counter() - start) / calls


def measure(task_name: str, engine: str, num_envs: int, device: str, calls: int, rounds: int, eager: bool) -> tuple[float, float, float]:
    """Median seconds of the recorded step, of `env.step` with its copies, and of bare physics."""
    task = load_task(task_name)
    task.cfg.env.num_envs = num_envs
    task.set("sim.engine", engine)
    env = task.env_class(task.cfg, device, eager=eager)
    actions = 0.3 * torch.randn(num_envs, env.num_actions, device=device)
    for _ in range(20):
        env.step(actions)
    if env.sim.engine == "mujoco":
        with torch.inference_mode():  # as in training
            return inside_mujoco(env, actions, calls * rounds)
    bare = bare_warp(env)
    graph_times, step_times, bare_times = [], [], []
    for _ in range(rounds):
        graph_times.append(timed(env._graph, calls, device))
        bare_times.append(timed(bare, calls, device))
        step_times.append(timed(lambda: env.step(actions), calls, device))
    return statistics.median(graph_times), statistics.median(step_times), statistics.median(bare_times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_flat")
    parser.add_argument("--num_envs", type=int, nargs="+", default=None)
    parser.add_argument("--device", default=None)
    parser.add_argument("--engine", choices=ENGINES, default="auto")
    parser.add_argument("--calls", type=int, default=40, help="calls a round; short, so that bare physics does not fall over")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--eager", action="store_true", help="time the step without its recording")
    args = parser.parse_args()
    device = pick_device(args.device)
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"CPU, {usable_cores()} cores"
    torch.set_num_threads(1 if device == "cpu" else torch.get_num_threads())  # as train.py does
    print(f"{args.task} on {name}, engine {pick_engine(args.engine, device)}; torch {torch.__version__}, mujoco {mujoco.__version__}")
    print(f"{'worlds':>8}{'bare [ms]':>12}{'step [ms]':>12}{'env.step [ms]':>15}{'ratio':>8}{'env.step ratio':>16}{'env steps/s':>14}")
    for num_envs in args.num_envs or ([256, 1024] if device == "cpu" else [1024, 4096, 16384]):
        step, whole, bare = measure(args.task, args.engine, num_envs, device, args.calls, args.rounds, args.eager)
        print(
            f"{num_envs:>8}{bare * 1e3:>12.2f}{step * 1e3:>12.2f}{whole * 1e3:>15.2f}"
            f"{bare / step:>8.3f}{bare / whole:>16.3f}{num_envs / whole:>14.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
