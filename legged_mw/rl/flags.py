"""The flags of train.py. They are parsed before the import of torch, so that --help and errors print at once."""

from __future__ import annotations

import argparse
import time

from legged_mw.utils.cli import duration, make_parser, positive
from legged_mw.utils.files import writable
from legged_mw.utils.task import task_names


def parse(description: str | None, argv: list[str] | None = None) -> argparse.Namespace:
    """The flags of training, from ``argv`` or the command line."""
    parser = make_parser(description)
    parser.add_argument(
        "--max_iterations", type=positive, metavar="N", help="train until this iteration, resumed or not"
    )
    parser.add_argument("--run_name", metavar="NAME", help="appended to the run folder's name")
    parser.add_argument("--resume", action="store_true", help="go on with the last run, or the one of --load_run")
    source = "its run, checkpoint or export, or a task for its last or shipped policy"
    parser.add_argument(
        "--teacher", metavar="RUN", help=f"distil: imitate a policy that may have more observations; {source}"
    )
    parser.add_argument("--init", metavar="RUN", help="begin with the actor of another policy, named as a teacher is")
    parser.add_argument(
        "--headless", action="store_true", help="accepted as in legged_gym; training never opens a window"
    )
    parser.add_argument(
        "--max_time", type=duration, metavar="T", help="be done, annealed, after 90s, 5m, 1.5h ... or --max_iterations"
    )
    parser.add_argument(
        "--play", action="store_true", help="watch the policy as it trains: a window, or a web page without a screen"
    )
    parser.add_argument("--list", action="store_true", help="show the tasks and exit")
    parser.add_argument("--check", action="store_true", help="describe the task and exit")
    parser.add_argument(
        "--picture", metavar="PNG", help="with --check: the robot's health page too, and a picture of the robot"
    )
    args = parser.parse_args(argv)
    if args.picture is not None:
        writable(args.picture, "--picture", suffix=".png")
        if not args.check:
            parser.error("--picture draws what --check shows: add --check")
    if not args.list:
        require_task(args, parser)
    if not args.resume and (args.load_run is not None or args.checkpoint != -1):
        parser.error("--load_run and --checkpoint select what to resume: add --resume")
    if args.resume and (args.teacher is not None or args.init is not None):
        parser.error("--resume keeps the teacher and start of the run: leave --teacher and --init out")
    args.deadline = time.time() + args.max_time if args.max_time else None
    return args


def require_task(args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """If ``--task`` is missing, take the task of the run at the path ``--load_run``."""
    if not args.task and args.load_run:
        from legged_mw.rl.run_folder import task_at  # imports torch

        args.task = task_at(args.load_run)
    if not args.task:
        parser.error(
            f"--task is missing, and --load_run is no path of a run that would say it; tasks: {', '.join(task_names())}"
        )
