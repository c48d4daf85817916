"""Contacts or constraints that did not fit are said wherever somebody looks at the result."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from program import SMALL

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import perform, rollout
from legged_mw.eval.report import Column, about
from legged_mw.eval.walking import ExamRules
from legged_mw.export import replay as export_replay
from legged_mw.sim.mujoco_engine import MujocoSimulation
from legged_mw.sim.simulation import overflow_note
from legged_mw.utils.task import load_task
from legged_mw.view.playing import EnvStage

NOTE = "is not to be trusted: simulator overflow (NEFC) in 3 of 4 worlds; raise njmax (now 1)"


@pytest.fixture
def env(monkeypatch: pytest.MonkeyPatch) -> LeggedRobot:
    monkeypatch.setattr(
        MujocoSimulation,
        "overflow_report",
        lambda _: "simulator overflow (NEFC) in 3 of 4 worlds; raise njmax (now 1)",
    )
    task = load_task("go1_flat")
    for item in SMALL[SMALL.index("--set") + 1 :: 2]:
        task.set(*item.split("=", 1))
    task.set("env.num_envs", 4)
    return LeggedRobot(task.cfg, "cpu")


def still(obs: Any) -> torch.Tensor:
    return torch.zeros(len(obs["state"]), 12)


def test_the_exam_says_it(env: LeggedRobot, capsys: pytest.CaptureFixture[str]) -> None:
    cases = rollout.cases(ExamRules.from_config(env.cfg), env.dt, 0.0)[:4]
    rollout.roll_out(env, still, cases, 2, {})  # type: ignore[arg-type]
    assert f"WARNING: this exam {NOTE}\n" == capsys.readouterr().out


def test_play_says_it_once(env: LeggedRobot, capsys: pytest.CaptureFixture[str]) -> None:
    stage = EnvStage(env, still)
    for _ in range(3):
        stage.step(None)
    assert f"WARNING: the shown simulation {NOTE}\n" == capsys.readouterr().out


def test_the_report_says_it(env: LeggedRobot) -> None:
    note = overflow_note(env.sim, "this exam")
    assert f"<b>WARNING: this exam {NOTE}</b>" in about([Column("mine", {"warning": note}, {}, {})])


def test_the_skills_exam_and_the_export_say_it() -> None:
    """Through the same line: it is called there."""
    for place in (perform.perform, export_replay.record):
        assert "say_overflow" in place.__code__.co_names


def test_what_fits_says_nothing(env: LeggedRobot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MujocoSimulation, "overflow_report", lambda _: "")
    assert overflow_note(env.sim, "this exam") == ""
