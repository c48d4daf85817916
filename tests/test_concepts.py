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
from drivers import Watched

from legged_mw import ROOT
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import RobotRemote
from legged_mw.deploy.log import Log
from legged_mw.deploy.robot import Health, Remote
from legged_mw.deploy.runner import run as walk
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.deploy.states import States
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval.exams import require_exam
from legged_mw.export import exporter
from legged_mw.rl.run_folder import update_from_run
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import load_task

PACKAGE = str(ROOT / "legged_mw")
SHIPPED = ROOT / "resources/policies/go1_flat"
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


def unseen(call: Callable[..., Any]) -> Callable[..., Any]:
    """``call``, in which `touched` does not look."""

    def inside(*args: Any, **more: Any) -> Any:
        look = sys.getprofile()
        sys.setprofile(None)
        try:
            return call(*args, **more)
        finally:
            sys.setprofile(look)

    return inside


def an_export() -> Callable[[], object]:
    """Of a published policy, whose network stands for what torch would write of it again."""
    task, folder = load_task("go1_flat"), Path(tempfile.mkdtemp())
    update_from_run(task, load_yaml(SHIPPED / "config.yaml"), "config.yaml")
    env = exporter._small_env(task)
    env.step = unseen(env.step)  # type: ignore[method-assign]

    def write(model: object, args: object, path: Path, **more: object) -> None:
        shutil.copy(SHIPPED / "policy.onnx", path)

    def run() -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(exporter, "_small_env", lambda task: env)
            patch.setattr(torch.onnx, "export", write)
            exporter.export(task, SHIPPED / "policy.onnx", folder)
        shutil.rmtree(folder)

    return run


def a_robot() -> Callable[[], object]:
    """It stands up, walks, and is damped, by its remote; logged. The robot is MuJoCo's."""
    folder, presses = Path(tempfile.mkdtemp()), {5: "start", 150: "A", 160: "select"}

    def health(step: int) -> Health:
        return Health(age_s=0.0, remote=Remote(frozenset({presses[step]} if step in presses else ())))

    def drive() -> None:
        contract = read_contract(SHIPPED)
        robot, controller = Watched(SHIPPED, contract), Controller(SHIPPED, contract)
        robot.health_at = health
        said, still = list[str](), contract.held([0.0, 0.0, 0.0])
        states = States(controller, [RobotRemote(contract.commands)], lambda now: still, said.append)
        safety = Safety(contract, Limits.of(SHIPPED, contract, robot.limits))
        log = Log(folder / "run.lmwlog", contract, SHIPPED, "simulated", said.append)
        done = walk(robot, controller, lambda now: still, 3.4, live=False, safety=safety, states=states, log=log)
        assert {"limp", "write", "damp"} == {*robot.done} and not done.trips
        shutil.rmtree(folder)

    return drive


# concept -> how it is run, most files to read, most files in which code runs
BUDGETS: dict[str, tuple[Callable[[], Callable[[], object]], int, int]] = {
    "one step of walking": (a_step, 8, 15),
    "a reward": (a_reward, 2, 4),
    "a motor's torque": (a_torque, 2, 6),
    "a row of observations": (rows, 2, 6),
    "an iteration of PPO, without its steps": (an_iteration, 4, 13),
    "a checkpoint saved and resumed": (a_checkpoint, 3, 12),
    "the walking exam, without its steps": (an_exam, 6, 19),
    "an export, without the steps of its environment": (an_export, 6, 32),
    "a policy on a robot": (a_robot, 9, 15),
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
