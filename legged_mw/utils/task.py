"""Finding a task: a name in ``configs/``, or the path of a config file anywhere; and its two configs as one."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from legged_mw import ROOT
from legged_mw.utils.config import Config, ConfigError
from legged_mw.utils.errors import UserError, in_short, shown, unknown, users_fault
from legged_mw.utils.files import typed

_ENDS = "must end with TASK = Task(Env, Cfg, CfgPPO)"
PRESETS = "base"  # configs/base.py: what tasks extend, no task
ROBOT_FILES = (".xml", ".mjcf", ".urdf")
_SHIPPED = (ROOT / "configs").resolve()
_packages: dict[tuple[Path, ...], dict[str, ModuleType]] = {}  # folders of `configs` -> its modules, imported once
_beside: dict[Path, dict[str, ModuleType]] = {}  # folder of a task -> the modules beside it, likewise


class Task(NamedTuple):
    """What the last line of a config file names: three classes, and how its policies are graded."""

    env: type[Any]  # the environment, a RobotTask
    cfg: type[Any]  # its config
    train: type[Any]  # the learner's config
    exam: str | None = None  # a kind of exam, "" for none; None: the one that the environment's class names


class LoadedTask:
    """A task with fresh instances of its configs: ``cfg`` for the environment, ``train`` for the learner.

    The sections of both share one name space: ``set`` and ``update`` take a path or a mapping over all of them.
    """

    def __init__(self, name: str, path: Path, task: Task, about: str = "") -> None:
        self.name, self.path, self.env_class = name, path, task.env
        self.about = about  # the config file's first line
        self.exam: str = getattr(task.env, "exam", "") if task.exam is None else task.exam
        self.cfg, self.train = task.cfg(), task.train()
        self.cfg._folder = str(path.resolve().parent)  # where files that flags name are looked for: utils/files.py

    def set(self, path: str, value: Any, where: str = "--set") -> None:
        """Override one field by its dotted path; text is parsed by the field's type."""
        section = path.split(".")[0]
        self._owner(section, where).set(path, value, where=where)

    def update(self, values: Mapping[str, Any], where: str) -> None:
        """Override fields from a nested mapping over the sections of both configs; all of them or, on an error, none."""
        parts: dict[int, dict[str, Any]] = {id(self.cfg): {}, id(self.train): {}}
        for section, fields in values.items():
            if section != "task":
                parts[id(self._owner(section, where))][section] = fields
        before = self.cfg.to_dict()
        self.cfg.update(parts[id(self.cfg)], where=where)
        try:
            self.train.update(parts[id(self.train)], where=where)
        except ConfigError:
            self.cfg.update(before, where=where)
            raise

    def changes_since(self, before: LoadedTask) -> dict[str, tuple[Any, Any]]:
        """Dotted path -> (value in ``before``, value now) of every field that differs; ``before`` is a copy of this task."""
        differences = [*before.cfg.diff(self.cfg), *before.train.diff(self.train)]
        return {path: (then, now) for path, then, now in differences}

    def to_dict(self) -> dict[str, Any]:
        """Both configs as one mapping, with the task's name: what ``config.yaml`` in a run folder holds.

        Of a file outside of configs/ that is the path from the current folder, which has logs/: both may move together.
        """
        name, here, file = self.name, Path.cwd().resolve(), self.path.resolve()
        if not self.ships:
            together = os.path.commonpath([here, file]) != here.anchor
            name = Path(os.path.relpath(file, here)).as_posix() if together else file.name
        return {"task": name, **self.cfg.to_dict(), **self.train.to_dict()}

    @property
    def ships(self) -> bool:
        """Whether the file is in configs/, so that ``--task`` knows its bare name."""
        return self.path.parent.resolve() == _SHIPPED

    def _owner(self, section: str, where: str) -> Config:
        sections: dict[str, Config] = {name: owner for owner in (self.cfg, self.train) for name in owner.to_dict()}
        if section not in sections:
            raise ConfigError(f"{where}: {unknown('config section', section, sections, 'this task')}")
        return sections[section]


def task_names() -> list[str]:
    """Names that ``--task`` knows without a path."""
    names = [path.stem for path in (ROOT / "configs").glob("*.py") if not path.stem.startswith("_")]
    return sorted(name for name in names if name != PRESETS)


def load_task(name: str, say: bool = False) -> LoadedTask:
    """The task called ``name`` in ``configs/``, or that of the config file at that path, which is printed before it runs if ``say``.

    The file may import its neighbours. A relative ``asset.file`` is looked for beside the file that wrote it, then in the repository.
    """
    path = typed(name)
    if path.suffix in ROBOT_FILES:
        raise ConfigError(
            f"{name} is a robot, not a task; make a task for it: python -m legged_mw.robot {name} --new NAME"
        )
    if path.suffix != ".py":
        known = task_names()
        if name not in known and path.is_file():
            raise ConfigError(
                f"{name} is neither a task's config file (.py) nor a robot ({', '.join(ROBOT_FILES)})"
                + ("; unzip it, and name the .xml that is in it" if path.suffix in (".mjz", ".zip") else "")
            )
        if name not in known:
            raise ConfigError(f"{unknown('task', name, known, 'configs/')}; or give the path of a config file (.py)")
        path = ROOT / "configs" / f"{name}.py"
    if not path.is_file():
        raise ConfigError(f"no config file at {path.absolute()}")
    if say and path.resolve().parent != _SHIPPED:
        print(f"task: {shown(path)}", flush=True)
    try:
        module = import_task(path)
    except UserError:
        raise
    except SyntaxError as error:
        line = f":{error.lineno}" if error.lineno else ""
        raise ConfigError(
            f"{shown(Path(error.filename or path))}{line}: {error.msg}: {(error.text or '').strip()[:100]}"
        ) from error
    except (Exception, SystemExit) as error:
        ends = "" if isinstance(error, ImportError) else f"; {shown(path)} {_ENDS}"
        raise ConfigError(f"{users_fault(error) or shown(path)}: {in_short(error)}{ends}") from error
    task = getattr(module, "TASK", None)
    if not isinstance(task, Task):
        raise ConfigError(f"{path} {_ENDS}; its TASK is {task!r:.100}")
    _check_task(task, path)
    return LoadedTask(path.stem, path, task, about=(module.__doc__ or "").partition("\n")[0])


def _check_task(task: Task, path: Path) -> None:
    """Three classes of the kinds that are expected, and an exam's name."""
    for name, kind, wanted, has in (
        ("env", task.env, "an environment, as LeggedRobot is", lambda kind: hasattr(kind, "observation_rows")),
        (
            "cfg",
            task.cfg,
            "an environment's config, as LeggedRobotCfg is",
            lambda kind: issubclass(kind, Config) and hasattr(kind, "env"),
        ),
        (
            "train",
            task.train,
            "a learner's, as LeggedRobotCfgPPO is",
            lambda kind: issubclass(kind, Config) and hasattr(kind, "runner"),
        ),
    ):
        if not isinstance(kind, type) or not has(kind):
            raise ConfigError(f"{path}: TASK: {name} is {kind!r:.100}; it must be a class: {wanted}")
    if not isinstance(task.exam, str | None):
        raise ConfigError(f"{path}: TASK: exam is {task.exam!r:.100}; it must be the name of an exam, or None")


# ---- importing a task's file: its neighbours by their names, `configs` as one package; `sys.path` is as it was before ----------


def import_task(path: Path) -> ModuleType:
    """The module of a config file. Those in configs/ are imported by name, so that they can subclass one another."""
    folder = path.resolve().parent
    beside = folder if folder.name == "configs" else folder / "configs"
    places = (beside, _SHIPPED) if beside.is_dir() and beside != _SHIPPED else (_SHIPPED,)
    have = [Path(place).resolve() for place in getattr(sys.modules.get("configs"), "__path__", ())]
    names = {entry.stem for entry in folder.iterdir() if entry.suffix == ".py" or (entry / "__init__.py").is_file()}
    package = set() if have == [*places] else {"configs"}
    names = {name for name in names if _may_mean(name, folder)}
    mine, beside_it = _packages.setdefault(places, {}), _beside.setdefault(folder, {})
    with _named(package, mine, places), _named(names, beside_it):
        if "configs" not in sys.modules:
            sys.modules["configs"] = ModuleType("configs")
            sys.modules["configs"].__path__ = [str(place) for place in places]
        sys.path.insert(0, str(folder))
        importlib.invalidate_caches()  # a file that was written a moment ago
        try:
            return importlib.import_module(f"configs.{path.stem}") if folder == _SHIPPED else _run(path)
        finally:
            sys.path.remove(str(folder))


def _run(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"legged_mw_task_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # annotations are resolved through it
    spec.loader.exec_module(module)
    return module


def _may_mean(name: str, folder: Path) -> bool:
    """Whether ``name`` may be that of a neighbour in ``folder``: it is no library's, and not imported from there already."""
    if name in sys.stdlib_module_names or name in ("__main__", "legged_mw", "configs"):
        return False
    if name not in sys.modules:
        return True
    file = Path(getattr(sys.modules[name], "__file__", None) or folder / name).resolve()
    return not {"site-packages", "dist-packages"} & {*file.parts} and not file.is_relative_to(folder)


@contextmanager
def _named(names: set[str], mine: dict[str, ModuleType], places: tuple[Path, ...] = ()) -> Iterator[None]:
    """While a task is loaded, the modules called ``names`` are ``mine``, to which those are added that it imports.

    Afterwards a name is given back to what had it outside of tasks, and ``configs`` to what else on the path has it. Other names
    stay until the next task wants them, since a config may name a class by its module.
    """
    before = _take_out(names)
    sys.modules.update(mine)
    try:
        yield
    finally:
        mine |= _take_out(names)
        of_tasks = {id(module) for kept in (*_packages.values(), *_beside.values()) for module in kept.values()}
        others = {name: module for name, module in before.items() if id(module) not in of_tasks}
        theirs = {_top(name) for name in others}
        found = PathFinder.find_spec("configs") if "configs" in names else None
        if found and [*(found.submodule_search_locations or ())] != [str(place) for place in places]:
            theirs.add("configs")
        sys.modules.update({name: module for name, module in mine.items() if _top(name) not in theirs} | others)


def _take_out(names: set[str]) -> dict[str, ModuleType]:
    """Remove the modules and packages ``names`` from those that are imported; returns them."""
    return {name: sys.modules.pop(name) for name in [*sys.modules] if _top(name) in names}


def _top(name: str) -> str:
    return name.partition(".")[0]
