"""Class-based configuration: what a class may declare and what its instances accept; tests/golden/config_classes.py has what errors say."""

import copy
import importlib
import importlib.util
import math
import os
import pickle
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, Optional

import pytest
import yaml
from rsl_rl.utils import resolve_callable

from legged_mw import ROOT
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.rl.learner_config import check_classes, fit_cpu
from legged_mw.rl.run_folder import update_from_run
from legged_mw.rl.students.distillation import GraphedDistillation
from legged_mw.utils.config import Config, ConfigError, load_yaml, save_yaml
from legged_mw.utils.task import LoadedTask, Task, load_task


class Base(Config):
    seed: int = 1

    class env:
        num_envs: int = 4096
        episode_length_s: float = 20  # an int where a float is due
        run_name: str = ""
        is_flat: bool = True
        note: str | None = None

    class control:
        control_type: Literal["P", "V", "T"] = "P"
        stiffness: dict[str, float] = {"hip": 20, "calf": 40.0}
        limits: int | list[float] = 3
        anything: Any = None

    class commands:
        heading: bool = False

        class ranges:
            lin_vel_x: list[float] = [-1.0, 1.0]
            path: list[int] = (1, 2, 3)  # type: ignore[assignment]  (a tuple becomes a list)

    class rewards:
        tracking_sigma: float = 0.25

        class scales:
            _open = True
            torques: float = -2e-4
            termination: float = 0.0

        def total(self) -> float:
            return self.scales.torques + self.scales.termination  # type: ignore[attr-defined]


class Go1(Base):
    class env(Base.env):
        num_envs = 8192

    class rewards(Base.rewards):
        class scales(Base.rewards.scales):
            lin_vel_z = -2


def says(*parts: str) -> Any:
    """Expects a ConfigError whose text has all `parts`, in this order."""
    return pytest.raises(ConfigError, match="(?s)" + ".*".join(re.escape(part) for part in parts))


def load_module(tmp_path: Path, source: str, name: str) -> Any:
    path = tmp_path / f"{name}.py"
    path.write_text(source)
    spec = importlib.util.spec_from_file_location(name, path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        spec.loader.exec_module(module)
    finally:
        del sys.modules[name]
    return module


# ---- Class statements that are right --------------------------------------------------------------------------------


def test_overrides_and_inherited_sections() -> None:
    cfg = Go1()
    assert cfg.env.num_envs == 8192
    assert cfg.env.episode_length_s == 20.0
    assert cfg.commands.ranges.lin_vel_x == [-1.0, 1.0]
    assert Base().env.num_envs == 4096
    assert isinstance(cfg.env, Go1.env)
    assert isinstance(cfg.env, Base.env)
    assert isinstance(cfg.commands, Base.commands)


def test_values_take_the_declared_type() -> None:
    cfg = Go1()
    assert type(cfg.env.episode_length_s) is float
    assert type(cfg.control.stiffness["hip"]) is float
    assert type(cfg.rewards.scales.lin_vel_z) is float
    assert type(cfg.control.limits) is int
    assert type(Base.env.episode_length_s) is float


def test_union_keeps_the_type_of_the_value() -> None:
    class Either(Config):
        first: float | int = 3
        second: int | float = 3
        third: int | float = 3.0

    assert [type(value) for value in Either().to_dict().values()] == [int, int, float]


def test_open_section_keeps_its_methods() -> None:
    class Methods(Config):
        class scales:
            _open = True

            def total(self) -> float:
                return 0.0

    with pytest.raises(ConfigError):
        Methods().set("scales.total", 1)


def test_an_open_section_may_start_empty() -> None:
    class Empty(Go1):
        class rewards(Go1.rewards):
            class scales(Go1.rewards.scales):
                _only = True
                torques = -1
                fresh = 2

    class Child(Empty):
        class rewards(Empty.rewards):
            class scales(Empty.rewards.scales):
                termination = -3

    assert Empty().to_dict()["rewards"]["scales"] == {
        "torques": -1.0,
        "termination": 0.0,
        "lin_vel_z": 0.0,
        "fresh": 2.0,
    }
    assert Child().to_dict()["rewards"]["scales"] == {
        "torques": -1.0,
        "termination": -3.0,
        "lin_vel_z": 0.0,
        "fresh": 2.0,
    }
    assert Go1().to_dict()["rewards"]["scales"] == {"torques": -2e-4, "termination": 0.0, "lin_vel_z": -2.0}
    cfg = Empty()
    cfg.set("rewards.scales.lin_vel_z", "-4")
    assert cfg.to_dict()["rewards"]["scales"]["lin_vel_z"] == -4.0


def test_same_declaration_again_is_fine() -> None:
    class Again(Base):
        class env(Base.env):
            num_envs: int = 2
            note: Optional[str] = "x"  # noqa: UP045

    assert Again().env.num_envs == 2
    assert Again().env.note == "x"


def test_new_fields_and_sections_in_a_subclass() -> None:
    class More(Go1):
        class env(Go1.env):
            extra: int = 3

        class terrain:
            kind: str = "flat"

    assert More().env.extra == 3
    assert More().terrain.kind == "flat"
    assert list(More().to_dict()) == ["seed", "env", "control", "commands", "rewards", "terrain"]
    assert list(More().to_dict()["env"])[-1] == "extra"


def test_two_parents() -> None:
    class Wide(Base):
        class env(Base.env):
            run_name = "wide"

    class Both(Go1, Wide):
        class env(Go1.env, Wide.env):
            pass

    assert (Both().env.num_envs, Both().env.run_name) == (8192, "wide")

    class Neither(Go1, Wide):
        pass

    assert Neither().to_dict() == Both().to_dict()
    with pytest.raises(ConfigError):

        class OneAlone(Go1, Wide):
            class env(Go1.env):
                pass


def test_of_two_parents_only_what_changes_a_section_is_asked_for(tmp_path: Path) -> None:
    """Python refuses a class whose first parent is extended by its second, and one with the same parent twice."""

    class Plain(Base):
        pass

    class Wide(Base):
        class env(Base.env):
            run_name = "wide"

    with pytest.raises(ConfigError, match=r"`class env\([\w.]*Wide\.env\):`"):

        class Wrong(Plain, Wide):
            class env(Base.env):
                pass

    with pytest.raises(ConfigError, match=r"`class control\([\w.]*Plain\.control\):`"):

        class NotAField(Plain, Wide):
            control = 1  # pyright: ignore[reportAssignmentType]

    for parents in ("Plain.env, Wide.env", "Plain.env, LeggedRobotCfg.env"):
        file = tmp_path / "own.py"
        file.write_text(
            "from legged_mw.envs.legged_robot_config import LeggedRobotCfg\n"
            "class Plain(LeggedRobotCfg):\n    pass\n"
            "class Wide(LeggedRobotCfg):\n    class env(LeggedRobotCfg.env):\n        num_envs = 8\n"
            f"class Both(Plain, Wide):\n    class env({parents}):\n        num_envs = 9\n"
        )
        with pytest.raises(ConfigError) as refused:
            load_task(str(file))
        assert "own.py:8" in str(refused.value) and "TASK" not in str(refused.value)


def test_sections_of_two_parents_are_joined_at_any_depth() -> None:
    class Robot(Base):
        class control(Base.control):
            stiffness = {"": 20.0}

        class rewards(Base.rewards):
            class scales(Base.rewards.scales):
                torques = -0.5

    class Skill(Base):
        class control(Base.control):
            stiffness = {"": 1.0}
            control_type = "T"

        class rewards(Base.rewards):
            class scales(Base.rewards.scales):
                termination = -7.0
                alive = 1.0

    class Task(Robot, Skill):
        pass

    class Own(Robot, Skill):
        class control(Robot.control, Skill.control):
            stiffness = {"": 3.0}

    cfg, scales = Task(), Task().to_dict()["rewards"]["scales"]
    assert (cfg.control.stiffness, cfg.control.control_type) == ({"": 20.0}, "T")  # the first parent's word is the last
    assert scales == {"torques": -0.5, "termination": -7.0, "alive": 1.0}
    assert (Own().control.stiffness, Own().control.control_type) == ({"": 3.0}, "T")
    assert list(cfg.to_dict()["control"]) == list(Base().to_dict()["control"])
    with pytest.raises(ConfigError):
        cfg.control.stifness = {}  # type: ignore[attr-defined]


def test_methods_and_private_names_are_not_fields() -> None:
    class Quiet(Base):
        _secret = 3

        class env(Base.env):
            _hidden = {1, 2}

            @property
            def twice(self) -> int:
                return 2 * self.num_envs

            @staticmethod
            def three() -> int:
                return 3

    assert Quiet().env.twice == 8192
    assert Quiet().env.three() == 3
    rewards: Any = Go1().rewards
    assert rewards.total() == pytest.approx(-2e-4)
    assert Quiet().to_dict() == Base().to_dict()
    cfg = Quiet()
    cfg.env._mark = 1  # type: ignore[attr-defined]
    assert cfg.to_dict() == Base().to_dict()


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("env.num_envs", 3.0),
        ("env.num_envs", True),
        ("env.episode_length_s", True),
        ("env.is_flat", 1),
        ("env.run_name", None),
        ("env.note", 3),
        ("control.control_type", "v"),
        ("control.stiffness", {"hip": None}),
        ("control.stiffness", {3: 1.0}),
        ("control.stiffness", 35),
        ("control.stiffness", [1.0]),
        ("control.limits", 0.5),
        ("control.anything", {1, 2}),
        ("commands.ranges.lin_vel_x", [0.0, "1"]),
        ("commands.ranges.path", [1, 2.5]),
        ("rewards.scales.torques", "big"),
        ("rewards.scales.brand_new", True),
        ("rewards.scales.brand_new", "1"),
        ("rewards.scales.brand_new", None),
    ],
)
def test_wrong_type_of_value(path: str, value: Any) -> None:
    """In the class statement, in an update, in an assignment."""
    *sections, name = path.split(".")
    bodies: list[Any] = [Base]
    for section in sections:
        bodies.append(getattr(bodies[-1], section))
    body: dict[str, Any] = {name: value}
    qualname = f"Bad.{path}"
    for parent in reversed(bodies[1:]):
        qualname = qualname.rpartition(".")[0]
        body = {parent.__name__: type(parent.__name__, (parent,), {**body, "__qualname__": qualname})}
    with says(f"Bad.{path}"):
        type("Bad", (Base,), body)
    section_path = ".".join(sections)
    with says(f"a.yaml: {path}"):
        Base().update(nest(path, value), "a.yaml")
    node: Any = Base()
    for section in sections:
        node = getattr(node, section)
    with says(f"Base.{section_path}.{name}"):
        setattr(node, name, value)


def nest(path: str, value: Any) -> Any:
    for name in reversed(path.split(".")):
        value = {name: value}
    return value


# ---- String annotations ---------------------------------------------------------------------------------------------

PARENT = """from __future__ import annotations
from typing import Literal
from legged_mw.utils.config import Config

class Cfg(Config):
    class env:
        num_envs: int = 1
        mode: Literal["a", "b"] | float = 0.0
        int: list[float] = [1]
"""


def test_string_annotations(tmp_path: Path) -> None:
    parent = load_module(tmp_path, PARENT, "cfg_parent")

    class Child(parent.Cfg):
        class env(parent.Cfg.env):
            mode = "b"
            num_envs: int = 2

    assert Child().to_dict() == {"env": {"num_envs": 2, "mode": "b", "int": [1.0]}}
    with says("env.mode"):
        Child().set("env.mode", "c")


@pytest.mark.parametrize("annotation", ["Tensor", "list[Tensor]", "list['Tensor']", "math.nope", "int |"])
def test_unresolvable_annotation(tmp_path: Path, annotation: str) -> None:
    source = PARENT + f"        third: {annotation!r} = 3\n"
    with says("cfg_bad.py:10: Cfg.env.third: "):
        load_module(tmp_path, "import math\n" + source.replace("from __future__ import annotations\n", ""), "cfg_bad")


def test_error_names_file_and_line(tmp_path: Path) -> None:
    source = PARENT + "\nclass Go1(Cfg):\n    class env(Cfg.env):\n        '''Doc.'''\n        num_env = 3\n"
    with says(f"{tmp_path / 'cfg_line.py'}:14: Go1.env.num_env"):
        load_module(tmp_path, source, "cfg_line")


def test_error_without_source_names_the_module() -> None:
    code = "from legged_mw.utils.config import Config\nclass A(Config):\n    x = 1\n"
    with says("module prompt: A.x"):
        exec(code, {"__name__": "prompt"})


# ---- Instances ------------------------------------------------------------------------------------------------------


def test_instances_share_nothing() -> None:
    one, two = Go1(), Go1()
    one.commands.ranges.lin_vel_x[0] = -9.0
    one.control.stiffness["hip"] = 9.0
    one.env.num_envs = 9
    assert two.to_dict() == Go1().to_dict()
    assert Go1.commands.ranges.lin_vel_x == [-1.0, 1.0]
    assert Base.control.stiffness == {"hip": 20.0, "calf": 40.0}
    assert Go1.env.num_envs == 8192


def test_a_default_is_not_the_list_it_was_written_with() -> None:
    shared = [1.0, 2.0]

    class Shares(Config):
        x: list[float] = shared

    shared.append(3.0)
    assert Shares().x == [1.0, 2.0]


def test_assignment_is_checked() -> None:
    cfg = Go1()
    with pytest.raises(ConfigError):
        cfg.env.num_env = 3  # type: ignore[attr-defined]
    with pytest.raises(ConfigError):
        cfg.commands.ranges.path2 = 3  # type: ignore[attr-defined]
    with pytest.raises(ConfigError):
        cfg.env = 3  # type: ignore[assignment]
    with pytest.raises(ConfigError):
        cfg.sede = 3  # type: ignore[attr-defined]
    assert cfg.to_dict() == Go1().to_dict()
    cfg.env.episode_length_s = 3
    assert type(cfg.env.episode_length_s) is float
    cfg.rewards.scales.brand_new = 1  # type: ignore[attr-defined]
    assert cfg.to_dict()["rewards"]["scales"]["brand_new"] == 1.0


def test_assigned_lists_are_copied() -> None:
    cfg, mine = Base(), [0.0, 1.0]
    cfg.commands.ranges.lin_vel_x = mine
    mine[0] = 5.0
    assert cfg.commands.ranges.lin_vel_x == [0.0, 1.0]


def test_deepcopy_and_pickle() -> None:
    cfg = Go1()
    cfg.env.num_envs = 3
    twins: list[Any] = [copy.deepcopy(cfg), pickle.loads(pickle.dumps(cfg))]
    for twin in twins:
        assert twin.to_dict() == cfg.to_dict()
        twin.env.num_envs = 4
        with pytest.raises(ConfigError):
            twin.env.num_env = 4
        assert isinstance(twin.env, Go1.env)
    assert cfg.env.num_envs == 3


def test_to_dict_is_plain_and_in_order() -> None:
    plain = Go1().to_dict()
    assert list(plain) == ["seed", "env", "control", "commands", "rewards"]
    assert list(plain["env"]) == ["num_envs", "episode_length_s", "run_name", "is_flat", "note"]
    assert list(plain["rewards"]["scales"]) == ["torques", "termination", "lin_vel_z"]
    assert plain["commands"]["ranges"] == {"lin_vel_x": [-1.0, 1.0], "path": [1, 2, 3]}
    assert type(plain["commands"]["ranges"]["path"]) is list
    assert yaml.safe_load(yaml.safe_dump(plain)) == plain
    plain["commands"]["ranges"]["lin_vel_x"][0] = 7.0
    assert Go1().commands.ranges.lin_vel_x[0] == -1.0


def test_numpy_numbers_become_plain() -> None:
    np = pytest.importorskip("numpy")
    cfg = Base()
    cfg.env.num_envs = np.int64(3)
    cfg.env.episode_length_s = np.float32(0.5)
    assert (type(cfg.env.num_envs), type(cfg.env.episode_length_s)) == (int, float)


# ---- set ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("path", "text", "expected"),
    [
        ("seed", "7", 7),
        ("env.num_envs", "1_024", 1024),
        ("rewards.scales.torques", "1e-4", 1e-4),
        ("rewards.scales.torques", "-1E-4", -1e-4),
        ("rewards.scales.torques", "3", 3.0),
        ("rewards.scales.torques", ".5e1", 5.0),
        ("rewards.scales.feet_slip", "-1e-2", -0.01),
        ("env.is_flat", "false", False),
        ("env.run_name", "1e-4", "1e-4"),
        ("env.run_name", "null", "null"),
        ("env.run_name", "[a: b", "[a: b"),
        ("env.note", "null", None),
        ("env.note", "3", "3"),
        ("env.note", "a: {b", "a: {b"),
        ("control.control_type", "T", "T"),
        ("control.limits", "[1e-4, 2]", [1e-4, 2.0]),
        ("control.limits", "5", 5),
        ("control.stiffness", "{knee: 1e1, hip: 2}", {"knee": 10.0, "hip": 2.0}),
        # which to YAML is a key 'knee:1e1' without a value
        ("control.stiffness", "{knee:1e1,hip: 2}", {"knee": 10.0, "hip": 2.0}),
        ("control.stiffness", "{hip:2}", {"hip": 2.0}),  # in place of the default, not beside it
        ("control.anything", "{a: [1, 1e-4, x]}", {"a": [1, 1e-4, "x"]}),
        ("commands.ranges.lin_vel_x", "[-1, 1e-1]", [-1.0, 0.1]),
        ("commands.ranges.path", "[1, 2]", [1, 2]),
        ("env.num_envs", 3, 3),
    ],
)
def test_set(path: str, text: Any, expected: Any) -> None:
    cfg, before = Base(), Base()
    cfg.env.note = before.env.note = "before"
    cfg.set(path, text)
    value: Any = cfg
    for name in path.split("."):
        value = getattr(value, name)
    assert value == expected
    assert type(value) is type(expected)
    assert [changed for changed, _, _ in cfg.diff(before)] == [path]


@pytest.mark.parametrize(
    ("path", "value"), [("env.num_envs", "many"), ("env.num_env", "3"), ("rewards.scales.a-b", "0")]
)
def test_what_set_refuses_changes_nothing(path: str, value: str) -> None:
    """tests/golden/config_classes.py has what it says of each mistake."""
    cfg = Base()
    with says("elsewhere: "):
        cfg.set(path, value, where="elsewhere")
    assert cfg.diff(Base()) == []


# ---- update and diff ------------------------------------------------------------------------------------------------


def test_update() -> None:
    cfg = Go1()
    values = {"seed": 3, "rewards": {"scales": {"torques": -1, "fresh": 2}}, "control": {"stiffness": {"knee": 1}}}
    cfg.update(values, "go1.yaml")
    assert cfg.seed == 3
    assert cfg.control.stiffness == {"knee": 1.0}
    assert cfg.rewards.scales.torques == -1.0
    assert cfg.to_dict()["rewards"]["scales"] == {"torques": -1.0, "termination": 0.0, "lin_vel_z": -2.0, "fresh": 2.0}
    values["control"]["stiffness"]["knee"] = 5  # type: ignore[index]
    assert cfg.control.stiffness == {"knee": 1.0}


@pytest.mark.parametrize(
    "wrong",
    [
        {"env": {"num_env": 3}},
        {"rewords": {}},
        {"rewards": 3},
        {"rewards": {"scales": None}},
        {"env": {"num_envs": "3"}},
        {"env": {"num_envs": {"a": 1}}},
        {"env": {3: 1}},
        {"rewards": {"scales": {True: 1}}},
        [1],
    ],
)
def test_update_is_all_or_nothing(wrong: Any) -> None:
    cfg = Base()
    values = (
        {"seed": 99, "env": {"episode_length_s": 1.0, **wrong.pop("env", {})}, **wrong}
        if isinstance(wrong, dict)
        else wrong
    )
    with says("over.yaml: "):
        cfg.update(values, "over.yaml")
    assert cfg.diff(Base()) == []


def test_dict_survives_update() -> None:
    cfg = Go1()
    cfg.set("env.note", "x")
    cfg.set("rewards.scales.fresh", 1)
    twin = Go1()
    twin.update(cfg.to_dict())
    assert twin.to_dict() == cfg.to_dict()
    assert twin.commands.ranges.path == [1, 2, 3]


def test_diff() -> None:
    mine, theirs = Go1(), Base()
    theirs.env.note = "x"
    theirs.control.stiffness = {"hip": 1.0}
    assert mine.diff(theirs) == [
        ("env.num_envs", 8192, 4096),
        ("env.note", None, "x"),
        ("control.stiffness", {"hip": 20.0, "calf": 40.0}, {"hip": 1.0}),
        ("rewards.scales.lin_vel_z", -2.0, None),
    ]
    assert mine.diff(Go1()) == []
    assert theirs.diff(mine)[-1] == ("rewards.scales.lin_vel_z", None, -2.0)


# ---- YAML -----------------------------------------------------------------------------------------------------------


def test_yaml_round_trip(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    mapping = {
        "z": {"lr": 1e-4, "tiny": 1e-12, "big": 1e22, "one": 1.0, "int": 1, "inf": math.inf},
        "a": [1e-4, None, True],
        "names": ["1e-4", "1e5", "123e456", "null", "yes", "0x1f", "ä: b", "2024-01-01"],
        "empty": {"list": [], "dict": {}, "str": ""},
    }
    save_yaml(path, mapping)
    for loaded in (load_yaml(path), yaml.safe_load(path.read_text(encoding="utf-8"))):
        assert loaded == mapping
        assert list(loaded) == list(mapping)
        assert all(type(loaded["z"][key]) is type(value) for key, value in mapping["z"].items())
    assert os.listdir(tmp_path) == ["config.yaml"]


def test_config_round_trip(tmp_path: Path) -> None:
    cfg = Go1()
    cfg.set("env.run_name", "1e4")
    cfg.set("rewards.scales.torques", "1e-7")
    save_yaml(tmp_path / "config.yaml", cfg.to_dict())
    twin = Go1()
    twin.update(load_yaml(tmp_path / "config.yaml"), "config.yaml")
    assert twin.diff(cfg) == []
    assert "rewards" in (tmp_path / "config.yaml").read_text()


def test_numbers_as_people_write_them(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("a: 1e-4\nb: [-2E3, .5e+1, '1e-4', 1e, e5, 3]\n")
    assert load_yaml(tmp_path / "a.yaml") == {"a": 1e-4, "b": [-2000.0, 5.0, "1e-4", "1e", "e5", 3]}


def test_repeated_lists_are_written_out(tmp_path: Path) -> None:
    shared = [1.0]
    save_yaml(tmp_path / "a.yaml", {"x": shared, "y": shared})
    assert "&" not in (tmp_path / "a.yaml").read_text()


def test_save_replaces_whole_files_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "config.yaml"
    save_yaml(path, {"a": 1})
    with pytest.raises(yaml.YAMLError):
        save_yaml(path, {"a": 2, "b": object()})
    assert load_yaml(path) == {"a": 1}

    def fail(*_: Any) -> None:
        raise OSError("disk full")

    monkeypatch.setattr(os, "replace", fail)
    with pytest.raises(OSError, match="disk full"):
        save_yaml(path, {"a": 2})
    assert load_yaml(path) == {"a": 1}
    assert os.listdir(tmp_path) == ["config.yaml"]


def test_a_run_older_than_a_section_keeps_what_was_so_then() -> None:
    """Not what the task says today: a resumed run must not change its learner on the way."""
    task = load_task("go1_flat")
    saved = task.to_dict()
    del saved["symmetry"], saved["anneal"]
    assert task.train.symmetry.use_data_augmentation and task.train.anneal.desired_kl
    assert update_from_run(task, saved, where="config.yaml") == ["anneal", "symmetry"]
    assert not task.train.symmetry.use_data_augmentation and task.train.anneal.desired_kl == 0.0
    assert update_from_run(load_task("go1_flat"), load_task("go1_flat").to_dict(), where="config.yaml") == []


@pytest.mark.parametrize(("name", "section"), [("go1_rough", "gait"), ("go2_rough", "observations")])
def test_a_run_older_than_what_its_policy_could_read_reads_it_not(name: str, section: str) -> None:
    """A clock or frames that the task got since would change the size of the network's input."""
    task, saved = load_task(name), load_task(name).to_dict()
    del saved[section]
    task.set("rewards.scales.contact_phase", 0.0)
    update_from_run(task, saved, where="config.yaml")
    assert task.to_dict()[section] == LeggedRobotCfg().to_dict()[section] != load_task(name).to_dict()[section]


# ---- names of former releases


def test_an_old_runs_config_loads_under_the_new_names() -> None:
    """The sections of a config.yaml as commit 1576520 wrote it."""
    task = load_task("go1_flat")
    saved = task.to_dict()
    saved["cpu"] = {**saved["cpu"], "keep_probability": [0.1, 0.2, 0.3], "kick_curriculum": False}
    del saved["cpu"]["overrides"]
    saved["perturbation"]["enable"] = not saved["perturbation"].pop("kick")
    before = copy.deepcopy(saved)
    assert update_from_run(task, saved, where="config.yaml") == []
    assert task.train.cpu.overrides == {"commands.keep_probability": [0.1, 0.2, 0.3], "perturbation.curriculum": False}
    assert task.cfg.perturbation.kick == saved["perturbation"]["enable"] != load_task("go1_flat").cfg.perturbation.kick
    assert saved == before  # the caller's own


def test_every_shipped_policys_config_loads() -> None:
    """They are older than some fields; what they say of the fields that they have is kept."""
    for folder in sorted((ROOT / "resources/policies").iterdir()):
        task, saved = load_task(folder.name), load_yaml(folder / "config.yaml")
        update_from_run(task, saved, where="config.yaml")
        now = task.to_dict()["rewards"]
        assert now == {**now, **saved["rewards"], "scales": {**now["scales"], **saved["rewards"]["scales"]}}
        check_classes(task.train)


@pytest.mark.parametrize(
    "old", ["legged_mw.rl.distillation:GraphedDistillation", "legged_mw.rl.distillation.GraphedDistillation"]
)
def test_a_class_of_an_old_run_is_found_where_it_moved_to(old: str) -> None:
    task = load_task("go1_flat")
    saved = task.to_dict()
    saved["distillation"]["class_name"] = old
    update_from_run(task, saved, where="config.yaml")
    assert task.train.distillation.class_name == old.replace("rl.dist", "rl.students.dist")
    check_classes(task.train)
    assert resolve_callable(task.train.distillation.class_name) is GraphedDistillation


def test_a_wrong_section_of_an_old_run_is_named() -> None:
    saved = {**load_task("go1_flat").to_dict(), "cpu": {"kick_curriculum": False, "overrides": 3}}
    with says("config.yaml: cpu.overrides"):
        update_from_run(load_task("go1_flat"), saved, where="config.yaml")


# ---- what a CPU takes instead


def test_a_cpus_overrides_name_fields_of_either_config() -> None:
    task = load_task("go1_flat")
    task.train.cpu.overrides = {
        "commands.resampling_time": 3,
        "algorithm.gamma": 0.5,
        "terrain.mesh_type": "heightfield",
    }
    fit_cpu(task, cores=1)
    assert task.cfg.commands.resampling_time == 3.0 and task.train.algorithm.gamma == 0.5
    assert task.cfg.terrain.mesh_type == "heightfield" and task.cfg.commands.keep_probability == [0.9, 0.25, 0.5]


@pytest.mark.parametrize(
    "name", ["go1_flat_dr", "go1_flat_fast", "go1_rough", "examples/go1_playground.py", "examples/go1_mjlab.py"]
)
def test_on_a_cpu_rewards_stay_those_of_a_task_that_subclasses_another(name: str) -> None:
    task, first = load_task(name), load_task("go1_flat")
    rewards = (task.cfg.to_dict()["rewards"], first.cfg.to_dict()["rewards"])
    fit_cpu(task, cores=1)
    fit_cpu(first, cores=1)
    assert task.cfg.to_dict()["rewards"] == rewards[0] and first.cfg.to_dict()["rewards"] != rewards[1]


# ---- the name `configs`

FAST = """from configs.go1_flat import {base}
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.rl.learner_config import LeggedRobotCfgPPO
from legged_mw.utils.task import Task


class FastCfg({base}):
    class env({base}.env):
        num_envs = 7


TASK = Task(LeggedRobot, FastCfg, LeggedRobotCfgPPO)
"""


@pytest.fixture
def no_configs() -> Iterator[None]:
    """As for an installed package: nothing on the path has the name."""
    with pytest.MonkeyPatch.context() as patch:
        for name in [name for name in sys.modules if name.partition(".")[0] == "configs"]:
            patch.delitem(sys.modules, name)
        patch.setattr(sys, "path", [place for place in sys.path if not (Path(place) / "configs").is_dir()])
        patch.chdir("/")
        importlib.invalidate_caches()
        yield
    importlib.invalidate_caches()  # the way to the package `tests` is known again


def test_a_task_finds_configs_where_nothing_else_has_them(no_configs: None, tmp_path: Path) -> None:
    (tmp_path / "fast.py").write_text(FAST.format(base="Go1FlatCfg"))
    task = load_task(str(tmp_path / "fast.py"))
    assert task.cfg.env.num_envs == 7 and task.cfg.asset.imu_site == "imu"
    assert load_task("go1_flat_dr").cfg.domain_rand.enable
    assert isinstance(task.cfg, load_task("go1_flat").cfg.__class__)


@pytest.mark.parametrize("inside", [False, True])
def test_a_folder_configs_beside_the_task_wins(no_configs: None, tmp_path: Path, inside: bool) -> None:
    """Also if the task lies in it. What it has not comes from the package."""
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs/go1_flat.py").write_text(
        "from configs.go2_rough_scan import Go2RoughCfg as Theirs\n\nclass MyCfg(Theirs):\n    pass\n"
    )
    (tmp_path / "configs/go2_rough.py").write_text(
        "from legged_mw.envs.legged_robot_config import LeggedRobotCfg\n\n"
        "class Go2RoughCfg(LeggedRobotCfg):\n    class noise(LeggedRobotCfg.noise):\n        level = 0.25\n"
    )
    file = tmp_path / ("configs/fast.py" if inside else "fast.py")
    file.write_text(FAST.format(base="MyCfg"))
    task = load_task(str(file))
    assert (task.cfg.env.num_envs, task.cfg.noise.level) == (7, 0.25)
    assert task.to_dict()["task"] == "fast.py"  # from "/", where it runs, there is no way that another machine has too
    assert load_task("go1_flat").cfg.noise.level == 1.0  # by name it is the package's own


def test_another_packages_name_configs_is_given_back(no_configs: None, tmp_path: Path) -> None:
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs/__init__.py").write_text("")
    (tmp_path / "configs/mine.py").write_text("VALUE = 3\n")
    sys.path.insert(0, str(tmp_path))  # of no_configs; syspath_prepend would restore that list, not the real one
    importlib.invalidate_caches()
    first = load_task("go1_flat_dr")  # before anybody imported it
    mine = importlib.import_module("configs.mine")
    assert mine.VALUE == 3
    again = load_task("go1_flat_dr")  # and after
    assert sys.modules["configs.mine"] is mine and "configs.go1_flat" not in sys.modules
    assert type(first.cfg) is type(again.cfg)


# ---- what a task says of its exam


def test_the_exam_is_the_tasks_own_or_its_environments() -> None:
    class Bare:
        pass

    class Graded:
        exam = "walking"

    configs = type(load_task("go1_flat").cfg), type(load_task("go1_flat").train)
    for env, exam, expected in (
        (Graded, None, "walking"),
        (Graded, "", ""),
        (Graded, "getup", "getup"),
        (Bare, None, ""),
    ):
        assert LoadedTask("dog", Path("dog.py"), Task(env, *configs, exam)).exam == expected
