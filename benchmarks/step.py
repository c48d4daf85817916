"""How much of an environment step is physics: environment steps a second, and two ratios, measured in the same run.

    python benchmarks/step.py --num_envs 4096 16384
    python benchmarks/step.py --task g1_flat --num_envs 8192
    python benchmarks/step.py --task go1_rough --num_envs 4096 8192
    python benchmarks/step.py --device cpu --num_envs 256 1024

- own / step: the step's own physics, ``env.sim.step(decimation)`` as the environment runs it (sensors in the last substep, what
  nothing reads left out), against the recorded step. What is missing to 1 is all that an environment adds. Look at this one.
- bare / step: plain ``mujoco_warp.step``, ``decimation`` times, the same model on the same ground, sensors in every substep.
  What one would have without this framework; it can be above 1.

Each is recorded as one graph, from the environment's state of the moment, and timed in turns with the environment; own physics
with the targets held that the environment left, bare physics with those of the default pose. MuJoCo's own engine has one
physics: the call of `Batch.step` inside of the environment's step, for robots that thrash and fall take longer to step than
robots that stand. Medians are compared.
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
import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.envs.robot_task import RobotTask
from legged_mw.sim.engines import ENGINES, pick_engine
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.cli import pick_device
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import load_task


class Times(NamedTuple):
    """Median seconds."""

    own: float  # the step's own physics
    bare: float  # plain mujoco_warp.step; MuJoCo's own engine: its own physics again
    step: float  # the recorded step
    whole: float  # `env.step`, with its copies


def inside_mujoco(env: RobotTask, actions: torch.Tensor, calls: int) -> Times:
    """Physics is the call of `Batch.step` inside of the step."""
    batch, spent = env.sim._batch, []  # type: ignore[attr-defined]
    step_batch = batch.step
    batch.step = lambda **asked: spent.append(timed(lambda: step_batch(**asked), 1, "cpu"))
    step, whole = [], []
    for _ in range(calls):
        whole.append(timed(lambda: env.step(actions), 1, "cpu"))
        env.actions.copy_(actions)
        step.append(timed(env._graph, 1, "cpu"))
    del batch.step
    physics = statistics.median(spent)
    return Times(physics, physics, statistics.median(step), statistics.median(whole))


def own_physics(env: RobotTask) -> Callable[[], None]:
    """A recorded call of the substeps of one control step, as the environment runs them."""
    graph = StepGraph(lambda: env.sim.step(env.cfg.control.decimation, env.actuators.before), env.device)
    for _ in range(4):
        graph()
    return graph


def bare_warp(env: RobotTask) -> tuple[Callable[[], None], Callable[[], None]]:
    """A recorded call of `decimation` plain mujoco-warp steps, and what brings it to the environment's state."""
    import mujoco_warp as mjw
    import warp as wp

    from legged_mw.sim.warp_engine import WarpSimulation, make_model, record_warp

    device, sim = wp.get_device(env.device), env.sim
    assert isinstance(sim, WarpSimulation)
    with wp.ScopedDevice(device):
        model = make_model(env.robot.physics, env.terrain)
        model.opt.warn_overflow, model.opt.graph_conditional = 0, False
        data = mjw.make_data(env.robot.physics, nworld=env.num_envs, nconmax=sim.nconmax, njmax=sim.njmax)
    wp.to_torch(data.ctrl).copy_(env.default_dof_pos.expand(env.num_envs, -1))

    def begin() -> None:
        for name in ("qpos", "qvel"):
            wp.to_torch(getattr(data, name)).copy_(getattr(sim, name))

    def steps() -> None:
        for _ in range(env.cfg.control.decimation):
            mjw.step(model, data)

    if device.is_cpu:
        return record_warp(steps, device), begin
    graph = StepGraph(steps, env.device)
    begin()
    for _ in range(4):
        graph()
    return graph, begin


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


def measure(task_name: str, engine: str, num_envs: int, device: str, calls: int, rounds: int, eager: bool) -> Times:
    task = load_task(task_name)
    task.cfg.env.num_envs = num_envs
    task.set("sim.engine", engine)
    env = task.env_class(task.cfg, device, eager=eager)
    env.fuse(steps=1_000_000)
    actions = 0.3 * torch.randn(num_envs, env.num_actions, device=device)
    with torch.inference_mode():  # as in training
        for _ in range(20):
            env.step(actions)
        if env.sim.engine == "mujoco":
            return inside_mujoco(env, actions, calls * rounds)
        (bare, begin_bare), state = bare_warp(env), {name: value.clone() for name, value in env.sim.memory().items()}
        own, rows = own_physics(env), []
        for _ in range(rounds):
            for name, value in env.sim.memory().items():  # as own physics found it: nobody stands up again there
                value.copy_(state[name])
            begin_bare()
            own_time, bare_time, step = (
                timed(own, calls, device),
                timed(bare, calls, device),
                timed(env._graph, calls, device),
            )
            rows.append((own_time, bare_time, step, timed(lambda: env.step(actions), calls, device)))
    return Times(*map(statistics.median, zip(*rows, strict=True)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_flat")
    parser.add_argument("--num_envs", type=int, nargs="+", default=None)
    parser.add_argument("--device", default=None)
    parser.add_argument("--engine", choices=ENGINES, default="auto")
    parser.add_argument(
        "--calls", type=int, default=40, help="calls a round; short, so that bare physics does not fall over"
    )
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--eager", action="store_true", help="time the step without its recording")
    args = parser.parse_args()
    device = pick_device(args.device)
    name = torch.cuda.get_device_name(device) if device != "cpu" else f"CPU, {usable_cores()} cores"
    torch.set_num_threads(1 if device == "cpu" else torch.get_num_threads())  # as train.py does
    print(
        f"{args.task} on {name}, engine {pick_engine(args.engine, device)}; torch {torch.__version__}, mujoco {mujoco.__version__}"
    )
    heads = (
        "worlds",
        "own physics",
        "step",
        "env.step [ms]",
        "own/step",
        "own/env.step",
        "bare [ms]",
        "bare/step",
        "env steps/s",
    )
    print("".join(f"{head:>14}" for head in heads))
    for num_envs in args.num_envs or ([256, 1024] if device == "cpu" else [1024, 4096, 16384]):
        own, bare, step, whole = measure(args.task, args.engine, num_envs, device, args.calls, args.rounds, args.eager)
        print(
            f"{num_envs:>14}{own * 1e3:>14.2f}{step * 1e3:>14.2f}{whole * 1e3:>14.2f}{own / step:>14.3f}{own / whole:>14.3f}"
            f"{bare * 1e3:>14.2f}{bare / step:>14.3f}{num_envs / whole:>14.0f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
