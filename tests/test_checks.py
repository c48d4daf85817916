"""Values that do not fit their field, or not each other, are refused by name before anything is built or written."""

from __future__ import annotations

import math
import random
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from program import SMALL, run
from worlds import make_env

from legged_mw import ROOT
from legged_mw.check.own_class import LEGGED_GYM_METHODS, PAYS, WITHOUT, check_class
from legged_mw.rl.iteration_log import FiniteCheck
from legged_mw.rl.run_folder import update_from_run
from legged_mw.robot.page import doubts
from legged_mw.utils.bounds import bare, bounds_text
from legged_mw.utils.config import ConfigError, field_types, load_yaml
from legged_mw.utils.errors import LEGGED_GYM_TENSORS, StepError, in_short
from legged_mw.utils.task import LoadedTask, load_task, task_names


@pytest.mark.parametrize("name", task_names())
def test_tasks_as_they_ship_pass(name: str) -> None:
    task = load_task(name)
    task.cfg.check()
    task.train.check(task.cfg.env.num_envs)


@pytest.mark.parametrize(
    ("path", "value"),
    [("env.num_envs", 0), ("commands.ranges.lin_vel_y", [0.5]), ("runner.save_interval", 0)],
)
def test_a_value_out_of_bounds_is_refused_in_the_class_statement(path: str, value: Any) -> None:
    """Where it has its place; tests/golden/numbers.py has what the other ways say."""
    task = load_task("go1_flat")
    *sections, name = path.split(".")
    owner, body = type(task.cfg if sections[0] in task.cfg.to_dict() else task.train), {name: value}
    parents = [owner]
    for section in sections:
        parents.append(getattr(parents[-1], section))
    for parent in parents[:0:-1]:
        body = {
            parent.__name__: type(
                parent.__name__, (parent,), {**body, "__qualname__": f"Bad.{path}".rpartition(".")[0]}
            )
        }
    with pytest.raises(ConfigError) as error:
        type("Bad", (owner,), body)
    assert f"{name} is {value!r}; it must be " in str(error.value)


def fields() -> list[tuple[LoadedTask, str, Any]]:
    """(task, path, type) of every field of every task."""
    tasks = [load_task(name) for name in task_names()]
    return [(task, *field) for task in tasks for cfg in (task.cfg, task.train) for field in field_types(type(cfg))]


@pytest.mark.parametrize(
    "number", [math.nan, math.inf, -math.inf, 1e39, 10**5000], ids=["nan", "inf", "-inf", "1e39", "5000 digits"]
)
def test_no_field_takes_a_number_that_is_not_finite(number: float) -> None:
    """Nor one that is infinite in float32, wherever a number may stand: alone, in a list, in a table."""
    whole = {
        float: number,
        list[float]: [number] * 3,
        dict[str, float]: {"": number},
        dict[str, list[float]]: {"": [number]},
    }
    found = [(task, path, whole[bare(kind)]) for task, path, kind in fields() if bare(kind) in whole]
    assert len(found) > 1000
    for task, path, value in found:
        with pytest.raises(ConfigError, match="it must be "):
            task.set(path, value)


def test_every_whole_number_says_its_bounds() -> None:
    whole = (int, list[int], dict[str, int])
    assert not [path for _, path, kind in fields() if bare(kind) in whole and not bounds_text(kind)]


# ---- methods of a user's class ----

MINE = """import torch
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.utils.task import Task


class Mine({parent}):
    {method}


TASK = Task(Mine, Go1FlatCfg, Go1FlatCfgPPO)
"""
PLACE = "mine.py:9, Mine."


def mine(folder: Path, method: str, parent: str = "LeggedRobot") -> LoadedTask:
    """A task whose class has one ``method`` of its own."""
    (folder / "mine.py").write_text(MINE.format(parent=parent, method=method.replace("\n", "\n    ")))
    return load_task(str(folder / "mine.py"))


def lines_on(task: LoadedTask) -> list[str]:
    return check_class(task.env_class, task.cfg.to_dict()["rewards"]["scales"])


@pytest.mark.parametrize(
    ("method", "call"),
    [
        ("def _init_buffers(self):\n    self.mine = torch.zeros(3)", "super()._init_buffers()"),
        ("def _update_state(self):\n    self.mine = 1", "super()._update_state()"),
        ("def _end_step(self):\n    pass", "super()._end_step()"),
        ("def on_training_progress(self, share):\n    self.mine = share", "super().on_training_progress(share)"),
        ("def training_state(self):\n    return {}", "super().training_state()"),
        ("def load_training_state(self, state):\n    self.mine = state", "super().load_training_state(state)"),
        ("def _refresh_base(self):\n    self.mine = 1", "super()._refresh_base()"),
        ("def reset_envs(self, mask):\n    self.mine = mask", "super().reset_envs(mask)"),
        ("def _reset_robots(self, mask):\n    self.mine = mask", "super()._reset_robots(mask)"),
        ("def _reset_task(self, mask):\n    self.mine = mask", "super()._reset_task(mask)"),
        ("@torch.no_grad()\ndef _end_step(self):\n    pass", "super()._end_step()"),
    ],
)
def test_a_hook_without_super_is_named(method: str, call: str, tmp_path: Path) -> None:
    task = mine(tmp_path, method)
    with pytest.raises(StepError) as error:
        lines_on(task)
    assert PLACE in error.value.where and call in error.value.what and WITHOUT in error.value.what


@pytest.mark.parametrize(
    ("method", "parent"),
    [
        ("def _end_step(self):\n    super()._end_step()", "LeggedRobot"),
        ("def _end_step(self):\n    LeggedRobot._end_step(self)", "LeggedRobot"),
        ("def _end_step(self):  # without super: nothing is remembered\n    pass", "LeggedRobot"),
        ("def _reset_task(self, mask):\n    self.mine = mask", "RobotTask"),  # whose own does nothing
        ("def _resample_commands(self, mask):\n    self._reset_commands(mask)", "LeggedRobot"),  # may be replaced
        ("def _fallen(self):\n    return self.reset_buf", "LeggedRobot"),
    ],
)
def test_what_calls_its_parent_or_may_replace_it_passes(method: str, parent: str, tmp_path: Path) -> None:
    assert lines_on(mine(tmp_path, method, parent)) == []


@pytest.mark.parametrize("how", [[], ["--check"], ["--eager"]], ids=["training", "check", "eager"])
def test_a_hook_without_super_ends_a_training_before_it_begins(how: list[str], tmp_path: Path) -> None:
    task = mine(tmp_path, "def reset_envs(self, mask):\n    pass")
    result = run("train", tmp_path, "--task", str(task.path), "--device", "cpu", *how)
    assert result.code == 2 and PLACE in result.err and not (tmp_path / "logs").exists()


@pytest.mark.parametrize("name", LEGGED_GYM_METHODS)
def test_a_hook_of_legged_gyms_is_named_with_ours(name: str, tmp_path: Path) -> None:
    [line] = lines_on(mine(tmp_path, f"def {name}(self, env_ids):\n    super().{name}(env_ids)"))
    assert PLACE in line and LEGGED_GYM_METHODS[name] in line


def test_a_method_of_that_name_which_the_users_own_code_calls_passes(tmp_path: Path) -> None:
    methods = "def _get_heights(self):\n    return 0\n\ndef _update_state(self):\n    super()._update_state()\n    self._get_heights()"
    assert lines_on(mine(tmp_path, methods)) == []


def test_what_legged_gym_calls_differently_stands_in_the_table() -> None:
    """And what is named instead is there."""
    page = (ROOT / "docs" / "from_legged_gym.md").read_text()
    for old, here in {**LEGGED_GYM_METHODS, **LEGGED_GYM_TENSORS}.items():
        if old == "anneal":  # a former name of ours
            continue
        assert re.search(rf"\b{old}\b", page), old
        assert all(word in page for word in re.findall(r"\w+", here.partition("(")[0]) if "_" in word), here


def test_a_reward_with_a_letter_too_many_is_named(tmp_path: Path) -> None:
    [line] = lines_on(mine(tmp_path, "def _rewards_crouch(self):\n    return self.base_height"))
    assert PLACE + "_rewards_crouch" in line and "_reward_" in line


def test_a_reward_of_a_users_own_without_a_scale_is_off(tmp_path: Path) -> None:
    """The check says so."""
    task = mine(tmp_path, "def _reward_crouch(self):\n    return self.base_height")
    small = ("--task", str(task.path), "--device", "cpu", "--num_envs", "4", "--check")
    off = [line.split() for line in run("train", tmp_path, *small).out.splitlines() if " off: rewards" in line]
    assert off == [["crouch", "off:", "rewards.scales.crouch", "is", "missing"]]
    assert " off: rewards" not in run("train", tmp_path, *small, "--set", "rewards.scales.crouch=1").out


@pytest.mark.parametrize(
    ("name", "scale"), [("tracking_lin_vel", -1.0), ("action_rate", 0.01), ("alive", -1.0), ("feet_slip", 1.0)]
)
def test_a_scale_of_the_unusual_sign_is_named(name: str, scale: float) -> None:
    task = load_task("go1_flat")
    task.set(f"rewards.scales.{name}", scale)
    [line] = lines_on(task)
    assert f"rewards.scales.{name} is {scale:g}" in line


@pytest.mark.parametrize("folder", sorted((ROOT / "resources/policies").glob("*/")), ids=lambda folder: folder.name)
def test_no_policy_that_ships_was_warned_of(folder: Path) -> None:
    task = load_task(folder.name)
    update_from_run(task, load_yaml(folder / "config.yaml"), where="config.yaml")
    assert not [line for line in lines_on(task) if "usual sign" in line]


def test_a_cost_of_a_skill_has_the_sign_of_a_cost() -> None:
    task = load_task("g1_getup")
    task.set("rewards.scales.shock", -0.4)
    assert lines_on(task) == []
    task.set("rewards.scales.power", 1.0)
    [line] = lines_on(task)
    assert "below 0" in line


def test_a_term_of_a_users_own_has_any_sign(tmp_path: Path) -> None:
    task = mine(tmp_path, "def _reward_torques(self):\n    return -self.torques.square().sum(dim=1)")
    task.set("rewards.scales.torques", 1.0)
    assert lines_on(task) == []


@pytest.mark.parametrize(
    "name", [*task_names(), *(f"examples/{path.name}" for path in sorted((ROOT / "examples").glob("*.py")))]
)
def test_no_task_of_ours_is_warned_of(name: str) -> None:
    if name.startswith("examples/") and "TASK = " not in (ROOT / name).read_text():
        return
    task = load_task(name if not name.startswith("examples/") else str(ROOT / name))
    wrong, odd = doubts(task)
    assert lines_on(task) == wrong == []
    assert bool(odd) == ("g1_" in name), "on two legs it tilts, and its lightest joints ring"


def test_usual_signs_are_those_of_the_page() -> None:
    rows = re.findall(
        r"^\| (`\w+`(?:, `\w+`)*) \|.*\| (above|below) 0 \|$", (ROOT / "docs" / "tasks.md").read_text(), re.MULTILINE
    )
    signs = {term: side == "above" for terms, side in rows for term in re.findall(r"\w+", terms)}
    assert len(signs) >= 25 and all((term in PAYS) == above for term, above in signs.items())


@pytest.mark.parametrize(("name", "here"), [("root_states", "root_pos"), ("foot_speeds", "'foot_speed'")])
def test_a_tensor_that_is_not_there_is_answered_with_what_is(name: str, here: str) -> None:
    with pytest.raises(AttributeError) as error:
        getattr(make_env(1), name)
    assert here in in_short(error.value)


# ---- what a robot cannot learn with ----

AT_ONCE = {
    "termination.min_base_height": "5",
    "env.episode_length_s": "0.02",
    "asset.terminate_after_contacts_on": "[FR, FL, RR, RL]",
}


@pytest.mark.parametrize("field", AT_ONCE)
def test_the_rule_that_ends_every_episode_at_once_is_named(field: str) -> None:
    task = load_task("go1_flat")
    task.set(field, AT_ONCE[field])
    [line] = doubts(task)[0]
    assert [each for each in AT_ONCE if each in line] == [field]


def test_a_fall_of_a_users_own_that_ends_every_episode_is_named(tmp_path: Path) -> None:
    [line] = doubts(mine(tmp_path, "def _fallen(self):\n    return self.base_height > 0"))[0]
    assert PLACE + "_fallen" in line


@pytest.mark.parametrize("name", ["go1_flat", "g1_getup"])
def test_doubts_draw_no_number(name: str, tmp_path: Path) -> None:
    """A training is the same with them, also of a task that draws from Python's generator and numpy's."""
    task = load_task(name)
    if name == "go1_flat":
        task = mine(
            tmp_path, "def _init_buffers(self):\n    super()._init_buffers()\n    random.random(), np.random.rand()"
        )
        vars(sys.modules[task.env_class.__module__]).update(random=random, np=np)
    before = torch.get_rng_state(), random.getstate(), str(np.random.get_state())
    doubts(task)
    assert (
        torch.equal(torch.get_rng_state(), before[0]) and (random.getstate(), str(np.random.get_state())) == before[1:]
    )


def test_doubts_keep_the_ground_of_a_task_and_never_fail(tmp_path: Path) -> None:
    """Also where its class fails on a plane, or where so few robots fail."""
    own = "def _init_buffers(self):\n    super()._init_buffers()\n    self.mine = {}"
    task = mine(tmp_path, own.format("self.tiles.levels.clone()"))
    [line] = doubts(task)[1]
    assert "AttributeError" in line and doubts(task)[0] == []
    task.set("terrain.mesh_type", "heightfield")
    assert doubts(task) == ([], [])


def test_only_the_first_rank_looks_at_few_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    task = load_task("go1_flat")
    task.set("termination.min_base_height", "5")
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "1")
    assert doubts(task) == ([], [])


def test_episodes_of_one_step_are_said_when_training_begins_and_after_two_iterations(tmp_path: Path) -> None:
    field = "termination.min_base_height"
    result = run("train", tmp_path, *SMALL, "--max_iterations", "3", "--set", f"{field}=5")
    warned = [line for line in result.out.splitlines() if line.lower().startswith("warning")]
    assert result.code == 0 and [field in line for line in warned] == [True, False]
    assert "iteration 2: episodes last 1.0 steps" in warned[1] and " fell" in warned[1] and "timed out" not in warned[1]


def test_episodes_of_one_step_are_said_once_after_a_resume_too() -> None:
    numbers = {"episodes": 8.0, "episode_length": 1.0, "fell": 8.0, "broken": 0.0}
    health = FiniteCheck([], [])
    assert [len(health.lengths(numbers)) for _ in range(3)] == [0, 1, 0]  # whatever the number of the iteration is


def test_a_robot_that_stands_after_a_quarter_of_its_training_is_said_once() -> None:
    numbers = {"episodes": 0.0, "episode_length": 1e3, "falls_a_minute": 0.2, "rew_pose": 1.0, "rew_torques": -0.3}
    numbers["rew_termination"] = -9.0  # no advice: it is falling that costs
    for walked, falls, what in ((0.1, 0.2, "weaken torques"), (0.1, 7.0, "falls 7 times"), (0.3, 7.0, "")):
        health = FiniteCheck([], [])
        asked = numbers | {"rew_energy": -0.1, "walked": walked, "falls_a_minute": falls}
        said = [(k, line) for k in range(100) for line in (health.lengths(asked), health.walking(asked, k / 100))[1]]
        assert [k for k, _ in said] == ([25] if what else []) and all(
            what in line and "10%" in line for _, line in said
        )
    health = FiniteCheck([], [])
    assert not any(health.lengths(numbers) or health.walking(numbers, 0.5) for _ in range(99)), "not told to walk"
    health, stands = FiniteCheck([], []), numbers | {"walked": 0.1, "command_share": 1.0}
    said = [(k, line) for k in range(99) for line in (health.lengths(stands), health.walking(stands, 0.5))[1]]
    assert [k for k, _ in said] == [19] and "curriculum" not in said[0][1], "it is on"


@pytest.mark.parametrize(("kp", "what"), [("0", "sags"), ("25000", "unstable")])
@pytest.mark.parametrize("how", [["--check"], ["--max_iterations", "1"]], ids=["check", "training"])
def test_gains_that_no_robot_stands_on_are_said(kp: str, what: str, how: list[str], tmp_path: Path) -> None:
    """As the picture's page says it."""
    out = run("train", tmp_path, *SMALL, "--set", f"control.stiffness={{'': {kp}}}", *how).out
    [line] = [line for line in out.splitlines() if what in line]
    assert line.startswith("  - " if how == ["--check"] else "warning: ") and "FR_calf_joint" in line


@pytest.mark.parametrize("law", ["torque", "dc_motor"])
def test_other_motors_are_looked_at_as_far_as_they_have_gains(law: str) -> None:
    task = load_task("go1_flat")
    task.update(
        {"control": {"actuator": law, "stall_torque": {"": 30.0}, "no_load_speed": {"": 30.0}, "stiffness": {"": 0.0}}},
        "test",
    )
    wrong, _ = doubts(task)
    assert bool(wrong) == (law == "dc_motor")
