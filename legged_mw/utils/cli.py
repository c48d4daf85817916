"""Functions for all programs: flags, one-line errors, durations, seeds. The module imports no torch and no numpy."""

from __future__ import annotations

import argparse
import difflib
import errno
import os
import random
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from ctypes import ArgumentError
from pathlib import Path
from typing import Any, NoReturn, TextIO

from legged_mw.utils.config import ConfigError, fit, load_yaml
from legged_mw.utils.errors import UserError, in_short, out_of_memory, printable, users_fault
from legged_mw.utils.task import LoadedTask

FIELDS = {  # flag of train or play -> the config field that it sets
    **{"num_envs": "env.num_envs", "seed": "seed", "engine": "sim.engine"},
    **{"teacher": "distillation.teacher", "init": "warm_start.policy"},
    **{name: f"runner.{name}" for name in ("max_iterations", "experiment_name", "run_name")},
}
FEWER_WORLDS = "; fewer worlds need less: try half with --num_envs"  # for programs with this flag


class Parser(argparse.ArgumentParser):
    """argparse's parser with errors of one line and exit code 2, and with --verbose."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.add_argument(
            "--verbose",
            action="store_true",
            help="say more: the whole traceback of an error; all numbers of an iteration while training",
        )

    def parse_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse's method, but the error for an unknown flag names the nearest flag."""
        found, unknown = self.parse_known_args(args, namespace)
        if unknown:
            flags = [word.partition("=")[0] for word in unknown if word.startswith("-")]
            known = self._option_string_actions
            near = [name for flag in flags for name in difflib.get_close_matches(flag, known, n=1)]
            hint = f"; did you mean {', '.join(near)}?" if near else ""
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return found

    def error(self, message: str) -> NoReturn:
        fail(self.prog, f"{message if len(message) <= 500 else f'{message[:500]}...'} (--help lists the flags)")


def make_parser(description: str | None) -> Parser:
    """A parser with the common flags of train and play, with legged_gym's names."""
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
    """Apply --override, then --set, then flags of single fields. Later ones override earlier ones."""
    for file in args.override:
        task.update(load_yaml(file), where=f"--override {file}")
    for item in args.set:
        path, equals, value = item.partition("=")
        if not equals:
            raise ConfigError(f"--set {item}: write it as path=value, e.g. rewards.scales.torques=-1e-4")
        task.set(path.strip(), value.strip(), where=f"--set {item}")
    for flag, path in FIELDS.items():
        value = getattr(args, flag, None)
        if value is not None:
            task.set(path, value, where=f"--{flag}")
    if task.train.seed < 0:
        task.train.seed = random.SystemRandom().randrange(2**31)


def pick_device(name: str | None) -> str:
    """The device ``name``; None: the first GPU, or the CPU. Raises ConfigError if it does not exist."""
    import torch  # here, because legged_mw.deploy imports this file and runs without torch

    if name is None:
        return "cuda:0" if torch.cuda.is_available() else "cpu"
    if re.fullmatch(r"cuda(:\d+)?", name):
        index = int(name.partition(":")[2] or 0)
        if index < torch.cuda.device_count():
            return f"cuda:{index}"
        have = f"this machine has {torch.cuda.device_count()} CUDA devices"
        raise ConfigError(f"--device {name}: {have}; use --device cpu")
    if name != "cpu":
        raise ConfigError(f"--device {name}: say cpu, cuda, or cuda:<index>")
    return name


def seed_everything(seed: int) -> None:
    """Seed Python, numpy and torch on every device."""
    import numpy as np
    import torch

    random.seed(seed)
    np.random.seed(seed % 2**32)
    torch.manual_seed(seed)


def positive(text: str) -> int:
    """A positive whole number, for argparse."""
    if not re.fullmatch(r"\+?[\d_]+", text, re.ASCII) or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive whole number")
    return int(text)


def number(kind: Any) -> Callable[[str], Any]:
    """A function that parses a number for argparse. ``kind``: a type of utils/bounds.py, int or float."""

    def read(text: str) -> Any:
        try:
            return fit(float(text), kind, "the value")
        except ConfigError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return read


def duration(text: str) -> float:
    """Parse "90", "90s", "5m" or "1.5h" to seconds, for argparse; less than 1e9 s."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh]?)", text)
    seconds = float(match[1]) * {"": 1, "s": 1, "m": 60, "h": 3600}[match[2]] if match else 0.0
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"'{text[:60]}' is no duration; write 90s, 5m or 1.5h")
    return seconds


@contextmanager
def one_line_errors(program: str = "", fewer: str = "") -> Iterator[None]:
    """A context that ends the program with one line and exit code 2 for an error in the user's request or code.

    --verbose adds the traceback. If memory runs out, the line ends with the advice ``fewer``. Ctrl-C gives code 130 if
    the program does not handle it; a training saves and ends with code 3 (rl/training.py). Errors of our own code stay
    tracebacks. If the console closes, as in ``| head``, the program continues.
    """
    program = program or Path(sys.argv[0]).name
    try:
        with patient_console():
            yield
    except UserError as error:
        _show_all()
        fail(program, str(error))
    except (KeyboardInterrupt, ArgumentError) as error:  # ctypes may wrap the former in the latter
        if "KeyboardInterrupt" not in repr(error):
            raise
        print(f"\n{program}: stopped", file=sys.stderr)
        raise SystemExit(130) from None
    except Exception as error:
        first: BaseException = error
        while first.__context__ is not None:
            first = first.__context__  # too little memory is often the cause of another error
        if isinstance(error, RuntimeError | MemoryError) and (out_of_memory(first) or out_of_memory(error)):
            fail(program, f"out of memory ({(str(first) or 'memory').splitlines()[0]}){fewer}")
        if where := users_fault(error):
            _show_all()
            fail(program, f"{where}: {in_short(error)}; --verbose shows the whole traceback")
        if isinstance(error, ModuleNotFoundError) and not f"{error.name}".startswith("legged_mw"):
            _show_all()
            fail(program, f"{error}; legged-mw doctor says how to install what is missing")
        raise


def _show_all() -> None:
    if "--verbose" in sys.argv:
        traceback.print_exc()


def fail(program: str, message: str) -> NoReturn:
    """Print one line to standard error and exit with code 2."""
    with suppress(OSError):  # it may be closed
        print(f"{program}: {printable(' '.join(message.split()))}", file=sys.stderr, flush=True)
    raise SystemExit(2)


def command(program: str, processes: int = 1) -> str:
    """The command that starts ``train`` or ``play``: ``python train.py`` in a clone, else ``legged-mw train``.

    ``processes``: of torchrun. On several nodes (``GROUP_WORLD_SIZE``) the user replaces N by the node's number.
    """
    installed = Path(sys.argv[0]).name.startswith("legged-mw")
    if processes > 1:
        script = f"-m legged_mw.programs {program}" if installed else f"{program}.py"
        if (nodes := int(os.environ.get("GROUP_WORLD_SIZE", "1"))) > 1:
            where = f"--nnodes={nodes} --node_rank=N --master_addr={os.environ.get('MASTER_ADDR', 'HOST')}"
            return f"torchrun {where} --nproc_per_node={processes // nodes} {script}"
        return f"torchrun --nproc_per_node={processes} {script}"
    return f"legged-mw {program}" if installed else f"python {program}.py"


# ---- a console that may close, as in | head: later prints are lost, the program continues ---------------------------


_GONE = (errno.EPIPE, errno.EIO, errno.EBADF)  # a closed pipe, a terminal that hung up, a closed descriptor


class SafeStream:
    """A stream that ignores failed writes."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        self._try(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def _try(self, call: Callable[..., object], *args: str) -> None:
        try:
            call(*args)
        except ValueError:  # the stream is closed
            return
        except OSError as error:
            if error.errno in _GONE:
                with suppress(OSError, ValueError):  # discard the buffer that Python flushes at exit
                    nowhere = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(nowhere, self._stream.fileno())
                    os.close(nowhere)


@contextmanager
def patient_console() -> Iterator[None]:
    """A context in which failed prints are ignored."""
    out, err = SafeStream(sys.stdout), SafeStream(sys.stderr)
    with redirect_stdout(out), redirect_stderr(err):  # type: ignore[type-var]
        try:
            yield
        finally:
            out.flush()
            err.flush()
