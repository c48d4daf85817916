"""Oddities of vendors' files, one each, in small files that are written for the test."""

from __future__ import annotations

import shutil
from pathlib import Path

import mujoco
import numpy as np
import pytest
from test_sim import build_toy, toy

from legged_mw.robot.draft import draft
from legged_mw.robot.measure import inside_by
from legged_mw.robot.mjcf import XmlSource
from legged_mw.robot.new import as_mjcf, class_name, targets, write
from legged_mw.robot.triangles import Triangles, read_triangles, thin, write_stl
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.model import read_file
from legged_mw.utils.errors import UserError
from legged_mw.utils.task import load_task

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
        choices = {"sites": {}, "imu_site": ""}
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


def test_the_first_of_several_materials_of_a_look_is_kept(tmp_path: Path) -> None:
    """Unitree's B2, whose exporter writes one material for each of a mesh's colours."""
    look = '<visual><geometry><sphere radius="0.1"/></geometry>{}</visual>'.format(
        "".join(f'<material name="m{k}"><color rgba="0.{k} 0 0 1"/></material>' for k in (1, 2))
    )
    robot = read_robot(urdf(tmp_path, base=look))
    assert "materials dropped: all but the first of 1 looks" in robot.notes
    assert any(geom.rgba[0] == pytest.approx(0.1) for geom in robot.spec.body("base").geoms)


def test_a_link_of_hardly_any_mass_has_none(tmp_path: Path) -> None:
    """Unitree's B2: links of sensors have 4e-15 kg and moments of 2e-27 kg m^2, which MuJoCo refuses."""
    file = urdf(tmp_path)
    speck = '<mass value="4e-15"/><inertia ixx="2e-27" ixy="0" ixz="0" iyy="2e-27" iyz="0" izz="2e-27"/>'
    joint = '<joint name="fixed" type="fixed"><parent link="base"/><child link="lidar"/></joint>'
    lidar = f'<link name="lidar"><inertial>{speck}</inertial></link>{joint}</robot>'
    file.write_text(file.read_text().replace("</robot>", lidar))
    robot = read_robot(file)
    assert "masses below 1e-09 kg dropped: those of link 'lidar'" in robot.notes
    assert robot.model.body_mass.sum() == pytest.approx(5.0)


def test_a_missing_mesh_at_the_end_of_a_leg_is_refused(tmp_path: Path) -> None:
    """The draft would stand on the other legs' feet alone."""
    file = urdf(tmp_path)
    left, right = file.read_text().split('<joint name="right_hip"')
    right = right.replace('xyz="0 -0.1 0"', 'xyz="0 -0.1 -0.15"').replace(FOOT, MESH)
    file.write_text(f'{left}<joint name="right_hip"{right}')
    with pytest.raises(
        UserError, match=r"link 'right_leg' collides as the mesh package://there/torso.STL, which cannot"
    ):
        draft(file)


# ---- looks: COLLADA, many triangles


QUAD = """<?xml version="1.0"?>{doctype}<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema"><asset><unit meter="0.01"/></asset>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array count="12">0 0 0 1 0 0 1 1 0 0 1 0.5</float_array>
<technique_common><accessor stride="3"/></technique_common></source><vertices id="v"><input semantic="POSITION" source="#s"/></vertices>
{faces}</mesh></geometry></library_geometries><library_visual_scenes><visual_scene>{nodes}</visual_scene></library_visual_scenes></COLLADA>"""
INPUTS = '<input semantic="VERTEX" source="#v" offset="0"/><input semantic="NORMAL" source="#n" offset="1"/>'
TRIANGLES = f'<triangles count="2">{INPUTS}<p>0 0 1 0 2 0 0 0 2 0 3 0</p></triangles>'
POLYLIST = f'<polylist count="1">{INPUTS}<vcount>4</vcount><p>0 0 1 0 2 0 3 0</p></polylist>'
POLYGONS = f"<polygons>{INPUTS}<p>0 0 1 0 2 0 3 0</p></polygons>"
NODE = '<node><translate>0 0 2</translate><rotate>0 0 1 90</rotate><instance_geometry url="#g"/></node>'


def dae(file: Path, faces: str = TRIANGLES, nodes: str = NODE, doctype: str = "") -> Path:
    file.write_text(QUAD.format(faces=faces, nodes=nodes, doctype=doctype))
    return file


@pytest.mark.parametrize("faces", [TRIANGLES, POLYLIST, POLYGONS])
def test_triangles_of_a_dae_are_placed_by_its_nodes_in_metres(faces: str, tmp_path: Path) -> None:
    mesh = read_triangles(dae(tmp_path / "a.dae", faces))
    corners = 0.01 * np.array([[0, 0, 2], [0, 1, 2], [-1, 1, 2], [-1, 0, 2.5]])
    first, second = mesh.points[mesh.faces]
    np.testing.assert_allclose(first, corners[[0, 1, 2]], atol=1e-12)
    np.testing.assert_allclose(second, corners[[0, 2, 3]], atol=1e-12)


def test_a_mirrored_node_keeps_its_outside(tmp_path: Path) -> None:
    for scale in ("1 1 1", "-1 1 1"):
        mesh = read_triangles(
            dae(tmp_path / "a.dae", nodes=f'<node><scale>{scale}</scale><instance_geometry url="#g"/></node>')
        )
        a, b, c = mesh.points[mesh.faces[0]]
        assert np.cross(b - a, c - a)[2] > 0.0


TWICE = "".join(
    f'<node id="n{i}"><instance_node url="#n{i + 1}"/><instance_node url="#n{i + 1}"/></node>' for i in range(40)
)


@pytest.mark.parametrize(
    "wrong",
    [
        {"doctype": '<!DOCTYPE a [<!ENTITY b "c">]>'},
        {"nodes": TWICE},
        {"nodes": '<node id="n"><instance_node url="#n"/></node>'},
        {"nodes": "<node>" * 300 + "</node>" * 300},
        {"nodes": '<node><rotate>0 0 1</rotate><instance_geometry url="#g"/></node>'},
        {"nodes": '<node><matrix>1 2 3</matrix><instance_geometry url="#g"/></node>'},
        {"nodes": '<node><scale>nan 1 1</scale><instance_geometry url="#g"/></node>'},
        {"nodes": ""},
        {"faces": TRIANGLES.replace("3 0</p>", "9 0</p>")},
        {"faces": TRIANGLES.replace("3 0</p>", "-3 0</p>")},
        {"faces": TRIANGLES.replace("3 0</p>", "3</p>")},
        {"faces": TRIANGLES.replace("3 0</p>", f"{10**30} 0</p>")},
        {"faces": TRIANGLES.replace("#v", "#w")},
        {"faces": TRIANGLES.replace('offset="1"', f'offset="{10**12}"')},
        {"faces": POLYLIST.replace("<vcount>4", "<vcount>-4 -1")},
    ],
)
def test_a_hostile_dae_is_looks_that_are_left_out(wrong: dict[str, str], tmp_path: Path) -> None:
    dae(tmp_path / "a.dae", **wrong)
    with pytest.raises(ValueError):
        read_triangles(tmp_path / "a.dae")
    visual = '<visual><geometry><mesh filename="a.dae"/></geometry></visual>'
    (line,) = [line for line in read_robot(urdf(tmp_path, base=visual)).notes if line.startswith("looks left out")]
    assert "a.dae" in line


def ball(turns: int) -> Triangles:
    """A sphere of radius 1 m."""
    polar, around = np.meshgrid(np.linspace(0, np.pi, turns), np.linspace(0, 2 * np.pi, turns), indexing="ij")
    points = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], -1)
    i = np.arange(turns * turns).reshape(turns, turns)
    a, b, c, d = (each.ravel() for each in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    return Triangles(points.reshape(-1, 3), np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))


def test_thinned_triangles_keep_the_shape() -> None:
    few = thin(ball(200), 2000)
    assert 500 < len(few.faces) <= 2000
    np.testing.assert_allclose(np.linalg.norm(few.points, axis=1), 1.0, atol=0.02)
    a, b, c = (few.points[few.faces[:, i]] for i in range(3))
    outwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c)
    assert (outwards > 0.0).mean() > 0.98
    assert thin(few, 2000) is few


def test_a_mesh_of_more_faces_than_mujoco_reads_is_looks(tmp_path: Path) -> None:
    write_stl(ball(330), tmp_path / "shell.STL")
    robot = read_robot(urdf(tmp_path, base='<visual><geometry><mesh filename="shell.STL"/></geometry></visual>'))
    assert not any("left out" in line for line in robot.notes)
    spec = robot.spec.copy()
    spec.compiler.discardvisual = False
    assert 1000 < spec.compile().nmeshface <= 5000


# ---- a draft and what it needs


def drafted(file: Path, folder: Path, **choices: bool) -> list[Path]:
    found = draft(file)
    return write(found, file, "mine", folder, **choices)


def test_a_packed_draft_can_be_moved(tmp_path: Path) -> None:
    """Looks are thinned, colliders are copied as they are, and nothing is named outside of the folder."""
    vendor, made, moved = tmp_path / "vendor", tmp_path / "made", tmp_path / "moved"
    (vendor / "meshes").mkdir(parents=True)
    write_stl(ball(330), vendor / "meshes/shell.STL")
    write_stl(ball(20), vendor / "meshes/hull.stl")
    dae(vendor / "meshes/lid.dae")
    parts = "".join(
        f'<{kind}><geometry><mesh filename="package://vendor/meshes/{name}" scale="0.1 0.1 0.1"/></geometry></{kind}>'
        for kind, name in (("visual", "shell.STL"), ("visual", "lid.dae"), ("collision", "hull.stl"))
    )
    file = urdf(vendor, base=parts)
    robot, config, folder = drafted(file, made)
    assert sorted(path.name for path in folder.iterdir()) == ["hull.stl", "shell_0.stl"]  # the lid is short text
    assert (folder / "hull.stl").read_bytes() == (vendor / "meshes/hull.stl").read_bytes()
    before = read_robot(file)
    shutil.rmtree(vendor)
    made.rename(moved)
    after = read_robot(moved / robot.name)
    assert not any("left out" in line for line in after.notes)
    assert str(tmp_path) not in (moved / robot.name).read_text() and ".." not in (moved / robot.name).read_text()
    assert XmlSource(moved / robot.name, alone=True).named
    np.testing.assert_allclose(after.model.body_mass, before.model.body_mass, rtol=1e-5)
    task = load_task(str(moved / config.name))
    task.set("env.num_envs", 1)
    task.set("sim.engine", "mujoco")
    assert task.env_class(task.cfg, "cpu", eager=True).num_actions == 2


def test_a_draft_may_name_the_files_where_they_lie(tmp_path: Path) -> None:
    (tmp_path / "vendor").mkdir()
    write_stl(ball(20), tmp_path / "vendor/hull.stl")
    part = '<collision><geometry><mesh filename="hull.stl" scale="0.1 0.1 0.1"/></geometry></collision>'
    robot, _ = drafted(urdf(tmp_path / "vendor", base=part), tmp_path / "made", pack=False)
    assert 'file="../vendor/hull.stl"' in robot.read_text()


def test_names_of_feet_and_classes() -> None:
    assert [class_name(name) for name in ("h1_2", "my_dog", "b2", "g1_12dof", "a_1", "x2_y")] == [
        *("H1_2", "MyDog", "B2", "G1_12dof", "A1", "X2Y"),
    ]


def test_a_foot_is_not_called_by_the_number_of_its_geom(tmp_path: Path) -> None:
    """B2 of unitree_mujoco: its feet are the seventh geoms of its calves."""
    shin = FOOT.replace("-0.2", "-0.1").replace("sphere", "box").replace('radius="0.03"', 'size="0.01 0.01 0.1"')
    feet = draft(urdf(tmp_path, leg=shin + FOOT)).feet
    assert [(foot.name, foot.geoms) for foot in feet] == [
        ("left_foot", ("left_leg_1",)),
        ("right_foot", ("right_leg_1",)),
    ]


def test_the_vendors_own_file_is_never_overwritten(tmp_path: Path) -> None:
    write_stl(ball(20), tmp_path / "hull.stl")
    asset = '<asset><mesh name="hull" file="hull.stl" scale="0.1 0.1 0.1"/></asset>'
    file = toy(tmp_path, inside='<geom type="mesh" mesh="hull" mass="0"/>', extra=asset)
    text = file.read_text()
    for force in (False, True):
        with pytest.raises(UserError, match="the robot's own file"):
            targets("toy", tmp_path, file, force)
    assert file.read_text() == text


def test_meshes_that_lie_where_a_draft_puts_its_own_are_never_overwritten(tmp_path: Path) -> None:
    """Not without --force, and with it not those that the source itself names."""
    parts = tmp_path / "mine_parts"
    parts.mkdir()
    write_stl(ball(20), parts / "hull.stl")
    asset = '<asset><mesh name="hull" file="mine_parts/hull.stl" scale="0.1 0.1 0.1"/></asset>'
    look = '<geom type="mesh" mesh="hull" mass="0" contype="0" conaffinity="0"/>'
    file, kept = toy(tmp_path, inside=look, extra=asset), (parts / "hull.stl").read_bytes()
    with pytest.raises(UserError, match="mine_parts exists; say another name"):
        targets("mine", tmp_path, file)
    text = as_mjcf("mine", file, tmp_path, parts)
    assert (parts / "hull.stl").read_bytes() == kept and 'file="mine_parts/hull_.stl"' in text
    (tmp_path / "mine.xml").write_text(text)
    assert read_robot(tmp_path / "mine.xml").spec.mesh("hull") is not None


def test_a_class_may_name_a_material_that_is_not_there(tmp_path: Path) -> None:
    """Lite3 of DeepRobotics: each geom of the class overrides it by nothing, which MuJoCo's writer leaves out."""
    default = '<default><default class="look"><geom material="none"/></default></default>'
    look = '<geom name="lid" class="look" material="" size="0.1" contype="0" conaffinity="0" mass="0"/>'
    file = toy(tmp_path, inside=look, extra=default)
    (tmp_path / "out").mkdir()
    (tmp_path / "out/mine.xml").write_text(as_mjcf("mine", file, tmp_path / "out"))
    assert read_robot(tmp_path / "out/mine.xml").spec.geom("lid") is not None


def test_many_points_hold_a_robot_as_their_hull_does() -> None:
    """H1_2 12 of unitree_rl_gym stood on 1,432 points of its feet's meshes, whose pairs took 22 GB."""
    generator = np.random.default_rng(0)
    corners = np.array([[-0.1, -0.2], [0.1, -0.2], [0.1, 0.2], [-0.1, 0.2]])
    points = np.concatenate([corners, generator.uniform([-0.1, -0.2], [0.1, 0.2], (1500, 2))])
    for place, margin in (([0.0, 0.0], 0.1), ([0.07, 0.0], 0.03), ([0.15, 0.0], -0.05), ([0.13, 0.24], -0.05)):
        assert inside_by(points, np.array(place)) == pytest.approx(margin, abs=1e-9)
