"""Following a motion: begin on the reference, compare at the anchor, end, draw starts by failures; its exam, its export."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_export import untrained

from legged_mw import ROOT
from legged_mw.check.guard import check_recordable
from legged_mw.deploy.exam import run_skill
from legged_mw.deploy.robot import Measurement
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval.perform import machine, prepare
from legged_mw.eval.skills import PUSH_EVERY, ExamGround, Recording, TrackingExam
from legged_mw.export.exporter import export
from legged_mw.skills.clip import Clip, read_clip, save_clip
from legged_mw.skills.motion_tracking import MotionTracking, angle_between, quat_multiply, rotation_quat
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg
from legged_mw.utils.task import load_task

EXACT = {
    **{f"motion.start_{name}": [0.0] * 3 for name in ("pos", "turn", "lin_vel", "ang_vel")},
    **{"motion.start_joints": 0.0, "noise.level": 0.0, "domain_rand.enable": False, "perturbation.push": False},
}


def make(device: str = "cpu", worlds: int = 4, **settings: Any) -> MotionTracking:
    task = load_task("g1_track")
    for path, value in {**EXACT, "env.num_envs": worlds, **settings}.items():
        task.set(path, value)
    return task.env_class(task.cfg, device, eager=device == "cpu")


def follow(env: MotionTracking) -> torch.Tensor:
    """Actions whose targets are the reference's angles."""
    return (env.reference.joint_pos - env.default_dof_pos) / env.actuators.scale


def test_worlds_begin_on_the_reference(device: str) -> None:
    """A step from there, with targets at the reference, each tracking term is nearly 1; the same on both engines."""
    env = make(device)
    frame = env.reference.frame.clone()
    assert (frame >= 1).all()
    before = env.reference._table.index_select(0, frame - 1)
    torch.testing.assert_close(env.sim.qpos, before[:, :36])
    torch.testing.assert_close(env.body.pos.flatten(1), before[:, 36 + 35 : 36 + 35 + 42], atol=1e-5, rtol=0)
    env.step(follow(env))
    assert (env.reference.frame == frame + 1).all() and not env.reset_buf.any()
    tracking = [i for i, name in enumerate(env.reward_names) if name.startswith("tracking")]
    share = (env.episode_sums / env.reward_scales)[:, tracking]
    assert len(tracking) == 6 and (share > 0.9).all() and (share < 1.0).all()


def test_a_field_that_a_clip_does_not_read_may_have_its_default() -> None:
    make(**{"init_state.yaw_range": MotionTrackingCfg.init_state.yaw_range})


def test_the_exams_changes_are_ones_that_the_task_takes() -> None:
    """It keeps its init_state; a clip whose last frame is not held is judged to its last frame too."""
    task = load_task("g1_track")
    task.set("motion.hold_s", 0.0)
    prepare(task)
    task.cfg.check()
    assert task.cfg.motion.hold_s == 1.0 and not task.cfg.motion.random_start


def test_starts_may_be_drawn_from_every_frame() -> None:
    env = make(worlds=2, **{"motion.bin_s": 0.005})
    assert len(env.reference.failures) == sum(len(clip.root_pos) - 1 for clip in env.clips)


def test_errors_are_taken_at_the_anchor() -> None:
    """A robot elsewhere, with another heading, in the reference's pose: only what is said of the world is off."""
    env = make(worlds=2, **{"motion.random_start": False})
    env.reference.read()
    env.sim.qpos.copy_(env.reference.qpos)
    turn = torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
    env.sim.qpos[:, 3:7] = quat_multiply(rotation_quat(turn), env.sim.qpos[:, 3:7])
    env.sim.qpos[0, 0] += 1.0
    env.sim.qpos[1, 2] += 0.1
    env._refresh_base()
    env.reference.align(env.body, env.anchor)
    torch.testing.assert_close(env.body.pos[0], env.reference.wanted_pos[0], atol=1e-5, rtol=0)
    assert env._reward_tracking_body_pos()[0] > 0.9999 and env._reward_tracking_body_ori()[0] > 0.9999
    assert env._reward_tracking_anchor_ori()[0].item() == pytest.approx(np.exp(-((0.5 / 0.4) ** 2)), rel=1e-4)
    heights = (env.body.pos - env.reference.wanted_pos)[1]
    torch.testing.assert_close(heights, torch.tensor([0.0, 0.0, 0.1]).expand_as(heights), atol=1e-5, rtol=0)
    assert env._reward_tracking_body_pos()[1].item() == pytest.approx(np.exp(-((0.1 / 0.3) ** 2)), rel=1e-4)
    env.compute_observations()
    span = env.observations.span("privileged_state", "anchor_pos")
    torch.testing.assert_close(env.obs_buf["privileged_state"][1, span].norm(), torch.tensor(0.1), atol=1e-5, rtol=0)
    a, b = (torch.eye(3), torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]))
    assert angle_between(a, b).item() == pytest.approx(np.pi / 2, rel=1e-6)


@pytest.mark.parametrize(
    ("lift", "lean", "bend", "fell"),
    [
        (0.0, 0.0, 0.0, False),
        (0.24, 0.0, 0.0, False),
        (0.26, 0.0, 0.0, True),
        (0.0, 1.5, 0.0, True),
        (0.0, 0.0, 1.2, True),
    ],
)
def test_who_is_far_from_the_reference_fell(lift: float, lean: float, bend: float, fell: bool) -> None:
    """In height, in tilt, and with a foot."""
    env = make(worlds=1, **{"motion.random_start": False, "termination.max_tilt": 180.0})
    env.reference.read()
    env.sim.qpos.copy_(env.reference.qpos)
    env.sim.qpos[:, 2] += lift
    env.sim.qpos[:, 3:7] = quat_multiply(rotation_quat(torch.tensor([[lean, 0.0, 0.0]])), env.sim.qpos[:, 3:7])
    env.sim.qpos[:, 7 + env.robot.joint_names.index("left_hip_pitch_joint")] -= bend
    env._refresh_base()
    env.reference.align(env.body, env.anchor)
    assert env._fallen().item() is fell


def test_after_the_last_frame_it_is_held_and_then_the_episode_times_out() -> None:
    env = make(worlds=2, **{"motion.hold_s": 0.1})  # five frames
    frames = len(env.clips[0].root_pos)
    env.reference.frame.copy_(torch.tensor([frames - 1, frames + 3]))
    env.reference.read()
    held = env.reference.qpos.clone()
    torch.testing.assert_close(held[0], held[1])
    assert (env.reference.qvel[1] == 0.0).all()
    assert env._timed_out().tolist() == [False, False]
    env.reference.advance()
    assert env._timed_out().tolist() == [False, True]
    env.reference.advance()
    assert env.reference.frame.tolist() == [frames + 1, frames + 4]


def test_the_error_in_the_log_is_of_worlds_that_go_on() -> None:
    """A world just reset is on a new frame of the clip; what it was compared with is of the episode before."""
    env = make(worlds=8)
    env.episode_length_buf = torch.tensor([env.max_episode_length] * 4 + [0] * 4)
    env.step(follow(env))
    assert env.reset_buf.tolist() == [True] * 4 + [False] * 4
    off = 1000.0 * (env.body.pos - env.reference.wanted_pos).norm(dim=2).mean(dim=1)
    assert off[:4].max() > 2.0 * off[4:].max()
    assert env.read_statistics()["body_error_mm"] == pytest.approx(off[4:].mean().item(), rel=1e-4)


def test_starts_are_drawn_by_failures() -> None:
    env = make(worlds=512, **{"motion.clips": ["resources/motions/g1_squat.npz", "resources/motions/g1_turn.npz"]})
    reference = env.reference
    assert len(reference.failures) == 6 + 8 and reference._bins[:, 1].sum() == 300 + 400
    torch.manual_seed(0)
    everywhere = torch.bincount(reference._bin_of[reference.draw(0.1)], minlength=14)
    assert (everywhere > 15).all()
    reference.frame.fill_(301 + 50 + 125)  # of the second clip; after the first one's held frames
    reference.remember_failures(torch.arange(512) < 32, rate=0.5)
    assert reference.failures.nonzero().tolist() == [[8]] and reference.failures[8].item() == pytest.approx(
        0.5 * 32 / 512
    )
    among = torch.bincount(reference._bin_of[reference.draw(0.1)], minlength=14)
    assert 430 < among[8] < 500 and among.gt(0).sum() > 7  # nine tenths, and a fourteenth of the rest
    drawn = reference.draw(1e-9)
    assert (reference._bin_of[drawn] == 8).all() and drawn.min() == 451 and drawn.max() == 500
    env.cfg.motion.uniform = 1e-9
    env.load_training_state({"motion_failures": reference.failures.clone()})  # a resumed run draws by them
    assert (reference.frame - 1).ge(451).all() and (reference.frame - 1).le(500).all()
    torch.testing.assert_close(env.training_state()["motion_failures"], reference.failures)


def test_a_mirrored_robot_follows_the_mirrored_motion() -> None:
    """What the rows say is what a robot sees whose joints and attitude are the mirror images, and so is its reference's."""
    env = make(worlds=2, **{"motion.start_turn": [0.3] * 3, "motion.start_joints": 0.1, "motion.random_start": False})
    partners = env._partners()

    def image(qpos: torch.Tensor) -> torch.Tensor:
        place, attitude = (
            qpos[:, :3] * torch.tensor([1.0, -1.0, 1.0]),
            qpos[:, 3:7] * torch.tensor([1.0, -1.0, 1.0, -1.0]),
        )
        return torch.cat(
            [place, attitude, qpos[:, 7:36][:, list(partners.joints)] * torch.tensor(partners.signs)], dim=1
        )

    first = env.reference._table[:1, :36]
    env.sim.qpos[1:] = image(env.sim.qpos[:1])
    bodies = env.kinematics(torch.cat([first, image(first)]), torch.zeros(2, 35))
    for kept, found in zip(env.reference.bodies, bodies, strict=True):
        kept.copy_(found)
    env.reference.read = lambda: None  # type: ignore[method-assign]
    env._refresh_base()
    env.compute_observations()
    for name in ("anchor_pos", "anchor_ori", "body_pos", "body_ori"):
        span = env.observations.span("privileged_state", name)
        seen = env.mirror.observations["privileged_state"](env.obs_buf["privileged_state"])[0, span]
        torch.testing.assert_close(seen, env.obs_buf["privileged_state"][1, span], atol=2e-3, rtol=0, msg=name)


@pytest.mark.parametrize(
    ("left_out", "rows"), [({"state": ["anchor_pos", "base_lin_vel"]}, 154), ({}, 160)], ids=["154 rows", "160 rows"]
)
def test_the_step_can_be_recorded(left_out: dict[str, list[str]], rows: int) -> None:
    assert make(worlds=1, **{"observations.leave_out": left_out}).obs_buf["state"].shape == (1, rows)
    task = load_task("g1_track")
    task.set("observations.leave_out", left_out)
    check_recordable(task)


# ---- the exam


def test_the_exam_judges_places_at_the_anchor() -> None:
    env = make(worlds=1)
    robot, exam = machine(env), TrackingExam()
    assert robot.motion
    frames = exam.steps(robot)
    assert frames == 351
    qpos = np.tile(robot.motion.qpos[:, None], (1, 4, 1))
    qpos[:, 1, 0] += 0.3  # elsewhere
    qpos[:, 2, 7 + 18] += 0.29  # an elbow: a 29th of it is the mean of all joints
    qpos[200:, 3, 2] -= 0.3  # down
    nothing = np.zeros((frames, 4, 1))
    found = exam.judge(robot, Recording(qpos, nothing, nothing, ended_at=np.full(4, np.inf)))
    assert found["worst"] == 3 and found["finished"] == 0.75 and found["drift"] == pytest.approx(0.1)
    steps = 3 * frames + 200
    assert found["joint_error"] == pytest.approx(0.01 * frames / steps)
    assert 0.0 < found["body_error"] < 10.0
    ended = exam.judge(robot, Recording(qpos[:, :2], nothing, nothing, ended_at=np.array([100.0, np.inf])))
    assert ended["worst"] == 0 and ended["finished"] == 0.5 and ended["body_error"] == pytest.approx(0.0, abs=1e-6)
    starts, speeds = exam.starts(robot, 32)
    assert (
        (np.ptp(starts[:, 7:], axis=0) > 0.05).all()
        and np.abs(starts - robot.motion.qpos[0])[:, 7:].max() <= 0.05
        and speeds.any()
    )


def test_each_robot_is_pushed_once_every_two_seconds() -> None:
    ground, steps = ExamGround(push=0.5), round(PUSH_EVERY / 0.02)
    jumps = [ground.pushes(step, 32, 0.02) for step in range(1, steps + 1)]
    total = sum(np.linalg.norm(jump, axis=1) for jump in jumps if jump is not None)
    np.testing.assert_allclose(total, 0.5)
    assert ground.pushes(0, 32, 0.02) is None and ExamGround().pushes(steps, 32, 0.02) is None


# ---- the export


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With a place and a velocity among its rows; the export compares each of them with the environment's."""
    folder = tmp_path_factory.mktemp("g1_track")
    clip = read_clip(ROOT / "resources/motions/g1_kick.npz")
    save_clip(folder / "short.npz", Clip(clip.fps, clip.joint_names, *(values[:21] for values in clip[2:])))
    settings = {"observations.leave_out": {}, "motion.clips": [str(folder / "short.npz")]}
    export(*untrained(ROOT / "configs/g1_track.py", folder, settings), folder / "out")
    return folder / "out"


def test_an_export_follows_and_is_graded(exported: Path) -> None:
    stage = DeployStage(exported, 1)
    follower = stage.controller.follower
    assert follower and stage.contract.motion and stage.contract.to_dict()["format"] == 5
    np.testing.assert_allclose(stage.qpos()[0], follower.clip.qpos()[0], atol=1e-5)  # it starts where the clip does
    for step in range(3):
        assert follower.frame.tolist() == [1 + step]
        stage.step()
    stage.reset(0)
    assert follower.frame.tolist() == [1]
    follower.frame[:] = 21
    stage.step()
    assert follower.frame.tolist() == [21]  # the last one is held
    result = run_skill(exported)
    assert result["asked"] == {"kind": "tracking"} and {*result["parts"]} == {"not pushed", "pushed"}


def test_a_robot_follows_from_where_it_stands(exported: Path) -> None:
    """With another place and heading a deployed policy sees the same."""
    stage = DeployStage(exported, 2)
    follower = stage.controller.follower
    assert follower
    stage.fleet.qpos[1, :2] += [3.0, -2.0]
    stage.fleet.qpos[1, 3:7] = [np.cos(0.5), 0.0, 0.0, np.sin(0.5)]
    stage.fleet.refresh()
    measured, fresh = stage.fleet.read(), np.ones(2, dtype=bool)
    for name, value in follower.rows(measured, fresh).items():
        np.testing.assert_allclose(value[0], value[1], atol=1e-9, err_msg=name)
    follower.keep(measured, fresh)
    stage.fleet.qpos[1, 0] += 0.1  # from now on the motion stays where it is
    moved: Measurement = stage.fleet.read()
    away = follower.rows(moved, ~fresh)["anchor_pos"]
    assert np.linalg.norm(away[1] - away[0]) == pytest.approx(0.1)
