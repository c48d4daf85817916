"""Importing a task's file: its neighbours by their names, ``configs`` as one package; ``sys.path`` is as it was before."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.machinery import PathFinder
from pathlib import Path
from types import ModuleType

from legged_mw import ROOT

_SHIPPED = (ROOT / "configs").resolve()
_packages: dict[tuple[Path, ...], dict[str, ModuleType]] = {}  # folders of `configs` -> its modules, imported once
_beside: dict[Path, dict[str, ModuleType]] = {}  # folder of a task -> the modules beside it, likewise


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
