"""Robots' files: names that are ours, numbers that no machine has, bombs, and files that are somewhere else."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest
from attack import Case, attack, captured, program

from legged_mw import ROOT
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.safety import Limits
from legged_mw.deploy.simulated import read_scene
from legged_mw.drawing.scene import visual_model
from legged_mw.export.scene import standalone
from legged_mw.robot.mjcf import XmlSource, write_archive
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.model import read_file
from legged_mw.utils.errors import ModelError
from legged_mw.utils.task import load_task

SHIPPED = ROOT / "resources/policies/go1_flat"
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


TEXTS: list[tuple[str, str | bytes, str]] = [
    ("negative mass", first('mass="[^"]*"', 'mass="-1"'), 'line 32: mass="-1" must be from 0 to 100000'),
    ("NaN mass", first('mass="[^"]*"', 'mass="nan"'), 'mass="nan" is not a number'),
    ("mass of 10^30", first('mass="[^"]*"', 'mass="1e30"'), 'mass="1e30" must be from 0 to 100000'),
    ("infinite mass", first('mass="[^"]*"', 'mass="inf"'), 'mass="inf" must be from 0 to 100000'),
    (
        "no mass",
        first('(<inertial[^>]*)mass="[^"]*"', r'\1mass="0"'),
        "mass and inertia of moving bodies must be larger",
    ),
    (
        "negative inertia",
        first('diaginertia="[^"]*"', 'diaginertia="-1 -1 -1"'),
        'diaginertia="-1 -1 -1" must be from 0 to',
    ),
    ("NaN inertia", first('diaginertia="[^"]*"', 'diaginertia="nan 1 1"'), 'diaginertia="nan 1 1" is not a number'),
    ("inertia of 10^30", first('diaginertia="[^"]*"', 'diaginertia="1e30 1e30 1e30"'), "must be from 0 to 1e+06"),
    ("density of 10^30", first("<geom ", '<geom density="1e30" '), 'density="1e30" must be from 0 to'),
    (
        "a range that ends first",
        first(' range="[^"]*"', ' range="1 -1"'),
        'line 14: range="1 -1" ends before it begins',
    ),
    (
        "a force range that ends first",
        more('<actuator><motor joint="FR_hip_joint" forcerange="5 -5"/></actuator>'),
        "ends before it begins",
    ),
    (
        "NaN gravity",
        first("<compiler", '<option gravity="0 0 nan"/><compiler'),
        'line 8: gravity="0 0 nan" is not a number',
    ),
    ("gravity of 10^9", first("<compiler", '<option gravity="0 0 -1e9"/><compiler'), "gravity is 0 0 -1e+09 m/s^2"),
    ("infinite gravity", first("<compiler", '<option gravity="0 0 inf"/><compiler'), "gravity is 0 0 inf m/s^2"),
    ("negative timestep", first("<compiler", '<option timestep="-1"/><compiler'), "timestep is -1 s"),
    ("NaN place", first(' pos="[^"]*"', ' pos="nan 0 0"'), 'pos="nan 0 0" is not a number'),
    (
        "infinite place",
        first('name="FR_hip" pos="[^"]*"', 'name="FR_hip" pos="inf 0 0"'),
        "pos of body 'FR_hip' is inf",
    ),
    ("a turn of no length", first(' quat="[^"]*"', ' quat="0 0 0 0"'), "zero quaternion is not allowed"),
    ("negative size", first(' size="[^"]*"', ' size="-1 -1 -1"'), "must be positive"),
    ("size of 10^30", first(' size="[^"]*"', ' size="1e30 1e30 1e30"'), "size of geom 'trunk_right' is 1e+30"),
    ("an axis of no length", first(' axis="[^"]*"', ' axis="0 0 0"'), "axis too small in joint"),
    ("negative armature", first(' armature="[^"]*"', ' armature="-1"'), 'armature="-1" must be from 0'),
    ("NaN damping", first(' damping="[^"]*"', ' damping="nan"'), 'damping="nan" is not a number'),
    ("a name twice", GO1.replace('name="FR_hip_1"', 'name="FR_hip_2"'), "repeated name 'FR_hip_2' in geom"),
    ("entities", '<!DOCTYPE a [<!ENTITY b "c">]>' + GO1, "line 1: it has a DOCTYPE, which may define entities"),
    (
        "a bomb of entities",
        '<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;&b;">]><mujoco model="&c;"/>',
        "it has a DOCTYPE",
    ),
    ("an entity of a file", '<!DOCTYPE a [<!ENTITY b SYSTEM "file:///etc/passwd">]>' + GO1, "it has a DOCTYPE"),
    ("a definition elsewhere", '<!DOCTYPE a SYSTEM "/etc/passwd">' + GO1, "it has a DOCTYPE"),
    (
        "include from above",
        more('<include file="../x.xml"/>'),
        "it includes ../x.xml, which lies outside of its own folder",
    ),
    (
        "include from anywhere",
        more('<include file="/etc/passwd"/>'),
        "it includes /etc/passwd, which lies outside of its own folder",
    ),
    (
        "include by a crooked way",
        more("<include file = 'a/../../x.xml' />"),
        "it includes a/../../x.xml, which lies outside",
    ),
    (
        "a model from above",
        more('<asset><model name="m" file="../x.xml"/></asset>'),
        "it includes ../x.xml, which lies outside",
    ),
    ("include of itself", more('<include file="robot.xml"/>'), "it includes robot.xml, which is already included"),
    (
        "a model of itself",
        more('<model name="m" file="robot.xml"/>', "asset"),
        "it includes robot.xml, which is already included",
    ),
    ("include of nothing", more('<include file="none.xml"/>'), "it includes none.xml, which is no file here"),
    ("include by reference", more('<include file="..&#47;x.xml"/>'), "it includes ../x.xml, which lies outside"),
    (
        "include between attributes",
        more(
            '<custom><text name="<!--" data="a"/></custom><include file="/etc/passwd"/><custom><text name="-->" data="a"/></custom>'
        ),
        "it is no XML: not well-formed",
    ),
    ("NaN by reference", first('mass="[^"]*"', 'mass="&#110;a&#x6E;"'), 'line 32: mass="nan" is not a number'),
    ("a number by reference", first('mass="[^"]*"', 'mass="1&#101;30"'), 'mass="1e30" must be from 0'),
    (
        "10^9 copies",
        more('<replicate count="1000000000"><geom size="1"/></replicate>', "worldbody"),
        'count="1000000000" must be',
    ),
    (
        "copies of copies",
        more('<replicate count="9000">' * 3 + "</replicate>" * 3, "worldbody"),
        "makes more than 20000 elements",
    ),
    (
        "copies of many things",
        more('<replicate count="300">' * 2 + "<geom size='1'/>" * 20 + "</replicate>" * 2, "worldbody"),
        "makes more than 20000 elements, all copies counted",
    ),
    (
        "copies, counted in other words",
        more('<replicate count="0x2710"><geom size="1"/></replicate>', "worldbody"),
        'count="0x2710" must',
    ),
    (
        "a height field of 4 10^8",
        more('<hfield name="h" nrow="20000" ncol="20000" size="1 1 1 1"/>', "asset"),
        "cells of height fields",
    ),
    (
        "height fields of 10^8",
        more('<hfield nrow="5000" ncol="5000" size="1 1 1 1"/>' * 4, "asset"),
        "cells of height fields",
    ),
    (
        "a picture of 2 10^8",
        more('<texture builtin="flat" width="16384" height="16384"/>', "asset"),
        "cells of height fields",
    ),
    (
        "400 joints in a row",
        "<mujoco><worldbody>" + '<body><joint/><geom size="1"/>' * 400 + "</body>" * 400 + "</worldbody></mujoco>",
        "too deeply",
    ),
    (
        "a mesh name of 5000",
        more(f'<mesh name="z" file="{"x" * 5000}.stl"/>', "asset"),
        "can be no file: File name too long",
    ),
    ("an include of 5000", more(f'<include file="{"x" * 5000}"/>'), "which is no file here"),
    (
        "files in many folders",
        more("".join(f'<mesh file="{i}.stl"/><compiler meshdir="{i}"/>' for i in range(400)), "asset"),
        "no robot has",
    ),
    ("an element of 20 MB", f'<mujoco model="{"x" * (20 << 20)}"/>', "an element has more than 16 MiB"),
    ("200 kB of comments without end", "<mujoco>" + "<!--" * 50_000, "it has more than 20000 comments"),
    ("comments without end", "<mujoco>" + "<!--" * 5000, "it is no XML"),
    (
        "many attributes",
        "<mujoco><option " + " ".join(f"a{i}='1'" for i in range(300)) + "/></mujoco>",
        "more than 200 attributes",
    ),
    ("200 kB of includes without end", "<mujoco>" + "<include " * 22_000, "it is no XML"),
    ("another encoding", GO1.encode("utf-16"), "it is no XML"),
    (
        "a height field of 10^10",
        more('<hfield name="h" nrow="100000" ncol="100000" size="1 1 1 1"/>', "asset"),
        'nrow="100000" must be',
    ),
    ("room of 400 GB", first("<worldbody>", '<size memory="400G"/><worldbody>'), "Could not allocate memory"),
    (
        "10^9 numbers a body",
        first("<worldbody>", '<size nuser_body="1000000000"/><worldbody>'),
        'nuser_body="1000000000" must be from 0',
    ),
    ("a mesh without end", more('<mesh name="z" file="/dev/zero"/>', "asset"), "/dev/zero is no file"),
    ("nothing", "", "it is no XML: no element found"),
    ("zeros", b"\0" * 99, "robot.xml is not a valid MJCF"),
    ("cut", GO1[:3000], "it is no XML"),
    (
        "3000 deep",
        "<mujoco><worldbody>" + '<body><joint/><geom size="1"/>' * 3000 + "</body>" * 3000 + "</worldbody></mujoco>",
        "too deep",
    ),
    ("no robot", "<mujoco/>", "it must hold a robot"),
    ("no XML", "legs: 4", "robot.xml is not a valid MJCF"),
]


@pytest.mark.parametrize(("text", "says"), [entry[1:] for entry in TEXTS], ids=[entry[0] for entry in TEXTS])
def test_mjcf(text: str | bytes, says: str, tmp_path: Path) -> None:
    attack(Case("", reads(), ("robot.xml ", says), given=given(text)), tmp_path)


MESH = '<visual><geometry><mesh filename="{0}"/></geometry></visual>'
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
    ("a bomb", '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><robot name="&b;"/>', "it has a DOCTYPE"),
    (
        "a mesh name of 5000",
        PLAIN.replace("</link>", MESH.format("x" * 5000) + "</link>", 1),
        "can be no file: File name too long",
    ),
    ("a mesh without end", PLAIN.replace("</link>", MESH.format("/dev/zero") + "</link>", 1), "/dev/zero is no file"),
    (
        "include",
        PLAIN.replace("</link>", '<include file="/etc/passwd"/></link>', 1),
        "it includes /etc/passwd, which lies outside",
    ),
    (
        "20000 deep",
        '<robot name="a"><link name="l">' + "<a>" * 20_000 + "</a>" * 20_000 + "</link></robot>",
        "it is nested too deeply",
    ),
    ("two roots", '<robot name="a"><link name="a"/><link name="b"/></robot>', "robot.urdf"),
    ("a circle", PLAIN.replace('parent link="base"', 'parent link="leg"'), "robot.urdf"),
]


def test_what_a_simulators_plugin_names_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(
        PLAIN.replace("</robot>", '<gazebo><plugin filename="/dev/null"/></gazebo></robot>')
    )
    assert XmlSource(tmp_path / "robot.urdf").spec().compile().nbody > 1


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
OTHERS = [
    Case("include through a link", reads(), "it includes part.xml, which lies outside of its own folder", given=linked),
    Case("NaN in a part", reads(), 'part.xml: line 2: gravity="0 0 nan" is not a number', given=part_with_nan),
    Case("no file", reads(), "no MJCF at "),
    Case("a folder", reads(), "no MJCF at ", given=lambda root: (root / "robot.xml").mkdir()),
    *(Case(f"a pipe: {name}", reads(), "is no file", given=piped(*where)) for name, where in PIPES.items()),
    Case("models of models", reads(), "makes more than 20000 elements", given=models_of_models),
    Case(
        "includes in a circle", reads(), "it includes robot.xml, which is already included", given=includes_in_a_circle
    ),
    Case(
        "what is no robot's file",
        program("train", "--check", "--set", "asset.file=/etc/passwd"),
        ("passwd", "it is no XML"),
    ),
    Case("a mesh that links to a device", reads(), "z.stl is no file", given=endless_mesh),
    Case("the health page of it", program("robot", "ROOT/robot.xml"), "robot.xml", given=BAD),
    Case(
        "a task of it",
        program("train", "--check", "--set", "asset.file=ROOT/robot.xml"),
        'gravity="0 0 nan" is not a number',
        given=BAD,
    ),
]


@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.id)
def test_others(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)


def scene(model: str) -> Callable[[Path], object]:
    """The scene of a shipped policy with more in it."""

    def given_scene(root: Path) -> None:
        shutil.copytree(SHIPPED, root / "out")
        (root / "out/scene.xml").write_text(
            (SHIPPED / "scene.xml").read_text().replace("</worldbody>", f"</worldbody>{model}", 1)
        )

    return given_scene


FAR = '<asset><mesh name="z" file="..&#47;x.obj"/></asset>'
OF_SCENES = {
    "read": lambda root: read_scene(root / "out", read_contract(root / "out", edited=True)),
    "limits": lambda root: limits(root / "out"),
}


def limits(folder: Path) -> Limits:
    return Limits.of(folder, read_contract(folder, edited=True))


@pytest.mark.parametrize("reader", OF_SCENES)
@pytest.mark.parametrize(
    "model", [FAR, f'<custom><text name="<!--" data="a"/></custom>{FAR}<custom><text name="-->" data="a"/></custom>']
)
def test_scenes_that_name_other_files(reader: str, model: str, tmp_path: Path) -> None:
    """Whoever reads the scene refuses it, also for the limits of a real robot."""
    says = "it is no XML" if "<!--" in model else "it names ../x.obj, which lies outside"
    attack(Case("", OF_SCENES[reader], ("scene.xml is not a valid MJCF", says), given=scene(model)), tmp_path)


@pytest.mark.parametrize("more", ["a" * 100_000, " " * (60 << 20), "<!-- " + "-" * 100_000 + " -->", '=" ' * 30_000])
def test_text_between_elements_is_nothing(more: str, tmp_path: Path) -> None:
    """Its cost is that of reading it."""
    write_archive(tmp_path / "robot.mjz", GO1.replace("<worldbody>", f"{more}<worldbody>"))
    assert XmlSource(tmp_path / "robot.mjz", alone=True).text == XmlSource(ROOT / "resources/robots/go1/go1.xml").text


TOY = (
    '<mujoco model="toy">{}<worldbody><body name="base"><freejoint/><geom size=".1"/>'
    '<body><joint name="j"/><geom size=".1"/>{}</body></body></worldbody></mujoco>'
)
ARM = '<mujoco model="arm"><worldbody><body name="arm"><geom name="{}" size=".1"/></body></worldbody></mujoco>'


@pytest.mark.parametrize("text", [
    "\n<!-- \xb0 --><?xml version='1.0' encoding='gb2312'?>\n".encode("latin-1") + TOY.format("", "").encode(),
    TOY.format("<!-- ---- parts ---- -->", "<!----><!-- <geom/> -->").encode(),
    TOY.format("", "").replace(" name=", "\n name = ").replace('"', "'").encode("utf-8-sig"),
], ids=["blank line and encoding", "lines of comments", "lines and quotes"])  # fmt: skip
def test_what_vendors_write_is_read(text: bytes, tmp_path: Path) -> None:
    given(text)(tmp_path)
    assert read_robot(tmp_path / "robot.xml").model.nv == 7


def test_a_robot_needs_no_ending(tmp_path: Path) -> None:
    given(GO1, "robot")(tmp_path)
    with captured() as said:
        assert read_robot(tmp_path / "robot").model.nv == 18
    assert said == [""]


def test_parts_are_found_as_mujoco_finds_them_and_read_once(tmp_path: Path) -> None:
    """Includes from the model's folder or their own, attached models by one name in two folders; files that change later do not count."""
    files = {
        "robot.xml": TOY.format('<include file="parts/all.xml"/>', "".join(
            f'<frame><attach model="{side}" body="arm" prefix="{side}_"/></frame>' for side in ("left", "right"))),
        "parts/all.xml": '<mujocoinclude><include file="more.xml"/><asset><model name="left" file="left/arm.xml"/></asset></mujocoinclude>',
        "parts/more.xml": '<mujoco><asset><model name="right" file="right/arm.xml"/></asset></mujoco>',
        "parts/left/arm.xml": ARM.format("one"),
        "parts/right/arm.xml": ARM.format("two"),
    }  # fmt: skip
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    theirs = mujoco.MjSpec.from_file(str(tmp_path / "robot.xml"))  # pyright: ignore[reportAttributeAccessIssue]
    source = XmlSource(tmp_path / "robot.xml")
    for name in files:
        (tmp_path / name).write_text("<mujoco/>")
    ours = source.spec()
    assert ours.to_xml() == theirs.to_xml() and [geom.name for geom in ours.geoms] == ["", "", "left_one", "right_two"]
    assert ours.modelfiledir == theirs.modelfiledir


def test_mujoco_names_the_line_of_the_file(tmp_path: Path) -> None:
    given(GO1.replace("<worldbody>", "<!-- a\n -- \n-->\n<worldbody typo='1'>"))(tmp_path)
    line = (tmp_path / "robot.xml").read_text().partition("<worldbody")[0].count("\n") + 1
    with pytest.raises(ModelError, match=rf"'typo' .*line {line}"):
        read_robot(tmp_path / "robot.xml")


def test_names_that_are_ours(tmp_path: Path) -> None:
    """They are renamed, and what refers to them follows."""
    text = (
        GO1.replace('name="FR_hip_1"', 'name="floor"')
        .replace('name="trunk_box"', 'name="floor/0"')
        .replace('"rubber"', '"ground"')
    )
    text = text.replace(
        "</mujoco>",
        '<sensor><touch name="contact/FR" site="imu"/><rangefinder name="up/x" site="imu"/></sensor></mujoco>',
    )
    given(text)(tmp_path)
    robot = read_robot(tmp_path / "robot.xml")
    names = {kind: [thing.name for thing in getattr(robot.spec, kind)] for kind in ("geoms", "materials", "sensors")}
    assert {"robot_floor", "robot_floor/0"} <= {*names["geoms"]} and "robot_ground" in names["materials"]
    assert names["sensors"] == ["robot_contact/FR", "robot_up/x"]
    assert "robot_ground" in [geom.material for geom in robot.spec.geoms]
    assert "geom 'floor' is called 'robot_floor': the first name is one of ours" in robot.notes


def test_a_robot_whose_names_are_ours_trains(tmp_path: Path) -> None:
    """Also the names that an export and a picture add."""
    text = (
        GO1.replace('"rubber"', '"ground"')
        .replace('"metal"', '"sky"')
        .replace('"dark"', '"around"')
        .replace('"lens"', '"relief"')
    )
    text = text.replace('name="FR_hip_1"', 'name="floor/3"')
    given(text)(tmp_path)
    task = load_task("go1_flat")
    for path, value in {"asset.file": str(tmp_path / "robot.xml"), "env.num_envs": 1, "sim.engine": "mujoco"}.items():
        task.set(path, value)
    robot = task.env_class(task.cfg, "cpu", eager=True).robot
    visual_model(robot)
    scene = standalone(robot, robot.imu, [0, 0, 0.3, 1, 0, 0, 0, *robot.pose], list(robot.pose))
    assert 'name="robot_ground"' in scene.xml and 'name="ground"' in scene.xml
