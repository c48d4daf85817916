"""What holds for each robot's file in resources/robots: it states facts only, and its looks neither weigh nor touch anything."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

ROBOTS = Path(__file__).parents[1] / "resources" / "robots"
SIZES = {"go1": (19, 18, 37), "go2": (19, 18, 23), "g1": (36, 35, 33)}  # nq, nv, geoms that collide
STANCE = {"hip": (0.1, -0.1), "thigh": (0.8, 1.0), "calf": (-1.5, -1.5)}  # of a Go2; hip: left, right; else front, rear
UNCHANGED = ("body_mass", "body_ipos", "body_iquat", "body_inertia", "body_invweight0", "dof_invweight0", "site_pos")


@pytest.fixture(params=SIZES)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture
def xml(name: str) -> str:
    return (ROBOTS / name / f"{name}.xml").read_text()


@pytest.fixture
def model(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(xml)


def test_it_states_facts_only(name: str, xml: str, model: mujoco.MjModel) -> None:
    """Servos, sensors, ground, lights and cameras are the choices of whoever loads it."""
    assert (model.nu, model.nsensor, model.nlight, model.ncam, model.neq, model.nexclude) == (0,) * 6
    assert model.nkey == (0 if name == "go2" else 1)
    assert not np.any(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    assert (model.nq, model.nv) == SIZES[name][:2]
    for word in ("file=", "<option", "<include", "<actuator", "<sensor"):
        assert word not in xml
    assert "Menagerie" in xml and "BSD-3-Clause" in xml and len(xml) < 60_000


def test_the_free_joint_is_free(model: mujoco.MjModel) -> None:
    """The defaults of the hinges must not leak into it."""
    for values in (model.dof_armature, model.dof_damping, model.dof_frictionloss):
        np.testing.assert_array_equal(values[:6], 0.0)
    assert model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and model.jnt_limited[0] == model.jnt_actfrclimited[0] == 0


def test_looks_weigh_nothing_and_touch_nothing(name: str, xml: str, model: mujoco.MjModel) -> None:
    """Without them it is the same machine."""
    spec = mujoco.MjSpec.from_string(xml)
    looks = [geom for geom in spec.geoms if geom.group == 2]
    bodies = {model.body(i).name for i in range(1, model.nbody)}
    assert {geom.parent.name for geom in looks} == bodies, "every body is to be seen"
    for geom in looks:
        assert geom.mass == 0.0 and (geom.contype, geom.conaffinity) == (0, 0)
        assert geom.material, "a colour by name, not by chance"
    assert {geom.group for geom in spec.geoms} == {2, 3}
    spec.compiler.discardvisual = True
    bare = spec.compile()
    colliding = {model.geom(i).name for i in range(model.ngeom) if model.geom_contype[i]}
    assert {bare.geom(i).name for i in range(bare.ngeom)} == colliding
    assert (bare.ngeom, bare.nmesh, bare.nmat, bare.ntex) == (SIZES[name][2], 0, 0, 0)
    for field in (*UNCHANGED, "key_qpos"):
        np.testing.assert_array_equal(getattr(bare, field), getattr(model, field), err_msg=field)


def test_it_looks_the_same_from_left_and_right(name: str, model: mujoco.MjModel) -> None:
    """Every visible geom has a mirror image of the same material: compared by bounding boxes as it stands."""
    data = mujoco.MjData(model)
    if name == "go2":
        for i in range(1, model.njnt):
            leg, link, _ = model.joint(i).name.split("_")
            data.qpos[6 + i] = STANCE[link][leg[1] == "R" if link == "hip" else leg[0] == "R"]
    else:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_kinematics(model, data)
    boxes = []
    for i in np.flatnonzero(model.geom_group == 2):
        if (mesh := model.geom_dataid[i]) >= 0:
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            points = model.mesh_vert[start : start + count]
        else:
            center, half = model.geom_aabb[i, :3], model.geom_aabb[i, 3:]
            points = center + half * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
        world = data.geom_xpos[i] + points @ data.geom_xmat[i].reshape(3, 3).T
        boxes.append([model.geom_matid[i], *world.min(0), *world.max(0)])
    boxes = np.array(boxes)
    mirrored = boxes.copy()
    mirrored[:, 2], mirrored[:, 5] = -boxes[:, 5], -boxes[:, 2]
    # 0.2 mm: the facets of a round shape need not be mirrored, and a G1's right shoulder is published 10 um off
    assert np.abs(boxes[:, None] - mirrored[None]).max(-1).min(1).max() < 2e-4
