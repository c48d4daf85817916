"""The hard exam on an export: what each condition does to a robot, and what is seen of one that walks."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest

from legged_mw import ROOT
from legged_mw.deploy import __main__ as program
from legged_mw.deploy import hard_exam
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.exam import contract_rules
from legged_mw.deploy.hard_exam import apply_conditions, commands_of, look, run_conditions
from legged_mw.deploy.simulated import Fleet, trunk_of
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import hard, walking

GO2, G1 = ROOT / "resources/policies/go2_flat", ROOT / "resources/policies/g1_flat"
NAMES = [condition.name for condition in hard.CONDITIONS]


def test_each_condition_changes_its_own_worlds() -> None:
    stage = DeployStage(GO2, len(NAMES))
    apply_conditions(stage, np.arange(len(NAMES)), 3.0)
    batch, fleet, servo = stage.fleet._batch, stage.fleet, stage.fleet._actuators[0]
    models = {name: batch.get_model(i) for i, name in enumerate(NAMES)}
    nominal, contract = models["none"], stage.contract
    for name, factor in {"none": 1.0, "gains x 0.8": 0.8, "gains x 1.2": 1.2, "load": 1.0, "all": 0.9}.items():
        assert models[name].actuator_gainprm[servo, 0] == pytest.approx(factor * contract.stiffness[0])
        assert models[name].actuator_biasprm[servo, 1] == pytest.approx(-factor * contract.stiffness[0])
        assert models[name].dof_damping[fleet._dofs[0]] == pytest.approx(factor * contract.damping[0])
    for name in NAMES:
        heavier = models[name].body_subtreemass[0] - nominal.body_subtreemass[0]
        assert heavier == pytest.approx(3.0 if name in ("load", "all") else 0.0, abs=1e-9)
    friction = {name: model.geom_friction[:, 0] for name, model in models.items()}
    assert (friction["friction 0.3"] == 0.3).all() and (friction["all"] == 0.5).all()
    assert (friction["noise"] == fleet.model.geom_friction[:, 0]).all()
    assert fleet._late.tolist() == [0, 3, 5, 0, 0, 0, 0, 0, 3]  # steps of 4 ms


def test_noise_is_of_what_the_policy_sees() -> None:
    stage = DeployStage(GO2, len(NAMES))
    apply_conditions(stage, np.arange(len(NAMES)), 3.0)
    assert stage.disturb
    seen = [stage.disturb(stage.measured) for _ in range(200)]
    noisy = [name in ("noise", "all") for name in NAMES]
    for name, most in hard.NOISE.items():
        off = np.abs(np.stack([getattr(each, name) - getattr(stage.measured, name) for each in seen])).max(axis=(0, 2))
        assert ((off > 0.9 * most) == noisy).all() and (off <= most).all()
    assert seen[0].lin_vel is stage.measured.lin_vel


def test_a_late_target_arrives_late() -> None:
    """12 ms are 3 of the 5 physics steps of a period: two robots with the same targets part after that."""
    contract = read_contract(GO2)
    sent: list[np.ndarray] = []
    fleet = Fleet(GO2, contract, 3, each=lambda: sent.append(fleet._ctrl[:, fleet._actuators[0]].copy()))
    fleet.set_delay(np.array([0.0, 0.012, 0.02]))
    first, second = contract.default_pose + 0.1, contract.default_pose + 0.2
    for target in (first, second, second):
        fleet.write(np.tile(target, (3, 1)))
    steps = np.round(np.array(sent) - contract.default_pose[0], 6)
    assert steps[:, 0].tolist() == [0.1] * 5 + [0.2] * 10
    assert steps[:, 1].tolist() == [0.0] * 3 + [0.1] * 5 + [0.2] * 7
    assert steps[:, 2].tolist() == [0.0] * 5 + [0.1] * 5 + [0.2] * 5
    fleet.reset([1])
    fleet.write(np.tile(first, (3, 1)))
    assert np.round(sent[-5][1] - contract.default_pose[0], 6) == 0.0


def test_motors_without_gains_lose_torque() -> None:
    contract = read_contract(GO2)
    fleet = Fleet(GO2, contract, 2)
    fleet.contract = replace(contract, motors=contract.motors._replace(law="torque"))
    fleet.scale_gains(np.array([1.0, 0.8]))
    gears = [fleet._batch.get_model(i).actuator_gear[fleet._actuators, 0] for i in range(2)]
    assert gears[1] == pytest.approx(0.8 * gears[0])


def test_all_conditions_of_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    """None of them falls so soon but by a push; a push that is far too strong fells all but under no condition alone."""
    monkeypatch.setattr(hard, "SECONDS", 1.6)
    monkeypatch.setattr(hard, "SETTLING", 0.8)
    monkeypatch.setattr(hard, "PUSH_AT", 0.3)
    monkeypatch.setattr(hard, "PUSH_OTHERS", 20.0)
    contract = read_contract(GO2)
    found = run_conditions(partial(DeployStage, GO2), contract, contract_rules(contract, common=True), 3.0)
    assert list(found) == NAMES and all(each["falls"] == 0 for each in found.values())
    assert all(each["pushes"] < 0.5 for each in found.values())
    assert found["none"]["error"] != found["noise"]["error"] and found["none"]["drift"] < 0.01


@pytest.mark.parametrize("folder", [GO2, G1])
def test_a_robot_is_looked_at(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hard_exam, "LOOK_SECONDS", 6.2)  # of these, 4.2 s: six strides of a G1
    contract = read_contract(folder)
    walk, poses = look(partial(DeployStage, folder), contract, contract_rules(contract, common=True))
    assert walk and len(poses) == hard_exam.PICTURES
    found = hard.looks(walk)
    carried = walk.force.sum(axis=1).mean() / walk.weight
    assert carried == pytest.approx(1.0, abs=0.05)  # the feet carry the robot
    assert walk.tilt.shape == (round(4.2 / walk.dt), 2)
    assert 1.0 < found["strides"] < 3.0 and found["hit"]["mean"] < 3.0 and found["clearance"] > 0.01
    assert (found["sole_tilt"] is None) == (folder == GO2) and found["clock"] == pytest.approx(
        2.0 if folder == GO2 else 1.43, abs=0.01
    )
    assert 0.2 < found["feet_apart"] < 0.5 and abs(found["duty_left_right"]) < 0.05
    if folder == G1:  # it is upright, and no target is at a limit
        assert abs(found["pitch"]["mean"]) < 3.0 and found["target_at_limit"]["worst"] < 0.01
    assert np.ptp([pose[0] for pose in poses]) < 0.6  # of one stride


def test_the_trunk_is_the_heaviest_body() -> None:
    for folder, name in ((GO2, "base"), (G1, "torso_link")):
        model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
        assert model.body(trunk_of(model)).name == name


def test_loads() -> None:
    contract = read_contract(GO2)
    assert hard.load_of(contract_rules(contract), contract.mass) == 3.0
    assert hard.load_of(contract_rules(read_contract(G1)), 35.0) == 5.0
    other = replace(contract_rules(contract), peer="")
    assert hard.load_of(other, 20.0) == 3.5 and commands_of(contract, [(1.0, 0.0, 0.5)]).tolist() == [[1.0, 0.0, 0.5]]


def test_in_the_exam_of_an_export(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("legged_mw.deploy.exam.run_exam", lambda *_, **__: exam)
    rules = contract_rules(read_contract(GO2))
    exam = {"rules": rules.to_mapping(), "walks": True}
    monkeypatch.setattr(walking, "table", lambda _: "the walking exam")
    monkeypatch.setattr(hard, "SECONDS", 0.2)
    monkeypatch.setattr(hard, "SETTLING", 0.1)
    monkeypatch.setattr(hard_exam, "LOOK_SECONDS", 2.0)
    monkeypatch.setattr(sys, "argv", ["deploy", str(GO2), "--eval", "--out", str(tmp_path / "exam.json")])
    program.main()
    saved = json.loads((tmp_path / "exam.json").read_text())["hard"]
    assert list(saved["conditions"]) == NAMES and saved["load"] == 3.0 and math.isclose(saved["vx"], 1.0)
    assert "hard exam: 12 commands and 32 pushes" in capsys.readouterr().out


def test_on_odometry_the_conditions_are_walked_by_the_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    """Another walk than with the true velocity, under noise more than without."""
    monkeypatch.setattr(hard, "SECONDS", 1.6)
    monkeypatch.setattr(hard, "SETTLING", 0.8)
    monkeypatch.setattr(hard, "PUSH_DIRECTIONS", 1)
    folder = ROOT / "resources/policies/go1_flat_dr"
    contract = read_contract(folder)
    truth, estimate = (
        run_conditions(partial(DeployStage, folder, contact=contact), contract, contract_rules(contract), 2.0)
        for contact in (None, "height")
    )
    apart = {
        name: np.abs(np.subtract(estimate[name]["error"], truth[name]["error"]))[:2].sum() for name in ("none", "noise")
    }
    assert 0.0 < apart["none"] < apart["noise"]
