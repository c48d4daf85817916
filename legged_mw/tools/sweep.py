"""legged-mw sweep --task NAME --seeds 1,2,3 --set a.b=1,2,3: one training after another, and a table of them at the end.

Several values, apart by commas, make a training each; of several such fields every combination is trained. A list keeps its
commas: --set actor.hidden_dims=[64,64],[128,128]. All other flags are those of train.
"""

from __future__ import annotations

import argparse
import ctypes
import math
import os
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from itertools import product
from statistics import mean, stdev
from typing import NamedTuple

from legged_mw.rl import flags
from legged_mw.tools.compare import Run, curves_of, figures, find_runs, rows, text_table
from legged_mw.utils.cli import Parser, apply_overrides
from legged_mw.utils.task import load_task

STOPPED = 3  # exit code of a training run that a signal ended, from rl/training.py
TRAIN = [sys.executable, "-m", "legged_mw.programs", "train"]
_PDEATHSIG = 1  # option of Linux's prctl
Start = Callable[[list[str]], tuple[int, str, str]]  # flags of train -> exit code, run folder or "", last line


class Cell(NamedTuple):
    """One training run: its varied fields, field -> value."""

    varied: dict[str, str]
    flags: list[str]

    @property
    def name(self) -> str:
        return " ".join(f"{path.rpartition('.')[2]}={value}" for path, value in self.varied.items())


class Stop:
    """Ends the sweep at a signal. The current training run gets SIGTERM, so that it saves."""

    def __init__(self) -> None:
        self.asked = False
        self.training: subprocess.Popen[str] | None = None

    def listen(self) -> None:
        """Handle Ctrl-C, SIGTERM and SIGHUP, except signals that are ignored, as under nohup."""
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            number = getattr(signal, name, None)  # Windows has no SIGHUP
            if number and signal.getsignal(number) is not signal.SIG_IGN:
                signal.signal(number, self)

    def __call__(self, *_: object) -> None:
        first, self.asked = not self.asked, True
        # send it once: a closing terminal sends SIGHUP twice, and a second SIGTERM would stop the run at once
        if first and self.training:
            self.training.terminate()


def parse() -> tuple[argparse.Namespace, list[str]]:
    about, _, more = (__doc__ or "").partition("\n\n")
    parser = Parser(prog="legged-mw sweep", description=f"{about} {more}", allow_abbrev=False)
    parser.add_argument("--task", metavar="NAME", required=True, help="a task, or the path of a config file")
    parser.add_argument("--seeds", metavar="N,N,...", default="", help="seeds, each a training")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=V,V,...", help="a config field and its values"
    )
    args, rest = parser.parse_known_args()
    for flag in ("--run_name", "--resume", "--load_run", "--list", "--check", "--play"):
        if any(text.partition("=")[0] == flag for text in rest):
            parser.error(f"{flag} is of one training: leave it out")
    if not all(re.fullmatch(r"\d+", seed) for seed in values(args.seeds)):
        parser.error(f"--seeds {args.seeds}: write whole numbers apart by commas: --seeds 1,2,3")
    return args, rest


def main() -> None:
    args, rest = parse()
    cells = make_cells(args.set, values(args.seeds))
    check(cells, ["--task", args.task, *rest])
    print(f"{len(cells)} trainings of {args.task}: {'; '.join(cell.name or 'as it is' for cell in cells)}", flush=True)
    stop = Stop()
    stop.listen()
    found = train_all(cells, ["--task", args.task, *rest], partial(start, stop=stop), stop)
    if found:
        print(f"\n{table(found)}\n\n{curves_of([run for _, run in found])}")
    if len(found) < len(cells):
        raise SystemExit(1)


def values(text: str) -> list[str]:
    """Split at commas outside brackets and quotes."""
    parts, depth, quote = [""] if text else [], 0, ""
    for letter in text:
        quote = "" if letter == quote else letter if letter in "\"'" and not quote else quote
        depth += 0 if quote else (letter in "[{(") - (letter in "]})")
        if letter == "," and depth == 0 and not quote:
            parts.append("")
        else:
            parts[-1] += letter
    return [part.strip() for part in parts]


def make_cells(settings: Sequence[str], seeds: Sequence[str]) -> list[Cell]:
    """All combinations. The seed varies fastest."""
    axes = [
        [(path, value) for value in values(text) or [""]]
        for path, _, text in (item.partition("=") for item in settings)
    ]
    axes += [[("seed", seed) for seed in seeds]] if seeds else []
    cells = []
    for choice in product(*axes):
        varied = {
            path: value for (path, value), axis in zip(choice, axes, strict=True) if len(axis) > 1 or path == "seed"
        }
        flags = [text for path, value in choice for text in ("--set", f"{path}={value}")]
        cells.append(Cell(varied, flags))
    return cells


def check(cells: Sequence[Cell], common: list[str]) -> None:
    """Parse all flags and values once, as train does. Raises UserError, or ends the program, for an invalid one."""
    args = flags.parse(None, common)
    args.set += dict.fromkeys(text for cell in cells for text in cell.flags if text != "--set")
    apply_overrides(load_task(args.task, say=True), args)


def train_all(cells: Sequence[Cell], common: list[str], start: Start, stop: Stop) -> list[tuple[Cell, Run]]:
    """Train all cells. Report and skip a failed run. A signal stops the current run and then the sweep."""
    found = []
    for number, cell in enumerate(cells, 1):
        if stop.asked:
            break
        label = re.sub(r"[^\w.=-]+", "_", cell.name).strip("_")
        code, folder, said = start([*common, *cell.flags, *(["--run_name", label] if label else [])])
        ended = bool(folder) and code in (0, STOPPED)
        print(f"{number}/{len(cells)} {cell.name or 'as it is'}: {folder if ended else said}", flush=True)
        if ended:
            found.append((cell, find_runs([folder])[0]))
        if code == STOPPED:
            break
    return found


def start(flags: list[str], stop: Stop) -> tuple[int, str, str]:
    """Run ``legged-mw train`` in a child process that ends with this one. A terminal shows its last line."""
    folder, said, live = "", "", sys.stdout.isatty()
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(
            [*TRAIN, *flags], stdout=-1, stderr=errors, text=True, errors="replace", preexec_fn=_end_with(os.getpid())
        ) as process,
    ):
        stop.training = process
        if stop.asked:  # a signal came before the process started
            process.terminate()
        assert process.stdout is not None
        for line in process.stdout:
            folder = line.removeprefix("writing to ").strip() if line.startswith("writing to ") else folder
            said = line.strip() if line.startswith("stopped: ") else said
            if live and line.startswith("Learning iteration"):
                print(f"\r\x1b[K{line.strip()[:100]}", end="", flush=True)
        process.wait()
        stop.training = None
        errors.seek(0)
        last = (errors.read().strip().splitlines() or [""])[-1]
    print("\r\x1b[K" if live else "", end="")
    return process.returncode, folder, said or last


def _end_with(parent: int) -> Callable[[], object] | None:
    """The first function of a child, so that it gets SIGTERM at any end of ``parent``. None if not on Linux."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl

    def first() -> None:
        prctl(_PDEATHSIG, int(signal.SIGTERM))
        if os.getppid() != parent:  # the parent has already ended
            os._exit(1)

    return first


def table(found: Sequence[tuple[Cell, Run]]) -> str:
    """One line per run. With several seeds, then mean and standard deviation for each setting."""
    fields = list(dict.fromkeys(path for cell, _ in found for path in cell.varied))
    (_, *heads), *lines = rows(runs := [run for _, run in found])
    short = [path.rpartition(".")[2] for path in fields]
    settings = [[cell.varied.get(path, "") for path in fields] for cell, _ in found]
    cells = [[*setting, *line] for setting, (_, *line) in zip(settings, lines, strict=True)]
    means = []
    if "seed" in fields:
        groups: dict[tuple[str, ...], list[int]] = {}
        for i, setting in enumerate(settings):
            groups.setdefault(tuple(setting[:-1]), []).append(i)
        columns = figures(runs).values()
        for group, of in groups.items():
            if len(of) > 1:
                figured = [_mean(digits, [values[i] for i in of]) for digits, values in columns]
                means.append([*group, f"mean of {len(of)}", *figured])
    return text_table([[*short, *heads], *cells, *means])


def _mean(digits: str, values: Sequence[float | None]) -> str:
    """Mean and standard deviation as text; "-" if a value is missing.

    It has the figure's ``digits``, or more to show two digits of the deviation.
    """
    numbers = [value for value in values if value is not None and math.isfinite(value)]
    if len(numbers) < len(values):
        return "-"
    spread = stdev(numbers)
    needed = 1 - math.floor(math.log10(spread)) if spread > 0 else 0
    places = max(int(digits.strip(",.df") or 0), min(needed, 6))
    return f"{mean(numbers):.{places}f} ± {spread:.{places}f}"
