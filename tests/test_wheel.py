"""The wheel: what is in it, and that a task loads, trains and deploys from it, away from the clone and from anything of it."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from legged_mw import ROOT, programs

CONFIGS = {path.relative_to(ROOT / "configs") for path in (ROOT / "configs").rglob("*.py")}


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel, unpacked as pip does it; built from a copy of the sources, which stay as they are."""
    source, wheels, site = (tmp_path_factory.mktemp(name) for name in ("source", "wheels", "site"))
    for name in ("pyproject.toml", "README.md", "LICENSE", "legged_mw", "configs", "resources"):
        (source / name).symlink_to(ROOT / name)
    build = "import sys; from setuptools import build_meta; build_meta.build_wheel(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", build, str(wheels)], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    [wheel] = wheels.iterdir()
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return site


def start(installed: Path, folder: Path, *args: str) -> str:
    """``legged-mw <args>`` in ``folder``, with the package of the wheel and without the clone on the path."""
    libraries = sysconfig.get_path("purelib")
    program = "import sys; sys.argv[0] = 'legged-mw'; import legged_mw; print(legged_mw.__file__); "
    program += "from legged_mw.programs import main; main()"
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), libraries])}
    command = [sys.executable, "-S", "-c", program, *args]  # -S: an editable install of the clone stays out
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    where, _, out = done.stdout.partition("\n")
    assert where == str(installed / "legged_mw/__init__.py")
    return out


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="compares with what git tracks")
def test_the_sdist_holds_what_the_wheel_is_built_from_and_tested_with(tmp_path: Path) -> None:
    """What git tracks, but for the pictures of docs/ and the folders of services: MANIFEST.in lists it."""
    source, out = tmp_path / "source", tmp_path / "out"
    out.mkdir()
    subprocess.run(["git", "checkout-index", "--all", f"--prefix={source}/"], cwd=ROOT, check=True)
    build = "import sys; from setuptools import build_meta; build_meta.build_sdist(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", build, str(out)], cwd=source, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    [file] = out.iterdir()
    with tarfile.open(file) as archive:
        inside = {name.partition("/")[2] for name in archive.getnames()}
    tracked = {str(path.relative_to(source)) for path in source.rglob("*") if path.is_file()}
    left_out = {name for name in tracked - inside if not name.startswith((".", "docs/images/"))}
    assert left_out == set() and not any("__pycache__" in name for name in inside)
    assert {"LICENSE", "constraints.txt", "tests/program.py", "resources/policies/go1_flat/policy.onnx"} <= inside


def test_the_image_is_built_from_files_that_are_there_and_from_constraints() -> None:
    lines = (ROOT / "Dockerfile").read_text().splitlines()
    copied = [name for line in lines if line.startswith("COPY ") for name in line.split()[1:-1]]
    assert {"legged_mw", "configs", "resources", "constraints.txt"} <= set(copied) and all(
        (ROOT / name).exists() for name in copied
    )
    [install] = [line for line in lines if "pip install" in line]
    assert "--constraint /src/constraints.txt" in install and not set(copied) & set(
        (ROOT / ".dockerignore").read_text().split()
    )


def test_the_same_version_everywhere() -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert (
        f"\nversion: {version}\n" in (ROOT / "CITATION.cff").read_text()
        and f"## {version} (" in (ROOT / "CHANGELOG.md").read_text()
    )


def test_what_is_installed_by_constraints_fits_the_ranges() -> None:
    pinned = dict(line.split("==") for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line)
    pinned = {name.lower().replace("_", "-"): version for name, version in pinned.items()}
    for text in tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]:
        requirement = Requirement(text)
        assert requirement.specifier.contains(pinned[requirement.name]), text
        assert any(spec.operator == ">=" for spec in requirement.specifier), (
            f"{text}: from which version on was it tested?"
        )


def test_every_package_is_in_the_list() -> None:
    packages = {str(path.parent.relative_to(ROOT)).replace("/", ".") for path in ROOT.glob("legged_mw/**/__init__.py")}
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    beside = {"legged_mw.configs", "legged_mw.configs.robots", "legged_mw.resources"}
    assert set(settings["packages"]) == packages | beside


def test_configs_robots_and_policies_are_inside(installed: Path) -> None:
    package = installed / "legged_mw"
    inside = {path.relative_to(package / "configs") for path in (package / "configs").rglob("*") if path.is_file()}
    assert inside == CONFIGS
    for folder in ("robots", "motions", "policies"):
        inside, here = package / "resources" / folder, ROOT / "resources" / folder
        ours = {path.relative_to(here) for path in here.rglob("*") if path.is_file()}
        assert ours and ours == {path.relative_to(inside) for path in inside.rglob("*") if path.is_file()}
    for file in ("peers.yaml", "makers.yaml"):
        assert (package / "resources" / file).is_file()
    [points] = installed.glob("*.dist-info/entry_points.txt")
    assert "legged-mw = legged_mw.programs:main" in points.read_text()
    # `configs` is nobody's top level
    assert {path.name for path in installed.iterdir()} == {"legged_mw", points.parent.name}


def test_an_installed_package_trains_the_task_of_the_first_page_and_logs_where_it_is_started(
    installed: Path, tmp_path: Path
) -> None:
    [code] = re.findall(r"```python\n(.*?)```", (ROOT / "docs/index.md").read_text(), re.DOTALL)
    home = tmp_path / "robots"
    home.mkdir()
    (home / "go1_gentle.py").write_text(code)
    small = [
        *shlex.split("--device cpu --num_envs 8 --max_iterations 1 --verbose --set runner.num_steps_per_env=4"),
        *shlex.split("--set runner.export=false"),
    ]
    out = start(installed, tmp_path, "train", "--task", str(home / "go1_gentle.py"), *small)
    assert "rew_crouch" in out and "watch it with\n  legged-mw play --task " in out
    [config] = tmp_path.glob("logs/go1_gentle/*/config.yaml")
    assert f"file: {installed}" not in config.read_text()  # a run can be played in a clone


def test_an_installed_package_deploys_the_shipped_policy_by_name(installed: Path, tmp_path: Path) -> None:
    out = start(installed, tmp_path, "deploy", "go1_flat", "--viewer", "none", "--time", "0.1s")
    assert "0.1 s, 0 falls" in out


def test_an_installed_package_drafts_a_task(installed: Path, tmp_path: Path) -> None:
    out = start(installed, tmp_path, "robot", str(ROOT / "tests/data/go2_style.xml"), "--new", "mine")
    assert out.endswith("written: mine.xml and mine_flat.py; next:\n  legged-mw train --task mine_flat.py --check\n")
    assert (tmp_path / "mine.xml").exists() and (tmp_path / "mine_flat.py").exists()


def test_without_a_program_the_programs_are_named(tmp_path: Path) -> None:
    names = "train, play, deploy, exam, fit, robot, motion, doctor, compare, sweep, warm, completion"
    for words, said in (
        ([], f"there are: {names}"),
        (["trian"], f"no program 'trian', did you mean 'train'? there are: {names}"),
    ):
        command = [sys.executable, "-m", "legged_mw.programs", *words]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (2, f"legged-mw: {said}; e.g. legged-mw train --task go1_flat\n")


def test_help_says_what_each_program_does(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["legged-mw", "--help"])
    programs.main()
    said = capsys.readouterr().out
    assert said.startswith("legged-mw PROGRAM ...; each has --help, e.g. legged-mw train --help\n")
    assert [line.split()[0] for line in said.splitlines()[1:]] == list(programs.PROGRAMS)
    monkeypatch.setattr(sys, "argv", ["legged-mw", "--version"])
    programs.main()
    assert capsys.readouterr().out.startswith("legged_mw 0.")
