"""Level pieces of a terrain as boxes: MuJoCo makes a tilted contact with every triangle of a height field that is near, with a box none."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from legged_mw.sim.terrain import LEVEL, Heights, Terrain

MOST_BOXES = 1000  # of a tile; what needs more stays a height field


class Box(NamedTuple):
    """A block of ground whose top is level."""

    low: tuple[float, float]  # corner x, y [m, world]
    high: tuple[float, float]  # the opposite one
    top: float  # [m]


def as_boxes(terrain: Terrain) -> tuple[list[Box], Heights, list[str]]:
    """Tiles that are few level pieces as boxes, the heights of all else, sunk by 1 m under the boxes, and its kinds.

    Steps are upright there, midway between the vertices where the height field has a slope of one cell.
    """
    heights, boxes, left = terrain.heights.copy(), [], set()
    n = round(terrain.tile / terrain.cell)
    for column, level in np.ndindex(len(terrain.kinds), terrain.levels):
        where, kind = terrain.vertices(level, column), terrain.kinds[column]
        is_level = kind in LEVEL or not np.ptp(terrain.heights[where])
        pieces = _level_pieces(np.round(terrain.heights[where], 6)) if is_level else []
        if not pieces or len(pieces) > MOST_BOXES:
            left.add(kind)
            continue
        for rows, columns, top in pieces:
            y, x = (tile.start + np.clip([*span], 0.5, n + 0.5) - 0.5 for tile, span in zip(where, (rows, columns), strict=True))
            low, high = zip(terrain.corner[0] + x * terrain.cell, terrain.corner[1] + y * terrain.cell, strict=True)
            boxes.append(Box(low, high, top))
        inside = heights[where][1:-1, 1:-1]
        inside[...] = inside.min() - 1.0
    return boxes, heights, sorted(left)


def _level_pieces(patch: Heights) -> list[tuple[tuple[int, int], tuple[int, int], float]]:
    """Rectangles of vertices of one height: first row and the one after the last, columns likewise, height; too many: cut short."""
    taken = np.zeros(patch.shape, dtype=bool)
    pieces: list[tuple[tuple[int, int], tuple[int, int], float]] = []
    for row in range(patch.shape[0]):
        while not taken[row].all() and len(pieces) <= MOST_BOXES:
            first = int(np.argmin(taken[row]))
            differs = np.flatnonzero((patch[row, first:] != patch[row, first]) | taken[row, first:])
            last = first + int(differs[0]) if len(differs) else patch.shape[1]
            same = ((patch[row:, first:last] == patch[row, first]) & ~taken[row:, first:last]).all(axis=1)
            end = row + (int(np.argmin(same)) if not same.all() else len(same))
            taken[row:end, first:last] = True
            pieces.append(((row, end), (first, last), float(patch[row, first])))
    return pieces
