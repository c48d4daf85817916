"""The user's classes of a task, what their methods must return, and where they are written: for errors that name the line."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from legged_mw.envs.observations import Row
from legged_mw.utils.errors import StepError, line_of


def check_term(method: Callable[[], Any], count: int) -> Tensor:
    """What a reward method returns, if it is a number an environment. Raises StepError with the method's place."""
    value = method()
    if not isinstance(value, Tensor) or value.shape != (count,):
        got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise StepError(
            f"must return a tensor ({count},), one value an environment; it returned {got}", place_of(method)
        )
    return value


def checked_rows(env: Any) -> Mapping[str, Any]:
    """``env``'s table of observation rows, if all of it is of the kind that it must be. Raises StepError with its place."""
    table, count, where = env.observation_rows(), env.num_envs, place_of(env.observation_rows)
    if not isinstance(table, Mapping) or not all(isinstance(rows, list | tuple) and rows for rows in table.values()):
        raise StepError(f"must return group -> list of rows; it returned {type(table).__name__}", where)
    for group, row in [(group, row) for group, rows in table.items() for row in rows if not isinstance(row, str)]:
        if not isinstance(row, Row):
            raise StepError(
                f"group '{group}' holds {type(row).__name__}; write Row(name, value, ...), or the name of a group",
                where,
            )
        value = row.value
        if not isinstance(value, Tensor) or value.dim() != 2 or len(value) != count or not value.numel():
            got = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
            raise StepError(
                f"row '{row.name}' of '{group}' is {got}; it must be a tensor ({count}, size), a row a world", where
            )
    return table


def own_classes(env_class: type) -> list[type]:
    """The classes of an environment that are the user's, the child first."""
    return [kind for kind in env_class.__mro__ if not kind.__module__.startswith("legged_mw.") and kind is not object]


def place_of(method: Any) -> str:
    """Where a method is written."""
    method = getattr(method, "func", method)  # of a partial
    function = inspect.unwrap(getattr(method, "__func__", method))
    return line_of(function.__code__, function.__code__.co_firstlineno)
