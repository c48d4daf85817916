"""Commands of one's own: the table, what is drawn, how it mirrors; headings; what a person types."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from worlds import QUIET, layout, make_env

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.commands import Command, command_table, with_units
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import load_task
from legged_mw.view.drive import outside, parse_command

Go1FlatCfg: Any = type(load_task("go1_flat").cfg)


class HeightCfg(Go1FlatCfg):
    class env(Go1FlatCfg.env):
        num_envs = 400

    class commands(Go1FlatCfg.commands):
        units = {"base_height": "m"}
        mirror = {"base_height": 1.0}
        default = {"base_height": 0.28}
        keep_probability = [0.9, 0.25, 0.5, 0.6]

        class ranges(Go1FlatCfg.commands.ranges):
            base_height: list[float] = [0.2, 0.32]


TABLE = (
    Command("lin_vel_x", -1.5, 1.5, "m/s", 1.0),
    Command("lin_vel_y", -0.8, 0.8, "m/s", -1.0),
    Command("ang_vel_yaw", -1.2, 1.2, "rad/s", -1.0),
    Command("base_height", 0.2, 0.32, "m", 1.0, 0.28),
)


@pytest.fixture(scope="module")
def env() -> LeggedRobot:
    cfg = HeightCfg()
    cfg.update({**{"noise": {"level": 0.0}, "perturbation": {"kick": False}}})
    torch.manual_seed(0)
    return LeggedRobot(cfg, "cpu")


def test_the_table_is_the_ranges_in_order() -> None:
    assert command_table(HeightCfg()) == TABLE
    assert command_table(Go1FlatCfg()) == TABLE[:3], "a heading is no command"
    for end in (0.2, 0.32):  # the ends of the range are in it
        at_end = HeightCfg()
        at_end.commands.default = {"base_height": end}
        assert command_table(at_end)[3].default == end
    assert with_units(TABLE) == "vx [m/s], vy [m/s], yaw rate [rad/s], base height [m]"


def test_a_further_command_is_drawn_and_observed(env: LeggedRobot) -> None:
    assert env.command_table == TABLE and layout(env)["state"]["commands"] == 4
    env.reset()
    height = env.commands[:, 3]
    assert height.min() >= 0.2 and height.max() <= 0.32 and height.std() > 0.02
    assert torch.equal(env.obs_buf["state"][:, env.observations.span("state", "commands")], env.commands)
    assert torch.equal(env.moving, env.moving) and env.velocity_command.shape == (400, 3)


def test_when_it_changes_it_goes_to_its_default_or_to_a_new_value(env: LeggedRobot) -> None:
    env.commands.fill_(0.25)
    torch.manual_seed(1)
    env._resample_commands(torch.ones(400, dtype=torch.bool))
    changed = env.commands[:, 3] != 0.25
    at_default = (env.commands[:, 3] == 0.28).float().sum() / changed.float().sum()
    assert changed.float().mean() == pytest.approx(0.5, abs=0.08) and at_default == pytest.approx(0.4, abs=0.1)
    assert (env.commands[:, 1] == 0.0).float().mean() > 0.3, "a velocity goes to zero"


def test_a_stand_is_a_velocity_of_zero_at_any_height(env: LeggedRobot) -> None:
    env.reset()
    env.commands[:] = torch.tensor([0.0, 0.0, 0.0, 0.3])
    env.step(torch.zeros(400, 12))
    still = env.moving[(env.commands[:, :3] == 0.0).all(dim=1)]
    assert len(still) > 100 and not still.any()


def test_it_mirrors_by_its_sign(env: LeggedRobot) -> None:
    span = env.observations.span("state", "commands")
    x = torch.zeros(1, 49)
    x[0, span] = torch.tensor([0.5, 0.2, 0.0, 0.3])
    assert env.mirror.observations["state"](x)[0, span].tolist() == pytest.approx([0.5, -0.2, 0.0, 0.3])


def test_the_curriculum_widens_it_around_its_default() -> None:
    cfg = HeightCfg()
    cfg.set("commands.curriculum", True)
    cfg.env.num_envs = 2
    env = LeggedRobot(cfg, "cpu")
    assert env.command_ranges[:, 3].tolist() == pytest.approx([0.28 - 0.4 * 0.08, 0.28 + 0.4 * 0.04])
    assert env.command_ranges[:, 0].tolist() == pytest.approx([-0.6, 0.6])


def test_the_yaw_rate_steers_to_a_heading() -> None:
    env = make_env(3, {**QUIET, "commands.heading_command": True, "commands.resampling_time": 10.0})
    half = torch.tensor([0.0, 1.5, 0.0])
    env.sim.qpos[:, 3:7] = torch.stack([half.cos(), 0 * half, 0 * half, half.sin()], dim=1)
    env.heading.copy_(torch.tensor([1.0, -3.0, 3.1]))
    env._end_step()
    # the last at its range's end
    assert env.commands[:, 2].tolist() == pytest.approx([0.5, 0.5 * (2 * math.pi - 6.0), 1.2], abs=1e-5)
    caller = make_env(3, {**QUIET, "commands.heading_command": True})
    caller.commands[:, 2] = 0.7
    caller._end_step()
    assert caller.commands[:, 2].tolist() == pytest.approx([0.7] * 3), (
        "where nothing is drawn the commands are the caller's"
    )


def test_typed_commands() -> None:
    assert parse_command("0.5,0,-0.2", TABLE) == [0.5, 0.0, -0.2, 0.28]
    assert parse_command("0.5,0,0,0.3", TABLE) == [0.5, 0.0, 0.0, 0.3]
    assert parse_command("base_height=0.25", TABLE) == [0.0, 0.0, 0.0, 0.25]
    assert outside([0.0, 0.0, 0.0, 0.32], TABLE) == ""
    for text in ("2,0,0", "hight=1", "1,2,3,4,5", "1,x,0", "nan"):
        with pytest.raises(ConfigError, match=f"--command {text}: "):
            parse_command(text, TABLE)
    with pytest.raises(ConfigError, match="0 commands"):
        parse_command("1", ())
