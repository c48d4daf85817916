"""A task, its robot and its runs move: to another folder, to another machine, away from the class that they extend."""

from __future__ import annotations

import re
import shlex
import sys
from pathlib import Path
from typing import Any

import pytest
from program import SMALL, refused, run
from rsl_rl.utils import resolve_callable

from legged_mw import ROOT
from legged_mw.rl.run_folder import task_of, update_from_run
from legged_mw.utils.config import ConfigError, load_yaml, save_yaml
from legged_mw.utils.errors import UserError
from legged_mw.utils.files import find_file
from legged_mw.utils.task import LoadedTask, load_task

GO1 = ROOT / "resources/robots/go1/go1.xml"
QUICK = SMALL[2:]  # but for its task
BASE = """
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO


class BaseCfg(Go1FlatCfg):
    class asset(Go1FlatCfg.asset):
        file = "robot/dog.xml"

    class env(Go1FlatCfg.env):
        episode_length_s = {seconds}
"""
DOG = '''"""A dog that extends a neighbour."""

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task
from my_base import BaseCfg, Go1FlatCfgPPO


class DogCfg(BaseCfg):
    class asset(BaseCfg.asset):
        penalize_contacts_on = []


TASK = Task(LeggedRobot, DogCfg, Go1FlatCfgPPO)
'''


def kennel(folder: Path, seconds: float = 7.0) -> Path:
    """A task file with a neighbour and a robot beside it."""
    (folder / "robot").mkdir(parents=True)
    (folder / "my_base.py").write_text(BASE.format(seconds=seconds))
    (folder / "robot/dog.xml").write_text(GO1.read_text())
    (folder / "dog.py").write_text(DOG)
    return folder / "dog.py"


def robot_of(task: LoadedTask) -> Path:
    return find_file(task.cfg, "asset.file")


# ---- runs and exports


def test_a_folder_with_task_robot_and_runs_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing in it says where it was; it is exported, resumed and played from where it is now, and by a task that lies elsewhere."""
    old, new = tmp_path / "first machine", tmp_path / "second" / "machine"
    kennel(old)
    monkeypatch.chdir(old)
    result = run("train", old, "--task", "dog.py", *QUICK, "--max_iterations", "1", "--set", "runner.export=true")
    assert result.code == 0 and "not exported" not in result.out, result
    [folder] = (old / "logs/dog").iterdir()
    assert "--task dog.py --load_run" in result.out and (folder / "export/policy.yaml").exists()
    config = load_yaml(folder / "config.yaml")
    assert (config["task"], config["asset"]["file"]) == ("dog.py", "robot/dog.xml")
    assert load_yaml(folder / "export/config.yaml") == config
    tell = [path for path in folder.rglob("*") if path.is_file() and str(tmp_path).encode() in path.read_bytes()]
    assert not tell
    new.parent.mkdir()
    monkeypatch.chdir(tmp_path)
    old.rename(new)
    run_folder = new / "logs/dog" / folder.name
    monkeypatch.chdir(new)
    result = run(
        "train",
        new,
        *shlex.split("--task dog.py --resume --device cpu --max_iterations 2 --set runner.export=false"),
    )
    assert result.code == 0 and (run_folder / "model_2.pt").exists(), result
    monkeypatch.chdir(tmp_path)
    still = ["--device", "cpu", "--viewer", "none", "--time", "0.1s"]
    result = run("play", tmp_path, "--task", str(new / "dog.py"), "--load_run", str(run_folder), *still)
    assert result.code == 0 and "task: second/machine/dog.py\n" in result.out and "model_2.pt" in result.out, result
    other = kennel(tmp_path / "third")
    for gone in (new / "dog.py", new / "robot/dog.xml"):
        gone.unlink()
    result = run("play", tmp_path, "--task", str(other), "--load_run", str(run_folder), *still)
    assert result.code == 0, result
    line = refused(tmp_path, "play", "--load_run", str(run_folder), "--device", "cpu")
    assert f"{run_folder.relative_to(tmp_path)} is of task 'dog.py', somebody's code" in line and line.endswith(
        "--task dog.py, with its folder before the name\n"
    )


def test_the_task_of_a_run_is_the_projects_or_the_users(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name in configs/, a file in the clone's examples/ whichever way it is written, or one that the user's task is or extends."""
    file, folder = kennel(tmp_path / "tasks"), tmp_path / "logs/dog/one"
    child = tmp_path / "child.py"
    child.write_text(
        "import sys\nsys.path.append('tasks')\nfrom dog import TASK as DOG, DogCfg\n\n\n"
        "class ChildCfg(DogCfg):\n    pass\n\n\nTASK = DOG._replace(cfg=ChildCfg)\n"
    )
    folder.mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    example = str(ROOT / "examples/go1_stand.py")
    link = tmp_path / "go1_stand.py"
    link.symlink_to(example)
    for stored, found in (
        ("go1_flat", "go1_flat"),
        ("examples/go1_stand.py", example),
        (example, example),
        ("go1_stand.py", example),  # the link: what it leads to is the project's
        (str(file), ""),
        ("tasks/dog.py", ""),
        ("../examples/go1_stand.py", ""),
        ("configs/none.py", ""),
    ):
        save_yaml(folder / "config.yaml", {"task": stored})
        if found:
            assert task_of(folder) == found
        else:
            with pytest.raises(ConfigError, match=re.escape(f"logs/dog/one is of task '{stored}', somebody's code")):
                task_of(folder)
    save_yaml(folder / "config.yaml", {"task": "elsewhere/dog.py"})
    for mine in (file, child):
        assert task_of(folder, load_task(str(mine))) == str(file)
    with pytest.raises(ConfigError, match="--task elsewhere/dog.py, or a task that extends its config$"):
        task_of(folder, load_task("go1_flat"))
    save_yaml(folder / "config.yaml", {"seed": 1})
    with pytest.raises(ConfigError, match=r"^logs/dog/one/config\.yaml does not say of which task it is; say --task$"):
        task_of(folder)
    line = refused(tmp_path, "play", "--device", "cpu", "--load_run", "one")
    assert "--task is missing, and --load_run is no path of a run that would say it; tasks: " in line


def test_a_run_stores_the_way_from_where_its_logs_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    task = load_task(str(kennel(tmp_path / "dogs")))
    for here, stored in (
        (tmp_path, "dogs/dog.py"),
        (tmp_path / "dogs", "dog.py"),
        (tmp_path / "dogs/robot", "../dog.py"),
        (Path("/"), "dog.py"),
    ):
        monkeypatch.chdir(here)
        assert task.to_dict()["task"] == stored
    assert load_task("go1_flat").to_dict()["task"] == "go1_flat"


def test_runs_of_before_name_absolute_files(tmp_path: Path) -> None:
    """One that is the task's own, or is of another machine, becomes the task's own; another robot that is there stays."""
    file = kennel(tmp_path / "dogs")
    other = tmp_path / "other/dog.xml"
    other.parent.mkdir()
    other.write_text(GO1.read_text())

    def loaded(stored: Path) -> str:
        task = load_task(str(file))
        saved: dict[str, Any] = task.to_dict()
        saved["asset"]["file"], saved["task"] = str(stored), "/far/away/dog.py"
        update_from_run(task, saved, "config.yaml")
        return task.cfg.asset.file

    assert loaded(file.parent / "robot/dog.xml") == loaded(Path("/far/away/dog.xml")) == "robot/dog.xml"
    assert loaded(other) == str(other) and loaded(Path("/far/away/cat.xml")) == "/far/away/cat.xml"


# ---- the robot's file


def test_the_robot_is_beside_the_class_that_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A subclass in another folder keeps its parent's file; a flag's is looked for here, beside the task, and beside its parents."""
    kennel(tmp_path / "parent")
    child = tmp_path / "child/pup.py"
    (child.parent / "robot").mkdir(parents=True)
    (child.parent / "robot/dog.xml").write_text("not this one")
    child.write_text(DOG)
    monkeypatch.syspath_prepend(str(tmp_path / "parent"))
    monkeypatch.setitem(sys.modules, "my_base", sys)  # for monkeypatch to take it away at the end
    del sys.modules["my_base"]
    task = load_task(str(child))
    assert robot_of(task) == tmp_path / "parent/robot/dog.xml"
    own = child.read_text().replace("penalize_contacts_on = []", 'file = "robot/dog.xml"')
    child.with_name("own.py").write_text(own)
    assert robot_of(load_task(str(child.with_name("own.py")))) == child.parent / "robot/dog.xml"
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    task.set("asset.file", "cat.xml")
    for folder in (tmp_path / "parent", child.parent, here):
        (folder / "cat.xml").write_text("")
        assert robot_of(task) == folder / "cat.xml"
    task.set("asset.file", "resources/robots/go1/go1.xml")
    assert robot_of(task) == GO1
    task.set("asset.file", "hen.xml")
    places = rf"{here}, {child.parent}, {tmp_path / 'parent'}, .*{ROOT}"
    with pytest.raises(UserError, match=rf"^asset\.file: no file 'hen\.xml' in {places}$"):
        robot_of(task)


def test_a_flag_finds_a_robot_beside_a_task_without_a_config_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(
        "from configs.go1_flat import TASK as THEIRS\nfrom legged_mw.utils.task import Task\n\nTASK = Task(*THEIRS)\n"
    )
    (tmp_path / "mine.xml").write_text("")
    task = load_task(str(tmp_path / "mine.py"))
    assert robot_of(task) == GO1
    task.set("asset.file", "mine.xml")
    assert robot_of(task) == tmp_path / "mine.xml"


# ---- neighbours


def test_neighbours_of_one_name_are_not_mixed_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor with a module of that name that is imported already, and which is given back, as is the path."""
    first, second = kennel(tmp_path / "a", seconds=7.0), kennel(tmp_path / "b", seconds=8.0)
    stranger = type(sys)("my_base")
    stranger.__file__ = str(tmp_path / "c/my_base.py")
    monkeypatch.setitem(sys.modules, "my_base", stranger)
    path = [*sys.path]
    tasks = [load_task(str(file)) for file in (first, second, first, second)]
    assert [task.cfg.env.episode_length_s for task in tasks] == [7.0, 8.0, 7.0, 8.0]
    assert [robot_of(task).parts[-3] for task in tasks] == ["a", "b", "a", "b"]
    assert sys.modules["my_base"] is stranger and sys.path == path
    assert type(tasks[0].cfg).__mro__[1] is type(tasks[2].cfg).__mro__[1]  # imported once


def test_a_neighbours_class_is_found_by_its_module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """rsl-rl imports what class_name says, after the task was loaded."""
    for name in ("my_nets", "my_base"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    for folder in (tmp_path / "a", tmp_path / "b"):
        file = kennel(folder)
        (folder / "my_nets.py").write_text(f"class Net:\n    folder = {folder.name!r}\n")
        file.write_text("import my_nets\n" + DOG)
        load_task(str(file))
        assert resolve_callable("my_nets:Net").folder == folder.name  # type: ignore[attr-defined]
    load_task(str(tmp_path / "a/dog.py"))
    assert resolve_callable("my_nets:Net").folder == "a"  # type: ignore[attr-defined]


def test_a_neighbour_takes_no_librarys_name(tmp_path: Path) -> None:
    """What is imported already keeps its meaning: torch is torch, and legged_mw is the one that runs."""
    kennel(tmp_path)
    for name in ("torch.py", "json.py", "legged_mw.py"):
        (tmp_path / name).write_text("raise RuntimeError('not this one')\n")
    (tmp_path / "dog.py").write_text("import json\nimport torch\nfrom torch import Tensor\n" + DOG)
    assert load_task(str(tmp_path / "dog.py")).cfg.env.episode_length_s == 7.0


def test_a_neighbour_that_fails_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "my_base", raising=False)
    (tmp_path / "my_base.py").write_text("from nowhere_at_all import thing\n")
    (tmp_path / "dog.py").write_text(DOG)
    path = [*sys.path]
    said = rf"^{tmp_path}/my_base\.py:1, called from {tmp_path}/dog\.py:5: ModuleNotFoundError: No module named 'nowhere_at_all'$"
    with pytest.raises(ConfigError, match=said):
        load_task(str(tmp_path / "dog.py"))
    assert sys.path == path and "my_base" not in sys.modules
