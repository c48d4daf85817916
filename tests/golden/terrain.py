"""Kinds of ground, the package's and one's own."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from test_terrain import terrain

from golden.table import Table
from legged_mw.sim.terrain import KINDS, LEVEL, MEASURES, add_kind

OWN: dict[str, Callable[..., Any]] = {
    "another shape": lambda grid, *_: grid.zeros()[1:],
    "no rim": lambda grid, difficulty, _: grid.zeros() + difficulty,
    "no start": lambda grid, *_: np.where(grid.distance < 0.5, 0.01, 0.0),
    "a hole of NaN": lambda grid, *_: np.where(grid.distance < 0.1, np.nan, 0.0),
}


def own(make: Callable[..., Any]) -> None:
    def kind(grid: Any, difficulty: float, rng: Any) -> Any:
        return make(grid, difficulty, rng)

    kept = [table.copy() for table in (KINDS, MEASURES, LEVEL)]
    try:
        add_kind()(kind)
        terrain(proportions={"kind": 1.0})
    finally:
        for table, before in zip((KINDS, MEASURES, LEVEL), kept, strict=True):
            table.clear()
            table.update(before)  # type: ignore[arg-type]


def gap(grid: Any, difficulty: float, rng: Any) -> Any:
    return grid.zeros()


def table() -> Table:
    made = Table()
    made.calls(
        {
            "no such kind": lambda: terrain(proportions={"stair_up": 1.0}),
            "a tile of half a cell": lambda: terrain(tile=8.05),
            "few columns": lambda: terrain(columns=3),
            "no shares": lambda: terrain(proportions={"flat": 0.0}),
            "too many heights": lambda: terrain(cell=0.002),
            "a kind's measure alone": lambda: add_kind("depth [cm]"),
            "a kind's measure of numbers": lambda: add_kind(5, 40),  # type: ignore[arg-type]
            "a kind of the package": lambda: add_kind()(gap),
        }
    )
    made.calls({f"own kind: {name}": lambda make=make: own(make) for name, make in OWN.items()})
    return made
