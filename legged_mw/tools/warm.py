"""legged-mw warm: compile the kernels that tasks need on this device, so that their first training begins at once."""

from __future__ import annotations

import time
from contextlib import redirect_stdout
from io import StringIO

import torch

from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval.exams import make_exam
from legged_mw.rl.learner_config import fit_cpu
from legged_mw.rl.networks import kernels_for
from legged_mw.rl.runner import make_runner
from legged_mw.sim.device import device_facts
from legged_mw.utils.cli import Parser, pick_device
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import load_task, task_names

_FEW = 8  # number of worlds for mujoco-warp on a CPU
_STEPS = 5  # three before the step is recorded, then two replays


def main() -> None:
    parser = Parser(prog="legged-mw warm", description=__doc__, allow_abbrev=False)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="tasks or config files (default: all tasks that ship)")
    parser.add_argument("--device", metavar="D", help="cuda:0, cpu (default: the GPU if there is one)")
    args = parser.parse_args()
    device = pick_device(args.device)
    for name in args.tasks:
        load_task(name, say=True)  # a wrong name is refused before the first one compiles
    if device == "cpu":
        print(
            "on a CPU MuJoCo's own engine trains: few kernels; most of these are for --engine mujoco_warp", flush=True
        )
    before = device_facts(device)
    print(f"kernels of {before.name} go to {before.cache}", flush=True)
    for name in args.tasks or task_names():
        begun = time.perf_counter()
        warm(name, device)
        if device == "cpu":
            warm_engine(name)
        print(f"{name:<20} {time.perf_counter() - begun:>6.1f} s", flush=True)
    print(f"{device_facts(device).compiled} modules of mujoco-warp are compiled, {before.compiled} were before")


def warm(name: str, device: str) -> None:
    """Train a task for one iteration and step its exam, which compiles all kernels of its training."""
    task = load_task(name)
    if device == "cpu":
        fit_cpu(task, usable_cores())
        torch.set_num_threads(1)  # as train.py does
    env = task.env_class(task.cfg, device)
    env.fuse(task.train.runner.max_iterations * task.train.runner.num_steps_per_env)
    exam = make_exam(task, env)
    if kernels := kernels_for(env.actions):
        kernels.load(device)
    if not task.train.distillation.teacher:  # a student needs a teacher that is already trained
        with redirect_stdout(StringIO()):
            make_runner(env, task.train, None, device).learn(1)
    for each in [env, *([exam.env] if exam else [])]:
        _step(each)


def warm_engine(name: str) -> None:
    """Compile the kernels of a task's step in mujoco-warp on a CPU. They do not depend on the number of worlds."""
    task = load_task(name)
    task.set("sim.engine", "mujoco_warp")
    task.set("env.num_envs", _FEW)
    _step(task.env_class(task.cfg, "cpu"))


def _step(env: RobotTask) -> None:
    """Do a few steps, until the step is recorded."""
    for _ in range(_STEPS):
        env.step(torch.zeros_like(env.actions))
