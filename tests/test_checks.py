"""Values that no type can refuse are refused by name before anything is built or written."""

from __future__ import annotations

from typing import Any

import pytest
from worlds import make_env

from legged_mw.envs.checks import ENVIRONMENT, LEARNER, WALKING, check_values
from legged_mw.sim.errors import ModelError
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


def test_no_number_is_cut_off_in_silence() -> None:
    task = load_task("go1_flat")
    task.set("commands.keep_probability", [0.9, 0.25, 0.5, 0.5])
    text = "^commands.keep_probability has 4 numbers, but there are 3 commands: lin_vel_x, lin_vel_y, ang_vel_yaw$"
    with pytest.raises(ConfigError, match=text):
        check_values(task.cfg)


@pytest.mark.parametrize("name", ["stiffness", "damping", "action_scale", "pose_weights", "default_joint_angles", "joint_speed_limits"])
def test_a_table_of_joints_is_checked_when_the_environment_is_made(name: str) -> None:
    """Not where it is read, which may be at the end of an exam; all joints are named."""
    section = {"pose_weights": "rewards", "default_joint_angles": "init_state", "joint_speed_limits": "asset"}.get(name, "control")
    legs = [f"{leg}_{joint}_joint" for leg in ("FR", "FL", "RR", "RL") for joint in ("hip", "thigh", "calf")]
    with pytest.raises(ModelError, match=rf"^{section}\.{name}: no joint 'wheel' in the MJCF; there are: {', '.join(legs)} "):
        make_env(1, {f"{section}.{name}": {"": 1.0, "wheel": 2.0}})
    if name in ("stiffness", "damping", "action_scale", "pose_weights"):  # the other tables may be silent
        thighs = ", ".join(joint for joint in legs if "thigh" in joint)
        with pytest.raises(ModelError, match=rf"^{section}\.{name}: no value for {thighs}: none of \['hip', 'calf'\] is a part of these"):
            make_env(1, {f"{section}.{name}": {"hip": 1.0, "calf": 1.0}})


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
