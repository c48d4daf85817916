"""resources/robots/g1/g1.xml, link by link, against the published figures; its pose, its look and its export.

Source of every figure: Unitree's g1_description, 29 DoF rev 1.0, as published in MuJoCo Menagerie (BSD-3-Clause). Typed
here: the middle and the left side; the right side is its mirror image but for what _RIGHT and RIGHT_... say.
Units m, kg, kg m^2, rad, N m; quaternions w x y z.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from inertia import compiled_tensor, rotation, tensor

from legged_mw.export.scene import standalone
from legged_mw.sim.model import Ground, Solver, build_model

XML = Path(__file__).parents[1] / "resources" / "robots" / "g1" / "g1.xml"
MIRROR = np.diag([1.0, -1.0, 1.0])
# joint, in the file's order: axis, range, armature, force limit
_LEG = {
    "hip_pitch": ("y", -2.5307, 2.8798, 0.01017752004, 88),
    "hip_roll": ("x", -0.5236, 2.9671, 0.025101925, 139),
    "hip_yaw": ("z", -2.7576, 2.7576, 0.01017752004, 88),
    "knee": ("y", -0.087267, 2.8798, 0.025101925, 139),
    "ankle_pitch": ("y", -0.87267, 0.5236, 0.00721945, 50),
    "ankle_roll": ("x", -0.2618, 0.2618, 0.00721945, 50),
}
_WAIST = {
    "waist_yaw": ("z", -2.618, 2.618, 0.01017752004, 88),
    "waist_roll": ("x", -0.52, 0.52, 0.00721945, 50),
    "waist_pitch": ("y", -0.52, 0.52, 0.00721945, 50),
}
_ARM = {
    "shoulder_pitch": ("y", -3.0892, 2.6704, 0.003609725, 25),
    "shoulder_roll": ("x", -1.5882, 2.2515, 0.003609725, 25),
    "shoulder_yaw": ("z", -2.618, 2.618, 0.003609725, 25),
    "elbow": ("y", -1.0472, 2.0944, 0.003609725, 25),
    "wrist_roll": ("x", -1.97222, 1.97222, 0.003609725, 25),
    "wrist_pitch": ("y", -1.61443, 1.61443, 0.00425, 5),
    "wrist_yaw": ("z", -1.61443, 1.61443, 0.00425, 5),
}
# the only ranges that are not the left one's
_RIGHT = {"hip_roll": (-2.9671, 0.5236), "shoulder_roll": (-2.2515, 1.5882)}


def _side(side: str, rows: dict[str, tuple]) -> dict[str, tuple]:
    turned = {
        name: (row[0], *_RIGHT[name], *row[3:]) if side == "right" and name in _RIGHT else row
        for name, row in rows.items()
    }
    return {f"{side}_{name}": row for name, row in turned.items()}


JOINTS = _side("left", _LEG) | _side("right", _LEG) | _WAIST | _side("left", _ARM) | _side("right", _ARM)
HOME = (0.0, 0.0, 0.785, 1.0, 0.0, 0.0, 0.0)
BENT = {"hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2, "shoulder_pitch": 0.2, "elbow": 1.28}
_ONE = (1.0, 0.0, 0.0, 0.0)
# place, quaternion, mass, com, quaternion of the inertia, principal moments
LINKS = {
    "pelvis": (
        (0.0, 0.0, 0.793),
        _ONE,
        3.813,
        (0.0, 0.0, -0.07605),
        (0.99999992, 0.0, -0.000399147968, 0.0),
        (0.010549, 0.0093089, 0.0079184),
    ),
    "left_hip_pitch_link": (
        (0.0, 0.064452, -0.1027),
        _ONE,
        1.35,
        (0.002741, 0.047791, -0.02606),
        (0.954862473, 0.293964146, 0.030255615, 0.0301220149),
        (0.00181517, 0.00153422, 0.00116212),
    ),
    "left_hip_roll_link": (
        (0.0, 0.052, -0.030465),
        (0.996178686, 0.0, -0.0873385724, 0.0),
        1.52,
        (0.029812, -0.001045, -0.087934),
        (0.977807773, -1.97118954e-05, 0.205575952, -0.0403792906),
        (0.00254986, 0.00241169, 0.00148755),
    ),
    "left_hip_yaw_link": (
        (0.025001, 0.0, -0.12412),
        _ONE,
        1.702,
        (-0.057709, -0.010981, -0.15078),
        (0.600597916, 0.158319978, 0.223481969, 0.751180895),
        (0.00776166, 0.00717575, 0.00160139),
    ),
    "left_knee_link": (
        (-0.078273, 0.0021489, -0.17734),
        (0.996178686, 0.0, 0.0873385724, 0.0),
        1.932,
        (0.005457, 0.003964, -0.12074),
        (0.923417871, -0.0327698954, 0.0158245978, 0.382066947),
        (0.0113804, 0.0112778, 0.00146458),
    ),
    "left_ankle_pitch_link": (
        (0.0, -9.4445e-05, -0.30001),
        _ONE,
        0.074,
        (-0.007269, 0.0, 0.011137),
        (0.603052987, 0.369224992, 0.369224992, 0.603052987),
        (1.89e-05, 1.40805e-05, 6.9195e-06),
    ),
    "left_ankle_roll_link": (
        (0.0, 0.0, -0.017558),
        _ONE,
        0.608,
        (0.026505, 0.0, -0.016425),
        (-0.000481091833, 0.728481748, -0.000618966785, 0.685064763),
        (0.00167218, 0.0016161, 0.000217621),
    ),
    "waist_yaw_link": (
        (0.0, 0.0, 0.0),
        _ONE,
        0.214,
        (0.003494, 0.000233, 0.018034),
        (0.289696986, 0.591000972, -0.337794984, 0.672820968),
        (0.000163531, 0.000107714, 0.000102205),
    ),
    "waist_roll_link": (
        (-0.0039635, 0.0, 0.044),
        _ONE,
        0.086,
        (0.0, 2.3e-05, 0.0),
        (0.5, 0.5, -0.5, 0.5),
        (8.245e-06, 7.079e-06, 6.339e-06),
    ),
    "torso_link": (
        (0.0, 0.0, 0.0),
        _ONE,
        7.818,
        (0.00203158, 0.000339683, 0.184568),
        (0.999802581, -6.03318747e-05, 0.0198255917, 0.00131985945),
        (0.121847, 0.109825, 0.0273735),
    ),
    "left_shoulder_pitch_link": (
        (0.0039563, 0.10022, 0.24778),
        (0.99026414, 0.13920102, 1.3872202e-05, -9.86868139e-05),
        0.718,
        (0.0, 0.035892, -0.011628),
        (0.654151918, 0.0130457984, -0.326266959, 0.682249915),
        (0.000465864, 0.000432842, 0.000406394),
    ),
    "left_shoulder_roll_link": (
        (0.0, 0.038, -0.013831),
        (0.990268219, -0.139172031, 0.0, 0.0),
        0.643,
        (-0.000227, 0.00727, -0.063243),
        (0.701256025, -0.0196223007, -0.00710317026, 0.712604026),
        (0.000691311, 0.000618011, 0.000388977),
    ),
    "left_shoulder_yaw_link": (
        (0.0, 0.00624, -0.1032),
        _ONE,
        0.734,
        (0.010773, -0.002949, -0.072009),
        (0.716878715, -0.0964828616, -0.0679941729, 0.687133727),
        (0.00106187, 0.00103217, 0.000400661),
    ),
    "left_elbow_link": (
        (0.015783, 0.0, -0.080518),
        _ONE,
        0.6,
        (0.064956, 0.004454, -0.010062),
        (0.541765236, 0.636132278, 0.38882117, 0.388129169),
        (0.000443035, 0.000421612, 0.000259353),
    ),
    "left_wrist_roll_link": (
        (0.1, 0.00188791, -0.01),
        _ONE,
        0.085445,
        (0.0171394, 0.000537591, 4.8864e-07),
        (0.575338369, 0.411667264, -0.574906368, 0.411094263),
        (5.48211e-05, 4.96646e-05, 3.57798e-05),
    ),
    "left_wrist_pitch_link": (
        (0.038, 0.0, 0.0),
        _ONE,
        0.48405,
        (0.0229999, -0.00111685, -0.00111658),
        (0.249997828, 0.661362546, 0.293035799, 0.643607558),
        (0.000430353, 0.000429873, 0.000164648),
    ),
    "left_wrist_yaw_link": (
        (0.046, 0.0, 0.0),
        _ONE,
        0.254576,
        (0.0708244, 0.000191745, 0.00161742),
        (0.510570849, 0.526294845, 0.468077862, 0.493187854),
        (0.000646113, 0.000559993, 0.000147566),
    ),
}
SHAPES = {
    "pelvis_collision": ("pelvis", "sphere", (0.07,), (0.0, 0.0, -0.08), _ONE),
    "left_hip_collision": ("left_hip_roll_link", "capsule", (0.06, 0.04), (0.02, 0.0, -0.04), _ONE),
    "left_thigh_collision": (
        "left_hip_yaw_link",
        "capsule",
        (0.055, 0.0761577311),
        (-0.03, 0.0, -0.1),
        (0.979578, 0.0, 0.201066, 0.0),
    ),
    "left_shin_collision": ("left_knee_link", "capsule", (0.045, 0.075), (0.01, 0.0, -0.075), _ONE),
    "left_linkage_brace_collision": ("left_knee_link", "capsule", (0.03, 0.04), (0.01, 0.0, -0.24), _ONE),
    "left_foot1_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.0250049995),
        (0.075, -0.0265, -0.025),
        (0.707107, -0.0141393, 0.706965, 0.0),
    ),
    "left_foot2_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.0835),
        (0.0395, -0.018, -0.025),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_foot3_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.091),
        (0.039, -0.01, -0.025),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_foot4_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.093),
        (0.039, 0.0, -0.025),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_foot5_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.091),
        (0.039, 0.01, -0.025),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_foot6_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.0835),
        (0.0395, 0.018, -0.025),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_foot7_collision": (
        "left_ankle_roll_link",
        "capsule",
        (0.01, 0.025),
        (0.075, 0.026, -0.025),
        (0.707107, 0.0, 0.707107, 0.0),
    ),
    "torso_collision": ("torso_link", "capsule", (0.09, 0.06), (0.01, 0.0, 0.14), (6.12323e-17, 1.0, 0.0, 0.0)),
    "head_collision": ("torso_link", "sphere", (0.06,), (0.0, 0.0, 0.43), _ONE),
    "left_shoulder_yaw_collision": (
        "left_shoulder_yaw_link",
        "capsule",
        (0.035, 0.065),
        (0.0, 0.0, -0.015),
        (6.12323e-17, 1.0, 0.0, 0.0),
    ),
    "left_elbow_yaw_collision": (
        "left_elbow_link",
        "capsule",
        (0.035, 0.045),
        (0.035, 0.0, -0.01),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_wrist_collision": (
        "left_wrist_pitch_link",
        "capsule",
        (0.035, 0.035),
        (0.025, 0.0, 0.0),
        (0.707107, 0.0, -0.707107, 0.0),
    ),
    "left_hand_collision": (
        "left_wrist_yaw_link",
        "capsule",
        (0.035, 0.0412310563),
        (0.11, -0.01, 0.0),
        (0.707107, -0.171499, -0.685994, 0.0),
    ),
}
# what is published for the right side and is no mirror image: place; quaternion of the inertia and moments; shape
RIGHT_PLACE = {"right_shoulder_pitch_link": (0.0039563, -0.10021, 0.24778)}
RIGHT_INERTIA = {
    "right_knee_link": ((0.923438887, 0.0345275958, 0.0116332986, -0.382011953), (0.011374, 0.0112843, 0.00146452))
}
RIGHT_SHAPE = {"right_foot1_collision": ((0.01, 0.025), (0.075, -0.026, -0.025), (0.707107, 0.0, 0.707107, 0.0))}


def sides(name: str) -> list[tuple[str, np.ndarray]]:
    """The names of a link or a shape, each with what turns the typed figures into its own."""
    return (
        [(name, np.eye(3)), (name.replace("left_", "right_"), MIRROR)]
        if name.startswith("left_")
        else [(name, np.eye(3))]
    )


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(XML))


@pytest.fixture(scope="module")
def home(model: mujoco.MjModel) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("home").id)
    mujoco.mj_forward(model, data)
    return data


@pytest.mark.parametrize("link", LINKS)
def test_frame_and_inertia(model: mujoco.MjModel, link: str) -> None:
    place, quat, mass, com, turned, moments = LINKS[link]
    for name, flip in sides(link):
        body = model.body(name)
        np.testing.assert_array_equal(body.pos, RIGHT_PLACE.get(name, flip @ place), err_msg=name)
        np.testing.assert_allclose(rotation(body.quat), flip @ rotation(quat) @ flip, rtol=0, atol=1e-8, err_msg=name)
        assert body.mass[0] == mass, name
        np.testing.assert_array_equal(body.ipos, flip @ com, err_msg=name)
        expected = tensor(*RIGHT_INERTIA[name]) if name in RIGHT_INERTIA else flip @ tensor(turned, moments) @ flip
        found = compiled_tensor(model, name)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.trace(expected), err_msg=name)


def test_every_link_and_shape_is_typed_here(model: mujoco.MjModel) -> None:
    assert {model.body(i).name for i in range(1, model.nbody)} == {name for link in LINKS for name, _ in sides(link)}
    touching = {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i] or model.geom_conaffinity[i]}
    assert touching == {name for shape in SHAPES for name, _ in sides(shape)} and len(touching) == 33


@pytest.mark.parametrize("shape", SHAPES)
def test_colliding_geom(model: mujoco.MjModel, shape: str) -> None:
    body, kind, *figures = SHAPES[shape]
    for (name, flip), (link, _) in zip(sides(shape), sides(body), strict=True):
        if "_foot" in name:
            flip = np.eye(3)  # both soles are counted from the robot's right to its left
        geom, (size, place, quat) = model.geom(name), RIGHT_SHAPE.get(name, figures)
        assert model.body(geom.bodyid[0]).name == link and geom.group[0] == 3
        assert geom.type[0] == getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
        np.testing.assert_array_equal(geom.size[: len(size)], size, err_msg=name)
        np.testing.assert_allclose(geom.pos, flip @ place, rtol=0, atol=1e-12, err_msg=name)
        # a capsule or sphere is the same turned about its axis z, or upside down
        assert abs(rotation(geom.quat)[:, 2] @ flip @ rotation(quat)[:, 2]) == pytest.approx(1.0, abs=1e-9), name


def test_joints(model: mujoco.MjModel) -> None:
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and len(JOINTS) == 29
    assert [model.joint(i).name for i in range(1, model.njnt)] == [f"{name}_joint" for name in JOINTS]
    for name, (axis, low, high, armature, force) in JOINTS.items():
        joint = model.joint(f"{name}_joint")
        assert (
            joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE
            and joint.limited[0] == 1
            and model.jnt_actfrclimited[joint.id] == 1
        )
        np.testing.assert_array_equal(joint.axis, np.eye(3)["xyz".index(axis)], err_msg=name)
        np.testing.assert_array_equal(joint.range, (low, high), err_msg=name)
        np.testing.assert_array_equal(model.jnt_actfrcrange[joint.id], (-force, force), err_msg=name)
        assert (joint.armature[0], joint.frictionloss[0], joint.damping[0]) == (armature, 0.1, 0.0), name


def test_sites(model: mujoco.MjModel) -> None:
    places = {"imu_in_pelvis": ("pelvis", (0.04525, 0.0, -0.08339))}
    places |= {f"{side}_foot": (f"{side}_ankle_roll_link", (0.04, 0.0, -0.037)) for side in ("left", "right")}
    for name, (body, place) in places.items():
        assert model.body(model.site(name).bodyid[0]).name == body
        np.testing.assert_array_equal(model.site(name).pos, place)
        np.testing.assert_array_equal(model.site(name).quat, _ONE)


def test_home(model: mujoco.MjModel, home: mujoco.MjData) -> None:
    expected = []
    for i in range(1, model.njnt):
        name = model.joint(i).name
        lean = {"left_shoulder_roll_joint": 0.2, "right_shoulder_roll_joint": -0.2}.get(name, 0.0)
        expected.append(next((angle for part, angle in BENT.items() if name.endswith(f"{part}_joint")), lean))
    np.testing.assert_array_equal(model.key("home").qpos, [*HOME, *expected])
    assert np.all((model.jnt_range[1:, 0] < expected) & (expected < model.jnt_range[1:, 1]))
    for side in ("left", "right"):  # the sole is 0.8 mm above the ground, the site 2 mm lower
        assert home.site(f"{side}_foot").xpos[2] == pytest.approx(-0.0012, abs=1e-4)
        np.testing.assert_allclose(home.site(f"{side}_foot").xmat.reshape(3, 3), np.eye(3), rtol=0, atol=1e-6)


def test_its_export_is_a_small_text() -> None:
    """Meshes are written out vertex by vertex; an export holds them with every policy."""
    robot = build_model(
        XML,
        solver=Solver(timestep=0.005, iterations=3, ls_iterations=10),
        ground=Ground(friction=1.0),
        stiffness={"": 40.0},
        damping={"": 2.0},
        colliders=["*_foot[26]_collision"],
        self_collisions=False,
        contact_geoms=[],
        imu_site="imu_in_pelvis",
        pose={"": 0.0},
    )
    scene = standalone(robot, robot.imu, qpos=[*HOME, *robot.pose], ctrl=robot.pose)
    assert len(scene.xml) < 80_000
