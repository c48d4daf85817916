"""legged-mw compare RUN RUN ...: figures, exams and settings of runs side by side. TensorBoard draws their curves."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from legged_mw.utils.cli import Parser
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import shown
from legged_mw.utils.files import typed

CONFIG_FILE = "config.yaml"
PAUSE = 60.0  # [s] ours: a longer iteration includes a pause, such as before a resume
FIRST_TOOK = ("Perf/collection_time", "Perf/learning_time")  # [s] of an iteration
AXES, AXES_OF = ("vx", "vy", "yaw rate"), ("error", "worst", "offset")
REPORT = "eval/report.json"  # written by play --eval into the run's folder
LONGEST = 40  # [characters] longest setting in a table


class Run(NamedTuple):
    """A run: its settings by dotted path, and the last values of its curves by name."""

    name: str
    folder: Path
    settings: dict[str, Any]
    last: dict[str, float]
    iterations: int
    seconds: float  # [s] of training, without pauses
    graded: dict[str, float]  # figures of the whole exam; empty without one


def main() -> None:
    parser = Parser(prog="legged-mw compare", description=__doc__, allow_abbrev=False)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a run's path, TASK/RUN, or a task for its last run")
    runs = find_runs(parser.parse_args().runs)
    print(text_table(rows(runs)))
    if exam := exam_rows(runs):
        print(f"\nthe whole exam\n{text_table([['', *(run.name for run in runs)], *exam])}")
    if settings := differing_settings(runs):
        print(f"\nsettings that differ\n{text_table([['', *(run.name for run in runs)], *settings])}")
    print(f"\n{curves_of(runs)}")


def curves_of(runs: Sequence[Run]) -> str:
    """The command that draws the curves of the runs."""
    together = Path(os.path.commonpath([run.folder.resolve() for run in runs]))
    return f"curves: {shlex.join(['tensorboard', '--logdir', shown(together)])}"


# ---- a run's files


def find_runs(names: list[str]) -> list[Run]:
    """The runs with these names: a path, TASK/RUN, or a task for its last run. Raises ConfigError."""
    folders = [_find(name) for name in names]
    together = [folder.resolve().parent for folder in folders]
    alone = len({folder.name for folder in folders}) == len(folders) and len(set(together)) == 1
    return [
        read_run(folder, folder.name if alone else f"{folder.resolve().parent.name}/{folder.name}")
        for folder in folders
    ]


def _find(name: str) -> Path:
    path, logs = typed(name), Path.cwd() / "logs"
    for folder in (path, logs / name):
        if _events(folder):
            return folder
        if newest := sorted(
            (run for run in folder.glob("*") if _events(run)), key=lambda run: _events(run)[-1].stat().st_mtime_ns
        ):
            return newest[-1]
    raise ConfigError(
        f"no run with curves at {shown(path)} or in {shown(logs / name)}; name it by its path, as TASK/RUN, or by its task"
    )


def _events(folder: Path) -> list[Path]:
    return sorted(folder.glob("events.out.tfevents.*"), key=lambda file: file.stat().st_mtime_ns)


def read_run(folder: Path, name: str) -> Run:
    """A run's figures. If a resumed run repeated an iteration, the later values count."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # takes 0.5 s to import

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    curves = {tag: {event.step: event for event in events.Scalars(tag)} for tag in events.Tags()["scalars"]}
    last = {tag: points[max(points)].value for tag, points in curves.items()}
    timed = curves.get("Perf/total_fps", {})
    walls = [timed[step].wall_time for step in sorted(timed)]
    # no other iteration precedes the first one
    first = sum(curves[part][min(curves[part])].value for part in FIRST_TOOK if part in curves)
    took = [first, *(max(0.0, after - before) for before, after in pairwise(walls))]
    settings = dict(_flat(load_yaml(folder / CONFIG_FILE))) if (folder / CONFIG_FILE).is_file() else {}
    seconds = sum(spent for spent in took if spent < PAUSE)
    return Run(name, folder, settings, last, max(timed, default=0), seconds, _graded(folder / REPORT))


def _graded(report: Path) -> dict[str, float]:
    """The numeric figures of the exam in a report; empty without a report."""
    try:
        exam = dict(json.loads(report.read_text(encoding="utf-8"))["columns"][0]["exam"])
    except (OSError, ValueError, LookupError, TypeError):
        return {}
    values = dict(_flat({name: each for name, each in exam.items() if name != "rules"}))
    axes = {
        f"{path} {axis}": each
        for path, value in values.items()
        if path in AXES_OF
        for axis, each in zip(AXES, value, strict=False)
    }
    return {path: float(value) for path, value in {**values, **axes}.items() if isinstance(value, int | float)}


def _flat(values: Any, path: str = "") -> list[tuple[str, Any]]:
    """(dotted path, value) of all leaves. A list is a leaf."""
    if isinstance(values, dict):
        return [leaf for key, item in values.items() for leaf in _flat(item, f"{path}.{key}" if path else str(key))]
    return [(path, values)]


# ---- tables


def figures(runs: Sequence[Run]) -> dict[str, tuple[str, list[float | None]]]:
    """Training times and last figures of ``runs``: name -> (number format, one value per run)."""
    exams = dict.fromkeys(name for run in runs for name in run.last if name.startswith("Exam/"))
    last = {"steps/s": ("Perf/total_fps", ",.0f"), "reward": ("Train/mean_reward", ".2f")}
    last |= {name.removeprefix("Exam/"): (name, ".3f") for name in exams}
    steps = [run.last.get("Train/total_steps") for run in runs]
    return {
        "iterations": ("d", [run.iterations for run in runs]),
        "M steps": (".1f", [None if total is None else total / 1e6 for total in steps]),
        "minutes": (".1f", [run.seconds / 60 for run in runs]),
        **{head: (digits, [run.last.get(name) for run in runs]) for head, (name, digits) in last.items()},
    }


def rows(runs: Sequence[Run]) -> list[list[str]]:
    """A header, then one row per run: its name and its ``figures``."""
    found = figures(runs)
    columns = [["-" if value is None else f"{value:{digits}}" for value in values] for digits, values in found.values()]
    return [["run", *found], *([run.name, *line] for run, *line in zip(runs, *columns, strict=True))]


def exam_rows(runs: Sequence[Run]) -> list[list[str]]:
    """One row per figure of the whole exam: its name, and its value of each run."""
    names = dict.fromkeys(name for run in runs for name in run.graded)
    return [[name, *(f"{run.graded[name]:.3g}" if name in run.graded else "-" for run in runs)] for name in names]


def differing_settings(runs: Sequence[Run]) -> list[list[str]]:
    """One row per setting in which the runs differ: its dotted path, and its value of each run."""
    table = []
    for path in dict.fromkeys(path for run in runs for path in run.settings if path != "runner.run_name"):
        values = [run.settings.get(path) for run in runs]
        if any(value != values[0] for value in values):
            table.append([path, *map(_cell, values)])
    return table


def _cell(value: object) -> str:
    text = "-" if value is None else " ".join(str(value).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def text_table(lines: Sequence[Sequence[str]]) -> str:
    """``lines`` of cells as text for a terminal. The first line is the header."""
    first, *widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    cells = [[cell.rjust(width) for cell, width in zip(line[1:], widths, strict=True)] for line in lines]
    return "\n".join("  ".join([line[0].ljust(first), *right]) for line, right in zip(lines, cells, strict=True))
