"""The work of train.py: choose config and device, train, stop, resume, and print the next command.

The check of a task, the exam and the exporter are arguments, because they are not part of the core.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import signal
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack, nullcontext, suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rsl_rl.algorithms import Distillation

from legged_mw.envs.motors import note_network
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.learner_config import MAX_RATE, check_classes, check_room, fit_cpu
from legged_mw.rl.policies import (
    TEACHER,
    Trained,
    attach_teacher_observations,
    begin_with,
    check_start,
    find_trained,
    keep_teacher,
    load_teacher,
)
from legged_mw.rl.ppo import Recorded
from legged_mw.rl.ranks import Rank, first_ranks, leave_together, leave_when_stuck, rank_device, this_rank
from legged_mw.rl.run_folder import (
    CONFIG_FILE,
    LOCK_FILE,
    CheckpointWriter,
    RunLock,
    experiment_folder,
    find_checkpoint,
    find_run,
    new_run,
    reason_of,
    update_from_run,
)
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.sim.device import device_facts
from legged_mw.sim.engines import pick_engine
from legged_mw.utils.cli import apply_overrides, command, pick_device, seed_everything
from legged_mw.utils.config import ConfigError, load_yaml, save_yaml
from legged_mw.utils.errors import UserError, shown
from legged_mw.utils.files import writable
from legged_mw.utils.machine import settle, usable_cores
from legged_mw.utils.task import LoadedTask, load_task

STOPPED = 3  # exit code of a training that was stopped and can be resumed
_STEPS_PER_CORE = 6500  # [steps/s] of a training with the default section `cpu` (docs/performance.md)

# raises if the step cannot be recorded; returns a message on task state that checkpoints do not hold, or ""
Check = Callable[[LoadedTask], str]
Examine = Callable[[Any], dict[str, float]]  # policy -> figures by name
Begun = Callable[[Runner, Path], None]  # runner, run folder
Export = Callable[[LoadedTask, Path, Path], str]  # task, checkpoint, folder -> message


class Start(NamedTuple):
    """The run, checkpoint or policies that a training starts from."""

    experiment: Path  # folder for a new run
    run: Path | None = None  # the run to resume
    checkpoint: Path | None = None
    teacher: Trained | None = None  # the policy to distil
    policy: Trained | None = None  # a new run starts from its actor

    goes_on: bool = False  # write into the folder of ``run``, because the checkpoint is its newest


def configure(task: LoadedTask, args: argparse.Namespace) -> tuple[Start, str]:
    """Set the final config of ``task``: resumed run, CPU section, flags. Returns the start and the device."""
    if not torch.cuda.is_available():
        torch.set_num_threads(1)  # a step has hundreds of small operations, which are slow on several threads
    start = _resume(task, args) if args.resume else None
    began = _kept(task)
    apply_overrides(task, args)
    if start:
        for path, now in _kept(task).items():
            if now != (before := began.get(path, now)):
                print(f"a resumed run keeps its {path}: {before!r}, not {now!r}")
                task.set(path, before)
    start = _find_others(task, start or Start(experiment_folder(task)))
    rank = this_rank()
    device = pick_device(rank_device(rank, args.device))
    if fitted := device == "cpu" and task.train.cpu.enable and not start.run:
        fit_cpu(task, usable_cores())
        fields = ", ".join(["worlds", "networks", "learner", *task.train.cpu.overrides])
        print(f"on a CPU the section cpu sets {fields}; flags win, --set cpu.enable=false leaves it out")
    if start.policy:
        actor = start.policy.task.train.to_dict()["actor"]
        del actor["distribution_cfg"]["std_range"]  # the limits of exploration are the new task's
        task.update({"actor": actor}, where="--init")
    if fitted or start.policy:
        apply_overrides(task, args)  # again, because flags win
    if this_rank().leads and not args.check:
        writable(str(start.run or start.experiment), "runs go to", folder=True)
    _note_others(task, start)
    note_network(task.cfg)
    check_classes(task.train)
    task.cfg.check()
    task.train.check(task.cfg.env.num_envs)
    if device != "cpu":
        torch.cuda.set_device(device)
    seed_everything(task.train.seed + rank.index)  # each rank has its own worlds, commands and noise
    args.eager |= not _announce(task, device, rank, args.max_time)
    return start, device


def _resume(task: LoadedTask, args: argparse.Namespace) -> Start:
    """Find the run to resume, and update ``task`` with its config."""
    experiment = experiment_folder(task, args.experiment_name)
    run = find_run(experiment, args.load_run or "-1")
    checkpoint, config = find_checkpoint(run, args.checkpoint), run / CONFIG_FILE
    start = Start(experiment, run, checkpoint, goes_on=checkpoint == find_checkpoint(run, -1))
    if start.goes_on and this_rank().leads and not args.check and (run / LOCK_FILE).is_file():
        _lock(start).release()  # raise before the environment is made
    for section in update_from_run(task, load_yaml(config), where=shown(config)):
        print(f"{shown(config)} has no section {section}: the run is older than it, so it keeps its defaults")
    return start


def _kept(task: LoadedTask) -> dict[str, Any]:
    """The values of the config that a checkpoint settles, so flags of a resume do not change them."""
    train = task.train
    kept = {
        "distillation.teacher": train.distillation.teacher,
        "warm_start.policy": train.warm_start.policy,
        "seed": train.seed,
    }
    if train.algorithm.schedule == "adaptive":
        kept["algorithm.learning_rate"] = train.algorithm.learning_rate
    return kept


def _find_others(task: LoadedTask, start: Start) -> Start:
    """Find the teacher and the warm start that the config names. A resumed run uses its copy of the teacher."""
    teacher, begin = task.train.distillation.teacher, task.train.warm_start.policy
    if teacher:
        teacher = str(start.run / TEACHER) if start.run else teacher
        start = start._replace(teacher=find_trained(teacher, start.experiment, "--teacher", task))
    if begin and not start.run:
        start = start._replace(policy=find_trained(begin, start.experiment, "--init", task))
    return start


def _note_others(task: LoadedTask, start: Start) -> None:
    """Print teacher and warm start, and write their files into the config."""
    for trained, section, field in ((start.teacher, "distillation", "teacher"), (start.policy, "warm_start", "policy")):
        if trained and not start.run:
            file = shown(trained.source.checkpoint)
            task.update({section: {field: trained.task.name if trained.source.shipped else file}}, where="train")
            print(f"{'teacher' if trained is start.teacher else 'begins with the actor of'}: {file}")
    if start.teacher and (task.train.symmetry.use_data_augmentation or task.train.symmetry.use_mirror_loss):
        print(
            "symmetry is off while a student is distilled, as rsl-rl's distillation has none; "
            "PPO from the student has it again"
        )


def _announce(task: LoadedTask, device: str, rank: Rank, most: float | None) -> bool:
    """Print task, device, reasons for a low speed, and on a CPU the duration. Returns whether steps can be recorded."""
    worlds, engine = task.cfg.env.num_envs, pick_engine(task.cfg.sim.engine, device)
    where = device if rank.count == 1 else f"each of {rank.count} {'processes' if device == 'cpu' else 'GPUs'}"
    print(f"{task.name}: {worlds} worlds on {where}, engine {engine}", flush=True)
    facts = device_facts(device) if engine == "mujoco_warp" else None
    for line in facts.slow() if facts else ():
        print(line, flush=True)
    if device != "cpu":
        print(advice_on_rate(task), end="", flush=True)
        return facts is None or facts.pool
    cores, runner = usable_cores(), task.train.runner
    steps = runner.max_iterations * worlds * runner.num_steps_per_env
    minutes = steps / (_STEPS_PER_CORE * cores) / 60
    plan = f"{runner.max_iterations} iterations, {steps / 1e6:.1f} M steps, about {minutes:.0f} min"
    if task.to_dict()["terrain"].get("mesh_type", "plane") != "plane":
        plan = f"{steps:,} steps; rough ground takes a CPU several times as long as a plane, and wants a GPU"
    if most and most < 60 * minutes:
        plan += f"; --max_time ends it after {most / 60:.3g} min"
    print(f"{cores} cores: {plan}", flush=True)
    return True


def advice_on_rate(task: LoadedTask) -> str:
    """A warning for a recurrent network on a GPU: its adaptive learning rate becomes too high with many samples.

    Source: docs/lab.md, Blind stairs.
    """
    algorithm, networks = task.train.algorithm, (task.train.actor, task.train.critic)
    recurrent = any(network.class_name.endswith("RNNModel") for network in networks)
    bounded = algorithm.schedule == "fixed" or algorithm.max_learning_rate < MAX_RATE
    if not recurrent or bounded or task.train.distillation.teacher:
        return ""
    advice = "--set algorithm.max_learning_rate=1e-3 (docs/training.md, A memory)"
    return f"note: a recurrent network may fail to learn at a high adaptive learning rate: {advice}\n"


def say_compiling(task: LoadedTask, device: str) -> AbstractContextManager[object]:
    """A context that prints a line if kernels must be compiled."""
    return (
        device_facts(device).say_compiling()
        if pick_engine(task.cfg.sim.engine, device) == "mujoco_warp"
        else nullcontext()
    )


def build(task: LoadedTask, start: Start, device: str, eager: bool, check: Check) -> Any:
    """Make the environment. Raises if its step cannot be recorded (unless ``eager``) or does not fit the learner."""
    lost = check(task) if this_rank().leads and (start.run or not eager) else ""
    env = task.env_class(task.cfg, device, eager=eager)
    env.not_remembered = lost
    if lost:
        print(f"note: {lost}; with --resume worlds begin anew", flush=True)
    check_room(task.train.to_dict(), env)
    if start.policy:
        check_start(env, task, start.policy)
    if start.teacher:
        attach_teacher_observations(env, start.teacher)
    for line in env.robot.overrides if this_rank().leads else ():
        if line.startswith("warning:"):
            print(line, flush=True)
    return env


def make_learner(task: LoadedTask, env: RobotTask, start: Start) -> Runner:
    """Make the runner. A new run loads its teacher or warm start here. ``train`` loads the checkpoint of a resume."""
    runner = make_runner(env, task.train, None, str(env.device), start.teacher.task.train if start.teacher else None)
    if not start.checkpoint:
        _begin(runner, start)
    return runner


def wants_exam(task: LoadedTask) -> bool:
    """Whether this process runs exams during training."""
    return this_rank().leads and 0 < task.train.runner.exam_interval <= task.train.runner.max_iterations


def train(
    task: LoadedTask,
    env: RobotTask,
    start: Start,
    examine: Examine | None,
    export: Export,
    deadline: float | None = None,
    verbose: bool = False,
    begun: Begun | None = None,
) -> bool:
    """Train to the last iteration, to ``deadline`` [s, time.time()], or until stopped. Export if not stopped.

    ``begun`` is called before the first iteration, after the run folder is written; ``verbose`` prints all numbers.
    Returns whether the training is finished. Raises UserError if it diverged or the last checkpoint was not written.
    """
    rank, runner = this_rank(), make_learner(task, env, start)
    env.fuse(task.train.runner.max_iterations * task.train.runner.num_steps_per_env)  # last: it takes seconds
    runner.examine, runner.console.verbose, runner.deadline = examine, verbose, deadline
    with ExitStack() as held:
        left = _load(runner, task, start)  # before the lock, so that an error writes nothing
        lock = held.enter_context(_lock(start)) if start.goes_on and rank.leads else None
        _stop_on_signals(runner)
        leave_when_stuck(rank)
        folder = _open_run(runner, task, start, rank, held, lock)
        if rank.leads and begun:
            begun(runner, folder)
        _learn(runner, left, rank)
        lost = _not_saved(runner)
        finished = not lost and _say_how_it_ended(runner, task, folder, rank)
        leave_together(rank)
        if error := runner.diverged or lost:
            raise UserError(error)
        if rank.leads and finished and task.train.runner.export:
            _export(task, folder, export)
    return finished or rank.count > 1  # for torchrun any exit code but 0 is a crash


def _not_saved(runner: Runner) -> str:
    """Error line if the last checkpoint was not written, else ''."""
    writer, done = runner.writer, runner.current_learning_iteration
    if not (writer and writer.failed):
        return ""
    written = writer.written
    newest = f"the newest that is written is {shown(written)}" if written else "none of this training is written"
    last = f"the last checkpoint, of iteration {done}"
    return f"{last}, cannot be written to {shown(writer.folder)}: {writer.failed}; {newest}"


def _load(runner: Runner, task: LoadedTask, start: Start) -> int:
    """Load the checkpoint of a resumed run. Returns the number of iterations left."""
    if start.checkpoint:
        runner.load(str(start.checkpoint))
    done, last = runner.current_learning_iteration, task.train.runner.max_iterations
    if done >= last:
        what = shown(start.checkpoint or start.experiment)
        raise ConfigError(f"{what} has done {done} iterations of {last}; raise --max_iterations to go on")
    if start.checkpoint:
        print(f"resuming {shown(start.checkpoint)}")
        note = f"worlds begin anew ({runner.why_not_exact}); networks, counters and curricula go on"
        print(note if runner.why_not_exact else "exactly: worlds and generators go on where they were", flush=True)
    return last - done


def _begin(runner: Runner, start: Start) -> None:
    """Load the teacher or the actor of the warm start of a new run."""
    if start.teacher:
        assert isinstance(runner.alg, Distillation)
        load_teacher(runner.alg.teacher, start.teacher, runner.env)
        runner.alg.teacher_loaded = True
    if start.policy:
        begin_with(runner.alg.get_policy(), start.policy, runner.env)
        if warmup := runner.cfg["critic_warmup"]:
            print(f"only the critic learns for {warmup} iterations (warm_start.critic_warmup)", flush=True)


def _lock(start: Start) -> RunLock:
    """Lock the run to resume. Raises ConfigError if it is locked, read-only, or has a newer checkpoint."""
    assert start.run
    try:
        lock = RunLock(start.run)
    except OSError as error:
        raise ConfigError(f"{shown(start.run)} cannot be written: {reason_of(error)}") from None
    if (newest := find_checkpoint(start.run, -1)) == start.checkpoint:
        return lock
    lock.release()
    raise ConfigError(
        f"{shown(start.run)} has gone on since this began, to {newest.name}: another process trained there; "
        "resume it again"
    )


def _open_run(
    runner: Runner, task: LoadedTask, start: Start, rank: Rank, held: ExitStack, lock: RunLock | None
) -> Path:
    """Open the run folder and write the config into it. It stays locked until ``held`` ends.

    With a ``lock`` it is the folder of the resumed run, else a new one. The first rank makes it for all ranks, also
    again if it is deleted.
    """
    folder = [Path()]
    if start.run and lock:
        folder = [start.run]
    elif rank.leads:
        folder = [new_run(start.experiment, task.train.runner.run_name)]

    def write() -> None:
        nonlocal lock
        if not lock or lock.lost():
            folder[0].mkdir(parents=True, exist_ok=True)
            lock = held.enter_context(RunLock(folder[0]))
        lock.begin()
        runner.console.open(folder[0])
        save_yaml(folder[0] / CONFIG_FILE, task.to_dict())
        if start.teacher:
            keep_teacher(start.teacher, folder[0])

    def restore() -> bool:
        if gone := rank.leads and not (folder[0] / CONFIG_FILE).is_file():
            write()
        return gone

    if rank.leads:
        try:
            write()
        except OSError as error:
            raise ConfigError(f"{shown(folder[0])} cannot be written: {reason_of(error)}") from None
        runner.logger.log_dir = str(folder[0])
        print(f"writing to {shown(folder[0])}", flush=True)
    folder[0] = first_ranks(folder[0], runner.device)
    runner.writer = CheckpointWriter(folder[0], task.train.runner.keep_checkpoints, rank, restore)
    return folder[0]


def _learn(runner: Runner, iterations: int, rank: Rank) -> None:
    """Run the iterations. Raises UserError if the connection to another rank is lost."""
    settle()
    try:
        with runner.console:
            runner.learn(iterations, bool(runner.why_not_exact))
        if isinstance(runner.alg, Recorded):
            runner.alg.release()
    except RuntimeError as error:
        lost = r"(closed|reset|aborted) by|connection (was )?(closed|reset|refused)|remote process|remoteerror"
        if rank.count == 1 or not re.search(lost, str(error), re.IGNORECASE):
            raise
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"rank {rank.index} lost another rank ({reason}); "
            "--resume goes on from the last checkpoint, if there is one"
        ) from error


def _say_how_it_ended(runner: Runner, task: LoadedTask, folder: Path, rank: Rank) -> bool:
    """Print the last exam and the next command. Returns whether the training is finished."""
    if runner.last_exam:
        iteration, figures = runner.last_exam
        text = ", ".join(f"{figure} {value:.3f}" for figure, value in figures.items())
        print(f"exam after {iteration} iterations: {text}")
    flags, schedule, done = _flags(task, folder), runner.schedule, runner.current_learning_iteration
    if runner.stop and done < schedule.last:
        left = f" --max_time {max(1, round(schedule.deadline - time.time()))}s" if schedule.deadline else ""
        print(
            f"stopped: {runner.stop}; go on with\n  {command('train', rank.count)} --resume {flags}{left}", flush=True
        )
        return False
    if done < task.train.runner.max_iterations:
        print(f"{done} iterations within --max_time; --resume goes on towards {task.train.runner.max_iterations}")
    print(f"done: {shown(folder)}; watch it with\n  {command('play')} {flags}", flush=True)
    return True


def _flags(task: LoadedTask, folder: Path) -> str:
    """The flags that select a run."""
    name = task.name if task.ships else shown(task.path)
    home = experiment_folder(load_task(name))
    return shlex.join(["--task", name, "--load_run", folder.name if folder.parent == home else shown(folder)])


def _export(task: LoadedTask, run: Path, export: Export) -> None:
    """Export the trained policy. The training is already saved, so an error is only printed."""
    folder = run / "export"
    try:
        print(export(task, find_checkpoint(run, -1), folder))
    except Exception as error:  # any kind
        reason = " ".join(f"{error}".split()) or type(error).__name__
        print(f"not exported: {reason}\n  to try again: {command('play')} {_flags(task, run)} --export {shown(folder)}")


def _stop_on_signals(runner: Runner) -> None:
    """On Ctrl-C, SIGTERM and SIGHUP, save and stop. A second Ctrl-C or SIGTERM stops at once.

    A second SIGHUP does nothing: when a terminal closes, the shell and the system each send one.
    """

    def stop(number: int, _: object) -> None:
        runner.stop = name = signal.Signals(number).name
        # os.write, because print fails if the signal interrupts another print
        with suppress(OSError):  # the terminal may be closed
            again = "" if name == "SIGHUP" else "; again to stop at once"
            os.write(1, f"{name}: saving and stopping after this iteration{again}\n".encode())
        signal.signal(number, (lambda *_: None) if name == "SIGHUP" else signal.SIG_DFL)

    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup ignores it
        signal.signal(signal.SIGHUP, stop)
