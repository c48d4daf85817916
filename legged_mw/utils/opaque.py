"""What the core knows of legged_mw/fast, the package that makes a step faster: which calls it may not look into, and its modules.

The core runs without that package. So it imports nothing from there: it asks here, and None means that the package is not there.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from importlib import import_module
from importlib.machinery import PathFinder
from typing import Any, ParamSpec, TypeVar

import legged_mw

P = ParamSpec("P")
R = TypeVar("R")

traces: list[Any] = []  # those that fast/trace.py takes at the moment, the innermost last


def tracing() -> bool:
    """Whether a trace is taken at the moment."""
    return bool(traces)


def not_traced(method: Callable[P, R]) -> Callable[P, R]:
    """Of a method that a trace is not to look into: it is called anew each time."""

    @wraps(method)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        return traces[-1].call_whole(method, args, kwargs) if traces else method(*args, **kwargs)

    return wrapped


@cache
def fast(module: str) -> Any:
    """That module of legged_mw.fast, or None without the package. An error inside of the module is raised."""
    # in this project, wherever another is installed
    package = PathFinder.find_spec("legged_mw.fast", legged_mw.__path__)
    if package is None or package.origin is None:  # no folder, or one without source files
        return None
    return import_module(f"legged_mw.fast.{module}")
