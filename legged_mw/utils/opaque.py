"""The core's one door to legged_mw/fast, the package that makes a step faster.

The core runs without that package and imports nothing from it: ``fast`` loads its modules by name, if they exist.
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

traces: list[Any] = []  # running traces of fast/trace.py, the innermost last


def tracing() -> bool:
    """Whether a trace is running."""
    return bool(traces)


def not_traced(method: Callable[P, R]) -> Callable[P, R]:
    """Decorate a method that a trace must not look into: the traced step calls it every time."""

    @wraps(method)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        return traces[-1].call_whole(method, args, kwargs) if traces else method(*args, **kwargs)

    return wrapped


@cache
def fast(module: str) -> Any:
    """The module legged_mw.fast.``module``, or None without the package. Errors inside of the module are raised."""
    # look in this project alone: another legged_mw may be installed
    package = PathFinder.find_spec("legged_mw.fast", legged_mw.__path__)
    if package is None or package.origin is None:  # no folder, or one without source files
        return None
    return import_module(f"legged_mw.fast.{module}")
