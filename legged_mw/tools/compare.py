"""legged-mw compare RUN RUN ...: curves and exams of runs in one page that needs nothing else."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterable, Sequence
from html import escape
from itertools import accumulate, groupby, pairwise
from pathlib import Path
from typing import Any, NamedTuple

from legged_mw.eval.page import CSS, table
from legged_mw.utils.cli import Parser
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import UserError, shown

# ---- the curves of a run, read from its TensorBoard files, and where a run that a user names lies


CONFIG_FILE = "config.yaml"
PAUSE = 60.0  # [s] ours: a longer iteration includes a pause, such as before a resume
AXES, AXES_OF = ("vx", "vy", "yaw rate"), ("error", "worst", "offset")
REPORT = "eval/report.json"  # written by play --eval into the run's folder


class Run(NamedTuple):
    """A run: its settings by dotted path, and its curves by name: (iterations, values), of equal length."""

    name: str
    folder: Path
    settings: dict[str, Any]
    curves: dict[str, tuple[list[float], list[float]]]
    seconds: dict[float, float]  # iteration -> [s] of training up to it, without pauses
    graded: dict[str, float]  # figures of the whole exam; empty without one

    @property
    def iterations(self) -> int:
        return int(max(self.seconds, default=0))

    def last(self, curve: str) -> float | None:
        """The last value of a curve; None without one."""
        values = self.curves.get(curve, ([], []))[1]
        return values[-1] if values else None


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
    path, logs = Path(name).expanduser(), Path.cwd() / "logs"
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
    """All curves of a run. If a resumed run repeated an iteration, the later values count."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator  # takes 0.5 s to import

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    curves, walls = {}, {}
    for tag in events.Tags()["scalars"]:
        points = {event.step: event for event in events.Scalars(tag)}
        kept = [points[step] for step in sorted(points)]
        curves[tag] = ([float(event.step) for event in kept], [event.value for event in kept])
        if tag == "Perf/total_fps":
            walls = {float(event.step): event.wall_time for event in kept}
    first = [curves[name][1][0] for name in ("Perf/collection_time", "Perf/learning_time") if name in curves]
    took = [sum(first), *(max(0.0, after - before) for before, after in pairwise(walls.values()))]
    seconds = dict(zip(walls, accumulate(spent if spent < PAUSE else 0.0 for spent in took), strict=False))
    settings = dict(_flat(load_yaml(folder / CONFIG_FILE))) if (folder / CONFIG_FILE).is_file() else {}
    return Run(name, folder, settings, curves, seconds, _graded(folder / REPORT))


def _graded(report: Path) -> dict[str, float]:
    """The numeric figures of the exam in a report; empty without a report."""
    try:
        exam = json.loads(report.read_text(encoding="utf-8"))["columns"][0]["exam"]
    except (OSError, ValueError, LookupError, TypeError):
        return {}
    found = dict(_flat({name: each for name, each in exam.items() if name != "rules"}))
    axes = {
        f"{path} {axis}": each
        for path, value in found.items()
        if path in AXES_OF
        for axis, each in zip(AXES, value, strict=False)
    }
    return {path: float(value) for path, value in {**found, **axes}.items() if isinstance(value, int | float)}


def _flat(values: Any, path: str = "") -> list[tuple[str, Any]]:
    """(dotted path, value) of all leaves. A list is a leaf."""
    if isinstance(values, dict):
        return [leaf for key, item in values.items() for leaf in _flat(item, f"{path}.{key}" if path else str(key))]
    return [(path, values)]


def differences(runs: list[Run]) -> dict[str, list[Any]]:
    """The settings in which runs differ: dotted path -> one value per run, None if the run lacks the setting."""
    paths = dict.fromkeys(path for run in runs for path in run.settings)
    table = {path: [run.settings.get(path) for run in runs] for path in paths}
    return {path: values for path, values in table.items() if any(value != values[0] for value in values)}


# ---- a line chart as SVG --------------------------------------------------------------------------------------------


WIDTH, HEIGHT = 340, 210  # of the drawing, in SVG units
LEFT, RIGHT, TOP, BOTTOM = 46, 10, 24, 34
POINTS = 120  # most points of a curve: neighbours are averaged

Line = tuple[str, Sequence[float], Sequence[float]]  # colour, x, y


def chart(title: str, over: str, lines: Sequence[Line]) -> str:
    """An SVG chart of the lines on common axes; "" if no line has a point."""
    thinned = [(colour, thin(list(zip(x, y, strict=True)))) for colour, x, y in lines]
    points = [point for _, line in thinned for point in line]
    if not points:
        return ""
    across = ticks(min(0.0, *(x for x, _ in points)), max(x for x, _ in points), 5)
    up = ticks(min(y for _, y in points), max(y for _, y in points), 4)

    def place(x: float, y: float) -> tuple[float, float]:
        right, above = (x - across[0]) / (across[-1] - across[0]), (y - up[0]) / (up[-1] - up[0])
        return LEFT + right * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - above * (HEIGHT - TOP - BOTTOM)

    parts = [f'<text class="name" x="0" y="13">{escape(title)}</text>']
    for y in up:
        _, at = place(across[0], y)
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{short(y)}</text>')
    for x in across:
        parts.append(
            f'<text x="{place(x, up[0])[0]:.1f}" y="{HEIGHT - BOTTOM + 15}" text-anchor="middle">{short(x)}</text>'
        )
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 2}" text-anchor="end">{escape(over)}</text>')
    for colour, line in thinned:
        path = "L".join("{:.1f} {:.1f}".format(*place(*point)) for point in line)
        parts.append(
            f'<path style="stroke:{colour}" d="M{path}"/>'
            if len(line) > 1
            else _dot(colour, place(*line[0]))
            if line
            else ""
        )
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(parts)}</svg>'


def _dot(colour: str, at: tuple[float, float]) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="3" style="fill:{colour}"/>'


def thin(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most ``POINTS`` points, each the mean of neighbours. Points that are not finite are left out."""
    points = [point for point in points if all(map(math.isfinite, point))]
    size = math.ceil(len(points) / POINTS) or 1
    groups = [points[i : i + size] for i in range(0, len(points), size)]
    return [(sum(x for x, _ in group) / len(group), sum(y for _, y in group) / len(group)) for group in groups]


def ticks(low: float, high: float, count: int) -> list[float]:
    """About ``count`` round numbers that span ``low`` to ``high``."""
    if high - low < 1e-12 * max(abs(low), abs(high), 1e-300):
        room = abs(high) / 2 or 1.0
        low, high = low - room, high + room
    raw = (high - low) / count
    scale = 10.0 ** math.floor(math.log10(raw))
    step = next(each * scale for each in (1, 2, 2.5, 5, 10) if each * scale >= raw * 0.999)
    return [i * step for i in range(math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9) + 1)]


def short(value: float) -> str:
    """A number for an axis: 12000 as 12k."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size * 0.9999 and (size > 1e3 or abs(value) >= 1e4):
            return f"{value / size:g}{letter}"
    return f"{value:.6g}"


LONGEST = 40  # [characters] longest setting in a table
MOST = 8  # number of distinct colours (Okabe and Ito's)
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8c6d31", "#68707d")
ON_DARK = ("#56b4e9", "#ff8a3d", "#2fc99b", "#e6a5c9", "#f0c04a", "#9fd4f5", "#c9a66b", "#9aa3b0")
STYLE = f""":root{{{"".join(f"--run{i}:{colour};" for i, colour in enumerate(COLOURS))}}}
@media (prefers-color-scheme:dark){{:root{{{"".join(f"--run{i}:{colour};" for i, colour in enumerate(ON_DARK))}}}}}
.swatch{{vertical-align:middle}}figure text{{font:11px var(--font);fill:var(--muted)}}figure .name{{fill:var(--ink);font-size:13px}}
figure path{{fill:none;stroke-width:1.6;stroke-linejoin:round}}figure line{{stroke:var(--faint)}}"""
TOTAL = "Train/total_steps"
FIRST = ("Train/mean_reward", "Train/mean_episode_length", "Episode/fell", "Policy/mean_std", "Perf/total_fps")
CHAPTERS = {  # prefix of a curve's name -> title; later chapters are folded
    "Exam/": "Exams during training",
    "Train/": "Training",
    "Curriculum/": "Curriculum",
    "Episode/rew_": "Reward terms",
    "Loss/": "Losses",
    "": "Everything else",
}
ACROSS: dict[str, Callable[[Run, float], float]] = {
    "iterations": lambda run, iteration: iteration,
    "steps": lambda run, iteration: iteration * steps_an_iteration(run) / 1e6,
    "minutes": lambda run, iteration: run.seconds.get(iteration, math.nan) / 60,
}
UNITS = {"iterations": "iterations", "steps": "million steps", "minutes": "minutes of training"}


def parse() -> argparse.Namespace:
    parser = Parser(prog="legged-mw compare", description=__doc__, allow_abbrev=False)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a run's path, TASK/RUN, or a task for its last run")
    parser.add_argument(
        "--out", default="compare.html", metavar="FILE", help="the page to write (default: compare.html)"
    )
    parser.add_argument("--over", choices=ACROSS, default="steps", help="what curves are drawn over (default: steps)")
    args = parser.parse_args()
    if len(args.runs) > MOST:
        parser.error(f"{len(args.runs)} runs cannot be told apart in one picture: name at most {MOST}")
    return args


def main() -> None:
    args = parse()
    runs = find_runs(args.runs)
    print(text_table(rows(runs)))
    write(runs, Path(args.out), args.over)
    print(f"written to {shown(Path(args.out))}")


def write(runs: Sequence[Run], path: Path, over: str = "steps") -> None:
    """Write the page. Raises UserError if it cannot be written."""
    try:
        path.write_text(html(runs, over), encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {path}: {error.strerror}; say --out FILE.html") from None


def steps_an_iteration(run: Run) -> float:
    """Steps per iteration: the last total of steps, divided by the number of iterations."""
    total = run.last(TOTAL)
    return total / run.iterations if total and run.iterations else math.nan


def figures(runs: Sequence[Run]) -> dict[str, tuple[str, list[float | None]]]:
    """Training times and last figures of ``runs``: name -> (number format, one value per run)."""
    exams = list(dict.fromkeys(name for run in runs for name in run.curves if name.startswith("Exam/")))
    last = {"steps/s": ("Perf/total_fps", ",.0f"), "reward": ("Train/mean_reward", ".2f")}
    last |= {name.removeprefix("Exam/"): (name, ".3f") for name in exams}
    return {
        "iterations": ("d", [run.iterations for run in runs]),
        "M steps": (".1f", [run.iterations * steps_an_iteration(run) / 1e6 for run in runs]),
        "minutes": (".1f", [run.seconds.get(run.iterations, 0.0) / 60 for run in runs]),
        **{head: (digits, [run.last(name) for run in runs]) for head, (name, digits) in last.items()},
    }


def rows(runs: Sequence[Run]) -> list[list[str]]:
    """A header, then one row per run: its name and its ``figures``."""
    found = figures(runs)
    columns = [["-" if value is None else f"{value:{digits}}" for value in values] for digits, values in found.values()]
    return [["run", *found], *([run.name, *line] for run, *line in zip(runs, *columns, strict=True))]


def text_table(lines: Sequence[Sequence[str]]) -> str:
    """``rows`` as text for a terminal."""
    first, *widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    cells = [[cell.rjust(width) for cell, width in zip(line[1:], widths, strict=True)] for line in lines]
    return "\n".join("  ".join([line[0].ljust(first), *right]) for line, right in zip(lines, cells, strict=True))


def html(runs: Sequence[Run], over: str = "steps") -> str:
    """The whole page."""
    heads, *lines = rows(runs)
    names = "".join(
        f'<li><i class="swatch" style="background:var(--run{i})"></i><b>{escape(run.name)}</b> '
        f'<span class="muted">{escape(shown(run.folder))}</span></li>'
        for i, run in enumerate(runs)
    )
    differ = [
        [path, *map(_said, values)] for path, values in differences(list(runs)).items() if path != "runner.run_name"
    ]
    graded = list(dict.fromkeys(name for run in runs for name in run.graded))
    exam = [[name, *(f"{run.graded[name]:.3g}" if name in run.graded else "-" for run in runs)] for name in graded]
    columns = ["", *(run.name for run in runs)]
    settings = (
        table(columns, differ, f"{len(differ)} settings" if len(differ) > 12 else "")
        if differ
        else "<p class=lead>None.</p>"
    )
    parts = [
        f"<section><h2>At the end</h2>{table(heads, lines)}</section>",
        *_chapters(runs, over),
        f"<section><h2>The whole exam</h2>{table(columns, exam)}</section>" if exam else "",
        f"<section><h2>Settings that differ</h2>{settings}</section>",
    ]
    title = " and ".join(dict.fromkeys(str(run.settings.get("task", run.folder.resolve().parent.name)) for run in runs))
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><title>{escape(title)}: {len(runs)} runs</title><style>{CSS}{STYLE}</style></head>
<body><main><header><p class="above">Training runs</p><h1>{escape(title)}</h1><ul class="names">{names}</ul></header>
{"".join(parts)}</main></body></html>
"""


def _said(value: object) -> str:
    text = "" if value is None else " ".join(str(value).split())
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def _chapters(runs: Sequence[Run], over: str) -> Iterable[str]:
    """The charts, grouped by the prefixes of their curves. Common groups are open, the others folded."""
    names = sorted(dict.fromkeys(name for run in runs for name in run.curves if name != TOTAL), key=_order)
    for chapter, group in groupby(names, key=_chapter):
        drawn = [
            chart(name.rpartition("/")[2].replace("_", " "), UNITS[over], _lines(runs, name, over)) for name in group
        ]
        figures = f'<div class="panels">{"".join(f"<figure>{svg}</figure>" for svg in drawn if svg)}</div>'
        if chapter in ("Exam/", "Train/"):
            yield f"<section><h2>{CHAPTERS[chapter]}</h2>{figures}</section>"
        else:
            yield f"<section><details><summary>{CHAPTERS[chapter]} ({len(drawn)})</summary>{figures}</details></section>"


def _chapter(name: str) -> str:
    return "Train/" if name in FIRST else next(begin for begin in CHAPTERS if name.startswith(begin))


def _order(name: str) -> tuple[int, int, str]:
    return list(CHAPTERS).index(_chapter(name)), FIRST.index(name) if name in FIRST else len(FIRST), name


def _lines(runs: Sequence[Run], name: str, over: str) -> list[tuple[str, list[float], list[float]]]:
    """(colour, x, y) for each run that has the curve."""
    found = []
    for i, run in enumerate(runs):
        if name in run.curves:
            iterations, values = run.curves[name]
            found.append((f"var(--run{i})", [ACROSS[over](run, iteration) for iteration in iterations], values))
    return found
