"""Heat and power: cases whose answer is known by hand, and the roll-out of an export that feeds them."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_export import untrained

from legged_mw import ROOT
from legged_mw.deploy import heat_exam
from legged_mw.deploy.contract import make_ratings, read_contract
from legged_mw.deploy.exam import contract_rules, contract_skill
from legged_mw.deploy.hard_exam import Witness
from legged_mw.deploy.stage import DeployStage
from legged_mw.envs.robot_task import motor_ratings
from legged_mw.eval import heat, report
from legged_mw.eval.heat import Motion, Switch
from legged_mw.eval.report import Column
from legged_mw.export.exporter import export
from legged_mw.utils import motor_heat
from legged_mw.utils.config import load_yaml, save_yaml
from legged_mw.utils.motor_heat import Ratings
from legged_mw.utils.task import load_task

POLICIES = ROOT / "resources/policies"
GO2 = POLICIES / "go2_flat"
LIMIT = np.array([20.0, 50.0])


def ratings(**known: Any) -> Ratings:
    """Of two motors; what is not given is unknown."""
    battery = known.pop("battery_power", None)
    return make_ratings({name: [value] * 2 for name, value in known.items()}, battery, 2)


WINDING = {"motor_constant": 2.0, "thermal_resistance": 4.0, "thermal_time": 300.0}


def test_a_constant_torque_heats_by_an_exponential() -> None:
    """10 N m at 2 N m/W^0.5 are 25 W, at 4 K/W 100 K: from 20 C to 85 C the time is -300 s * ln(1 - 65 / 100)."""
    load = np.array([10.0, 8.0])  # 8 N m are 16 W, 64 K: 84 C and no more at 20 C, 104 C at 40 C
    assert motor_heat.settled(load, ratings(**WINDING), 20.0) == pytest.approx([120.0, 84.0])
    cool, warm = (motor_heat.seconds_until_hot(load, ratings(**WINDING), room) for room in (20.0, 40.0))
    assert cool[0] == pytest.approx(-300.0 * math.log(0.35)) and math.isinf(cool[1])
    assert warm == pytest.approx([-300.0 * math.log(0.55), -300.0 * math.log(1.0 - 45.0 / 64.0)])


def test_the_closed_form_is_the_model_stepped() -> None:
    """A torque that is on for half of each 0.4 s, stepped by Euler, is hot when its RMS says so."""
    known, torque, winding, time = ratings(**WINDING), 14.0, 20.0, 0.0
    while winding < motor_heat.HOT:
        on = torque if time % 0.4 < 0.2 else 0.0
        winding += 0.02 * ((on / 2.0) ** 2 * 4.0 - (winding - 20.0)) / 300.0
        time += 0.02
    load = np.array([torque / math.sqrt(2.0), 0.0])
    until = motor_heat.seconds_until_hot(load, known, 20.0)
    assert time == pytest.approx(until[0], rel=2e-3) and math.isinf(until[1])


def test_rms_and_power() -> None:
    torque = np.array([[[3.0, 0.0]], [[-4.0, 2.0]]])  # (T=2, N=1, D=2)
    speed = np.array([[[2.0, 5.0]], [[1.0, 1.0]]])
    assert motor_heat.rms(torque) == pytest.approx([math.sqrt(12.5), math.sqrt(2.0)])
    assert motor_heat.power(torque, speed, ratings())[:, 0] == pytest.approx(
        [6.0, 0.0]
    )  # 2 W braking are not given back
    lossy = motor_heat.power(torque, speed, ratings(motor_constant=2.0))[:, 0]
    assert lossy == pytest.approx([6.0 + 9.0 / 4.0, -4.0 + 2.0 + 16.0 / 4.0 + 4.0 / 4.0])


def test_the_torque_speed_limit() -> None:
    """Flat at 20 N m to 10 rad/s, then a line to 0 at 30: 10 N m at 20 rad/s. Braking has the whole torque."""
    curve = ratings(peak_torque=20.0, knee_speed=10.0, top_speed=30.0)
    speeds = np.array([5.0, 10.0, 20.0, 30.0, 40.0])[:, None, None] * np.ones((1, 1, 2))
    assert motor_heat.highest_torque(speeds, curve, LIMIT)[:, 0, 0] == pytest.approx([20.0, 20.0, 10.0, 0.0, 0.0])
    torque = np.array([[[9.0, 9.9]], [[-9.9, -9.9]]])
    assert motor_heat.at_limit(torque, np.full((2, 1, 2), 20.0), curve, LIMIT).tolist() == [0.0, 0.5]
    assert motor_heat.highest_torque(speeds, ratings(), LIMIT)[-1, 0].tolist() == LIMIT.tolist()  # nothing is known
    flat = ratings(peak_torque=20.0, knee_speed=10.0)  # without a top speed nothing says how it falls
    assert motor_heat.highest_torque(speeds, flat, LIMIT)[:, 0, 0].tolist() == [20.0] * 5
    free = motor_heat.at_limit(torque, torque, ratings(), np.full(2, np.inf))
    assert np.isnan(free).all()


def still(torque: float, steps: int = 10) -> Motion:
    return Motion(np.full((steps, 1, 2), torque), np.zeros((steps, 1, 2)))


def found(known: Ratings, torque: float = 10.0, switch: Switch | None = None) -> dict[str, Any]:
    return heat.finish(("hip_joint", "knee_joint"), known, LIMIT, {"standing": still(torque)}, switch)


def test_what_trips_is_said() -> None:
    hot = found(ratings(**WINDING, continuous_torque=11.0, battery_power=100.0))
    assert hot["trips"] is True and hot["phases"]["standing"]["minutes"]["20"][0] == pytest.approx(5.249, abs=1e-3)
    assert hot["reasons"] == ["hip reaches 85 C after 5 min standing at 20 C, 3 min at 40 C"]
    over = found(ratings(continuous_torque=8.0))
    assert over["reasons"] == ["hip carries 10.0 N m RMS standing, 1.25 of its continuous rating: it overheats"]
    fine = found(ratings(continuous_torque=11.0, battery_power=100.0))
    assert fine["trips"] is False and fine["phases"]["standing"]["of_limit"] == [0.5, 0.2]
    fell = {**fine, "switches": True, "switch": None}
    assert heat._verdict(fell) is None, "what the switch asks of the battery was not measured"
    weak = found(ratings(**WINDING, battery_power=49.0), torque=10.0)  # 25 W in each winding
    assert any("50 W standing, and the battery gives 49 W" in each for each in weak["reasons"])


def test_the_switch_is_the_first_period() -> None:
    """In steps of 5 ms: 300 W for 20 ms; the torque's later rise does not count as a jump."""
    torque = np.zeros((40, 1, 2))
    torque[:4, 0, 0], torque[10:, 0, 1] = 30.0, 50.0
    speed = np.zeros_like(torque)
    speed[..., 0] = 10.0
    switch = Switch(0.005, np.array([0.1, -0.3]), np.array([2.0, 0.0]), Motion(torque, speed), period=0.02)
    result = found(ratings(battery_power=200.0, continuous_torque=11.0), switch=switch)
    assert result["switch"] == {
        **{"target_jump": 0.3, "target_joint": "knee_joint", "torque_jump": 28.0, "torque_joint": "hip_joint"},
        **{"peak_power": 300.0, "seconds": 0.02},
    }
    assert result["reasons"] == ["300 W for 20 ms at the switch, and the battery gives 200 W: this robot may cut power"]


def test_without_ratings_all_but_the_figures_is_unknown() -> None:
    result = found(ratings())
    each = result["phases"]["standing"]
    assert result["trips"] is None and result["ratings"] == {} and "battery_power" in result["unknown"]
    assert each["rms"] == [10.0, 10.0] and each["of_rating"] == each["minutes"]["20"] == [None, None]
    assert "unknown" in heat.table(result) and len(heat.rows(result)) == 3 and len(heat.rows(result, 1)) == 2
    fell = heat.finish(("hip", "knee"), ratings(), LIMIT, {"standing": None}, None)
    assert fell["trips"] is None and "fell" in heat.table(fell)


# ---- on an export ---------------------------------------------------------------------------------------------------


@pytest.fixture
def short_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in {"STAND": 0.4, "AFTER": 0.2, "SETTLING": 0.2, "SECONDS": 1.0}.items():
        monkeypatch.setattr(heat_exam, name, seconds)


def test_a_robot_that_stands_and_walks(short_runs: None) -> None:
    """A Go2's calves carry its weight; the policy's first target is off the pose, and what the curve allows is known."""
    contract = read_contract(GO2)
    result = heat_exam.run_heat(GO2, contract_rules(contract))
    assert list(result["phases"]) == ["standing", "walking"] and result["trips"] is None
    standing, walking = result["phases"].values()
    assert 3.0 < standing["rms"][2] < 9.0 and walking["mean_power"] > standing["mean_power"] + 5.0
    assert result["switch"]["target_jump"] > 0.05 and result["switch"]["peak_power"] > 5.0
    assert {"peak_torque", "knee_speed", "top_speed"} == set(result["ratings"])
    assert "Heat and power" in report._heats([Column("a", {}, {"heat": result})])


def test_the_recorded_torque_is_the_looked_at_one() -> None:
    """As the witness of the hard exam has it, which computes it from MuJoCo's data."""
    seen: list[Any] = []
    stage = DeployStage(GO2, 1, each=lambda: seen.append((recorder.sample(), witness.sample())))
    recorder, witness = heat_exam.MotorLog(stage.fleet), Witness(stage.fleet)
    stage.step()
    torque, speed = recorder.take()
    np.testing.assert_allclose(torque[:, 0], [row["torque"] for row in witness._rows], atol=1e-9)
    np.testing.assert_allclose(speed[:, 0], [row["speed"] for row in witness._rows], atol=1e-9)
    assert torque.shape == (5, 1, 12) and np.abs(torque).max() > 1.0


def test_a_skill_has_no_switch(short_runs: None, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = POLICIES / "go1_handstand"
    skill = contract_skill(read_contract(folder))
    monkeypatch.setattr(heat_exam, "TRIES", 2)
    result = heat_exam.run_heat(folder, skill)
    assert list(result["phases"]) == ["handstand"] and result["switch"] is None
    assert max(result["phases"]["handstand"]["rms"]) > 5.0


# ---- ratings in a contract and a config -----------------------------------------------------------------------------


def with_ratings(folder: Path, ratings: Any) -> Path:
    """A copy of the Go2's export with this section, edited by hand; None: without it."""
    shutil.copytree(GO2, folder)
    said = load_yaml(folder / "policy.yaml")
    said.pop("ratings")
    save_yaml(folder / "policy.yaml", said | ({"ratings": ratings} if ratings is not None else {}))
    return folder


def test_a_user_adds_ratings_in_three_lines(tmp_path: Path, short_runs: None) -> None:
    """The contract stays sealed; a number for all, or one a joint with unknown ones."""
    calves = [None, None, 5.0] * 4
    folder = with_ratings(tmp_path / "go2", {"continuous_torque": calves, **WINDING, "battery_power": 5})
    contract = read_contract(folder)
    assert contract.ratings and contract.ratings.thermal_time.tolist() == [300.0] * 12
    assert contract.to_dict()["ratings"]["continuous_torque"] == calves and np.isnan(contract.ratings.knee_speed).all()
    result = heat_exam.run_heat(folder, contract_rules(contract))
    assert result["trips"] and any("at the switch" in each for each in result["reasons"])


def test_contracts_without_ratings_are_read(tmp_path: Path, short_runs: None) -> None:
    folder = with_ratings(tmp_path / "go2", None)
    contract = read_contract(folder)
    assert contract.ratings is None and "ratings" not in contract.to_dict()
    result = heat_exam.run_heat(folder, contract_rules(contract))
    assert result["ratings"] == {} and result["trips"] is None and result["phases"]["walking"]["rms"][0] > 0.0


def test_an_export_of_torques(tmp_path: Path, short_runs: None) -> None:
    """It begins without torque; each robot has a delay of its own, and is recorded at each physics step."""
    task, checkpoint = untrained(ROOT / "configs/go1_flat.py", tmp_path, {"control.actuator": "torque"})
    export(task, checkpoint, folder := tmp_path / "out")
    stage = DeployStage(folder, 3, each=lambda: None)
    stage.fleet.set_delay(np.array([0.0, 0.01, 0.02]))
    stage.step(None)
    assert not stage.fleet._sent[-1].any()
    assert heat_exam.run_heat(folder, contract_rules(read_contract(folder)))["phases"]["walking"]


def test_the_config_gives_the_contract_its_ratings() -> None:
    """By keys that are parts of names: of a G1's 29 joints the six that two motors turn have no curve."""
    contract = read_contract(POLICIES / "g1_flat")
    assert contract.ratings
    unknown = [name for name, peak in zip(contract.joints, contract.ratings.peak_torque, strict=True) if np.isnan(peak)]
    assert unknown == [name for name in contract.joints if "ankle" in name or name.startswith(("waist_r", "waist_p"))]
    env = load_task("g1_flat")
    robot = SimpleNamespace(joint_names=contract.joints, held=())
    again = make_ratings(motor_ratings(env.cfg, robot), None, 29)  # type: ignore[arg-type]
    np.testing.assert_array_equal(np.array(again[:-1]), np.array(contract.ratings[:-1]))
