"""Bounds of a config's values, as types: the annotation of a field says what its number, list or table may hold.

    gamma: Share = 0.99
    interval: PositiveRange = [1.0, 3.0]
    stiffness: dict[str, NonNegative] = {}

A number is finite whatever its type. Errors and the reference of fields show the same text: `bounds_text`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import UnionType
from typing import Annotated, Any, NamedTuple, Union, get_args, get_origin

from legged_mw.utils.errors import CONTROL


class Bound(NamedTuple):
    """What values of a type a field takes."""

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
    float: Bound("finite, and 10^12 at most", lambda value: abs(value) <= 1e12),  # no unit of a config needs more
    # more than any machine counts, and few enough digits to print
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
PositiveShare = Annotated[float, above(0, 1)]  # a share that is not 0
Seconds = Annotated[float, above(0, 1e6, "s")]  # a million: what counts steps never overflows
Duration = Annotated[float, at_least(0, 1e6, "s")]  # such a time, or none
Speed = Annotated[float, at_least(0, 1000)]  # [m/s, rad/s]: no machine is as fast
Height = Annotated[float, at_least(0, 10, "m")]  # of a robot or of its feet
Swing = Annotated[float, above(0, 10, "m")]  # such a height, that is not 0
Angle = Annotated[float, Bound("from -2 pi to 2 pi rad, no degrees", lambda value: abs(value) <= 2 * math.pi)]
Gain = Annotated[float, at_least(0, 1e6)]  # in SI units, of a joint or motor: no robot has more
Sign = Annotated[float, Bound("1 or -1", lambda value: value in (1, -1))]

Count = Annotated[int, at_least(1)]
NonNegativeInt = Annotated[int, at_least(0)]
SmallInt = Annotated[int, at_least(1, 1000)]  # of what is repeated in a loop, where more would never end
Iterations = Annotated[int, at_least(0, 1_000_000)]
Threads = Annotated[int, at_least(0, 1024)]
Seed = Annotated[int, Bound("a whole number below 2^63", lambda value: abs(value) < 2**63)]

Names = Annotated[list[str], SOME]
Points = Annotated[list[Annotated[float, at_least(-100, 100, "m")]], SOME]
FileNames = list[Annotated[str, Bound("the name of a file", bool)]]
Sizes = Annotated[list[Count], SOME]  # of layers
NonNegativeVector = Annotated[list[NonNegative], THREE]
Range = Annotated[list[float], PAIR]
PositiveRange = Annotated[list[Positive], PAIR]
ShareRange = Annotated[list[Share], PAIR]

# Of a range that nothing needs to be drawn from: empty, it is left out
Factors = Annotated[list[Annotated[float, above(0, 1000)]], or_empty(PAIR)]
Frictions = Annotated[
    list[
        Annotated[
            float, Bound("from 1e-05, as which MuJoCo takes all below it, to 1000", lambda value: 1e-5 <= value <= 1000)
        ]
    ],
    or_empty(PAIR),
]
Places = Annotated[list[Annotated[float, at_least(-10, 10, "m")]], or_empty(PAIR)]
ContactTimes = Annotated[list[Annotated[float, at_least(1e-4, 10, "s")]], or_empty(PAIR)]
Offsets = Annotated[list[float], or_empty(PAIR)]
Shares = Annotated[list[Share], or_empty(PAIR)]
Delays = Annotated[list[NonNegative], or_empty(PAIR)]
StepDelays = Annotated[list[NonNegativeInt], or_empty(PAIR)]


def bare(kind: Any) -> Any:
    """A type without its bounds."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return bare(args[0])
    if origin is list:
        return list[bare(args[0])]
    if origin is dict:
        return dict[args[0], bare(args[1])]
    return Union[tuple(map(bare, args))] if origin in (Union, UnionType) else kind  # noqa: UP007 (X | Y takes no tuple)


def bounds_of(kind: Any) -> list[Bound]:
    """The bounds of the type itself, not of what it contains; a bare type has what holds always."""
    if get_origin(kind) is Annotated:
        return [bound for bound in get_args(kind)[1:] if isinstance(bound, Bound)]
    return [_ALWAYS[kind]] if kind in _ALWAYS else []


def bounds_text(kind: Any) -> str:
    """What a value of the type must be, in words that complete "it must be ..."; "" for a type without bounds."""
    origin, args = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return "; ".join(filter(None, [*(bound.text for bound in bounds_of(kind)), bounds_text(args[0])]))
    if origin in (list, dict):
        inner = bounds_text(args[-1])
        return inner and f"each {inner}"
    return ", or ".join(filter(None, map(bounds_text, args))) if origin in (Union, UnionType) else ""
