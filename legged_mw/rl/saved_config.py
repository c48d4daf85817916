"""The ``config.yaml`` of a run: which task it is of, and its fields, old names included."""

from __future__ import annotations

import copy
import shlex
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from legged_mw import ROOT
from legged_mw.utils.config import Config, ConfigError
from legged_mw.utils.files import find_file
from legged_mw.utils.renamed import MOVED
from legged_mw.utils.task import LoadedTask

# A field of runs of 0.1 -> the keys that lead to its value now.
RENAMED: dict[str, tuple[str, ...]] = {
    "perturbation.enable": ("perturbation", "kick"),
    "cpu.keep_probability": ("cpu", "overrides", "commands.keep_probability"),
    "cpu.kick_curriculum": ("cpu", "overrides", "perturbation.curriculum"),
}


def of_project(stored: str) -> str:
    """``--task`` for the task that a run's config names; "" if it is not this project's: no run may start such a file.

    This project's are the names in configs/, and files that really lie in configs/ or examples/ of package or clone.
    """
    if Path(stored).suffix != ".py":
        return stored  # a name; there is none outside of configs/
    folders = [(ROOT / name).resolve() for name in ("configs", "examples")]
    with suppress(OSError, ValueError, RuntimeError):  # a name that no file can have, a link to itself
        for file in ((place / stored).resolve() for place in (Path.cwd(), ROOT)):
            if file.is_file() and file.parent in folders:
                return str(file)
    return ""


def somebodys(stored: str) -> str:
    """What a task's file is that is not ``of_project``, and the flag that runs it."""
    return f"somebody's code, which no run starts by itself: read it, then say --task {shlex.quote(stored[:200])}"


def update_from_run(task: LoadedTask, saved: Mapping[str, Any], where: str) -> list[str]:
    """Give ``task`` the fields in the ``config.yaml`` of one of its runs, which may use old names.

    A learner's section that the file lacks is newer than the run. It takes the base class's values, as the run did, not
    those of today's task. Returns the names of these sections.
    """
    saved = _with_new_names(saved)
    theirs = str(saved.get("task", task.name))
    if Path(theirs).stem != task.name:
        what = f"say --task {theirs}" if of_project(theirs) else f"that is {somebodys(theirs)}"
        raise ConfigError(f"{where} is of task {theirs[:200]!r}, not '{task.name}'; {what}")
    asset = saved.get("asset")
    if isinstance(asset, dict) and _is_own_file(task, Path(str(asset.get("file", "")))):
        asset["file"] = task.cfg.asset.file
    parents = [kind for kind in type(task.train).__mro__ if issubclass(kind, Config) and kind is not Config]
    defaults = parents[-1]().to_dict()
    newer = {name: value for name, value in defaults.items() if name not in saved and isinstance(value, dict)}
    task.update({**saved, **newer}, where)
    return list(newer)


def _with_new_names(saved: Mapping[str, Any]) -> dict[str, Any]:
    """A copy in which every old name of a field, or of a class's module, is replaced by the new one."""
    config: dict[str, Any] = copy.deepcopy(dict(saved))
    for old, (*sections, name) in RENAMED.items():
        section, _, field = old.partition(".")
        if not isinstance(config.get(section), dict) or field not in config[section]:
            continue
        value, node = config[section].pop(field), config
        for key in sections:
            node = node.setdefault(key, {}) if isinstance(node, dict) else None
        if isinstance(node, dict):  # else the file is wrong there, and loading it says so
            node[name] = value
    for section in config.values():
        name = section.get("class_name") if isinstance(section, dict) else None
        for old, new in MOVED.items():
            if isinstance(name, str) and name.startswith((f"{old}:", f"{old}.")):
                section["class_name"] = new + name[len(old) :]
    return config


def _is_own_file(task: LoadedTask, file: Path) -> bool:
    """Whether an absolute path is the task's own robot: runs once stored the path of their machine."""
    if not file.is_absolute() or file.name != Path(task.cfg.asset.file).name:
        return False
    return not file.exists() or file.samefile(find_file(task.cfg, "asset.file"))
