"""Robots as vendors write them: six files are loaded unedited, and each trouble that they once made has a test of what is said now."""

from __future__ import annotations

import math
import struct
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from data.vendor_tasks import HERE, TASKS, vendor_task
from program import SMALL, run
from test_sim import build_toy, toy
from worlds import QUIET

from legged_mw import ROOT
from legged_mw.check.describe import describe
from legged_mw.drawing.scene import visual_model
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task import start_place
from legged_mw.export.scene import standalone
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.model import RobotModel, read_file
from legged_mw.sim.robot_file import read_plain
from legged_mw.view.recorder import save_png

EXACT = {"sim.iterations": 100, "sim.ls_iterations": 50}
STILL = {
    "init_state.lin_vel_range": 0.0,
    "init_state.ang_vel_range": 0.0,
    "init_state.yaw_range": 0.0,
    "init_state.pos_xy_range": 0.0,
}
EFFORTS = {
    "go2_style": [24, 24, 45] * 4,
    "g1_29dof_style": [88, 139, 88, 139, 50, 50] * 2 + [88, 50, 50] + [25, 25, 25, 25, 25, 5, 5] * 2,
    "g1_held_style": [88, 139, 88, 139, 50, 50] * 2,
    "g1_12dof_style": [88, 139, 88, 139, 50, 50] * 2,
    "t1_style": [45, 30, 30, 60, 24, 15] * 2,
    "anymal_c_style": [80] * 12,
    "a1_style": [20, 55, 55] * 4,
}


def make(name: str, num_envs: int = 2, **overrides: Any) -> LeggedRobot:
    task = vendor_task(name)
    for path, value in {"env.num_envs": num_envs, **QUIET, **STILL, **overrides}.items():
        task.set(path, value)
    torch.manual_seed(0)
    return task.env_class(task.cfg, "cpu")


@cache
def env_of(name: str) -> LeggedRobot:
    """One that tests only look at, or step."""
    return make(name, **EXACT)


def pure(name: str) -> mujoco.MjModel:
    """The file of an MJCF without a mesh that is missing, as MuJoCo alone reads it."""
    spec = mujoco.MjSpec.from_file(str(vendor_task(name).cfg.asset.file))
    for geom in [geom for geom in spec.geoms if geom.meshname and geom.meshname != "shell"]:
        spec.delete(geom)
    for mesh in [mesh for mesh in spec.meshes if mesh.file]:
        spec.delete(mesh)
    return spec.compile()


# ---- the six files, unedited


@pytest.mark.parametrize("name", TASKS)
def test_a_vendors_file_is_stepped_unedited(name: str) -> None:
    env = make(name, 3)
    assert env.robot.effort_range[:, 1].tolist() == EFFORTS[name] and env.num_actions == len(EFFORTS[name])
    for _ in range(3):
        observations, rewards, _, _ = env.step(0.3 * torch.randn(3, env.num_actions))
        assert all(torch.isfinite(group).all() for group in observations.values()) and torch.isfinite(rewards).all()
    assert not env.broken.any() and not env.fell.any()
    assert not any(line.startswith("warning:") for line in env.robot.overrides)


@pytest.mark.parametrize("name", TASKS)
def test_it_is_drawn_and_exported_as_one_text(name: str) -> None:
    env = env_of(name)
    robot, start = env.robot, [*env.start_place, 1.0, 0.0, 0.0, 0.0, *env.robot.pose]
    scene = standalone(robot, robot.imu, qpos=start, ctrl=robot.pose)  # which checks that it is the same machine
    assert "file=" not in scene.xml and visual_model(robot).nv == robot.physics.nv


@pytest.mark.parametrize("name", TASKS)
def test_its_mirror_image_moves_as_the_mirror_says(name: str) -> None:
    """Two worlds, one the mirror image of the other, from a bent pose in the air to the ground."""
    env = make(name, 2, **EXACT)
    partners = env._partners()
    sign, index = torch.tensor(partners.signs, dtype=torch.float), list(partners.joints)
    env.step(torch.zeros(2, env.num_actions))
    generator = torch.Generator().manual_seed(1)
    bent = env.default_dof_pos + 0.1 * torch.randn(env.num_actions, generator=generator)
    actions = 0.2 * torch.randn(1, env.num_actions, generator=generator)
    env.sim.qvel.zero_()
    env.sim.qpos[:, :3] = torch.tensor(env.start_place)
    env.sim.qpos[:, 2] += 0.02
    env.sim.qpos[:, 3:7] = torch.tensor([[0.99, 0.06, 0.05, 0.1], [0.99, -0.06, 0.05, -0.1]])
    env.sim.qpos[0, 7:], env.sim.qpos[1, 7:] = bent, bent[index] * sign
    for _ in range(6):
        env.step(torch.cat([actions, env.mirror.actions(actions)]))
    left, right = env.sim.qpos
    assert env.foot_contact.any() and (left[7:] - bent).abs().max() > 0.05
    torch.testing.assert_close(right[7:], left[7:][index] * sign, atol=2e-3, rtol=0)
    torch.testing.assert_close(right[:7], left[:7] * torch.tensor([1, -1, 1, 1, -1, 1, -1.0]), atol=1e-3, rtol=0)


# ---- what is dropped, added and renamed is said


SAID = {
    "go2_style": [
        "keyframe 'home' read: pose and height of the root, where nothing else states them",
        "sensors dropped, as nothing reads them: FR_hip_angle, FR_hip_speed, imu_quat, imu_gyro, imu_acc",
        "world geoms dropped, as the ground is added: floor, one without a name",
        "lights dropped: one without a name",
        "skybox dropped: one without a name",
        "geom of 'base_link' without a name is called 'base_link_1'",
        "option impratio: 100 -> 1",
        "option cone: elliptic -> pyramidal",
        "option disableflags: none -> eulerdamp",
        "12 actuators replaced",
    ],
    "g1_29dof_style": [
        "looks left out (no such file): pelvis.STL, torso_link.STL, head_link.STL",
        "cameras dropped: over_the_scene",
        "free joint frictionloss: 0.2 -> 0",
        "site 'left_ankle_roll_link' made at the lowest point of left_ankle_roll_link_0, left_ankle_roll_link_1, left_ankle_roll_link_2, "
        "left_ankle_roll_link_3",
    ],
    "g1_held_style": [
        "joint 'waist_yaw_joint' held at 0 rad",
        "joint 'left_elbow_joint' held at 1.2 rad",
        "site 'imu_in_torso_aligned' made at the place of 'imu_in_torso' on 'torso_link', with the axes of the root 'pelvis'",
    ],
    "g1_12dof_style": [
        "option integrator: implicitfast -> euler",
        "fused into 'pelvis', to which they are fixed: torso_link, left_arm_link, right_arm_link",
        "site 'imu_aligned' made at the place of 'imu' on 'torso_link', with the axes of the root 'pelvis'",
    ],
    "t1_style": [
        "keyframe 'stand' read: pose and height of the root, where nothing else states them",
        "cameras dropped: track",
    ],
    "anymal_c_style": [
        "free joint added to 'base'",
        "fused into 'base', to which they are fixed: base_inertia, face_front, battery, imu_link",
        "fused into 'LF_SHANK', to which they are fixed: LF_FOOT",
        "joints without limits: LF_HFE, LF_KFE, RF_HFE, RF_KFE, LH_HFE, LH_KFE, RH_HFE, RH_KFE",
        "site 'imu' made at the origin of 'base'",
    ],
    "a1_style": [
        "fused into 'base', to which they are fixed: trunk, imu_link",
        "inertia of 'imu_link' balanced: no body has the moments 1e-06, 1e-06, 0.0002 kg m^2; now 6.71e-05, 6.71e-05, 0.000134",
        "FR_hip_joint armature: 0 -> 0.01 kg m^2",
        "FR_hip_joint damping: 0.01 -> 0.5 N m s/rad",
    ],
}


@pytest.mark.parametrize("name", SAID)
def test_what_was_dropped_added_or_renamed_is_said(name: str) -> None:
    overrides = env_of(name).robot.overrides
    assert [line for line in SAID[name] if line not in overrides] == []


@pytest.mark.parametrize(("name", "mesh"), [("anymal_c_style", "base.dae"), ("a1_style", "imu.stl")])
def test_looks_that_are_not_there_are_left_out(name: str, mesh: str) -> None:
    (line,) = [line for line in env_of(name).robot.overrides if line.startswith("looks")]
    start, _, files = line.partition(": ")
    assert start == "looks left out (no such file)" and f"package://{name}_description/meshes/{mesh}" in files.split(
        ", "
    )


# ---- the machine stays the same


@pytest.mark.parametrize("name", ["go2_style", "g1_29dof_style", "g1_held_style", "g1_12dof_style", "t1_style"])
def test_nothing_of_the_machine_is_lost(name: str) -> None:
    """Mass, its place and the inertia of the whole are those of the file in this pose, with joints held and bodies fused."""
    robot, file = env_of(name).robot, pure(name)
    known = dict(zip(robot.joint_names, robot.pose, strict=True)) | {"left_elbow_joint": 1.2, "right_elbow_joint": 1.2}
    inertia, centres = [], []
    for model in (robot.physics, file):
        data = mujoco.MjData(model)
        data.qpos[:7] = [0, 0, 1, 1, 0, 0, 0]
        for i in range(1, model.njnt):
            data.qpos[model.jnt_qposadr[i]] = known.get(model.joint(i).name, 0.0)
        mujoco.mj_forward(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        free = float(model.dof_armature[0])  # the file's free joint may have some, which is dropped
        inertia.append(full[:6, :6] - free * np.eye(6))
        centres.append(data.subtree_com[1].copy())
    np.testing.assert_allclose(inertia[0], inertia[1], atol=1e-6)
    np.testing.assert_allclose(centres[0], centres[1], atol=1e-7)


def test_a_link_of_a_urdf_without_inertial_has_no_mass() -> None:
    assert env_of("a1_style").total_mass == pytest.approx(4.7 + 0.001 + 4 * (0.7 + 1.0 + 0.17 + 0.06))
    assert env_of("anymal_c_style").total_mass == pytest.approx(19 + 0.7 + 5.5 + 0.01 + 4 * (2.8 + 3.0 + 0.5 + 0.1))


@pytest.mark.parametrize(
    ("name", "place"),
    [
        ("go2_style", [0.0, 0.0, 0.27]),  # the keyframe's
        ("t1_style", [0.0, 0.0, 0.66]),  # that of the only one
        ("anymal_c_style", None),
        ("g1_12dof_style", None),
    ],
)
def test_where_it_starts(name: str, place: list[float] | None) -> None:
    env = env_of(name)
    if place:
        assert env.start_place == place
        return
    data = mujoco.MjData(env.robot.physics)
    data.qpos[:] = [*env.start_place, 1, 0, 0, 0, *env.robot.pose]
    for height, contacts in ((-1e-4, True), (1e-4, False)):
        data.qpos[2] = env.start_place[2] + height
        mujoco.mj_forward(env.robot.physics, data)
        assert bool(data.ncon) == contacts, "the lowest foot stands on the ground"


def test_the_config_wins_over_the_keyframe() -> None:
    changed = make(
        "go2_style",
        **{"init_state.pos": [0.0, 0.0, 0.5], "init_state.default_joint_angles": {"hip": 0.1, "FR_calf": -1.7}},
    )
    assert changed.start_place == [0.0, 0.0, 0.5]
    assert changed.robot.pose == (0.1, 0.9, -1.8, 0.1, 0.9, -1.7, 0.1, 0.9, -1.8, 0.1, 0.9, -1.8)
    legs = [0.213 * math.cos(0.9) + 0.213 * math.cos(0.9 + calf) for calf in (-1.8, -2.4)]
    lower = make("go2_style", **{"init_state.default_joint_angles": {"calf": -2.4}}).start_place
    assert lower[2] == pytest.approx(0.27 - legs[0] + legs[1], abs=0.01), (
        "feet are as high above the ground as in the keyframe"
    )


def test_a_keyframe_states_a_height_and_no_place(tmp_path: Path) -> None:
    """On terrain the root would stand beside the middle of its tile."""
    key = '<keyframe><key qpos="1 2 0.4 1 0 0 0 0 0"/></keyframe>'
    robot = build_toy(toy(tmp_path, extra=key))
    assert start_place(LeggedRobotCfg(), robot, ["left_foot"]) == [0.0, 0.0, 0.4]


def test_a_keyframes_tilt_is_a_warning(tmp_path: Path) -> None:
    """The root begins upright, whatever the file says; a turn about the vertical is nothing to say."""

    def made(quat: str) -> RobotModel:
        return build_toy(toy(tmp_path, extra=f'<keyframe><key name="sit" qpos="0 0 0.4 {quat} 0 0"/></keyframe>'))

    said = "warning: keyframe 'sit' tilts the root by 30 degrees; that and its height are not read, the root begins upright: "
    tilted = made("0.9659258 0 0.258819 0")
    assert said + "state a pose for that" in tilted.overrides and tilted.keyframe and tilted.keyframe.height is None
    for quat in ("0.7 0 0 0.7", "2 0 0 0"):
        level = made(quat)
        assert level.keyframe and level.keyframe.height == 0.4 and not any("tilt" in line for line in level.overrides)


# ---- trouble by trouble


def test_a_motors_range_is_its_force_limit(tmp_path: Path) -> None:
    """Effort was lost: a file with neither actuatorfrcrange nor forcerange had infinite servos, and nothing said so."""
    motors = """<actuator><motor joint="left_hip" gear="4" ctrlrange="-6 5"/>
      <general joint="right_hip" gainprm="2" ctrlrange="-3 3"/></actuator>"""
    robot = build_toy(toy(tmp_path, extra=motors))
    assert robot.effort_range.tolist() == [[-24, 20], [-6, 6]] and not any(
        "warning" in line for line in robot.overrides
    )
    both = motors.replace('gear="4"', 'gear="4" forcerange="-2 2"')
    assert build_toy(toy(tmp_path, extra=both)).effort_range.tolist()[0] == [-8, 8], "forcerange comes first"
    angles = '<actuator><position joint="left_hip" ctrlrange="-1 1"/></actuator>'
    robot = build_toy(toy(tmp_path, extra=angles))
    assert robot.effort_range.tolist() == [[-math.inf, math.inf]] * 2, "an angle is no force"
    text = (
        "warning: nothing limits the force of left_hip, right_hip: these servos are stronger than any motor; set effort"
    )
    assert text in robot.overrides


def test_an_actuators_armature_is_its_joints(tmp_path: Path) -> None:
    """MuJoCo's actuators have rotors too, before their gear. They were lost with the actuators, and nothing said so."""
    motors = """<actuator><motor joint="left_hip" gear="-3" armature="0.02" ctrlrange="-6 5"/>
      <position joint="right_hip" forcerange="-3 3" armature="0.01"/></actuator>"""
    file = toy(tmp_path, extra=motors)
    model, robot = mujoco.MjModel.from_xml_path(str(file)), build_toy(file)
    assert robot.physics.dof_armature[6:].tolist() == pytest.approx([0.18, 0.01])
    matrices = []
    for each in (model, robot.physics):
        data, matrix = mujoco.MjData(each), np.zeros((each.nv, each.nv))
        mujoco.mj_forward(each, data)
        mujoco.mj_fullM(each, data, matrix)
        matrices.append(matrix)
    np.testing.assert_allclose(matrices[1], matrices[0], atol=1e-9)
    assert sum("armature" in line for line in robot.overrides) == 2


def test_an_infinite_servo_is_a_warning_that_names_the_field(tmp_path: Path) -> None:
    (tmp_path / "bare.xml").write_text(
        (HERE / "g1_12dof_style.xml").read_text().replace('actuatorfrcrange="-139 139"', "")
    )
    text = "warning: nothing limits the force of left_hip_roll_joint, left_knee_joint, right_hip_roll_joint, right_knee_joint: "
    text += "these servos are stronger than any motor; set effort"
    env = make("g1_12dof_style", **{"asset.file": str(tmp_path / "bare.xml")})
    assert text in env.robot.overrides and f"  {text}" in describe(env, vendor_task("g1_12dof_style")).splitlines()
    mended = make(
        "g1_12dof_style",
        **{"asset.file": str(tmp_path / "bare.xml"), "asset.effort": {"hip_roll": 120.0, "knee": 130.0}},
    )
    assert not any("warning" in line for line in mended.robot.overrides)
    assert mended.robot.effort_range[:, 1].tolist() == [88, 120, 88, 130, 50, 50] * 2


def test_tables_that_name_some_joints_win_over_the_file() -> None:
    tables = {"asset.effort": {"hip": 20.0}, "asset.armature": {"calf": 0.03}, "asset.frictionloss": {"FR_hip": 1.0}}
    robot = make("go2_style", **tables, **{"asset.joint_speed_limits": {"": 30.0, "calf": 20.0}}).robot
    assert robot.effort_range[:3, 1].tolist() == [20, 24, 45] and robot.speed_limits == (30.0, 30.0, 20.0) * 4
    np.testing.assert_allclose(robot.physics.dof_armature[6:12], [0.01, 0.01, 0.03] * 2)
    fr_hip = robot.joint_names.index("FR_hip_joint")
    assert robot.physics.dof_frictionloss[6 + fr_hip] == 1.0 and robot.physics.dof_frictionloss[
        6:
    ].sum() == pytest.approx(1.0 + 11 * 0.2)
    assert {"FR_hip_joint force limit: 24 -> 20 N m", "FR_hip_joint frictionloss: 0.2 -> 1 N m"} <= set(robot.overrides)


def test_a_urdfs_speed_limits_are_known() -> None:
    assert env_of("a1_style").robot.speed_limits == (52.0, 28.6, 28.6) * 4
    assert make("a1_style", **{"asset.joint_speed_limits": {"hip": 40.0}}).robot.speed_limits == (40.0, 28.6, 28.6) * 4
    assert set(env_of("go2_style").robot.speed_limits) == {math.inf}


def test_a_joint_without_limits_is_nowhere_punished() -> None:
    """Its range was 0 to 0, so that `dof_pos_limits` punished every angle."""
    env = make("anymal_c_style")
    assert env.robot.joint_range[1].tolist() == [-math.inf, math.inf] and env.soft_lower[0] > -0.72
    env.sim.qpos[:, 8] = 9.0  # [rad] LF_HFE
    assert env._reward_dof_pos_limits().abs().max() == 0.0
    env.sim.qpos[:, 7] = 0.8  # LF_HAA
    assert env._reward_dof_pos_limits().min() > 0.0
    assert not env.robot.physics.actuator_ctrllimited[1] and "[-inf, inf]" in describe(
        env, vendor_task("anymal_c_style")
    )


def test_a_second_ground_is_dropped(tmp_path: Path) -> None:
    world = '<geom name="floor" type="plane" size="0 0 1"/><body name="table"><geom size="0.1"/></body>'
    robot = build_toy(toy(tmp_path, world=world))
    assert robot.physics.geom(0).name == "floor" and robot.physics.ngeom == 3 and robot.physics.nbody == 4
    for line in (
        "world geoms dropped, as the ground is added: floor",
        "body 'table' of the world dropped: it has no joint",
    ):
        assert line in robot.overrides


def test_a_geom_of_the_robot_that_is_called_as_the_ground(tmp_path: Path) -> None:
    robot = build_toy(toy(tmp_path, inside='<geom name="floor" size="0.1"/>'))
    assert robot.spec.geom("robot_floor").parent.name == "base" and robot.physics.geom("floor").bodyid == 0
    assert "geom 'floor' is called 'robot_floor': the first name is one of ours" in robot.overrides


def test_of_keyframes_home_or_the_only_one_is_read(tmp_path: Path) -> None:
    def keys(*names: str, qpos: str = "0 0 0.4 1 0 0 0 0.1 0.2") -> RobotModel:
        return build_toy(
            toy(
                tmp_path,
                extra=f"<keyframe>{''.join(f'<key name={name!r} qpos={qpos!r}/>' for name in names)}</keyframe>",
            )
        )

    for robot in (keys("sit", "home"), keys("sit")):
        assert robot.pose == (0.1, 0.2) and robot.keyframe is not None and robot.keyframe.height == 0.4
    assert keys("sit", "lie").pose == (0.0, 0.0) and "keyframe 'lie' dropped" in keys("sit", "lie").overrides
    assert "keyframe 'home' dropped" in " ".join(keys("home", qpos="0 0 1").overrides)


def test_what_a_files_defaults_say_is_not_of_what_is_added(tmp_path: Path) -> None:
    defaults = (
        '<default><geom margin="0.01" solref="0.1 1"/><motor gear="7" ctrlrange="-1 1" forcerange="-1 1"/></default>'
    )
    robot = build_toy(toy(tmp_path, extra=defaults))
    floor, foot = robot.physics.geom("floor"), robot.physics.geom("left_foot")
    assert (floor.margin[0], floor.solref[0], foot.margin[0]) == (0.0, 0.02, 0.01)
    assert (robot.physics.actuator_gear[:, 0] == 1).all() and not robot.physics.actuator_forcelimited.any()
    defaults = """<default><geom surfacevel="1 0 0"/>
        <motor armature="0.1" damping="0.5" delay="0.01" nsample="3"/></default>"""
    model = build_toy(toy(tmp_path, extra=defaults)).physics
    assert not model.actuator_armature.any() and not model.actuator_damping.any() and not model.actuator_delay.any()
    assert not model.geom_surfacevel[model.geom("floor").id].any()


def test_a_flag_of_the_file_switches_nothing_of_the_robot_off(tmp_path: Path) -> None:
    flags = "constraint equality frictionloss limit contact spring damper gravity clampctrl actuation sensor"
    switches = " ".join(f'{flag}="disable"' for flag in flags.split())
    robot = build_toy(toy(tmp_path, extra=f"<option><flag {switches} warmstart='disable'/></option>"))
    bits = mujoco.mjtDisableBit
    assert robot.physics.opt.disableflags == bits.mjDSBL_EULERDAMP | bits.mjDSBL_WARMSTART
    assert not any(line.startswith("warning: gravity") for line in robot.overrides)
    light = build_toy(toy(tmp_path, extra='<option gravity="0 0 -3.7"/>'))
    assert light.physics.opt.gravity[2] == -3.7
    assert any(line.startswith("warning: gravity") and "-3.7" in line for line in light.overrides)


def test_ties_to_the_world_are_dropped(tmp_path: Path) -> None:
    ties = """<contact><pair name="p" geom1="shell" geom2="left_foot"/><exclude body1="base" body2="left_leg"/></contact>
      <equality><weld name="hook" body1="base"/><joint name="couple" joint1="left_hip" joint2="right_hip"/></equality>"""
    robot = build_toy(toy(tmp_path, extra=ties))
    assert robot.physics.neq == 1 and robot.physics.npair == 0 and robot.physics.nexclude == 1
    assert "equality 'hook' dropped: it holds 'base' to the world" in robot.overrides


def test_a_frictionless_flight(tmp_path: Path) -> None:
    """A joint's default holds for a <joint type="free"> too, where it would brake the robot in the air."""
    robot = build_toy(toy(tmp_path, root='<joint type="free" damping="0.5" armature="0.1" frictionloss="0.2"/>'))
    model = robot.physics
    assert not (model.dof_damping[:6].any() or model.dof_armature[:6].any() or model.dof_frictionloss[:6].any())
    assert {
        "free joint damping: 0.5 -> 0",
        "free joint armature: 0.1 -> 0",
        "free joint frictionloss: 0.2 -> 0",
    } <= set(robot.overrides)


# ---- held joints


def test_a_joint_is_held_at_its_default() -> None:
    held, whole = env_of("g1_held_style").robot, env_of("g1_29dof_style").robot
    assert held.joint_names == whole.joint_names[:12] and held.held == whole.joint_names[12:]
    places = []
    for robot in (held, whole):
        model = visual_model(robot)  # what is stepped has no geoms that touch nothing
        data = mujoco.MjData(model)
        data.qpos[:] = [0, 0, 1, 1, 0, 0, 0, *robot.pose]
        mujoco.mj_forward(model, data)
        places.append(
            {
                name: data.geom(name).xpos.copy()
                for name in ("head", "left_wrist_yaw_link_0", "right_shoulder_yaw_link_0")
            }
        )
    for name, place in places[0].items():
        np.testing.assert_allclose(place, places[1][name], atol=1e-9, err_msg=name)


def test_a_held_joint_takes_actuator_and_keyframe_with_it() -> None:
    env = make("go2_style", **{"asset.held_joints": ["*_calf_joint"]})
    assert env.num_actions == 8 and env.robot.pose == (0.0, 0.9) * 4 and env.robot.physics.nu == 8
    assert "joint 'FL_calf_joint' held at -1.8 rad" in env.robot.overrides
    assert env.robot.effort_range[:, 1].tolist() == [24] * 8


def test_held_joints_within_frames_and_with_others_on_their_body(tmp_path: Path) -> None:
    arm = """<frame pos="0 0.3 0" euler="0 0 90"><body name="arm" pos="0.1 0 0" euler="0 30 0">
      <joint name="a" axis="1 0 0" pos="0 0 0.1"/><joint name="b" axis="0 1 0"/><geom name="hand" size="0.02" pos="0.1 0.1 0.1"/>
      </body></frame>"""
    file, places = toy(tmp_path, inside=arm), []
    table = {
        "stiffness": {"": 1.0},
        "damping": {"": 1.0},
        "pose": {"": 0.3, "b": 0.7},
        "colliders": ["hand"],
        "contact_geoms": [],
    }
    for held in ([], ["a"], ["a", "b"]):
        robot = build_toy(file, held_joints=held, **table)
        data = mujoco.MjData(robot.physics)
        data.qpos[7:] = robot.pose
        mujoco.mj_kinematics(robot.physics, data)
        places.append(data.geom("hand").xpos - data.xpos[1])
    np.testing.assert_allclose(places[1], places[0], atol=1e-9)
    np.testing.assert_allclose(places[2], places[0], atol=1e-9)


def test_a_reward_about_held_joints_leaves_them_out() -> None:
    """So that one config serves 29 joints and 12."""
    hips = {"rewards.scales.hip_pos": -1.0, "rewards.hip_joints": ["hip_roll", "waist_*", "wrist"]}
    env, whole = make("g1_held_style", **hips), make("g1_29dof_style", **hips)
    named = [
        [robot.joint_names[i] for i in indices] for robot, indices in ((env.robot, env.hips), (whole.robot, whole.hips))
    ]
    assert named[0] == ["left_hip_roll_joint", "right_hip_roll_joint"] and len(named[1]) == 2 + 3 + 6
    said = "rewards.hip_joints: 'waist_*' left out, as waist_yaw_joint, waist_roll_joint, waist_pitch_joint are held"
    assert said in env.robot.overrides and not any("hip_joints" in line for line in whole.robot.overrides)
    nothing = make("g1_held_style", **{**hips, "rewards.hip_joints": ["wrist"]})
    nothing.step(torch.ones(2, 12))
    assert nothing._reward_hip_pos().tolist() == [0.0, 0.0]


# ---- the IMU


def test_a_turned_imu_reads_in_the_roots_axes() -> None:
    """Velocity, rates, gravity and acceleration at the site, against MuJoCo's own sensors at the turned site of the file."""
    env = make("g1_12dof_style", **EXACT)
    robot = env.robot
    spec = mujoco.MjSpec.from_file(str(HERE / "g1_12dof_style.xml"))
    for key, kind in (("v", "VELOCIMETER"), ("w", "GYRO"), ("a", "ACCELEROMETER")):
        spec.add_sensor(
            name=key, type=getattr(mujoco.mjtSensor, f"mjSENS_{kind}"), objtype=mujoco.mjtObj.mjOBJ_SITE, objname="imu"
        )
    file = spec.compile()
    data, ours = mujoco.MjData(file), mujoco.MjData(robot.physics)
    # the site's axes in the root's: 90 degrees about z
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for each in (data, ours):
        each.qpos[:] = [0, 0, 3, 0.9, 0.1, 0.3, 0.2, *robot.pose]
        each.qpos[3:7] /= np.linalg.norm(each.qpos[3:7])
        each.qvel[:6] = [0.3, -0.2, 0.1, 1.0, -2.0, 0.5]
    for model, each in ((file, data), (robot.physics, ours)):
        model.dof_damping[:], model.dof_frictionloss[:] = 0.0, 0.0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONTACT
        model.dof_armature[6:] = 0.01
        model.dof_armature[:6] = 0.0
        mujoco.mj_forward(model, each)
    env.sim.qpos[:], env.sim.qvel[:] = torch.tensor(ours.qpos), torch.tensor(ours.qvel)
    env._refresh_base()
    np.testing.assert_allclose(env.base_lin_vel[0], turn @ data.sensor("v").data, atol=1e-5)
    np.testing.assert_allclose(env.base_ang_vel[0], turn @ data.sensor("w").data, atol=1e-5)
    acceleration = ours.sensordata[robot.sensors["accelerometer"]]
    assert np.abs(acceleration).max() > 0.3
    np.testing.assert_allclose(acceleration, turn @ data.sensor("a").data, atol=1e-4)


def test_an_imu_beyond_a_joint_is_made_at_the_root_unless_it_is_asked_for(tmp_path: Path) -> None:
    text = (HERE / "g1_29dof_style.xml").read_text()
    (tmp_path / "robot.xml").write_text(text.replace('"imu_in_torso"', '"imu"'))  # as Unitree's file has it
    robot = make("g1_29dof_style", **{"asset.file": str(tmp_path / "robot.xml"), "asset.imu_site": ""}).robot
    assert robot.imu == "imu_root" and robot.physics.site("imu_root").pos.tolist() == [0.0, 0.0, 0.0]
    said = "site 'imu_root' made at the origin of 'pelvis': 'imu' is on body 'torso_link', which moves against the root 'pelvis' by joint "
    assert said + "'waist_pitch_joint'; imu_site may name another" in robot.overrides
    held = make("g1_held_style", **{"asset.file": str(tmp_path / "robot.xml"), "asset.imu_site": ""}).robot
    assert held.imu == "imu_aligned"


# ---- meshes


def brick(path: Path) -> None:
    """A binary STL of a tetrahedron."""
    corners = [(0.0, 0.0, 0.0), (0.2, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.2)]
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    path.parent.mkdir(parents=True, exist_ok=True)
    triangles = b"".join(struct.pack("<12fH", 0, 0, 0, *(x for i in face for x in corners[i]), 0) for face in faces)
    path.write_bytes(b"\0" * 80 + struct.pack("<I", len(faces)) + triangles)


LINK = '<link name="{0}"><inertial><mass value="{1}"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial>{2}</link>'
HINGE = '<joint name="hip" type="revolute"><parent link="base"/><child link="leg"/><axis xyz="0 1 0"/><limit lower="-1" upper="1"/></joint>'


def urdf(file: Path, base: str = "", leg: str = "", more: str = "") -> Path:
    shape = "<collision><geometry><sphere radius='0.1'/></geometry></collision>"
    text = LINK.format("base", 5, base or shape) + LINK.format("leg", 1, leg or shape) + HINGE + more
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f'<?xml version="1.0"?><!-- <mujoco> --><robot name="mini"><gazebo/>{text}</robot>')
    return file


def part(kind: str, mesh: str) -> str:
    return f"<{kind}><geometry><mesh filename='{mesh}'/></geometry></{kind}>"


def build(file: Path) -> RobotModel:
    return build_toy(file, colliders=["leg"], contact_geoms=["leg"], sites={}, imu_site="")


def test_a_mesh_that_gives_no_mass_is_looks(tmp_path: Path) -> None:
    looks = '<geom type="mesh" mesh="hull" contype="0" conaffinity="0"/>'
    asset = '<asset><mesh name="hull" file="hull.stl"/></asset>'
    robot = build_toy(toy(tmp_path, inside=looks.replace("/>", ' mass="0"/>'), extra=asset))
    assert "looks left out (no such file): hull.stl" in robot.overrides
    (tmp_path / "hull.stl").write_text("solid of words, which MuJoCo does not read")
    robot = build_toy(toy(tmp_path, inside=looks.replace("/>", ' mass="0"/>'), extra=asset))
    assert any(line.startswith("looks left out (") and "hull.stl" in line for line in robot.overrides)


def test_a_skin_that_is_missing_is_left_out(tmp_path: Path) -> None:
    """It was called "not a valid MJCF", as missing meshes once were."""
    file = toy(tmp_path, extra='<asset><skin name="fur" file="fur.skn"/></asset>')
    assert "looks left out (no such file): fur.skn" in build_toy(file).overrides


def test_inertias_that_all_come_from_geoms_do(tmp_path: Path) -> None:
    """Also of looks, which are not stepped, and in the place of what is written; MuJoCo alone leaves no looks out of such a file."""
    inside = '<geom size="0.05" pos="0.2 0 0" contype="0" conaffinity="0" mass="1"/><inertial pos="0 0 0" mass="9" diaginertia="1 1 1"/>'
    file = toy(tmp_path, inside=inside, extra='<compiler inertiafromgeom="true"/>')
    ours, theirs = build_toy(file).physics, mujoco.MjModel.from_xml_path(str(file))
    assert ours.body_mass[1] == 3.0 and ours.body_ipos[1, 0] == pytest.approx(0.2 / 3)
    np.testing.assert_allclose(ours.body_inertia, theirs.body_inertia, rtol=1e-6)


@pytest.mark.parametrize(
    "place",
    [
        "meshes/leg.stl",
        "../mini_description/meshes/leg.stl",
        "../../mini_description/meshes/leg.stl",
        "leg.stl",
        "../../../meshes/leg.stl",
    ],
)
def test_package_paths_are_found_near_the_file(tmp_path: Path, place: str) -> None:
    file = tmp_path / "a/b/c/mini.urdf"
    brick((file.parent / place).resolve())
    names = "package://mini_description/meshes/leg.stl"
    robot = build(urdf(file, leg=part("collision", names) + part("visual", names)))
    assert robot.physics.geom("leg_0").type[0] == mujoco.mjtGeom.mjGEOM_MESH and robot.physics.nmesh == 1
    assert not any("left out" in line for line in robot.overrides) and visual_model(robot).ngeom == 4


def test_meshes_of_a_urdf_for_mujoco_are_found_in_its_meshdir_and_may_be_scaled(tmp_path: Path) -> None:
    brick(tmp_path / "parts/leg.stl")
    one = part("collision", "leg.stl")
    text = '<mujoco><compiler meshdir="parts" balanceinertia="true"/></mujoco>'
    robot = build(urdf(tmp_path / "mini.urdf", leg=one + one.replace("leg.stl'", "leg.stl' scale='1 -1 2'"), more=text))
    sizes = [
        np.ptp(robot.physics.mesh_vert[robot.physics.mesh_vertadr[i] :][:4], axis=0).max()
        for i in range(robot.physics.nmesh)
    ]
    assert robot.physics.nmesh == 2 and max(sizes) > 1.3 * min(sizes)


def test_two_meshes_of_one_name_are_two(tmp_path: Path) -> None:
    for folder in ("visual", "collision"):
        brick(tmp_path / folder / "leg.stl")
    robot = build(
        urdf(tmp_path / "mini.urdf", leg=part("visual", "visual/leg.stl") + part("collision", "collision/leg.stl"))
    )
    assert sorted(Path(mesh.file).parent.name for mesh in robot.spec.meshes) == ["collision", "visual"]


# ---- URDF


def test_a_macro_in_a_comment_is_none(tmp_path: Path) -> None:
    assert build(urdf(tmp_path / "mini.urdf", more="<!-- from <xacro:include/> -->")).root == "base", (
        "a comment is no macro"
    )


def test_looks_of_no_size_are_left_out(tmp_path: Path) -> None:
    """MuJoCo spoke of a geom without a name."""
    point, box = (
        "<{0}><geometry><" + shape + "/></geometry></{0}>"
        for shape in ("sphere radius='0.0'", "box size='0.1 0.1 0.2'")
    )
    file = urdf(tmp_path / "mini.urdf", leg=point.format("visual") + box.format("visual") + box.format("collision"))
    robot = build(file)
    assert "looks left out (of size 0): those of link 'leg'" in robot.overrides and visual_model(robot).ngeom == 4


def test_a_link_world_is_dropped(tmp_path: Path) -> None:
    world = '<link name="world"/><joint name="stand" type="fixed"><parent link="world"/><child link="base"/></joint>'
    robot = build(urdf(tmp_path / "mini.urdf", more=world))
    assert robot.root == "base" and robot.physics.nq == 8
    assert {"link 'world' and joint 'stand' dropped: the root is free", "free joint added to 'base'"} <= set(
        robot.overrides
    )


@pytest.mark.parametrize(
    ("kind", "origin", "root"),
    [("floating", "", "base"), ("fixed", '<origin xyz="0 0 0.4"/>', "base"), ("fixed", "", "odom")],
)
def test_an_empty_link_that_is_elsewhere_is_dropped(tmp_path: Path, kind: str, origin: str, root: str) -> None:
    """As base_footprint is, on the ground: heights are of the base. A dummy root in the same place stays."""
    odom = f'<link name="odom"/><joint name="there" type="{kind}"><parent link="odom"/><child link="base"/>{origin}</joint>'
    world = '<link name="world"/><joint name="stand" type="fixed"><parent link="world"/><child link="odom"/></joint>'
    for more in (odom, odom + world):
        robot = build(urdf(tmp_path / "mini.urdf", more=more))
        assert robot.root == root and robot.physics.nq == 8
        assert ("link 'odom' and joint 'there' dropped: the root is free" in robot.overrides) == (root == "base")


def test_a_joint_that_mimics_moves_by_itself(tmp_path: Path) -> None:
    file = urdf(tmp_path / "mini.urdf")
    name = build(file).joint_names[0]
    file.write_text(file.read_text().replace("</joint>", '<mimic joint="other"/></joint>'))
    assert f"mimic dropped: {name} are independent joints" in build(file).overrides


def test_a_root_without_a_name_gets_one(tmp_path: Path) -> None:
    file = toy(tmp_path)
    file.write_text(file.read_text().replace('<body name="base"', "<body"))
    robot = build_toy(file)
    assert robot.root == "base" and "body without a name, the root, is called 'base'" in robot.overrides


def test_a_pose_beyond_a_range_is_a_warning(tmp_path: Path) -> None:
    file = toy(tmp_path)
    file.write_text(file.read_text().replace("<worldbody>", '<compiler angle="radian"/><worldbody>'))
    over = build_toy(file, pose={"": 0.0, "left": 1.5}).overrides
    assert [line for line in over if "beyond" in line] == [
        "warning: in the pose left_hip stands at 1.5 rad, beyond its range from -1 to 1 rad"
    ]
    for end in (1.0001, -1.0001):  # rounding is no reason
        assert not any("beyond" in line for line in build_toy(file, pose={"": end}).overrides)


def test_files_of_an_attached_robot_and_of_a_stripped_path_are_found(tmp_path: Path) -> None:
    """They are not where the file's own meshdir and texturedir say."""
    brick(tmp_path / "arm/parts/hull.stl")
    (tmp_path / "arm/arm.xml").write_text(
        '<mujoco model="arm"><compiler meshdir="parts"/><asset><mesh name="hull" file="hull.stl"/></asset><worldbody><body name="arm">'
        '<geom type="mesh" mesh="hull" mass="0.1"/></body></worldbody></mujoco>'
    )
    inside = '<frame><attach model="arm" body="arm" prefix="its_"/></frame>'
    robot = build_toy(toy(tmp_path, inside=inside, extra='<asset><model name="arm" file="arm/arm.xml"/></asset>'))
    assert robot.spec.compile().nmesh == 1 and not any("left out" in line for line in robot.overrides)
    (tmp_path / "own").mkdir()
    save_png(tmp_path / "own/wood.png", np.full((4, 4, 3), 255, dtype=np.uint8))
    looks = '<geom type="box" size="0.1 0.1 0.1" material="wood" mass="0" contype="0" conaffinity="0"/>'
    asset = (
        '<asset><texture name="wood" type="2d" file="theirs/wood.png"/><material name="wood" texture="wood"/></asset>'
    )
    file = toy(tmp_path, inside=looks, extra='<compiler strippath="true" texturedir="own"/>' + asset)
    robot = build_toy(file)
    assert visual_model(robot).ntex and not any("left out" in line for line in robot.overrides)
    (tmp_path / "own/wood.png").unlink()
    assert "looks left out (no such file): theirs/wood.png" in build_toy(file).overrides


def test_a_training_says_its_warnings_once(tmp_path: Path) -> None:
    go1 = (ROOT / "resources/robots/go1/go1.xml").read_text()
    (tmp_path / "bare.xml").write_text(go1.replace(' actuatorfrcrange="-35.55 35.55"', ' actuatorfrcrange="0 0"'))
    result = run("train", tmp_path, *SMALL, "--set", f"asset.file={tmp_path / 'bare.xml'}", "--max_iterations", "1")
    assert result.code == 0, result.err
    text = "warning: nothing limits the force of FR_calf_joint, FL_calf_joint, RR_calf_joint, RL_calf_joint: these servos are "
    assert result.out.count(text + "stronger than any motor; set effort\n") == 1


STEPS_WITHOUT = """
import sys
sys.modules["legged_mw.robot"] = None  # an import of it fails
import torch
from legged_mw.utils.task import load_task
for name in ("go1_flat", "g1_flat"):
    task = load_task(name)
    task.set("env.num_envs", 2)
    env = task.env_class(task.cfg, "cpu")
    env.step(torch.zeros(2, env.num_actions))
"""


def test_a_plain_mjcf_is_loaded_without_the_package_for_others() -> None:
    subprocess.run([sys.executable, "-c", STEPS_WITHOUT], check=True, cwd=ROOT)


def test_a_file_is_plain_or_read_by_the_package(tmp_path: Path) -> None:
    for file in (ROOT / "resources/robots").glob("*/*.xml"):
        plain, other = read_plain(file), read_robot(file)
        assert plain and plain.spec.to_xml() == other.spec.to_xml()
        assert (plain.notes, plain.limits, plain.keyframe) == (other.notes, other.limits, other.keyframe)
    text = (ROOT / "resources/robots/go1/go1.xml").read_text()
    for more in (
        "<sensor><gyro name='g' site='imu'/></sensor>",
        "<actuator><motor joint='FR_hip_joint'/></actuator>",
        "<worldbody><light/></worldbody>",
        "<worldbody><geom type='plane' size='1 1 1'/></worldbody>",
        "<compiler inertiafromgeom='true'/>",
        "<default><geom friction='2'/></default>",
        "<asset><material name='floor'/></asset>",
    ):
        (tmp_path / "go1.xml").write_text(text.replace("</mujoco>", f"{more}</mujoco>"))
        assert read_plain(tmp_path / "go1.xml") is None
        assert read_file(tmp_path / "go1.xml").root == "trunk"
