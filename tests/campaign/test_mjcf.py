"""Robots' files: names that are ours, numbers that no machine has, bombs, and files that are somewhere else."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from attack import Case, attack, program

from legged_mw import ROOT
from legged_mw.drawing.scene import visual_model
from legged_mw.rl.export_scene import standalone
from legged_mw.sim.vendor import read_robot
from legged_mw.utils.task import load_task

GO1 = (ROOT / "resources/robots/go1/go1.xml").read_text()
URDF = """<robot name="a"><link name="base"><inertial><mass value="3"/>{0}</inertial></link>
<link name="leg"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="knee" type="revolute"><parent link="base"/><child link="leg"/><axis xyz="{2}"/><limit {1}/></joint></robot>"""
INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
LIMIT = 'lower="-1" upper="1" effort="5" velocity="9"'


def given(text: str | bytes, name: str = "robot.xml") -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes(text.encode() if isinstance(text, str) else text)


def reads(name: str = "robot.xml") -> Callable[[Path], object]:
    return lambda root: read_robot(root / name)


def first(pattern: str, new: str) -> str:
    """The Go1 with the first match of ``pattern`` replaced."""
    found, count = re.subn(pattern, new, GO1, count=1)
    assert count == 1, pattern
    return found


def more(text: str, inside: str = "mujoco") -> str:
    """The Go1 with more at the end of an element."""
    return first(f"</{inside}>", f"{text}</{inside}>")


TEXTS: list[tuple[str, str | bytes, str]] = [
    ("negative mass", first('mass="[^"]*"', 'mass="-1"'), 'line 32: mass="-1" must be from 0 to 100000'),
    ("NaN mass", first('mass="[^"]*"', 'mass="nan"'), 'mass="nan" is not a number'),
    ("mass of 10^30", first('mass="[^"]*"', 'mass="1e30"'), 'mass="1e30" must be from 0 to 100000'),
    ("infinite mass", first('mass="[^"]*"', 'mass="inf"'), 'mass="inf" must be from 0 to 100000'),
    ("no mass", first('(<inertial[^>]*)mass="[^"]*"', r'\1mass="0"'), "mass and inertia of moving bodies must be larger"),
    ("negative inertia", first('diaginertia="[^"]*"', 'diaginertia="-1 -1 -1"'), 'diaginertia="-1 -1 -1" must be from 0 to'),
    ("NaN inertia", first('diaginertia="[^"]*"', 'diaginertia="nan 1 1"'), 'diaginertia="nan 1 1" is not a number'),
    ("inertia of 10^30", first('diaginertia="[^"]*"', 'diaginertia="1e30 1e30 1e30"'), "must be from 0 to 1e+06"),
    ("density of 10^30", first("<geom ", '<geom density="1e30" '), 'density="1e30" must be from 0 to'),
    ("a range that ends first", first(' range="[^"]*"', ' range="1 -1"'), 'line 14: range="1 -1" ends before it begins'),
    (
        "a force range that ends first",
        more('<actuator><motor joint="FR_hip_joint" forcerange="5 -5"/></actuator>'),
        "ends before it begins",
    ),
    ("NaN gravity", first("<compiler", '<option gravity="0 0 nan"/><compiler'), 'line 8: gravity="0 0 nan" is not a number'),
    ("gravity of 10^9", first("<compiler", '<option gravity="0 0 -1e9"/><compiler'), "gravity is 0 0 -1e+09 m/s^2"),
    ("infinite gravity", first("<compiler", '<option gravity="0 0 inf"/><compiler'), "gravity is 0 0 inf m/s^2"),
    ("negative timestep", first("<compiler", '<option timestep="-1"/><compiler'), "timestep is -1 s"),
    ("NaN place", first(' pos="[^"]*"', ' pos="nan 0 0"'), 'pos="nan 0 0" is not a number'),
    ("infinite place", first('name="FR_hip" pos="[^"]*"', 'name="FR_hip" pos="inf 0 0"'), "pos of body 'FR_hip' is inf"),
    ("a turn of no length", first(' quat="[^"]*"', ' quat="0 0 0 0"'), "zero quaternion is not allowed"),
    ("negative size", first(' size="[^"]*"', ' size="-1 -1 -1"'), "must be positive"),
    ("size of 10^30", first(' size="[^"]*"', ' size="1e30 1e30 1e30"'), "size of geom 'trunk_right' is 1e+30"),
    ("an axis of no length", first(' axis="[^"]*"', ' axis="0 0 0"'), "axis too small in joint"),
    ("negative armature", first(' armature="[^"]*"', ' armature="-1"'), 'armature="-1" must be from 0'),
    ("NaN damping", first("<joint ", '<joint damping="nan" '), 'damping="nan" is not a number'),
    ("a name twice", GO1.replace('name="FR_hip_1"', 'name="FR_hip_2"'), "repeated name 'FR_hip_2' in geom"),
    ("entities", '<!DOCTYPE a [<!ENTITY b "c">]>' + GO1, "line 1: it defines entities; write out what they stand for"),
    ("a bomb of entities", '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;&b;">]><mujoco model="&c;"/>', "it defines entities"),
    ("an entity of a file", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>' + GO1, "it defines entities"),
    ("include from above", more('<include file="../x.xml"/>'), "it includes ../x.xml, which lies outside of its own folder"),
    ("include from anywhere", more('<include file="/etc/passwd"/>'), "it includes /etc/passwd, which lies outside of its own folder"),
    ("include by a crooked way", more("<include file = 'a/../../x.xml' />"), "it includes a/../../x.xml, which lies outside"),
    ("a model from above", more('<asset><model name="m" file="../x.xml"/></asset>'), "it includes ../x.xml, which lies outside"),
    ("include of itself", more('<include file="robot.xml"/>'), "'robot.xml' already included"),
    ("include of nothing", more('<include file="none.xml"/>'), "Error opening file 'none.xml'"),
    ("10^9 copies", more('<replicate count="1000000000"><geom size="1"/></replicate>', "worldbody"), 'count="1000000000" must be'),
    ("copies of copies", more('<replicate count="9000">' * 3 + "</replicate>" * 3, "worldbody"), "makes more than 100000 copies"),
    (
        "a height field of 10^10",
        more('<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>', "asset"),
        'nrow="100000" must be',
    ),
    ("room of 400 GB", first("<worldbody>", '<size memory="400G"/><worldbody>'), "Could not allocate memory"),
    ("10^9 numbers a body", first("<worldbody>", '<size nuser_body="1000000000"/><worldbody>'), 'nuser_body="1000000000" must be from 0'),
    ("a mesh without end", more('<mesh name="z" file="/dev/zero"/>', "asset"), "/dev/zero is no file"),
    ("nothing", "", "empty file"),
    ("zeros", b"\0" * 99, "robot.xml is not a valid MJCF"),
    ("cut", GO1[:3000], "XML parse error"),
    ("3000 deep", "<mujoco><worldbody>" + '<body><joint/><geom size="1"/>' * 3000 + "</body>" * 3000 + "</worldbody></mujoco>", "too deep"),
    ("no robot", "<mujoco/>", "it must hold a robot"),
    ("no XML", "legs: 4", "robot.xml is not a valid MJCF"),
]


@pytest.mark.parametrize(("text", "says"), [entry[1:] for entry in TEXTS], ids=[entry[0] for entry in TEXTS])
def test_mjcf(text: str | bytes, says: str, tmp_path: Path) -> None:
    attack(Case("", reads(), ("robot.xml ", says), given=given(text)), tmp_path)


PLAIN = URDF.format(INERTIA, LIMIT, "0 1 0")
URDFS: list[tuple[str, str, str]] = [
    (
        "negative mass",
        PLAIN.replace('mass value="3"', 'mass value="-3"'),
        "mass and inertia of moving bodies",
    ),
    ("NaN mass", PLAIN.replace('mass value="3"', 'mass value="nan"'), 'value="nan" is not a number'),
    (
        "range that ends first",
        PLAIN.replace('lower="-1" upper="1"', 'lower="1" upper="-1"'),
        "range of joint 'knee' is from 1 to -1",
    ),
    ("speed of words", PLAIN.replace('velocity="9"', 'velocity="fast"'), "'fast'"),
    ("no axis", URDF.format(INERTIA, LIMIT, "0 0 0"), "axis"),
    ("a bomb", '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>', "it defines entities"),
    ("20000 deep", '<robot name="a"><link name="l">' + "<a>" * 20_000 + "</a>" * 20_000 + "</link></robot>", "it is nested too deeply"),
    ("two roots", '<robot name="a"><link name="a"/><link name="b"/></robot>', "robot.urdf"),
    ("a circle", PLAIN.replace('parent link="base"', 'parent link="leg"'), "robot.urdf"),
]


@pytest.mark.parametrize(("text", "says"), [entry[1:] for entry in URDFS], ids=[entry[0] for entry in URDFS])
def test_urdf(text: str, says: str, tmp_path: Path) -> None:
    attack(Case("", reads("robot.urdf"), ("robot.urdf", says), given=given(text, "robot.urdf")), tmp_path)


def linked(root: Path) -> None:
    (root / "robot.xml").write_text(more('<include file="part.xml"/>'))
    (root / "part.xml").symlink_to("/etc/passwd")


def part_with_nan(root: Path) -> None:
    (root / "robot.xml").write_text(more('<include file="part.xml"/>'))
    (root / "part.xml").write_text('<mujoco>\n<option gravity="0 0 nan"/></mujoco>')


def endless_mesh(root: Path) -> None:
    (root / "robot.xml").write_text(more('<mesh name="z" file="z.stl"/>', "asset"))
    (root / "z.stl").symlink_to("/dev/zero")


BAD = given(first("<compiler", '<option gravity="0 0 nan"/><compiler'))
OTHERS = [
    Case("include through a link", reads(), "it includes part.xml, which lies outside of its own folder", given=linked),
    Case("NaN in a part", reads(), 'part.xml: line 2: gravity="0 0 nan" is not a number', given=part_with_nan),
    Case("no file", reads(), "no MJCF at "),
    Case("a folder", reads(), "no MJCF at ", given=lambda root: (root / "robot.xml").mkdir()),
    Case("a mesh that links to a device", reads(), "z.stl is no file", given=endless_mesh),
    Case("the health page of it", program("robot", "ROOT/robot.xml"), "robot.xml", given=BAD),
    Case("a task of it", program("train", "--check", "--set", "asset.file=ROOT/robot.xml"), 'gravity="0 0 nan" is not a number', given=BAD),
]


@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.id)
def test_others(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)


def test_names_that_are_ours(tmp_path: Path) -> None:
    """They are renamed, and what refers to them follows."""
    text = GO1.replace('name="FR_hip_1"', 'name="floor"').replace('name="trunk_box"', 'name="floor/0"').replace('"rubber"', '"ground"')
    text = text.replace("</mujoco>", '<sensor><touch name="contact/FR" site="imu"/><rangefinder name="up/x" site="imu"/></sensor></mujoco>')
    given(text)(tmp_path)
    robot = read_robot(tmp_path / "robot.xml")
    names = {kind: [thing.name for thing in getattr(robot.spec, kind)] for kind in ("geoms", "materials", "sensors")}
    assert {"robot_floor", "robot_floor/0"} <= {*names["geoms"]} and "robot_ground" in names["materials"]
    assert names["sensors"] == ["robot_contact/FR", "robot_up/x"]
    assert "robot_ground" in [geom.material for geom in robot.spec.geoms]
    assert "geom 'floor' is called 'robot_floor': the first name is one of ours" in robot.notes


def test_a_robot_whose_names_are_ours_trains(tmp_path: Path) -> None:
    """Also the names that an export and a picture add."""
    text = GO1.replace('"rubber"', '"ground"').replace('"metal"', '"sky"').replace('"dark"', '"around"').replace('"lens"', '"relief"')
    text = text.replace('name="FR_hip_1"', 'name="floor/3"')
    given(text)(tmp_path)
    task = load_task("go1_flat")
    for path, value in {"asset.file": str(tmp_path / "robot.xml"), "env.num_envs": 1, "sim.engine": "mujoco"}.items():
        task.set(path, value)
    robot = task.env_class(task.cfg, "cpu", eager=True).robot
    visual_model(robot)
    scene = standalone(robot, robot.imu, [0, 0, 0.3, 1, 0, 0, 0, *robot.pose], list(robot.pose))
    assert 'name="robot_ground"' in scene.xml and 'name="ground"' in scene.xml
