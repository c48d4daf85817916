"""Ground that is not flat: what tiles are made of, that they fit together, and that a lookup finds what MuJoCo's rays find."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from guard import recordable

from legged_mw.sim.model import ModelError
from legged_mw.sim.terrain import KINDS, PLATFORM, HeightMap, Terrain, as_boxes, level_kinds, make_terrain, share_columns


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
        assert z == middle[0, 0] and HeightMap(ground, "cpu")(torch.tensor([x, y], dtype=torch.float)) == pytest.approx(z, abs=1e-6)
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


@pytest.mark.parametrize("cell", [0.1, 0.05])
def test_a_lookup_is_what_a_ray_hits(cell: float) -> None:
    ground = terrain(levels=2, cell=cell)
    low, high = ground.span()
    rows, columns = ground.heights.shape
    spec = mujoco.MjSpec()
    size = [(columns - 1) * cell / 2, (rows - 1) * cell / 2, high - low, 1.0]
    spec.add_hfield(name="ground", size=size, nrow=rows, ncol=columns, userdata=((ground.heights - low) / (high - low)).ravel())
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[0, 0, low])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    points = np.random.default_rng(0).uniform(ground.corner, [-c for c in ground.corner], (1000, 2))
    hit = np.zeros(1, dtype=np.int32)
    down = np.array([0.0, 0.0, -1.0])
    rays = [5.0 - mujoco.mj_ray(model, data, np.array([*p, 5.0]), down, None, 1, -1, hit) for p in points]
    np.testing.assert_allclose(HeightMap(ground, "cpu")(torch.tensor(points, dtype=torch.float)), rays, atol=1e-4)


def test_a_lookup_can_be_recorded_and_holds_outside() -> None:
    ground = terrain(levels=2)
    heights, points = HeightMap(ground, "cpu"), torch.tensor([[[1e4, -1e4], [0.0, 0.0]], [[-1e4, 1e4], [1.0, 2.0]]])
    with recordable():
        found = heights(points)
    assert found.shape == (2, 2) and found[:, 0].tolist() == [0.0, 0.0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"proportions": {"stair_up": 1.0}}, "no kind of terrain 'stair_up' in terrain.terrain_proportions; did you mean 'stairs_up'"),
        ({"tile": 8.05}, "terrain.tile_size 8.05 must be a whole number of cells \\(terrain.horizontal_scale\\) of 0.1 m"),
        ({"columns": 3}, "3 columns cannot hold 10 kinds"),
    ],
)
def test_mistakes_are_named(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ModelError, match=message):
        terrain(**changes)


def test_level_pieces_are_told_from_slopes() -> None:
    level = level_kinds(KINDS, 0.05)
    assert {"flat", "stairs_up", "stairs_down", "obstacles", "gap"} <= set(level)
    assert not {"smooth_slope", "rough_slope", "waves", "low_random"} & set(level)


def test_boxes_cover_each_level_tile_once_and_at_its_heights() -> None:
    ground = terrain(levels=2, proportions={"stairs_up": 1.0, "rough_slope": 1.0}, columns=2)
    boxes, heights = as_boxes(ground)
    area = sum((b.high[0] - b.low[0]) * (b.high[1] - b.low[1]) for b in boxes)
    assert area == pytest.approx(2 * 64.0)
    rng = np.random.default_rng(0)
    look_up = HeightMap(ground, "cpu")
    for box in boxes:
        inside = rng.uniform(np.array(box.low) + 0.051, np.array(box.high) - 0.051, (20, 2))
        np.testing.assert_allclose(look_up(torch.tensor(inside, dtype=torch.float)), box.top, atol=1e-5)
    edge, n = 20, 80
    assert (heights[edge + 1 : edge + n, edge + 1 : edge + 2 * n : n // 2] < ground.heights.min() - 0.9).any(), "sunk under the boxes"
    np.testing.assert_array_equal(heights[edge + n :], ground.heights[edge + n :], "the slopes stay")
