"""go2.xml and g1.xml against the published figures of the machines, repeated here by hand.

Sources: Unitree's go2_description and g1_description (29 joints, revision 1.0) as published in MuJoCo Menagerie
(BSD-3-Clause). Units m, kg, rad, N m; x forward, y left, z up.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

ROBOTS = Path(__file__).parents[1] / "resources" / "robots"
# joint, in the file's order: axis, range, armature, force limit, mass of the body that it moves
_GO2_FRONT = {
    "hip": ("x", -1.0472, 1.0472, 0.01, 23.7, 0.678),
    "thigh": ("y", -1.5708, 3.4907, 0.01, 23.7, 1.152),
    "calf": ("y", -2.7227, -0.83776, 0.01, 45.43, 0.241352),
}
_GO2_REAR = _GO2_FRONT | {"thigh": ("y", -0.5236, 4.5379, 0.01, 23.7, 1.152)}
GO2 = {f"{leg}_{link}": row for leg in ("FL", "FR", "RL", "RR") for link, row in (_GO2_FRONT if leg[0] == "F" else _GO2_REAR).items()}
_LEG = {
    "hip_pitch": ("y", -2.5307, 2.8798, 0.01017752004, 88, 1.35),
    "hip_roll": ("x", -0.5236, 2.9671, 0.025101925, 139, 1.52),
    "hip_yaw": ("z", -2.7576, 2.7576, 0.01017752004, 88, 1.702),
    "knee": ("y", -0.087267, 2.8798, 0.025101925, 139, 1.932),
    "ankle_pitch": ("y", -0.87267, 0.5236, 0.00721945, 50, 0.074),
    "ankle_roll": ("x", -0.2618, 0.2618, 0.00721945, 50, 0.608),
}
_WAIST = {
    "waist_yaw": ("z", -2.618, 2.618, 0.01017752004, 88, 0.214),
    "waist_roll": ("x", -0.52, 0.52, 0.00721945, 50, 0.086),
    "waist_pitch": ("y", -0.52, 0.52, 0.00721945, 50, 7.818),
}
_ARM = {
    "shoulder_pitch": ("y", -3.0892, 2.6704, 0.003609725, 25, 0.718),
    "shoulder_roll": ("x", -1.5882, 2.2515, 0.003609725, 25, 0.643),
    "shoulder_yaw": ("z", -2.618, 2.618, 0.003609725, 25, 0.734),
    "elbow": ("y", -1.0472, 2.0944, 0.003609725, 25, 0.6),
    "wrist_roll": ("x", -1.97222, 1.97222, 0.003609725, 25, 0.085445),
    "wrist_pitch": ("y", -1.61443, 1.61443, 0.00425, 5, 0.48405),
    "wrist_yaw": ("z", -1.61443, 1.61443, 0.00425, 5, 0.254576),
}
_RIGHT = {"hip_roll": (-2.9671, 0.5236), "shoulder_roll": (-2.2515, 1.5882)}  # the only ranges that are not the left one's


def _side(side: str, rows: dict[str, tuple]) -> dict[str, tuple]:
    turned = {name: (row[0], *_RIGHT[name], *row[3:]) if side == "right" and name in _RIGHT else row for name, row in rows.items()}
    return {f"{side}_{name}": row for name, row in turned.items()}


G1 = _side("left", _LEG) | _side("right", _LEG) | _WAIST | _side("left", _ARM) | _side("right", _ARM)
JOINTS = {"go2": GO2, "g1": G1}
ROOT = {"go2": ("base", 6.921), "g1": ("pelvis", 3.813)}
TOTAL_MASS = {"go2": 15.20641, "g1": 33.34114}
FRICTION_LOSS = {"go2": 0.2, "g1": 0.1}
DAMPING = {"go2": 2.0, "g1": 0.0}
IMU = {"go2": ("imu", (-0.02557, 0.0, 0.04232)), "g1": ("imu_in_pelvis", (0.04525, 0.0, -0.08339))}
# summed by hand from the published masses, frames and tensors, all angles 0: centre of mass from the root's frame, and the
# inertia about it, xx yy zz xy xz yz; a slip in any frame, com or tensor shows here
WHOLE = {
    "go2": ((0.008875, 0.0, -0.034871), (0.2552, 0.544983, 0.511709, 0.000122, -0.001979, -3.1e-05)),
    "g1": ((0.020332, 8.2e-05, -0.088666), (3.694815, 3.421389, 0.469595, 9.2e-05, -0.018778, -0.000873)),
}
# colliding geoms: number, and the size and place of those that touch the ground first, in the body's frame
COLLIDING = {"go2": 23, "g1": 33}
GO2_FOOT = (0.022, (-0.002, 0.0, -0.213))
G1_SOLE = {  # capsule: half length, x, y; radius 0.01, z -0.025
    **{1: (0.025, 0.075, -0.026), 2: (0.0835, 0.0395, -0.018), 3: (0.091, 0.039, -0.01), 4: (0.093, 0.039, 0.0)},
    **{5: (0.091, 0.039, 0.01), 6: (0.0835, 0.0395, 0.018), 7: (0.025, 0.075, 0.026)},
}
STANCE = {  # angles to stand with, and the height of the root that brings the feet to the ground
    "go2": ({"thigh": 0.9, "calf": -1.8}, 0.2884),
    "g1": ({"hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2}, 0.7842),
}
# the published figures are not quite mirror images: |left - reflected right| of inertias [kg m^2] and places [m]
ASYMMETRIC_INERTIA = {"left_knee_link": 9e-5, "right_knee_link": 9e-5}
ASYMMETRIC_PLACE = {"left_shoulder_pitch_link": 1.01e-5, "right_shoulder_pitch_link": 1.01e-5}


@cache
def model(robot: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(ROBOTS / robot / f"{robot}.xml"))


@pytest.fixture(params=["go2", "g1"])
def robot(request: pytest.FixtureRequest) -> str:
    return request.param


def rotation(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def inertia(of: mujoco.MjModel, body: str) -> np.ndarray:
    """(3, 3) at the com, in the axes of the body."""
    r = rotation(of.body(body).iquat)
    return r @ np.diag(of.body(body).inertia) @ r.T


def colliding(of: mujoco.MjModel) -> list[int]:
    return [i for i in range(of.ngeom) if of.geom_contype[i] or of.geom_conaffinity[i]]


def other_side(name: str) -> str:
    """The name across the plane y = 0, or the name itself."""
    for here, there in (("left_", "right_"), ("right_", "left_"), ("FL", "FR"), ("FR", "FL"), ("RL", "RR"), ("RR", "RL")):
        if name.startswith(here):
            return there + name[len(here) :]
    return name


def lowest(of: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Height [m] of the lowest point of the spheres and capsules that collide."""
    heights = []
    for i in colliding(of):
        kind, z = mujoco.mjtGeom(of.geom_type[i]), data.geom_xpos[i, 2]
        along = abs(data.geom_xmat[i, 8]) * of.geom_size[i, 1]
        if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
            heights.append(z - of.geom_size[i, 0] - (along if kind == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0))
    return min(heights)


def test_it_states_facts_only(robot: str) -> None:
    """Servos, sensors, ground, lights and cameras are the choices of whoever loads it."""
    machine = model(robot)
    assert (machine.nu, machine.nsensor, machine.nlight, machine.ncam, machine.neq, machine.nexclude) == (0,) * 6
    text = (ROBOTS / robot / f"{robot}.xml").read_text()
    for word in ("file=", "<option", "<include", "<actuator", "<sensor"):
        assert word not in text
    assert "Menagerie" in text and "BSD-3-Clause" in text and len(text) < 60_000


def test_joints(robot: str) -> None:
    machine, rows = model(robot), JOINTS[robot]
    root, root_mass = ROOT[robot]
    assert machine.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and machine.body(1).name == root
    assert machine.body(root).mass[0] == root_mass
    assert [machine.joint(i).name for i in range(1, machine.njnt)] == [f"{name}_joint" for name in rows]
    for name, (axis, low, high, armature, force, mass) in rows.items():
        joint = machine.joint(f"{name}_joint")
        assert joint.type[0] == mujoco.mjtJoint.mjJNT_HINGE and joint.limited[0] == 1 and machine.jnt_actfrclimited[joint.id] == 1
        np.testing.assert_array_equal(joint.axis, np.eye(3)["xyz".index(axis)], err_msg=name)
        np.testing.assert_array_equal(joint.range, (low, high), err_msg=name)
        np.testing.assert_array_equal(machine.jnt_actfrcrange[joint.id], (-force, force), err_msg=name)
        assert (joint.armature[0], joint.frictionloss[0], joint.damping[0]) == (armature, FRICTION_LOSS[robot], DAMPING[robot]), name
        assert machine.body_mass[joint.bodyid[0]] == mass, name


def test_the_free_joint_is_free(robot: str) -> None:
    """The defaults of the hinges must not leak into it."""
    machine = model(robot)
    for values in (machine.dof_armature, machine.dof_damping, machine.dof_frictionloss):
        np.testing.assert_array_equal(values[:6], 0.0)
    assert machine.jnt_limited[0] == 0 and machine.jnt_actfrclimited[0] == 0


def test_mass_and_inertia_of_the_whole(robot: str) -> None:
    machine = model(robot)
    data = mujoco.MjData(machine)
    data.qpos[:7] = (0, 0, 0, 1, 0, 0, 0)
    mujoco.mj_forward(machine, data)
    com, moments = data.subtree_com[1], np.zeros((3, 3))
    for i in range(1, machine.nbody):
        r, place = data.ximat[i].reshape(3, 3), data.xipos[i] - com
        moments += r @ np.diag(machine.body_inertia[i]) @ r.T
        moments += machine.body_mass[i] * (place @ place * np.eye(3) - np.outer(place, place))
    assert machine.body_mass.sum() == pytest.approx(TOTAL_MASS[robot], abs=1e-5)
    np.testing.assert_allclose(com, WHOLE[robot][0], rtol=0, atol=1e-6)
    upper = [moments[i, k] for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    np.testing.assert_allclose(upper, WHOLE[robot][1], rtol=0, atol=1e-6)


def test_imu(robot: str) -> None:
    name, place = IMU[robot]
    site = model(robot).site(name)
    assert model(robot).body(site.bodyid[0]).name == ROOT[robot][0]
    np.testing.assert_array_equal(site.pos, place)
    np.testing.assert_array_equal(site.quat, (1.0, 0.0, 0.0, 0.0))


def test_colliding_geoms(robot: str) -> None:
    machine = model(robot)
    found = colliding(machine)
    assert len(found) == COLLIDING[robot]
    assert np.all(machine.geom_contype[found] == 1) and np.all(machine.geom_conaffinity[found] == 1)


def test_go2_feet() -> None:
    machine = model("go2")
    for leg in ("FR", "FL", "RR", "RL"):
        geom = machine.geom(leg)
        assert machine.body(geom.bodyid[0]).name == f"{leg}_calf" and geom.type[0] == mujoco.mjtGeom.mjGEOM_SPHERE
        assert geom.size[0] == GO2_FOOT[0]
        np.testing.assert_array_equal(geom.pos, GO2_FOOT[1])


@pytest.mark.parametrize("side", ["left", "right"])
def test_g1_soles(side: str) -> None:
    machine = model("g1")
    for k, (half, x, y) in G1_SOLE.items():
        geom = machine.geom(f"{side}_foot{k}_collision")
        assert machine.body(geom.bodyid[0]).name == f"{side}_ankle_roll_link" and geom.type[0] == mujoco.mjtGeom.mjGEOM_CAPSULE
        first = side == "left" and k == 1  # published half a millimetre off, and turned by a degree
        np.testing.assert_allclose(geom.size[:2], (0.01, half), rtol=0, atol=1e-5 if first else 0)
        np.testing.assert_allclose(geom.pos, (x, y, -0.025), rtol=0, atol=6e-4 if first else 0)
        assert abs(rotation(geom.quat)[0, 2]) > 0.999, "they lie along the foot"
    site = machine.site(f"{side}_foot")
    assert site.bodyid[0] == machine.body(f"{side}_ankle_roll_link").id
    np.testing.assert_array_equal(site.pos, (0.04, 0.0, -0.037))


def test_it_stands_on_its_feet(robot: str) -> None:
    """Within a millimetre of the height that the lengths of the links give."""
    machine, (angles, height) = model(robot), STANCE[robot]
    data = mujoco.MjData(machine)
    data.qpos[:] = 0.0
    data.qpos[2:4] = height, 1.0
    for name in JOINTS[robot]:
        for part, angle in angles.items():
            if name.endswith(part):
                data.qpos[machine.joint(f"{name}_joint").qposadr[0]] = angle
    mujoco.mj_forward(machine, data)
    assert abs(lowest(machine, data)) < 1e-3


def test_left_and_right_are_mirror_images(robot: str) -> None:
    """Across the plane y = 0, but for what the vendor publishes otherwise; the Go2's calves are all one part."""
    machine, mirror = model(robot), np.diag([1.0, -1.0, 1.0])
    compared = 0
    for i in range(1, machine.nbody):
        left = machine.body(i).name
        right = other_side(left)
        if left == right or (robot == "go2" and left.endswith("calf")):
            continue
        compared += 1
        tensors, frames = ASYMMETRIC_INERTIA.get(left, 1e-9), ASYMMETRIC_PLACE.get(left, 1e-9)
        assert machine.body(left).mass == machine.body(right).mass
        np.testing.assert_allclose(machine.body(left).pos, mirror @ machine.body(right).pos, rtol=0, atol=frames, err_msg=left)
        np.testing.assert_allclose(machine.body(left).ipos, mirror @ machine.body(right).ipos, rtol=0, atol=frames, err_msg=left)
        here, there = (rotation(machine.body(name).quat) for name in (left, right))
        np.testing.assert_allclose(here, mirror @ there @ mirror, rtol=0, atol=1e-5, err_msg=left)
        np.testing.assert_allclose(inertia(machine, left), mirror @ inertia(machine, right) @ mirror, rtol=0, atol=tensors, err_msg=left)
    assert compared == {"go2": 8, "g1": 26}[robot]


def test_looks_weigh_nothing_and_touch_nothing(robot: str) -> None:
    spec = mujoco.MjSpec.from_file(str(ROBOTS / robot / f"{robot}.xml"))
    looks = [geom for geom in spec.geoms if geom.group == 2]
    assert looks, "there is something to see"
    assert all(geom.mass == 0.0 and (geom.contype, geom.conaffinity) == (0, 0) and geom.material for geom in looks)
    assert {geom.group for geom in spec.geoms} == {2, 3}
    spec.compiler.discardvisual = True
    bare, machine = spec.compile(), model(robot)
    assert bare.ngeom == COLLIDING[robot]
    for field in ("body_mass", "body_ipos", "body_iquat", "body_inertia", "dof_invweight0"):
        np.testing.assert_array_equal(getattr(bare, field), getattr(machine, field), err_msg=field)


def test_it_looks_the_same_from_left_and_right(robot: str) -> None:
    """All angles 0, every look has a twin of the same material across the plane y = 0: bounding boxes are compared."""
    machine = model(robot)
    data = mujoco.MjData(machine)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    mujoco.mj_forward(machine, data)
    corners, boxes = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T, []
    for i in np.flatnonzero(machine.geom_group == 2):
        middle, half = machine.geom_aabb[i, :3], machine.geom_aabb[i, 3:]
        places = data.geom_xpos[i] + (middle + half * corners) @ data.geom_xmat[i].reshape(3, 3).T
        boxes.append([machine.geom_matid[i], *places.min(0), *places.max(0)])
    assert boxes, "there is something to see"
    boxes = np.array(boxes)
    mirrored = boxes.copy()
    mirrored[:, 2], mirrored[:, 5] = -boxes[:, 5], -boxes[:, 2]
    distance = np.abs(boxes[:, None] - mirrored[None]).max(-1)
    assert distance.min(1).max() < 2e-3, machine.geom(int(np.flatnonzero(machine.geom_group == 2)[distance.min(1).argmax()]))
