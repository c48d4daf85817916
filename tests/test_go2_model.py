"""resources/robots/go2/go2.xml against the published figures of the machine.

Source of every figure: Unitree's go2_description as published in MuJoCo Menagerie (BSD-3-Clause). They are repeated
here by hand, leg by leg where legs differ, so that a slip in the MJCF and its defaults cannot hide.
Units m, kg, kg m^2, rad, N m; quaternions w x y z; inertia = principal moments at the com in the frame of the quaternion.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from inertia import compiled_tensor, rotation, tensor

XML = Path(__file__).parents[1] / "resources" / "robots" / "go2" / "go2.xml"
LEGS, LINKS = ("FL", "FR", "RL", "RR"), ("hip", "thigh", "calf")
LINK_NAMES = [f"{leg}_{link}" for leg in LEGS for link in LINKS]
TOTAL_MASS = 15.20641
FOOT_RADIUS, FOOT_POS = 0.022, (-0.002, 0.0, -0.213)
IMU = (-0.02557, 0.0, 0.04232)

# mass, com, quaternion of the inertia, principal moments
_HIP, _THIGH, _CALF = (
    (0.00088403, 0.000596003, 0.000479967),
    (0.00594973, 0.00584149, 0.000878787),
    (0.0014901, 0.00146356, 5.31397e-05),
)
_THIGH_L = (1.152, (-0.00374, -0.0223, -0.0327), (0.829532869, 0.0847634866, -0.0200631968, 0.551622913), _THIGH)
_THIGH_R = (1.152, (-0.00374, 0.0223, -0.0327), (0.551622913, -0.0200631968, 0.0847634866, 0.829532869), _THIGH)
_CALF_L = (
    0.241352,
    (0.00629595, -0.000622121, -0.141417),
    (0.710671705, 0.00154098936, -0.00450086813, 0.703507708),
    _CALF,
)
_CALF_R = (
    0.241352,
    (0.00629595, 0.000622121, -0.141417),
    (0.703507708, -0.00450086813, 0.00154098936, 0.710671705),
    _CALF,
)
INERTIALS = {
    "base": (
        6.921,
        (0.021112, 0.0, -0.005366),
        (-0.000543471019, 0.713435025, -0.00173769006, 0.700719024),
        (0.107027, 0.0980771, 0.0244531),
    ),
    "FL_hip": (0.678, (-0.0054, 0.00194, -0.000105), (0.497013894, 0.499244893, 0.505461892, 0.498236893), _HIP),
    "FR_hip": (0.678, (-0.0054, -0.00194, -0.000105), (0.498236893, 0.505461892, 0.499244893, 0.497013894), _HIP),
    "RL_hip": (0.678, (0.0054, 0.00194, -0.000105), (0.505461892, 0.498236893, 0.497013894, 0.499244893), _HIP),
    "RR_hip": (0.678, (0.0054, -0.00194, -0.000105), (0.499244893, 0.497013894, 0.498236893, 0.505461892), _HIP),
    "FL_thigh": _THIGH_L,
    "FR_thigh": _THIGH_R,
    "RL_thigh": _THIGH_L,
    "RR_thigh": _THIGH_R,
    "FL_calf": _CALF_L,
    "FR_calf": _CALF_R,
    "RL_calf": _CALF_L,
    "RR_calf": _CALF_R,
}
# axis, range in front, range behind, force limit
JOINTS = {
    "hip": ((1, 0, 0), (-1.0472, 1.0472), (-1.0472, 1.0472), 23.7),
    "thigh": ((0, 1, 0), (-1.5708, 3.4907), (-0.5236, 4.5379), 23.7),
    "calf": ((0, 1, 0), (-2.7227, -0.83776), (-2.7227, -0.83776), 45.43),
}
_ONE, _Y, _X = (1.0, 0.0, 0.0, 0.0), (0.707107, 0.707107, 0.0, 0.0), (0.707107, 0.0, 0.707107, 0.0)


def shapes(body: str) -> list[tuple[str, tuple, tuple, tuple]]:
    """Type, size, pos, quat of what collides, in the order of the file."""
    if body == "base":
        return [
            ("box", (0.1881, 0.04675, 0.057), (0.0, 0.0, 0.0), _ONE),
            ("cylinder", (0.05, 0.045), (0.285, 0.0, 0.01), _ONE),
            ("sphere", (0.047,), (0.293, 0.0, -0.06), _ONE),
        ]
    leg, link = body.split("_")
    if link == "hip":
        return [("cylinder", (0.046, 0.02), (0.0, 0.08 if leg[1] == "L" else -0.08, 0.0), _Y)]
    if link == "thigh":
        return [("box", (0.1065, 0.01225, 0.017), (0.0, 0.0, -0.1065), _X)]
    upper = ("cylinder", (0.013, 0.06), (0.01, 0.0, -0.06), (0.995004, 0.0, -0.0998334, 0.0))
    if leg == "FL":  # published so, unlike the other three
        upper = ("cylinder", (0.012, 0.06), (0.008, 0.0, -0.06), (0.994493, 0.0, -0.104807, 0.0))
    lower = ("cylinder", (0.011, 0.0325), (0.02, 0.0, -0.148), (0.999688, 0.0, 0.0249974, 0.0))
    return [upper, lower, ("sphere", (FOOT_RADIUS,), FOOT_POS, _ONE)]


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(XML))


def test_order_and_frames(model: mujoco.MjModel) -> None:
    """Bodies and joints as published: left before right, unlike the motors' order."""
    assert [model.body(i).name for i in range(model.nbody)] == ["world", "base", *LINK_NAMES]
    assert [model.joint(i).name for i in range(1, model.njnt)] == [f"{name}_joint" for name in LINK_NAMES]
    np.testing.assert_array_equal(model.body("base").pos, (0.0, 0.0, 0.445))
    for leg in LEGS:
        x, y = 1 if leg[0] == "F" else -1, 1 if leg[1] == "L" else -1
        frames = {
            "hip": ("base", (x * 0.1934, y * 0.0465, 0.0)),
            "thigh": ("hip", (0.0, y * 0.0955, 0.0)),
            "calf": ("thigh", (0.0, 0.0, -0.213)),
        }
        for link, (parent, pos) in frames.items():
            body = model.body(f"{leg}_{link}")
            assert model.body(body.parentid[0]).name == (parent if parent == "base" else f"{leg}_{parent}")
            np.testing.assert_array_equal(body.pos, pos)
    np.testing.assert_array_equal(model.body_quat, np.tile(_ONE, (model.nbody, 1)))
    np.testing.assert_array_equal(model.jnt_pos, 0.0)


def test_masses(model: mujoco.MjModel) -> None:
    assert model.body_mass.sum() == pytest.approx(TOTAL_MASS, abs=5e-6)
    for name, (mass, com, quat, moments) in INERTIALS.items():
        assert model.body(name).mass[0] == mass
        np.testing.assert_array_equal(model.body(name).ipos, com)
        expected = tensor(quat, moments)
        np.testing.assert_allclose(
            compiled_tensor(model, name), expected, rtol=0, atol=1e-9 * np.trace(expected), err_msg=name
        )


@pytest.mark.parametrize("name", LINK_NAMES)
def test_joint(model: mujoco.MjModel, name: str) -> None:
    axis, front, rear, force = JOINTS[name.split("_")[1]]
    joint = model.joint(f"{name}_joint")
    assert model.body(joint.bodyid[0]).name == name and joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE
    np.testing.assert_array_equal(joint.axis, axis)
    assert joint.limited[0] == 1 and model.jnt_actfrclimited[joint.id] == 1
    np.testing.assert_array_equal(joint.range, front if name[0] == "F" else rear)
    np.testing.assert_array_equal(model.jnt_actfrcrange[joint.id], (-force, force))
    assert (joint.armature[0], joint.damping[0], joint.frictionloss[0], joint.stiffness[0]) == (0.01, 2.0, 0.2, 0.0)


def test_what_collides(model: mujoco.MjModel) -> None:
    assert np.count_nonzero(model.geom_contype) == sum(len(shapes(body)) for body in INERTIALS) == 23
    for body in INERTIALS:
        geoms = [
            model.geom(i)
            for i in range(model.ngeom)
            if model.geom_bodyid[i] == model.body(body).id and model.geom_contype[i]
        ]
        for geom, (kind, size, pos, quat) in zip(geoms, shapes(body), strict=True):
            assert geom.name and geom.group[0] == 3 and (geom.contype[0], geom.conaffinity[0]) == (1, 1)
            assert geom.type[0] == getattr(mujoco.mjtGeom, f"mjGEOM_{kind.upper()}")
            np.testing.assert_array_equal(geom.size[: len(size)], size)
            np.testing.assert_allclose(geom.pos, pos, rtol=0, atol=1e-12)
            np.testing.assert_allclose(rotation(geom.quat), rotation(quat), rtol=0, atol=1e-12)


def test_feet_and_sites(model: mujoco.MjModel) -> None:
    assert {model.site(i).name for i in range(model.nsite)} == {*LEGS, "imu"}
    for leg in LEGS:
        for point in (model.geom(leg), model.site(leg)):
            assert model.body(point.bodyid[0]).name == f"{leg}_calf"
            np.testing.assert_array_equal(point.pos, FOOT_POS)
    assert model.body(model.site("imu").bodyid[0]).name == "base"
    np.testing.assert_array_equal(model.site("imu").pos, IMU)
    np.testing.assert_array_equal(model.site_quat, np.tile(_ONE, (model.nsite, 1)))


@pytest.mark.parametrize("pair", [("FL", "FR"), ("RL", "RR")])
def test_legs_are_mirror_images(model: mujoco.MjModel, pair: tuple[str, str]) -> None:
    """Across the plane y = 0, all links; only the upper calf cylinder of the front left leg differs, which weighs nothing by itself."""
    mirror = np.diag([1.0, -1.0, 1.0])
    for link in LINKS:
        left, right = (f"{leg}_{link}" for leg in pair)
        assert model.body(right).mass == model.body(left).mass
        np.testing.assert_array_equal(mirror @ model.body(right).ipos, model.body(left).ipos)
        expected = mirror @ compiled_tensor(model, right) @ mirror
        np.testing.assert_allclose(compiled_tensor(model, left), expected, rtol=0, atol=1e-9)


def test_an_exported_scene_stays_small() -> None:
    """A built-in mesh is written out vertex by vertex: few and coarse ones only."""
    spec = mujoco.MjSpec.from_file(str(XML))
    spec.compile()
    assert len(spec.to_xml()) < 45_000
