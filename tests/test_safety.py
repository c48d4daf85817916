"""A run folder from a stranger runs nothing: neither its class names nor its task's path choose code. A task's own file does."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from program import SMALL, refused, run, trained

from legged_mw.rl.learner_config import ALLOWED, check_classes, rsl_rl_config
from legged_mw.rl.policies import load_policy
from legged_mw.utils.config import ConfigError, load_yaml, save_yaml
from legged_mw.utils.task import load_task

TASK = ["--task", "go1_flat", "--device", "cpu"]
# Importing it leaves a file; so does every use of what it holds.
NETS = """
from pathlib import Path

from rsl_rl.models import MLPModel

Path(__file__).with_name("it_ran").touch()


class Walker(MLPModel):
    pass
"""
CLASSES = {  # what a stranger may write -> where
    "logs.go1_flat.some_run.nets:Walker": "actor.class_name",
    "logs.go1_flat.some_run.nets.Walker": "critic.class_name",
    "os:system": "algorithm.class_name",
    "nets:Walker": "actor.distribution_cfg.class_name",
    "os.system": "actor.class_name",
    "subprocess:run": "actor.distribution_cfg.class_name",
    "PPO": "actor.class_name",  # of another kind
    "rsl_rl.models.mlp_model:torch.load": "actor.class_name",
    "rsl_rl.models.mlp_model:MLPModel.load_state_dict": "actor.class_name",
    "legged_mw.utils.config:load_yaml": "algorithm.class_name",
    "legged_mw.nets:Walker": "actor.class_name",
}


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return trained(tmp_path_factory.mktemp("safety"), "--max_iterations", "1")


@pytest.fixture
def home(trained_once: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with a run, logs/go1_flat/some_run, that holds code; all of it could be imported from here."""
    folder = tmp_path / "logs/go1_flat/some_run"
    shutil.copytree(trained_once, folder)
    for package in (tmp_path / "logs", tmp_path / "logs/go1_flat", folder):
        (package / "__init__.py").write_text("")
    for place in (folder, tmp_path):
        (place / "nets.py").write_text(NETS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in [name for name in sys.modules if name.partition(".")[0] in ("logs", "nets")]:
        del sys.modules[name]


def nothing_ran(home: Path) -> bool:
    return not list(home.rglob("it_ran")) and not any(
        name.partition(".")[0] in ("logs", "nets") for name in sys.modules
    )


def poison(home: Path, path: str, value: str) -> Path:
    """Write ``value`` into the run's config.yaml."""
    file = home / "logs/go1_flat/some_run/config.yaml"
    config = load_yaml(file)
    *sections, name = path.split(".")
    node = config
    for section in sections:
        node = node.setdefault(section, {})
    node[name] = value
    save_yaml(file, config)
    return file


def test_the_stranger_could_run_code_otherwise(home: Path) -> None:
    """The trap works: whoever resolves the name as rsl-rl does leaves the mark."""
    from rsl_rl.utils import resolve_callable

    resolve_callable("logs.go1_flat.some_run.nets:Walker")
    assert not nothing_ran(home)


@pytest.mark.parametrize("name", CLASSES)
def test_no_class_of_a_run_is_imported(home: Path, name: str) -> None:
    path = CLASSES[name]
    poison(home, path, name)
    for program, more in (
        ("play", ["--load_run", "some_run", "--viewer", "none"]),
        ("play", ["--load_run", "some_run", "--export", str(home / "out")]),
        ("play", ["--load_run", "some_run", "--eval"]),
        ("train", ["--resume", "--load_run", "some_run", "--max_iterations", "2"]),
    ):
        line = refused(home, program, *TASK, *more)
        assert f"{path} is '{name}': only the task's own Python file, which --task names, may choose that; " in line
        assert "a run's config.yaml, --set and --override may name " in line
        assert nothing_ran(home)


def test_no_class_of_a_compared_run_is_imported(home: Path, trained_once: Path) -> None:
    shutil.copytree(trained_once, home / "logs/go1_flat/mine")
    poison(home, "actor.class_name", "logs.go1_flat.some_run.nets:Walker")
    line = refused(home, "play", *TASK, "--load_run", "mine", "--eval", "--compare", "some_run")
    assert (
        "actor.class_name is 'logs.go1_flat.some_run.nets:Walker': only the task's own Python file" in line
        and nothing_ran(home)
    )


@pytest.mark.parametrize("name", CLASSES)
def test_no_class_of_a_flag_or_an_override_file_is_imported(home: Path, name: str) -> None:
    path = CLASSES[name]
    file, node = home / "mine.yaml", name
    for key in reversed(path.split(".")):
        node = {key: node}
    save_yaml(file, node)
    for flags in (["--set", f"{path}={name}"], ["--override", str(file)]):
        for program, more in (
            ("play", ["--load_run", "some_run", "--viewer", "none", "--time", "0.02s"]),
            ("train", []),
        ):
            assert f"{path} is '{name}': only the task's own Python file" in refused(
                home, program, *TASK, *more, *flags
            )
            assert nothing_ran(home)


def test_a_cpus_overrides_choose_no_class_either(home: Path) -> None:
    name = "logs.go1_flat.some_run.nets:Walker"
    line = refused(home, "train", *TASK, "--set", f"cpu.overrides={{actor.class_name: '{name}'}}")
    assert f"actor.class_name is '{name}': only the task's own Python file" in line and nothing_ran(home)


def test_the_lowest_layer_refuses_too(home: Path) -> None:
    """What benchmarks and notebooks call."""
    task = load_task("go1_flat")
    task.train.actor.class_name = "logs.go1_flat.some_run.nets:Walker"
    for use in (lambda: rsl_rl_config(task.train), lambda: load_policy(home / "none.pt", None, task.train, "cpu")):  # type: ignore[arg-type]
        with pytest.raises(ConfigError, match="only the task's own Python file"):
            use()
    assert nothing_ran(home)


def test_the_path_in_a_run_is_not_imported(home: Path) -> None:
    """A file of the task's name beside the run; --task wins."""
    evil = home / "logs/go1_flat/some_run/go1_flat.py"
    evil.write_text(NETS)
    poison(home, "task", str(evil))
    result = run("play", home, *TASK, "--load_run", "some_run", "--export", str(home / "out"))
    assert result.code == 0 and (home / "out/policy.onnx").is_file(), result.err
    result = run("train", home, *TASK, "--resume", "--load_run", "some_run", "--max_iterations", "2")
    assert result.code == 0, result.err
    assert nothing_ran(home) and load_yaml(home / "logs/go1_flat/some_run/config.yaml")["task"] == "go1_flat"


def test_every_allowed_class_is_one_that_rsl_rl_finds_under_that_name() -> None:
    from rsl_rl.utils import resolve_callable

    from legged_mw.rl.learner_config import spellings

    for path, kinds in ALLOWED.items():
        for kind in kinds:
            for name in spellings(kind):
                assert resolve_callable(name) is resolve_callable(kind)
                task = load_task("go1_flat")
                if not path.startswith("critic.distribution"):  # a section that the critic has not
                    task.set(path, name)
                    check_classes(task.train)


def test_a_class_of_the_right_kind_may_be_chosen(tmp_path: Path) -> None:
    """By a flag, and then by the run's own config.yaml."""
    result = run(
        "train", tmp_path, *SMALL, "--max_iterations", "1", "--set", "algorithm.class_name=rsl_rl.algorithms:PPO"
    )
    assert result.code == 0, result.err
    result = run("train", tmp_path, *TASK, "--resume", "--max_iterations", "2")
    assert result.code == 0 and "Learning iteration 2/2" in result.out, result.err
    [config] = tmp_path.glob("logs/go1_flat/*/config.yaml")
    assert load_yaml(config)["algorithm"]["class_name"] == "rsl_rl.algorithms:PPO"


OWN = '''"""A task with a network of its own."""

from rsl_rl.models import MLPModel

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Walker(MLPModel):
    """As rsl-rl's."""


class OwnCfgPPO(Go1FlatCfgPPO):
    class actor(Go1FlatCfgPPO.actor):
        class_name = f"{__name__}:Walker"

    class algorithm(Go1FlatCfgPPO.algorithm):
        extra: list[str] = []


TASK = Task(LeggedRobot, Go1FlatCfg, OwnCfgPPO)
'''


def test_a_network_of_the_tasks_own_file_trains_resumes_and_plays(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(OWN.replace("        extra: list[str] = []\n", "        pass\n"))
    task = ["--task", str(tmp_path / "own.py"), *SMALL[2:]]
    result = run("train", tmp_path, *task, "--max_iterations", "1")
    assert result.code == 0 and "a network is a Walker" in result.out, result.err
    [folder] = (tmp_path / "logs/own").iterdir()
    assert load_yaml(folder / "config.yaml")["actor"]["class_name"] == "legged_mw_task_own:Walker"
    result = run("train", tmp_path, *task[:2], "--device", "cpu", "--resume", "--max_iterations", "2")
    assert result.code == 0 and "a network is a Walker" in result.out and "iteration 2/2" in result.out, result.err
    result = run("play", tmp_path, *task[:2], "--device", "cpu", "--viewer", "none", "--time", "0.1s")
    assert result.code == 0, result.err


def test_a_class_deep_in_a_learners_config_is_checked_too(tmp_path: Path) -> None:
    """Whatever holds it: rsl-rl resolves names in nested dicts as well."""
    source = OWN.replace("extra: list[str] = []", "symmetry_cfg: dict[str, Any] = {}").replace(
        "from rsl_rl", "from typing import Any\n\nfrom rsl_rl", 1
    )
    (tmp_path / "own.py").write_text(source)
    task = load_task(str(tmp_path / "own.py"))
    check_classes(task.train)
    task.set("algorithm.symmetry_cfg", {"data_augmentation_func": "os:system"})
    with pytest.raises(
        ConfigError,
        match="algorithm.symmetry_cfg.data_augmentation_func is 'os:system': .* may name nothing else there",
    ):
        check_classes(task.train)
    task.set("algorithm.symmetry_cfg", {"many": [{"class_name": "os:system"}]})
    with pytest.raises(ConfigError, match=r"algorithm.symmetry_cfg.many.0.class_name is 'os:system'"):
        check_classes(task.train)
