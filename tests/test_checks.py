"""Values that no type can refuse are refused by name before anything is built or written."""

from __future__ import annotations

from typing import Any

import pytest

from legged_mw.envs.checks import ENVIRONMENT, LEARNER, WALKING, check_values
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import load_task, task_names


@pytest.mark.parametrize("name", task_names())
def test_tasks_as_they_ship_pass(name: str) -> None:
    task = load_task(name)
    check_values(task.cfg, task.train)


@pytest.mark.parametrize(
    ("path", "value", "wanted"),
    [
        ("env.num_envs", 0, "positive"),
        ("sim.dt", -0.004, "positive"),
        ("control.decimation", 0, "positive"),
        ("env.episode_length_s", float("inf"), "positive"),
        ("terrain.friction", -1.0, "zero or more"),
        ("terrain.condim", 2, "1, 3, 4 or 6"),
        ("terrain.seed", -1, "zero or more"),
        ("terrain.horizontal_scale", 0.3, "above 0 and at most 0.25 m, or a cell would be wider than a step of stairs"),
        ("terrain.terrain_proportions", {"stairs_up": float("inf")}, "kinds with shares from 0"),
        ("terrain.measured_points_y", [float("nan")], "at least one number, all finite"),
        ("commands.ranges.lin_vel_x", [1.0, -1.0], "two numbers, the lower first"),
        ("commands.ranges.lin_vel_y", [0.5], "two numbers, the lower first"),
        ("commands.keep_probability", [0.9, 0.25], "three numbers from 0 to 1"),
        ("commands.mirror", {"lin_vel_x": 0.5}, "1 or -1 for each command"),
        ("perturbation.duration", [0.0, 0.2], "two numbers above zero, the lower first"),
        ("asset.foot_names", [], "a list with at least one name"),
        ("termination.max_tilt", 0.0, "above 0 and at most 180 degrees"),
        ("init_state.pos", [0.0, 0.3], "three numbers, x, y, z"),
        ("runner.save_interval", 0, "positive"),
        ("algorithm.num_mini_batches", -1, "positive"),
        ("runner.run_name", "a/b", "part of a folder's name"),
    ],
)
def test_mistake_is_named(path: str, value: Any, wanted: str) -> None:
    task = load_task("go1_flat")
    task.set(path, value)
    with pytest.raises(ConfigError) as error:
        check_values(task.cfg, task.train)
    assert str(error.value).startswith(f"{path} is {value!r}; it must be {wanted}")


def test_rules_name_fields_that_exist() -> None:
    task = load_task("go1_flat")
    known = task.to_dict()
    for path in [*ENVIRONMENT, *WALKING, *LEARNER]:
        node = known
        for part in path.split("."):
            assert part in node, path
            node = node[part]


def test_fewer_samples_than_minibatches_are_named() -> None:
    task = load_task("go1_flat")
    task.set("env.num_envs", 1)
    task.set("runner.num_steps_per_env", 3)
    text = r"an iteration has 3 samples \(1 worlds x 3 steps\), fewer than algorithm.num_mini_batches = 4; raise"
    with pytest.raises(ConfigError, match=text):
        check_values(task.cfg, task.train)
