"""Rough ground: one height field of tiles, with levels of difficulty along x and kinds of ground along y.

Heights are computed here once, on the host, and looked up on the device.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from legged_mw.utils.errors import ModelError, unknown

Heights = NDArray[np.float64]
STEP = (0.06, 0.195)  # [m] of stairs at difficulty 0 and 1 [legged_gym: 0.05, 0.23; ours: for a leg of 0.43]
BLOCK = (0.05, 0.25)  # [m] of blocks and holes [legged_gym]
STONE_GAP = (0.05, 0.2)  # [m] between stones [legged_gym: 0.05, 0.1]
DITCH = (0.05, 0.6)  # [m] of width [legged_gym: 0 to 1]
SLOPE, WAVE, NOISE = 0.4, 0.3, 0.05  # at difficulty 1: [-], then [m]; a wave from trough to crest
MOST_HEIGHTS = 1e8  # largest number of heights: 0.8 GB on the host, half of it on the device
# [m] half the edge of the flat middle of a tile, where robots begin [legged_gym: 3 m in all for most, ours 2]
PLATFORM = 1.0


@dataclass(frozen=True)
class Terrain:
    """A height field of tiles inside a flat border: ``levels`` along x, ``len(kinds)`` along y.

    Each cell is two triangles, divided by the diagonal from (row, column) to (row + 1, column + 1), as in MuJoCo.
    """

    heights: Heights  # (R, C) [m], row = +y, column = +x, vertices at the rim included
    cell: float  # [m] between two vertices
    corner: tuple[float, float]  # x, y of the vertex (0, 0) [m, world]
    tile: float  # [m] edge of a tile
    kinds: tuple[str, ...]  # kind of each column of tiles
    difficulties: tuple[float, ...]  # difficulty of each level
    origins: NDArray[np.float64]  # (levels, kinds, 3) centre of each tile, on the ground [m, world]

    @property
    def levels(self) -> int:
        return len(self.origins)

    def tile_at(self, x: float, y: float) -> tuple[int, int] | None:
        """Level and column of the tile at x, y [m, world]; None outside the tiles."""
        level = int(np.floor(x / self.tile + self.levels / 2))
        column = int(np.floor(y / self.tile + len(self.kinds) / 2))
        return (level, column) if 0 <= level < self.levels and 0 <= column < len(self.kinds) else None

    def vertices(self, level: int, column: int) -> tuple[slice, slice]:
        """Rows and columns of ``heights`` in a tile, including its rim."""
        n = round(self.tile / self.cell)
        edge = (self.heights.shape[1] - 1 - self.levels * n) // 2
        y, x = edge + column * n, edge + level * n
        return slice(y, y + n + 1), slice(x, x + n + 1)

    def span(self) -> tuple[float, float]:
        """Lowest and highest point [m]."""
        return float(self.heights.min()), float(self.heights.max())


def make_terrain(
    *,
    levels: int,
    proportions: Mapping[str, float],  # kind -> share of the columns
    columns: int,
    difficulty: tuple[float, float] = (0.0, 1.0),  # of the first level and of the last level
    tile: float,
    cell: float,
    border: float,
    seed: int,
) -> Terrain:
    """Build all tiles. The difficulty rises linearly with the level. Raises ModelError for invalid arguments."""
    for kind in proportions:
        if kind not in KINDS:
            raise ModelError.of(("proportions", unknown("kind of terrain", kind, KINDS, "the table of kinds")))
    n = round(tile / cell)
    if abs(n * cell - tile) > 1e-6 or tile < 4 * PLATFORM:
        must = f"must be a whole number of cells of {cell:g} m, and at least {4 * PLATFORM:g} m"
        raise ModelError.of(("tile", f"{tile:g} m {must}"))
    kinds, rng = share_columns(proportions, columns), np.random.default_rng(seed)
    edge = round(border / cell)
    shape = (columns * n + 2 * edge + 1, levels * n + 2 * edge + 1)
    count = shape[0] * shape[1]
    if count > MOST_HEIGHTS:
        tiles = f"{levels} x {columns} tiles of {tile:g} m with a height every {cell:g} m"
        instead = f"take larger cells, fewer or smaller tiles, or less than {border:g} m around them"
        many = f"have {count / 1e6:.0f} million heights, more than {MOST_HEIGHTS / 1e6:.0f}"
        raise ModelError.of(("cell", f"{tiles} {many}; {instead}"))
    field = np.zeros(shape)
    origins = np.zeros((levels, columns, 3))
    corner = (-0.5 * levels * tile - edge * cell, -0.5 * columns * tile - edge * cell)
    difficulties = tuple(_between(difficulty, level / max(levels - 1, 1)) for level in range(levels))
    for column, kind in enumerate(kinds):
        for level, hard in enumerate(difficulties):
            grid = Grid(n, cell, pit=(column + level) % 2 == 0)
            patch = _checked(KINDS[kind](grid, hard, rng), kind, grid)
            row0, col0, half = edge + column * n, edge + level * n, n // 2
            field[row0 : row0 + n + 1, col0 : col0 + n + 1] = patch
            middle = (corner[0] + (col0 + half) * cell, corner[1] + (row0 + half) * cell)
            origins[level, column] = *middle, patch[half, half]
    return Terrain(field, cell, corner, tile, kinds, difficulties, origins)


def _checked(patch: Heights, kind: str, grid: Grid) -> Heights:
    """The heights from the function of ``kind``. Raises ModelError if they are not a valid tile."""
    patch, shape, name = np.asarray(patch, dtype=float), grid.zeros().shape, f"kind of terrain '{kind}'"
    if patch.shape != shape:
        raise ModelError(f"{name} returned heights of shape {patch.shape}; a tile has {shape}, as grid.zeros()")
    rim = np.concatenate([patch[[0, -1]].ravel(), patch[:, [0, -1]].ravel()])
    if not np.isfinite(patch).all() or np.abs(rim).max() > 1e-9:
        must = "its heights must be finite, and 0 along the rim so that tiles fit together"
        raise ModelError(f"{name}: {must} (grid.fade does that)")
    if np.ptp(patch[grid.distance < PLATFORM - 0.5 * grid.cell]) > 1e-3:
        must = f"it must be level within {PLATFORM:g} m of its middle, where robots begin"
        raise ModelError(f"{name}: {must} (grid.fade does that)")
    return patch


def share_columns(proportions: Mapping[str, float], columns: int) -> tuple[str, ...]:
    """A kind for each column, in the given order. Shares are rounded to whole columns, at least one per kind."""
    shares = {kind: share for kind, share in proportions.items() if share > 0}
    if not shares:
        none = f"no kind has a share above 0, in {dict(proportions)}; there are: {', '.join(KINDS)}"
        raise ModelError.of(("proportions", none))
    if len(shares) > columns:
        few = f"{columns} columns cannot hold {len(shares)} kinds; every kind with a share above 0 needs one"
        raise ModelError.of(("columns", few))
    bounds = np.cumsum(list(shares.values())) / sum(shares.values())
    places = np.searchsorted(bounds, (np.arange(columns) + 0.5) / columns).clip(max=len(shares) - 1)
    kinds = [list(shares)[place] for place in places]
    for kind in shares:
        if kind not in kinds:
            most = max(shares, key=kinds.count)
            kinds[len(kinds) - 1 - kinds[::-1].index(most)] = kind
    return tuple(sorted(kinds, key=list(shares).index))


# ---- heights on the device


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


# ---- kinds of ground: (n + 1, n + 1) heights, flat at the centre and zero at the rim, so that tiles fit together


@dataclass(frozen=True)
class Grid:
    """The vertices of one tile, (n + 1, n + 1)."""

    n: int  # cells along an edge
    cell: float  # [m] between two vertices
    pit: bool  # true for every second tile along both axes: kinds that go up or down then make a pit

    @property
    def distance(self) -> Heights:
        """Distance from the centre [m]: the larger of |x| and |y|."""
        along = np.abs(np.arange(self.n + 1) - self.n / 2) * self.cell
        return np.maximum(along[:, None], along[None, :])

    @property
    def half(self) -> float:
        """Half of the edge [m], which is the largest distance."""
        return 0.5 * self.n * self.cell

    def zeros(self) -> Heights:
        return np.zeros((self.n + 1, self.n + 1))

    def fade(self, heights: Heights) -> Heights:
        """Scale ``heights`` to 0 at the centre, and at the rim over the last 0.5 m."""
        inside = np.clip((self.distance - PLATFORM) / 0.3, 0.0, 1.0)
        outside = np.clip((self.half - self.distance) / 0.5, 0.0, 1.0)
        return heights * inside * outside


# function of the grid, the difficulty (0 easy, 1 hard, 2 at most) and the random generator
Kind = Callable[[Grid, float, np.random.Generator], Heights]

KINDS: dict[str, Kind] = {}
# kind -> its measure of difficulty "name [unit]", and its values at difficulty 0 and 1
MEASURES: dict[str, tuple[str, float, float]] = {}
LEVEL: set[str] = set()  # kinds made of level pieces


def add_kind(measure: str = "", low: float = 0.0, high: float = 0.0, *, level: bool = False) -> Callable[[Kind], Kind]:
    """Register the decorated function as a kind of ground with its own name.

    ``measure``: its measure of difficulty, such as "depth [cm]"; ``low`` and ``high``: values at difficulty 0 and 1.
    ``level``: it consists of level pieces, such as steps; MuJoCo's own engine and exports make boxes of them.
    """
    if not isinstance(measure, str) or (measure and low == high):
        must = "name what makes the kind hard and its value at difficulty 0 and 1"
        example = 'as in @add_kind("depth [cm]", 5, 40), or write @add_kind()'
        raise ModelError(f"add_kind({measure!r}, {low:g}, {high:g}): {must}, {example}")

    def add(kind: Kind) -> Kind:
        name = kind.__name__
        if name in KINDS and KINDS[name].__module__ == __name__:
            instead = f"give yours another name than {', '.join(KINDS)}"
            raise ModelError(f"kind of terrain '{name}' is one of the package's own; {instead}")
        KINDS[name] = kind
        MEASURES.pop(name, None)
        LEVEL.discard(name)
        if measure:
            MEASURES[name] = (measure, low, high)
        if level:
            LEVEL.add(name)
        return kind

    return add


@add_kind(level=True)
def flat(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Level ground."""
    return grid.zeros()


@add_kind("slope [%]", 0.0, 100 * SLOPE)
def smooth_slope(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """A pyramid or, every second time, a pit, with a slope of up to 0.4 [legged_gym; ours: alternating, not random]."""
    rise = SLOPE * difficulty * np.clip(grid.half - 0.5 - np.maximum(grid.distance, PLATFORM), 0.0, None)
    return -rise if grid.pit else rise


@add_kind("slope [%]", 0.0, 100 * SLOPE)
def rough_slope(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """The same, with 5 cm of noise [legged_gym]."""
    return smooth_slope(grid, difficulty, rng) + grid.fade(_noise(grid, 0.05, 0.2, rng))


@add_kind("step [cm]", 100 * STEP[0], 100 * STEP[1], level=True)
def stairs_up(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Stairs from a pit at the centre up to the rim. Steps are 6 to 19.5 cm high and 30 cm deep."""
    return -_stairs(grid, _between(STEP, difficulty))


@add_kind("step [cm]", 100 * STEP[0], 100 * STEP[1], level=True)
def stairs_down(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Stairs from the top at the centre down to the rim."""
    return _stairs(grid, _between(STEP, difficulty))


@add_kind("height [cm]", 100 * BLOCK[0], 100 * BLOCK[1], level=True)
def obstacles(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Twenty blocks and holes of 5 to 25 cm, 1 to 2 m across [legged_gym]."""
    heights, height = grid.zeros(), _between(BLOCK, difficulty)
    for _ in range(20):
        size = rng.integers(round(1.0 / grid.cell), round(2.0 / grid.cell) + 1, 2)
        low = [int(rng.integers(0, max(grid.n + 1 - s, 1))) for s in size]
        level = rng.choice([-height, -height / 2, height / 2, height])
        heights[low[0] : low[0] + size[0], low[1] : low[1] + size[1]] = level
    heights[(grid.distance <= PLATFORM) | (grid.distance > grid.half - 0.5)] = 0.0
    return heights


@add_kind("height [cm]", 0.0, 100 * WAVE)
def waves(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Sines along both axes, 2 m long, up to 30 cm from trough to crest [ours]."""
    along = np.arange(grid.n + 1) * grid.cell
    phase = rng.uniform(0.0, 2.0 * np.pi, 2)
    sines = [np.sin(np.pi * along + p) for p in phase]
    return grid.fade(0.25 * WAVE * difficulty * (sines[0][:, None] + sines[1][None, :]))


@add_kind("gap [cm]", 100 * STONE_GAP[0], 100 * STONE_GAP[1], level=True)
def stepping_stones(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Square stones of 1.5 m to 0.3 m, with gaps of 5 to 20 cm, 0.3 m deep [legged_gym; ours: less deep]."""
    stone = max(round((1.5 - 1.2 * difficulty) / grid.cell), 2)
    gap = max(round(_between(STONE_GAP, difficulty) / grid.cell), 1)
    heights = np.full((grid.n + 1, grid.n + 1), -0.3)
    row = 0
    while row <= grid.n:
        start = -int(rng.integers(0, stone + gap))
        while start <= grid.n:
            heights[row : row + stone, max(start, 0) : max(start + stone, 0)] = 0.0
            start += stone + gap
        row += stone + gap
    heights[(grid.distance <= PLATFORM) | (grid.distance > grid.half - 0.5)] = 0.0
    return heights


@add_kind("width [cm]", 100 * DITCH[0], 100 * DITCH[1], level=True)
def gap(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """A ditch around the centre, 5 to 60 cm wide, 0.5 m deep [legged_gym; ours: less wide]."""
    width = min(max(_between(DITCH, difficulty), grid.cell), grid.half - PLATFORM - grid.cell)
    heights = grid.zeros()
    heights[(grid.distance > PLATFORM + 0.5 * grid.cell) & (grid.distance < PLATFORM + width + 0.5 * grid.cell)] = -0.5
    return heights


@add_kind("height [cm]", 0.0, 100 * NOISE)
def low_random(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
    """Random heights of 0 to 5 cm at every vertex, smaller in lower levels [MuJoCo Playground: 0 to 5 cm]."""
    return grid.fade(NOISE * difficulty * rng.random((grid.n + 1, grid.n + 1)))


def name_tile(kind: str, difficulty: float) -> str:
    """A kind with the value of its measure of difficulty: "stairs_up, step 12.8 cm"."""
    if kind not in MEASURES:
        return kind
    name, value, unit = measure(kind, difficulty)
    return f"{kind}, {name} {value:.3g} {unit}".rstrip()


def measure(kind: str, difficulty: float) -> tuple[str, float, str]:
    """Name, value and unit of the measure of difficulty of ``kind``."""
    what, low, high = MEASURES[kind]
    name, _, unit = what.rstrip("]").partition(" [")
    return name, _between((low, high), difficulty), unit


def _between(span: tuple[float, float], difficulty: float) -> float:
    return span[0] + (span[1] - span[0]) * difficulty


def _stairs(grid: Grid, height: float, width: float = 0.3) -> Heights:
    """A pyramid of steps: one step every ``width`` [m], from the rim to the centre."""
    count = int((grid.half - 0.5 - PLATFORM) / width + 1e-6)
    step = np.ceil((grid.half - 0.5 - grid.distance) / width - 1e-6)
    return height * np.clip(step, 0, count)


def _noise(grid: Grid, height: float, every: float, rng: np.random.Generator) -> Heights:
    """Uniform noise within +-``height`` every ``every`` [m], with interpolation."""
    coarse = np.arange(0.0, 2.0 * grid.half + every, every)
    fine = np.arange(grid.n + 1) * grid.cell
    draws = rng.uniform(-height, height, (len(coarse), len(coarse)))
    rows = np.stack([np.interp(fine, coarse, draws[:, i]) for i in range(len(coarse))], axis=1)
    return np.stack([np.interp(fine, coarse, row) for row in rows])
