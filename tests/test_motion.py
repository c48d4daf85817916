"""Clips as files: read, resampled, checked; those of others; those that ship; and kinematics in torch beside MuJoCo's."""

import sys
import warnings
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from legged_mw import ROOT
from legged_mw.envs.robot_task import load_robot
from legged_mw.motion import look
from legged_mw.motion.__main__ import feet_of, main
from legged_mw.motion.foreign import breadth_first, read_motion
from legged_mw.motion.look import page
from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.sim.surface_points import SPACING, spheres_on
from legged_mw.skills.clip import (
    Clip,
    ClipError,
    checked,
    from_rotation_vector,
    heading,
    multiply,
    read_clip,
    rotate,
    rotation_vector,
    save_clip,
)
from legged_mw.skills.kinematics import Kinematics
from legged_mw.utils.task import load_task

CLIPS = sorted((ROOT / "resources/motions").glob("*.npz"))
AXIS = np.array([0.6, 0.0, 0.8])


@pytest.fixture(scope="module")
def g1() -> RobotModel:
    return load_robot(load_task("g1_track").cfg, "servo", "mujoco")


def steady(fps: float = 30.0, frames: int = 31) -> Clip:
    """A root that moves at 1 m/s and turns at 2 rad/s, and a joint at 3 rad/s."""
    time = np.arange(frames) / fps
    return checked(
        Path("clip"),
        fps,
        ["knee"],
        np.outer(time, [1.0, 0.0, 0.0]),
        from_rotation_vector(np.outer(2 * time, AXIS)),
        3 * time[:, None],
    )


def test_a_clip_at_another_rate_is_the_same_motion() -> None:
    assert steady(frames=2).seconds == pytest.approx(1 / 30)  # two frames are enough
    clip = steady().at(50.0)
    assert len(clip.root_pos) == 51 and clip.seconds == pytest.approx(1.0)
    for ours, right in zip(clip[2:], steady(50.0, 51)[2:], strict=True):
        np.testing.assert_allclose(ours, right, atol=1e-9)
    # turning is in the body's frame
    np.testing.assert_allclose(clip.qvel(), np.tile([1.0, 0, 0, *(2 * AXIS), 3.0], (51, 1)), atol=1e-9)


def test_rotations_by_hand() -> None:
    """A quarter turn, the way there and back, the shorter way round, and the heading of a body that also leans."""
    yaw, roll = (from_rotation_vector(np.array(v)) for v in ([0.0, 0.0, np.pi / 2], [0.3, 0.0, 0.0]))
    np.testing.assert_allclose(rotate(yaw, np.array([2.0, 0.0, 5.0])), [0.0, 2.0, 5.0], atol=1e-12)
    np.testing.assert_allclose(rotate(roll, np.array([7.0, 1.0, 0.0])), [7.0, np.cos(0.3), np.sin(0.3)], atol=1e-12)
    for angle in (1e-12, 0.3, 3.0):
        turn = from_rotation_vector(angle * AXIS)
        for same in (turn, -turn):
            np.testing.assert_allclose(rotation_vector(same), angle * AXIS, rtol=1e-9)
    np.testing.assert_allclose(rotation_vector(from_rotation_vector(4.0 * AXIS)), (4.0 - 2 * np.pi) * AXIS, rtol=1e-9)
    np.testing.assert_allclose(heading(multiply(yaw, roll)), yaw, atol=1e-12)
    np.testing.assert_allclose(heading(roll), [1.0, 0.0, 0.0, 0.0], atol=1e-12)


def test_signs_of_quaternions_do_not_jump(tmp_path: Path) -> None:
    clip = steady()
    flipped = clip._replace(root_quat=clip.root_quat * np.where(np.arange(31) % 2, -1.0, 1.0)[:, None])
    save_clip(tmp_path / "clip.npz", flipped)
    np.testing.assert_allclose(read_clip(tmp_path / "clip.npz").root_quat, clip.root_quat, atol=1e-6)


def test_unitrees_csv(g1: RobotModel, tmp_path: Path) -> None:
    clip = read_clip(CLIPS[0]).at(30.0)
    table = np.concatenate([clip.root_pos, clip.root_quat[:, [1, 2, 3, 0]], clip.joint_pos], axis=1)
    for name, header in (("plain.csv", ""), ("named.csv", ",".join(f"column{i}" for i in range(36)))):
        np.savetxt(tmp_path / name, table, delimiter=",", header=header, comments="")
        read = read_motion(tmp_path / name, g1)
        assert read.fps == 30.0 and read.joint_names == g1.joint_names
        (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + (tmp_path / name).read_bytes())  # as Excel saves UTF-8
        assert len(read_motion(tmp_path / name, g1).root_pos) == len(table)
        np.testing.assert_allclose(read.qpos(), clip.qpos(), atol=1e-7)
    for name, text in (("text.csv", "abc\n"), ("comment.csv", "# abc\n"), ("empty.csv", "")):
        (tmp_path / name).write_text(text)
        with (
            warnings.catch_warnings(action="error"),
            pytest.raises(ClipError, match=f"{name} cannot be read as a CSV of numbers: it"),
        ):
            read_motion(tmp_path / name, g1)


@pytest.mark.parametrize("order", ["as in the robot's file", "breadth first"])
def test_bodies_tell_the_order_of_joints(order: str, g1: RobotModel, tmp_path: Path) -> None:
    """BeyondMimic's files come from Isaac Lab, mjlab's from MuJoCo; neither has names."""
    whole = read_clip(CLIPS[0]).of(g1.joint_names, "clip")
    clip = Clip(whole.fps, whole.joint_names, *(values[::25] for values in whole[2:]))
    names = breadth_first(g1) if order == "breadth first" else list(g1.joint_names)
    assert breadth_first(g1)[:4] == [
        "left_hip_pitch_joint",
        "right_hip_pitch_joint",
        "waist_yaw_joint",
        "left_hip_roll_joint",
    ]
    states = [posed(g1.physics, row[7:], row[:7]) for row in clip.qpos()]
    held: dict[str, Any] = {"fps": [50], "joint_pos": clip.of(names, "clip").joint_pos}
    held |= {
        "body_pos_w": np.array([data.xpos[1:] for data in states]),
        "body_quat_w": np.array([data.xquat[1:] for data in states]),
    }
    np.savez(tmp_path / "theirs.npz", **held)
    np.testing.assert_allclose(read_motion(tmp_path / "theirs.npz", g1).qpos(), clip.qpos(), atol=1e-6)
    unknown = np.where(np.arange(held["body_pos_w"].shape[1]) > 0, np.nan, 0.0)[:, None]  # of all but the root
    for key, value, why in (
        ("fps", [], "fps must be one number"),
        ("fps", ["fast"], "fps must be one number"),
        ("body_pos_w", np.zeros(3), "body_pos_w must be numbers with 3 axes"),
        ("body_quat_w", held["body_quat_w"][0], "body_quat_w must be numbers with 3 axes"),
        ("body_quat_w", held["body_quat_w"][:, :0], "body_quat_w must be numbers with 3 axes"),
        ("body_pos_w", held["body_pos_w"] + unknown, "bodies are nan m .* another robot"),
    ):
        np.savez(tmp_path / "theirs.npz", **{**held, key: value})
        with pytest.raises(ClipError, match=why):
            read_motion(tmp_path / "theirs.npz", g1)


@pytest.mark.parametrize("file", CLIPS, ids=lambda file: file.stem)
def test_a_shipped_clip_is_what_the_robot_can_do(file: Path, g1: RobotModel) -> None:
    """Within the joints' ranges, no foot in the ground, none that slides."""
    text = page(g1, read_clip(file).of(g1.joint_names, file.name), feet_of(g1))
    assert "warning" not in text, text
    assert "lowest point: 0 mm" in text


def test_what_a_robot_cannot_do_is_said(
    g1: RobotModel, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: Any
) -> None:
    clip = read_clip(CLIPS[0])
    joints = clip.joint_pos.copy()
    joints[10, clip.joint_names.index("left_knee_joint")] = 3.0
    moved = clip.root_pos + np.outer(np.arange(len(joints)), [0.01, 0.0, 0.0]) - [0.0, 0.0, 0.05]
    save_clip(tmp_path / "bad.npz", clip._replace(joint_pos=joints, root_pos=moved))
    out = tmp_path / "mended.npz"
    monkeypatch.setattr(
        sys,
        "argv",
        ["motion", str(tmp_path / "bad.npz"), "--lift", "0.05", "--cut", "1", "2", "--rate", "25", "--out", str(out)],
    )
    robot = page(g1, read_clip(tmp_path / "bad.npz"), feet_of(g1))
    assert "warning: left_knee_joint is 0.120 rad beyond its range (-0.09 to 2.88) after 0.20 s" in robot
    assert "mm in the ground; --lift 0.0" in robot and "a foot slides on the ground at 0.5" in page(
        g1, clip._replace(root_pos=moved + [0, 0, 0.05]), feet_of(g1)
    )
    main()
    mended = read_clip(out)
    assert (mended.fps, len(mended.root_pos)) == (25.0, 26) and "warning: left_knee" not in capsys.readouterr().out
    np.testing.assert_allclose(mended.root_pos[0], moved[50] + [0.0, 0.0, 0.05], atol=1e-6)


def test_a_foot_that_turns_about_its_toe_does_not_slide(g1: RobotModel) -> None:
    """The robot turns about its toes' edge at 2 rad/s; then it slides at 1 m/s. ClipStage gives velocities of the IMU, body frame."""
    still = read_clip(CLIPS[0]).of(g1.joint_names, "clip")
    feet, fps, rows = feet_of(g1), 50.0, np.zeros(6, int)
    data = posed(g1.physics, still.joint_pos[0], still.qpos()[0, :7])
    ends = np.concatenate(
        [
            data.geom_xpos[g] + spheres @ data.geom_xmat[g].reshape(3, 3).T - [0.0, 0.0, radius]
            for g in (g1.id("geom", name) for name in feet)
            for spheres, radius in [spheres_on(g1.physics, g, SPACING)]
        ]
    )
    toe = ends[ends[:, 0].argmax()]
    turns = from_rotation_vector(np.outer(np.arange(6) * 2.0 / fps, [0.0, 1.0, 0.0]))
    start, joints = still.qpos()[0, :7], still.joint_pos[rows]
    heights = -toe * [0.0, 0.0, 1.0]
    places = toe + rotate(turns, (start[:3] - toe)[None]) + heights
    tipping = checked(Path("clip"), fps, g1.joint_names, places, multiply(turns, start[None, 3:]), joints)
    *_, speed = look._feet(g1, tipping, feet)
    assert speed.max() < 0.05
    aside = start[:3] + heights + np.outer(np.arange(6) / fps, [0.0, 1.0, 0.0])
    sliding = checked(Path("clip"), fps, g1.joint_names, aside, np.tile(start[3:], (6, 1)), joints)
    *_, speed = look._feet(g1, sliding, feet)
    assert speed[1:].min() == pytest.approx(1.0, abs=0.01)
    turned = from_rotation_vector(np.array([0.0, 0.0, np.pi / 2]))
    facing = checked(Path("clip"), fps, g1.joint_names, aside, np.tile(turned, (6, 1)), joints)
    np.testing.assert_allclose(look.ClipStage(g1, facing).velocity(), [[1.0, 0.0, 0.0]], atol=1e-6)
    turns = from_rotation_vector(np.outer(np.arange(6) / fps, [0.0, 0.0, 1.0]))
    on_the_spot = checked(Path("clip"), fps, g1.joint_names, np.tile(start[:3], (6, 1)), turns, joints)
    ahead, left, _ = g1.physics.site(g1.imu).pos
    np.testing.assert_allclose(look.ClipStage(g1, on_the_spot).velocity(), [[-left, ahead, 1.0]], atol=1e-5)


def test_the_shipped_clips_are_made_by_the_example(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples"))
    import make_motions

    plan = make_motions.squat(body := make_motions.Body())
    plan.push = plan.push[:60]
    made, ships = body.pose(plan).qpos(), read_clip(ROOT / "resources/motions/g1_squat.npz").qpos()
    np.testing.assert_allclose(made, ships[:60], atol=1e-5)


def test_kinematics_are_mujocos(g1: RobotModel, double: None) -> None:
    model, rng = g1.physics, np.random.default_rng(0)
    names = ["pelvis", "right_wrist_yaw_link", "left_ankle_roll_link", "torso_link"]
    bodies, data = [g1.id("body", name) for name in names], mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = rng.normal(size=model.nq), rng.normal(size=model.nv)
    data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
    for compute in (mujoco.mj_kinematics, mujoco.mj_comPos, mujoco.mj_comVel):
        compute(model, data)
    found = Kinematics(model, bodies, "cpu")(torch.tensor(data.qpos)[None], torch.tensor(data.qvel)[None])
    for i, body in enumerate(bodies):
        speed = np.zeros(6)
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, body, speed, 0)
        right = (data.xpos[body], data.xmat[body].reshape(3, 3), speed[3:], speed[:3])
        for ours, theirs in zip(found, right, strict=True):
            np.testing.assert_allclose(ours[0, i].numpy(), theirs, atol=1e-12)
