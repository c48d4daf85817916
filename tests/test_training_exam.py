"""The exam during training: its figures, its curves, and that training does not notice it."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from program import SMALL, refused, run, trained
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from test_train import assert_equal

from legged_mw.eval import rollout
from legged_mw.eval.exams import make_exam
from legged_mw.eval.figures import Record
from legged_mw.eval.rollout import TrainingExam, training_figures
from legged_mw.rl.run_folder import checkpoints
from legged_mw.rl.runner import Runner
from legged_mw.utils.task import load_task

FIGURES = ["error_vx", "error_vy", "error_yaw", "falls", "pushes_survived"]


def test_figures() -> None:
    """World i is off by 0.01 i, of either sign, once it settled; command 20 fell, and 4 of the 16 that were pushed."""
    steps, worlds = 200, 38
    off = (
        0.01 * np.arange(worlds)[None, :, None] * (-1.0) ** np.arange(steps)[:, None, None] * np.array([1.0, 2.0, 3.0])
    )
    off[:100] += 9.0
    fell_at = np.full(worlds, math.inf)
    fell_at[[20, 22, 23, 24, 37]] = 150
    commands = np.ones((steps, worlds, 3))
    found = training_figures(
        Record(0.02, 10.0, commands, fell_at, np.zeros((worlds, 2)), {"velocity": commands + off}), 22
    )
    means = [(0.01 * n * (sum(range(22)) - 20) + 1.0) / 22 for n in (1, 2, 3)]  # at command 20 it is off by the command
    assert found == pytest.approx(dict(zip(FIGURES, [*means, 1.0, 0.75], strict=True)))
    all_fell = training_figures(
        Record(0.02, 10.0, commands, np.zeros(worlds), np.zeros((worlds, 2)), {"velocity": commands + off}), 22
    )
    assert all_fell["error_vx"] == 1.0 and all_fell["falls"] == 22 and all_fell["pushes_survived"] == 0.0


def test_it_grades_and_draws_nothing_of_the_trainings_randomness() -> None:
    """Zero action stands: it follows the command to stand only, and no generator has moved."""
    task = load_task("go1_flat")
    task.set("terrain.friction", 0.4)  # an override of training counts in the exam
    before = torch.get_rng_state()
    examine = TrainingExam(task, "cpu")
    found = examine(lambda obs: torch.zeros(len(obs), 12))
    assert torch.equal(torch.get_rng_state(), before)
    assert examine.env.cfg.terrain.friction == 0.4 and examine.env.num_envs == 38 and task.cfg.env.num_envs == 8192
    assert examine.env.cfg.noise.level == 0.0 and task.cfg.noise.level == 1.0
    wanted = np.abs(examine.rules.commands()).mean(axis=0)
    assert [found[name] for name in FIGURES[:3]] == pytest.approx(list(wanted), abs=0.01) and found["falls"] == 0
    assert found["pushes_survived"] == 0.0
    assert examine(lambda obs: torch.zeros(len(obs), 12)) == found


def test_advice_names_what_is_beyond_the_marks() -> None:
    rules = TrainingExam(load_task("go1_flat"), "cpu").rules
    vx, vy, yaw = rules.marks
    can, cannot, after = rules.advise([vx, vy, yaw], 0.0, 1.0)
    assert can.count(";") >= 4 and cannot == "it cannot: -" and "--eval" in after
    can, cannot, after = rules.advise([vx, 2.0 * vy, yaw], 3.0, 0.5)
    assert "follow vy" in cannot and "stand at" in cannot and "pushes" in cannot and "--resume" in after
    assert "follow vx" in can and "follow yaw" in can and "perturbation.velocity" in after
    *_, after = rules.advise([vx, vy, yaw], 0.0, 0.5)
    assert "perturbation.velocity" not in after  # no fall: weaker kicks would not help


def test_no_exam_for_an_actor_that_sees_what_the_nominal_world_has_not(capsys: pytest.CaptureFixture[str]) -> None:
    task = load_task("go1_flat")
    for path, value in {"env.num_envs": 2, "domain_rand.enable": True, "domain_rand.observe": True}.items():
        task.set(path, value)
    env = task.env_class(task.cfg, "cpu")
    assert make_exam(task, env) is not None  # its actor sees `state`, which is the same
    task.set("obs_groups.actor", ["privileged_state"])
    assert make_exam(task, env) is None
    line = capsys.readouterr().out
    assert (
        line.startswith("no exam during training: the actor's observation group 'privileged_state' has 1")
        and line.count("\n") == 1
    )


def run_with(root: Path, interval: int) -> tuple[Path, dict[int, Any], dict[str, list[int]]]:
    """Four iterations: the run's folder, its checkpoints, and each curve's iterations."""
    options = ["--max_iterations", "4", "--set", "runner.save_interval=2", "--set", f"runner.exam_interval={interval}"]
    learn = Runner.learn

    def learn_and_flush(self: Runner, *args: Any) -> None:
        learn(self, *args)
        self.logger.writer.flush()  # type: ignore[union-attr]  (a thread writes the curves)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runner, "learn", learn_and_flush)
        folder = trained(root, *options)
    events = EventAccumulator(str(folder))
    events.Reload()
    curves = {name: [point.step for point in events.Scalars(name)] for name in events.Tags()["scalars"]}
    return folder, {n: torch.load(path, weights_only=True) for n, path in checkpoints(folder).items()}, curves


def test_exams_are_logged_and_leave_training_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Networks, normalisers, optimizer, counters and random state of every checkpoint are the same bits with exams and without."""
    monkeypatch.setattr(rollout, "TRAINING_SECONDS", 0.5)
    monkeypatch.setattr(rollout, "TRAINING_SETTLING", 0.2)
    _, plain, curves = run_with(tmp_path / "without", 0)
    assert not [name for name in curves if name.startswith("Exam/")]
    _, examined, curves = run_with(tmp_path / "with", 2)
    assert list(plain) == list(examined) == [2, 4]
    for n, content in plain.items():
        assert_equal(content, examined[n], str(n))
    for name in FIGURES:
        assert curves[f"Exam/{name}"] == [2, 4]
    assert curves["Perf/exam_time"] == [2, 4] and curves["Train/total_steps"] == [1, 2, 3, 4]


def test_an_exam_that_fails_costs_the_training_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> dict[str, float]:
        raise RuntimeError("no room for it")

    monkeypatch.setattr(TrainingExam, "__call__", fail)
    result = run("train", tmp_path, *SMALL, "--max_iterations", "4", "--set", "runner.exam_interval=1")
    assert result.code == 0 and list(tmp_path.glob("logs/*/*/model_4.pt"))
    assert (
        result.out.count("WARNING: the exam failed, training continues without it: RuntimeError: no room for it") == 1
    )


def test_a_short_run_has_no_exam_and_a_negative_interval_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin(*_: Any, **__: Any) -> None:
        raise AssertionError("nobody asked for an exam")

    monkeypatch.setattr("legged_mw.eval.exams.make_exam", begin)
    trained(tmp_path, "--max_iterations", "1")  # fewer than an interval
    line = refused(tmp_path, "train", "--task", "go1_flat", "--device", "cpu", "--set", "runner.exam_interval=-1")
    assert "runner.exam_interval is -1; it must be 0 or more" in line
