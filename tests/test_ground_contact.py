"""Contacts with a height field on mujoco-warp: where a plane would have them, as deep as the nearest triangle is, two in a corner."""

from __future__ import annotations

import itertools
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from legged_mw.sim.ground import GROUND
from legged_mw.sim.ground_contact import HeightLookup, probes
from legged_mw.sim.terrain import HeightMap, Terrain, make_terrain
from legged_mw.sim.warp_engine import WarpSimulation
from legged_mw.utils.errors import ModelError

RADIUS = 0.023  # [m] of a Go1's foot
# a mesh of half these sizes [m]
BRICK, CORNERS = np.array([0.1, 0.05, 0.02]), np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
MESH = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "brick"}


def ground(kind: str, cell: float = 0.05, levels: int = 2) -> Terrain:
    return make_terrain(levels=levels, proportions={kind: 1.0}, columns=1, tile=4.0, cell=cell, border=1.0, seed=3)


def ball_model(terrain: Terrain | None, shape: dict[str, Any] | None = None) -> mujoco.MjModel:
    """A free ball, or another shape, over the ground."""
    spec = mujoco.MjSpec()
    spec.option.timestep = 0.004
    floor: dict[str, Any] = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.05]}
    if terrain:
        low, high = terrain.span()
        rows, columns = terrain.heights.shape
        size = [(columns - 1) * terrain.cell / 2, (rows - 1) * terrain.cell / 2, max(high - low, 1e-3), 1.0]
        spec.add_hfield(
            name="g", size=size, nrow=rows, ncol=columns, userdata=((terrain.heights - low) / size[2]).ravel()
        )
        floor = {"type": mujoco.mjtGeom.mjGEOM_HFIELD, "hfieldname": "g", "pos": [0, 0, low]}
    spec.worldbody.add_geom(name=GROUND, priority=1, friction=[0.6, 0.005, 0.0001], **floor)
    body = spec.worldbody.add_body(name="ball")
    body.add_freejoint()
    spec.add_mesh(name="brick", uservert=np.ravel(BRICK * CORNERS), inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX)
    body.add_geom(name="ball", mass=1.0, **(shape or {"type": mujoco.mjtGeom.mjGEOM_SPHERE, "size": [RADIUS, 0, 0]}))
    return spec.compile()


def contacts(terrain: Terrain, places: np.ndarray, device: str) -> tuple[np.ndarray, ...]:
    """World, depth [m] and normal of every contact of balls at ``places`` (N, 3)."""
    sim = WarpSimulation(ball_model(terrain), len(places), device, nconmax=4, njmax=24, terrain=terrain, eager=True)
    sim.qpos[:, :3] = sim.qpos.new_tensor(places)
    sim.step()
    contact, count = sim._data.contact, int(sim._data.nacon.numpy()[0])
    world = contact.worldid.numpy()[:count]
    return world, contact.dist.numpy()[:count], contact.frame.numpy()[:count, 0]


def nearest(terrain: Terrain, place: np.ndarray) -> tuple[float, np.ndarray]:
    """Signed distance [m] of a point from the triangles around it, and the direction away from the ground; by brute force."""
    column, row = ((place[:2] - terrain.corner) / terrain.cell).astype(int)
    c, r = np.meshgrid(np.arange(column - 3, column + 4), np.arange(row - 3, row + 4))
    x, y = (
        terrain.corner[0] + np.stack([c, c + 1]) * terrain.cell,
        terrain.corner[1] + np.stack([r, r + 1]) * terrain.cell,
    )
    corners = np.array([[x[i], y[j], terrain.heights[r + j, c + i]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    triangles = corners[[[0, 1, 2], [0, 2, 3]]].transpose(1, 3, 4, 0, 2).reshape(3, -1, 3)
    each = place - _closest(place, *triangles)
    direction = each[np.argmin(np.linalg.norm(each, axis=1))]
    best = float(np.linalg.norm(direction))
    u, v = (place[:2] - terrain.corner) / terrain.cell - (column, row)
    a, b = terrain.heights[row, column], terrain.heights[row + 1, column + 1]
    side = terrain.heights[row, column + 1] if u >= v else terrain.heights[row + 1, column]
    under = place[2] < a + (side - a) * max(u, v) + (b - side) * min(u, v)
    return (-best if under else best), direction / best * (-1.0 if under else 1.0)


def _closest(p: np.ndarray, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """The nearest point of each triangle (T, 3): inside of it, or on one of its edges."""

    def dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sum(x * y, axis=-1, keepdims=True)

    n, edges = np.cross(b - a, c - a), ((a, b), (b, c), (c, a))
    foot = p - n * dot(p - a, n) / dot(n, n)
    inside = np.all([dot(np.cross(e - s, foot - s), n) >= 0 for s, e in edges], axis=0)
    on_edges = np.array([s + (e - s) * np.clip(dot(p - s, e - s) / dot(e - s, e - s), 0, 1) for s, e in edges])
    first = np.argmin(np.linalg.norm(p - on_edges, axis=2), axis=0)
    return np.where(inside, foot, on_edges[first, np.arange(len(a))])


def around(terrain: Terrain, count: int, low: float, high: float) -> np.ndarray:
    """Places whose height over the ground under them is within ``low``..``high`` [m], where the ground is not flat."""
    rng = np.random.default_rng(0)
    flat = rng.uniform([terrain.corner[0] + 1.0, -1.9], [-terrain.corner[0] - 1.0, 1.9], (count, 2))
    grid = ((flat - terrain.corner) / terrain.cell).astype(int)
    return np.column_stack([flat, terrain.heights[grid[:, 1], grid[:, 0]] + rng.uniform(low, high, count)])


@pytest.mark.parametrize("kind", ["rough_slope", "stairs_up", "obstacles", "low_random"])
def test_a_contact_is_as_deep_as_the_nearest_triangle(kind: str, device: str) -> None:
    terrain = ground(kind)
    places = around(terrain, 400, -0.03, 0.04)  # centres of balls, some below the ground
    world, depth, normal = contacts(terrain, places, device)
    deepest = {w: i for i, w in sorted(enumerate(world), key=lambda pair: -depth[pair[0]])}
    touching = 0
    for number, place in enumerate(places):
        distance, direction = nearest(terrain, place)
        if distance > RADIUS + 1e-5:
            assert number not in deepest, "a contact where nothing touches"
        elif distance < RADIUS - 1e-5:
            touching += 1
            first = deepest[number]
            assert depth[first] == pytest.approx(distance - RADIUS, abs=2e-5)
            if abs(distance) > 2e-3:
                assert np.dot(normal[first], direction) > 0.999
    assert touching > 100


def test_flat_ground_is_a_plane_with_one_contact_a_ball(device: str) -> None:
    terrain = ground("flat")
    places = around(terrain, 200, 0.01, 0.022)
    world, depth, normal = contacts(terrain, places, device)
    assert sorted(world) == list(range(200))
    np.testing.assert_allclose(depth, places[world, 2] - RADIUS, atol=1e-6)
    np.testing.assert_allclose(normal, np.tile([0.0, 0.0, 1.0], (200, 1)), atol=1e-6)


def test_a_slope_has_no_edges_inside(device: str) -> None:
    terrain = ground("smooth_slope")
    # on one side of the pyramid of level 1
    places = np.column_stack([np.full(50, 3.3), np.linspace(-0.5, 0.5, 50), np.zeros(50)])
    places[:, 2] = [terrain.heights[60, round((3.3 - terrain.corner[0]) / 0.05)] + 0.022] * 50
    world, _, normal = contacts(terrain, places, device)
    assert len(world) == len(set(world)) > 0
    assert np.ptp(normal, axis=0).max() < 1e-4, "one plane, one normal"


def test_in_the_corner_of_a_step_there_are_two(device: str) -> None:
    terrain = ground("stairs_up", levels=2)
    row = terrain.heights[60, :]
    rise = next(i for i in range(140, 190) if row[i + 1] - row[i] > 0.1)  # of level 1, going outwards
    x, z = terrain.corner[0] + rise * 0.05, row[rise]
    world, depth, normal = contacts(terrain, np.array([[x - 0.006, 0.0, z + 0.02], [x - 0.1, 0.0, z + 0.02]]), device)
    assert sorted(world) == [0, 0, 1]
    corner = normal[world == 0]
    assert sorted(corner[:, 2].round(3))[-1] == 1.0 and min(corner[:, 0]) < -0.8, "the tread and the riser"
    assert (depth < 0).all()


def test_a_ball_rests_as_on_a_plane(device: str) -> None:
    terrain = ground("flat")
    heights = []
    for field in (None, terrain):
        sim = WarpSimulation(ball_model(field), 4, device, nconmax=4, njmax=24, terrain=field, eager=True)
        sim.qpos[:, 2], sim.qvel[:, 0] = 0.05, 0.5
        for _ in range(100):
            sim.step()
        heights.append(sim.qpos.clone())
    assert (heights[0] - heights[1]).abs().max() < 1e-5
    assert not sim.overflow_report()


def test_shapes_and_their_probes() -> None:
    kinds = mujoco.mjtGeom
    for kind, size, count in (
        (kinds.mjGEOM_SPHERE, [0.1, 0, 0], 1),
        (kinds.mjGEOM_CAPSULE, [0.1, 0.2, 0], 5),
        (kinds.mjGEOM_CYLINDER, [0.1, 0.1, 0], 38),
        (kinds.mjGEOM_CYLINDER, [0.02, 0.01, 0], 26),
        (kinds.mjGEOM_CYLINDER, [0.02, 0.1, 0], 3),
        (kinds.mjGEOM_BOX, [0.1] * 3, 26),
        (kinds.mjGEOM_ELLIPSOID, [0.1, 0.1, 0.05], 62),
    ):
        model = ball_model(None, {"type": kind, "size": size})
        geoms, places, radii = probes(model, 0)
        assert geoms == [1] * count and len(places) == len(radii) == count
    _, places, _ = probes(ball_model(None, {"type": kinds.mjGEOM_CYLINDER, "size": [0.3, 0.1, 0]}), 0)
    angle, across = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 50), np.linspace(0.0, 0.3, 20))
    cap = np.stack([across * np.cos(angle), across * np.sin(angle), np.full_like(angle, 0.1)], axis=-1)
    nearest_probe = np.linalg.norm(cap[..., None, :] - places, axis=-1).min(axis=-1)
    assert nearest_probe.max() < 0.1 / np.sqrt(2) + 1e-6, "10 cm apart along either way"
    model = ball_model(None)
    model.geom_type[1] = kinds.mjGEOM_HFIELD
    with pytest.raises(
        ModelError, match=r"^geom 'ball' is a hfield: its surface is not known as points, .* or take the engine mujoco$"
    ):
        probes(model, 0)


def test_a_rod_is_a_row_of_spheres_as_long_and_as_thick_as_it_is() -> None:
    _, places, radii = probes(ball_model(None, {"type": mujoco.mjtGeom.mjGEOM_CYLINDER, "size": [0.013, 0.06, 0]}), 0)
    np.testing.assert_allclose(places, [[0, 0, -0.047], [0, 0, 0.047]], atol=1e-9)
    assert radii == [0.013, 0.013]


def test_an_ellipsoid_is_probed_on_its_surface_and_at_its_ends() -> None:
    size = np.array([0.2, 0.1, 0.05])
    _, places, radii = probes(ball_model(None, {"type": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "size": size}), 0)
    np.testing.assert_allclose(np.square(places / size).sum(axis=1), 1.0, atol=1e-9)
    np.testing.assert_allclose(np.abs(places).max(axis=0), size, rtol=0.02)
    assert not any(radii)


def test_a_mesh_is_probed_at_its_corners_and_between_them() -> None:
    model = ball_model(None, MESH)
    geoms, places, radii = probes(model, 0)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.mesh_quat[0])  # compiled, a mesh lies in its principal axes
    places = places @ turn.reshape(3, 3).T + model.mesh_pos[0]
    assert set(geoms) == {1} and not any(radii)
    assert {tuple(corner) for corner in (BRICK * CORNERS).round(6)} <= {tuple(place) for place in places.round(6)}
    on_surface = np.stack(
        np.meshgrid(np.linspace(-0.1, 0.1, 41), np.linspace(-0.05, 0.05, 21), [-0.02, 0.02]), axis=-1
    ).reshape(-1, 1, 3)
    assert np.linalg.norm(on_surface - places, axis=-1).min(axis=1).max() < 0.1 / np.sqrt(2) + 1e-6
    assert len(places) < 20, "no more than keeps the surface covered"


def test_a_round_mesh_is_thinned_and_as_large_as_it_was() -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><asset><mesh name="ball" builtin="sphere" params="4" scale=".05 .05 .05"/></asset><worldbody>'
        '<geom name="floor" type="plane" size="1 1 1"/><body><freejoint/><geom type="mesh" mesh="ball"/></body></worldbody></mujoco>'
    )
    model = spec.compile()
    _, places, _ = probes(model, 0)
    assert len(places) < 40 < model.mesh_vertnum[0] and np.linalg.norm(places, axis=1) == pytest.approx(0.05, rel=0.01)
    down = np.random.default_rng(0).normal(size=(200, 3))
    reach = (down / np.linalg.norm(down, axis=1, keepdims=True) @ places.T).max(axis=1)
    assert reach.min() > 0.9 * 0.05, "it sinks by a tenth of its radius at the most, whichever way it lies"


@pytest.mark.parametrize("field", ["flat", "smooth_slope"])
def test_a_mesh_rests_as_the_box_of_its_size_does(field: str, device: str) -> None:
    """A sole of 20 x 10 x 4 cm, as a mesh and as a box on a height field, and as MuJoCo itself has it on the level."""
    terrain, rest = ground(field), []
    place = [3.0, 0.0, terrain.heights[60, round((3.0 - terrain.corner[0]) / 0.05)] + 0.05]
    for shape in (MESH, {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": BRICK}):
        model = ball_model(terrain, shape)
        model.opt.iterations = 50
        sim = WarpSimulation(model, 1, device, nconmax=40, njmax=160, terrain=terrain, eager=True)
        sim.qpos[0, :3] = torch.tensor(place)
        for _ in range(150):
            sim.step()
        assert not sim.overflow_report()
        rest.append(sim.qpos[0].cpu().numpy())
    model = ball_model(terrain, MESH)
    data = mujoco.MjData(model)
    data.qpos[:3] = place
    mujoco.mj_step(model, data, 150)
    np.testing.assert_allclose(rest[0], rest[1], atol=1e-4)
    slope = 0.4 if field == "smooth_slope" else 0.0  # down along x
    from_middle = place[2] - 0.05 + slope * place[0]  # what the ground's plane has for z + slope * x
    for pose in (rest[0], data.qpos) if field == "flat" else rest:  # MuJoCo's own has tilted contacts on a slope
        assert (pose[2] + slope * pose[0] - from_middle) / np.hypot(1.0, slope) == pytest.approx(0.02, abs=1e-3), (
            "half its height"
        )
        w, x, y, z = pose[3:]
        assert (2 * (x * z + w * y) * slope + 1 - 2 * (x * x + y * y)) / np.hypot(1.0, slope) > 0.999, (
            "it lies on its flat side"
        )


@pytest.mark.parametrize(
    "shape",
    [
        {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [0.3, 0.1, 0.05]},
        {"type": mujoco.mjtGeom.mjGEOM_CAPSULE, "size": [0.05, 0.3, 0]},
        {"type": mujoco.mjtGeom.mjGEOM_ELLIPSOID, "size": [0.3, 0.2, 0.05]},
    ],
)
def test_what_lies_across_an_edge_does_not_sink_into_it(shape: dict[str, Any], device: str) -> None:
    terrain = ground("stairs_down")
    row = terrain.heights[60, :]
    edge = next(i for i in range(150, 190) if row[i] - row[i + 1] > 0.1)  # of level 1, going down outwards
    sim = WarpSimulation(ball_model(terrain, shape), 1, device, nconmax=64, njmax=128, terrain=terrain, eager=True)
    lying = [1.0, 0.0, 0.0, 0.0] if shape["size"][2] else [0.7071068, 0.0, 0.7071068, 0.0]
    sim.qpos[0] = torch.tensor([terrain.corner[0] + edge * 0.05 - 0.05, 0.0, row[edge] + 0.052, *lying])
    for _ in range(40):
        sim.step()
    assert sim.qpos[0, 2] > row[edge] + 0.02, "its middle is over the edge's tread"


def test_too_little_room_is_seen() -> None:
    terrain = ground("flat")
    sim = WarpSimulation(
        ball_model(terrain, {"type": mujoco.mjtGeom.mjGEOM_BOX, "size": [0.1] * 3}),
        3,
        "cpu",
        nconmax=1,
        njmax=24,
        terrain=terrain,
    )
    sim.qpos[:, 2] = 0.099
    sim.step()
    assert "raise nconmax (now 1)" in sim.overflow_report()


@pytest.mark.parametrize("kind", ["rough_slope", "stairs_up"])
def test_both_lookups_find_the_same_heights(kind: str, device: str) -> None:
    terrain = ground(kind)
    lookup, tensors = HeightLookup(terrain, device), HeightMap(terrain, device)
    points = torch.rand(7, 100, 2, device=device) * 14.0 - 7.0  # some of them outside
    torch.testing.assert_close(lookup(points), tensors(points), atol=2e-5, rtol=0.0)
    nothing = torch.tensor([[float("nan"), 0.0], [float("inf"), -float("inf")]], device=device)
    assert lookup(nothing).isfinite().all() and tensors(nothing).isfinite().all()
