"""Robots as vendors write them, from the unedited file to a deployed policy: check, a short training, export, deploy."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from data.vendor_tasks import HERE, TASKS
from program import run

from legged_mw.deploy.contract import read_contract
from legged_mw.utils.config import load_yaml

FEW = [
    *shlex.split("--num_envs 8 --max_iterations 3 --set runner.num_steps_per_env=8"),
    *shlex.split("--set runner.exam_interval=0"),
]
FEW += [
    *shlex.split("--set 'actor.hidden_dims=[16, 16]' --set 'critic.hidden_dims=[16, 16]'"),
    *shlex.split("--set algorithm.num_learning_epochs=1"),
]
FILES = {path.name for path in HERE.iterdir() if path.suffix in (".xml", ".urdf")}


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A user's folder: the six files, and a task file for each."""
    folder = tmp_path_factory.mktemp("user") / "robots"
    shutil.copytree(HERE, folder, ignore=shutil.ignore_patterns("__pycache__"))
    for name in TASKS:
        (folder / f"{name}.py").write_text(f'from vendor_tasks import TASKS\n\nTASK = TASKS["{name}"]\n')
    return folder


def test_they_are_six_short_files() -> None:
    assert {Path(task.cfg.asset.file).name for task in TASKS.values()} == FILES and len(FILES) == 6
    assert all(30 <= len((HERE / name).read_text().splitlines()) <= 80 for name in FILES)


@pytest.mark.parametrize(
    ("name", "engine", "device"),
    [
        *((name, "mujoco", "cpu") for name in ("go2_style", "anymal_c_style", "g1_held_style")),
        ("t1_style", "mujoco_warp", "cpu"),
        *(pytest.param(name, "mujoco_warp", "cuda:0", marks=pytest.mark.gpu) for name in TASKS),
    ],
)
def test_from_the_file_to_a_deployed_policy(name: str, engine: str, device: str, robots: Path, tmp_path: Path) -> None:
    task = ["--task", str(robots / f"{name}.py"), "--device", device, "--engine", engine]
    checked = run("train", tmp_path, *task, "--check")
    assert checked.code == 0 and "the step can be recorded as a CUDA graph\n" in checked.out, checked.err

    trained = run("train", tmp_path, *task, *FEW)
    assert trained.code == 0 and "Learning iteration 3/3" in trained.out, trained.err
    assert "WARNING" not in trained.out, "room for contacts and constraints"
    [folder] = (tmp_path / "logs" / name).iterdir()
    assert load_yaml(folder / "config.yaml")["sim"]["engine"] == engine
    weights = torch.load(folder / "model_3.pt", weights_only=True)["actor_state_dict"].values()
    assert all(torch.isfinite(weight).all() for weight in weights)

    deployed = run("deploy", tmp_path, str(folder / "export"), "--viewer", "none", "--time", "0.3s")
    assert deployed.code == 0, deployed.err
    assert re.search(r"^0\.3 s, 0 falls$", deployed.out, re.MULTILINE), deployed.out
    measured = [float(number) for number in deployed.out.splitlines()[-1].split()[-3:]]
    assert np.isfinite(measured).all() and len(read_contract(folder / "export").joints) >= 12
