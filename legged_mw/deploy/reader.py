"""Takes typed values out of a contract; what is wrong is one clear line."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from legged_mw.utils.errors import UserError


class ContractError(UserError, ValueError):
    """An export that cannot be deployed; the text names the file, what it states, what was expected and what to do."""


class Reader:
    """Takes typed values out of a mapping; a missing or ill-typed one is one clear line."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.values, self.where = values, where

    def take(self, key: str, wanted: str, fits: Callable[[Any], bool]) -> Any:
        """The value of ``key`` if it fits; ``wanted`` are the words for what does."""
        if key not in self.values or not fits(self.values[key]):
            found = f"is {self.values[key]!r}" if key in self.values else "is missing"
            raise ContractError(f"{self.where}: '{key}' {found}; it must be {wanted}")
        return self.values[key]

    def section(self, key: str) -> Reader:
        return Reader(self.take(key, "a mapping", lambda v: isinstance(v, dict)), f"{self.where}: {key}")

    def sections(self, key: str, empty: bool = False) -> list[Reader]:
        items = self.take(key, "a list of mappings", lambda v: is_list(v, lambda item: isinstance(item, dict), empty))
        return [Reader(item, f"{self.where}: {key}[{i}]") for i, item in enumerate(items)]

    def text(self, key: str, empty: bool = False) -> str:
        return self.take(key, "text", lambda v: isinstance(v, str) and (empty or v != ""))

    def texts(self, key: str, empty: bool = False) -> tuple[str, ...]:
        return tuple(self.take(key, "a list of names", lambda v: is_list(v, lambda item: isinstance(item, str), empty)))

    def count(self, key: str) -> int:
        return self.take(key, "a whole number from 1", lambda v: isinstance(v, int) and not isinstance(v, bool) and v >= 1)

    def number(self, key: str, low: float = -math.inf, high: float = math.inf) -> float:
        limits = (f" from {low:g}" if low > -math.inf else "") + (f" to {high:g}" if high < math.inf else "")
        return float(self.take(key, f"a number{limits}", lambda v: is_number(v) and low <= v <= high))

    def above_zero(self, key: str) -> float:
        self.number(key)
        return float(self.take(key, "above zero", lambda v: v > 0))

    def numbers(self, key: str, count: int, of: str) -> np.ndarray:
        return np.array(self.take(key, f"{count} numbers, one a {of}", lambda v: is_list(v, is_number) and len(v) == count), dtype=float)

    def scale(self, count: int, of: str) -> np.ndarray:
        """``scale`` as one number a value; one for all may stand for them."""
        wanted = f"a number, or {count} numbers, one a {of}"
        value = self.take("scale", wanted, lambda v: is_number(v) or (is_list(v, is_number) and len(v) == count))
        return np.full(count, value, dtype=float) if is_number(value) else np.array(value, dtype=float)


def is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def is_list(value: object, fits: Callable[[Any], bool], empty: bool = False) -> bool:
    return isinstance(value, list) and (empty or len(value) > 0) and all(map(fits, value))
