"""Run folders and checkpoints on disk: making, finding, writing whole, reading without running code."""

from __future__ import annotations

import io
import os
import re
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import torch

from legged_mw.rl.checkpoint import EARLIER, check_content, damage, sealed
from legged_mw.rl.saved_config import of_project, somebodys
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.errors import shown, unknown
from legged_mw.utils.files import check_folder, check_name, typed
from legged_mw.utils.task import LoadedTask

CONFIG_FILE = "config.yaml"


def logs_folder() -> Path:
    """The folder of all runs of all tasks: ``logs`` in the current folder."""
    return Path.cwd() / "logs"


def experiment_folder(task: LoadedTask, name: str | None = None) -> Path:
    """The folder of a task's runs, or of the experiment called ``name``. Raises UserError for a name that is none."""
    return logs_folder() / check_name(
        name or task.train.runner.experiment_name or task.name, "the name of the experiment"
    )


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
    """Run folders that hold a checkpoint, oldest first by the time of their newest checkpoint. What cannot be read is none."""
    found: dict[Path, int] = {}
    for folder in experiment.glob("*"):
        # a link to itself, a folder of another user's, a checkpoint that is thinned out as it is looked at
        with suppress(OSError):
            if there := checkpoints(folder):
                found[folder] = max(path.stat().st_mtime_ns for path in there.values())
    return sorted(found, key=lambda folder: found[folder])


def checkpoints(run: Path) -> dict[int, Path]:
    """Iteration -> checkpoint of a run, in rising order."""
    named = {path: re.fullmatch(r"model_(\d{1,18})\.pt", path.name) for path in run.glob("model_*.pt")}
    return dict(sorted((int(match[1]), path) for path, match in named.items() if match and path.is_file()))


def find_run(experiment: Path, name: str) -> Path:
    """The run called ``name`` below ``experiment``, a path to one, or for "-1" the one last trained. It may be a stranger's."""
    found, given = runs(experiment), typed(name)
    if name == "-1":
        if not found:
            raise ConfigError(
                f"no run with a checkpoint in {experiment}; train first, or name another --experiment_name"
            )
        return check_folder(found[-1])
    for folder in (experiment / name, given):
        if folder.is_dir() and checkpoints(folder):
            return check_folder(folder)
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


def task_of(run: Path, named: LoadedTask | None = None) -> str:
    """What ``--task`` is for the run in the folder ``run``: the project's task that its config names, or a file that ``named`` has run.

    No other file, since a file is code, and a run may be a stranger's. Raises ConfigError with what to type.
    """
    stored = load_yaml(run / CONFIG_FILE).get("task", "")
    if not isinstance(stored, str) or not stored:
        raise ConfigError(f"{shown(run / CONFIG_FILE)} does not say of which task it is; say --task")
    if found := of_project(stored) or (named and named.file_called(Path(stored).name)):
        return str(found)
    raise ConfigError(
        f"{shown(run)} is of task {stored[:200]!r}, {somebodys(stored)}{', or a task that extends its config' if named else ''}"
    )


def task_at(path: str) -> str:
    """``task_of`` the run that the user named by its path; "" if there is no run."""
    run = typed(path)
    return task_of(check_folder(run)) if (run / CONFIG_FILE).is_file() else ""


def save_whole(content: dict[str, Any], path: Path, sync: bool = True) -> None:
    """Write a checkpoint, with its checksum, so that a kill at any moment (``sync``: a power cut too) leaves all of it or nothing."""
    temporary, archive = path.with_name(f".{path.name}.{os.getpid()}.tmp"), io.BytesIO()
    torch.save(content, archive)
    try:
        with open(temporary, "wb") as file:
            file.write(sealed(archive.getvalue()))
            file.flush()
            if sync:
                os.fsync(file.fileno())
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def load_tensors(path: Path, device: str) -> dict[str, Any]:
    """Read a checkpoint, whole and of finite numbers, without running code from it (``weights_only``). Raises ConfigError."""
    try:
        written = path.read_bytes()
    except FileNotFoundError:
        raise ConfigError(f"no checkpoint at {path}") from None
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None
    why = damage(written)
    try:
        content = None if why else torch.load(io.BytesIO(written), map_location=device, weights_only=True)
    except (
        Exception
    ):  # a zip, pickle or tensor error, by how the file is broken; torch's own advice is to load it unsafely
        why = "it is damaged, or holds more than tensors and numbers"
    if why:
        raise ConfigError(f"{path} cannot be read as a checkpoint: {why}; {EARLIER}")
    return check_content(content, path)


def check_fit(saved: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor], path: Path, what: str) -> None:
    """One clear line if the parameters in a checkpoint are not those of the network that config makes."""
    remembers = [any(name.startswith("rnn.") for name in names) for names in (saved, wanted)]
    if saved and remembers[0] != remembers[1]:
        has, lacks = ("there", "here") if remembers[0] else ("here", "there")
        raise ConfigError(f"{path} does not fit this task: the {what} has a memory (RNNModel) {has} and none {lacks}")
    for name in [*wanted, *saved]:
        here, there = wanted.get(name), saved.get(name)
        if (
            here is None
            or there is None
            or here.shape != there.shape
            or here.is_floating_point() != there.is_floating_point()
        ):
            shapes = ["missing" if t is None else str(tuple(t.shape)) for t in (there, here)]
            if here is not None and there is not None and here.shape == there.shape:
                shapes = [str(t.dtype).removeprefix("torch.") for t in (there, here)]
            raise ConfigError(f"{path} does not fit this task: {what} {name} is {shapes[0]} there and {shapes[1]} here")
        if not bool(there.isfinite().all()):
            raise ConfigError(f"{path}: {what} {name} has values that are not finite")
