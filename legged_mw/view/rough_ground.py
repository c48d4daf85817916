"""The rough ground of a model: its height for cameras, and fine or coarse tiles for slow renderers.

The ground is height fields side by side. Where two are at the same place, one is a coarse copy of the other and is hidden at first.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.view.stage import FloatArray


class RoughGround:
    """All height fields of a model, at places (T, 2) with half edges (T, 2) [m], world frame; they do not move."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData) -> None:
        geoms = height_fields(model)
        vertices = model.hfield_nrow * model.hfield_ncol
        found: dict[tuple[float, float], list[int]] = {}
        for geom in sorted(geoms, key=lambda geom: -vertices[model.geom_dataid[geom]]):
            x, y = np.round(data.geom_xpos[geom, :2], 6)
            found.setdefault((x, y), []).append(int(geom))
        self._model = model
        self.fine, self.coarse = (np.array([same[which] for same in found.values()]) for which in (0, -1))  # (T,), the same if alone
        self.places: FloatArray = np.array(list(found))
        self.halves: FloatArray = np.array([model.hfield_size[model.geom_dataid[geom], :2] for geom in self.fine])
        self._bottoms: FloatArray = np.array(data.geom_xpos[self.fine, 2])

    def height(self, place: FloatArray) -> float:
        """Height [m] of the vertex nearest to `place` (2,) [m]; 0 outside of all tiles."""
        inside = np.flatnonzero((np.abs(self.places - place) <= self.halves).all(axis=1))
        if not len(inside):
            return 0.0
        tile, model = int(inside[0]), self._model
        field = int(model.geom_dataid[self.fine[tile]])
        rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
        share = (place - self.places[tile] + self.halves[tile]) / (2 * self.halves[tile])
        column, row = np.round(share * [columns - 1, rows - 1]).astype(int)
        vertex = model.hfield_data[model.hfield_adr[field] + row * columns + column]
        return float(vertex * model.hfield_size[field, 2] + self._bottoms[tile])

    def refine(self, place: FloatArray, reach: float) -> None:
        """Draw the tiles within `reach` [m] of `place` (2,) finely, the others coarsely."""
        near = (np.maximum(np.abs(self.places - place) - self.halves, 0.0) ** 2).sum(axis=1) < reach**2
        self._model.geom_rgba[self.coarse, 3] = ~near
        self._model.geom_rgba[self.fine, 3] = near | (self.fine == self.coarse)


def height_fields(model: mujoco.MjModel) -> NDArray[np.int64]:
    """Indices of the geoms that are height fields."""
    return np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)
