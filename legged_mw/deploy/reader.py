"""Takes typed values out of a contract; what is wrong is one clear line."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.utils.errors import UserError, brief

MOST = 1e6  # no quantity of a robot is larger, in any unit
MOST_VALUES = 10_000_000  # of an observation: a camera's picture has a tenth


class ContractError(UserError, ValueError):
    """An export that cannot be deployed; the text names the file, what it states, what was expected and what to do."""


class Reader:
    """Takes typed values out of a mapping; a missing or ill-typed one is one clear line."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.values, self.where = values, where

    def take(self, key: str, wanted: str, fits: Callable[[Any], bool]) -> Any:
        """The value of ``key`` if it fits; ``wanted`` are the words for what does."""
        if key not in self.values or not fits(self.values[key]):
            found = f"is {brief(self.values[key])}" if key in self.values else "is missing"
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

    def count(self, key: str, most: int = MOST_VALUES) -> int:
        value = self.take(
            key, "a whole number from 1", lambda v: isinstance(v, int) and not isinstance(v, bool) and v >= 1
        )
        return value if value <= most else self.take(key, f"{most} at most", lambda v: False)

    def number(self, key: str, low: float = -MOST, high: float = MOST) -> float:
        beyond = is_number(self.values.get(key)) and abs(self.values[key]) > MOST
        limits = (f" from {low:g}" if beyond or low > -MOST else "") + (
            f" to {high:g}" if beyond or high < MOST else ""
        )
        return float(self.take(key, f"a number{limits}", lambda v: is_number(v) and low <= v <= high))

    def above_zero(self, key: str, high: float = MOST) -> float:
        self.number(key, -MOST, high)
        return float(self.take(key, "above zero", lambda v: v > 0))

    def numbers(self, key: str, count: int, of: str, low: float = -MOST, high: float = MOST) -> np.ndarray:
        value = self.take(key, f"{count} numbers, one a {of}", lambda v: is_list(v, is_number) and len(v) == count)
        self.take(key, f"numbers from {low:g} to {high:g}", lambda v: low <= min(v) and max(v) <= high)
        return np.array(value, dtype=float)

    def file(self, key: str, name: str) -> None:
        """An export's files have fixed names and lie beside the contract, whoever wrote it."""
        if key in self.values:
            self.take(key, f"{name}, which lies beside {self.where.partition(':')[0]}", lambda v: v == name)

    def scale(self, count: int, of: str) -> np.ndarray:
        """``scale`` as one number a value; one for all may stand for them."""
        wanted = f"a number, or {count} numbers, one a {of}"
        value = self.take("scale", wanted, lambda v: is_number(v) or (is_list(v, is_number) and len(v) == count))
        self.take("scale", f"of {MOST:g} at most", lambda v: np.max(np.abs(v)) <= MOST)
        return np.full(count, value, dtype=float) if is_number(value) else np.array(value, dtype=float)


def compile_scene(file: Path) -> Any:
    """The model in an export's scene. Raises ContractError."""
    from legged_mw.robot.mjcf import Source, check_model  # which bring MuJoCo

    try:
        model = Source(file, alone=True).spec().compile()
        check_model(model)
    except (ValueError, OSError) as error:
        raise ContractError(f"{file.name} is not a valid MJCF: {' '.join(str(error).split())}") from None
    return model


def is_number(value: object) -> bool:
    # a whole number may be no float
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def is_list(value: object, fits: Callable[[Any], bool], empty: bool = False) -> bool:
    return isinstance(value, list) and (empty or len(value) > 0) and all(map(fits, value))
