"""The programs: legged-mw train, play, deploy, exam, fit, robot and tools. train.py and play.py call the first two.

Each program imports its modules when it starts, so deploy runs without torch.
"""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from legged_mw.utils.cli import FEWER_WORLDS, fail, one_line_errors
from legged_mw.utils.errors import UserError
from legged_mw.utils.machine import settle
from legged_mw.utils.opaque import fast
from legged_mw.utils.task import LoadedTask, load_task, task_names

if TYPE_CHECKING:
    from legged_mw.eval.exams import Graded
    from legged_mw.eval.report import Column


def start_quickly(gpu: str | None = "cpu") -> None:
    """Call the start of legged_mw/fast, if that package exists, before the import of torch. ``gpu``: the device."""
    if quick_start := fast("quick_start"):
        quick_start.begin(gpu)


@one_line_errors(fewer=FEWER_WORLDS)
def train() -> None:
    """Train a task. On 8 GPUs: torchrun --nproc_per_node=8 train.py --task go1_flat"""
    from legged_mw.rl import flags

    args = flags.parse(train.__doc__)
    start_quickly("cpu" if args.list else args.device)
    if args.list:
        print("\n".join(f"{name:<16} {load_task(name).about}" for name in task_names()))
        return
    from legged_mw.check.own_class import check_class
    from legged_mw.eval.exams import find_exam
    from legged_mw.rl import training
    from legged_mw.rl.ranks import quiet, this_rank

    quiet(this_rank())  # from here on only the first process prints
    find_exam(task := load_task(args.task, say=True))
    start, device = training.configure(task, args)
    for line in check_class(task.env_class, task.cfg.to_dict()["rewards"]["scales"]):
        print(line, flush=True)
    with training.say_compiling(task, device):
        _build_and_train(task, start, device, args)


def _build_and_train(task: LoadedTask, start: Any, device: str, args: argparse.Namespace) -> None:
    from legged_mw.check.describe import describe
    from legged_mw.check.guard import check_recordable, not_remembered
    from legged_mw.eval.exams import make_exam
    from legged_mw.rl import training
    from legged_mw.robot.page import doubts

    check = not_remembered if args.eager else check_recordable
    env = training.build(task, start, device, args.eager, check)
    wrong, odd = doubts(task)
    if args.check:
        training.make_learner(task, env, start)  # raise its errors now
        print(describe(env, task) + ("" if args.eager else "\nthe step can be recorded as a CUDA graph"))
        print(
            "".join(["what to look at\n", *(f"  - {line}\n" for line in [*wrong, *odd])]) if wrong or odd else "",
            end="",
        )
        if args.picture:
            from legged_mw.robot.__main__ import show_task

            show_task(task, Path(args.picture))
        return
    print("".join(f"warning: {line}\n" for line in wrong), end="", flush=True)
    examine = make_exam(task, env, args.eager) if training.wants_exam(task) else None
    begun = None
    if args.play:
        from legged_mw.view.playing import watch_training

        begun = partial(watch_training, task)
    if not training.train(task, env, start, examine, export, args.deadline, args.verbose, begun):
        raise SystemExit(training.STOPPED)
    print("".join(f"{line}\n" for line in examine.advice) if examine else "", end="", flush=True)


@one_line_errors(fewer=FEWER_WORLDS)
def play() -> None:
    """Watch, grade or export a policy."""
    start_quickly()
    from legged_mw.eval import exams
    from legged_mw.rl.learner_config import check_classes
    from legged_mw.rl.policies import find_policy, find_rival, introduce, load_trained
    from legged_mw.view import playing

    args = playing.parse(play.__doc__)
    task = load_task(args.task, say=True)
    source = find_policy(task, args.load_run, args.checkpoint, args.experiment_name)
    trained = load_trained(args.task, source)
    settle()
    if args.eval:
        rivals = [find_rival(task, args.compare, args.experiment_name)] if args.compare is not None else []
        policies = [(source, trained), *((rival, load_trained(args.task, rival)) for rival in rivals)]
        exams.grade(policies, args, lambda graded: grade_export(graded, not args.no_hard))
        return
    if args.export:
        check_classes(trained.train)
        introduce(source, {})
        print(export(trained, source.checkpoint, Path(args.export), args.half))
        return
    playing.watch(source, *playing.prepare(source, trained, args), args)


def grade_export(graded: Graded, hard: bool = True) -> list[Column]:
    """Grade the same policy on MuJoCo's C engine, through an export, as ``legged_mw.deploy`` does.

    ``hard``: also the hard exam, if the task walks.
    """
    from legged_mw.deploy.exam import run
    from legged_mw.deploy.hard_exam import strip_png
    from legged_mw.envs.domain_rand import active
    from legged_mw.eval.report import Column

    task = graded.task
    if active(task.cfg):
        print("not graded through an export: an export has the nominal robot, and domain_rand changes it")
        return []
    with TemporaryDirectory() as folder:
        try:
            made = Path(folder) / "export"
            export(task, graded.source.checkpoint, made)
            result, poses = run(made, graded.exam.rules(task), hard)
            strip = strip_png(made, poses)
            return [Column("the same, deployed in MuJoCo", {}, result, strip=strip)]
        except UserError as error:  # a row without sensors, or no onnxruntime
            print(f"not graded through an export: {error}")
            return []


def export(task: LoadedTask, checkpoint: Path, folder: Path, half: bool = False) -> str:
    """Export a policy with its trained config. Returns a message about the files."""
    from legged_mw.export.exporter import export  # onnx takes long to import

    return export(task, checkpoint, folder, half).text(folder)


def exam() -> None:
    """Grade a policy, and compare with an earlier result. A run without an export is exported first."""
    from legged_mw.deploy.gate import main

    def make(name: str, checkpoint: int, folder: Path) -> None:
        from legged_mw.rl.policies import find_trained
        from legged_mw.rl.run_folder import logs_folder

        source, task = find_trained(name, logs_folder(), "exam", checkpoint=checkpoint)
        export(task, source.checkpoint, folder)

    with one_line_errors(fewer=FEWER_WORLDS):
        main(make)


def _main_of(name: str, fewer: str = "") -> Callable[[], None]:
    """The program in ``main`` of a module. ``fewer``: see ``one_line_errors``."""

    def start() -> None:
        with one_line_errors(fewer=fewer):
            import_module(name).main()

    return start


def completion() -> None:
    """Print the Tab completion for bash or zsh."""
    from legged_mw.tools.completion import main

    with one_line_errors():
        main(PROGRAMS)


PROGRAMS: dict[str, Callable[[], None]] = {
    "train": train,
    "play": play,
    "deploy": _main_of("legged_mw.deploy.__main__", FEWER_WORLDS),
    "exam": exam,
    "fit": _main_of("legged_mw.deploy.fit"),
    "robot": _main_of("legged_mw.robot.__main__"),
    "motion": _main_of("legged_mw.motion.__main__"),
    "doctor": _main_of("legged_mw.tools.doctor"),
    "compare": _main_of("legged_mw.tools.compare"),
    "sweep": _main_of("legged_mw.tools.sweep"),
    "warm": _main_of("legged_mw.tools.warm"),
    "completion": completion,
}
HELP = """legged-mw PROGRAM ...; each has --help, e.g. legged-mw train --help
  train       train a task: legged-mw train --task go1_flat
  play        watch, grade or export a policy
  deploy      run an exported policy without torch
  exam        grade a policy, and compare with an earlier result
  fit         a robot's own numbers, from the log of its chirp
  robot       a robot's health page, and a first task for it
  motion      read and look at reference motions
  doctor      what this machine has, lacks and how fast it trains
  compare     figures, exams and settings of runs side by side
  sweep       train over seeds and values, with a table at the end
  warm        compile kernels ahead of the first training
  completion  the Tab key for bash and zsh"""


def main() -> None:
    """``legged-mw NAME ...``"""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name in ("-h", "--help"):
        print(HELP)
        return
    if name == "--version":
        from importlib.metadata import PackageNotFoundError, version

        try:
            print(f"legged_mw {version('legged_mw')}")
        except PackageNotFoundError:
            print("legged_mw, on the path but not installed")
        return
    if name not in PROGRAMS:
        close = difflib.get_close_matches(name, PROGRAMS, n=1)
        hint = f", did you mean {close[0]!r}? " if close else "; "
        problem = f"no program {name!r}{hint}" if name else ""
        fail("legged-mw", f"{problem}there are: {', '.join(PROGRAMS)}; e.g. legged-mw train --task go1_flat")
    sys.argv = [f"legged-mw {name}", *sys.argv[2:]]
    PROGRAMS[name]()


if __name__ == "__main__":
    main()
