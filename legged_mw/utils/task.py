"""Load a task by its name in ``configs/`` or the path of its config file, and access its two configs as one."""

from __future__ import annotations

import importlib
import importlib.util
import os
import re
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
from legged_mw.utils.files import file_of, typed

_ENDS = "must end with TASK = Task(Env, Cfg, CfgPPO)"
PRESETS = "base"  # configs/base.py: not a task, but presets that tasks extend
ROBOT_FILES = (".xml", ".mjcf", ".urdf")
_SHIPPED = (ROOT / "configs").resolve()
_packages: dict[tuple[Path, ...], dict[str, ModuleType]] = {}  # folders of the package `configs` -> imported modules
_beside: dict[Path, dict[str, ModuleType]] = {}  # folder of a task -> imported modules in it


class Task(NamedTuple):
    """The last line of a config file: three classes, and the exam."""

    env: type[Any]  # class of the environment, a RobotTask
    cfg: type[Any]  # class of its config
    train: type[Any]  # class of the learner's config
    exam: str | None = None  # kind of exam; "": no exam; None: the exam of the environment's class


class LoadedTask:
    """A task with new instances of its configs: ``cfg`` for the environment, ``train`` for the learner.

    The sections of both have different names, so ``set`` and ``update`` accept fields of both.
    """

    def __init__(self, name: str, path: Path, task: Task, about: str = "") -> None:
        self.name, self.path, self.env_class = name, path, task.env
        self.about = about  # first line of the config file
        self.exam: str = getattr(task.env, "exam", "") if task.exam is None else task.exam
        self.cfg, self.train = task.cfg(), task.train()
        self.cfg._folder = str(path.resolve().parent)  # for find_file of utils/files.py

    def set(self, path: str, value: Any, where: str = "--set") -> None:
        """Override the field at a dotted path. Text is parsed by the field's type. Raises ConfigError."""
        section = path.split(".")[0]
        self._owner(section, where).set(path, value, where=where)

    def update(self, values: Mapping[str, Any], where: str) -> None:
        """Override all fields of both configs in the nested ``values``. If one is wrong, change nothing and raise."""
        parts: dict[Config, dict[str, Any]] = {self.cfg: {}, self.train: {}}
        for section, fields in values.items():
            if section != "task":
                parts[self._owner(section, where)][section] = fields
        before = self.cfg.to_dict()
        self.cfg.update(parts[self.cfg], where=where)
        try:
            self.train.update(parts[self.train], where=where)
        except ConfigError:
            self.cfg.update(before, where=where)
            raise

    def changes_since(self, before: LoadedTask) -> dict[str, tuple[Any, Any]]:
        """Dotted path -> (value in ``before``, value now), for all fields that differ. ``before``: the same task."""
        differences = [*before.cfg.diff(self.cfg), *before.train.diff(self.train)]
        return {path: (then, now) for path, then, now in differences}

    def to_dict(self) -> dict[str, Any]:
        """Both configs and the task's name as one mapping, for ``config.yaml`` in a run folder.

        The name of a file outside of configs/ is its path relative to the current folder, so that the file and logs/
        can be moved together.
        """
        name, here, file = self.name, Path.cwd().resolve(), self.path.resolve()
        if not self.ships:
            together = os.path.commonpath([here, file]) != here.anchor
            name = Path(os.path.relpath(file, here)).as_posix() if together else file.name
        return {"task": name, **self.cfg.to_dict(), **self.train.to_dict()}

    def file_called(self, name: str) -> Path | None:
        """The file with this ``name``, if it is the task's file or that of a config that it extends; else None."""
        kinds = (*type(self.cfg).__mro__, *type(self.train).__mro__)
        return next((file for file in (self.path, *map(file_of, kinds)) if file and file.name == name), None)

    @property
    def ships(self) -> bool:
        """Whether the file is in configs/, so that ``--task`` accepts its name without a path."""
        return self.path.parent.resolve() == _SHIPPED

    def _owner(self, section: str, where: str) -> Config:
        sections: dict[str, Config] = {name: owner for owner in (self.cfg, self.train) for name in owner.to_dict()}
        if section not in sections:
            raise ConfigError(f"{where}: {unknown('config section', section, sections, 'this task')}")
        return sections[section]


def task_names() -> list[str]:
    """The names of all tasks in configs/."""
    names = [path.stem for path in (ROOT / "configs").glob("*.py") if not path.stem.startswith("_")]
    return sorted(name for name in names if name != PRESETS)


def load_task(name: str, say: bool = False) -> LoadedTask:
    """Load the task ``name``: a name in ``configs/`` or the path of a config file. Raises ConfigError.

    ``say``: print the path of a file before it runs. The file may import modules in its folder. ``find_file`` finds a
    relative ``asset.file``.
    """
    path, known = typed(name), task_names()
    if path.suffix in ROBOT_FILES:
        remedy = f"make a task for it: python -m legged_mw.robot {name} --new NAME"
        raise ConfigError(f"{name} is a robot, not a task; {remedy}")
    if path.suffix != ".py" and name not in known:
        if path.is_file():
            kinds = f"a task's config file (.py) nor a robot ({', '.join(ROBOT_FILES)})"
            unzip = "; unzip it, and name the .xml that is in it" if path.suffix in (".mjz", ".zip") else ""
            raise ConfigError(f"{name} is neither {kinds}{unzip}")
        raise ConfigError(f"{unknown('task', name, known, 'configs/')}; or give the path of a config file (.py)")
    if path.suffix != ".py":
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
        where = f"{shown(Path(error.filename or path))}{line}"
        raise ConfigError(f"{where}: {error.msg}: {(error.text or '').strip()[:100]}") from error
    except (Exception, SystemExit) as error:
        remedy = "" if isinstance(error, ImportError) else f"; {shown(path)} {_ENDS}"
        if isinstance(error, TypeError) and re.search(r"\(MRO\)|duplicate base class", str(error)):
            remedy = "; one of these parents is the other one, or extends it: name only the last of them"
        raise ConfigError(f"{users_fault(error) or shown(path)}: {in_short(error)}{remedy}") from error
    task = getattr(module, "TASK", None)
    if not isinstance(task, Task):
        raise ConfigError(f"{path} {_ENDS}; its TASK is {task!r:.100}")
    for part, attribute, wanted in (
        ("env", "observation_rows", "an environment, as LeggedRobot is"),
        ("cfg", "env", "an environment's config, as LeggedRobotCfg is"),
        ("train", "runner", "a learner's, as LeggedRobotCfgPPO is"),
    ):
        kind = getattr(task, part)
        if not isinstance(kind, type) or not hasattr(kind, attribute):
            raise ConfigError(f"{path}: TASK: {part} is {kind!r:.100}; it must be a class: {wanted}")
    return LoadedTask(path.stem, path, task, about=(module.__doc__ or "").partition("\n")[0])


# ---- importing a task's file ---------------------------------------------------------------------------------------
# A file may import modules in its folder by their names, and configs/ as the package `configs`. Two folders may have
# modules with the same name, so the modules of each folder are kept separately. `sys.path` is restored afterwards.


def import_task(path: Path) -> ModuleType:
    """Import a config file. Files in configs/ are imported by name, so that they can extend each other."""
    folder = path.resolve().parent
    beside = folder if folder.name == "configs" else folder / "configs"
    places = (beside, _SHIPPED) if beside.is_dir() and beside != _SHIPPED else (_SHIPPED,)
    have = [Path(place).resolve() for place in getattr(sys.modules.get("configs"), "__path__", ())]
    names = {entry.stem for entry in folder.iterdir() if entry.suffix == ".py" or (entry / "__init__.py").is_file()}
    names = {name for name in names if _may_be_neighbour(name, folder)}
    package = set() if have == [*places] else {"configs"}
    with (
        _modules(package, _packages.setdefault(places, {}), places),
        _modules(names, _beside.setdefault(folder, {})),
    ):
        if "configs" not in sys.modules:
            sys.modules["configs"] = ModuleType("configs")
            sys.modules["configs"].__path__ = [str(place) for place in places]
        sys.path.insert(0, str(folder))
        importlib.invalidate_caches()  # the file may be new
        try:
            return importlib.import_module(f"configs.{path.stem}") if folder == _SHIPPED else _run(path)
        finally:
            sys.path.remove(str(folder))


def _run(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"legged_mw_task_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # the resolution of annotations needs it
    spec.loader.exec_module(module)
    return module


def _may_be_neighbour(name: str, folder: Path) -> bool:
    """Whether an import of ``name`` may use the file in ``folder``: no library or loaded module has the name."""
    if name in sys.stdlib_module_names or name in ("__main__", "legged_mw", "configs"):
        return False
    if name not in sys.modules:
        return True
    file = Path(getattr(sys.modules[name], "__file__", None) or folder / name).resolve()
    return not {"site-packages", "dist-packages"} & {*file.parts} and not file.is_relative_to(folder)


@contextmanager
def _modules(names: set[str], mine: dict[str, ModuleType], places: tuple[Path, ...] = ()) -> Iterator[None]:
    """A context in which modules called ``names`` are those in ``mine``. Modules imported in it are added to ``mine``.

    Afterwards the modules that do not belong to tasks are restored, and ``configs`` is free for another package of that
    name on the path. Other modules stay until the next task needs their names, because a config may name a class by its
    module.
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
        other_package = PathFinder.find_spec("configs") if "configs" in names else None
        if other_package and [*(other_package.submodule_search_locations or ())] != [str(place) for place in places]:
            theirs.add("configs")
        sys.modules.update({name: module for name, module in mine.items() if _top(name) not in theirs} | others)


def _take_out(names: set[str]) -> dict[str, ModuleType]:
    """Remove the modules called ``names`` and their submodules from ``sys.modules``, and return them."""
    if not names:
        return {}
    return {name: sys.modules.pop(name) for name in [*sys.modules] if _top(name) in names}


def _top(name: str) -> str:
    return name.partition(".")[0]
