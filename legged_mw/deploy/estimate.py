"""The second output of an exported network: what the policy believes of values that no robot measures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

ESTIMATE = "estimate"  # the output's name, and the contract's section that lists its rows


class Estimated(NamedTuple):
    """One row of the output."""

    name: str
    size: int
    unit: str
    frame: str


def read_estimated(rows: Sequence[Any]) -> tuple[Estimated, ...]:
    """The rows from the contract's readers of ``estimate``."""
    return tuple(
        Estimated(row.text("name"), row.count("size"), row.text("unit", empty=True), row.text("frame", empty=True))
        for row in rows
    )


def columns_of(rows: Sequence[Estimated], name: str) -> slice | None:
    """Columns of the row ``name`` in the output; None if it is not estimated."""
    start = 0
    for row in rows:
        if row.name == name:
            return slice(start, start + row.size)
        start += row.size
    return None
