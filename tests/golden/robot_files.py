"""MJCF and URDF: numbers that no machine has, bombs, files that are somewhere else, and what a robot's names must fit."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

from attack import program
from test_sim import build_toy
from worlds import make_env

from golden.table import Run, Table
from legged_mw import ROOT
from legged_mw.robot.draft import draft
from legged_mw.sim.model import read_file

GO1 = (ROOT / "resources/robots/go1/go1.xml").read_text()
URDF = """<robot name="a"><link name="base"><inertial><mass value="3"/>{0}</inertial></link>
<link name="leg"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="knee" type="revolute"><parent link="base"/><child link="leg"/><axis xyz="{2}"/><limit {1}/></joint></robot>"""
INERTIA = '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/>'
LIMIT = 'lower="-1" upper="1" effort="5" velocity="9"'


def given(text: str | bytes, name: str = "robot.xml") -> Callable[[Path], object]:
    return lambda root: (root / name).write_bytes(text.encode() if isinstance(text, str) else text)


def reads(name: str = "robot.xml") -> Callable[[Path], object]:
    return lambda root: read_file(root / name)


def first(pattern: str, new: str) -> str:
    """The Go1 with the first match of ``pattern`` replaced."""
    found, count = re.subn(pattern, new, GO1, count=1)
    assert count == 1, pattern
    return found


def more(text: str, inside: str = "mujoco") -> str:
    """The Go1 with more at the end of an element."""
    return first(f"</{inside}>", f"{text}</{inside}>")


MJCFS: dict[str, str | bytes] = {
    "negative mass": first('mass="[^"]*"', 'mass="-1"'),
    "NaN mass": first('mass="[^"]*"', 'mass="nan"'),
    "mass of 10^30": first('mass="[^"]*"', 'mass="1e30"'),
    "infinite mass": first('mass="[^"]*"', 'mass="inf"'),
    "no mass": first('(<inertial[^>]*)mass="[^"]*"', r'\1mass="0"'),
    "negative inertia": first('diaginertia="[^"]*"', 'diaginertia="-1 -1 -1"'),
    "NaN inertia": first('diaginertia="[^"]*"', 'diaginertia="nan 1 1"'),
    "inertia of 10^30": first('diaginertia="[^"]*"', 'diaginertia="1e30 1e30 1e30"'),
    "density of 10^30": first("<geom ", '<geom density="1e30" '),
    "a range that ends first": first(' range="[^"]*"', ' range="1 -1"'),
    "a force range that ends first": more('<actuator><motor joint="FR_hip_joint" forcerange="5 -5"/></actuator>'),
    "NaN gravity": first("<compiler", '<option gravity="0 0 nan"/><compiler'),
    "gravity of 10^9": first("<compiler", '<option gravity="0 0 -1e9"/><compiler'),
    "infinite gravity": first("<compiler", '<option gravity="0 0 inf"/><compiler'),
    "negative timestep": first("<compiler", '<option timestep="-1"/><compiler'),
    "NaN place": first(' pos="[^"]*"', ' pos="nan 0 0"'),
    "infinite place": first('name="FR_hip" pos="[^"]*"', 'name="FR_hip" pos="inf 0 0"'),
    "a turn of no length": first(' quat="[^"]*"', ' quat="0 0 0 0"'),
    "negative size": first(' size="[^"]*"', ' size="-1 -1 -1"'),
    "size of 10^30": first(' size="[^"]*"', ' size="1e30 1e30 1e30"'),
    "an axis of no length": first(' axis="[^"]*"', ' axis="0 0 0"'),
    "negative armature": first(' armature="[^"]*"', ' armature="-1"'),
    "NaN damping": first(' damping="[^"]*"', ' damping="nan"'),
    "a name twice": GO1.replace('name="FR_hip_1"', 'name="FR_hip_2"'),
    "entities": '<!DOCTYPE a [<!ENTITY b "c">]>' + GO1,
    "a bomb of entities": '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;&b;">]><mujoco model="&c;"/>',
    "an entity of a file": '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>' + GO1,
    "a definition elsewhere": '<!DOCTYPE a SYSTEM "/etc/passwd">' + GO1,
    "include from above": more('<include file="../x.xml"/>'),
    "include from anywhere": more('<include file="/etc/passwd"/>'),
    "include by a crooked way": more("<include file = 'a/../../x.xml' />"),
    "a model from above": more('<asset><model name="m" file="../x.xml"/></asset>'),
    "include of itself": more('<include file="robot.xml"/>'),
    "a model of itself": more('<model name="m" file="robot.xml"/>', "asset"),
    "include of nothing": more('<include file="none.xml"/>'),
    "include by reference": more('<include file="..&#47;x.xml"/>'),
    "include between attributes": more(
        '<custom><text name="<!--" data="a"/></custom><include file="/etc/passwd"/><custom><text name="-->" data="a"/></custom>'
    ),
    "NaN by reference": first('mass="[^"]*"', 'mass="&#110;a&#x6E;"'),
    "a number by reference": first('mass="[^"]*"', 'mass="1&#101;30"'),
    "10^9 copies": more('<replicate count="1000000000"><geom size="1"/></replicate>', "worldbody"),
    "copies of copies": more('<replicate count="9000">' * 3 + "</replicate>" * 3, "worldbody"),
    "copies of many things": more(
        '<replicate count="300">' * 2 + "<geom size='1'/>" * 20 + "</replicate>" * 2, "worldbody"
    ),
    "copies, counted in other words": more('<replicate count="0x2710"><geom size="1"/></replicate>', "worldbody"),
    "a height field of 4 10^8": more('<hfield name="h" nrow="20000" ncol="20000" size="1 1 1 1"/>', "asset"),
    "height fields of 10^8": more('<hfield nrow="5000" ncol="5000" size="1 1 1 1"/>' * 4, "asset"),
    "a picture of 2 10^8": more('<texture builtin="flat" width="16384" height="16384"/>', "asset"),
    "400 joints in a row": "<mujoco><worldbody>"
    + '<body><joint/><geom size="1"/>' * 400
    + "</body>" * 400
    + "</worldbody></mujoco>",
    "a mesh name of 5000": more(f'<mesh name="z" file="{"x" * 5000}.stl"/>', "asset"),
    "an include of 5000": more(f'<include file="{"x" * 5000}"/>'),
    "files in many folders": more(
        "".join(f'<mesh file="{i}.stl"/><compiler meshdir="{i}"/>' for i in range(400)), "asset"
    ),
    "an element of 20 MB": f'<mujoco model="{"x" * (20 << 20)}"/>',
    "200 kB of comments without end": "<mujoco>" + "<!--" * 50_000,
    "comments without end": "<mujoco>" + "<!--" * 5000,
    "many attributes": "<mujoco><option " + " ".join(f"a{i}='1'" for i in range(300)) + "/></mujoco>",
    "200 kB of includes without end": "<mujoco>" + "<include " * 22_000,
    "another encoding": GO1.encode("utf-16"),
    "a height field of 10^10": more('<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>', "asset"),
    "room of 400 GB": first("<worldbody>", '<size memory="400G"/><worldbody>'),
    "10^9 numbers a body": first("<worldbody>", '<size nuser_body="1000000000"/><worldbody>'),
    "a mesh without end": more('<mesh name="z" file="/dev/zero"/>', "asset"),
    "nothing": "",
    "zeros": b"\0" * 99,
    "cut": GO1[:3000],
    "3000 deep": "<mujoco><worldbody>"
    + '<body><joint/><geom size="1"/>' * 3000
    + "</body>" * 3000
    + "</worldbody></mujoco>",
    "no robot": "<mujoco/>",
    "no XML": "legs: 4",
}
MESH = '<visual><geometry><mesh filename="{0}"/></geometry></visual>'
PLAIN = URDF.format(INERTIA, LIMIT, "0 1 0")
URDFS = {
    "negative mass": PLAIN.replace('mass value="3"', 'mass value="-3"'),
    "NaN mass": PLAIN.replace('mass value="3"', 'mass value="nan"'),
    "range that ends first": PLAIN.replace('lower="-1" upper="1"', 'lower="1" upper="-1"'),
    "speed of words": PLAIN.replace('velocity="9"', 'velocity="fast"'),
    "no axis": URDF.format(INERTIA, LIMIT, "0 0 0"),
    "a bomb": '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>',
    "a mesh name of 5000": PLAIN.replace("</link>", MESH.format("x" * 5000) + "</link>", 1),
    "a mesh without end": PLAIN.replace("</link>", MESH.format("/dev/zero") + "</link>", 1),
    "include": PLAIN.replace("</link>", '<include file="/etc/passwd"/></link>', 1),
    "20000 deep": '<robot name="a"><link name="l">' + "<a>" * 20_000 + "</a>" * 20_000 + "</link></robot>",
    "two roots": '<robot name="a"><link name="a"/><link name="b"/></robot>',
    "a circle": PLAIN.replace('parent link="base"', 'parent link="leg"'),
}


def linked(root: Path) -> None:
    (root / "robot.xml").write_text(more('<include file="part.xml"/>'))
    (root / "part.xml").symlink_to("/etc/passwd")


def part_with_nan(root: Path) -> None:
    (root / "robot.xml").write_text(more('<include file="part.xml"/>'))
    (root / "part.xml").write_text('<mujoco>\n<option gravity="0 0 nan"/></mujoco>')


def endless_mesh(root: Path) -> None:
    (root / "robot.xml").write_text(more('<mesh name="z" file="z.stl"/>', "asset"))
    (root / "z.stl").symlink_to("/dev/zero")


def piped(text: str, inside: str) -> Callable[[Path], object]:
    """The Go1 with more in it, which names the pipe p/q."""

    def given_pipe(root: Path) -> None:
        (root / "robot.xml").write_text(more(text, inside))
        (root / "p").mkdir()
        os.mkfifo(root / "p/q")

    return given_pipe


def models_of_models(root: Path) -> None:
    """Each attaches the next one twice: 2^30 bodies."""
    for i in range(30):
        name, last = (f"{i}.xml" if i else "robot.xml"), i == 29
        asset = "" if last else f'<asset><model name="m" file="{i + 1}.xml"/></asset>'
        two = "" if last else "".join(f'<frame><attach model="m" body="b" prefix="{side}_"/></frame>' for side in "ab")
        (root / name).write_text(
            f'<mujoco>{asset}<worldbody><body name="b"><joint/><geom size="1"/>{two}</body></worldbody></mujoco>'
        )


def includes_in_a_circle(root: Path) -> None:
    (root / "robot.xml").write_text(more('<include file="part.xml"/>'))
    (root / "part.xml").write_text('<mujoco><include file="robot.xml"/></mujoco>')


PIPES = {
    "mesh": ('<mesh name="z" file="p/q"/>', "asset"),
    "mesh in a folder": ('<compiler meshdir="p"/><asset><mesh name="z" file="q"/></asset>', "mujoco"),
    "mesh by its last name": (
        '<compiler strippath="true" meshdir="p"/><asset><mesh name="z" file="C:/there/q"/></asset>',
        "mujoco",
    ),
    "picture": ('<texture name="z" type="2d" file="p/q"/>', "asset"),
    "side of a picture": ('<texture name="z" type="cube" fileleft="p/q"/>', "asset"),
    "height field": ('<hfield name="z" size="1 1 1 1" file="p/q"/>', "asset"),
    "skin": ('<skin name="z" file="p/q"/>', "asset"),
    "flexcomp": ('<body><flexcomp name="z" type="mesh" file="p/q"/></body>', "worldbody"),
    "include": ('<include file="p/q"/>', "mujoco"),
    "model": ('<model name="z" file="p/q"/>', "asset"),
}
BAD = given(first("<compiler", '<option gravity="0 0 nan"/><compiler'))
OTHERS: dict[str, tuple[Run, Run]] = {  # what is read, and the folder before
    "include through a link": (reads(), linked),
    "NaN in a part": (reads(), part_with_nan),
    "no file": (reads(), lambda root: None),
    "a folder": (reads(), lambda root: (root / "robot.xml").mkdir()),
    **{f"a pipe: {name}": (reads(), piped(*where)) for name, where in PIPES.items()},
    "models of models": (reads(), models_of_models),
    "includes in a circle": (reads(), includes_in_a_circle),
    "what is no robot's file": (program("train", "--check", "--set", "asset.file=/etc/passwd"), lambda root: None),
    "a mesh that links to a device": (reads(), endless_mesh),
    "the health page of it": (program("robot", "ROOT/robot.xml"), BAD),
    "a task of it": (program("train", "--check", "--set", "asset.file=ROOT/robot.xml"), BAD),
}
TOY = """<mujoco model="toy"><worldbody><body name="base" pos="0 0 1"><freejoint/><geom name="trunk" size="0.1" mass="3"/>
<body name="leg"><joint name="hip" axis="0 1 0"/>{}
<geom name="shin" size="0.05" pos="0 0 -0.2" mass="1"/></body></body>{}</worldbody>{}</mujoco>"""
TEXTS = {
    "a rock": '<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>',
    "an attribute that is not there": "<mujoco><worldbody><geom typ='box'/></worldbody></mujoco>",
    "an empty world": "<mujoco><worldbody/></mujoco>",
    "two robots": TOY.format("", '<body name="other"><freejoint/><geom size="1"/></body>', ""),
    "no free root": TOY.replace("<freejoint/>", '<joint name="slider" type="slide"/>').format("", "", ""),
    "no joint": '<mujoco><worldbody><body name="rock"><freejoint/><geom size="1"/></body></worldbody></mujoco>',
    "a joint without a name": TOY.replace('<joint name="hip"', "<joint").format("", "", ""),
    "a ball": TOY.format('</body><body name="arm"><joint name="ball" type="ball"/><geom size="0.1"/>', "", ""),
    "a mesh of mass": TOY.format(
        '<geom type="mesh" mesh="hull"/>', "", '<asset><mesh name="hull" file="hull.stl"/></asset>'
    ),
    "looks of mass": TOY.format(
        '<geom type="mesh" mesh="hull" contype="0" conaffinity="0"/>',
        "",
        '<asset><mesh name="hull" file="hull.stl"/></asset>',
    ),
}
MINI = """<robot name="mini"><link name="base">{}<inertial><mass value="1"/>
<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
MINIS = {
    "xacro": '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" name="a"><xacro:macro name="x"/></robot>',
    "not closed": '<robot name="mini"><link name="base"></robot>',
    "a shape of no size": MINI.format('<collision><geometry><sphere radius="0"/></geometry></collision>'),
}
MESH_OF = '<collision><geometry><mesh filename="package://a/b{}"/></geometry></collision>'
LOST: dict[str, tuple[str, str]] = {  # a file whose leg is a mesh that cannot be read, and its text
    "a geom": (
        "robot.xml",
        TOY.format(
            '<geom type="mesh" mesh="hull" mass="0"/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>',
            "",
            '<asset><mesh name="hull" file="hull.stl"/></asset>',
        ).replace('<geom name="shin" size="0.05" pos="0 0 -0.2" mass="1"/>', ""),
    ),
    **{
        f"a link, {ending}": (
            "robot.urdf",
            PLAIN.replace("</inertial></link>", f"</inertial>{MESH_OF.format(ending)}</link>"),
        )
        for ending in (".stl", ".ply")
    },
}
WHEELED = """<mujoco><compiler angle="radian"/><worldbody><body name="trunk" pos="0 0 0.3"><freejoint/>
<geom name="trunk" type="box" size="0.3 0.1 0.05" mass="5"/>{}</body></worldbody></mujoco>""".format(
    "".join(
        f'<body name="{side}" pos="{0.2 if side[0] == "F" else -0.2} {0.15 if side[1] == "L" else -0.15} -0.2">'
        f'<joint name="{side}_wheel" axis="0 1 0"/><geom name="{side}_tyre" type="cylinder" size="0.1 0.02" zaxis="0 1 0" mass="1"/></body>'
        for side in ("FL", "FR", "RL", "RR")
    )
)
WHOLE = ("control.stiffness", "control.damping", "control.action_scale", "rewards.pose_weights")  # tables of all joints
SILENT = ("init_state.default_joint_angles", "asset.joint_speed_limits")
FIELDS = {  # of go1_flat
    "no joint": {"asset.armature": {"kneee": 0.1}},
    "two keys": {"control.stiffness": {"FR_hip": 1.0, "hip_jo": 2.0, "": 3.0}},
    "no value": {"control.damping": {"hip": 1.0}},
    "a foot": {"asset.foot_names": ["left_foot", "FL", "RR", "RL"]},
    "an IMU": {"asset.imu_site": "nose"},
    "an IMU on a leg": {"asset.imu_site": "FR_calf"},
    "a held joint": {"asset.held_joints": {"neck": 0.0}},
    "a held joint of none": {"asset.held_joints": ["neck"]},
    "no value in three tables": {
        "control.stiffness": {"hip": 1.0},
        "control.damping": {"calf": 1.0},
        "init_state.default_joint_angles": {"hip": 0.0},
    },
    "a body without a geom": {"asset.foot_names": ["FR", "FL", "RR", "imu"]},
    "a collider": {"asset.colliders": ["nosuch"]},
    "friction loss": {"asset.frictionloss": {"kneee": 0.1}},
    "effort": {"asset.effort": {"kneee": 0.1}},
    **{f"a wheel in {table}": {table: {"": 1.0, "wheel": 2.0}} for table in (*WHOLE, *SILENT)},
    **{f"no thigh in {table}": {table: {"hip": 1.0, "calf": 1.0}} for table in WHOLE},
}


def collide_with_leg(file: Path) -> object:
    return build_toy(
        file,
        **{"stiffness": {"": 10.0}, "damping": {"": 0.2}, "imu_site": "", "sites": {}},
        **{"colliders": ["leg"], "contact_geoms": ["leg"]},
    )


def table() -> Table:
    made = Table()
    for name, text in MJCFS.items():
        made.add(f"MJCF, {name}", reads(), given(text))
    for name, text in URDFS.items():
        made.add(f"URDF, {name}", reads("robot.urdf"), given(text, "robot.urdf"))
    for name, (run, before) in OTHERS.items():
        made.add(name, run, before)
    for name, text in TEXTS.items():
        made.add(f"toy, {name}", reads(), given(text))
    for name, text in MINIS.items():
        made.add(f"mini, {name}", reads("robot.urdf"), given(text, "robot.urdf"))
    for name, (file, text) in LOST.items():
        made.add(f"lost, {name}", lambda root, file=file: collide_with_leg(root / file), given(text, file))
    made.add("lost, a foot", lambda root: draft(root / "robot.urdf"), given(LOST["a link, .stl"][1], "robot.urdf"))
    made.add("a draft on wheels", program("robot", "ROOT/car.xml", "--new", "mine"), given(WHEELED, "car.xml"))
    made.add("no URDF", reads("none.urdf"))
    for name, fields in FIELDS.items():
        made.add(f"go1_flat, {name}", lambda root, fields=fields: make_env(1, fields))
    return made
