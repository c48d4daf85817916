"""The terrain tile of each world, and the terrain curriculum.

The rules are legged_gym's. A robot that leaves its tile goes one level up. A robot that walks less than half of the
commanded distance goes one level down. A robot that succeeds on the last level goes to a random level. The distance is
measured along the command. The commanded distance of a turn on the spot is 0.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.sim.terrain import Terrain, make_terrain
from legged_mw.utils.errors import ModelError

FIELDS = {  # parameter of make_terrain -> its config field
    "proportions": "terrain.terrain_proportions",
    "columns": "terrain.num_cols",
    "tile": "terrain.tile_size",
    "cell": "terrain.horizontal_scale",
}


def build_terrain(cfg: LeggedRobotCfg) -> Terrain | None:
    """The terrain of the section ``terrain``; None: a plane."""
    ground = cfg.terrain
    if ground.mesh_type == "plane":
        return None
    try:
        return make_terrain(
            levels=ground.num_rows,
            difficulty=(ground.difficulty[0], ground.difficulty[1]),
            proportions=ground.terrain_proportions,
            columns=ground.num_cols,
            tile=ground.tile_size,
            cell=ground.horizontal_scale,
            border=ground.border_size,
            seed=ground.seed,
        )
    except ModelError as error:
        raise error.renamed(FIELDS) from None


class Tiles:
    """The tiles of N worlds, in fixed tensors."""

    written = ("levels", "origins")

    def __init__(self, cfg: LeggedRobotCfg, terrain: Terrain, num_envs: int, device: str) -> None:
        self.curriculum, self.size, self.num_levels = cfg.terrain.curriculum, terrain.tile, terrain.levels
        highest = min(cfg.terrain.max_init_terrain_level, terrain.levels - 1) if self.curriculum else terrain.levels - 1
        self.levels = torch.randint(0, highest + 1, (num_envs,), device=device)  # (N,) row of the tile
        world = torch.arange(num_envs, device=device)
        self.columns = (2 * world + 1) * len(terrain.kinds) // (2 * num_envs)  # (N,) fixed; not all if N is small
        self._all_origins = torch.tensor(terrain.origins, dtype=torch.float, device=device)  # (levels, columns, 3)
        self.origins = self._all_origins[self.levels, self.columns]  # (N, 3) where an episode begins [m, world]
        tiles = torch.tensor([terrain.levels, len(terrain.kinds)], dtype=torch.float, device=device)
        self.edge = tiles * terrain.tile / 2 + cfg.terrain.border_size / 2  # x, y [m]; outside, a robot has left it
        self.kinds = tuple(dict.fromkeys(terrain.kinds))
        kind = torch.tensor([self.kinds.index(name) for name in terrain.kinds], device=device)[self.columns]
        self._is_kind = torch.nn.functional.one_hot(kind, len(self.kinds)).float()  # (N, kinds)
        self._count = self._is_kind.sum(dim=0)

    def put(self, levels: Tensor) -> None:
        """Set the level (N,) of each world, for its next reset."""
        self.levels.copy_(levels)
        self.origins.copy_(self._all_origins[self.levels, self.columns])

    def promote(self, mask: Tensor, up: Tensor, down: Tensor) -> None:
        """Change levels where ``mask`` (N,) is true by one; random above the last level, or without a curriculum."""
        level = self.levels + up.long() - down.long()
        anywhere = torch.randint_like(level, self.num_levels)
        level = torch.where(level >= self.num_levels, anywhere, level.clamp(min=0)) if self.curriculum else anywhere
        self.put(torch.where(mask, level, self.levels))

    def of_kinds(self, table: Mapping[str, float]) -> Tensor | None:
        """(N,) Each world's number in ``table``, by its kind of ground, else 0; None if the table is empty."""
        numbers = [table.get(kind, 0.0) for kind in self.kinds]
        return self._is_kind @ self._is_kind.new_tensor(numbers) if table else None

    def statistics(self) -> dict[str, Tensor]:
        """Mean level of all worlds and of each kind of ground, as (2,) sum and count."""
        sums = torch.stack([self.levels.float() @ self._is_kind, self._count])  # (2, kinds)
        by_kind = {f"terrain_level/{kind}": sums[:, i] for i, kind in enumerate(self.kinds)}
        return {"terrain_level": sums.sum(dim=1), **by_kind}
