"""What must be opened to understand one thing: the table in docs/concepts.md, held against the files in which code runs."""

from __future__ import annotations

import re
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import pytest
import torch

from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval.exams import require_exam
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.utils.task import load_task

PACKAGE = str(ROOT / "legged_mw")
TITLE = "## What to open"


class Concept(NamedTuple):
    read: list[str]  # files, in reading order
    leaves: dict[str, str]  # file -> why it need not be read


def table() -> dict[str, Concept]:
    section = (ROOT / "docs/concepts.md").read_text(encoding="utf-8").split(TITLE)[1].split("\n## ")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    found = {}
    for name, read, leaves in rows[2:]:
        why = {file: reason for files, reason in re.findall(r"([^;:]+): ([^;]+)", leaves) for file in _files(files)}
        found[name] = Concept(_files(read), why)
    return found


def _files(cell: str) -> list[str]:
    return re.findall(r"`([\w/]+)`", cell)


class OwnLaw(LeggedRobot):
    """With legged_gym's law in code, in place of the servos."""

    def _compute_torques(self, actions: torch.Tensor) -> torch.Tensor:
        return super()._compute_torques(actions)


def make(kind: type[LeggedRobot] = LeggedRobot) -> Any:
    task = load_task("go1_flat")
    for path, value in {"env.num_envs": 4, "sim.engine": "mujoco", "sim.fuse": False}.items():
        task.set(path, value)
    return kind(task.cfg, "cpu")


def a_step() -> Callable[[], object]:
    """In which every episode ends and begins."""
    env = make()
    env.episode_length_buf = torch.full_like(env.episode_length_buf, 10**6)
    return lambda: env.step(torch.zeros(4, 12))


def a_reward() -> Callable[[], object]:
    return make()._reward_feet_air_time


def a_torque() -> Callable[[], object]:
    """Of a law in code, from an action to a substep."""
    env = make(OwnLaw)

    def act() -> None:
        env.actuators.apply(env.actions)
        env.sim.step(1, before=env.actuators.before)

    return act


def rows() -> Callable[[], object]:
    return make().compute_observations


def make_learner(folder: Path | None = None) -> Runner:
    task = load_task("go1_flat")
    small = {"actor.hidden_dims": [8], "critic.hidden_dims": [8], "runner.num_steps_per_env": 1}
    for path, value in {**small, "algorithm.num_mini_batches": 1}.items():
        task.set(path, value)
    return make_runner(make(), task.train, folder, "cpu")


def an_iteration() -> Callable[[], object]:
    runner = make_learner()
    stepped = runner.env.step(torch.zeros(4, 12))
    runner.env.step = lambda actions: stepped  # type: ignore[method-assign]
    return lambda: runner.learn(1, init_at_random_ep_len=False)


def a_checkpoint() -> Callable[[], object]:
    folder = Path(tempfile.mkdtemp())
    saves, loads = make_learner(folder), make_learner()
    saves.learn(1, init_at_random_ep_len=False)

    def save_and_load() -> None:
        saves._save_checkpoint()
        loads.load(str(folder / "model_1.pt"))
        shutil.rmtree(folder)
        assert loads.why_not_exact == ""

    return save_and_load


def an_exam() -> Callable[[], object]:
    """From a roll-out to the table, as ``--eval`` does; the report that is drawn of it is left out."""
    task = load_task("go1_flat")
    exam = require_exam(task)
    for path, value in {"sim.engine": "mujoco", "sim.fuse": False}.items():
        task.set(path, value)
    exam.prepare(task)
    exam.make_room(task)
    env, actions = LeggedRobot(task.cfg, "cpu"), torch.zeros(task.cfg.env.num_envs, 12)
    stepped = env.step(actions)
    env.step = lambda actions: stepped  # type: ignore[method-assign]
    return lambda: exam.table(exam.examine(env, lambda obs: actions[: len(obs)])[0])


# concept -> how it is run, most files to read, most files in which code runs
BUDGETS: dict[str, tuple[Callable[[], Callable[[], object]], int, int]] = {
    "one step of walking": (a_step, 8, 15),
    "a reward": (a_reward, 2, 4),
    "a motor's torque": (a_torque, 2, 6),
    "a row of observations": (rows, 2, 6),
    "an iteration of PPO, without its steps": (an_iteration, 4, 13),
    "a checkpoint saved and resumed": (a_checkpoint, 3, 12),
    "the walking exam, without its steps": (an_exam, 6, 19),
}


def touched(run: Callable[[], object]) -> set[str]:
    """Files of the package, without ``.py``, whose functions are called; without fast/, which may be missing."""
    seen = set[str]()

    def look(frame: FrameType, event: str, _: object) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            seen.add(str(Path(frame.f_code.co_filename).relative_to(PACKAGE).with_suffix("")))

    sys.setprofile(look)
    try:
        run()
    finally:
        sys.setprofile(None)
    return {file for file in seen if not file.startswith("fast/")}


@pytest.mark.parametrize("name", BUDGETS)
def test_what_runs_is_listed(name: str) -> None:
    concept, (prepare, most_read, most_touched) = table()[name], BUDGETS[name]
    found = touched(prepare())
    assert found <= {*concept.read, *concept.leaves}, "list these in docs/concepts.md, with the reason"
    assert len(concept.read) <= most_read and len(found) <= most_touched
    assert found & {*concept.read} and {*concept.leaves} <= found


def test_files_of_the_table_exist() -> None:
    concepts = table()
    assert concepts.keys() == BUDGETS.keys()
    files = [file for concept in concepts.values() for file in (*concept.read, *concept.leaves)]
    assert [file for file in files if not Path(PACKAGE, f"{file}.py").exists()] == []


def test_a_file_that_is_not_listed_is_found() -> None:
    def run() -> None:
        table()
        load_task("go1_flat")

    assert "utils/task" in touched(run)
