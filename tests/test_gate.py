"""legged-mw exam: one result of all repeats, and what makes a mark fall. And deploy.yaml, read as its program reads it."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import yaml
from test_export import untrained

from legged_mw import ROOT
from legged_mw.deploy import gate
from legged_mw.deploy.contract import ContractError, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.stage import SCATTER, DeployStage
from legged_mw.eval import walking
from legged_mw.eval.walking import Figure
from legged_mw.export.exporter import export
from legged_mw.unitree import deploy_yaml
from legged_mw.utils.errors import UserError

GO2 = ROOT / "resources/policies/go2_flat"
Program = Callable[..., int]


@pytest.fixture
def exam(monkeypatch: pytest.MonkeyPatch) -> Program:
    """The program, with walks of a few steps; returns its exit code."""

    def no_torch(name: str, checkpoint: int, folder: Path) -> None:
        raise UserError(f"no export {name}")

    def start(*args: object) -> int:
        monkeypatch.setattr(sys, "argv", ["exam", *map(str, args)])
        try:
            gate.main(no_torch)
        except SystemExit as end:
            return int(end.code or 0)
        return 0

    monkeypatch.setattr(walking, "EXAM_SECONDS", 3.2)
    return start


def result_of(**means: float) -> dict[str, object]:
    """A result with these marks of 0.06, each of two repeats 0.001 apart."""
    figures = [[Figure(name, mean + off, 3, 0.06) for name, mean in means.items()] for off in (-0.0005, 0.0005)]
    return {"marks": gate.marks_of(figures)}


def test_a_mark_falls_beyond_its_tolerance_alone() -> None:
    before = result_of(vx=0.02, vy=0.02)
    assert [mark["tolerance"] for mark in before["marks"]] == [0.002, 0.002]  # type: ignore[attr-defined]
    assert gate.fallen(result_of(vx=0.0219, vy=0.001), before) == []
    assert [line.split(":")[0] for line in gate.fallen(result_of(vx=0.0221, vy=0.02), before)] == ["vx"]
    more = [[Figure("pushes", share, 2, 0.9, more_is_better=True)] for share in (1.0, 0.9)]
    fewer = [[Figure("pushes", share, 2, 0.9, more_is_better=True)] for share in (0.6, 0.6)]
    assert not gate.fallen({"marks": gate.marks_of(more)}, {"marks": gate.marks_of(fewer)})
    assert gate.fallen({"marks": gate.marks_of(fewer)}, {"marks": gate.marks_of(more)})
    assert gate.marks_of(more)[0]["worst"] == 0.9


NEAR = (0.119, 0.119, 0.119), (0.1201, 0.1201, 0.1185)


def test_a_clean_repeat_hides_no_falls() -> None:
    """The range of the new repeats is wide, so their mean alone would pass."""
    stored, now = (
        {"marks": gate.marks_of([[Figure("falls", each, 0, 0.0)] for each in values])}
        for values in ((0, 0, 0), (0, 22, 22))
    )
    assert gate.fallen(now, stored) == ["falls: fails in 2 of 3 repeats, passed in all before"]
    once = {"marks": gate.marks_of([[Figure("falls", each, 0, 0.0)] for each in (0, 0, 1)])}
    assert gate.fallen(once, stored) == []
    near = [{"marks": gate.marks_of([[Figure("vx", each, 3, 0.12)] for each in values])} for values in NEAR]
    assert gate.fallen(near[1], near[0]) == [], "a mark is near, and the repeats are within the tolerance"


def test_marks_of_three_axes_have_three_names() -> None:
    rows = [
        Figure("error vx", 0.1, 3),
        Figure("  offset", 0.1, 3, 0.2),
        Figure("error vy", 0.1, 3),
        Figure("  offset", 0.1, 3, 0.2),
    ]
    assert [figure.name for figure in gate.named(rows)] == ["error vx, offset", "error vy, offset"]


def test_the_program_compares_with_its_own_file(exam: Program, tmp_path: Path) -> None:
    stored = tmp_path / "stored.json"
    badge = tmp_path / "badge.svg"
    assert exam(GO2, "--no_hard", "--seeds", 2, "--json", stored, "--badge", badge) == 0
    said = json.loads(stored.read_text())
    assert said["seeds"] == [0, 1] and said["exam"]["version"] == gate.VERSION and "MuJoCo" in said["engine"]
    first = said["marks"][1]
    assert first["name"] == "error vx [m/s]" and first["values"][0] != first["values"][1]  # the seed scatters the start
    assert badge.read_text().startswith("<svg") and "go2_flat" in badge.read_text()
    first["mean"] /= 2
    stored.write_text(json.dumps(said))
    assert exam(GO2, "--no_hard", "--seeds", 1, "--against", stored) == gate.FELL


@pytest.mark.parametrize("spoil", ["cut", "list", "robot", "version"])
def test_a_file_of_something_else_is_refused_before_the_exam(spoil: str, tmp_path: Path, exam: Program) -> None:
    said = {"exam": {"kind": "walking", "version": gate.VERSION, "hard": False, "rules": {}}, **result_of(vx=0.02)}
    said |= {"robot": {"joints": list(read_contract(GO2).joints)}}
    if spoil == "robot":
        said["robot"] = {"joints": ["knee"]}
    if spoil == "version":
        said["exam"] = {"kind": "walking", "version": 0}
    text = "[]" if spoil == "list" else json.dumps(said)
    (file := tmp_path / "stored.json").write_text(text[: len(text) // 2] if spoil == "cut" else text)
    with pytest.raises(
        UserError, match={"cut": "incomplete", "list": "not a result", "robot": "joints", "version": "version"}[spoil]
    ):
        exam(GO2, "--no_hard", "--against", file)


def test_a_seed_turns_joints_and_seed_zero_nothing() -> None:
    stage = DeployStage(GO2, 3)
    start = stage.qpos()
    stage.scatter(0)
    assert (stage.qpos() == start).all()
    stage.scatter(4)
    turned = stage.qpos() - start
    assert (
        (turned[:, :7] == 0.0).all() and (np.abs(turned[:, 7:]) <= SCATTER).all() and len(np.unique(turned[:, 7])) == 3
    )


def test_a_run_named_by_its_task_is_graded_by_its_export(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by its path. A run of a task of one's own cannot be exported again without its code."""
    run = tmp_path / "logs" / "mine" / "first"
    shutil.copytree(GO2, run / "export")
    monkeypatch.chdir(tmp_path)
    exported: list[tuple[str, int]] = []
    scratch = tmp_path / "scratch"
    for name in ("mine/first", "logs/mine/first"):
        found = gate.find_export(name, -1, lambda name, checkpoint, _: exported.append((name, checkpoint)), scratch)
        assert found.resolve() == run / "export" and not exported
        assert (
            gate.find_export(name, 3, lambda name, checkpoint, _: exported.append((name, checkpoint)), scratch)
            == scratch
        )
        assert exported.pop() == (name, 3)


def test_deploy_yaml_acts_as_the_contract_does(tmp_path: Path) -> None:
    """The file is read as unitree_rl_lab's C++ does it: terms in order, scaled, gains by motor, offset plus scale."""
    no_clock = {"gait.period": 0.0, "gait.offsets": [], "rewards.scales.contact_phase": 0.0}
    export(*untrained(ROOT / "configs/go2_rough.py", tmp_path, no_clock), folder := tmp_path / "export")
    contract = read_contract(folder)
    deploy_yaml.write(folder, contract, tmp_path)
    said = yaml.safe_load((tmp_path / "params/deploy.yaml").read_text())
    stage, controller = DeployStage(folder, 1), Controller(folder, contract, 1)
    stage.scatter(1)
    measured, command = stage.measured, np.array([[0.5, -0.2, 0.3]])
    targets = controller.act(measured, command)[0]
    terms = {
        "base_ang_vel": measured.ang_vel[0],
        "projected_gravity": measured.gravity[0],
        "velocity_commands": command[0],
        "joint_pos_rel": measured.joint_pos[0] - said["default_joint_pos"],
        "joint_vel_rel": measured.joint_vel[0],
        "last_action": np.zeros(12),
    }
    frames = [
        np.tile(terms[name] * term["scale"], term["history_length"]) for name, term in said["observations"].items()
    ]
    obs = np.concatenate(frames).astype(np.float32)
    network = onnxruntime.InferenceSession(tmp_path / "exported/policy.onnx")
    assert network.get_inputs()[0].shape == [1, 5 * 45]
    action = said["actions"]["JointPositionAction"]
    acted = network.run(["actions"], {"obs": obs[None]})[0][0] * action["scale"] + action["offset"]
    low, high = np.array(action["clip"]).T
    assert np.clip(acted, low, high) == pytest.approx(targets, abs=1e-5)
    uneven = replace(contract, stiffness=np.arange(12.0))
    by_motor = deploy_yaml.deploy_settings(uneven)["stiffness"]
    assert [by_motor[slot] for slot in said["joint_ids_map"]] == list(range(12))
    assert said["joint_ids_map"][:3] == [3, 4, 5]  # the contract begins with FL, the robot with FR


def test_deploy_yaml_refuses_what_that_program_does_not_know() -> None:
    with pytest.raises(ContractError, match="gait_clock"):
        deploy_yaml.deploy_settings(read_contract(ROOT / "resources/policies/g1_flat"))
