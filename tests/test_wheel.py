"""The wheel: what is in it, and that a task loads, trains and deploys from it, away from the clone and from anything of it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import sysconfig
import tomllib
import zipfile
from pathlib import Path

import pytest

from legged_mw import ROOT, programs

CONFIGS = {path.name for path in (ROOT / "configs").glob("*.py")}


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
    program = (
        "import sys; sys.argv[0] = 'legged-mw'; import legged_mw; print(legged_mw.__file__); from legged_mw.programs import main; main()"
    )
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(installed), libraries])}
    command = [sys.executable, "-S", "-c", program, *args]  # -S: an editable install of the clone stays out
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    where, _, out = done.stdout.partition("\n")
    assert where == str(installed / "legged_mw/__init__.py")
    return out


def test_every_package_is_in_the_list() -> None:
    packages = {str(path.parent.relative_to(ROOT)).replace("/", ".") for path in ROOT.glob("legged_mw/**/__init__.py")}
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    assert set(settings["packages"]) == packages | {"legged_mw.configs", "legged_mw.resources"}


def test_configs_robots_and_policies_are_inside(installed: Path) -> None:
    package = installed / "legged_mw"
    assert {path.name for path in (package / "configs").iterdir()} == CONFIGS
    for folder in ("robots", "motions", "policies"):
        inside, here = package / "resources" / folder, ROOT / "resources" / folder
        ours = {path.relative_to(here) for path in here.rglob("*") if path.is_file() and path.name != "exam.json"}
        assert ours and ours == {path.relative_to(inside) for path in inside.rglob("*") if path.is_file()}
    [points] = installed.glob("*.dist-info/entry_points.txt")
    assert "legged-mw = legged_mw.programs:main" in points.read_text()
    assert {path.name for path in installed.iterdir()} == {"legged_mw", points.parent.name}  # `configs` is nobody's top level


def test_an_installed_package_trains_the_task_of_the_first_page_and_logs_where_it_is_started(installed: Path, tmp_path: Path) -> None:
    [code] = re.findall(r"```python\n(.*?)```", (ROOT / "docs/index.md").read_text(), re.DOTALL)
    home = tmp_path / "robots"
    home.mkdir()
    (home / "go1_gentle.py").write_text(code)
    small = [
        "--device",
        "cpu",
        "--num_envs",
        "8",
        "--max_iterations",
        "1",
        "--set",
        "runner.num_steps_per_env=4",
        "--set",
        "runner.export=false",
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
    for words, said in (
        ([], "there are: train, play, deploy, robot"),
        (["trian"], "no program 'trian'; there are: train, play, deploy, robot"),
    ):
        command = [sys.executable, "-m", "legged_mw.programs", *words]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (2, f"legged-mw: {said}; e.g. legged-mw train --task go1_flat\n")


def test_help_names_the_programs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(sys, "argv", ["legged-mw", "--help"])
    programs.main()
    assert capsys.readouterr().out.startswith("legged-mw train | play | deploy | robot ...; each has --help")
