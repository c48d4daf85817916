"""Look up heights of a terrain on the device."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from legged_mw.sim.terrain import Terrain


class HeightMap:
    """The heights of a ``Terrain`` on a device. A lookup has a fixed shape and does not use the host."""

    def __init__(self, terrain: Terrain, device: str) -> None:
        self._rows, self._columns = terrain.heights.shape
        self._heights = torch.tensor(terrain.heights, dtype=torch.float, device=device).flatten()
        self._corner = torch.tensor(terrain.corner, dtype=torch.float, device=device)
        self._per_cell = 1.0 / terrain.cell

    def __call__(self, points: Tensor) -> Tensor:
        """Ground height [m] at ``points`` (..., 2) [m, world]; outside the height of the edge, for NaN of a corner."""
        place = ((points - self._corner) * self._per_cell).nan_to_num(0.0)
        u, v = place[..., 0].clamp(0.0, self._columns - 1.0), place[..., 1].clamp(0.0, self._rows - 1.0)
        column, row = u.floor().clamp(max=self._columns - 2.0), v.floor().clamp(max=self._rows - 2.0)
        across, along = u - column, v - row
        here = row.long() * self._columns + column.long()  # float32 is not exact for indices of a large field
        low, high = self._heights[here], self._heights[here + self._columns + 1]
        corner = torch.where(across >= along, self._heights[here + 1], self._heights[here + self._columns])
        return low + (corner - low) * torch.maximum(across, along) + (high - corner) * torch.minimum(across, along)


def make_height_map(terrain: Terrain, device: str) -> Callable[[Tensor], Tensor]:
    """The faster lookup for ``device``. Both lookups give the same heights."""
    if device == "cpu":
        return HeightMap(terrain, device)
    from legged_mw.sim.ground_contact import HeightLookup  # here, because importing warp takes about 1 s

    return HeightLookup(terrain, device)
