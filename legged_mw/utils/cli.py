"""What the programs share on the command line: flags, one-line errors, durations, seeds. Imports without torch and numpy."""

from __future__ import annotations

import argparse
import difflib
import random
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from ctypes import ArgumentError
from pathlib import Path
from typing import Any, NoReturn

from legged_mw.utils.config import ConfigError, fit, load_yaml
from legged_mw.utils.console import patient_console
from legged_mw.utils.errors import UserError, in_short, out_of_memory, printable, users_fault
from legged_mw.utils.task import LoadedTask

FEWER_WORLDS = "; fewer worlds need less: try half with --num_envs"  # of the programs that have the flag


class Parser(argparse.ArgumentParser):
    """argparse, but a mistake is one line and exit code 2; every program has --verbose."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_argument(
            "--verbose",
            action="store_true",
            help="say more: the whole traceback of an error; all numbers of an iteration while training",
        )

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse's, but a flag that does not exist is answered with the nearest one."""
        found, unknown = self.parse_known_args(args, namespace)
        if unknown:
            flags = [word.partition("=")[0] for word in unknown if word.startswith("-")]
            near = [
                close[0]
                for flag in flags
                if (close := difflib.get_close_matches(flag, self._option_string_actions, n=1))
            ]
            hint = f"; did you mean {', '.join(near)}?" if near else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return found

    def error(self, message: str) -> NoReturn:
        fail(self.prog, f"{message if len(message) <= 500 else f'{message[:500]}...'} (--help lists the flags)")


def make_parser(description: str | None) -> Parser:
    """A parser with the flags that both programs know, under legged_gym's names."""
    parser = Parser(description=description, allow_abbrev=False)
    parser.add_argument("--task", metavar="NAME", help="a task in configs/, or the path of a config file")
    parser.add_argument("--num_envs", type=positive, metavar="N", help="worlds stepped together")
    parser.add_argument("--seed", type=int, metavar="N", help="of everything random; -1 draws one")
    parser.add_argument("--experiment_name", metavar="NAME", help="folder below logs/ (default: the task's name)")
    parser.add_argument("--load_run", metavar="RUN", help="run to load: its name or path; -1 is the one last trained")
    parser.add_argument("--checkpoint", type=int, default=-1, metavar="N", help="iteration to load; -1 is the newest")
    parser.add_argument("--device", metavar="D", help="cuda:0, cpu, ... (default: the GPU if there is one)")
    parser.add_argument(
        "--engine", metavar="E", help="physics: mujoco (CPU), mujoco_warp (GPU, or slowly CPU) or auto, the default"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="override a config field: env.num_envs=64"
    )
    parser.add_argument(
        "--override", action="append", default=[], metavar="FILE", help="override config fields from a YAML file"
    )
    parser.add_argument("--eager", action="store_true", help="record nothing, launch every kernel: slow, for debugging")
    return parser


def apply_overrides(task: LoadedTask, args: argparse.Namespace) -> None:
    """Files first, then single fields, then flags: the more specific wins."""
    for file in args.override:
        task.update(load_yaml(file), where=f"--override {file}")
    for item in args.set:
        path, equals, value = item.partition("=")
        if not equals:
            raise ConfigError(f"--set {item}: write it as path=value, e.g. rewards.scales.torques=-1e-4")
        task.set(path.strip(), value.strip(), where=f"--set {item}")
    flags = {"num_envs": "env.num_envs", "seed": "seed", "engine": "sim.engine"}
    flags |= {"teacher": "distillation.teacher", "init": "warm_start.policy"}
    flags |= {name: f"runner.{name}" for name in ("max_iterations", "experiment_name", "run_name")}
    for flag, path in flags.items():
        value = getattr(args, flag, None)
        if value is not None:
            task.set(path, value, where=f"--{flag}")
    if task.train.seed < 0:
        task.train.seed = random.SystemRandom().randrange(2**31)


def pick_device(asked: str | None) -> str:
    """The device asked for, or the best there is; a clear error for one that is not there."""
    import torch  # here alone: legged_mw.deploy shares this file, and runs where torch is not installed

    if asked is None:
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    if re.fullmatch(r"cuda(:\d+)?", asked):
        index = int(asked.partition(":")[2] or 0)
        if index < torch.cuda.device_count():
            return f"cuda:{index}"
        raise ConfigError(
            f"--device {asked}: this machine has {torch.cuda.device_count()} CUDA devices; use --device cpu"
        )
    if asked != "cpu":
        raise ConfigError(f"--device {asked}: say cpu, cuda, or cuda:<index>")
    return asked


def seed_everything(seed: int) -> None:
    """Seed Python, numpy and torch on every device."""
    import numpy as np
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def positive(text: str) -> int:
    """A whole number from 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value} is not a positive number")
    return value


def number(kind: Any) -> Callable[[str], Any]:
    """For argparse: a number of the type ``kind``, a bound of utils/bounds.py or a bare type."""

    def read(text: str) -> Any:
        try:
            return fit(float(text), kind, "the value")
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def duration(text: str) -> float:
    """Seconds in "90", "90s", "5m" or "1.5h", for argparse; at most some thirty years, which every clock can hold."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh]?)", text)
    seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"'{text[:60]}' is no duration; write 90s, 5m or 1.5h")
    return seconds


@contextmanager
def one_line_errors(program: str = "", fewer: str = "") -> Iterator[None]:
    """Turn mistakes of the user, in what was asked or in code of their own, into one line and exit code 2; with --verbose all of it.

    Memory that runs out becomes that, with the advice ``fewer``, Ctrl-C a word and code 130. A mistake of ours stays a traceback.
    What is printed inside may find no reader, as in ``| head``, and ends nothing.
    """
    program = program or Path(sys.argv[0]).name
    try:
        with patient_console():
            yield
    except UserError as error:
        _show_all()
        fail(program, str(error))
    except (KeyboardInterrupt, ArgumentError) as error:  # ctypes wraps one that comes while it converts an argument
        if "KeyboardInterrupt" not in repr(error):
            raise
        print(f"\n{program}: stopped", file=sys.stderr)
        raise SystemExit(130) from None
    except (RuntimeError, MemoryError) as error:
        first: BaseException = error
        while first.__context__ is not None:
            first = first.__context__  # what ran out may show as the failure of what it interrupted
        if not out_of_memory(first) and not out_of_memory(error):
            _blame_user(program, error)
            raise
        fail(program, f"out of memory ({(str(first) or 'memory').splitlines()[0]}){fewer}")
    except Exception as error:
        _blame_user(program, error)
        raise


def _blame_user(program: str, error: Exception) -> None:
    """Fail with the user's own lines, if some of them led to ``error``."""
    if where := users_fault(error):
        _show_all()
        fail(program, f"{where}: {in_short(error)}; --verbose shows the whole traceback")


def _show_all() -> None:
    if "--verbose" in sys.argv:
        traceback.print_exc()


def fail(program: str, message: str) -> NoReturn:
    """One line on standard error, exit code 2."""
    with suppress(OSError):  # nobody may be there to read it
        print(f"{program}: {printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    raise SystemExit(2)


def command(program: str, processes: int = 1) -> str:
    """How the user starts ``train`` or ``play``: as the script of a clone, or as ``legged-mw train``."""
    installed = Path(sys.argv[0]).name.startswith("legged-mw")
    if processes > 1:
        return f"torchrun --nproc_per_node={processes} " + (
            f"-m legged_mw.programs {program}" if installed else f"{program}.py"
        )
    return f"legged-mw {program}" if installed else f"python {program}.py"
