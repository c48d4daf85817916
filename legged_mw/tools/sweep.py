"""legged-mw sweep --task NAME --seeds 1,2,3 --set a.b=1,2,3: one training after another, and a table of them at the end.

Several values, apart by commas, make a training each; of several such fields every combination is trained. A list keeps its
commas: --set actor.hidden_dims=[64,64],[128,128]. All other flags are those of train.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from datetime import datetime
from itertools import product
from statistics import mean, stdev
from typing import NamedTuple

from legged_mw.tools.compare import MOST, rows, text_table, write
from legged_mw.tools.curves import Run, find_runs
from legged_mw.utils.cli import Parser
from legged_mw.utils.errors import shown

STOPPED = 3  # exit code of a training that a signal ended: rl/training.py's
Start = Callable[[list[str]], tuple[int, str, str]]  # flags of train -> exit code, run folder or "", last line


class Cell(NamedTuple):
    """One training: what is varied in it, field -> value."""

    varied: dict[str, str]
    flags: list[str]

    @property
    def name(self) -> str:
        return " ".join(f"{path.rpartition('.')[2]}={value}" for path, value in self.varied.items())


def parse() -> tuple[argparse.Namespace, list[str]]:
    about, _, more = (__doc__ or "").partition("\n\n")
    parser = Parser(prog="legged-mw sweep", description=f"{about} {more}", allow_abbrev=False)
    parser.add_argument("--task", metavar="NAME", required=True, help="a task, or the path of a config file")
    parser.add_argument("--seeds", metavar="N,N,...", default="", help="seeds, each a training")
    parser.add_argument("--set", action="append", default=[], metavar="PATH=V,V,...", help="a config field and its values")
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
    print(f"{len(cells)} trainings of {args.task}: {'; '.join(cell.name or 'as it is' for cell in cells)}", flush=True)
    found = train_all(cells, ["--task", args.task, *rest], start)
    if found:
        print(f"\n{table(found)}")
        if 1 < len(found) <= MOST:
            page = found[0][1].folder.parent / f"sweep_{datetime.now():%Y-%m-%d_%H-%M-%S}.html"
            write([run for _, run in found], page)
            print(f"\ncurves: {shown(page)}")
    if len(found) < len(cells):
        raise SystemExit(1)


def values(text: str) -> list[str]:
    """Split at commas that stand in no brackets and no quotes."""
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
    """Every combination; the seeds change fastest."""
    axes = [[(path, value) for value in values(text) or [""]] for path, _, text in (item.partition("=") for item in settings)]
    axes += [[("seed", seed) for seed in seeds]] if seeds else []
    cells = []
    for choice in product(*axes):
        varied = {path: value for (path, value), axis in zip(choice, axes, strict=True) if len(axis) > 1 or path == "seed"}
        flags = [text for path, value in choice for text in ("--set", f"{path}={value}")]
        cells.append(Cell(varied, flags))
    return cells


def train_all(cells: Sequence[Cell], common: list[str], start: Start) -> list[tuple[Cell, Run]]:
    """Train each; one that fails is said and left out, and Ctrl-C ends the sweep after the training that it stops."""
    found = []
    for number, cell in enumerate(cells, 1):
        label = re.sub(r"[^\w.=-]+", "_", cell.name).strip("_")
        code, folder, said = start([*common, *cell.flags, *(["--run_name", label] if label else [])])
        ended = bool(folder) and code in (0, STOPPED)
        print(f"{number}/{len(cells)} {cell.name or 'as it is'}: {folder if ended else said}", flush=True)
        if ended:
            found.append((cell, find_runs([folder])[0]))
        if code == STOPPED:
            break
    return found


def start(flags: list[str]) -> tuple[int, str, str]:
    """``legged-mw train`` in a process of its own; in a terminal its last line is shown meanwhile."""
    command = [sys.executable, "-m", "legged_mw.programs", "train", *flags]
    folder, said, line, live = "", "", "", sys.stdout.isatty()
    with (
        tempfile.TemporaryFile("w+") as errors,
        subprocess.Popen(command, stdout=-1, stderr=errors, text=True, errors="replace") as process,
    ):
        assert process.stdout is not None
        while process.poll() is None or line:
            try:
                line = process.stdout.readline()
            except KeyboardInterrupt:  # the training got it too, and saves
                continue
            folder = line.removeprefix("writing to ").strip() if line.startswith("writing to ") else folder
            said = line.strip() if line.startswith("stopped: ") else said
            if live and line.startswith("Learning iteration"):
                print(f"\r\x1b[K{line.strip()[:100]}", end="", flush=True)
        errors.seek(0)
        last = (errors.read().strip().splitlines() or [""])[-1]
    print("\r\x1b[K" if live else "", end="")
    return process.returncode, folder, said or last


def table(found: Sequence[tuple[Cell, Run]]) -> str:
    """A line a training; where seeds were varied, below them the mean of each setting, and its standard deviation."""
    fields = list(dict.fromkeys(path for cell, _ in found for path in cell.varied))
    (_, *heads), *lines = rows([run for _, run in found])
    short = [path.rpartition(".")[2] for path in fields]
    cells = [[*(cell.varied.get(path, "") for path in fields), *line] for (cell, _), (_, *line) in zip(found, lines, strict=True)]
    means = []
    if "seed" in fields:
        groups: dict[tuple[str, ...], list[list[str]]] = {}
        for line in cells:
            groups.setdefault(tuple(line[: len(fields) - 1]), []).append(line[len(fields) :])
        means = [[*group, f"mean of {len(of)}", *map(_mean, zip(*of, strict=True))] for group, of in groups.items() if len(of) > 1]
    return text_table([[*short, *heads], *cells, *means])


def _mean(texts: Sequence[str]) -> str:
    try:
        numbers = [float(text.replace(",", "")) for text in texts]
    except ValueError:  # "-": not all have it
        return "-"
    digits = max(len(text.partition(".")[2]) for text in texts)
    return f"{mean(numbers):.{digits}f} ± {stdev(numbers):.{digits}f}"
