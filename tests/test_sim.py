"""The simulator seam: what build_model makes of an MJCF and of mistakes, and what both engines promise about their views."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from mujoco_warp import OverflowType

from legged_mw import ROOT
from legged_mw.drawing.scene import visual_model
from legged_mw.sim.engines import make_simulation, pick_engine
from legged_mw.sim.ground import GROUND, Ground
from legged_mw.sim.joints import per_joint
from legged_mw.sim.mirror import find_partners
from legged_mw.sim.model import RobotModel, Solver, build_model
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.errors import ModelError

GO1 = ROOT / "resources/robots/go1/go1.xml"
FEET = ["FR", "FL", "RR", "RL"]
JOINTS = [f"{leg}_{link}_joint" for leg in FEET for link in ("hip", "thigh", "calf")]
POSE = [0.1, 0.9, -1.8, -0.1, 0.9, -1.8] * 2
HOME = torch.tensor([0.0, 0.0, 0.278, 1.0, 0.0, 0.0, 0.0, *POSE])
VIEWS = ("qpos", "qvel", "ctrl", "sensordata", "actuator_force", "site_xpos", "xfrc_applied")
EXACT = Solver(iterations=100, ls_iterations=50)  # converged, so that figures do not depend on the solver


def go1(**choices: Any) -> RobotModel:
    """The Go1 as go1_flat builds it, with other choices where given."""
    defaults: dict[str, Any] = {
        "solver": Solver(),
        "ground": Ground(),
        "stiffness": {"joint": 35.0},
        "damping": {"joint": 0.5},
        "colliders": FEET,
        "self_collisions": False,
        "contact_geoms": FEET,
        "imu_site": "imu",
        "sites": {foot: [foot] for foot in FEET},
    }
    return build_model(choices.pop("file", GO1), **{**defaults, **choices})


LEG = """
<body name="{0}_leg" pos="0 {1} 0">
  <joint name="{0}_hip" axis="0 1 0" range="-1 1" damping="0.1"{2}/>
  <geom name="{0}_shin" type="capsule" size="0.01" fromto="0 0 0 0 0 -0.2" mass="0.3"/>
  <geom name="{0}_foot" type="sphere" size="0.02" pos="0 0 -0.2" mass="0.1"/>
  <site name="{0}_foot" pos="0 0 -0.2"/>
</body>"""


def toy(
    folder: Path, *, root: str = "<freejoint/>", inside: str = "", world: str = "", extra: str = "", limit: str = ""
) -> Path:
    """An MJCF of a box with a left and a right leg of one joint each, and whatever a test adds to it."""
    legs = LEG.format("left", 0.1, limit) + LEG.format("right", -0.1, limit)
    file = folder / "toy.xml"
    file.write_text(
        f"""<mujoco><worldbody>{world}<body name="base" pos="0 0 0.3">{root}
        <geom name="shell" type="box" size="0.1 0.05 0.05" mass="2"/><site name="imu"/>{inside}{legs}
        </body></worldbody>{extra}</mujoco>"""
    )
    return file


def build_toy(file: Path, **choices: Any) -> RobotModel:
    feet = ["left_foot", "right_foot"]
    defaults: dict[str, Any] = {"file": file, "stiffness": {"hip": 10.0}, "damping": {"hip": 0.2}, "colliders": feet}
    return go1(**{**defaults, "contact_geoms": feet, "sites": {foot: [foot] for foot in feet}, **choices})


def one_line(error: pytest.ExceptionInfo[ModelError]) -> str:
    text = str(error.value)
    assert "\n" not in text
    return text


# ---- gain tables


def test_table_gives_each_joint_its_own_value() -> None:
    table = {"hip": 1.0, "thigh": 2.0, "FR_calf": 3.0, "FL_calf": 4.0, "RR_calf": 5.0, "RL_calf": 6.0}
    assert per_joint(table, JOINTS, "gains") == [1, 2, 3, 1, 2, 4, 1, 2, 5, 1, 2, 6]


def test_of_keys_that_fit_the_longest_counts() -> None:
    joints = ["left_hip", "left_hip_yaw", "left_knee", "neck"]
    assert per_joint({"": 1.0, "hip": 2.0, "left": 3.0, "left_hip": 4.0}, joints, "gains") == [4, 4, 3, 1]
    assert per_joint({"hip_yaw": 5.0, "left_hip": 4.0, "left_hip_yaw": 6.0, "": 1}, joints, "gains") == [4, 6, 1, 1]
    assert per_joint({"hip": 1.0, "yaw": 2.0, "hip_yaw": 3.0}, ["hip_yaw"], "gains") == [3.0]
    assert per_joint({"": 7.0}, [], "gains") == []


# ---- names


def test_ids_by_name() -> None:
    robot = go1()
    assert (robot.root, robot.joint_names) == ("trunk", tuple(JOINTS))
    assert (
        robot.physics.geom(robot.id("geom", "RL")).name == "RL"
        and robot.physics.site(robot.id("site", "imu")).name == "imu"
    )


# ---- geoms without a name, sites that are made


SOLE = """
<body name="{0}_ankle" pos="0 {1} -0.3"><joint name="{0}_ankle" axis="0 1 0"/>
  <geom name="{0}_heel" type="box" size="0.03 0.02 0.01" pos="-0.05 0 0" mass="0.1"/>
  <geom name="{0}_toe" type="box" size="0.04 0.02 0.01" pos="0.06 0 0" mass="0.1"/>
  <body name="{0}_nail" pos="0.1 0 0.02"><geom name="{0}_nail" size="0.01" mass="0.01"/></body>
</body>"""
SOLES = SOLE.format("left", 0.1) + SOLE.format("right", -0.1)


def build_soles(folder: Path, **choices: Any) -> RobotModel:
    """The toy with a heel and a toe on a joint of its own at either side."""
    gains = {
        "stiffness": {"": 10.0},
        "damping": {"": 0.2},
        "contact_geoms": [],
        "colliders": ["*_heel"],
    }
    choices.setdefault("sites", {"left_sole": ["left_heel", "left_toe"]})
    return build_toy(toy(folder, inside=SOLES), **{**gains, **choices})


def test_what_may_touch_has_a_name(tmp_path: Path) -> None:
    shapes = (
        '<geom size="0.01"/><geom size="0.02" contype="0" conaffinity="0"/><body name="hand"><geom size="0.01"/></body>'
    )
    robot = build_toy(toy(tmp_path, inside=shapes), colliders=["base_1", "hand_*"], contact_geoms=["hand_0", "base_1"])
    assert robot.contact_geoms == ("hand_0", "base_1") and robot.physics.geom("base_1").conaffinity[0] == 1
    assert {
        "geom of 'base' without a name is called 'base_1'",
        "geom of 'hand' without a name is called 'hand_0'",
    } <= set(robot.overrides)
    assert len([line for line in robot.overrides if "without a name" in line]) == 2, "what is only looked at needs none"
    taken = toy(tmp_path, inside='<geom size="0.01"/><geom name="base_1" size="0.01"/>')
    assert "geom of 'base' without a name is called 'base_1_'" in build_toy(taken).overrides


def test_a_body_means_its_geoms_that_collide(tmp_path: Path) -> None:
    looks = '<geom name="shade" size="0.3" contype="0" conaffinity="0"/><body name="hand"><geom name="palm" size="0.01"/></body>'
    robot = build_toy(toy(tmp_path, inside=looks), colliders=["base", "*_leg"], contact_geoms=["left_leg", "ba*"])
    assert robot.contact_geoms == ("left_shin", "left_foot", "shell"), (
        "neither what is looked at nor what is on a child"
    )
    assert robot.names.find(["*"], "") == robot.names.geoms and robot.names.find(["*_foot"], "") == (
        "left_foot",
        "right_foot",
    )
    assert robot.names.find(["hand"], "") == ("palm",)
    touching = {robot.physics.geom(i).name for i in range(robot.physics.ngeom) if robot.physics.geom_conaffinity[i]}
    assert touching == {"shell", "left_shin", "left_foot", "right_shin", "right_foot"}
    same = toy(tmp_path, inside='<body name="left_foot"><geom name="thumb" size="0.01"/></body>')
    assert build_toy(same).names.find(["left_foot"], "") == ("left_foot",), "a geom wins over a body of its name"


def test_a_missing_site_is_made_at_its_geom(tmp_path: Path) -> None:
    file = toy(tmp_path, inside='<geom name="tail" type="capsule" size="0.01" fromto="-0.1 0 0 -0.3 0 0.1"/>')
    robot = build_toy(file, sites={"left_foot": ["left_shin"], "tail": ["tail"]})
    np.testing.assert_allclose(robot.physics.site("tail").pos, [-0.2, 0, 0.05], atol=1e-9)
    np.testing.assert_allclose(robot.physics.site("left_foot").pos, [0, 0, -0.2], atol=1e-9)  # the MJCF's own stays
    assert robot.site_geoms == {"tail": ("tail",), "left_foot": ("left_shin",)}
    assert "site 'tail' made at tail" in robot.overrides and not any(
        "'left_foot' made" in line for line in robot.overrides
    )
    data = mujoco.MjData(robot.physics)
    data.qvel[5] = 2.0  # [rad/s] about z
    mujoco.mj_forward(robot.physics, data)
    np.testing.assert_allclose(data.sensordata[robot.sensors["linvel"]][3:], [0.0, -0.4, 0.0], atol=1e-9)


@pytest.mark.parametrize(
    ("angle", "place"),
    [
        (0.0, (0.01, 0.0, -0.01)),  # both soles are level: the middle from the heel's end, -0.08, to the toe's, 0.1
        (0.5, (0.1, 0.0, -0.01)),  # toes down
        (-0.5, (-0.08, 0.0, -0.01)),
    ],
)
def test_of_several_geoms_the_lowest_point_is_the_site(tmp_path: Path, angle: float, place: tuple[float, ...]) -> None:
    robot = build_soles(tmp_path, pose={"ankle": angle, "": 0.0})
    np.testing.assert_allclose(robot.physics.site("left_sole").pos, place, atol=1e-6)
    site = robot.physics.site("left_sole").bodyid[0]
    assert robot.physics.body(site).name == "left_ankle"
    assert "site 'left_sole' made at the lowest point of left_heel, left_toe" in robot.overrides


def test_the_lowest_point_may_be_on_a_fixed_body_and_names_may_be_patterns(tmp_path: Path) -> None:
    # upside down
    robot = build_soles(tmp_path, pose={"ankle": -3.0, "": 0.0}, sites={"left_sole": ["left_t*", "left_nail"]})
    site = robot.physics.site("left_sole")
    assert (
        robot.site_geoms == {"left_sole": ("left_toe", "left_nail")}
        and robot.physics.body(site.bodyid[0]).name == "left_ankle"
    )
    # the nail is fused
    np.testing.assert_allclose(site.pos, [0.1 + 0.01 * math.sin(-3.0), 0, 0.02 - 0.01 * math.cos(-3.0)], atol=1e-6)


def test_left_and_right_soles_mirror(tmp_path: Path) -> None:
    sites = {f"{side}_sole": [f"{side}_heel", f"{side}_toe"] for side in ("left", "right")}
    robot = build_soles(tmp_path, pose={"ankle": 0.2, "": 0.0}, sites=sites)
    assert find_partners(robot, list(sites)).sites == (1, 0)


@pytest.mark.parametrize(
    ("shape", "lowest"),
    [
        ('type="sphere" size="0.05"', 0.05),
        ('type="capsule" size="0.02 0.1" euler="90 0 0"', 0.02),
        ('type="capsule" size="0.02 0.1"', 0.12),
        ('type="box" size="0.03 0.04 0.05" euler="90 0 0"', 0.04),
        ('type="cylinder" size="0.05 0.1" euler="90 0 0"', 0.05),
        ('type="ellipsoid" size="0.03 0.04 0.1"', 0.1),
        ('type="mesh" mesh="brick"', 0.07),
    ],
)
def test_the_lowest_point_of_every_shape(tmp_path: Path, shape: str, lowest: float) -> None:
    corners = " ".join(f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.07, 0.07))
    mesh = f'<asset><mesh name="brick" vertex="{corners}"/></asset>'
    geoms = f'<body name="hand"><geom name="a" {shape}/><geom name="b" size="0.001" pos="0 0 0.3"/></body>'
    robot = build_toy(toy(tmp_path, inside=geoms, extra=mesh), sites={"hand": ["a", "b"]}, self_collisions=True)
    np.testing.assert_allclose(robot.physics.site("hand").pos, [0.0, 0.0, -lowest], atol=1e-3)


# ---- servos


def test_servo_parameters() -> None:
    gains, dampings = {"hip": 20.0, "thigh": 30.0, "calf": 40.0}, {"hip": 0.5, "thigh": 0.6, "calf": 0.7}
    robot = go1(stiffness=gains, damping=dampings)
    for model in (robot.physics, visual_model(robot)):
        # servo i is joint i; joint 0 is free
        assert model.nu == 12 and (model.actuator_trnid[:, 0] == range(1, 13)).all()
        kp, kd = [20.0, 30.0, 40.0] * 4, [0.5, 0.6, 0.7] * 4
        assert model.actuator_gainprm[:, 0].tolist() == kp
        assert model.actuator_biasprm[:, :3].tolist() == [[0.0, -k, 0.0] for k in kp]
        assert (model.actuator_gear == [1, 0, 0, 0, 0, 0]).all()
        np.testing.assert_allclose(model.dof_damping, [0.0] * 6 + kd)
        limits = [23.7, 23.7, 35.55] * 4
        assert model.actuator_forcelimited.all() and (model.actuator_forcerange == [[-f, f] for f in limits]).all()
        assert model.actuator_ctrllimited.all() and (model.actuator_ctrlrange == model.jnt_range[1:]).all()
        assert not model.jnt_actfrclimited.any()  # the servo clamps, so that actuator_force is what acts
    assert robot.effort_range[:, 1].tolist() == limits and (robot.joint_range == robot.physics.jnt_range[1:]).all()
    assert (
        "FR_hip_joint servo: kp 20 N m/rad" in robot.overrides
        and "RL_calf_joint damping: 0.5 -> 0.7 N m s/rad" in robot.overrides
    )
    assert not any("hip_joint damping" in line for line in robot.overrides)  # 0.5 is what the MJCF has


def test_servos_act_as_written() -> None:
    """tau = clamp(kp (clamp(target) - q)), by C MuJoCo, floating; the damping is the joint's and not in tau."""
    model = go1().physics
    data = mujoco.MjData(model)
    data.qpos[:7], data.qpos[7:], data.qvel[6:] = [0, 0, 1, 1, 0, 0, 0], POSE, 1.0
    # fine; force too large; angle beyond the range, force then fine
    data.ctrl[:] = np.array(POSE) + [0.5, 1.0, 5.0] * 4
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.actuator_force, [17.5, 23.7, 35 * (-0.888 + 1.8)] * 4, rtol=1e-6)
    np.testing.assert_allclose(data.qfrc_passive[6:], -0.5, rtol=1e-6)


def test_actuators_of_the_mjcf_are_replaced(tmp_path: Path) -> None:
    """Their force limit is kept where the joint states none; through a gear it is the joint's that counts."""
    motors = """<actuator>
      <motor name="weak" joint="left_hip" forcerange="-7 7"/>
      <position name="servo" joint="right_hip" kp="3" gear="2" forcerange="-4 4"/>
    </actuator>"""
    robot = build_toy(toy(tmp_path, extra=motors))
    model = robot.physics
    assert [model.actuator(i).name for i in range(model.nu)] == ["left_hip", "right_hip"]
    assert model.actuator_gainprm[:, 0].tolist() == [10, 10] and (model.actuator_gear[:, 0] == 1).all()
    assert model.actuator_forcerange.tolist() == [[-7, 7], [-8, 8]] and robot.effort_range[:, 1].tolist() == [7, 8]
    assert "2 actuators replaced" in robot.overrides


def test_limit_of_the_joint_wins_over_the_actuators(tmp_path: Path) -> None:
    motors = '<actuator><motor joint="left_hip" forcerange="-7 7"/></actuator>'
    robot = build_toy(toy(tmp_path, extra=motors, limit=' actuatorfrcrange="-5 5"'))
    assert robot.effort_range[:, 1].tolist() == [5, 5] and robot.physics.actuator_forcerange.tolist() == [
        [-5, 5],
        [-5, 5],
    ]


def test_no_limit_stated_is_no_limit(tmp_path: Path) -> None:
    robot = build_toy(toy(tmp_path))
    assert robot.effort_range.tolist() == [[-math.inf, math.inf]] * 2 and not robot.physics.actuator_forcelimited.any()


# ---- the two models


def test_physics_model_is_the_visual_one_without_looks() -> None:
    robot = go1()
    bare, drawn = robot.physics, visual_model(robot)
    assert (bare.nlight, bare.nmesh) == (0, 0) and drawn.nlight == 1 and drawn.nmesh > 0
    kept = {bare.geom(i).name for i in range(bare.ngeom)}
    assert all(
        bare.geom(i).contype or bare.geom(i).conaffinity or bare.geom(i).name == GROUND for i in range(bare.ngeom)
    )
    assert set(FEET) | {GROUND} <= kept and drawn.ngeom > bare.ngeom
    assert (
        (bare.nq, bare.nv, bare.nu, bare.nsensordata)
        == (drawn.nq, drawn.nv, drawn.nu, drawn.nsensordata)
        == (19, 18, 12, 19)
    )
    for field in (
        "body_mass",
        "body_inertia",
        "body_ipos",
        "body_iquat",
        "dof_armature",
        "dof_frictionloss",
        "jnt_range",
        "body_invweight0",
    ):
        np.testing.assert_array_equal(getattr(bare, field), getattr(drawn, field), err_msg=field)


def test_options_are_written() -> None:
    model = go1(solver=Solver(0.002, 3, 7), ground=Ground(0.8, 6)).physics
    assert (model.opt.timestep, model.opt.iterations, model.opt.ls_iterations) == (0.002, 3, 7)
    assert model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    floor = model.geom(GROUND)
    assert (floor.friction[0], floor.condim[0], floor.priority[0]) == (0.8, 6, 1)


def test_links_without_a_name_may_overlap(tmp_path: Path) -> None:
    """They get one, for MuJoCo leaves out pairs by name."""
    hand = '<body pos="0 0 0.05"><joint name="hip_3" axis="0 1 0"/><geom name="hand" size="0.02"/></body>'
    arm = f'<body><joint name="hip_2"/><geom size="0.01" contype="0" conaffinity="0"/>{hand}</body>'
    robot = build_toy(toy(tmp_path, inside=arm), colliders=["*"], self_collisions=True)
    assert robot.physics.nexclude == 1
    assert "self-collisions left out, as they overlap in the pose: 'base' and 'body_of_hand'" in robot.overrides


def test_sensor_spans_after_the_mjcfs_own_sensors(tmp_path: Path) -> None:
    own = '<sensor><gyro name="gyro" site="imu"/><jointpos joint="left_hip"/><touch name="skin" site="imu"/><force site="imu"/></sensor>'
    robot = build_toy(toy(tmp_path, extra=own))
    assert robot.sensors == {"contact": slice(4, 6), "linvel": slice(6, 12), "accelerometer": slice(12, 15)}
    assert "sensors dropped, as nothing reads them: gyro, one without a name" in robot.overrides
    data = mujoco.MjData(robot.physics)
    mujoco.mj_forward(robot.physics, data)
    np.testing.assert_allclose(data.sensordata[robot.sensors["accelerometer"]], 0, atol=1e-9)  # falls freely
    few = build_toy(toy(tmp_path), contact_geoms=[], sites={})
    assert few.sensors == {"contact": slice(0, 0), "linvel": slice(0, 0), "accelerometer": slice(0, 3)}


# ---- who touches whom, by C MuJoCo


def contacts(robot: RobotModel, qpos: Any) -> set[frozenset[str]]:
    """Pairs of geoms that touch."""
    data = mujoco.MjData(robot.physics)
    data.qpos[:] = qpos
    mujoco.mj_forward(robot.physics, data)
    names = [robot.physics.geom(i).name for i in range(robot.physics.ngeom)]
    return {frozenset(names[g] for g in data.contact[i].geom) for i in range(data.ncon)}


# Hips turned inwards until right and left foot overlap; the trunk far up, or everything pressed into the ground.
CROSSED = [0.45, 0.9, -1.8, -0.45, 0.9, -1.8] * 2
HIGH, PRESSED = [0, 0, 2.0, 1, 0, 0, 0], [0, 0, 0.05, 1, 0, 0, 0]
ON_GROUND = {frozenset({GROUND, foot}) for foot in FEET}


def test_only_feet_touch_the_ground_and_nothing_touches_itself() -> None:
    robot = go1()
    assert contacts(robot, [*PRESSED, *POSE]) == ON_GROUND
    assert contacts(robot, [*HIGH, *CROSSED]) == set()
    assert any(line.startswith("collisions off: trunk_box, ") for line in robot.overrides)


def test_self_collisions_are_among_the_colliders() -> None:
    robot = go1(self_collisions=True)
    assert contacts(robot, [*HIGH, *CROSSED]) == {frozenset({"FR", "FL"}), frozenset({"RR", "RL"})}
    assert contacts(robot, [*PRESSED, *POSE]) == ON_GROUND


def test_patterns_name_colliders() -> None:
    everything = contacts(go1(colliders=["*"]), [*PRESSED, *POSE])
    assert everything > ON_GROUND and frozenset({GROUND, "trunk_box"}) in everything
    assert all(GROUND in pair for pair in everything)
    assert contacts(go1(colliders=["F?", "trunk_*"], contact_geoms=[]), [*PRESSED, *POSE]) == {
        frozenset({GROUND, name}) for name in ("FR", "FL", "trunk_box", "trunk_left", "trunk_right")
    }


def test_friction_of_the_ground_wins(tmp_path: Path) -> None:
    """MuJoCo takes the larger of two frictions unless one geom has priority; the feet have 1."""
    for ground in (Ground(0.3, 3), Ground(1.7, 1), Ground(0.6, 6)):
        robot = go1(ground=ground)
        data = mujoco.MjData(robot.physics)
        data.qpos[:] = HOME
        mujoco.mj_forward(robot.physics, data)
        assert data.ncon == 4
        for contact in data.contact:
            assert contact.dim == ground.condim and contact.friction[0] == contact.friction[1] == ground.friction


# ---- both engines


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return go1()


@pytest.fixture(params=["mujoco_warp", "mujoco"])
def engine(request: pytest.FixtureRequest) -> str:
    return request.param


def simulate(robot: RobotModel, engine: str, num_envs: int = 3, **options: Any) -> Any:
    """Worlds that stand in the home pose with their servos on it."""
    sim = make_simulation(robot.physics, num_envs, "cpu", engine=engine, **{"nconmax": 8, "njmax": 40, **options})
    stand(sim, torch.ones(num_envs, dtype=torch.bool))
    return sim


def stand(sim: Simulation, mask: torch.Tensor) -> None:
    sim.qpos[mask], sim.qvel[mask], sim.ctrl[mask] = HOME, 0.0, HOME[7:]


def snapshot(sim: Simulation) -> dict[str, torch.Tensor]:
    return {name: getattr(sim, name).clone() for name in VIEWS}


def assert_same(
    a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], worlds: Any = slice(None), where: str = ""
) -> None:
    """Bit for bit."""
    for name in VIEWS:
        assert torch.equal(a[name][worlds], b[name][worlds]), f"{name} {where}"


def assert_close(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], rtol: float = 0.0, atol: float = 0.0) -> None:
    for name in VIEWS:
        torch.testing.assert_close(
            a[name], b[name], rtol=rtol, atol=atol, msg=lambda text, name=name: f"{name}: {text}"
        )


def copy_state(target: Simulation, source: Simulation) -> None:
    target.qpos.copy_(source.qpos)
    target.qvel.copy_(source.qvel)


def test_shapes(robot: RobotModel, engine: str) -> None:
    sim = simulate(robot, engine)
    shapes = [(3, 19), (3, 18), (3, 12), (3, 19), (3, 12), (3, 6, 3), (3, 14, 6)]
    assert [tuple(getattr(sim, name).shape) for name in VIEWS] == shapes
    assert all(getattr(sim, name).dtype == torch.float32 for name in VIEWS)
    assert (sim.engine, sim.num_envs, sim.device) == (engine, 3, "cpu")


def test_which_engine_steps() -> None:
    assert [pick_engine("auto", device) for device in ("cpu", "cuda:1")] == ["mujoco", "mujoco_warp"]
    assert pick_engine("mujoco_warp", "cpu") == "mujoco_warp"


def test_views_stay(robot: RobotModel, engine: str) -> None:
    sim = simulate(robot, engine)
    views = {name: getattr(sim, name) for name in VIEWS}
    memory, before = {name: view.data_ptr() for name, view in views.items()}, snapshot(sim)
    sim.step(5)
    sim.reset(torch.tensor([True, False, False]))
    sim.step(5)
    for name in VIEWS:
        assert getattr(sim, name) is views[name] and views[name].data_ptr() == memory[name], name
        if engine == "mujoco_warp":
            assert memory[name] == getattr(sim._data, name).ptr, name  # the simulator's own
    changed = [name for name in VIEWS if not torch.equal(views[name], before[name])]
    assert set(changed) >= {"qpos", "qvel", "sensordata", "actuator_force", "site_xpos", "ctrl"}


def test_it_repeats_bit_for_bit_on_any_number_of_threads(robot: RobotModel, engine: str) -> None:
    one, other = simulate(robot, engine, 7, threads=1), simulate(robot, engine, 7, threads=3)
    for step in range(10):
        for sim in (one, other):
            sim.ctrl[:] = HOME[7:] + 0.1 * math.sin(step) * torch.arange(7)[:, None] / 7
            sim.step(5)
        assert_same(snapshot(one), snapshot(other), where=f"step {step}")


def test_reset_touches_masked_worlds_alone(robot: RobotModel, engine: str) -> None:
    sim, undisturbed = simulate(robot, engine, 4), simulate(robot, engine, 4)
    mask = torch.tensor([True, False, True, False])
    for s in (sim, undisturbed):
        s.xfrc_applied[:, 1, 0] = 5.0
        s.step(5)
    before = snapshot(sim)
    for name in ("sensordata", "actuator_force", "site_xpos", "xfrc_applied"):
        assert (before[name].flatten(1) != 0).any(dim=1).all(), f"{name} must hold something to clear"
    sim.reset(mask)
    after = snapshot(sim)
    assert_same(after, before, ~mask)
    for name in ("sensordata", "actuator_force", "site_xpos", "xfrc_applied", "qvel", "ctrl"):
        assert (after[name][mask] == 0).all(), name
    assert torch.equal(after["qpos"][mask], torch.tensor(robot.physics.qpos0, dtype=torch.float).expand(2, -1))
    for _ in range(3):  # nor is anything hidden touched: the others' future is the same
        for s in (sim, undisturbed):
            s.step(5)
    assert_same(snapshot(sim), snapshot(undisturbed), ~mask)


def test_broken_world_is_as_new_after_a_reset(robot: RobotModel, engine: str) -> None:
    """Not a NaN survives, neither in a view nor in what the solver remembers; the neighbours never notice."""
    sim, undisturbed = simulate(robot, engine), simulate(robot, engine)
    mask = torch.tensor([False, True, False])
    sim.qpos[1], sim.qvel[1] = math.nan, math.nan
    for s in (sim, undisturbed):
        s.step(5)
        s.step(5)
    for name in ("qpos", "qvel", "sensordata", "site_xpos"):
        assert getattr(sim, name)[1].isnan().any(), name
    assert_same(snapshot(sim), snapshot(undisturbed), ~mask)
    sim.reset(mask)
    assert all(torch.isfinite(getattr(sim, name)).all() for name in VIEWS)
    stand(sim, mask)
    new = simulate(robot, engine)
    for step in range(5):
        sim.step(5)
        new.step(5)
        assert_same(snapshot(sim), snapshot(new), mask, where=f"step {step}")
    assert torch.isfinite(sim.qpos).all() and torch.isfinite(sim.sensordata).all()


def test_sensors_are_those_of_the_last_substep(robot: RobotModel, engine: str) -> None:
    """mujoco-warp leaves them out of the other four; that changes neither them nor the motion. MuJoCo's own engine rounds to
    float32 between calls, so there five single steps are five times as rough as one of five."""
    close = {} if engine == "mujoco_warp" else {"rtol": 1e-3, "atol": 2e-3}
    sim, every = simulate(robot, engine), simulate(robot, engine)
    for _ in range(10):
        sim.step(5)
        for _ in range(5):
            every.step(1)
        assert_close(snapshot(sim), snapshot(every), **close)
        copy_state(every, sim)
    before = sim.sensordata.clone()
    sim.step(1)  # another number of substeps, recorded on its own
    every.step(1)
    assert_close(snapshot(sim), snapshot(every), **close)
    assert not torch.equal(sim.sensordata, before)


def test_forces_push(robot: RobotModel, engine: str) -> None:
    """xfrc_applied is a force [N] in the world frame and persists: F t / m in free flight."""
    sim = simulate(robot, engine)
    sim.qpos[:, 2] = 3.0
    sim.xfrc_applied[1, robot.id("body", "trunk"), :3] = torch.tensor([10.0, 0.0, 0.0])
    for _ in range(5):
        sim.step(5)
    mass, momentum = robot.physics.body_subtreemass[0], 10.0 * 25 * robot.physics.opt.timestep
    # legs swing, hence the margin
    assert sim.qvel[1, 0] > 0.5 * momentum / mass and abs(sim.qvel[0, 0]) < 0.1 * momentum / mass


# ---- per-world fields


def test_fields_are_views_per_world(robot: RobotModel, engine: str) -> None:
    sim = simulate(robot, engine, world_fields=["body_mass", "geom_friction"])
    mass, friction = sim.field("body_mass"), sim.field("geom_friction")
    assert mass.shape == (3, 14) and mass.dtype == torch.float32 and friction.shape == (3, robot.physics.ngeom, 3)
    assert torch.equal(mass, torch.tensor(robot.physics.body_mass, dtype=torch.float).expand(3, -1))
    np.testing.assert_allclose(friction, np.broadcast_to(robot.physics.geom_friction, friction.shape), rtol=1e-6)


def test_heavier_robot_sags_further(engine: str) -> None:
    """And as far as C MuJoCo says, in its own world only."""
    robot = go1(solver=EXACT)
    trunk, extra = robot.id("body", "trunk"), torch.tensor([0.0, 3.0, 6.0])  # [kg]
    sim = simulate(robot, engine, world_fields=["body_mass"])
    sim.field("body_mass")[:, trunk] += extra
    heights = []
    for added in extra.tolist():
        robot.physics.body_mass[trunk] += added
        data = mujoco.MjData(robot.physics)
        data.qpos[:], data.ctrl[:] = HOME, HOME[7:]
        mujoco.mj_step(robot.physics, data, 50)
        robot.physics.body_mass[trunk] -= added
        heights.append(data.qpos[2])
    for _ in range(10):
        sim.step(5)
    assert heights[0] > heights[1] + 0.003 > heights[2] + 0.006
    np.testing.assert_allclose(sim.qpos[:, 2], heights, atol=1e-5)


def test_less_friction_slides_further(engine: str) -> None:
    """v^2 / (2 mu g), to a fifth: the robot is not a block, but its servos are stiff here."""
    robot = go1(solver=EXACT, stiffness={"joint": 200.0}, damping={"joint": 1.5})
    sim = simulate(robot, engine, world_fields=["geom_friction"])
    friction, speed = torch.tensor([0.6, 0.2, 0.1]), 0.5
    for _ in range(100):  # settle
        sim.step(5)
    start = sim.qpos[:, 0].clone()
    sim.field("geom_friction")[:, robot.id("geom", GROUND), 0] = friction
    sim.qvel[:, 0] = -speed
    for _ in range(60):
        sim.step(5)
    np.testing.assert_allclose(start - sim.qpos[:, 0], speed**2 / (2 * friction * 9.81), rtol=0.2)


def test_fields_that_do_not_exist(robot: RobotModel, engine: str) -> None:
    """tests/golden/robots.py has what MuJoCo's engine says."""
    sim = simulate(robot, engine, 2, world_fields=["body_mass", "geom_friction"])
    for unknown in ("geom_fricton", "dof_armature"):
        with pytest.raises(ModelError, match=f"'{unknown}' in this simulation"):
            sim.field(unknown)
    whose = {"mujoco_warp": "mujoco-warp", "mujoco": "MuJoCo"}[engine]
    for unknown in ("body_mas", "body_parentid"):  # the latter is shared by all
        with pytest.raises(ModelError, match=f"'{unknown}' in {whose}'s Model; "):
            simulate(robot, engine, 2, world_fields=["body_mass", unknown])


# ---- mujoco-warp alone


def test_replay_equals_eager(robot: RobotModel) -> None:
    """Recording is an optimisation: 20 steps with random targets, pushes and resets, bit for bit."""
    recorded, eager = simulate(robot, "mujoco_warp", 4), simulate(robot, "mujoco_warp", 4, eager=True)
    dice = torch.Generator().manual_seed(0)
    resets = 0
    for step in range(20):
        targets = HOME[7:] + 0.3 * torch.randn(4, 12, generator=dice)
        push, mask = 20 * torch.randn(4, 6, generator=dice), torch.rand(4, generator=dice) < 0.2
        resets += int(mask.sum())
        for sim in (recorded, eager):
            sim.ctrl.copy_(targets)
            sim.xfrc_applied[:, 1] = push
            sim.step(5)
        assert_same(snapshot(recorded), snapshot(eager), where=f"after step {step}")
        for sim in (recorded, eager):
            sim.reset(mask)
            stand(sim, mask)
        assert_same(snapshot(recorded), snapshot(eager), where=f"after reset {step}")
    assert resets > 5 and recorded._recorded and not eager._recorded


def test_all_fits(robot: RobotModel) -> None:
    """ "Not converged" is the plan at 1 and 5 iterations, so its two bits are no overflow."""
    sim = simulate(robot, "mujoco_warp")
    assert sim.overflow_report() == ""
    sim.overflow[0] |= int(OverflowType.LS_ITERATIONS | OverflowType.ITERATIONS)
    for _ in range(10):
        sim.step(5)
    assert sim.overflow[0] & int(OverflowType.ITERATIONS) and sim.overflow[0] & int(OverflowType.LS_ITERATIONS)
    assert sim.overflow_report() == ""


@pytest.mark.parametrize(
    ("bit", "advice"),
    [
        (OverflowType.CONTACT_MATCH, 'raise <numeric name="contact_sensor_maxmatch" data="128"/> in the MJCF (now 64)'),
        (OverflowType.NJMAX_NNZ, "raise njmax (now "),
        (OverflowType.CCD, "simpler geoms or fewer contacts may help"),
    ],
)
def test_what_overflows_for_other_reasons_is_told_what_helps(robot: RobotModel, bit: OverflowType, advice: str) -> None:
    sim = simulate(robot, "mujoco_warp")
    sim.overflow[0] |= int(bit)
    sim.step(1)
    assert sim.overflow_report().startswith(f"simulator overflow ({bit.name}) in 1 of {sim.num_envs} worlds; {advice}")


@pytest.mark.parametrize(
    ("room", "advice"),
    [
        ({"nconmax": 1, "njmax": 4}, "raise njmax (now 4) and nconmax (now 1)"),
        ({"nconmax": 8, "njmax": 4}, "raise njmax (now 4)"),
        ({"nconmax": 1, "njmax": 40}, "raise nconmax (now 1)"),
    ],
)
def test_what_does_not_fit_is_named(robot: RobotModel, room: dict[str, int], advice: str) -> None:
    sim = simulate(robot, "mujoco_warp", 3, **room)
    sim.step(5)
    report = sim.overflow_report()
    assert report.startswith("simulator overflow (") and report.endswith(f" in 3 of 3 worlds; {advice}")
    sim.reset(torch.ones(3, dtype=torch.bool))
    assert not sim.overflow.any() and sim.overflow_report() == report  # a reset does not hide it


# ---- MuJoCo's own engine alone


@pytest.mark.parametrize(
    ("memory", "report", "stands"),
    [
        (
            "2K",
            "simulator overflow in 2 of 2 worlds: contacts or constraints do not fit; raise <size memory=...> in the MJCF",
            True,
        ),
        (
            "4K",
            "MuJoCo could not step 2 of 2 worlds: MuJoCo raised in 2 of 2 simulations (0, 1); simulation 0: ",
            False,
        ),
    ],
)
def test_what_does_not_fit_is_reported(tmp_path: Path, memory: str, report: str, stands: bool) -> None:
    small = build_toy(toy(tmp_path, extra=f'<size memory="{memory}"/>'))
    sim = make_simulation(small.physics, 2, "cpu", engine="mujoco", nconmax=8, njmax=40)
    assert sim.overflow_report() == ""
    sim.qpos[:, 2] = 0.2  # pressed into the ground
    sim.step(1)
    assert sim.overflowed_worlds() == 2.0 and sim.overflow_report().startswith(report)
    assert "\n" not in sim.overflow_report() and bool(torch.isfinite(sim.qpos).all()) == stands
    sim.reset(torch.ones(2, dtype=torch.bool))
    assert torch.isfinite(sim.qpos).all() and sim.overflow_report().startswith(report)  # a reset does not hide it


def test_a_broken_world_leaves_no_log_file(robot: RobotModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    sim = simulate(robot, "mujoco")
    sim.qvel[0] = math.nan
    sim.step(5)
    assert sim.qpos[0].isnan().any() and list(tmp_path.iterdir()) == []
