"""The health page: its numbers against a robot of one joint that can be worked out by hand, its texts, and the task that it writes."""

from __future__ import annotations

import itertools
import math
import re
import sys
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch

from legged_mw import ROOT
from legged_mw.envs.statistics import BrokenWorlds, DivergenceStop
from legged_mw.robot import __main__ as program
from legged_mw.robot import picture
from legged_mw.robot.draft import Draft, as_env, draft, has_mirror, table
from legged_mw.robot.measure import (
    Gains,
    Joint,
    RobotNumbers,
    beyond_euler,
    family,
    inside_by,
    mass_matrices,
    measure,
    suggest,
    tilt,
)
from legged_mw.robot.new import config_text, write
from legged_mw.robot.page import page
from legged_mw.robot.picture import HEIGHT, WIDTH, Label, _columns
from legged_mw.sim.model import Ground, RobotModel, Solver, build_model
from legged_mw.utils.cli import one_line_errors
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import load_task
from tests.program import SMALL, refused, run

GO1, TOY = ROOT / "resources" / "robots" / "go1" / "go1.xml", ROOT / "examples" / "toy_biped.xml"
DATA = sorted((ROOT / "tests" / "data").glob("*_style.*"))
DT, KP, KD = 0.004, 5.0, 0.1
# A slab of 2 kg that stands on the ground, and on it a wheel of 1 kg about the slab's centre of mass; each turns about y.
WHEEL = """
<mujoco><compiler angle="radian"/><worldbody><body name="slab" pos="0 0 0.1"><freejoint/>
  <inertial pos="0 0 0" mass="2" diaginertia="0.2 0.2 0.2"/><site name="imu"/>
  <geom name="slab" type="box" size="{half} 0.2 0.1"/>
  <body name="wheel"><joint name="wheel" axis="0 1 0" armature="0.01" range="-2 2" limited="true" {more}/>
    <inertial pos="{offset} 0 0" mass="1" diaginertia="0.05 0.05 0.05"/></body>
</body></worldbody></mujoco>"""


def wheel(
    folder: Path, *, half: float = 0.2, offset: float = 0.0, more: str = 'actuatorfrcrange="-3 3"', **choices: Any
) -> RobotModel:
    file = folder / "wheel.xml"
    file.write_text(WHEEL.format(half=half, offset=offset, more=more))
    plain = {
        **{
            "solver": Solver(DT, 10, 20),
            "ground": Ground(),
            "stiffness": {"": KP},
            "damping": {"": KD},
            "colliders": ["*"],
        },
        **{"self_collisions": False, "contact_geoms": ["slab"], "imu_site": "imu"},
    }
    return build_model(file, **{**plain, **choices})


def health(robot: RobotModel, height: float = 0.1) -> RobotNumbers:
    return measure(robot, [0.0] * len(robot.joint_names), [0.0, 0.0, height])


def test_a_robot_of_one_joint(tmp_path: Path) -> None:
    """Two bodies that turn about one axis: to its motor the pair is I1 I2 / (I1 + I2) = 0.04, and the armature is 0.01."""
    found = health(wheel(tmp_path))
    [joint] = found.joints
    assert (joint.name, joint.low, joint.high, joint.effort, joint.kp, joint.kd) == ("wheel", -2.0, 2.0, 3.0, KP, KD)
    assert joint.inertia == pytest.approx(0.04 + 0.01) and joint.held == pytest.approx(0.06)
    assert joint.damping_step(DT) == pytest.approx(0.004 * 0.1 / 0.05)
    assert joint.stiffness_step(DT) == pytest.approx(0.004 * 10.0)
    assert joint.damping_ratio() == pytest.approx(0.1 / (2 * 0.5))
    assert found.mass == pytest.approx(3.0)
    assert found.height == pytest.approx(0.1, abs=2e-3) and found.top == pytest.approx(0.2, abs=2e-3)
    assert found.margin == pytest.approx(0.2, abs=1e-3)
    assert (found.rest.contacts, found.rest.rows, found.rest.toppled) == (4, 16, False)
    assert found.room[:2] == (8, 1 + 16)  # contacts: at least 8; rows: a limit and four contacts
    assert found.stand.end == "stands" and found.mode.growth == pytest.approx(1.0, abs=1e-6)
    assert joint.torque == pytest.approx(0.0, abs=1e-6)


def test_a_joint_without_limits_is_looked_at_within_one_radian(tmp_path: Path) -> None:
    robot, pose = wheel(tmp_path, offset=0.1), np.array([0.3])
    limited = mass_matrices(robot, pose)
    robot.physics.jnt_limited[:] = 0
    for matrices, low, middle, high in ((limited, -2.0, 0.0, 2.0), (mass_matrices(robot, pose), -0.7, 0.3, 1.3)):
        for name, angle in {"default": 0.3, "low": low, "middle": middle, "high": high}.items():
            np.testing.assert_allclose(matrices[name], mass_matrices(robot, np.array([angle]))["default"])


def test_sag_is_the_torque_at_rest_over_kp(tmp_path: Path) -> None:
    found = health(wheel(tmp_path, offset=0.1))
    # the weight turns it forwards, about +y
    assert found.joints[0].torque == pytest.approx(-1.0 * 9.81 * 0.1, rel=1e-3)
    assert found.joints[0].sag() == pytest.approx(0.981 / KP, rel=1e-3)
    assert found.margin == pytest.approx(0.2 - 0.1 / 3.0, abs=1e-3)  # 1 kg of 3 is 0.1 m ahead


def test_a_centre_of_mass_beside_the_ground_that_it_stands_on(tmp_path: Path) -> None:
    found = health(wheel(tmp_path, half=0.02, offset=0.15))
    assert found.rest.toppled and found.margin == pytest.approx(0.02 - 0.05, abs=1e-3)
    assert found.stand.end == "falls" and 0.1 < found.stand.seconds < 3.0
    text = page(found, "it")
    assert "30 mm OUTSIDE of what its contacts span" in text and "tilts beyond 60 degrees after" in text
    assert "the centre of mass is not over the feet: choose another init_state.default_joint_angles" in text


@pytest.mark.parametrize(("kp", "kd"), [(5.0, 0.1), (5.0, 20.0), (5.0, 30.0), (5e4, 0.0), (3e3, 26.0)])
@pytest.mark.parametrize("integrator", ["euler", "implicitfast"])
def test_growth_and_verdict_are_those_of_the_step_itself(tmp_path: Path, kp: float, kd: float, integrator: str) -> None:
    """One servo's characteristic polynomial by hand; what MuJoCo makes of a velocity of 1 rad/s in 8 substeps agrees."""
    robot = wheel(tmp_path, solver=Solver(DT, 10, 20, integrator), stiffness={"": kp}, damping={"": kd}, more="")
    found = health(robot)
    inertia, d, s = 0.05, DT * kd / 0.05, DT * DT * kp / 0.05
    implicit = integrator == "implicitfast"
    roots = np.roots([1 + d, -(2 + d - s), 1]) if implicit else np.roots([1, -(2 - s - d), 1 - d])
    growth = np.abs(roots).max()
    assert found.joints[0].inertia == pytest.approx(inertia)
    assert found.mode.growth == pytest.approx(max(growth, 1.0), rel=1e-5)
    assert (found.joints[0].verdict(DT, implicit) == "unstable") == (growth > 1.0)
    assert found.mode.joints == ("wheel",) or growth <= 1.0
    model = robot.physics
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.jnt_limited[:], model.actuator_ctrllimited[:] = 0, 0
    data = mujoco.MjData(model)
    data.qpos[2], data.qvel[6] = 10.0, 1.0
    data.qvel[4] = -0.2  # of the slab, so that the pair turns as a mode of its own
    mujoco.mj_step(model, data, 8)
    assert (abs(data.qvel[6]) > 3.0) == (growth > 1.1)


@pytest.mark.parametrize("implicit", [False, True])
def test_verdicts_hold_where_the_polynomial_does(implicit: bool) -> None:
    for d, s in itertools.product(np.linspace(0.05, 3.0, 40), np.linspace(0.05, 8.0, 40)):
        joint = Joint("j", -1, 1, 1, math.inf, 0.1, s * 0.5 / DT**2, d * 0.5 / DT, 0.5, "default", 0.5, 0.0)
        roots = np.roots([1 + d, -(2 + d - s), 1]) if implicit else np.roots([1, -(2 - s - d), 1 - d])
        assert (joint.verdict(DT, implicit) == "unstable") == (np.abs(roots).max() >= 1.0), (d, s)
        if not implicit and joint.verdict(DT, False) != "unstable":
            assert (joint.verdict(DT, False) == "rings") == (d > 1.0)


def test_a_damping_that_the_step_does_not_bear(tmp_path: Path) -> None:
    found = health(wheel(tmp_path, damping={"": 40.0}, more=""))
    assert found.stand.end == "diverges" and found.stand.joints[0] == "wheel"
    text = page(found, "it")
    assert "servos in the air: UNSTABLE, a mode of wheel grows 2.20-fold a substep" in text  # d = 3.2: |1 - d|
    assert (
        "unstable servos: wheel: lower control.damping or control.stiffness, or give them armature (asset.armature)"
        in text
    )
    assert "no force limit: wheel: say asset.effort" in text
    assert "!!3.20" in text and "action zero          diverges after" in text
    calm = health(wheel(tmp_path, damping={"": 40.0}, solver=Solver(DT, 10, 20, "implicitfast")))
    assert calm.stand.end == "stands" and "implicitfast; servos in the air: stable" in page(calm, "it")


def health_of(found: Draft, file: Path) -> RobotNumbers:
    return measure(as_env(found, file).robot, found.pose, found.place)


def test_inside_by() -> None:
    square = np.array([[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0], [1.0, 1.0], [1.0, 0.0]])
    assert inside_by(square, np.array([1.0, 0.5])) == pytest.approx(0.5)
    assert inside_by(square, np.array([3.0, 3.0])) == pytest.approx(-math.sqrt(2.0))
    triangle = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 3.0]])
    assert inside_by(triangle, np.array([1.5, 1.0])) == pytest.approx(0.7)  # of 3 x + 4 y = 12
    assert inside_by(triangle, np.array([4.0, 3.0])) == pytest.approx(-2.4)
    assert inside_by(square[:2], np.array([1.0, 0.25])) == pytest.approx(-0.25)  # two points span a line
    assert inside_by(square[:1], np.array([0.0, 1.0])) == pytest.approx(-1.0)
    assert inside_by(square[:0], np.zeros(2)) == -math.inf
    assert tilt(np.array([math.cos(0.4), 0.0, math.sin(0.4), 0.0])) == pytest.approx(math.degrees(0.8))


# ---- suggested gains ----


def joint(name: str, **other: Any) -> Joint:
    plain = {"low": -1.0, "high": 1.0, "effort": 40.0, "speed": math.inf, "armature": 0.01, "kp": 1.0, "kd": 0.0}
    return Joint(**{"name": name, **plain, "inertia": 0.1, "pose": "default", "held": 0.2, "torque": 0.0, **other})


def test_suggested_gains() -> None:
    """Between full effort and 0.4 of the moment of 100 N m at 1 rad; 25 ms of it; what the load asks for at least."""
    assert suggest([joint("a")], 100.0) == [(40.0, 1.0)] and suggest([joint("a", effort=10.0)], 100.0)[0].kp == 20.0
    assert suggest([joint("a", torque=-9.0)], 100.0)[0].kp == 45.0  # twice the load within 0.4 rad
    assert suggest([joint("a", effort=math.inf)], 100.0)[0].kp == pytest.approx(0.2 * (4 * math.pi) ** 2, rel=0.02)
    both = suggest([joint("left_hip", torque=-9.0), joint("right_hip"), joint("right_knee")], 100.0)
    assert [gain.kp for gain in both] == [45.0, 45.0, 40.0]


def test_gains_that_explicit_euler_does_not_bear() -> None:
    """Published gains are never cut: light limbs ask for the other integrator. dt kd / I and dt sqrt(kp / I) to 0.5."""
    light, stiff, fine = joint("a", inertia=0.007), joint("a", inertia=0.02), joint("a")
    assert beyond_euler([light, stiff, fine], [Gains(1.0, 1.0), Gains(400.0, 0.1), Gains(40.0, 1.0)], DT) == [
        light._replace(kp=1.0, kd=1.0),
        stiff._replace(kp=400.0, kd=0.1),
    ]


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("FR_hip_joint", "hip"),
        ("left_hip_yaw_joint", "hip_yaw"),
        ("LF_HAA", "HAA"),
        ("Left_Knee_Pitch", "Knee_Pitch"),
        ("waist", "waist"),
        ("L", "L"),
    ],
)
def test_families_of_joints(name: str, same: str) -> None:
    assert family(name) == same


def test_short_tables() -> None:
    names = ["FL_hip", "FR_hip", "FL_knee", "FR_knee", "waist"]
    assert table([0.0] * 5, names) == {"": 0.0}
    assert table([0.1, -0.1, 0.9, 0.9, 0.9], names) == {"": 0.9, "FL_hip": 0.1, "FR_hip": -0.1}
    assert table([0.0, 0.0, 0.9, 0.9, 0.0], names) == {"": 0.0, "knee": 0.9}
    awkward = ["hip", "left_hip", "right_hip"]  # "hip" is a part of the others' names
    assert table([1.0, 0.0, 0.0], awkward) == {"hip": 1.0, "left_hip": 0.0, "right_hip": 0.0}


# ---- the programs ----


def show(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *args: object) -> str:
    """What ``python -m legged_mw.robot`` prints."""
    monkeypatch.setattr(sys, "argv", ["robot", *map(str, args)])
    with one_line_errors("legged_mw.robot"):
        program.main()
    return capsys.readouterr().out


def complaint(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], *args: object) -> str:
    with pytest.raises(SystemExit) as end:
        show(monkeypatch, capsys, *args)
    assert end.value.code == 2
    return capsys.readouterr().err


@pytest.mark.parametrize(("name", "said"), [("walker.mjz", "unzip it"), ("walker.stl", ".urdf")])
def test_a_file_that_is_neither_robot_nor_task(
    name: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / name).touch()
    line = complaint(monkeypatch, capsys, tmp_path / name)
    assert f"{name} is neither" in line and said in line and "no task" not in line


def png_size(path: Path) -> tuple[int, int]:
    head = path.read_bytes()[:24]
    assert head[:8] == b"\x89PNG\r\n\x1a\n"
    return int.from_bytes(head[16:20], "big"), int.from_bytes(head[20:24], "big")


def test_check_prints_the_page_and_draws_the_robot(tmp_path: Path) -> None:
    picture = tmp_path / "robot.png"
    result = run("train", tmp_path, "--task", "go1_rough", "--check", "--device", "cpu", "--picture", str(picture))
    assert result.code == 0, result.err
    assert result.out.index("observation state") < result.out.index("health of go1_rough")
    for text in (
        "mass                 12.74 kg",
        # of its rough ground
        "at rest              4 contacts, 28 constraint rows; room for more (sim.nconmax, sim.njmax): 8, 56",
        "stands on its servos for 5 s",
        "substep              4 ms, euler; servos in the air: stable",
        "nothing: all numbers are within bounds",
    ):
        assert text in result.out, result.out
    row = next(
        line
        for line in result.out.splitlines()
        if line.startswith("  FL_calf_joint") and "35.55" in line and "20.06" in line
    )
    assert row.split()[-2:] == ["25", "0.62"]
    assert png_size(picture) == (2 * WIDTH, HEIGHT)


def test_a_picture_that_cannot_be_drawn_leaves_the_page(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on a machine without OpenGL."""

    def fails(*_: object) -> None:
        raise UserError("No OpenGL context")

    monkeypatch.setattr(picture, "draw", fails)
    monkeypatch.setattr(sys, "argv", ["robot", str(TOY), "--picture", "robot.png"])
    with pytest.raises(UserError, match="No OpenGL context"):
        program.main()
    assert (
        "health of toy_biped.xml" in (out := capsys.readouterr().out)
        and "what to look at" in out
        and "picture: " not in out
    )


def test_picture_wants_check_and_a_png(tmp_path: Path) -> None:
    assert "--picture draws what --check shows: add --check" in refused(tmp_path, "train", *SMALL, "--picture", "a.png")
    text = refused(tmp_path, "train", *SMALL, "--check", "--picture", "robot.jpg")
    assert "this writes a .png; end the name in .png" in text
    lost = refused(tmp_path, "train", *SMALL, "--check", "--picture", "/proc/none/robot.png")
    assert "--picture /proc/none/robot.png: cannot be written: " in lost


def test_all_joints_without_a_key_at_once(tmp_path: Path) -> None:
    """From every table of the config in one line, not a table at a time."""
    task = tmp_path / "bare.py"
    task.write_text(
        "from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO\n"
        "from legged_mw.envs.legged_robot import LeggedRobot\nfrom legged_mw.utils.task import Task\n"
        "class Cfg(Go1FlatCfg):\n"
        "    class control(Go1FlatCfg.control):\n        stiffness, damping = {'calf': 1.0}, {'hip': 1.0, 'calf': 1.0}\n"
        "    class rewards(Go1FlatCfg.rewards):\n        pose_weights = {'thigh': 1.0}\n"
        "TASK = Task(LeggedRobot, Cfg, Go1FlatCfgPPO)\n"
    )
    text = refused(tmp_path, "train", "--task", str(task), "--check", "--device", "cpu")
    hips, thighs, calves = (
        [f"{leg}_{part}_joint" for leg in ("FR", "FL", "RR", "RL")] for part in ("hip", "thigh", "calf")
    )
    both, either = (
        ", ".join(joint for pair in zip(hips, other, strict=True) for joint in pair) for other in (thighs, calves)
    )
    assert f"control.stiffness: no value for {both}: none of ['calf']" in text
    assert f"control.damping: no value for {', '.join(thighs)}: none of ['hip', 'calf']" in text
    assert f"rewards.pose_weights: no value for {either}: none of ['thigh']" in text


@pytest.mark.parametrize("file", [GO1, TOY, *DATA], ids=lambda file: file.stem)
def test_a_new_task_checks_and_trains(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = show(monkeypatch, capsys, file, "--new", "mine", "--out", tmp_path / "made")
    assert "guessed: feet: " in out and "python train.py --task " in out
    robot, config = tmp_path / "made" / "mine.xml", tmp_path / "made" / "mine_flat.py"
    text = config.read_text()
    assert len(text.splitlines()) <= 95 and text.count("LOOK") >= 4
    assert str(ROOT) not in robot.read_text() + text and str(tmp_path) not in robot.read_text() + text
    moved = tmp_path / "moved"
    (tmp_path / "made").rename(moved)
    task = ["--task", str(moved / "mine_flat.py"), "--device", "cpu"]
    checked = run("train", tmp_path, *task, "--check")
    assert checked.code == 0, checked.err
    assert "the step can be recorded as a CUDA graph" in checked.out
    if file.stem in ("a1_style", "t1_style", "toy_biped"):  # drafts of a kind train alike
        result = run("train", tmp_path, *task, *SMALL[2:], "--max_iterations", "2", "--set", "runner.exam_interval=0")
        assert result.code == 0 and "Learning iteration 2/2" in result.out, result.err
        assert [*(tmp_path / "logs").glob("*/*/model_2.pt")]


def test_a_new_task_overwrites_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    mine = tmp_path / "mine_flat.py"
    mine.write_text("of mine")
    text = complaint(monkeypatch, capsys, GO1, "--new", "mine", "--out", tmp_path)
    assert "mine_flat.py exists; say another name or --out DIR, or --force to overwrite" in text
    assert mine.read_text() == "of mine" and [*tmp_path.iterdir()] == [mine]
    show(monkeypatch, capsys, GO1, "--new", "mine", "--out", tmp_path, "--force")
    assert mine.read_text() != "of mine" and (tmp_path / "mine.xml").read_bytes() == GO1.read_bytes()
    assert "a b/mine_flat.py' --check" in show(monkeypatch, capsys, GO1, "--new", "mine", "--out", tmp_path / "a b"), (
        "can be pasted"
    )
    assert "a name begins with a letter" in complaint(monkeypatch, capsys, GO1, "--new", "a/b", "--out", tmp_path)
    assert "go1_flat is a task already" in complaint(monkeypatch, capsys, "go1_flat", "--new", "mine")


def test_a_draft_says_what_it_guessed(tmp_path: Path) -> None:
    assert draft(GO1).guessed[0] == "pose: the file's keyframe" and draft(GO1).pose[:3] == pytest.approx(
        [0.1, 0.9, -1.8]
    )
    bare = tmp_path / "bare.xml"
    bare.write_text(re.sub(r"<keyframe>.*</keyframe>", "", GO1.read_text(), flags=re.DOTALL))
    found = draft(bare)
    assert [foot.name for foot in found.feet] == ["FR", "FL", "RR", "RL"]
    assert found.guessed[0] == "pose: knees bent by 1.52 rad"
    assert found.pose[:3] == pytest.approx([0.0, 0.8, -1.6], abs=0.02)  # two links of 0.213 m: half of the knee's angle
    assert found.place[2] == pytest.approx(2 * 0.213 * math.cos(0.8) + 0.023, abs=0.01)
    assert health_of(found, bare).stand.end == "stands"
    text = config_text(found, GO1, "my_go")
    assert (
        "class MyGoFlatCfg(SimToRealCfg):" in text and 'foot_names = ["FR", "FL", "RR", "RL"]  # LOOK: guessed' in text
    )
    assert "(quadruped, 12 joints; " in text and "# effort = " not in text
    assert "end_probability = 0.2  # share" in text
    assert "offsets = [0.0, 0.5, 0.5, 0.0]" in text  # FR and RL, then FL and RR
    for field, value in load_task("go1_flat").train.cpu.overrides.items():  # a quadruped learns as a Go1 on a CPU
        known = field in ("commands.curriculum", "commands.curriculum_step")  # in SimToRealCfg
        assert known or f'"{field}": {value}' in text, field
    simple = config_text(draft(bare, simple=True), GO1, "my_go")
    assert "class MyGoFlatCfg(LeggedRobotCfg):" in simple and "delay_ms" in text and "delay_ms" not in simple
    biped = config_text(draft(TOY), TOY, "toy", mirrors=True)
    assert (
        "class ToyFlatCfg(UprightBipedCfg):" in biped
        and "class ToyFlatCfgPPO(UprightBipedCfgPPO):" in biped
        and "use_data" not in biped
    )
    assert 'pose_weights = {"": 0.14, "ankle": 1.5}' in biped and "min_feet_distance = 0.12" in biped
    simple = config_text(draft(TOY, simple=True), TOY, "toy")
    assert "class ToyFlatCfg(BipedCfg):" in simple and 'pose_weights = {"": 0.02, "ankle": 0.05}' in simple
    assert "use_data_augmentation = False  # left and right are not alike" in config_text(draft(TOY), TOY, "toy")
    free = tmp_path / "free.xml"
    free.write_text(GO1.read_text().replace("actuatorfrcrange", "user"))
    assert 'effort = {"": 30.0}  # [N m] LOOK: the file has no force limit for all joints' in config_text(
        draft(free), free, "free"
    )


def test_sides_that_differ_by_a_fraction_of_a_millimetre_stand_alike(tmp_path: Path) -> None:
    """As from a CAD program: the computed angles of left and right would differ in the last digit."""
    file, calf = tmp_path / "uneven.xml", '<body name="FL_calf" pos="0 0 -0.213"'
    bare = re.sub(r"<keyframe>.*</keyframe>", "", GO1.read_text(), flags=re.DOTALL)
    assert bare.count(calf) == 1
    file.write_text(bare.replace(calf, '<body name="FL_calf" pos="0.0003 0 -0.2127"'))
    found = draft(file)
    angles = dict(zip(found.robot.joint_names, found.pose, strict=True))
    assert angles["FL_thigh_joint"] == angles["FR_thigh_joint"] != 0.0
    assert angles["FL_calf_joint"] == angles["FR_calf_joint"] != 0.0
    assert found.angles == angles
    assert has_mirror(as_env(found, file))


def test_a_robot_that_would_sink_gets_firmer_servos(tmp_path: Path) -> None:
    """Four feet under 20 kg, less so under 15, and not a biped, which falls on any."""
    text = (ROOT / "tests/data/go2_style.xml").read_text().replace('model="go2_style"', 'model="mine"')
    heavy, light = tmp_path / "heavy.xml", tmp_path / "light.xml"
    heavy.write_text(text.replace('mass="7"', 'mass="12"'))
    light.write_text(text)
    firm, soft = draft(heavy), draft(light)
    firmer = "gains: {} times what is suggested below, to stand on its servos"
    assert (firm.guessed[2], soft.guessed[2]) == (firmer.format("1.5"), firmer.format("1.25"))
    assert firm.gains[0].kp > 1.2 * soft.gains[0].kp
    assert health_of(firm, heavy).stand.end == "stands"
    heavy.write_text(text.replace('mass="7"', 'mass="40"'))
    none = draft(heavy)
    assert none.guessed[2] == "gains: as suggested below, though with up to 2 times them it does not stand either"


FEET = {
    "a1_style": ["FR_foot", "FL_foot", "RR_foot", "RL_foot"],
    "anymal_c_style": ["LF_FOOT", "RF_FOOT", "LH_FOOT", "RH_FOOT"],
    "g1_12dof_style": ["left_ankle_roll_link", "right_ankle_roll_link"],
    "g1_29dof_style": ["left_ankle_roll_link", "right_ankle_roll_link"],
    "go2_style": ["FL", "FR", "RL", "RR"],
    "t1_style": ["left_foot_link", "right_foot_link"],
}


@pytest.mark.parametrize("file", DATA, ids=lambda file: file.stem)
def test_feet_and_poses_of_vendors_files(file: Path) -> None:
    """Feet by the bodies' names; soles level; a quadruped stands on its servos, a biped over its feet."""
    found = draft(file)
    assert [foot.name for foot in found.feet] == FEET[file.stem]
    health = health_of(found, file)
    assert health.margin > 0.05 and not health.rest.toppled and health.mode.growth < 1.0 + 1e-6
    assert health.stand.end == ("stands" if len(found.feet) == 4 else "falls")
    angle = dict(zip(found.robot.joint_names, found.pose, strict=True))
    if file.stem.startswith("anymal"):  # its hind legs are its front legs, turned round
        assert angle["LF_HFE"] == pytest.approx(-angle["LH_HFE"]) and angle["LF_KFE"] == -angle["LH_KFE"] == -0.8
    if file.stem.startswith("g1"):
        assert angle["left_knee_joint"] == 0.3
        assert sum(angle[f"left_{part}_joint"] for part in ("hip_pitch", "knee", "ankle_pitch")) == pytest.approx(
            0.0, abs=1e-6
        )


def test_feet_that_the_pose_lifts_are_feet(tmp_path: Path) -> None:
    """A keyframe that sits on its hind legs made a biped of a quadruped."""
    text = (ROOT / "tests/data/go2_style.xml").read_text()
    (tmp_path / "sits.xml").write_text(text.replace("0 0 0 0 0.9 -1.8  0 0.9 -1.8 ", "0 0 0 0 -1.2 -1.8  0 -1.2 -1.8 "))
    found = draft(tmp_path / "sits.xml")
    [keyframe] = [each for each in found.judged if each.candidate.rank == 0]
    assert found.judged[0] is not keyframe and any("lifts a foot" in fault for fault in keyframe.faults)
    assert [foot.name for foot in found.feet] == FEET["go2_style"]


def test_what_of_the_file_is_changed_is_on_its_page(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """--new makes an MJCF of a URDF: what was left out of it is said here or nowhere, and its speed limits go into the config."""
    a1, t1 = ROOT / "tests/data/a1_style.urdf", ROOT / "tests/data/t1_style.xml"
    text = show(monkeypatch, capsys, a1)
    assert (
        "in the file\n  looks left out (no such file): package://a1_style_description/meshes/" in text
        and "\n  free joint added to 'base'\n" in text
    )
    changed = show(monkeypatch, capsys, t1)
    assert "\n  12 actuators replaced\n  keyframe 'stand' read" in changed
    assert (
        "\n  site 'imu_aligned' made at the place of 'imu' on 'Waist', with the axes of the root 'Trunk'\n" in changed
    )
    assert (
        "\n  fused into 'Trunk', to which they are fixed: H2, AL, left_hand_link, AR, right_hand_link, Waist\n"
        in changed
    )
    assert 'joint_speed_limits = {"": 28.6, "hip": 52.0}  # [rad/s] the file\'s' in config_text(draft(a1), a1, "mine")
    assert "joint_speed_limits" not in config_text(draft(t1), t1, "mine")


def test_a_file_without_feet(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "wheel.xml"
    file.write_text(WHEEL.format(half=0.2, offset=0.0, more=""))
    assert "no part that ends a limb collides, so that no feet can be guessed" in complaint(monkeypatch, capsys, file)
    file.write_text(
        '<mujoco><worldbody><body name="arm"><inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/><body name="hand" pos="0 0 0.4">'
        '<joint name="wrist" axis="0 1 0" range="-1 1" limited="true"/><geom size="0.02"/></body></body></worldbody></mujoco>'
    )
    text = "'arm', the root, is not above the lowest ends of limbs, hand; the health page needs a robot that stands on them"
    assert text in complaint(monkeypatch, capsys, file)


def test_names_beside_the_robot_do_not_overlap() -> None:
    labels = [(Label(f"joint {i}", np.zeros(3), (1.0, 1.0, 1.0)), (500.0 + i, 480.0)) for i in range(29)]
    rows = _columns(labels)
    for side in (True, False):
        heights = sorted(row for _, _, row, left in rows if left == side)
        assert (
            len(heights) >= 14 and min(np.diff(heights)) > 20.0 and heights[0] > 40.0 and heights[-1] < HEIGHT - 100.0
        )


# ---- physics that diverges stops a training ----


class FakeSim:
    def __init__(self, qpos: torch.Tensor, qvel: torch.Tensor) -> None:
        self.qpos, self.qvel = qpos, qvel


def test_what_broke_a_world_is_counted() -> None:
    sim, actions, broken = (
        FakeSim(torch.zeros(5, 9), torch.zeros(5, 8)),
        torch.zeros(5, 2),
        torch.zeros(5, dtype=torch.bool),
    )
    found = BrokenWorlds(sim, actions, ["hip", "knee"], 100.0)  # pyright: ignore[reportArgumentType]
    sim.qvel[:, 6:] = torch.tensor([1.0, 2.0])
    found.find(broken)
    assert not broken.any() and found.counts.tolist() == [0, 0, 0]
    sim.qvel[1, 6], sim.qvel[2] = 101.0, math.nan  # one joint too fast; all is lost, and nobody knows why
    # the policy's fault; the root is lost, and the knee is the fastest
    actions[3, 0], sim.qpos[4, 0] = math.nan, math.inf
    found.find(broken)
    assert broken.tolist() == [False, True, True, True, True] and found.counts.tolist() == [1, 1, 1]
    assert {name: float(value) for name, value in found.statistics().items()} == {
        **{"broken_by/hip": 1, "broken_by/knee": 1, "broken_by_action": 1}
    }
    found.find(broken)  # counts go on
    assert found.counts.tolist() == [2, 2, 2]


def numbers(
    broken: float, episodes: float = 200.0, hip: float = 0.0, knee: float = 0.0, action: float = 0.0
) -> dict[str, float]:
    return {
        "broken": broken,
        "episodes": episodes,
        "broken_by/hip": hip,
        "broken_by/knee": knee,
        "broken_by_action": action,
    }


def test_twice_in_a_row_over_one_percent() -> None:
    watch = DivergenceStop()
    assert watch.verdict(numbers(2.0, hip=2.0)) == ""  # 1 % is not over 1 %
    assert watch.verdict(numbers(3.0, hip=5.0)) == ""
    assert watch.verdict(numbers(0.0, hip=5.0)) == ""
    assert watch.verdict(numbers(3.0, hip=5.0, knee=3.0)) == ""
    text = watch.verdict(numbers(5.0, episodes=100.0, hip=7.0, knee=6.0))
    assert text.startswith(
        "in the last two iterations 3 of 200 and 5 of 100 episodes ended with a state that is not finite: physics diverges"
    )
    assert (
        "fastest joint at the break: knee (75%), hip (25%). Lower control.damping or control.stiffness of these joints"
        in text
    )
    assert (
        "asset.armature" in text
        and "sim.dt" in text
        and "set sim.integrator to implicitfast" in text
        and "--check --picture" in text
    )
    policy = DivergenceStop()
    policy.verdict(numbers(9.0, action=9.0))
    assert "the policy's actions are not finite; lower algorithm.learning_rate" in policy.verdict(
        numbers(9.0, action=18.0)
    )
    assert watch.verdict(numbers(0.0, episodes=0.0)) == ""


def test_a_training_whose_physics_diverges_ends_with_the_joints_that_did_it(tmp_path: Path) -> None:
    run_of = [
        *SMALL,
        "--max_iterations",
        "9",
        "--set",
        "control.damping={'': 0.5, 'calf': 14.0}",
        "--set",
        "runner.save_interval=1",
    ]
    result = run("train", tmp_path, *run_of)
    assert result.code == 2 and result.err.count("\n") == 1
    assert (
        "physics diverges; fastest joint at the break: " in result.err
        and "_calf_joint (" in result.err.partition("Lower")[0]
    )
    assert "Learning iteration 2/9" in result.out and "Learning iteration 3/9" not in result.out
    assert "stopped: the simulated state is not finite" in result.out
    [*_, newest] = sorted((tmp_path / "logs").glob("*/*/model_*.pt"))
    weights = torch.load(newest, weights_only=True)["actor_state_dict"]
    assert newest.name == "model_2.pt" and all(bool(value.isfinite().all()) for value in weights.values())


def test_networks_that_are_not_finite_are_not_saved(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from legged_mw.rl.runner import make_runner

    task = load_task("go1_flat")
    for path, value in {"env.num_envs": 4, "actor.hidden_dims": [8], "critic.hidden_dims": [8]}.items():
        task.set(path, value)
    runner = make_runner(task.env_class(task.cfg, "cpu"), task.train, tmp_path, "cpu")
    next(runner.alg.critic.parameters()).data.fill_(math.nan)
    runner._save_checkpoint()
    assert "the networks are not finite; not saved" in capsys.readouterr().out and not [*tmp_path.glob("*.pt")]


# ---- the integrator ----


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_implicitfast_bears_what_euler_does_not(tmp_path: Path, engine: str) -> None:
    """The wheel turns at 1 rad/s with dt kd / I = 3.2: explicit damping makes it faster, implicit damping stops it."""
    from legged_mw.sim.engines import make_simulation

    speeds = {}
    for integrator in ("euler", "implicitfast"):
        robot = wheel(tmp_path, solver=Solver(DT, 1, 5, integrator), damping={"": 40.0})
        assert robot.physics.opt.integrator == getattr(mujoco.mjtIntegrator, f"mjINT_{integrator.upper()}")
        sim = make_simulation(robot.physics, 1, "cpu", engine=engine, nconmax=4, njmax=20)
        sim.qpos[:, 2], sim.qvel[:, 6] = 10.0, 1.0
        sim.step(1)
        speeds[integrator] = float(sim.qvel[0, 6])
    assert speeds["euler"] == pytest.approx(1.0 - DT * 40.0 / 0.05, rel=1e-3)  # the motor turns the slab the other way
    assert speeds["implicitfast"] == pytest.approx(1.0 / (1.0 + DT * 40.0 / 0.05), rel=1e-3)


def test_integrator_is_a_field_and_euler_is_as_it_was(tmp_path: Path) -> None:
    assert load_task("go1_flat").cfg.sim.integrator == "euler"
    flags = wheel(tmp_path).physics.opt.disableflags
    assert flags == wheel(tmp_path, solver=Solver(integrator="implicitfast")).physics.opt.disableflags
    assert flags == mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    result = run(
        "train", tmp_path, "--task", "go1_flat", "--device", "cpu", "--check", "--set", "sim.integrator=implicitfast"
    )
    assert result.code == 0 and "option integrator: euler -> implicitfast" in result.out


# ---- meshes ----

OCTAHEDRON = "".join(
    f"v {x} {y} {z}\n" for x, y, z in [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)]
) + "".join(
    f"f {a} {b} {c}\n"
    for a, b, c in [(1, 3, 5), (3, 2, 5), (2, 4, 5), (4, 1, 5), (3, 1, 6), (2, 3, 6), (4, 2, 6), (1, 4, 6)]
)


@pytest.mark.parametrize("absolute", [False, True])
def test_meshes_are_named_relative_to_the_new_file(tmp_path: Path, absolute: bool) -> None:
    """So that both folders may move together; a copy of the file alone would look for them beside itself."""
    theirs, ours = tmp_path / "all" / "theirs", tmp_path / "all" / "ours"
    (theirs / "looks").mkdir(parents=True)
    (theirs / "looks" / "hull.obj").write_text(OCTAHEDRON)
    folder = f"{theirs}/looks" if absolute else "looks"
    text = TOY.read_text().replace('<compiler angle="radian"/>', f'<compiler angle="radian" meshdir="{folder}"/>')
    text = text.replace(
        "<worldbody>", '<asset><mesh name="hull" file="hull.obj" scale="0.1 0.1 0.1"/></asset><worldbody>'
    )
    text = text.replace('<site name="imu"', '<geom class="look" type="mesh" mesh="hull" mass="0"/><site name="imu"')
    (theirs / "toy.xml").write_text(text)
    robot, *_ = write(draft(theirs / "toy.xml"), theirs / "toy.xml", "mine", ours, pack=False)
    assert 'file="../theirs/looks/hull.obj"' in robot.read_text() and str(tmp_path) not in robot.read_text()
    (tmp_path / "all").rename(tmp_path / "moved")
    moved = mujoco.MjModel.from_xml_path(str(tmp_path / "moved" / "ours" / "mine.xml"))
    assert moved.nmesh == 1 and moved.nu == 0 and moved.body_subtreemass[0] == pytest.approx(12.0)
    assert [moved.jnt_actfrcrange[i, 1] for i in range(1, 7)] == [60.0] * 6


def test_meshes_of_an_attached_robot_are_named_relative_too(tmp_path: Path) -> None:
    """Its own meshdir is beside its own file: they were written as if they were beside the robot's."""
    parts = tmp_path / "theirs/arms/left/parts"
    parts.mkdir(parents=True)
    (parts / "hull.obj").write_text(OCTAHEDRON)
    hand = '<asset><mesh name="hull" file="hull.obj" scale="0.1 0.1 0.1"/></asset><worldbody><body name="hand">'
    hand = f'<mujoco model="hand"><compiler meshdir="parts"/>{hand}<geom type="mesh" mesh="hull" mass="0.1"/></body></worldbody></mujoco>'
    (tmp_path / "theirs/arms/left/hand.xml").write_text(hand)
    arm = '<worldbody><body name="arm"><geom size="0.02" mass="0.1"/><attach model="hand" body="hand" prefix="left_"/></body></worldbody>'
    arm = f'<mujoco model="arm"><asset><model name="hand" file="left/hand.xml"/></asset>{arm}</mujoco>'
    (tmp_path / "theirs/arms/arm.xml").write_text(arm)
    text = TOY.read_text().replace("<worldbody>", '<asset><model name="arm" file="arms/arm.xml"/></asset><worldbody>')
    (tmp_path / "theirs/toy.xml").write_text(
        text.replace('<site name="imu"', '<attach model="arm" body="arm" prefix="right_"/><site name="imu"')
    )
    robot, config = write(
        draft(tmp_path / "theirs/toy.xml"), tmp_path / "theirs/toy.xml", "mine", tmp_path / "ours/here", pack=False
    )
    assert (
        'file="../../theirs/arms/left/parts/hull.obj"' in robot.read_text() and str(tmp_path) not in robot.read_text()
    )
    assert mujoco.MjModel.from_xml_path(str(robot)).nmesh == 1
    task = load_task(str(config))
    assert task.env_class(task.cfg, "cpu").robot.physics.body_subtreemass[0] == pytest.approx(12.2)
