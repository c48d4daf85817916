"""The curves of a run, read from its TensorBoard files, and where a run that a user names lies."""

from __future__ import annotations

import json
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any, NamedTuple

from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import shown

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
