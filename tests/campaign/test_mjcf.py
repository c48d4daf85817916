"""Robots' files as vendors write them, and names that are ours; tests/golden/robot_files.py has those that are refused."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
from attack import captured
from golden.robot_files import GO1, PLAIN, given

from legged_mw import ROOT
from legged_mw.drawing.scene import visual_model
from legged_mw.export.scene import standalone
from legged_mw.robot.mjcf import XmlSource, write_archive
from legged_mw.robot.vendor import read_robot
from legged_mw.utils.errors import ModelError
from legged_mw.utils.task import load_task


def test_what_a_simulators_plugin_names_is_not_read(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(
        PLAIN.replace("</robot>", '<gazebo><plugin filename="/dev/null"/></gazebo></robot>')
    )
    assert XmlSource(tmp_path / "robot.urdf").spec().compile().nbody > 1


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
