"""Pictures, files and the window, and what the viewers say when they cannot work. A window is opened only where there is a display."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import legged_mw  # noqa: F401  (sets MUJOCO_GL, which mujoco reads when it is imported)

# isort: split
import av
import mujoco
import numpy as np
import pytest

from legged_mw import ROOT
from legged_mw.drawing.scene import visual_spec
from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.utils.task import load_task
from legged_mw.view import native
from legged_mw.view.camera import DISTANCE, RobotCamera
from legged_mw.view.drive import BINDINGS, Pilot
from legged_mw.view.native import NativeViewer, has_display
from legged_mw.view.overlay import ARC_SEGMENTS, draw, draw_velocities
from legged_mw.view.posed_robot import Placement, PosedRobots, show_groups
from legged_mw.view.recorder import Recorder, RobotRenderer, VideoWriter, contact_sheet, save_png, shrunk
from legged_mw.view.session import Pace
from legged_mw.view.stage import Fall, Moment, ViewError, top_speed

LEG = """<body pos="{0} {1} 0"><joint axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" group="2"/>
<geom name="foot{1}" size=".03" pos="0 0 -.3" group="2"/></body>"""
ROBOT = f"""
<mujoco>
  <asset>
    <texture name="floor" type="2d" builtin="checker" rgb1=".2 .2 .2" rgb2=".3 .3 .3" width="64" height="64"/>
    <material name="floor" texture="floor" texuniform="true"/>
    <mesh name="wedge" vertex="0 0 0  .1 0 0  0 .1 0  0 0 .1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .05" material="floor"/>
    <body name="trunk" pos="0 0 .35">
      <light pos="0 0 4" dir="0 0 -1" mode="trackcom"/>
      <freejoint/>
      <geom type="box" size=".2 .06 .05" group="2" rgba=".6 .6 .6 1"/>
      <geom type="mesh" mesh="wedge" pos=".15 0 .05" group="2" rgba=".2 .8 .8 1"/>
      <geom type="sphere" size=".25" group="3" rgba="1 0 0 1"/>
      {LEG.format(0.18, 0.1)} {LEG.format(0.18, -0.1)}
    </body>
  </worldbody>
  <sensor><contact geom1="foot0.1" geom2="floor"/><contact geom1="foot-0.1" geom2="floor"/></sensor>
</mujoco>"""


SPEC = mujoco.MjSpec.from_string(ROBOT)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ROBOT)


@pytest.fixture  # a new one for each test: the camera remembers where the robot was
def renderer(model: mujoco.MjModel) -> Iterator[RobotRenderer]:
    with closing(RobotRenderer(SPEC, 320, 240)) as robot_renderer:
        yield robot_renderer


TABLE = [Command(name, -1.0, 1.0) for name in VELOCITY]


def moment(model: mujoco.MjModel, count: int = 1, **changes: Any) -> Moment:
    """Robots that stand in their first pose and do nothing, but for `changes`."""
    zero = np.zeros((count, 3))
    still = Moment(0.0, np.tile(model.qpos0, (count, 1)), zero, zero, zero, np.zeros((count, 2), dtype=bool))
    return still._replace(**changes)


def colour_count(frame: np.ndarray, rgb: tuple[int, int, int]) -> int:
    """Pixels within 60 of `rgb` in every channel."""
    return int((np.abs(frame.astype(int) - rgb).max(axis=2) < 60).sum())


def frames(count: int) -> list[np.ndarray]:
    return [np.full((240, 320, 3), 20 * i, dtype=np.uint8) for i in range(count)]


# ---- video files


def test_video_decodes_to_what_was_written(tmp_path: Path) -> None:
    path = tmp_path / "new" / "folder" / "walk.mp4"
    with closing(VideoWriter(path, 320, 240, fps=50)) as writer:
        for frame in frames(10):
            writer.add(frame)
        assert not path.exists()
    assert list(path.parent.iterdir()) == [path]
    data = path.read_bytes()
    assert data.index(b"moov") < data.index(b"mdat")  # a browser can start before it has all
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        assert (context.name, context.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 50)
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert [frame.shape for frame in decoded] == [(240, 320, 3)] * 10
    assert all(abs(frame.mean() - 20 * i) < 5 for i, frame in enumerate(decoded))


@pytest.mark.parametrize("name", ["walk.mp4", "walk.gif"])
def test_broken_run_leaves_the_old_file_and_nothing_else(tmp_path: Path, name: str) -> None:
    path = tmp_path / "out" / name
    path.parent.mkdir()
    path.write_bytes(b"old")
    writer = VideoWriter(path, 320, 240, fps=50)
    writer.add(frames(1)[0])
    writer.abort()
    writer.close()  # harmless
    assert [(file.name, file.read_bytes()) for file in path.parent.iterdir()] == [(name, b"old")]


@pytest.mark.parametrize("name", ["10:30.mp4", "take:1/walk.gif", f"{'x' * 251}.mp4"])
def test_a_video_may_have_any_name_that_a_file_may_have(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with closing(VideoWriter(name, 320, 240, fps=25)) as writer:
        writer.add(frames(1)[0])
    assert [file.name for file in Path(name).parent.iterdir()] == [Path(name).name]


@pytest.mark.parametrize("name", ["walk.mp4", "walk.gif"])
def test_a_disk_that_fills_up_is_said_and_leaves_the_old_file(tmp_path: Path, name: str) -> None:
    path, noise = tmp_path / name, np.random.default_rng(0)
    path.write_bytes(b"old")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        writer = VideoWriter(path, 320, 240, fps=50)
        with pytest.raises(ViewError, match=name):
            for _ in range(60):
                writer.add(noise.integers(0, 255, (240, 320, 3), dtype=np.uint8))
            writer.close()
        writer.abort()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [(name, b"old")]


def test_a_gif_needs_no_encoder_of_mp4(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(av, "codecs_available", {"gif"})
    VideoWriter(tmp_path / "walk.gif", 320, 240, fps=12.5).abort()


def test_contact_sheet_and_png(tmp_path: Path) -> None:
    sheet = contact_sheet(frames(5)[1:], columns=3)
    assert sheet.shape == (480, 960, 3)
    assert [int(sheet[y, x, 0]) for y, x in ((0, 0), (239, 959), (240, 0), (479, 959))] == [20, 60, 80, 0]
    save_png(tmp_path / "new" / "sheet.png", sheet)
    with av.open(str(tmp_path / "new" / "sheet.png")) as container:
        assert np.array_equal(next(container.decode(video=0)).to_ndarray(format="rgb24"), sheet)


def test_gif_is_an_animation_in_its_own_colours(tmp_path: Path) -> None:
    path = tmp_path / "walk.gif"
    pictures = [np.full((40, 61, 3), (200, 20 * i, 30), dtype=np.uint8) for i in range(6)]  # odd widths are no trouble
    with closing(VideoWriter(path, 61, 40, fps=12.5)) as writer:
        for picture in pictures:
            writer.add(picture)
        assert not path.exists()
    assert [file.name for file in path.parent.glob("*.gif")] == ["walk.gif"] and path.read_bytes()[:6] == b"GIF89a"
    with av.open(str(path)) as container:
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert float(container.streams.video[0].average_rate or 0) == pytest.approx(12.5)
    assert len(decoded) == 6
    assert all(np.abs(seen.astype(int) - drawn).mean() < 6 for seen, drawn in zip(decoded, pictures, strict=True))


def test_a_recorder_writes_a_video_and_a_sheet(tmp_path: Path, model: mujoco.MjModel) -> None:
    film = Recorder(
        SPEC, 1, 0.02, 1.2, video=tmp_path / "a.mp4", sheet=tmp_path / "a.png", width=160, height=120, fps=25
    )
    for step in range(60):
        film.show(moment(model, time=step * 0.02))
    film.close()
    with av.open(str(tmp_path / "a.mp4")) as container:
        assert len(list(container.decode(video=0))) == 30
    with av.open(str(tmp_path / "a.png")) as container:
        assert next(container.decode(video=0)).to_ndarray(format="rgb24").shape == (3 * 120, 4 * 160, 3)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    film = Recorder(SPEC, 1, 0.02, 1.2, video=tmp_path / "a.mp4", sheet=None, width=160, height=120)
    film.show(moment(model))
    film.abort()
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before


def test_pictures_of_a_sheet_are_shrunk_by_means() -> None:
    frame = np.zeros((4, 6, 3), dtype=np.uint8)
    frame[::2] = 100
    assert shrunk(frame, 3).shape == (2, 3, 3) and (shrunk(frame, 3) == 50).all()
    assert np.array_equal(shrunk(frame, 6), frame)


# ---- pictures


def test_frames_are_copies_and_the_callers_model_is_untouched(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    first = renderer.frame(moment(model))
    kept = first.copy()
    second = renderer.frame(moment(model, qpos=model.qpos0[None] + np.eye(model.nq)[2] * 0.15))
    assert first.shape == (240, 320, 3) and first.dtype == np.uint8
    assert np.array_equal(first, kept) and not np.array_equal(first, second)
    assert (model.vis.global_.offwidth, model.vis.quality.shadowsize) == (640, 4096)  # MuJoCo's defaults


def test_both_arrows_are_drawn_and_collision_shapes_are_not(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    orange, blue, red = (255, 130, 0), (70, 215, 255), (255, 0, 0)
    plain = renderer.frame(moment(model))
    assert [colour_count(plain, rgb) for rgb in (orange, blue, red)] == [0, 0, 0]
    for value in ([[1.0, 0.0, 0.0]], [[0.0, 0.0, 1.0]]):
        commanded = renderer.frame(moment(model, target_velocity=np.array(value)))
        both = renderer.frame(moment(model, target_velocity=np.array(value), velocity=np.array(value)))
        assert colour_count(commanded, orange) > 20 and colour_count(commanded, blue) == 0
        assert colour_count(both, orange) > 10 and colour_count(both, blue) > 10


def test_arrow_points_along_the_body_velocity() -> None:
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string(ROBOT), 100)
    # heading +y
    draw_velocities(scene, Placement(np.zeros(3), np.pi / 2, 0.4, 0.1), np.array([1.0, 0.0, 0.0]), np.zeros(3))
    [arrow] = scene.geoms[: scene.ngeom]
    assert arrow.type == mujoco.mjtGeom.mjGEOM_ARROW
    assert np.allclose(arrow.mat[:, 2], [0, 1, 0], atol=1e-6)


def test_arrows_fit_the_fastest_command() -> None:
    """1.3 radii a m/s up to 1.5 m/s; of a faster robot the fastest command has the same arrow, and a push cannot make it much longer."""
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string(ROBOT), 100)
    lengths = []
    for speed, top in ((1.0, 1.0), (1.5, 1.5), (3.0, 3.0), (1.5, 3.0), (9.0, 1.0)):
        scene.ngeom = 0
        draw_velocities(scene, Placement(np.zeros(3), 0.0, 0.4, 0.1), [speed, 0.0, 0.0], np.zeros(3), top_speed=top)
        lengths.append(float(scene.geoms[0].size[2]) / 0.4)
    assert lengths == pytest.approx([1.3, 1.95, 1.95, 0.975, 1.1 * 1.95])
    table = [Command("lin_vel_x", -0.5, 2.0), Command("lin_vel_y", -2.5, 1.0), Command("base_height", 0.0, 9.0)]
    assert top_speed(table) == 2.5 and top_speed(table[2:]) == 1.0


def test_a_task_without_a_velocity_command_has_no_arrow_for_it() -> None:
    scene = mujoco.MjvScene(mujoco.MjModel.from_xml_string(ROBOT), 100)
    place, moving = Placement(np.zeros(3), 0.0, 0.4, 0.1), np.ones(3)
    counts = []
    for target in ([np.nan] * 3, [1.0, np.nan, np.nan], [1.0, 0.0, np.nan], [np.nan, np.nan, 1.0], [1.0, 0.0, 1.0]):
        scene.ngeom = 0
        draw_velocities(scene, place, np.array(target), moving)
        counts.append(scene.ngeom)
    turn = 2 * (ARC_SEGMENTS + 1)
    assert counts == [0, 0, 2, turn, 2 + turn]


def test_feet_that_stand_and_places_of_falls_are_marked(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    green, pink = (0, 255, 180), (220, 60, 120)
    lifted = model.qpos0[None] + np.eye(model.nq)[2] * 0.1  # so that the discs are not inside the floor
    assert colour_count(renderer.frame(moment(model, qpos=lifted)), green) == 0
    one, two = (renderer.frame(moment(model, qpos=lifted, contacts=np.array([[True, both]]))) for both in (False, True))
    assert 5 < colour_count(one, green) < colour_count(two, green)
    fallen = renderer.frame(moment(model, falls=(Fall(0, np.array([0.0, 0.4, 0.3])),)))
    assert colour_count(fallen, pink) > 50


def test_what_is_followed_is_a_pale_robot_beside(model: mujoco.MjModel) -> None:
    robots, scenes = PosedRobots(mujoco.MjSpec.from_string(ROBOT)), [mujoco.MjvScene(model, 200) for _ in range(2)]
    beside = model.qpos0[None] + np.eye(model.nq)[1] * 5.0
    for scene, ghost in zip(scenes, (None, beside), strict=True):
        draw(scene, robots, moment(model, ghost=ghost))
    ghosts = scenes[1].geoms[scenes[0].ngeom : scenes[1].ngeom]
    assert len(ghosts) and all(geom.rgba[3] < 0.5 and geom.pos[1] > 4.0 for geom in ghosts)
    assert (robots.data.qpos == model.qpos0).all()  # the robot itself stays


def test_words_are_written_over_the_picture(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    plain, said = (renderer.frame(moment(model, lines=lines)) for lines in ((), (("falls", "3"),)))
    assert (
        np.array_equal(plain[120:], said[120:])
        and (said[:40, :80] > 200).any()
        and not np.array_equal(plain[:40, :80], said[:40, :80])
    )


def test_camera_glides_after_the_base_and_cuts_after_a_jump(model: mujoco.MjModel) -> None:
    robots, qpos = PosedRobots(SPEC), model.qpos0.copy()
    follow = RobotCamera(mujoco.MjvCamera(), robots, by_hand=False)
    assert np.allclose(follow.update("follow", 0).lookat, robots.placements[0].position)
    assert follow.camera.distance == pytest.approx(DISTANCE * robots.radius)
    assert 0.3 < robots.radius < 0.5 and robots.placements[0].top == pytest.approx(0.15)  # group 3 does not count
    qpos[0] += 0.1
    robots.pose(qpos)
    assert 0 < follow.update("follow", 0).lookat[0] < 0.05
    for _ in range(60):
        follow.update("follow", 0)
    assert follow.camera.lookat[0] == pytest.approx(0.1, abs=1e-3)
    qpos[0] += 10
    robots.pose(qpos)
    assert follow.update("follow", 0).lookat[0] == pytest.approx(10.1)


def test_camera_walks_behind_and_sees_all(model: mujoco.MjModel) -> None:
    robots = PosedRobots(SPEC, 4)
    camera = RobotCamera(mujoco.MjvCamera(), robots, by_hand=False)
    qpos = np.tile(model.qpos0, (4, 1))
    qpos[1, 3:7] = np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)
    robots.pose(qpos, 1)
    assert camera.update("behind", 1).azimuth == pytest.approx(90)  # looks along the robot's x axis
    near = camera.camera.distance
    camera.update("all", 1)
    assert (
        np.allclose(camera.camera.lookat[:2], robots.offsets[:, :2].mean(axis=0)) and camera.camera.distance > 2 * near
    )


def test_a_mouse_may_turn_the_camera_that_follows(model: mujoco.MjModel) -> None:
    robots = PosedRobots(SPEC)
    camera = RobotCamera(mujoco.MjvCamera(), robots, by_hand=True)
    camera.update("follow", 0)
    assert camera.camera.type == mujoco.mjtCamera.mjCAMERA_TRACKING and camera.camera.trackbodyid == robots.base
    camera.camera.azimuth = 17.0
    assert camera.update("follow", 0).azimuth == 17.0


# ---- several robots


def test_another_robot_looks_as_the_followed_one_does(model: mujoco.MjModel) -> None:
    """The same robot in the same pose at the same place: followed, and beside a followed one that is behind the camera."""
    pose = model.qpos0 + 0.2 * np.eye(model.nq)[7] + 0.3 * np.eye(model.nq)[0]
    pictures = []
    for count in (1, 2):
        robots = PosedRobots(SPEC, count)
        robots.offsets[:] = 0.0
        away = model.qpos0 - 6.0 * np.eye(model.nq)[1]
        robots.pose(np.stack([away, pose])[-count:])
        camera, option = mujoco.MjvCamera(), mujoco.MjvOption()
        camera.lookat[:], camera.distance, camera.elevation = [0.3, 0, 0.2], 1.2, -20
        show_groups(option)
        with mujoco.Renderer(robots.model, 120, 160) as view:
            view.update_scene(robots.data, camera, option)
            assert view.scene.ngeom == 1 + count * 6  # group 3 stays behind
            lamp = next(light for light in view.scene.lights[: view.scene.nlight] if not light.headlight)
            lamp.pos[:] = 0.3, 0, 4  # the model's light stays with the followed robot
            pictures.append(view.render().astype(int))
    difference = np.abs(pictures[0] - pictures[1])
    assert pictures[0].std() > 20 and difference.mean() < 1.5, difference.mean()


def test_robots_stand_side_by_side_each_in_its_pose(model: mujoco.MjModel) -> None:
    robots, qpos = PosedRobots(SPEC, 5), np.tile(model.qpos0, (5, 1))
    qpos[3, :3] += (0.5, -0.2, 0.1)
    qpos[3, 7] = 0.7
    robots.pose(qpos, 3)
    apart = np.linalg.norm(robots.offsets[:, None] - robots.offsets[None], axis=2) + 10 * np.eye(5)
    assert apart.min() >= 2 * robots.radius and not robots.offsets[0].any()
    assert np.allclose(robots.placements[3].position, robots.offsets[3] + qpos[3, :3])
    alone = PosedRobots(SPEC)
    alone.pose(qpos[3])
    followed, fourth = slice(1, model.nbody), slice(1 + 3 * (model.nbody - 1), 1 + 4 * (model.nbody - 1))
    assert np.allclose(robots.data.xpos[followed], alone.data.xpos[1:] + robots.offsets[3])
    assert np.allclose(robots.data.xquat[followed], alone.data.xquat[1:])
    robots.pose(qpos, 1)
    assert np.allclose(robots.data.xpos[robots.base], robots.placements[1].position)  # what the camera tracks
    assert np.allclose(robots.placements[3].position, robots.offsets[3] + qpos[3, :3])
    assert np.allclose(robots.data.xpos[fourth], alone.data.xpos[1:] + robots.offsets[3])  # robots 1, 0, 2, 3, 4
    assert np.allclose(robots.data.xquat[fourth], alone.data.xquat[1:])
    assert robots.model.nlight == 1 and robots.model.nsensor == 0 and robots.model.nmesh == 1
    contacts = np.zeros((5, 2), dtype=bool)
    contacts[3, 0] = True  # of the leg that is turned
    [patch] = robots.patches(contacts)
    assert np.allclose(patch.place, alone.data.geom("foot0.1").xpos + robots.offsets[3] - (0, 0, 0.03))
    # 2.2 x 0.03 would be large for it
    assert 0.03 < 0.15 * robots.radius < 0.066 and np.allclose(patch.half, 0.15 * robots.radius)


def with_feet(geom: str, pitch: float = 0.0, yaw: float = 0.0) -> PosedRobots:
    """The robot with other feet, its leg pitched and the robot turned."""
    robots = PosedRobots(mujoco.MjSpec.from_string(ROBOT.replace('size=".03" pos="0 0 -.3"', geom)))
    qpos = robots.model.qpos0.copy()
    qpos[7] = pitch
    qpos[3:7] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
    robots.pose(qpos)
    return robots


def test_the_disc_of_a_flat_foot_is_below_its_sole() -> None:
    """As long and as wide as the sole and a margin, 2.2 times the sole's half height, and turned with the foot."""
    box = 'type="box" size=".1 .04 .01" pos=".05 0 -.3"'
    [patch] = with_feet(box).patches([[True, False]])
    assert np.allclose(patch.place, [0.18 + 0.05, 0.1, 0.35 - 0.31]) and np.array_equal(patch.turn, np.eye(3))
    assert np.allclose(patch.half, [0.1 + 0.022, 0.04 + 0.022])
    [turned] = with_feet(box, yaw=np.pi / 2).patches([[True, False]])
    assert np.allclose(turned.place, [-0.1, 0.18 + 0.05, 0.04]) and np.allclose(turned.turn[:, 0], [0, 1, 0])
    assert np.allclose(turned.half, patch.half)
    # on its heel or its toe: the disc lies below that edge, and is no longer than its margin
    robots = with_feet(box, pitch=0.5)
    [edge] = robots.patches([[True, False]])
    corner = robots.data.geom("foot0.1").xpos + robots.data.geom("foot0.1").xmat.reshape(3, 3) @ (0.1, 0.0, -0.01)
    assert np.allclose(edge.place, corner) and np.allclose(edge.half, [0.022, 0.04 + 0.022])


@pytest.mark.parametrize(
    ("geom", "low"),
    [
        ('type="capsule" size=".01 .05" pos="0 0 -.3" euler="0 90 0"', [-0.31, 0.05]),
        ('type="ellipsoid" size=".03 .02 .01" pos="0 0 -.3"', [-0.31, 0.0]),
        ('type="cylinder" size=".03 .01" pos="0 0 -.3"', [-0.31, 0.03]),
    ],
)
def test_discs_of_feet_of_any_shape(geom: str, low: list[float]) -> None:
    """Height of the lowest point below the hip, and how far what touches reaches from the middle."""
    robots = with_feet(geom)
    [patch] = robots.patches([[True, False]])
    margin = max(2.2 * 0.01, 0.045 * robots.radius)
    assert np.allclose(patch.place, [0.18, 0.1, 0.35 + low[0]]) and patch.half[0] == pytest.approx(low[1] + margin)


def test_a_foot_of_several_geoms_has_one_disc() -> None:
    """Heel and toe of the example's biped: one disc below both, or below the one that is down."""
    task = load_task(str(ROOT / "examples" / "toy_biped.py"))
    task.set("env.num_envs", 1)
    robots = PosedRobots(visual_spec(task.env_class(task.cfg, "cpu").robot))
    both, toe = robots.patches([[True, True, False, True]])
    sole = 0.62 - 2 * 0.28 - 0.03 - 0.015  # [m] the height of the trunk in its first pose, less its legs and a box
    margin = 2.2 * 0.015
    assert np.allclose(both.place, [(-0.07 + 0.12) / 2, 0.09, sole]) and np.allclose(
        both.half, [0.095 + margin, 0.05 + margin]
    )
    assert np.allclose(toe.place, [0.07, -0.09, sole]) and np.allclose(toe.half, 0.05 + margin)
    assert robots.patches([[False] * 4]) == [] and robots.patches([[True] * 5]) == []  # more columns than sensors


def test_links_without_looks_show_their_collision_shapes(model: mujoco.MjModel) -> None:
    """Feet in a hidden group are seen where their link has no looks, and count as a part of the robot where it has."""
    hidden = ROBOT.replace('fromto="0 0 0 0 0 -.3" group="2"', 'fromto="0 0 0 0 0 -.3" group="3"')
    hidden = hidden.replace('size=".03" pos="0 0 -.3" group="2"', 'size=".03" pos="0 0 -.3" group="3"')
    robots = PosedRobots(mujoco.MjSpec.from_string(hidden))
    groups = {robots.model.geom(i).name: int(robots.model.geom_group[i]) for i in range(robots.model.ngeom)}
    assert groups["foot0.1"] == groups["foot-0.1"] == 2 and sorted(robots.model.geom_group) == [0, 2, 2, 2, 2, 2, 2, 3]
    assert robots.radius == pytest.approx(PosedRobots(SPEC).radius) and robots.bottom == pytest.approx(0.33)
    feet = ROBOT.replace('size=".03" pos="0 0 -.3" group="2"', 'size=".03" pos="0 0 -.3" group="3"')
    below = PosedRobots(mujoco.MjSpec.from_string(feet))
    assert below.model.geom("foot0.1").group == 3 and below.bottom == pytest.approx(0.33)


# ---- sizes


def in_picture(camera: mujoco.MjvCamera, place: np.ndarray) -> np.ndarray:
    """Where a point is: to the right and up, 1 at the upper edge of a picture with a height of 45 degrees."""
    azimuth, elevation = np.deg2rad(camera.azimuth), np.deg2rad(camera.elevation)
    ahead = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    away = place - (camera.lookat - camera.distance * ahead)
    return np.array([away @ right, away @ np.cross(right, ahead)]) / (away @ ahead) / np.tan(np.deg2rad(22.5))


@pytest.mark.parametrize("mode", ["follow", "behind", "all"])
@pytest.mark.parametrize("height", [0.3, 0.7, 1.3, 1.8])
@pytest.mark.parametrize("wide", [False, True])
def test_robots_of_every_height_are_in_the_picture_with_their_arrows(height: float, wide: bool, mode: str) -> None:
    """A tall one and a long one, its base in the middle; at the fastest command, ahead and to the side."""
    length = 1.2 * height if wide else 0.2 * height
    text = f"""<mujoco><worldbody><body pos="0 0 {height / 2}"><freejoint/>
    <geom type="box" size="{length / 2} {0.1 * height} {height / 2}"/></body></worldbody></mujoco>"""
    robots = PosedRobots(mujoco.MjSpec.from_string(text))
    camera = RobotCamera(mujoco.MjvCamera(), robots, by_hand=False).update(mode, 0)
    scene = mujoco.MjvScene(robots.model, 100)
    for velocity in ([2.0, 0.0, 1.0], [-2.0, 0.0, -1.0], [0.0, 2.0, 1.0]):
        draw_velocities(scene, robots.placements[0], velocity, velocity, top_speed=2.0)
    drawn = scene.geoms[: scene.ngeom]  # MuJoCo draws an arrow half as long as its size says
    share = {mujoco.mjtGeom.mjGEOM_ARROW: 0.5, mujoco.mjtGeom.mjGEOM_CAPSULE: 1.0}
    ends = [np.array(geom.pos) + np.array(geom.mat)[:, 2] * geom.size[2] * share[geom.type] for geom in drawn]
    assert min(end[2] for end in ends) > height  # above its top
    corners = [
        np.array([x, y, z])
        for x in (-length / 2, length / 2)
        for y in (0.1 * height, -0.1 * height)
        for z in (0.0, height)
    ]
    for place in [*ends, *corners]:
        right, up = in_picture(camera, place)
        assert abs(up) < 1.0 and abs(right) < 16 / 9, (place, right, up)


def test_the_camera_of_a_scene_is_as_far_as_its_robot_is_large() -> None:
    """Go1's is where it always was; who gives a place gets that one."""
    places = []
    for name, camera in (
        ("go1_flat", []),
        (str(ROOT / "examples" / "toy_biped.py"), []),
        ("go1_flat", [1.0, 2.0, 3.0]),
    ):
        task = load_task(name)
        task.update({"env": {"num_envs": 1}, "viewer": {"camera": camera}}, where="test")
        env = task.env_class(task.cfg, "cpu")
        places.append(list(visual_spec(env.robot, env.cfg.viewer.camera).camera("track").pos))
    assert places == [[0.9, -1.1, 0.6], [1.2, -1.5, 0.8], [1.0, 2.0, 3.0]]


def test_on_a_terrain_each_robot_stays_where_it_is() -> None:
    terrain = '<asset><hfield name="hills" nrow="2" ncol="2" size="2 2 .5 .1" elevation="0 1 1 0"/></asset><worldbody>'
    floor = '<geom name="floor" type="plane" size="0 0 .05" material="floor"/>'
    ground = floor.replace("plane", "hfield").replace('size="0 0 .05"', 'hfield="hills"')
    hills = mujoco.MjSpec.from_string(ROBOT.replace("<worldbody>", terrain, 1).replace(floor, ground))
    robots = PosedRobots(hills, 3)
    assert not robots.offsets.any() and robots.ground is not None
    assert robots.model.nhfield == 1 and np.allclose(robots.model.hfield_data, hills.compile().hfield_data)


def test_many_robots_are_in_one_picture(model: mujoco.MjModel) -> None:
    with closing(RobotRenderer(SPEC, 320, 240, count=4)) as several:
        command = np.tile([1.0, 0.0, 0.0], (4, 1))
        one = colour_count(
            several.frame(moment(model, 4, target_velocity=command * [[1], [0], [0], [0]], camera="all")), (255, 130, 0)
        )
        four = colour_count(several.frame(moment(model, 4, target_velocity=command, camera="all")), (255, 130, 0))
        assert one > 5 and four > 2.5 * one


def test_a_pose_that_is_not_finite(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    with pytest.raises(ValueError, match=r"qpos\[8\] is not finite"):
        renderer.frame(moment(model, qpos=np.append(model.qpos0[:-1], np.nan)[None]))


def test_missing_opengl_names_the_remedy_and_the_state() -> None:
    code = "import mujoco\nfrom legged_mw.view.recorder import RobotRenderer\n"
    code += f"RobotRenderer(mujoco.MjSpec.from_string({ROBOT!r}), 64, 48)"
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")} | {
        "MUJOCO_GL": "glfw"
    }
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=False)
    assert "ViewError: No OpenGL context for offscreen rendering (MUJOCO_GL='glfw', DISPLAY=None)" in done.stderr
    assert "set MUJOCO_GL=egl" in done.stderr and "MUJOCO_GL=osmesa" in done.stderr


# ---- windows


def test_has_display_follows_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    assert not has_display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-0")
    assert has_display()
    monkeypatch.setenv("WAYLAND_DISPLAY", "")
    monkeypatch.setenv("DISPLAY", ":0")
    assert has_display()
    monkeypatch.delenv("DISPLAY")
    monkeypatch.setattr(sys, "platform", "darwin")
    assert has_display()


@pytest.mark.display
def test_window_shows_poses_and_is_gone_after_close(model: mujoco.MjModel) -> None:
    pilot = Pilot(TABLE, 2)
    with closing(NativeViewer(SPEC, pilot, 2)) as viewer:
        qpos = np.tile(model.qpos0, (2, 1)) + np.eye(model.nq)[0]
        viewer.show(moment(model, 2, qpos=qpos, target_velocity=np.ones((2, 3)), lines=(("falls", "0"),), world=1))
        assert viewer.is_running()
        assert viewer.robots.placements[0].position[0] == pytest.approx(1.0)
        assert viewer._handle.user_scn.ngeom > 2
        flag = int(mujoco.mjtVisFlag.mjVIS_CONTACTSPLIT)  # what P switches in MuJoCo's windows
        viewer._handle.opt.flags[flag] = 1
        viewer.show(moment(model, 2))
        assert viewer._handle.opt.flags[flag] == 0
    assert not viewer.is_running() and not any(thread.is_alive() for thread in viewer._threads)
    viewer.show(moment(model, 2))  # harmless: the loop that feeds a window may notice late


def test_every_key_of_the_table_reaches_the_pilot_by_its_code() -> None:
    asked: list[str] = []
    pilot = Pilot(TABLE)
    pilot.ask = asked.append  # pyright: ignore[reportAttributeAccessIssue]
    pressed = native.on_key(pilot)
    for code in (
        265,
        264,
        263,
        262,
        ord("Q"),
        ord("E"),
        ord("U"),
        ord("J"),
        32,
        ord("P"),
        ord("R"),
        259,
        ord("N"),
        257,
        ord("-"),
        ord("="),
        ord("C"),
        290,
    ):
        pressed(code)  # the last is F1, which is MuJoCo's
    assert asked[:9] == ["forward", "back", "left", "right", "turn_left", "turn_right", "raise", "lower", "stop"]
    assert asked[9:] == ["push", "reset", "reset", "next", "pause", "slower", "faster", "camera"]
    assert len(native.KEY_CODES) == sum(len(binding.keys) for binding in BINDINGS)


def test_our_keys_switch_nothing_of_mujocos_that_is_not_switched_back() -> None:
    rendering = {row[2] for row in mujoco.mjRNDSTRING}
    # reflections: no material of ours has any
    assert {chr(code) for code in native.KEY_CODES if code < 128} & rendering <= {"R"}


def test_window_texts_fit_mujocos_overlay(model: mujoco.MjModel) -> None:
    blocks = native.window_texts(moment(model, lines=(("falls", "2"), ("time", "1 s")), help=True))
    assert (blocks[0][2], blocks[0][3]) == ("falls\ntime", "2\n1 s")
    assert all(len(text) < 500 for block in blocks for text in block[2:])  # mjMAXOVERLAY
    assert any("push the robot" in block[3] for block in blocks)
    assert not any("push the robot" in block[3] for block in native.window_texts(moment(model)))


def test_pace_holds_real_time_and_does_not_hurry_after_a_delay() -> None:
    pace, start = Pace(0.01), time.perf_counter()
    for _ in range(5):
        pace.wait()
    assert time.perf_counter() - start >= 0.05
    time.sleep(0.05)
    start = time.perf_counter()
    for _ in range(4):
        pace.wait()  # the first returns at once
    assert time.perf_counter() - start >= 0.03


def test_feet_are_found_among_other_contacts() -> None:
    """The port of legged_gym's task senses contacts of thighs, calves and trunk too; its feet come first."""
    task = load_task(str(ROOT / "examples" / "go1_legged_gym.py"))
    task.set("env.num_envs", 1)
    spec = visual_spec(task.env_class(task.cfg, "cpu").robot)
    robots = PosedRobots(spec, 1)
    assert len(robots.feet) > 4
    robots.pose(spec.compile().qpos0[None], 0)
    assert len(robots.patches(np.array([[True, False, True, False]]))) == 2


def test_a_camera_that_draws_seldom_is_where_one_that_draws_always_is(model: mujoco.MjModel) -> None:
    """A contact sheet alone draws every twentieth frame; its robot must not have left the picture."""
    seen = []
    for skip in (1, 20):
        robots = PosedRobots(SPEC, 1)
        man, qpos = RobotCamera(mujoco.MjvCamera(), robots, by_hand=False), np.array(model.qpos0)
        for step in range(0, 61, skip):
            qpos[0] = 0.02 * step  # 1 m/s at 50 frames a second
            robots.pose(qpos[None], 0)
            man.update("follow", 0, frames=skip)
        seen.append(qpos[0] - man.camera.lookat[0])
    assert 0.0 < seen[1] < seen[0] < 0.2
