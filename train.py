"""Train a task: python train.py --task go1_flat, or on 8 GPUs: torchrun --nproc_per_node=8 train.py --task go1_flat"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import threading
import time
from pathlib import Path

import torch

from legged_mw import ROOT
from legged_mw.envs.checks import check_values
from legged_mw.envs.describe import describe
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval.training import TrainingExam, make_exam
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.ranks import Rank, leave_together, leave_when_stuck, quiet, rank_device, this_rank
from legged_mw.rl.runner import Runner, check_mirror, make_runner
from legged_mw.rl.runs import CONFIG_FILE, find_checkpoint, find_run, new_run
from legged_mw.sim.engines import pick_engine
from legged_mw.utils.cli import apply_overrides, duration, make_parser, one_line_errors, pick_device, positive, seed_everything, shown
from legged_mw.utils.config import ConfigError, load_yaml, save_yaml
from legged_mw.utils.errors import UserError
from legged_mw.utils.machine import usable_cores
from legged_mw.utils.task import LoadedTask, load_task, task_names

_STEPS_PER_CORE = 6500  # a second, in training with the section `cpu` as it is (docs/performance.md)


def parse() -> argparse.Namespace:
    parser = make_parser(__doc__)
    parser.add_argument("--max_iterations", type=positive, metavar="N", help="train until this iteration, resumed or not")
    parser.add_argument("--run_name", metavar="NAME", help="appended to the run folder's name")
    parser.add_argument("--resume", action="store_true", help="go on with the last run, or the one of --load_run")
    parser.add_argument("--headless", action="store_true", help="accepted as in legged_gym; training never opens a window")
    parser.add_argument("--max_time", type=duration, metavar="T", help="end, after a checkpoint, after 90s, 5m, 1.5h ...")
    parser.add_argument("--list", action="store_true", help="show the tasks and exit")
    parser.add_argument("--check", action="store_true", help="show what the task is made of and exit")
    args = parser.parse_args()
    if not (args.task or args.list):
        parser.error(f"--task is missing; tasks: {', '.join(task_names())}")
    return args


def main() -> None:
    began, args, rank = time.time(), parse(), this_rank()
    quiet(rank)
    if args.list:
        for name in task_names():
            print(f"{name:<16} {load_task(name).about}")
        return
    task = load_task(args.task)
    experiment = ROOT / "logs" / (args.experiment_name or task.train.runner.experiment_name or task.name)
    run = find_run(experiment, args.load_run or "-1") if args.resume else None
    checkpoint = find_checkpoint(run, args.checkpoint) if run else None
    if run:
        for section in task.update_from_run(load_yaml(run / CONFIG_FILE), where=shown(run / CONFIG_FILE)):
            print(f"{shown(run / CONFIG_FILE)} is older than the section {section}: left as it was then")
    elif args.load_run is not None or args.checkpoint != -1:
        raise ConfigError("--load_run and --checkpoint say what to go on with: add --resume")
    apply_overrides(task, args)
    device = pick_device(rank_device(rank, args.device))
    if device == "cpu" and task.train.cpu.enable and not run:
        task.fit_cpu(usable_cores())
        apply_overrides(task, args)  # again: what the user says wins
        print("on a CPU the section cpu sets worlds, networks and learner; flags win, --set cpu.enable=false keeps the task's own")
    if not run:
        experiment = ROOT / "logs" / (task.train.runner.experiment_name or task.name)  # --set may have named it
    check_values(task.cfg, task.train)
    if device != "cpu":
        torch.cuda.set_device(device)
    seed_everything(task.train.seed + rank.index)  # every rank its own worlds, commands and noise
    announce(task, device, rank)
    env = task.env_class(task.cfg, device, eager=args.eager)
    if args.check:
        check_mirror(env, task.train)
        print(describe(env, task))
        return
    wanted = rank.leads and 0 < task.train.runner.exam_interval <= task.train.runner.max_iterations
    examine = make_exam(task, env, args.eager) if wanted else None
    finished = train(task, env, examine, experiment, run, checkpoint, device, began + args.max_time if args.max_time else None)
    leave_together(rank)
    if finished and task.train.runner.export:
        take_away(task, *finished)


def announce(task: LoadedTask, device: str, rank: Rank) -> None:
    """Say what is trained on what; on a CPU also how long it may take."""
    worlds, engine = task.cfg.env.num_envs, pick_engine(task.cfg.sim.engine, device)
    where = device if rank.count == 1 else f"each of {rank.count} {'processes' if device == 'cpu' else 'GPUs'}"
    compiles = "; a first run compiles kernels, about a minute" if engine == "mujoco_warp" else ""
    print(f"{task.name}: {worlds} worlds on {where}, engine {engine}{compiles}", flush=True)
    if device != "cpu":
        return
    cores, runner = usable_cores(), task.train.runner
    steps = runner.max_iterations * worlds * runner.num_steps_per_env
    if task.cfg.terrain.mesh_type != "plane":
        print(
            f"{cores} cores: {steps:,} steps; rough ground takes a CPU several times as long as a plane, and wants a GPU",
            flush=True,
        )
        return
    minutes = steps / (_STEPS_PER_CORE * cores) / 60
    print(f"{cores} cores: {runner.max_iterations} iterations, {steps / 1e6:.1f} M steps, about {minutes:.0f} min", flush=True)


def train(
    task: LoadedTask,
    env: LeggedRobot,
    examine: TrainingExam | None,
    experiment: Path,
    run: Path | None,
    checkpoint: Path | None,
    device: str,
    deadline: float | None,
) -> tuple[Path, str] | None:
    """Train; returns the run folder and the flags that find it again if the training is finished, on the first rank."""
    runner = make_runner(env, task.train, None, device)
    runner.examine = examine
    if checkpoint:
        runner.load(str(checkpoint))
        print(f"resuming {shown(checkpoint)}")
    left = task.train.runner.max_iterations - runner.current_learning_iteration
    if left <= 0:
        done, wanted = runner.current_learning_iteration, task.train.runner.max_iterations
        raise ConfigError(f"{shown(checkpoint or experiment)} has done {done} iterations of {wanted}; raise --max_iterations to go on")
    newest = run is not None and checkpoint == find_checkpoint(run, -1)
    stop_on_signals(runner, deadline)
    rank = this_rank()
    leave_when_stuck(rank)
    if not rank.leads:  # one run folder, written by the first rank
        learn_together(runner, left, rank)
        return None
    folder = run if run and newest else new_run(experiment, task.train.runner.run_name)  # an earlier checkpoint begins a branch
    save_yaml(folder / CONFIG_FILE, task.to_dict())
    runner.logger.log_dir = str(folder)
    print(f"writing to {shown(folder)}", flush=True)
    learn_together(runner, left, rank)
    if runner.last_exam:
        iteration, figures = runner.last_exam
        print(f"exam after {iteration} iterations: {', '.join(f'{figure} {value:.3f}' for figure, value in figures.items())}")
    name = task.to_dict()["task"]
    home = ROOT / "logs" / (load_task(name).train.runner.experiment_name or task.name)
    flags = shlex.join(["--task", name, "--load_run", folder.name if folder.parent == home else shown(folder)])
    if runner.stop and runner.current_learning_iteration < task.train.runner.max_iterations:
        program = "python train.py" if rank.count == 1 else f"torchrun --nproc_per_node={rank.count} train.py"
        print(f"stopped: {runner.stop}; go on with\n  {program} --resume {flags}")
        return None
    print(f"done: {shown(folder)}; watch it with\n  python play.py {flags}", flush=True)
    return folder, flags


def take_away(task: LoadedTask, run: Path, flags: str) -> None:
    """Export what was trained; the training is done and saved, so that nothing may end it in an error now."""
    folder = run / "export"
    try:
        from legged_mw.rl.export import export  # onnx takes a while to import

        print(export(task.to_dict(), find_checkpoint(run, -1), folder).text(folder))
    except Exception as error:  # whatever an exporter may throw
        reason = " ".join(f"{error}".split()) or type(error).__name__
        print(f"not exported: {reason}\n  once that is mended: python play.py {flags} --export {shown(folder)}")


def learn_together(runner: Runner, iterations: int, rank: Rank) -> None:
    """Learn; when another rank is lost on the way, say so in a line."""
    try:
        runner.learn(iterations)
        if isinstance(runner.alg, GraphedPPO):
            runner.alg.release()
    except RuntimeError as error:
        lost = r"(closed|reset|aborted) by|connection (was )?(closed|reset|refused)|remote process|remoteerror"
        if rank.count == 1 or not re.search(lost, str(error), re.IGNORECASE):
            raise
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"rank {rank.index} lost another rank ({reason}); --resume goes on from the last checkpoint, if there is one"
        ) from error


def stop_on_signals(runner: Runner, deadline: float | None) -> None:
    """Ctrl-C, SIGTERM and the clock ask the runner to save and stop; a second Ctrl-C stops at once."""

    def ask(number: int, _: object) -> None:
        runner.stop = signal.Signals(number).name
        # not print: it is not to be called while another print is interrupted
        os.write(1, f"{runner.stop}: saving and stopping after this step; again to stop at once\n".encode())
        signal.signal(number, signal.SIG_DFL)

    signal.signal(signal.SIGINT, ask)
    signal.signal(signal.SIGTERM, ask)
    if deadline is not None:
        timer = threading.Timer(max(0.0, deadline - time.time()), lambda: setattr(runner, "stop", "--max_time"))
        timer.daemon = True
        timer.start()


if __name__ == "__main__":
    torch.set_num_threads(1 if not torch.cuda.is_available() else torch.get_num_threads())
    with one_line_errors("train.py"):
        main()
