"""The law of legged_mw/fast: in a copy of the project without it physics, environments and learning are what they are with it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from legged_mw import ROOT

PARTS = ("legged_mw", "configs", "resources", "examples", "tests", "train.py", "pyproject.toml")
# the step of two tasks by both engines, and updates against rsl-rl's: what legged_mw/fast computes in another way
TESTS = ("tests/test_net.py", "tests/test_ppo.py", "-k", "first_steps and (go1_flat or g1_track) or rate or symmetric")
TRAINING = [
    *("train.py", "--task", "go1_flat", "--num_envs", "16", "--device", "cpu", "--max_iterations", "3"),
    *("--set", "runner.export=false"),
]


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The project without legged_mw/fast and tests/fast."""
    folder = tmp_path_factory.mktemp("without")
    for part in PARTS:
        if (ROOT / part).is_file():
            shutil.copy(ROOT / part, folder)
        else:
            shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("fast", "__pycache__"))
    return folder


def python(folder: Path, *args: str) -> str:
    """What Python prints that imports the project from ``folder``; fails where it does."""
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    done = subprocess.run([sys.executable, *args], cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_copy_is_without(copy: Path) -> None:
    asks = "import legged_mw.utils.opaque as o; print(o.__file__, o.fast('shortcuts'), o.fast('kernels'))"
    assert python(copy, "-c", asks).split() == [str(copy / "legged_mw/utils/opaque.py"), "None", "None"]


def test_other_tests_pass_without(copy: Path) -> None:
    said = python(copy, "-m", "pytest", "-p", "no:cacheprovider", "-p", "no:xdist", *TESTS)
    assert "passed" in said and "failed" not in said


def test_a_training_runs_without(copy: Path) -> None:
    assert "done: " in python(copy, *TRAINING, "--set", "sim.engine=mujoco_warp")


def test_only_a_missing_package_is_accepted(copy: Path) -> None:
    """A module of it that cannot be imported is an error."""
    package = copy / "legged_mw" / "fast"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "broken.py").write_text("import nothing_of_that_name\n")
    asks = (
        "from legged_mw.utils.opaque import fast\ntry: fast('broken')\nexcept ImportError as error: print(error.name)"
    )
    try:
        assert python(copy, "-c", asks).strip() == "nothing_of_that_name"
    finally:
        shutil.rmtree(package)
