"""Bounds of a config's values, as types: a field's annotation limits its number, list or table.

    gamma: Share = 0.99
    interval: PositiveRange = [1.0, 3.0]
    stiffness: dict[str, NonNegative] = {}

All numbers must be finite. Errors and the reference of fields show the same text, `bounds_text`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

from legged_mw.utils.errors import CONTROL


class Bound(NamedTuple):
    """A condition on the value of a field."""

    text: str  # completes "it must be ..."
    holds: Callable[[Any], bool]


def _written(number: float) -> str:
    return f"{number:,.0f}" if number >= 1e4 else f"{number:g}"


def at_least(low: float, most: float = math.inf, unit: str = "") -> Bound:
    text = f"{low:g} or more" if most == math.inf else f"from {low:g} to {_written(most)}"
    return Bound(f"{text}{unit and f' {unit}'}", lambda value: low <= value <= most)


def above(low: float, most: float = math.inf, unit: str = "") -> Bound:
    text = f"above {low:g}" if most == math.inf else f"above {low:g} and at most {_written(most)}"
    return Bound(f"{text}{unit and f' {unit}'}", lambda value: low < value <= most)


_ALWAYS = {
    float: Bound("finite, and 10^12 at most", lambda value: abs(value) <= 1e12),  # enough for all units in a config
    int: Bound("below 10^24", lambda value: abs(value) < 10**24),
    str: Bound("text without control characters", lambda value: not CONTROL.search(value)),
}


def or_empty(bound: Bound) -> Bound:
    return Bound(f"{bound.text}, or an empty list", lambda value: not value or bound.holds(value))


PAIR = Bound("two numbers, the lower first", lambda value: len(value) == 2 and value[0] <= value[1])
THREE = Bound("three numbers", lambda value: len(value) == 3)
SOME = Bound("a list of at least one", lambda value: len(value) > 0)

Positive = Annotated[float, above(0)]
NonNegative = Annotated[float, at_least(0)]
Scale = Annotated[float, Bound("another number than 0, and 10,000 at most", lambda value: 0 < abs(value) <= 1e4)]
Share = Annotated[float, at_least(0, 1)]
PositiveShare = Annotated[float, above(0, 1)]
Seconds = Annotated[float, above(0, 1e6, "s")]  # at most 1e6, so that counters of steps never overflow
Duration = Annotated[float, at_least(0, 1e6, "s")]  # as Seconds, or 0
Speed = Annotated[float, at_least(0, 1000)]  # [m/s, rad/s] more than any machine has
Height = Annotated[float, at_least(0, 10, "m")]  # of a robot or its feet
Angle = Annotated[float, Bound("from -2 pi to 2 pi rad, no degrees", lambda value: abs(value) <= 2 * math.pi)]
Gain = Annotated[float, at_least(0, 1e6)]  # of a joint or motor, in SI units; more than any robot has
Sign = Annotated[float, Bound("1 or -1", lambda value: value in (1, -1))]

Count = Annotated[int, at_least(1)]
NonNegativeInt = Annotated[int, at_least(0)]
SmallInt = Annotated[int, at_least(1, 1000)]  # repetitions of a slow loop
Threads = Annotated[int, at_least(0, 1024)]

Names = Annotated[list[str], SOME]
Range = Annotated[list[float], PAIR]
PositiveRange = Annotated[list[Positive], PAIR]


def bare(kind: Any) -> Any:
    """The type without its bounds."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return bare(args[0])
    if origin is list:
        return list[bare(args[0])]
    if origin is dict:
        return dict[args[0], bare(args[1])]
    return Union[tuple(map(bare, args))] if origin in (Union, UnionType) else kind  # noqa: UP007 (X | Y takes no tuple)


def bounds_of(kind: Any) -> list[Bound]:
    """The bounds of the type, not of its elements. A type without own bounds has those of ``_ALWAYS``."""
    if get_origin(kind) is Annotated:
        return [bound for bound in get_args(kind)[1:] if isinstance(bound, Bound)]
    return [_ALWAYS[kind]] if kind in _ALWAYS else []


def bounds_text(kind: Any) -> str:
    """The bounds of a type as text that completes "it must be ..."; "" if it has none."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return "; ".join(filter(None, [*(bound.text for bound in bounds_of(kind)), bounds_text(args[0])]))
    if origin in (list, dict):
        inner = bounds_text(args[-1])
        return inner and f"each {inner}"
    return ", or ".join(filter(None, map(bounds_text, args))) if origin in (Union, UnionType) else ""
