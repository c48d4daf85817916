"""A training that was killed and resumed is the uninterrupted one, bit for bit: networks, optimizer, generators, worlds."""

from __future__ import annotations

import os
import shlex
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from program import SMALL, Result, assert_equal, load, refused, run, trained

from legged_mw.envs.snapshot import beyond
from legged_mw.rl.run_folder import CheckpointWriter, check_fit, checkpoints, save_whole

EXACTLY = "exactly: worlds and generators go on where they were"
THREE = [
    *shlex.split("--set runner.save_interval=1 --max_iterations 3 --seed 3 --set cpu.update_threads=1"),
    "--eager",
]
DELAYS = ["action_delay=[0, 2]", "observation_delay=[0, 2]", "delay_ms=[0.0, 12.0]", "encoder_offset=[-0.02, 0.02]"]
TILES = ["--set", "terrain.num_rows=2", "--set", "terrain.num_cols=8"]
TASKS = {  # what is trained -> flags; with symmetry, kicks, noise and episodes that end on the way
    "go1_rough": ["--task", "go1_rough", *TILES],
    "drawn worlds, delays, history": [
        *shlex.split("--task go1_flat_dr --set domain_rand.redraw_iterations=1"),
        *shlex.split("--set 'observations.history={state: 3}'"),
        *(word for each in DELAYS for word in ("--set", f"domain_rand.{each}")),
    ],
    "curricula, memory": [
        *shlex.split("--set commands.curriculum=true --set perturbation.curriculum=true"),
        *shlex.split("--set perturbation.push=true"),
        *("--set", "actor.class_name=RNNModel", "--set", "actor.rnn_hidden_dim=8", "--set", "cpu.rnn_hidden_dim=8"),
    ],
    "estimator": ["--task", "go1_flat_blind", "--set", "actor.estimator.targets=[base_lin_vel]"],
}
BY_HAND = {  # LEGGED_MW_CAMPAIGN=all pytest tests/campaign/test_resume.py
    "go1_flat": [],
    "no symmetry": ["--set", "symmetry.use_data_augmentation=false", "--set", "algorithm.schedule=fixed"],
    "rsl-rl's own": ["--set", "algorithm.class_name=PPO"],
    "getup": ["--task", "go1_getup"],
    "handstand": ["--task", "go1_handstand"],
    "tracking": ["--task", "g1_track"],
    "g1": ["--task", "g1_flat"],
    "concurrent": ["--task", "go1_rough_student", "--set", "actor.concurrent.groups=[privileged_state]", *TILES],
    "mujoco_warp": ["--engine", "mujoco_warp"],
    "mujoco_warp, drawn worlds": ["--task", "go1_flat_dr", "--engine", "mujoco_warp"],
}
if os.environ.get("LEGGED_MW_CAMPAIGN") == "all":
    TASKS |= BY_HAND


def interrupted(root: Path, *flags: str, after: int = 2) -> tuple[Path, Path]:
    """A run of three iterations, and a copy of its folder as a kill after iteration ``after`` would have left it."""
    killed, write = root / "killed/logs/go1_flat/run", CheckpointWriter.write

    def write_and_copy(self: CheckpointWriter, iteration: int, *content: Any) -> bool:
        done = write(self, iteration, *content)
        if iteration == after:
            shutil.copytree(self.folder, killed)
        return done

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CheckpointWriter, "write", write_and_copy)
        result = run("train", root, *SMALL, *THREE, "--experiment_name", "whole", *flags)
    assert result.code == 0, result.err
    [whole] = (root / "logs/whole").iterdir()
    return whole, killed


def resume(root: Path, folder: Path, *flags: str) -> Result:
    task = flags[flags.index("--task") + 1] if "--task" in flags else "go1_flat"
    return run(
        "train", root, "--task", task, "--device", "cpu", "--eager", "--resume", "--load_run", str(folder), *flags
    )


@pytest.mark.parametrize("name", TASKS)
def test_a_resumed_training_is_the_uninterrupted_one(name: str, tmp_path: Path) -> None:
    whole, killed = interrupted(tmp_path, *TASKS[name])
    assert [path.name for path in whole.glob("worlds_*.pt")] == ["worlds_3.pt"] and len(checkpoints(whole)) == 3
    result = resume(tmp_path, killed, *TASKS[name][: TASKS[name].count("--task") * 2])
    assert result.code == 0 and EXACTLY in result.out, result
    assert_equal(load(killed / "model_3.pt"), load(whole / "model_3.pt"))
    resumed, uninterrupted = (load(folder / "worlds_3.pt") for folder in (killed, whole))
    assert resumed["device"] == "cpu"
    resumed["worlds"] = {name: resumed["worlds"][name] for name in uninterrupted["worlds"]}  # loading wrote more
    assert_equal(resumed, uninterrupted)


OWN_TASK = """
import torch
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Mine(LeggedRobot):
    def _init_buffers(self):
        super()._init_buffers()
        self.steps = {made}

    def _end_step(self):
        super()._end_step()
        self.steps.add_(1.0)


TASK = Task(Mine, Go1FlatCfg, Go1FlatCfgPPO)
"""


@pytest.mark.parametrize("eager", [[], ["--eager"]])
@pytest.mark.parametrize("made", ["self.buffer()", "torch.zeros(self.num_envs, device=self.device)"])
def test_a_buffer_of_a_users_own_goes_on_or_costs_the_word(made: str, eager: list[str], tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(OWN_TASK.format(made=made))
    task = ["--task", str(tmp_path / "mine.py"), "--device", "cpu", *eager]
    first = run("train", tmp_path, *SMALL, *task, "--max_iterations", "1")
    result = run("train", tmp_path, *task, "--resume", "--max_iterations", "2")
    assert first.code == result.code == 0, (first, result)
    lost = "self.steps is written by the step and not made by self.buffer()"
    assert (EXACTLY in result.out) == (made == "self.buffer()") == (lost not in result.out)
    assert (f"worlds begin anew ({lost})" in result.out) == (made != "self.buffer()")
    assert (lost in first.out) == (made != "self.buffer()" and not eager)


def test_a_number_of_a_users_task_may_be_below_zero() -> None:
    best = {"best_reward": torch.tensor([-3.0])}
    check_fit(best, best, Path("model_1.pt"), "infos.env")


@pytest.mark.parametrize("value", [torch.nan, -torch.inf, 1e30])
@pytest.mark.parametrize("what", ["everything", "sim.qpos", "actions"])
def test_worlds_of_wild_numbers_begin_anew(what: str, value: float, tmp_path: Path) -> None:
    """Whoever wrote them: else the run would end some iterations later, and blame the task."""
    folder = trained(tmp_path, "--max_iterations", "1", "--eager")
    content = load(folder / "worlds_1.pt")
    for name, saved in content["worlds"].items():
        if saved.is_floating_point() and what in ("everything", name):
            saved.view(-1)[0 if what != "everything" else slice(None)] = value
    save_whole(content, folder / "worlds_1.pt")
    result = resume(tmp_path, folder, "--max_iterations", "2")
    assert result.code == 0 and "worlds begin anew (worlds_1.pt: " in result.out and EXACTLY not in result.out, result


def test_numbers_that_are_infinite_in_a_new_environment_too_may_be(tmp_path: Path) -> None:
    own = {"best": torch.tensor([-torch.inf, 3.0]), "level": torch.tensor([1, 2])}
    assert beyond({"best": torch.tensor([2.0, -torch.inf]), "level": torch.tensor([1, 2])}, own) == ""
    assert beyond({"best": torch.tensor([2.0, torch.nan])}, {"best": torch.zeros(2)}) == "best"


def test_a_resume_that_is_refused_leaves_nothing(tmp_path: Path) -> None:
    """Not even a lock, in a run that has none, as a stranger's."""
    folder = trained(tmp_path, "--max_iterations", "1")
    (folder / ".lock").unlink()
    asked = ["--task", "go1_flat", "--device", "cpu", "--eager", "--resume", "--load_run", folder.name]
    assert "raise --max_iterations" in refused(tmp_path, "train", *asked)
    content = load(folder / "model_1.pt")
    content["optimizer_state_dict"]["state"][0]["exp_avg"][...] = torch.nan
    save_whole(content, folder / "model_1.pt")
    assert "not finite" in refused(tmp_path, "train", *asked, "--max_iterations", "2")
