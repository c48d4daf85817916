"""The core's only access to legged_mw/fast, the package that makes a step faster.

The core runs without that package. It imports nothing from it; ``fast`` loads its modules by name if they exist.
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

traces: list[Any] = []  # active traces of fast/trace.py, innermost last


def not_traced(method: Callable[P, R]) -> Callable[P, R]:
    """Decorate a method whose body is not traced: the compiled step calls the method itself."""

    @wraps(method)
    def wrapped(*args: Any, **kwargs: Any) -> Any:
        return traces[-1].call_whole(method, args, kwargs) if traces else method(*args, **kwargs)

    return wrapped


@cache
def fast(module: str) -> Any:
    """The module legged_mw.fast.``module``, or None without the package. Import errors of the module are raised."""
    # search only this project, because another legged_mw may be installed
    package = PathFinder.find_spec("legged_mw.fast", legged_mw.__path__)
    if package is None or package.origin is None:  # no folder, or a folder without source files
        return None
    return import_module(f"legged_mw.fast.{module}")
