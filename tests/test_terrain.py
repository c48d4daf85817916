"""Ground that is not flat: what tiles are made of, that they fit together, and that a lookup finds what MuJoCo's rays find."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from legged_mw import ROOT
from legged_mw.check.recordable import recordable
from legged_mw.envs.terrain import build_terrain
from legged_mw.sim.ground import Ground, add_ground, as_boxes, leaning, replace_level_pieces
from legged_mw.sim.terrain import (
    KINDS,
    LEVEL,
    PLATFORM,
    Grid,
    HeightMap,
    Heights,
    Terrain,
    add_kind,
    make_terrain,
    name_tile,
    share_columns,
)
from legged_mw.utils.task import load_task


def terrain(**changes: Any) -> Terrain:
    asked = {
        "levels": 4,
        "proportions": dict.fromkeys(KINDS, 1.0),
        "columns": len(KINDS),
        "tile": 8.0,
        "cell": 0.1,
        "border": 2.0,
        "seed": 1,
    }
    return make_terrain(**{**asked, **changes})


def tile(ground: Terrain, level: int, kind: str) -> np.ndarray:
    """Heights of one tile, its rim included."""
    n, edge = round(ground.tile / ground.cell), round(2.0 / ground.cell)
    row, column = edge + ground.kinds.index(kind) * n, edge + level * n
    return ground.heights[row : row + n + 1, column : column + n + 1]


@pytest.mark.parametrize("kind", KINDS)
def test_tiles_begin_flat_and_end_at_zero(kind: str) -> None:
    ground = terrain()
    for level in range(4):
        patch = tile(ground, level, kind)
        middle = patch[31:50, 31:50]  # 0.9 m to each side
        assert np.ptp(middle) == 0.0
        assert not patch[[0, -1]].any() and not patch[:, [0, -1]].any(), "neighbours meet without a step"
        x, y, z = ground.origins[level, ground.kinds.index(kind)]
        assert z == middle[0, 0] and HeightMap(ground, "cpu")(torch.tensor([x, y], dtype=torch.float)) == pytest.approx(
            z, abs=1e-6
        )
    heights = [np.ptp(tile(ground, level, kind)) for level in (0, 3)]
    assert kind in ("flat", "stepping_stones", "gap") or heights[1] > heights[0], "the last level is the hardest"


def test_stairs_are_stairs() -> None:
    ground = terrain(levels=2)
    for kind, sign in (("stairs_up", 1.0), ("stairs_down", -1.0)):
        for level, height in ((0, 0.06), (1, 0.195)):
            along = tile(ground, level, kind)[40, 40:]  # from the middle outwards
            steps = np.diff(along)
            assert np.allclose(steps[steps != 0.0], sign * height) and (steps != 0.0).sum() == 8
            assert np.diff(np.flatnonzero(steps)).tolist() == [3] * 7, "0.3 m deep"
            assert along[round(PLATFORM / 0.1)] == along[0]


def test_each_kind_is_as_high_and_wide_as_it_says() -> None:
    """Tiles of 8 m at full difficulty, level within 1 m of the middle and in the last 0.5 m."""
    grid, rng = Grid(80, 0.1, pit=False), np.random.default_rng(0)
    hard = {name: kind(grid, 1.0, rng) for name, kind in KINDS.items()}
    found = {name: (hard[name].min().round(6), hard[name].max().round(6)) for name in hard}
    assert found["smooth_slope"] == (0.0, 0.4 * 2.5) and found["gap"] == (-0.5, 0.0)
    assert np.abs(np.diff(hard["smooth_slope"], axis=0)).max() == pytest.approx(0.04)
    assert set(np.unique(hard["obstacles"])) == {-0.25, -0.125, 0.0, 0.125, 0.25}
    assert set(np.unique(hard["stepping_stones"])) == {-0.3, 0.0}
    noise = hard["rough_slope"] - hard["smooth_slope"]
    for rough, low, high in ((noise, -0.05, 0.05), (hard["waves"], -0.15, 0.15), (hard["low_random"], 0.0, 0.05)):
        assert low <= rough.min() <= low + 0.03 and high - 0.03 <= rough.max() <= high
    wave = hard["waves"][10]  # 2 m long
    assert np.ptp(wave[10:30]) > 0.1 and wave[10:50] == pytest.approx(wave[30:70])
    assert KINDS["low_random"](grid, 0.5, rng).max() <= 0.025
    assert np.flatnonzero(hard["gap"][40]).tolist() == [*range(24, 30), *range(51, 57)]  # 0.6 m behind the platform
    holes = hard["stepping_stones"][10] < 0.0  # stones of 0.3 m, gaps of 0.2 m
    edges = np.flatnonzero(np.diff(holes[5:76].astype(int)))
    assert set(np.diff(edges)[1:-1]) == {2, 3}


def test_beyond_1_every_kind_grows_on_and_still_fits_its_neighbours() -> None:
    """Stairs of 25 cm at 1.41; at 2, the most, the smallest tile still has its middle and its rim."""
    ground = terrain(levels=2, difficulty=(0.0, 1.41), proportions={"stairs_up": 1.0}, columns=1)
    assert np.unique(np.diff(tile(ground, 1, "stairs_up")[40, 40:]).round(3)).tolist() == [0.0, 0.25]
    terrain(levels=2, difficulty=(2.0, 2.0), proportions=dict.fromkeys(KINDS, 1.0), columns=len(KINDS), tile=4.0)


def test_slopes_go_up_and_down_in_turn() -> None:
    """Along a column, and side by side: two columns of a kind have one of each at every level."""
    ground = terrain(proportions={"smooth_slope": 1.0, "rough_slope": 1.0}, columns=4)
    up = ground.origins[1:, :, 2] < 0.0  # from the middle, in a pit
    assert (up[:, ::2] != up[:, 1::2]).all() and (up[1:] != up[:-1]).all()


def test_the_same_seed_makes_the_same_ground() -> None:
    assert np.array_equal(terrain().heights, terrain().heights)
    assert not np.array_equal(terrain().heights, terrain(seed=2).heights)


def test_columns_are_shared_out() -> None:
    assert share_columns({"flat": 0.5, "gap": 0.25, "waves": 0.25}, 4) == ("flat", "flat", "gap", "waves")
    assert share_columns({"flat": 100.0, "gap": 1.0, "waves": 0.0}, 5) == ("flat",) * 4 + ("gap",)


def drop_rays(spec: mujoco.MjSpec, points: np.ndarray) -> list[float]:
    """Heights [m] that rays straight down hit at ``points`` (n, 2)."""
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hit, down = np.zeros(1, dtype=np.int32), np.array([0.0, 0.0, -1.0])
    return [5.0 - mujoco.mj_ray(model, data, np.array([*p, 5.0]), down, None, 1, -1, hit) for p in points]


def test_the_field_and_its_boxes_are_as_hard_as_asked() -> None:
    ground, spec = terrain(levels=2), mujoco.MjSpec()
    add_ground(spec, Ground(contact_time=0.01, terrain=ground), [])
    replace_level_pieces(spec, ground, [])
    model = spec.compile()
    assert model.ngeom > 1 and (model.geom_solref[:, 0] == 0.01).all()


@pytest.mark.parametrize("cell", [0.1, 0.05])
def test_a_lookup_is_what_a_ray_hits(cell: float) -> None:
    ground, spec = terrain(levels=2, cell=cell), mujoco.MjSpec()
    add_ground(spec, Ground(terrain=ground), [])
    points = np.random.default_rng(0).uniform(ground.corner, [-c for c in ground.corner], (1000, 2))
    rays = drop_rays(spec, points)
    np.testing.assert_allclose(HeightMap(ground, "cpu")(torch.tensor(points, dtype=torch.float)), rays, atol=1e-4)


def test_a_ray_hits_boxes_where_the_vertices_are() -> None:
    """Level pieces as boxes, the rest as a height field, for which few iterations become more."""
    ground, spec = terrain(levels=2), mujoco.MjSpec()
    spec.option.iterations, spec.option.ls_iterations = 1, 60
    add_ground(spec, Ground(terrain=ground), [])
    replace_level_pieces(spec, ground, [])
    assert (spec.option.iterations, spec.option.ls_iterations) == (20, 60)
    rng, (rows, columns) = np.random.default_rng(0), ground.heights.shape
    row, column = rng.integers(0, rows, 1000), rng.integers(0, columns, 1000)
    rays = drop_rays(spec, np.array(ground.corner) + 0.1 * np.column_stack([column, row]))
    np.testing.assert_allclose(rays, ground.heights[row, column], atol=1e-4)


def test_gravity_leans_ahead_on_a_slope() -> None:
    """By 30 degrees: half of it along x, the root of 3/4 down."""
    assert leaning([0.0, 0.0, -10.0], 30.0) == pytest.approx([5.0, 0.0, -10.0 * 0.75**0.5])


def test_a_lookup_can_be_recorded_and_holds_outside() -> None:
    ground = terrain(levels=2)
    heights, points = HeightMap(ground, "cpu"), torch.tensor([[[1e4, -1e4], [0.0, 0.0]], [[-1e4, 1e4], [1.0, 2.0]]])
    with recordable():
        found = heights(points)
    assert found.shape == (2, 2) and found[:, 0].tolist() == [0.0, 0.0]


def test_a_lookup_by_hand_at_the_rim_and_beyond() -> None:
    """Squares of the vertices' numbers: no two neighbours differ alike, so a vertex beside the right one is seen."""
    field = np.arange(12.0).reshape(3, 4) ** 2
    nowhere = {"tile": 1.0, "kinds": (), "difficulties": (), "origins": np.zeros((0, 0, 3))}
    look_up = HeightMap(Terrain(heights=field, cell=0.5, corner=(1.0, -2.0), **nowhere), "cpu")
    column, row = np.meshgrid(np.arange(-2, 7), np.arange(-2, 6))
    points = np.stack([1.0 + 0.5 * column, -2.0 + 0.5 * row], axis=-1)
    expected = field[row.clip(0, 2), column.clip(0, 3)]
    np.testing.assert_array_equal(look_up(torch.tensor(points, dtype=torch.float)), expected)
    # in the last cell, of heights 36 49, 100 121: 3/4 across and 1/4 along, then the other way round
    inside = torch.tensor([[2.375, -1.375], [2.125, -1.125], [torch.nan, torch.nan]])
    assert look_up(inside).tolist() == [36 + 0.75 * 13 + 0.25 * 72, 36 + 0.75 * 64 + 0.25 * 21, 0.0]


# ---- kinds of one's own


@pytest.mark.usefixtures("own_kinds")
def test_a_kind_of_ones_own() -> None:
    for depth in (0.2, 0.1):  # a config file may be loaded twice: the last one counts

        @add_kind("depth [cm]", 0.0, 100 * depth)
        def pits(grid: Grid, difficulty: float, rng: np.random.Generator, depth: float = depth) -> Heights:
            return grid.fade(np.full((grid.n + 1, grid.n + 1), -depth * difficulty))

    ground = terrain(proportions={"pits": 1.0, "flat": 1.0}, columns=2, levels=3)
    assert tile(ground, 2, "pits").min() == pytest.approx(-0.1) and tile(ground, 1, "pits").min() == pytest.approx(
        -0.05
    )
    assert ground.difficulties == (0.0, 0.5, 1.0)
    assert name_tile("pits", 0.5) == "pits, depth 5 cm" and name_tile("stairs_up", 0.5) == "stairs_up, step 12.8 cm"
    assert name_tile("flat", 0.5) == "flat" and name_tile("gap", 0.0) == "gap, width 5 cm"


@pytest.mark.usefixtures("own_kinds")
def test_a_kind_of_ones_own_is_boxes_if_it_says_that_it_is_level() -> None:
    for level in (True, False):

        @add_kind(level=level)
        def kerb(grid: Grid, difficulty: float, rng: np.random.Generator) -> Heights:
            return np.where((grid.distance > 1.5) & (grid.distance < 2.5), 0.1, 0.0)

        boxes, _, left = as_boxes(terrain(proportions={"kerb": 1.0}, columns=1))
        assert ({box.top for box in boxes} == {0.0, 0.1} and not left) if level else (not boxes and left == ["kerb"])


@pytest.mark.usefixtures("own_kinds")
def test_the_kind_in_the_docs_is_ground_that_a_task_can_have(tmp_path: Path) -> None:
    [code] = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "terrain.md").read_text(), re.DOTALL)
    (tmp_path / "go1_craters.py").write_text(code)
    for _ in range(2):  # train.py and play.py load it more than once
        task = load_task(str(tmp_path / "go1_craters.py"))
    for path, value in {"terrain.num_rows": 2, "terrain.num_cols": 4, "terrain.difficulty": [0.0, 1.0]}.items():
        task.set(path, value)
    ground = build_terrain(task.cfg)
    assert ground is not None and "craters" in ground.kinds
    patch = ground.heights[ground.vertices(1, ground.kinds.index("craters"))]
    assert -0.45 < patch.min() < -0.3 and not patch[78:83, 78:83].any()
    assert name_tile("craters", 1.0) == "craters, depth 40 cm"


@pytest.mark.parametrize("edge", [8.0, 8.1])
def test_a_place_is_on_the_tile_whose_vertices_are_around_it(edge: float) -> None:
    ground = terrain(levels=3, proportions={"flat": 1.0, "stairs_up": 1.0}, columns=2, tile=edge)
    for level, column in ((0, 0), (2, 1), (1, 0)):
        rows, columns = ground.vertices(level, column)
        assert rows.stop - rows.start == columns.stop - columns.start == round(edge / 0.1) + 1
        x, y = (start + span.start * 0.1 for start, span in zip(ground.corner, (columns, rows), strict=True))
        for inside in (0.01, edge - 0.01):
            assert ground.tile_at(x + inside, y + inside) == (level, column)
    assert ground.tile_at(-1.5 * edge - 0.01, 0.0) is None and ground.tile_at(0.0, edge + 0.01) is None


@pytest.mark.parametrize("cell", [0.05, 0.1, 0.2])
def test_only_level_pieces_become_boxes(cell: float) -> None:
    """A slope of few cells is a heap of steps to who counts rectangles."""
    kinds = [kind for kind in KINDS if kind != "craters"]
    ground = terrain(
        levels=2, cell=cell, proportions=dict.fromkeys(kinds, 1.0), columns=len(kinds), difficulty=(0.5, 0.9)
    )
    _, heights, _ = as_boxes(ground)
    sunk = set()
    for column, kind in enumerate(ground.kinds):
        rows, columns = ground.vertices(1, column)
        if heights[rows, columns].min() < ground.heights[rows, columns].min() - 0.9:
            sunk.add(kind)
    assert sunk == LEVEL


def test_boxes_cover_each_level_tile_once_and_at_its_heights() -> None:
    ground = terrain(levels=2, proportions={"stairs_up": 1.0, "rough_slope": 1.0}, columns=2)
    boxes, heights, left = as_boxes(ground)
    assert left == ["rough_slope"]
    area = sum((b.high[0] - b.low[0]) * (b.high[1] - b.low[1]) for b in boxes)
    assert area == pytest.approx(2 * 64.0)
    rng = np.random.default_rng(0)
    look_up = HeightMap(ground, "cpu")
    for box in boxes:
        inside = rng.uniform(np.array(box.low) + 0.051, np.array(box.high) - 0.051, (20, 2))
        np.testing.assert_allclose(look_up(torch.tensor(inside, dtype=torch.float)), box.top, atol=1e-5)
    edge, n = 20, 80
    for first in (edge, edge + n):
        assert (heights[edge + 1 : edge + n, first + 1 : first + n] < -0.9).all(), "sunk under the boxes"
    np.testing.assert_array_equal(heights[edge + n :], ground.heights[edge + n :], "the slopes stay")
