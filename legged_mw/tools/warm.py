"""legged-mw warm: compile the kernels that tasks need on this device, so that their first training begins at once."""

from __future__ import annotations

import time

import torch

from legged_mw.eval.exams import make_exam
from legged_mw.rl.layers import kernels_for
from legged_mw.sim.device import device_facts
from legged_mw.utils.cli import Parser, pick_device
from legged_mw.utils.task import load_task, task_names

_FEW = 8  # worlds on a CPU: kernels do not depend on their number
_STEPS = 5  # three before the step is recorded, two replays


def main() -> None:
    parser = Parser(prog="legged-mw warm", description=__doc__, allow_abbrev=False)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help="tasks or config files (default: all tasks that ship)")
    parser.add_argument("--device", metavar="D", help="cuda:0, cpu (default: the GPU if there is one)")
    args = parser.parse_args()
    device = pick_device(args.device)
    if device == "cpu":
        print("on a CPU MuJoCo's own engine trains, and compiles nothing; these kernels are for --engine mujoco_warp", flush=True)
    before = device_facts(device)
    print(f"kernels of {before.name} go to {before.cache}", flush=True)
    for name in args.tasks or task_names():
        begun = time.perf_counter()
        warm(name, device)
        print(f"{name:<20} {time.perf_counter() - begun:>6.1f} s", flush=True)
    print(f"{device_facts(device).compiled} modules of mujoco-warp are compiled, {before.compiled} were before")


def warm(name: str, device: str) -> None:
    """Step a task and its exam a few times; on a GPU load the update's kernels, too."""
    task = load_task(name)
    task.set("sim.engine", "mujoco_warp")
    if device == "cpu":
        task.set("env.num_envs", _FEW)
        torch.set_num_threads(1)
    env = task.env_class(task.cfg, device)
    exam = make_exam(task, env)
    for each in [env, *([exam.env] if exam else [])]:
        for _ in range(_STEPS):
            each.step(torch.zeros_like(each.actions))
    if kernels := kernels_for(env.actions):
        kernels.load(device)
