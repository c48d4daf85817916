"""The hard exam's figures, each from a walk made by hand whose answer is known, and its marks."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from legged_mw.eval import hard, report
from legged_mw.eval.hard import Walk, looks
from legged_mw.eval.report import Column
from legged_mw.eval.walking import ExamRules

STEP, PERIOD, SECONDS = 0.002, 0.02, 8.0
TIME = np.arange(0.0, SECONDS, STEP)
RULES = ExamRules.from_mapping(
    {}, {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_yaw": [-1.0, 1.0]}, feet=4
)


def walk(**changed: Any) -> Walk:
    """Two feet 0.2 m apart that take turns, half a second each, 100 N on one at a time; two joints that rest."""
    left = (TIME % 1.0) < 0.5
    down = np.stack([left, ~left], axis=1)
    still = np.zeros((len(TIME), 2))
    made: dict[str, Any] = {
        "dt": STEP,
        "period": PERIOD,
        "weight": 100.0,
        "tilt": still,
        "sideways": np.tile([0.1, -0.1], (len(TIME), 1)),
        "height": np.where(down, 0.0, 0.04),
        "sole": None,
        "force": np.where(down, 100.0, 0.0),
        "angle": still,
        "target": np.zeros((round(SECONDS / PERIOD), 2)),
        "torque": still,
        "speed": still,
        "low": np.array([-1.0, -2.0]),
        "high": np.array([1.0, 2.0]),
        "limit": np.array([10.0, 50.0]),
        "joints": ("hip", "knee"),
        "clock": 1.0,
    }
    return Walk(**{**made, **changed})


def test_a_gait_of_two_feet() -> None:
    found = looks(walk())
    assert found["strides"] == pytest.approx(1.0, abs=0.01) and found["clock"] == 1.0
    assert found["duty"] == [0.5, 0.5] and found["duty_left_right"] == 0.0 and found["all_down"] == 0.0
    assert found["feet_apart"] == pytest.approx(0.2) and found["clearance"] == pytest.approx(0.04)
    assert found["hit"] == {"mean": 1.0, "most": 1.0} and found["sole_tilt"] is None


def test_double_support_and_a_limp() -> None:
    """The left foot stands three quarters of a second, the right one half: both stand for a quarter."""
    phase = TIME % 1.0
    force = 50.0 * np.stack([phase < 0.75, phase >= 0.5], axis=1)
    found = looks(walk(force=force))
    assert found["duty_left_right"] == pytest.approx(0.25) and found["all_down"] == pytest.approx(0.25)
    assert found["none_down"] == 0.0


def test_a_hop_leaves_no_foot_down() -> None:
    """Both feet stand for the first 0.7 s of each second."""
    found = looks(walk(force=50.0 * np.stack([TIME % 1.0 < 0.7] * 2, axis=1)))
    assert found["none_down"] == pytest.approx(0.3) and found["all_down"] == pytest.approx(0.7)


def test_chatter_is_no_step() -> None:
    force = np.where((TIME % 1.0 < 0.5)[:, None] == np.array([True, False]), 100.0, 0.0)
    force[100:110, 0] = 0.0  # 20 ms in the air
    assert looks(walk(force=force))["strides"] == pytest.approx(1.0, abs=0.01)


def test_hits_are_the_first_60_ms() -> None:
    """Twice the weight at 40 ms counts, three times at 100 ms does not."""
    force = np.where((TIME % 1.0 < 0.5)[:, None] == np.array([True, False]), 100.0, 0.0)
    for start in range(250, len(TIME) - 60, 250):  # a touchdown
        foot = int(start % 500 != 0)
        force[start + 20, foot], force[start + 50, foot] = 200.0, 300.0
    assert looks(walk(force=force))["hit"] == {"mean": 2.0, "most": 2.0}


def test_sway_and_the_trunks_tilt() -> None:
    """Roll swings by 4 degrees around 1, pitch rests at -3."""
    tilt = np.radians(np.stack([1.0 + 4.0 * np.sin(2.0 * math.pi * TIME), np.full(len(TIME), -3.0)], axis=1))
    found = looks(walk(tilt=tilt))
    assert found["roll"]["mean"] == pytest.approx(1.0, abs=0.01)
    assert found["roll"]["amplitude"] == pytest.approx(4.0, abs=0.01)
    assert found["pitch"] == {"mean": -3.0, "amplitude": 0.0}
    assert hard.trunk(found) == pytest.approx(5.0, abs=0.01)


def test_soles_count_on_the_ground_alone() -> None:
    down = looks(walk())["duty"] and walk().force > 0.0
    sole = np.where(down, np.radians([2.0, 4.0]), 1.0)
    assert looks(walk(sole=sole))["sole_tilt"] == pytest.approx(4.0)


def test_limits_of_angles_and_targets() -> None:
    """2 % of the hip's range of 2 rad are 0.04 rad; a target far beyond the end counts, a joint without a range never."""
    angle = np.zeros((len(TIME), 2))
    angle[: len(TIME) // 4, 0] = 0.965
    angle[: len(TIME) // 2, 0] -= 0.0
    target = np.zeros((400, 2))
    target[:40, 1] = -7.0
    found = looks(walk(angle=angle, target=target))
    assert found["angle_at_limit"] == {"worst": 0.25, "joint": "hip"}
    assert found["target_at_limit"] == {"worst": 0.1, "joint": "knee"}
    torques = looks(walk(angle=angle, target=target, of_angles=False))
    assert torques["target_at_limit"]["worst"] == 0.0 and torques["target_step"] is None, "torques [N m] have no range"
    assert torques["angle_at_limit"] == found["angle_at_limit"]
    free = looks(walk(angle=angle, low=np.full(2, -np.inf), high=np.full(2, np.inf)))
    assert free["angle_at_limit"] == {"worst": 0.0, "joint": ""}
    angle[:, 0] = 0.955
    assert looks(walk(angle=angle))["angle_at_limit"]["worst"] == 0.0


def test_torque_power_and_steps_of_the_target() -> None:
    torque = np.tile([5.0, -10.0], (len(TIME), 1))
    speed = np.tile([2.0, 3.0], (len(TIME), 1))
    target = np.tile([[0.0, 0.0], [0.1, 0.3]], (200, 1))
    found = looks(walk(torque=torque, speed=speed, target=target))
    assert found["torque_over_limit"] == {"worst": 0.5, "joint": "hip"}
    assert found["torque_by_joint"] == {"hip": 0.5, "knee": 0.2}
    assert found["peak_power"] == pytest.approx(40.0) and found["target_step"] == pytest.approx(0.2)
    assert looks(walk(limit=np.full(2, np.inf)))["torque_over_limit"] is None


def test_share_above_ten_hertz() -> None:
    """Amplitudes 2 at 2 Hz and 1 at 20 Hz: a fifth of the power."""
    time = np.arange(0.0, SECONDS, PERIOD)[:, None]
    target = 0.5 + 2.0 * np.sin(4.0 * math.pi * time) + np.sin(40.0 * math.pi * time)
    assert hard.fast_share(target, PERIOD) == pytest.approx(0.2, abs=0.002)
    assert hard.fast_share(np.ones((400, 2)), PERIOD) is None


def test_twelve_commands() -> None:
    asked = hard.commands(RULES)
    assert len(asked) == 12 and asked[0] == (0.0, 0.0, 0.0) and hard.half_speed(RULES) == 0.5
    assert {(0.5, 0.0, 0.0), (1.0, 0.0, 0.0), (-0.5, 0.0, 0.0)} < {*asked}
    assert [c for c in asked if c[0] == 0.6667] == [(0.6667, y, w) for y in (0.2, -0.2) for w in (0.5, -0.5)]


def test_a_condition_is_graded() -> None:
    """Off by 0.1 in vx everywhere; the third command falls; 24 of 32 pushes are survived; 3 cm of drift."""
    count = len(hard.commands(RULES)) + hard.PUSH_DIRECTIONS
    asked = np.array(hard.commands(RULES))
    velocity = np.zeros((300, count, 3))
    velocity[:, :12] = asked + [0.1, 0.0, 0.0]
    velocity[:100, :12] = 9.0
    position = np.zeros((300, count, 2))
    position[100:, 0, 1] = np.linspace(0.0, 0.03, 200)
    fell_at = np.full(count, np.inf)
    fell_at[2] = 7
    fell_at[-8:] = 200
    found = hard.grade_condition(RULES, velocity, position, fell_at, 0.02)
    assert found["falls"] == 1 and found["pushes"] == 0.75 and found["drift"] == 0.03
    assert found["error"] == pytest.approx([(11 * 0.1 + 1.0) / 12, 0.0, 0.0], abs=1e-4)


def result(walks: bool = True, changed: dict[str, Any] | None = None, **condition: Any) -> dict[str, Any]:
    good = {"falls": 0, "error": [0.0, 0.0, 0.0], "drift": 0.0, "pushes": 1.0}
    conditions = {each.name: {**good} for each in hard.CONDITIONS}
    conditions[hard.ALL] |= condition
    return hard.finish(RULES, walks, conditions, {**looks(walk()), **(changed or {})}, 4, 3.0)


@pytest.mark.parametrize(
    ("found", "words"),
    [
        (result(), []),
        (result(walks=False), ["walk"]),
        (result(falls=2), ["falls under all"]),
        (result(pushes=0.875), ["88%"]),
        (result(pushes=0.90625), []),
        (result(changed={"angle_at_limit": {"worst": 0.02, "joint": "knee"}}), ["angle of knee"]),
        (result(changed={"target_at_limit": {"worst": 0.2, "joint": "hip"}}), ["target of hip"]),
        (result(changed={"torque_over_limit": {"worst": 0.41, "joint": "hip"}}), ["torque of hip"]),
        (result(changed={"roll": {"mean": -3.0, "amplitude": 2.5}}), ["5.5 degrees"]),
        (result(changed={"sole_tilt": 3.1}), ["soles"]),
        (result(changed={"sole_tilt": 2.9}), []),
    ],
)
def test_ready_for_a_robot(found: dict[str, Any], words: list[str]) -> None:
    assert found["ready"] == (not words) and len(found["misses"]) == len(words)
    assert all(word in miss for word, miss in zip(words, found["misses"], strict=True))
    assert hard.table(found)


def test_its_chapter_in_the_report() -> None:
    column = Column("mine", {}, {"hard": result(falls=1)}, strip=b"PNG")
    page = report._hard(column)
    assert page.count("<tr>") == 1 + len(hard.CONDITIONS) + 1 + len(hard.figures(column.exam["hard"])) - page.count(
        'class="sub"'
    )
    assert "falls under all" in page and "data:image/png;base64" in page and "load of 3 kg" in page
    assert "strip" not in column.plain()
    fallen = {**column.exam["hard"], "looks": None}
    assert hard.misses(fallen)[-1] == "falls in the gait measurement" and hard.figures(fallen) == []
    assert report._hard(Column("mine", {}, {"hard": fallen}))


def test_published_policies_stand_beside_where_they_were_asked_alike() -> None:
    """Both policies of a Go2: 0.05 and 0.05 in vx, 0.04 and 0.03 in vy, 0.03 and 0.04 in yaw rate without a hardship."""
    go2 = ExamRules.from_mapping(
        {"peer": "go2"}, {"lin_vel_x": [-0.5, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_yaw": [-1, 1]}
    )
    found = hard.beside(go2)
    assert len(found["policies"]) == 2 and found["errors"]["none"] == [0.05, 0.03, 0.03]
    assert found["pushes"] == {"all": 0.88} and found["looks"]["target_step"] == 0.034
    wider = ExamRules.from_mapping(
        {"peer": "go2"}, {"lin_vel_x": [-1, 1.0], "lin_vel_y": [-0.4, 0.4], "ang_vel_yaw": [-1, 1]}
    )
    assert hard.beside(wider)["errors"] == {} and hard.beside(wider)["pushes"] == {"all": 0.88}
    faster = ExamRules.from_mapping(
        {"peer": "go2"}, {"lin_vel_x": [-1, 2.0], "lin_vel_y": [-1, 1], "ang_vel_yaw": [-1, 1]}
    )
    assert hard.beside(faster) == {} == hard.beside(RULES)
    compared = hard.finish(go2, True, result()["conditions"], looks(walk()), 4, 3.0)
    assert compared["peers"] == found and "best of 2" in hard.table(compared)
    heads, *rows = hard.condition_rows(compared)
    assert {len(row) for row in rows} == {len(heads)} == {7}
    assert rows[0][-2:] == ["0.05, 0.03, 0.03", ""] and rows[-1][-1] == "0.88"
    assert len(hard.condition_rows(result())[0]) == 5
    assert [row.peer for row in hard.figures(compared) if row.peer is not None] == [0.42, 0.62, 0.17, 0.034, 0.002]
