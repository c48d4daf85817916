"""The default pose of a draft: the makers' table, the candidates and the judge."""

from __future__ import annotations

from pathlib import Path

import pytest

from legged_mw.robot.makers import FILE, find_maker, read_makers

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
