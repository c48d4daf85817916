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

# folders of `configs` -> its modules, kept while the name is another's
_loaded: dict[tuple[str, ...], dict[str, ModuleType]] = {}
_neighbours_of: dict[Path, dict[str, ModuleType]] = {}  # folder of a task -> the modules beside it that were imported


def import_task(path: Path) -> ModuleType:
    """The module of a config file. Those in configs/ are imported by name, so that they can subclass one another."""
    folder, shipped = path.resolve().parent, (ROOT / "configs").resolve()
    if folder == shipped:
        with _configs(shipped), _neighbours(folder):
            return importlib.import_module(f"configs.{path.stem}")
    spec = importlib.util.spec_from_file_location(f"legged_mw_task_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # annotations are resolved through it
    beside = folder if folder.name == "configs" else folder / "configs"
    with _configs(*([beside] if beside.is_dir() else []), shipped), _neighbours(folder):
        spec.loader.exec_module(module)
    return module


@contextmanager
def _neighbours(folder: Path) -> Iterator[None]:
    """While a task is loaded, what lies in its ``folder`` can be imported by its bare name, and wins over another's of that name.

    Afterwards the path is given back, and a name that is another's outside of tasks. Else a neighbour keeps its name until the
    next task wants it, since a config may name a class by its module. Libraries, and what comes from the folder already, stay.
    """
    names = {entry.stem for entry in folder.iterdir() if entry.suffix == ".py" or (entry / "__init__.py").is_file()}
    hidden = {
        key: it
        for name in names & sys.modules.keys()
        if _may_be_hidden(name, folder)
        for key, it in _take_out(name).items()
    }
    before = {name.partition(".")[0] for name in sys.modules}
    mine = _neighbours_of.setdefault(folder, {})
    sys.modules.update(mine)
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()  # a file that was written a moment ago
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        mine |= {key: it for key, it in sys.modules.items() if key.partition(".")[0] in names - before}
        of_tasks = {id(it) for modules in _neighbours_of.values() for it in modules.values()}
        strangers = {key: it for key, it in hidden.items() if id(it) not in of_tasks}
        for name in {key.partition(".")[0] for key in strangers}:
            _take_out(name)
        sys.modules.update(strangers)


def _may_be_hidden(name: str, folder: Path) -> bool:
    """Whether the imported module ``name`` is one of a user's that lies elsewhere."""
    file = Path(getattr(sys.modules[name], "__file__", None) or folder / name).resolve()
    library = (
        name in sys.stdlib_module_names
        or name in ("__main__", "legged_mw", "configs")
        or {"site-packages", "dist-packages"} & {*file.parts}
    )
    return not library and not file.is_relative_to(folder)


@contextmanager
def _configs(*folders: Path) -> Iterator[None]:
    """While a task is loaded, ``configs`` is the package of these folders; the first one that has a module wins.

    Afterwards the name is given back if something else on the path has it.
    """
    places = [str(folder) for folder in folders]
    before = _take_out("configs")
    if before and [str(Path(place).resolve()) for place in before["configs"].__path__] == places:
        sys.modules.update(before)
        yield
        return
    package = ModuleType("configs")
    package.__path__ = places
    sys.modules.update(_loaded.get(tuple(places), {"configs": package}))
    try:
        yield
    finally:
        other = PathFinder.find_spec("configs")
        if before or (other and [*(other.submodule_search_locations or ())] != places):
            _loaded[tuple(places)] = _take_out("configs")
            sys.modules.update(before)


def _take_out(package: str) -> dict[str, ModuleType]:
    """Remove a package and its modules from those that are imported; returns them."""
    return {name: sys.modules.pop(name) for name in [*sys.modules] if name.partition(".")[0] == package}
