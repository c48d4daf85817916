"""Pictures, video files and what the viewers say when they cannot work. A window itself is opened only where there is a display."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import legged_mw  # noqa: F401  (sets MUJOCO_GL, which mujoco reads when it is imported)

# isort: split
import av
import mujoco
import numpy as np
import pytest

from legged_mw.view import native, video
from legged_mw.view.native import NativeViewer, Pace, has_display
from legged_mw.view.overlay import DISTANCE, FollowCamera, Puppet
from legged_mw.view.video import RobotRenderer, VideoWriter, contact_sheet, save_png

LEG = '<body pos="{} {} 0"><joint axis="0 1 0"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.3" group="2"/></body>'
ROBOT = f"""
<mujoco>
  <worldbody>
    <light pos="0 0 4" dir="0 0 -1"/>
    <geom type="plane" size="0 0 .05" rgba=".2 .2 .2 1"/>
    <body name="trunk" pos="0 0 .35">
      <freejoint/>
      <geom type="box" size=".2 .06 .05" group="2" rgba=".6 .6 .6 1"/>
      <geom type="sphere" size=".25" group="3" rgba="1 0 0 1"/>
      {LEG.format(0.18, 0.1)} {LEG.format(0.18, -0.1)}
    </body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(ROBOT)


@pytest.fixture  # a new one for each test: the camera remembers where the robot was
def renderer(model: mujoco.MjModel) -> Iterator[RobotRenderer]:
    with RobotRenderer(model, 320, 240) as robot_renderer:
        yield robot_renderer


@pytest.fixture
def no_program(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """A PATH without ffmpeg: the folder `bin` and nothing else."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", str(folder))
    return folder


def fake_ffmpeg(folder: Path, body: str) -> None:
    """An ffmpeg that lists libx264 when asked for its encoders and else runs `body`; `$out` is the file to write."""
    script = folder / "ffmpeg"
    lines = f'if [ "$2" = "-encoders" ]; then echo " V....D libx264"; exit; fi\nfor out; do :; done\n{body}\n'
    script.write_text(f"#!/bin/sh\nPATH=/usr/bin:/bin\n{lines}")
    script.chmod(script.stat().st_mode | stat.S_IXUSR)


def colour_count(frame: np.ndarray, rgb: tuple[int, int, int]) -> int:
    """Pixels within 60 of `rgb` in every channel."""
    return int((np.abs(frame.astype(int) - rgb).max(axis=2) < 60).sum())


def frames(count: int) -> list[np.ndarray]:
    return [np.full((240, 320, 3), 20 * i, dtype=np.uint8) for i in range(count)]


# ---- video files


def test_video_decodes_to_what_was_written(tmp_path: Path, no_program: Path) -> None:
    path = tmp_path / "new" / "folder" / "walk.mp4"
    with VideoWriter(path, 320, 240, fps=50) as writer:
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


def test_video_goes_through_ffmpeg_where_there_is_one(tmp_path: Path, no_program: Path) -> None:
    fake_ffmpeg(no_program, 'cat > "$out"')
    with VideoWriter(tmp_path / "walk.mp4", 320, 240, fps=50) as writer:
        for frame in frames(3):
            writer.add(frame)
    assert (tmp_path / "walk.mp4").read_bytes() == b"".join(frame.tobytes() for frame in frames(3))


@pytest.mark.parametrize("fake", [False, True])
def test_broken_run_leaves_the_old_file_and_nothing_else(tmp_path: Path, no_program: Path, fake: bool) -> None:
    if fake:
        fake_ffmpeg(no_program, 'cat > "$out"')
    path = tmp_path / "out" / "walk.mp4"
    path.parent.mkdir()
    path.write_bytes(b"old")
    with pytest.raises(KeyboardInterrupt), VideoWriter(path, 320, 240, fps=50) as writer:
        writer.add(frames(1)[0])
        raise KeyboardInterrupt
    assert [(file.name, file.read_bytes()) for file in path.parent.iterdir()] == [("walk.mp4", b"old")]


def test_a_dying_ffmpeg_is_quoted(tmp_path: Path, no_program: Path) -> None:
    fake_ffmpeg(no_program, "echo disk full >&2; exit 3")
    with (
        pytest.raises(RuntimeError, match="ffmpeg ended with status 3: disk full"),
        VideoWriter(tmp_path / "walk.mp4", 320, 240, fps=50) as writer,
    ):
        for frame in frames(10):
            writer.add(frame)
    assert [file.name for file in tmp_path.iterdir()] == ["bin"]


def test_no_encoder_says_what_was_tried(tmp_path: Path, no_program: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(RuntimeError, match=r"ffmpeg: not on PATH; PyAV: .*pip install av, or ffmpeg"):
        VideoWriter(tmp_path / "walk.mp4", 320, 240, fps=50)


def test_bad_video_requests(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match=r"'walk.avi': the supported extension is \.mp4"):
        VideoWriter(tmp_path / "walk.avi", 320, 240, fps=50)
    with pytest.raises(RuntimeError, match="321 x 240 cannot be encoded: yuv420p needs an even width"):
        VideoWriter(tmp_path / "walk.mp4", 321, 240, fps=50)
    with pytest.raises(ValueError, match="fps = 0"):
        VideoWriter(tmp_path / "walk.mp4", 320, 240, fps=0)
    with (
        pytest.raises(ValueError, match=r"uint8 \(240, 320, 3\); got float64 \(2, 2, 3\)"),
        VideoWriter(tmp_path / "a.mp4", 320, 240, 50) as w,
    ):
        w.add(np.zeros((2, 2, 3)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(RuntimeError, match="empty.mp4 was not written: no frame"), VideoWriter(tmp_path / "empty.mp4", 320, 240, 50):
        pass
    assert list(tmp_path.iterdir()) == []


def test_contact_sheet_and_png(tmp_path: Path) -> None:
    sheet = contact_sheet(frames(5)[1:], columns=3)
    assert sheet.shape == (480, 960, 3)
    assert [int(sheet[y, x, 0]) for y, x in ((0, 0), (239, 959), (240, 0), (479, 959))] == [20, 60, 80, 0]
    save_png(tmp_path / "new" / "sheet.png", sheet)
    with av.open(str(tmp_path / "new" / "sheet.png")) as container:
        assert np.array_equal(next(container.decode(video=0)).to_ndarray(format="rgb24"), sheet)
    with pytest.raises(ValueError, match="got 0 frames, 3 columns"):
        contact_sheet([], columns=3)


# ---- pictures


def test_frames_are_copies_and_the_callers_model_is_untouched(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    first = renderer.frame(model.qpos0)
    kept = first.copy()
    raised = model.qpos0 + np.eye(model.nq)[2] * 0.15
    second = renderer.frame(raised)
    assert first.shape == (240, 320, 3) and first.dtype == np.uint8
    assert np.array_equal(first, kept) and not np.array_equal(first, second)
    assert (model.vis.global_.offwidth, model.vis.quality.shadowsize) == (640, 4096)  # MuJoCo's defaults


def test_both_arrows_are_drawn_and_collision_shapes_are_not(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    orange, blue, red = (255, 130, 0), (70, 215, 255), (255, 0, 0)
    forward, turn = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
    plain = renderer.frame(model.qpos0)
    assert [colour_count(plain, rgb) for rgb in (orange, blue, red)] == [0, 0, 0]
    for value in (forward, turn):
        commanded, both = renderer.frame(model.qpos0, command=value), renderer.frame(model.qpos0, command=value, velocity=value)
        assert colour_count(commanded, orange) > 20 and colour_count(commanded, blue) == 0
        assert colour_count(both, orange) > 10 and colour_count(both, blue) > 10
    assert np.array_equal(renderer.frame(model.qpos0, command=np.zeros(3)), plain)


def test_arrow_points_along_the_body_velocity(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    qpos = model.qpos0.copy()
    qpos[3:7] = np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)  # heading +y
    renderer.frame(qpos, command=np.array([1.0, 0.0, 0.0]))
    scene = renderer._renderer.scene
    arrow = scene.geoms[scene.ngeom - 1]
    assert arrow.type == mujoco.mjtGeom.mjGEOM_ARROW
    assert np.allclose(arrow.mat[:, 2], [0, 1, 0], atol=1e-6)


def test_camera_glides_after_the_base_and_cuts_after_a_jump(model: mujoco.MjModel) -> None:
    puppet = Puppet(model)
    follow, qpos = FollowCamera(puppet), model.qpos0.copy()
    assert np.allclose(follow.update().lookat, puppet.position)
    assert follow.camera.distance == pytest.approx(DISTANCE * puppet.radius)
    assert 0.3 < puppet.radius < 0.5 and puppet.top == pytest.approx(0.05)  # group 3 does not count
    qpos[0] += 0.1
    puppet.pose(qpos)
    assert 0 < follow.update().lookat[0] < 0.05
    for _ in range(60):
        follow.update()
    assert follow.camera.lookat[0] == pytest.approx(0.1, abs=1e-3)
    qpos[0] += 10
    puppet.pose(qpos)
    assert follow.update().lookat[0] == pytest.approx(10.1)


def test_bad_poses_and_models(model: mujoco.MjModel, renderer: RobotRenderer) -> None:
    with pytest.raises(ValueError, match=r"qpos has shape \(3,\); this model has nq = 9"):
        renderer.frame(np.zeros(3))
    with pytest.raises(ValueError, match=r"qpos\[8\] is not finite"):
        renderer.frame(np.append(model.qpos0[:-1], np.nan))
    with pytest.raises(ValueError, match=r"\(vx, vy, yaw rate\), shape \(3,\); got shape \(2,\)"):
        renderer.frame(model.qpos0, command=np.zeros(2))
    arm = '<mujoco><worldbody><body><joint name="elbow"/><geom size=".1"/></body></worldbody></mujoco>'
    with pytest.raises(ValueError, match="free joint, which must be the model's first joint; found 'elbow'"):
        Puppet(mujoco.MjModel.from_xml_string(arm))


def test_missing_opengl_names_the_remedy_and_the_state() -> None:
    code = (
        f"import mujoco\nfrom legged_mw.view.video import RobotRenderer\nRobotRenderer(mujoco.MjModel.from_xml_string({ROBOT!r}), 64, 48)"
    )
    environment = {key: value for key, value in os.environ.items() if key not in ("DISPLAY", "WAYLAND_DISPLAY")} | {"MUJOCO_GL": "glfw"}
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


def test_window_without_display_says_what_to_do(monkeypatch: pytest.MonkeyPatch, model: mujoco.MjModel) -> None:
    monkeypatch.setattr(native, "has_display", lambda: False)
    with pytest.raises(RuntimeError, match="neither DISPLAY nor WAYLAND_DISPLAY is set.*Record a video"):
        NativeViewer(model)
    monkeypatch.setattr(native, "has_display", lambda: True)
    monkeypatch.setattr(native, "_can_open_window", lambda: False)
    monkeypatch.setenv("DISPLAY", ":99")
    with pytest.raises(RuntimeError, match="No OpenGL window can be opened on this display .*DISPLAY=':99'"):
        NativeViewer(model)


def test_plain_python_on_macos_is_told_of_mjpython(monkeypatch: pytest.MonkeyPatch, model: mujoco.MjModel) -> None:
    import mujoco.viewer

    def refuse(*_: object, **__: object) -> None:
        raise RuntimeError("`launch_passive` requires mjpython")

    monkeypatch.setattr(sys, "platform", "darwin")
    monkeypatch.setattr(mujoco.viewer, "launch_passive", refuse)
    with pytest.raises(RuntimeError, match="start with `mjpython` in place of `python`"):
        NativeViewer(model)


@pytest.mark.display
def test_window_shows_poses_and_is_gone_after_close(model: mujoco.MjModel) -> None:
    with NativeViewer(model) as viewer:
        viewer.show(model.qpos0 + np.eye(model.nq)[0], command=np.array([1.0, 0.0, 0.0]), velocity=np.array([0.8, 0.0, 0.2]))
        assert viewer.is_running()
        assert viewer.puppet.position[0] == pytest.approx(1.0)
        assert viewer._handle.user_scn.ngeom > 2
    assert not viewer.is_running() and not any(thread.is_alive() for thread in viewer._threads)
    viewer.show(model.qpos0)  # harmless: the loop that feeds a window may notice late


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


def test_encoder_without_libx264_is_not_chosen(no_program: Path) -> None:
    fake_ffmpeg(no_program, "exit 1")
    script = no_program / "ffmpeg"
    script.write_text(script.read_text().replace("libx264", "mpeg4"))
    assert video._choose_encoder() is video._PyAv
