"""The default pose of a draft: the makers' table, the candidates and the judge."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import pytest

from legged_mw import ROOT
from legged_mw.robot import makers
from legged_mw.robot.draft import draft, values
from legged_mw.robot.makers import FILE, find_maker, read_makers
from legged_mw.robot.measure import Joint, suggest
from legged_mw.robot.new import config_text, refuse_wheels
from legged_mw.utils.errors import UserError

QUADRUPED = [f"{leg}_{joint}_joint" for leg in ("FL", "FR", "RL", "RR") for joint in ("hip", "thigh", "calf")]
HUMANOID = [
    f"{side}_{joint}_joint" for side in ("left", "right") for joint in ("hip_pitch", "knee", "ankle_pitch", "elbow")
]


@pytest.mark.parametrize(
    ("file", "model", "joints", "found"),
    [
        ("h1_2_handless.xml", "", HUMANOID, "h1_2"),  # the longest name, not h1
        ("robot.urdf", "a1_description", QUADRUPED, "a1"),
        ("b2w.xml", "b2", QUADRUPED, "b2w"),  # the file's name comes first
        ("b2x.xml", "", QUADRUPED, None),
        ("go2.xml", "go2", HUMANOID, None),  # other joints
    ],
)
def test_a_maker_is_found_by_name_and_joints(file: str, model: str, joints: list[str], found: str | None) -> None:
    maker = find_maker(Path(file), model, joints)
    assert (maker.name if maker else None) == found


def test_a_key_of_another_version_of_the_robot_is_left_out() -> None:
    maker = next(each for each in read_makers() if each.name == "go2w")
    assert maker.of("pose", QUADRUPED) == {
        joint: {"hip": 0.0, "thigh": 0.8, "calf": -1.5}[joint.split("_")[1]] for joint in QUADRUPED
    }
    assert maker.of("kp", []) == {}


def test_every_entry_names_its_source_and_no_other_robot_twice() -> None:
    makers = read_makers()
    assert len({maker.name for maker in makers}) == len(makers) > 10
    assert all("/" in maker.source for maker in makers), FILE


# ---- the judge ----

# Four legs of two links, 0.3 m each, with the feet FL, FR, RL, RR; ``knee`` and ``keyframe`` are attributes.
LEG = """<body name="{name}_thigh" pos="{x} {y} 0"><joint name="{name}_thigh_joint" axis="0 1 0" range="-2 4"/>
  <geom name="{name}_t" type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
  <body name="{name}_calf" pos="0 0 -0.3"><joint name="{name}_calf_joint" axis="0 1 0" range="{knee}"/>
    <geom name="{name}_c" type="capsule" fromto="0 0 0 0 0 -0.28" size="0.02" mass="0.5"/>
    <geom name="{name}" size="0.02" pos="0 0 -0.3" mass="0.05"/></body></body>"""


def four_legs(folder: Path, knees: dict[str, str], angles: str = "", height: float = 0.45) -> Path:
    """A quadruped whose keyframe, if ``angles`` of one leg are given, has its root at ``height`` [m]."""
    places = {"FL": (0.3, 0.15), "FR": (0.3, -0.15), "RL": (-0.3, 0.15), "RR": (-0.3, -0.15)}
    legs = "".join(LEG.format(name=name, x=x, y=y, knee=knees[name[0]]) for name, (x, y) in places.items())
    key = f'<keyframe><key name="home" qpos="0 0 {height} 1 0 0 0{f" {angles}" * 4}"/></keyframe>' if angles else ""
    file = folder / "four.xml"
    file.write_text(
        '<mujoco><compiler angle="radian" autolimits="true"/><default><joint actuatorfrcrange="-80 80"/></default>'
        '<worldbody><body name="trunk" pos="0 0 0.6"><freejoint/><geom name="trunk" type="box" size="0.35 0.1 0.05" mass="15"/>'
        f"{legs}</body></worldbody>{key}</mujoco>"
    )
    return file


ONE_WAY = {"F": "-2.8 -0.5", "R": "-2.8 -0.5"}


def test_the_keyframe_of_a_folded_robot_is_not_believed(tmp_path: Path) -> None:
    """Calves beyond their limit, and a height in the keyframe at which it does not stand."""
    found = draft(four_legs(tmp_path, ONE_WAY, "1.4 -2.85"))
    assert found.pose_from.startswith("knees bent") and found.place[2] > 0.4
    [keyframe] = [each for each in found.judged if each.candidate.rank == 0]
    said = " ".join(keyframe.faults)
    assert all(word in said for word in ("end of the range", "folded", "0.45 m"))


def test_a_keyframe_without_a_fault_is_believed(tmp_path: Path) -> None:
    found = draft(four_legs(tmp_path, ONE_WAY, "0.9 -1.8", 0.39))
    assert found.pose == [0.9, -1.8] * 4 and found.pose_from == "the file's keyframe"


def test_a_knee_that_cannot_be_straight_has_three_quarters_of_its_stroke(tmp_path: Path) -> None:
    angles = draft(four_legs(tmp_path, ONE_WAY)).pose
    assert angles[1] == pytest.approx(-1.43, abs=0.03) and angles[0] == pytest.approx(-angles[1] / 2, abs=0.02)
    other = draft(four_legs(tmp_path, {"F": "-2.8 -0.5", "R": "0.5 2.8"})).pose
    assert other[5] == pytest.approx(1.43, abs=0.03) and other[:2] == angles[:2]


def test_a_knee_that_turns_both_ways_is_bent_less(tmp_path: Path) -> None:
    found = draft(four_legs(tmp_path, {"F": "-9 9", "R": "-9 9"}))
    assert found.pose[:2] == pytest.approx([0.47, -0.95], abs=0.03)
    assert any("other way" in each.candidate.name for each in found.judged[1:])


@pytest.mark.parametrize(("stem", "most"), [("a1_style", 0.3), ("anymal_c_style", 0.2), ("g1_12dof_style", 0.1)])
def test_without_the_table_the_pose_is_near_the_makers(stem: str, most: float, monkeypatch: pytest.MonkeyPatch) -> None:
    file = next((ROOT / "tests/data").glob(f"{stem}.*"))
    known = draft(file)
    monkeypatch.setattr(makers, "read_makers", lambda: [])
    alone = draft(file)
    assert known.judged[0].candidate.rank == 1 and alone.judged[0].candidate.rank == 2
    assert max(abs(a - b) for a, b in zip(known.pose, alone.pose, strict=True)) < most


def test_soles_are_level_whatever_the_angles_of_zero_are(tmp_path: Path) -> None:
    """G1's feet, turned by 0.4 rad in the file: its ankles have to turn as much more."""
    text = (ROOT / "tests/data/g1_12dof_style.xml").read_text()
    turned = re.sub(r'(<body name="\w+_ankle_pitch_link"[^>]*?)>', r'\1 euler="0 0.4 0">', text)
    assert turned != text
    (tmp_path / "biped.xml").write_text(turned.replace("g1_12dof", "biped"))
    found = draft(tmp_path / "biped.xml")
    angle = dict(zip(found.robot.joint_names, found.pose, strict=True))
    assert sum(angle[f"left_{part}_joint"] for part in ("hip_pitch", "knee", "ankle_pitch")) == pytest.approx(
        -0.4, abs=0.03
    )


# ---- joints that do not walk ----


def test_joints_that_do_not_walk_are_held() -> None:
    found = draft(ROOT / "tests/data/g1_29dof_style.xml")
    assert len(found.robot.joint_names) == 12 and len(found.held) == 17
    said = values(found)
    assert said["asset"]["held_joints"] == ["*waist*", "*shoulder*", "*elbow*", "*wrist*"]
    assert found.angles["left_elbow_joint"] == 0.97
    assert "17 joints that do not walk; without this line the task has 29 actions" in config_text(
        found, Path("g1.xml"), "g1"
    )


# An arm of one link that points forward at 0, on a body beside the trunk of ``four_legs``; and a head above it.
ARM = """<body name="{side}_arm" pos="0.2 {y} 0.05"><joint name="{side}_shoulder_joint" axis="0 1 0" range="-3 3"/>
  <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02" mass="1"/></body>"""
HEAD = """<body name="head" pos="0.3 0 0.1"><joint name="head_joint" axis="0 1 0" range="-1 1"/>
  <geom size="0.05" pos="0.05 0 0.1" mass="1"/></body>"""


def test_arms_hang_and_a_head_does_not(tmp_path: Path) -> None:
    file = four_legs(tmp_path, ONE_WAY)
    more = "".join(ARM.format(side=side, y=y) for side, y in (("left", 0.15), ("right", -0.15))) + HEAD
    file.write_text(file.read_text().replace("</body></worldbody>", more + "</body></worldbody>"))
    found = draft(file)
    assert found.angles["left_shoulder_joint"] == pytest.approx(1.57, abs=0.1) and found.angles["head_joint"] == 0.0
    assert values(found)["asset"]["held_joints"] == ["*shoulder*", "*head*"] and len(found.pose) == 8


# a robot's weight times the height of its root [N m], and of some joints: torque limit [N m], published kp and kd
PUBLISHED = {
    "anymal_c": (281.0, [(80.0, 80.0, 2.0)]),
    "a1": (37.0, [(20.0, 20.0, 0.5), (55.0, 20.0, 0.5)]),
    "cassie": (253.0, [(112.0, 100.0, 3.0), (195.0, 200.0, 6.0), (45.0, 40.0, 1.0)]),
    "h1": (530.0, [(200.0, 150.0, 2.0), (300.0, 200.0, 4.0), (40.0, 40.0, 2.0)]),
    "g1": (271.0, [(88.0, 100.0, 2.0), (139.0, 150.0, 4.0), (50.0, 40.0, 2.0), (25.0, 40.0, 1.0)]),
    "go2": (43.0, [(23.7, 25.0, 0.5), (45.4, 25.0, 0.5)]),
    "b2": (431.0, [(200.0, 160.0, 5.0), (300.0, 160.0, 5.0)]),
    "t1": (209.0, [(45.0, 200.0, 5.0), (60.0, 200.0, 5.0), (24.0, 50.0, 1.0)]),
}


def test_the_rule_of_gains_is_near_what_makers_publish() -> None:
    """Within a factor of two for four of five, kp and kd; of numbers that the table itself has."""
    near = []
    for name, (moment, joints) in PUBLISHED.items():
        maker = next(each for each in read_makers() if each.name == name)
        for effort, kp, kd in joints:
            assert kp in maker.kp.values() and kd in maker.kd.values(), name
            joint = Joint("a", -1.0, 1.0, effort, math.inf, 0.0, 0.0, 0.0, 0.1, "default", 0.1, 0.0)
            [gains] = suggest([joint], moment)
            near += [abs(math.log(gains.kp / kp)) < math.log(2.0), abs(math.log(gains.kd / kd)) < math.log(2.0)]
    assert sum(near) >= 0.75 * len(near) and len(near) == 40


@pytest.mark.parametrize(("kp", "stands"), [(20.0, True), (8.0, False)])
def test_gains_on_which_a_quadruped_sinks_are_not_taken(
    kp: float, stands: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A1's of 20 N m/rad hold it up; a B2 learned nothing with those of its maker."""
    maker = replace(next(each for each in read_makers() if each.name == "a1"), kp={"": kp})
    monkeypatch.setattr(makers, "read_makers", lambda: [maker])
    found = draft(ROOT / "tests/data/a1_style.urdf")
    assert ({gain.kp for gain in found.gains} == {kp}) == stands
    assert found.gains_from.endswith("sinks") != stands and maker.source in found.gains_from


def test_every_gain_has_its_damping() -> None:
    for maker in read_makers():
        assert bool(maker.kp) == bool(maker.kd), maker.name
        assert all(0.001 < value / maker.kp[key] < 0.3 for key, value in maker.kd.items() if key in maker.kp), (
            maker.name
        )


# ---- wheels ----

WHEEL = '<body name="{0}_w" pos="0 0 -0.3"><joint name="{0}_wheel_joint" axis="0 1 0"/><geom name="{0}" {1} mass="0.3"/></body>'
SHAPES = {
    "cylinder": 'type="cylinder" size="0.08 0.02" zaxis="0 1 0"',
    "sphere": 'type="sphere" size="0.08"',
    "box": 'type="box" size="0.08 0.02 0.08"',
    "sphere off its axis": 'type="sphere" size="0.08" pos="0.01 0 0"',
}


@pytest.mark.parametrize(
    ("shape", "rolls"), [("cylinder", True), ("sphere", True), ("box", False), ("sphere off its axis", False)]
)
def test_a_wheel_is_known_by_its_joint_and_its_shape(shape: str, rolls: bool, tmp_path: Path) -> None:
    """And legs on wheels are bent as legs on feet are: the wheel is no ankle."""
    file, plain = four_legs(tmp_path, ONE_WAY), draft(four_legs(tmp_path, ONE_WAY))
    text = file.read_text()
    for leg in ("FL", "FR", "RL", "RR"):
        foot = re.search(rf'<geom name="{leg}" [^>]*/>', text)
        assert foot
        text = text.replace(foot[0], WHEEL.format(leg, SHAPES[shape]))
    file.write_text(text)
    found = draft(file)
    assert len(found.wheels) == (4 if rolls else 0)
    if rolls:
        assert found.angles["FL_calf_joint"] == pytest.approx(plain.pose[1], abs=0.05)
        with pytest.raises(UserError, match="is on wheels: FL_wheel_joint"):
            refuse_wheels(found, file)
