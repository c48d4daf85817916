"""Oddities of vendors' files, one each, in small files that are written for the test."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_sim import build_toy, toy

from legged_mw.robot.draft import draft
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.model import read_file

ONES = 'ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"'
LEG = """<joint name="{0}_hip" type="revolute"><parent link="base"/><child link="{0}_leg"/><origin xyz="0 {1} 0"/>
<axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="9"/></joint><link name="{0}_leg">{2}
<inertial><mass value="1"/><inertia ixx="0.1" ixy="0" ixz="0" iyy="0.1" iyz="0" izz="0.1"/></inertial></link>"""
FOOT = '<collision><origin xyz="0 0 -0.2"/><geometry><sphere radius="0.03"/></geometry></collision>'


def urdf(folder: Path, base: str = "", inertia: str = ONES, leg: str = FOOT) -> Path:
    """A base with a left and a right leg of one joint each."""
    legs = "".join(LEG.format(side, y, leg) for side, y in (("left", 0.1), ("right", -0.1)))
    file = folder / "robot.urdf"
    file.write_text(
        f'<robot name="r"><link name="base">{base}<inertial><mass value="3"/><inertia {inertia}/></inertial></link>{legs}</robot>'
    )
    return file


def tensor(model: mujoco.MjModel, body: str) -> np.ndarray:
    """Inertia (3, 3) of a body at its centre of mass, in the body's axes [kg m^2]."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body(body).iquat)
    axes = turn.reshape(3, 3)
    return axes @ np.diag(model.body(body).inertia) @ axes.T


# ---- inertias that no body can have


@pytest.mark.parametrize(
    ("given", "nearest"),
    [
        # ANYmal C's hatch: all numbers alike; moments 0, 0, 3 become 1, 1, 2
        ([1, 1, 1, 1, 1, 1], np.eye(3) * (1 + 1 / 3) + (1 / 3) * (np.ones((3, 3)) - np.eye(3))),
        # a tracking camera's: moments 1, 1, 5 become 2, 2, 4
        ([1, 1, 5, 0, 0, 0], np.diag([2.0, 2.0, 4.0])),
        # Cassie's base: a product that is larger than the moments; -4, 5, 6 become a rod along the first axis
        ([1, 5, 1, 0, 5, 0], None),
    ],
)
@pytest.mark.parametrize("kind", ["URDF", "MJCF"])
def test_an_inertia_that_no_body_can_have_becomes_the_nearest(
    given: list[float], nearest: np.ndarray | None, kind: str, tmp_path: Path
) -> None:
    names = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")
    numbers = " ".join(f'{name}="{value}"' for name, value in zip(names, given, strict=True))
    full = f'<inertial pos="0 0 0" mass="3" fullinertia="{" ".join(map(str, given))}"/>'
    file = urdf(tmp_path, inertia=numbers) if kind == "URDF" else toy(tmp_path, inside=full)
    robot = read_robot(file)
    (line,) = [line for line in robot.notes if line.startswith("inertia of 'base' balanced")]
    taken = tensor(robot.model, "base")
    xx, yy, zz, xy, xz, yz = given
    asked = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], float)
    second = 0.5 * np.trace(taken) - np.linalg.eigvalsh(taken)
    assert second.min() > 0.0, "a body's mass is spread along each axis"
    if nearest is not None:
        np.testing.assert_allclose(taken, nearest, atol=6e-3)
    # nothing nearby that a body can have is nearer
    generator = np.random.default_rng(0)
    for _ in range(300):
        spread = 0.05 * generator.standard_normal((3, 3))
        other = taken + spread + spread.T
        possible = 0.5 * np.trace(other) - np.linalg.eigvalsh(other)
        if possible.min() >= second.min():
            assert np.linalg.norm(other - asked) > np.linalg.norm(taken - asked) - 1e-9
    assert "kg m^2; now " in line


def test_an_inertia_that_a_body_can_have_stays(tmp_path: Path) -> None:
    """Also that of a thin plate, which rounding puts on either side of the bound."""
    for moments in ("0.1 0.2 0.3", "0.1 0.2 0.29"):
        robot = read_robot(toy(tmp_path, inside=f'<inertial pos="0 0 0" mass="3" diaginertia="{moments}"/>'))
        assert not any("balanced" in line for line in robot.notes)
        np.testing.assert_allclose(
            np.sort(robot.model.body("base").inertia), [float(each) for each in moments.split()], rtol=1e-4
        )


# ---- more in the world than the robot


SPARE = '<body name="spare" pos="0 0 20"><inertial pos="0 0 0" mass="0.1" diaginertia="0.1 0.1 0.1"/><joint name="spare"/></body>'


def test_a_body_of_the_world_with_a_joint_alone_is_dropped(tmp_path: Path) -> None:
    """Unitree's H1 and R1 keep the motors' numbers in order by them; the sensors and motors go with them."""
    more = (
        '<actuator><motor joint="left_hip"/><motor joint="spare"/></actuator><sensor><jointpos joint="spare"/></sensor>'
    )
    key = '<keyframe><key name="home" qpos="0 0 0.4 1 0 0 0 0.1 0.2 0.3"/></keyframe>'
    file = toy(tmp_path, world=SPARE, extra=more + key)
    robot = build_toy(file)
    assert robot.joint_names == ("left_hip", "right_hip") and robot.root == "base" and robot.pose == (0.2, 0.3)
    assert "bodies of the world dropped: 'spare', which have a joint and no geom" in robot.overrides


def test_a_robot_of_bodies_without_a_geom_is_read(tmp_path: Path) -> None:
    """Nothing is dropped where nothing would be left."""
    file = tmp_path / "robot.xml"
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    file.write_text(f'<mujoco><worldbody><body name="base">{inertial}<freejoint/></body></worldbody></mujoco>')
    with pytest.raises(ValueError, match="no hinge"):
        read_file(file)


# ---- a mesh that is not there


MESH = '<collision><geometry><mesh filename="package://there/torso.STL"/></geometry></collision>'


@pytest.mark.parametrize("kind", ["URDF", "MJCF"])
def test_a_missing_mesh_that_is_no_collider_of_the_task_is_a_note(kind: str, tmp_path: Path) -> None:
    """G1 12 of unitree_rl_gym: its feet collide, its torso's mesh is missing in a mirror."""
    if kind == "URDF":
        file = urdf(tmp_path, base=MESH)
        feet, found = ["left_leg", "right_leg"], draft(file)
        assert [foot.name for foot in found.feet] == feet
        choices = {"velocity_sites": [], "imu_site": ""}
    else:
        mesh = '<geom name="hull" type="mesh" mesh="torso" mass="0"/>'
        file = toy(tmp_path, inside=mesh, extra='<asset><mesh name="torso" file="torso.STL"/></asset>')
        feet, choices = ["left_foot", "right_foot"], {}
    robot = build_toy(file, colliders=feet, contact_geoms=feet, **choices)
    assert "collider of 'base' left out (no such file): " in " ".join(robot.overrides)
    assert not any(line.startswith(("warning: robot.urdf", "warning: toy.xml")) for line in robot.overrides)
    every = build_toy(file, colliders=["*"], contact_geoms=feet, **choices)
    assert any(line.startswith("warning: ") and "collides as the mesh" in line for line in every.overrides)
    name = "base" if kind == "URDF" else "hull"
    with pytest.raises(ValueError, match="collides as the mesh"):
        build_toy(file, colliders=[*feet, name], contact_geoms=feet, **choices)
