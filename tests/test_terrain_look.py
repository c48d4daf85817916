"""Rough ground as it is drawn: what the picture on it shows, where it lies and what is drawn coarsely."""

from __future__ import annotations

import shlex
from contextlib import closing

import legged_mw  # noqa: F401  (sets MUJOCO_GL, which mujoco reads when it is imported)

# isort: split
import mujoco
import numpy as np
import pytest
from program import run

from legged_mw import ROOT
from legged_mw.drawing import terrain_look
from legged_mw.drawing.scene import add_scene, visual_model, visual_spec
from legged_mw.drawing.terrain_look import _slopes, add_relief, relief
from legged_mw.sim.ground import GROUND, Ground, add_ground
from legged_mw.sim.terrain import Terrain, make_terrain
from legged_mw.utils.task import load_task
from legged_mw.view.camera import ELEVATION, RobotCamera
from legged_mw.view.playing import ground_to_watch
from legged_mw.view.posed_robot import PosedRobots, RoughGround
from legged_mw.view.recorder import RobotRenderer
from legged_mw.view.session import Outcome, Session
from legged_mw.view.stage import Moment

KINDS = ("stairs_up", "obstacles", "smooth_slope", "flat")


def terrain(*kinds: str, levels: int = 2, cell: float = 0.1, **more: float) -> Terrain:
    return make_terrain(
        levels=levels,
        proportions=dict.fromkeys(kinds, 1.0),
        columns=len(kinds),
        tile=8.0,
        cell=cell,
        **{"border": 2.0, "seed": 1, **more},
    )


@pytest.fixture(scope="module")
def hilly_spec() -> mujoco.MjSpec:
    """A Go1 among two levels of each kind, as it is drawn."""
    task = load_task("go1_rough")
    for path, value in {
        "env.num_envs": 1,
        "terrain.num_rows": 2,
        "terrain.difficulty": [0.0, 1.0],
        "terrain.num_cols": len(KINDS),
        "terrain.terrain_proportions": dict.fromkeys(KINDS, 1.0),
        "terrain.horizontal_scale": 0.1,
        "terrain.border_size": 2.0,
        "terrain.curriculum": False,
    }.items():
        task.set(path, value)
    return visual_spec(task.env_class(task.cfg, "cpu", eager=True).robot)


@pytest.fixture(scope="module")
def hilly(hilly_spec: mujoco.MjSpec) -> mujoco.MjModel:
    return hilly_spec.compile()


def grid() -> Terrain:
    """The ground of ``hilly``."""
    return terrain(*KINDS)


def shown(model: mujoco.MjModel) -> set[int]:
    """The height fields that are not hidden."""
    fields = model.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD
    return set(np.flatnonzero(fields & (model.geom_rgba[:, 3] > 0)).tolist())


def drawn(ground: Terrain) -> mujoco.MjModel:
    """The ground alone."""
    spec = mujoco.MjSpec()
    add_ground(spec, Ground(terrain=ground), [])
    add_scene(spec)
    add_relief(spec, ground, GROUND)
    return spec.compile()


@pytest.fixture
def without_squares(monkeypatch: pytest.MonkeyPatch) -> None:
    for squares in ("CHECKER", "LINE"):
        monkeypatch.setattr(terrain_look, squares, 0.0)


@pytest.mark.usefixtures("without_squares")
def test_edges_are_light_and_risers_dark() -> None:
    ground = terrain("stairs_down", levels=1, cell=0.05)
    tone = relief(ground)[..., 1].astype(int)
    along = tone[tone.shape[0] // 2, tone.shape[1] // 2 :]  # from the middle of the top, outwards
    heights = ground.heights[ground.heights.shape[0] // 2, ground.heights.shape[1] // 2 :]
    edge = int(np.flatnonzero(np.diff(heights))[0])  # the cell of the first riser
    level, upper, riser, lower = along[10], along[edge - 1], along[edge], along[edge + 1]
    assert riser < lower < level < upper


def test_the_slope_of_a_cell_is_its_largest_step() -> None:
    heights = np.array([[0.0, 0.0, 0.0], [0.0, 5.0, 7.0], [0.0, 1.0, 1.0]], dtype=np.float32)
    assert _slopes(heights).tolist() == [[5.0, 7.0], [5.0, 6.0]]


def test_squares_of_half_a_metre_and_lines_around_tiles() -> None:
    ground = terrain("flat", levels=2)
    tone = relief(ground)[..., 1].astype(int)
    pixel = 0.1

    def at(x: float, y: float) -> int:
        return tone[int((y - ground.corner[1]) / pixel), int((x - ground.corner[0]) / pixel)]

    assert at(0.25, 0.25) == at(0.75, 0.75) != at(0.75, 0.25)
    assert at(0.25, 0.25) < at(1.0, 0.25) < at(0.0, 0.25), "a line at a metre, a lighter one where the two tiles meet"


@pytest.mark.usefixtures("without_squares")
def test_the_picture_lies_where_the_heights_are() -> None:
    ground = terrain("obstacles", "obstacles", levels=2, seed=3)
    model = drawn(ground)
    (
        model.light_active[:],
        model.vis.headlight.diffuse[:],
        model.vis.headlight.ambient[:],
        model.vis.headlight.specular[:],
    ) = 0, 0, 1, 0
    model.vis.global_.fovy = 2 * 8.0
    camera, data = mujoco.MjvCamera(), mujoco.MjData(model)
    camera.orthographic, camera.azimuth, camera.elevation, camera.distance = 1, 90, -90, 20.0
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 160, 160) as renderer:
        renderer.update_scene(data, camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        seen = renderer.render()[::-1, :, 1].astype(float)  # row = +y
    edge = round(2.0 / 0.1)
    asked = relief(ground)[edge:-edge, edge:-edge, 1].astype(float)  # 160 x 160: a pixel each
    assert asked.shape == seen.shape
    match = np.corrcoef(seen.ravel(), asked.ravel())[0, 1]
    others = [np.corrcoef(seen.ravel(), other.ravel())[0, 1] for other in (asked[::-1], asked[:, ::-1], asked.T)]
    assert match > 0.9 > 0.5 > max(others)


def test_a_plane_is_drawn_as_ever_and_rough_ground_in_tiles(hilly: mujoco.MjModel) -> None:
    task = load_task("go1_flat")
    task.set("env.num_envs", 1)
    flat = visual_model(task.env_class(task.cfg, "cpu", eager=True).robot)
    assert flat.nhfield == 0 and flat.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE and flat.geom_rgba[0, 3] == 1.0
    assert hilly.nhfield == 2 * 5 + 3, "each tile twice, but for level ones: two that are flat, and a slope of 0"
    assert len(shown(hilly)) == 8 and hilly.geom("floor").type == mujoco.mjtGeom.mjGEOM_PLANE
    assert not hilly.geom("floor").size[:2].any() and not hilly.geom("floor").pos.any()  # without an end, for the haze
    robot = hilly.geom_bodyid > 0
    assert not hilly.geom_contype[~robot & (hilly.geom_type == mujoco.mjtGeom.mjGEOM_HFIELD)].any()
    assert (hilly.nq, hilly.nv) == (19, 18)


@pytest.mark.parametrize(("levels", "columns"), [(2, 2), (26, 1), (100, 3), (1, 40)])
def test_flat_ground_lies_all_around_as_far_as_a_camera_sees(levels: int, columns: int) -> None:
    ground = make_terrain(
        levels=levels, proportions={"flat": 1.0}, columns=columns, tile=8.0, cell=1.0, border=2.0, seed=1
    )
    model = drawn(ground)
    pieces = (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE) & (model.geom_size[:, 0] > 0)
    x, y = 4.0 * levels, 4.0 * columns
    grid = np.stack(
        np.meshgrid(np.arange(0.25 - x - 150, x + 150, 2.5), np.arange(0.25 - y - 150, y + 150, 2.5)), axis=-1
    )
    away = np.abs(grid[:, :, None] - model.geom_pos[pieces, :2]) <= model.geom_size[pieces, :2]
    tiles = (np.abs(grid) <= [x, y]).all(axis=-1)
    assert not model.geom_pos[pieces, 2].any()  # at the height of the tiles' rims
    assert (away.all(axis=-1).sum(axis=-1) == ~tiles).all(), "one piece everywhere beside the tiles, none over them"


def test_hills_are_as_high_as_the_ground(hilly: mujoco.MjModel) -> None:
    ground, data = grid(), mujoco.MjData(hilly)
    mujoco.mj_kinematics(hilly, data)
    hills = RoughGround(hilly, data)
    rows, columns = ground.heights.shape
    rng = np.random.default_rng(0)
    for row, column in zip(rng.integers(0, rows, 200), rng.integers(0, columns, 200), strict=True):
        place = np.array(ground.corner) + 0.1 * np.array([column, row])
        assert hills.height(place) == pytest.approx(ground.heights[row, column], abs=1e-5)
    assert hills.height(np.array([500.0, 0.0])) == 0.0


def test_only_near_tiles_are_drawn_in_full(hilly_spec: mujoco.MjSpec, hilly: mujoco.MjModel) -> None:
    ground = grid()
    middle = ground.origins[0, 0]
    with closing(RobotRenderer(hilly_spec, 64, 48, count=2)) as renderer:
        qpos = np.tile(hilly.qpos0, (2, 1))
        qpos[:, :3] = middle + (0.0, 0.0, 0.3)
        still = Moment(0.0, qpos, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 3)), np.zeros((2, 4), dtype=bool))
        renderer.frame(still)
        model, hills = renderer.robots.model, renderer.robots.ground
        assert hills is not None and len(shown(model)) == 8, "one of each tile"
        fine = shown(model) & set(hills.fine[hills.fine != hills.coarse].tolist())
        near = [tile for tile in range(8) if hills.fine[tile] in fine]
        assert 0 < len(near) < 6 and min(np.abs(hills.places[near] - middle[:2]).max(axis=1)) < 1e-6
        assert renderer.robots.offsets.tolist() == [[0.0] * 3] * 2, "each on its tile"


def test_the_camera_looks_over_what_rises_before_it(hilly_spec: mujoco.MjSpec, hilly: mujoco.MjModel) -> None:
    ground, cast = grid(), PosedRobots(hilly_spec)
    qpos = np.array(hilly.qpos0)
    elevations = []
    for column, ahead in ((KINDS.index("flat"), 0.0), (KINDS.index("stairs_up"), 2.0)):
        place = ground.origins[1, column] + (ahead, 0.0, 0.0)
        x, y = np.round((place[:2] - ground.corner) / 0.1).astype(int)
        qpos[:3] = *place[:2], ground.heights[y, x] + 0.3
        # so that the camera is at larger x, up the stairs
        qpos[3:7] = np.cos(np.radians(25)), 0, 0, np.sin(np.radians(25))
        cast.pose(qpos)
        camera = RobotCamera(mujoco.MjvCamera(), cast, by_hand=False).update("follow", 0)
        assert camera.azimuth == pytest.approx(180.0)
        elevations.append(camera.elevation)
    assert elevations[0] == ELEVATION > elevations[1] + 5.0


def test_boxes_are_places_too() -> None:
    step = (
        "<worldbody><geom type='box' size='1 1 .1'/><body pos='0 0 1'><freejoint/><geom size='.1'/></body></worldbody>"
    )
    assert not PosedRobots(mujoco.MjSpec.from_string(f"<mujoco>{step}</mujoco>"), 3).offsets.any()


# ---- the small grid of play.py


def played(*args: str) -> tuple[str, Session]:
    """What play.py prints, and the session that it would have run."""
    sessions: list[Session] = []

    def note(session: Session) -> Outcome:
        sessions.append(session)
        return Outcome(0.0, 0, [])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Session, "run", note)
        result = run(
            "play", ROOT, "--task", "go1_rough", "--load_run", "shipped", "--device", "cpu", "--viewer", "none", *args
        )
    assert result.code == 0, result.err
    return result.out, sessions[0]


def test_play_has_a_small_grid_with_a_robot_on_each_kind() -> None:
    out, session = played()
    for line in (
        "env.num_envs: 8192 -> 8",
        "terrain.num_rows: 12 -> 3",
        "terrain.num_cols: 20 -> 8",
        "terrain.border_size: 5.0 -> 2.0",
    ):
        assert f"  {line}\n" in out
    kinds = load_task("go1_rough").cfg.terrain.terrain_proportions
    on = [session.stage.ground(world).split(",")[0] for world in range(8)]
    assert sorted(on) == sorted(kinds) and on[0] == max(kinds, key=lambda kind: kinds[kind])
    assert not session.stage.ground(0).endswith("border")
    assert ("ground", session.stage.ground(0)) in session._lines(np.zeros(3), np.zeros(3))


def test_what_is_said_of_the_ground_wins_over_the_small_grid() -> None:
    stairs = (
        *shlex.split("--set 'terrain.terrain_proportions={stairs_up: 1}' --set 'terrain.difficulty=[0.5,0.5]'"),
        *shlex.split("--set terrain.num_rows=1"),
    )
    out, session = played(*stairs)
    assert (
        "  terrain.num_cols: 20 -> 1\n" in out
        and "-> {'stairs_up': 1.0}\n" in out
        and "  env.num_envs: 8192 -> 1\n" in out
    )
    assert session.stage.ground(0) == "stairs_up, step 12.8 cm"
    out, session = played(*stairs, "--num_envs", "2", "--set", "terrain.num_cols=2", "--set", "terrain.curriculum=true")
    assert "terrain.curriculum" not in out and session.stage.num_worlds == 2


def test_a_plane_stays_one() -> None:
    task = load_task("go1_flat")
    assert ground_to_watch(task) == {}
    task.set("terrain.mesh_type", "heightfield")
    assert ground_to_watch(task)["terrain.num_rows"] == 3
