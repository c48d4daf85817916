"""Run folders and checkpoints on disk: making, finding, writing whole, reading without running code."""

from __future__ import annotations

import argparse
import os
import re
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import shown, unknown
from legged_mw.utils.task import LoadedTask, task_names

CONFIG_FILE = "config.yaml"


def logs_folder() -> Path:
    """The folder of all runs of all tasks: ``logs`` in the current folder."""
    return Path.cwd() / "logs"


def experiment_folder(task: LoadedTask, name: str | None = None) -> Path:
    """The folder of a task's runs, or of the experiment called ``name``."""
    return logs_folder() / (name or task.train.runner.experiment_name or task.name)


def new_run(experiment: Path, run_name: str) -> Path:
    """Make and return a run folder below ``experiment``, named by the time."""
    stamp = datetime.now().strftime("%Y-%m-%d_%H-%M-%S") + (f"_{run_name}" if run_name else "")
    for suffix in ["", *(f"_{i}" for i in range(2, 1000))]:
        folder = experiment / (stamp + suffix)
        try:
            folder.mkdir(parents=True)
            return folder
        except FileExistsError:
            continue
    raise ConfigError(f"cannot make a run folder {experiment / stamp}: a thousand of that name exist")


def runs(experiment: Path) -> list[Path]:
    """Run folders that hold a checkpoint, oldest first by the time of their newest checkpoint."""
    found = [folder for folder in experiment.glob("*") if folder.is_dir() and checkpoints(folder)]
    return sorted(found, key=lambda folder: max(path.stat().st_mtime_ns for path in checkpoints(folder).values()))


def checkpoints(run: Path) -> dict[int, Path]:
    """Iteration -> checkpoint of a run, in rising order."""
    found = {int(m[1]): path for path in run.glob("model_*.pt") if (m := re.fullmatch(r"model_(\d+)\.pt", path.name))}
    return dict(sorted(found.items()))


def find_run(experiment: Path, name: str) -> Path:
    """The run called ``name`` below ``experiment``, a path to one, or for "-1" the one last trained."""
    found = runs(experiment)
    if name == "-1":
        if not found:
            raise ConfigError(f"no run with a checkpoint in {experiment}; train first, or name another --experiment_name")
        return found[-1]
    for folder in (experiment / name, Path(name).expanduser()):
        if folder.is_dir() and checkpoints(folder):
            return folder
    raise ConfigError(unknown("run with a checkpoint", name, [folder.name for folder in found], str(experiment)))


def find_checkpoint(run: Path, iteration: int) -> Path:
    """The checkpoint of ``run`` after ``iteration`` iterations, or for -1 the newest."""
    found = checkpoints(run)
    if not found:
        raise ConfigError(f"no checkpoint model_<iteration>.pt in {run}")
    if iteration == -1:
        return list(found.values())[-1]
    if iteration not in found:
        raise ConfigError(f"no checkpoint {iteration} in {run}; there are: {', '.join(map(str, found))}")
    return found[iteration]


def task_of(run: Path) -> str:
    """What ``--task`` is for the run in the folder ``run``: a name in configs/, or the path of its config file as it lies today.

    A relative path is looked for from the current folder and from those above the run, then its bare name. Raises ConfigError.
    """
    stored = load_yaml(run / CONFIG_FILE).get("task", "")
    if not isinstance(stored, str) or not stored:
        raise ConfigError(f"{shown(run / CONFIG_FILE)} does not say of which task it is; say --task")
    if Path(stored).suffix != ".py":
        return stored
    folders = [Path.cwd(), *run.resolve().parents[:4]]  # experiment, logs, what holds logs; of an export one more
    for file in (folder / name for name in (stored, Path(stored).name) for folder in folders):
        if file.is_file():
            return str(file)
    raise ConfigError(f"{shown(run)} is of task '{stored}', which is not there from {', '.join(map(str, folders))}; say --task FILE")


def require_task(args: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    """Where ``--task`` is missing, take the one that the run at the path ``--load_run`` is of."""
    if not args.task and args.load_run and (Path(args.load_run).expanduser() / CONFIG_FILE).is_file():
        args.task = task_of(Path(args.load_run).expanduser())
    if not args.task:
        parser.error(f"--task is missing, and --load_run is no path of a run that would say it; tasks: {', '.join(task_names())}")


def save_whole(content: dict[str, Any], path: Path, sync: bool = True) -> None:
    """Write a checkpoint so that a kill at any moment leaves either all of it or nothing; with ``sync`` a power cut too."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with open(temporary, "wb") as file:
            torch.save(content, file)
            file.flush()
            if sync:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load_tensors(path: Path, device: str) -> dict[str, Any]:
    """Read a checkpoint without running code from it (``weights_only``)."""
    try:
        content = torch.load(path, map_location=device, weights_only=True)
    except FileNotFoundError:
        raise ConfigError(f"no checkpoint at {path}") from None
    except Exception:  # a zip, pickle or tensor error, by how the file is broken; torch's own advice is to load it unsafely
        raise ConfigError(f"{path} cannot be read as a checkpoint: it is damaged, or holds more than tensors and numbers") from None
    if not isinstance(content, dict) or not {"actor_state_dict", "student_state_dict"} & content.keys():
        raise ConfigError(f"{path} is not a checkpoint of this project: it has no actor_state_dict")
    return content


def check_fit(saved: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor], path: Path, what: str) -> None:
    """One clear line if the parameters in a checkpoint are not those of the network that config makes."""
    for name in [*wanted, *saved]:
        here, there = wanted.get(name), saved.get(name)
        if here is None or there is None or here.shape != there.shape:
            shapes = ["missing" if t is None else str(tuple(t.shape)) for t in (there, here)]
            raise ConfigError(f"{path} does not fit this task: {what} {name} is {shapes[0]} there and {shapes[1]} here")
