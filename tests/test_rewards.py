"""Reward terms against figures worked out by hand, their sum, and the memory that they read. More terms: test_biped.py."""

from __future__ import annotations

import math
from collections.abc import Iterator

import pytest
import torch
from torch import Tensor
from worlds import QUIET, changed, make_env, only_scales, snapshot

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg

DT = 0.02  # [s] a control step
HAND = {**QUIET, "rewards.tracking_sigma": 0.25}  # what the figures below were worked out for
SCALES = {
    "tracking_lin_vel": 1.0,
    "tracking_ang_vel": 0.5,
    "lin_vel_z": -0.5,
    "ang_vel_xy": -0.05,
    "orientation": -5.0,
    "dof_pos_limits": -1.0,
    "pose": 0.5,
    "termination": -1.0,
    "stand_still": -1.0,
    "torques": -0.0002,
    "action_rate": -0.01,
    "energy": -0.001,
    "feet_clearance": -2.0,
    "feet_height": -0.2,
    "feet_slip": -0.1,
    "feet_air_time": 0.1,
    "collision": 0.0,
}
GO1_FLAT = SCALES | {"tracking_lin_vel": 2.0, "tracking_ang_vel": 1.0}  # our two departures
del GO1_FLAT["collision"]  # off
# What the terms are in the two worlds of `paint`: 0 walks, rolled by asin 0.6; 1 is told to stand and lies on its back.
EXPECTED = {
    # v_imu = (1.13935, 3.371245), command (1, 3): exp(-(0.13935^2 + 0.371245^2) / 0.25); (0.27213, 0.106985), command 0
    "tracking_lin_vel": (math.exp(-0.15724127 / 0.25), math.exp(-0.08550053 / 0.25)),
    # command 1.5, yaw rate 2: exp(-0.5^2 / 0.25); command 0, yaw rate -0.4: exp(-0.16 / 0.25)
    "tracking_ang_vel": (math.exp(-1.0), math.exp(-0.64)),
    # world z of v_imu: 0.6 * 3.371245 + 0.8 * 1.150785 = 2.943375; 0.203475
    "lin_vel_z": (8.66345639, 0.04140208),
    # W = (0.5, 0.8 * -1 - 0.6 * 2, .) = (0.5, -2, .): 4.25; (0.1, -0.2, .): 0.05
    "ang_vel_xy": (4.25, 0.05),
    # up = (0, -0.6, 0.8); (0, 0, -1): on its back the share in the plane is 0
    "orientation": (0.36, 0.0),
    # hip 0.9 above 0.95 * 0.863 = 0.81985, calf -2.8 below -1.853 - 0.95 * 0.965 = -2.76975;
    # thigh -0.6 below 1.9075 - 0.95 * 2.5935 = -0.556325, calf -0.9 above -1.853 + 0.91675 = -0.93625
    "dof_pos_limits": (0.08015 + 0.03025, 0.043675 + 0.03625),
    # hip 0.8^2 + thigh 0.5^2 + 0.1 * calf 1^2; thigh 1.5^2 + 0.1 * calf 0.9^2
    "pose": (math.exp(-0.99), math.exp(-2.331)),
    "termination": (0.0, 1.0),
    # moving: nothing; 1.5 + 0.9
    "stand_still": (0.0, 2.4),
    # (4, 3, -12): 13 + 19; twelve of 1: sqrt(12) + 12
    "torques": (32.0, 15.46410162),
    # 0.5^2 + 2^2; twelve of 0.1^2
    "action_rate": (4.25, 0.12),
    # |2 * 4| + |-3 * 3| + |0 * -12|; twelve of |-0.5 * 1|
    "energy": (17.0, 6.0),
    # 0.08 sqrt(5) + 0.04 sqrt(1) + 0.05 sqrt(0.25) + 0.02 * 0; 0.08 (sqrt(5) + 1 + 0.5 + 0): a standing robot pays too
    "feet_clearance": (0.24388544, 0.29888544),
    # FR touches down after a peak of 0.12, RL after 0.08 (its height now; 0.07 before): 0.2^2 + 0.2^2; standing: nothing
    "feet_height": (0.08, 0.0),
    # FR 5^2 + FL 1^2 + RL 0, RR is in the air; standing: nothing
    "feet_slip": (26.0, 0.0),
    # FR 0.3 - 0.1, RL 0.08 - 0.1; FL was in contact before; standing: nothing
    "feet_air_time": (0.18, 0.0),
    # nothing is named that should not touch; where something is: test_from_legged_gym.py
    "collision": (0.0, 0.0),
}


def paint(env: LeggedRobot) -> None:
    """Made-up numbers in the simulator's tensors of worlds 0 and 1, and in the episode's memory; then what a step derives."""
    sim, spans = env.sim, env.robot.sensors
    env.reset()
    # attitude: about x by asin 0.6 (half angles: cos = sqrt 0.9, sin = sqrt 0.1); about x by 180 degrees
    sim.qpos[:2, 3:7] = torch.tensor([[0.9**0.5, 0.1**0.5, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
    # The IMU is at r = (-0.01592, -0.06659, -0.00617). Its velocity in the body frame, R^T V + w x r:
    # 0: (1, 0.8*2 + 0.6*3, -0.6*2 + 0.8*3) + (0.13935, -0.028755, -0.049215) = (1.13935, 3.371245, 1.150785)
    # 1: (0.3, 0.1, -0.2) + (-0.02787, 0.006985, -0.003475) = (0.27213, 0.106985, -0.203475)
    sim.qvel[:2, :6] = torch.tensor([[1.0, 2.0, 3.0, 0.5, -1.0, 2.0], [0.3, -0.1, 0.2, 0.1, 0.2, -0.4]])
    env.commands[:2] = torch.tensor([[1.0, 3.0, 1.5], [0.0, 0.0, 0.0]])
    home = {"hip": (0.1, -0.1, 0.1, -0.1), "thigh": (0.9,) * 4, "calf": (-1.8,) * 4}
    pose = torch.tensor([home[part][leg] for leg in range(4) for part in ("hip", "thigh", "calf")]).repeat(2, 1)
    fr_hip, fl_thigh, rr_thigh, rl_calf = 0, 4, 7, 11
    pose[0, [fr_hip, fl_thigh, rl_calf]] = torch.tensor([0.9, 1.4, -2.8])
    pose[1, [rr_thigh, rl_calf]] = torch.tensor([-0.6, -0.9])
    sim.qpos[:2, 7:] = pose
    sim.qvel[:2, 6:] = torch.tensor([[2.0, 0, 0, 0, -3.0, 0, 0, 0, 0, 0, 0, 0], [-0.5] * 12])
    sim.actuator_force[:2] = torch.tensor([[4.0, 0, 0, 0, 3.0, 0, 0, 0, 0, 0, 0, -12.0], [1.0] * 12])
    env.actions[:2] = torch.tensor([[0.5, -1.0] + [0.3] * 10, [0.2] * 12])
    env.last_actions[:2] = torch.tensor([[1.0, 1.0] + [0.3] * 10, [0.1] * 12])
    # feet FR, FL, RR, RL
    sites = [env.robot.id("site", foot) for foot in ("FR", "FL", "RR", "RL")]
    sim.site_xpos[:2, sites, 2] = torch.tensor([[0.02, 0.06, 0.15, 0.08], [0.02] * 4])
    sim.sensordata[:2, spans["linvel"]] = torch.tensor([3.0, 4.0, 9.0, 0.6, 0.8, -7.0, 0.0, 0.25, 0.0, 0.0, 0.0, 2.0])
    sim.sensordata[:2, spans["contact"]] = torch.tensor([1.0, 1.0, 0.0, 1.0])
    env.feet_air_time[:2] = torch.tensor([0.28, 0.0, 0.5, 0.06])  # the step adds 0.02
    env.swing_peak[:2] = torch.tensor([0.12, 0.2, 0.3, 0.07])
    env._update_state()
    env.check_termination()


@pytest.fixture(scope="module")
def env() -> Iterator[LeggedRobot]:
    env = make_env(4, HAND)
    paint(env)
    yield env
    for name, (walking, lying) in EXPECTED.items():  # no test may have disturbed the picture
        assert getattr(env, f"_reward_{name}")()[:2].tolist() == pytest.approx([walking, lying], rel=2e-5, abs=1e-6)


# ---- terms


def test_every_term_that_is_on_has_a_figure_here() -> None:
    assert EXPECTED.keys() == SCALES.keys()
    assert LeggedRobotCfg().to_dict()["rewards"]["scales"] == SCALES
    assert make_env(1)._active_scales() == GO1_FLAT


@pytest.mark.parametrize("name", EXPECTED)
def test_reward_term(env: LeggedRobot, name: str) -> None:
    value = getattr(env, f"_reward_{name}")()
    assert value.shape == (4,) and value.dtype == torch.float
    assert value[:2].tolist() == pytest.approx(list(EXPECTED[name]), rel=2e-5, abs=1e-6)


@pytest.mark.parametrize("name", EXPECTED)
def test_reward_terms_only_read(env: LeggedRobot, name: str) -> None:
    before = snapshot(env)
    first = getattr(env, f"_reward_{name}")()
    kept = first.clone()
    second = getattr(env, f"_reward_{name}")()
    assert torch.equal(first, kept) and torch.equal(first, second)
    assert changed(env, before) == []
    first.fill_(7.0)  # a term that hands out a buffer would let its caller write into it
    assert changed(env, before) == []


def test_settings_reach_the_terms() -> None:
    settings = {
        "tracking_sigma": 0.5,
        "soft_dof_pos_limit": 1.0,
        "swing_height": 0.12,
        "min_air_time": 0.2,
        "min_command": 3.6,  # world 0 commands sqrt(1 + 9 + 2.25) = 3.5
        "pose_weights": {"": 2.0},
    }
    env = make_env(2, {**HAND, **{f"rewards.{name}": value for name, value in settings.items()}})
    paint(env)

    def term(name: str) -> list[float]:
        return getattr(env, f"_reward_{name}")().tolist()

    assert term("tracking_ang_vel") == pytest.approx([math.exp(-0.5), math.exp(-0.32)])
    assert term("dof_pos_limits") == pytest.approx([0.9 - 0.863, 0.0], abs=1e-6)  # the hard limits
    assert term("pose") == pytest.approx([math.exp(-2 * (0.64 + 0.25 + 1.0)), math.exp(-2 * (2.25 + 0.81))])
    assert term("stand_still") == pytest.approx([0.8 + 0.5 + 1.0, 2.4])
    drift = math.hypot(0.27213, 0.106985)
    assert term("stand_drift") == pytest.approx([math.hypot(1.13935, 3.371245), drift], abs=1e-6)
    assert term("feet_air_time") == term("feet_height") == term("feet_slip") == [0.0, 0.0]
    env.moving.fill_(True)
    assert term("stand_drift") == [0.0, 0.0]
    assert term("feet_air_time") == pytest.approx([0.1 - 0.12] * 2)
    assert term("feet_height") == pytest.approx([0.0 + (0.08 / 0.12 - 1) ** 2, (0.07 / 0.12 - 1) ** 2])
    # |0.02 - 0.12| sqrt(5) + |0.06 - 0.12| + |0.15 - 0.12| * 0.5
    assert term("feet_clearance")[0] == pytest.approx(0.1 * 5**0.5 + 0.06 + 0.015)


def test_moving_is_the_norm_of_all_three_commands() -> None:
    env = make_env(6, HAND)
    env.commands.copy_(
        # norm 0.0104
        torch.tensor(
            [[0, 0, 0], [0.0099, 0, 0], [0.0101, 0, 0], [0, -0.0101, 0], [0, 0, -0.0101], [0.006, 0.006, 0.006]]
        )
    )
    env._update_state()
    assert env.moving.tolist() == [False, False, True, True, True, True]


# ---- their sum


def test_sum_of_all_terms_is_clipped_at_zero_and_a_fall_costs_after_the_clip(env: LeggedRobot) -> None:
    paint(env)
    env.compute_reward()
    sums = [sum(SCALES[name] * EXPECTED[name][world] for name in SCALES if name != "termination") for world in (0, 1)]
    assert sums[0] < -8.0 and sums[1] < -2.0  # so that a missing clip shows
    assert env.rew_buf[:2].tolist() == pytest.approx([0.0, -1.0 * DT])


TWO = only_scales(tracking_lin_vel=1.0, torques=-0.01, termination=-1.0)
# Before the clip and without the fall: exp(-0.62896507) - 0.32 = 0.2131431; exp(-0.34200214) - 0.1546410 = 0.5557057.
W, L = 0.2131431, 0.5557057


@pytest.mark.parametrize(
    ("settings", "walking", "lying"),
    [
        ({}, W, L - 1.0),
        ({"scales.termination": 0.0}, W, L),
        ({"clip_termination": True}, W, 0.0),  # L - 1 is clipped
        ({"clip_termination": True, "scales.termination": -0.5}, W, L - 0.5),
        ({"max_reward": 0.002}, 0.1, 0.1 - 1.0),  # 0.002 a step of 0.02 s is 0.1 a second; the fall comes after it
        ({"max_reward": 0.002, "clip_termination": True}, 0.1, 0.0),
        ({"max_reward": 0.002, "only_positive_rewards": False}, 0.1, 0.1 - 1.0),
        ({"scales.torques": -0.02}, 0.0, L - 0.1546410 - 1.0),  # W - 0.32 is clipped
        ({"scales.torques": -0.02, "only_positive_rewards": False}, W - 0.32, L - 0.1546410 - 1.0),
        (
            {"scales.torques": -0.02, "only_positive_rewards": False, "clip_termination": True},
            W - 0.32,
            L - 0.1546410 - 1.0,
        ),
    ],
)
def test_clip(settings: dict[str, object], walking: float, lying: float) -> None:
    env = make_env(2, {**HAND, **TWO, **{f"rewards.{name}": value for name, value in settings.items()}})
    paint(env)
    env.compute_reward()
    assert env.rew_buf.tolist() == pytest.approx([walking * DT, lying * DT], rel=1e-5, abs=1e-7)


def test_tracking_sigma_goes_to_its_end_over_a_training() -> None:
    env = make_env(2, {**HAND, "rewards.tracking_sigma_end": 0.05})
    paint(env)
    squared = 0.62896507 * 0.25  # [m^2/s^2], as above
    for done, sigma in ((0.0, 0.25), (0.5, 0.15), (1.0, 0.05)):
        env.on_training_progress(done)
        assert env._reward_tracking_lin_vel()[0].item() == pytest.approx(math.exp(-squared / sigma), rel=1e-5)
    fixed = make_env(2, HAND)
    fixed.on_training_progress(1.0)
    assert fixed.tracking_sigma == 0.25 and not isinstance(fixed.tracking_sigma, torch.Tensor), (
        "no operation more than a number takes"
    )


def test_tracking_sigma_is_wider_on_harder_levels_of_some_kinds() -> None:
    """By a tenth a level on stairs, and not on flat ground; beside it the sigma of the training's progress."""
    ground = {"terrain.mesh_type": "heightfield", "terrain.num_cols": 2, "terrain.num_rows": 6}
    kinds = {"flat": 1.0, "stairs_up": 1.0}
    wider = {"rewards.tracking_sigma_growth": {"stairs_up": 0.1, "waves": 1.0}, "rewards.tracking_sigma_end": 0.05}
    env = make_env(2, {**HAND, **ground, "terrain.terrain_proportions": kinds, **wider})
    assert env.tiles
    env.tiles.put(torch.tensor([5, 5]))
    squared = (env.commands[:, :2] - env.base_lin_vel[:, :2]).square().sum(dim=1)
    for done, sigma in ((0.0, 0.25), (1.0, 0.05)):
        env.on_training_progress(done)
        sigmas = torch.tensor([sigma, 1.5 * sigma])
        torch.testing.assert_close(env._reward_tracking_lin_vel(), torch.exp(-squared / sigmas))


def test_reward_is_for_a_control_step_of_any_length() -> None:
    env = make_env(2, {**HAND, **TWO, "control.decimation": 10})
    paint(env)
    env.compute_reward()
    assert env.dt == pytest.approx(0.04) and env.max_episode_length == 500
    assert env.rew_buf.tolist() == pytest.approx([W * 0.04, (L - 1.0) * 0.04], rel=1e-5)


def test_sums_of_the_episode_are_before_the_clip_and_its_return_after() -> None:
    env = make_env(2, {**HAND, **only_scales(torques=-0.02, tracking_lin_vel=1.0, termination=-1.0)})
    paint(env)
    # in the config's order, what comes after the clip last
    assert env.reward_names == ["tracking_lin_vel", "torques", "termination"]
    for _ in range(2):
        env.compute_reward()
    terms = torch.tensor([[0.533143, -0.02 * 32.0, 0.0], [0.710346, -0.02 * 15.464102, -1.0]])
    assert torch.allclose(env.episode_sums, 2 * DT * terms, rtol=1e-4)
    assert env.episode_return[:, 0].tolist() == pytest.approx([0.0, 2 * DT * (0.710346 - 0.309282 - 1.0)], rel=1e-4)
    assert env.episode_steps.tolist() == [[2.0], [2.0]]


def test_broken_worlds_earn_nothing_whatever_their_terms() -> None:
    env = make_env(3, {**HAND, **TWO, "rewards.only_positive_rewards": False})
    paint(env)
    env.broken[1] = True
    env.torques[1] = math.nan
    env.base_lin_vel[1] = math.inf
    env.compute_reward()
    assert env.rew_buf[:2].tolist() == [pytest.approx(W * DT, rel=1e-5), 0.0]
    assert env.episode_sums[1].tolist() == [0.0, 0.0, 0.0] and env.episode_return[1].item() == 0.0
    assert env.episode_steps[:, 0].tolist() == [1.0, 1.0, 1.0]


# ---- memory of feet


class FootStory:
    """Plays made-up contacts and heights of the feet to the environment, without physics."""

    def __init__(self, env: LeggedRobot) -> None:
        self.env = env
        self.sites = [env.robot.id("site", foot) for foot in ("FR", "FL", "RR", "RL")]
        env.reset()

    def step(self, contact: list[float], height: list[float]) -> tuple[Tensor, Tensor, Tensor]:
        """First contact, air time and swing peak as the reward sees them, (F,), in world 0."""
        env = self.env
        env.sim.sensordata[0, env.robot.sensors["contact"]] = torch.tensor(contact)
        env.sim.site_xpos[0, self.sites, 2] = torch.tensor(height)
        env._update_state()
        seen = env.first_contact[0].clone(), env.feet_air_time[0].clone(), env.swing_peak[0].clone()
        env._end_step()
        return seen


def test_first_contact_air_time_and_swing_peak() -> None:
    """FR: stance, two steps of swing, stance, swing, touch-down; FL: always down; RR: never down; RL: two contacts at once count as one."""
    env = make_env(2, HAND)
    story = FootStory(env)
    fr = [(1, 0.02), (0, 0.05), (0, 0.09), (1, 0.03), (1, 0.04), (0, 0.01), (1, 0.02)]
    rl = [(0, 0.30), (2, 0.02), (2, 0.02), (0, 0.20), (0, 0.10), (0, 0.25), (1, 0.02)]
    first_fr = [False, False, False, True, False, False, True]
    air_fr = [0.02, 0.02, 0.04, 0.06, 0.02, 0.02, 0.04]  # what the reward sees: with this step, before it is zeroed
    # the height at touch-down counts, that of the last stance does not
    peak_fr = [0.02, 0.05, 0.09, 0.09, 0.04, 0.01, 0.02]
    first_rl = [False, True, False, False, False, False, True]
    air_rl = [0.02, 0.04, 0.02, 0.02, 0.04, 0.06, 0.08]
    peak_rl = [0.30, 0.30, 0.02, 0.20, 0.20, 0.25, 0.25]
    for t in range(len(fr)):
        first, air, peak = story.step([fr[t][0], 1, 0, rl[t][0]], [fr[t][1], 0.02, 0.1 + 0.01 * t, rl[t][1]])
        assert first.tolist() == [first_fr[t], False, False, first_rl[t]], t
        assert air.tolist() == pytest.approx([air_fr[t], 0.02, 0.02 * (t + 1), air_rl[t]]), t
        assert peak.tolist() == pytest.approx([peak_fr[t], 0.02, 0.1 + 0.01 * t, peak_rl[t]]), t
        assert env.foot_contact[0].tolist() == [fr[t][0] > 0, True, False, rl[t][0] > 0], t
    # after the step, zero where in contact
    assert env.feet_air_time[0].tolist() == pytest.approx([0.0, 0.0, 0.14, 0.0])
    assert env.swing_peak[0].tolist() == pytest.approx([0.0, 0.0, 0.16, 0.0])
    assert env.foot_contact[1].tolist() == [False] * 4  # the other world heard nothing of it


def test_a_landing_after_a_drop_is_one_first_contact_a_foot() -> None:
    """Through the physics: a robot let fall from 0.4 m lands once, with the air time of the fall."""
    env = make_env(
        2, {**HAND, "init_state.lin_vel_range": 0.0, "init_state.ang_vel_range": 0.0, "init_state.pos": [0.0, 0.0, 0.4]}
    )
    landings, times = torch.zeros(2, 4), torch.zeros(2, 4)
    for _ in range(25):
        env.actions.zero_()
        env.sim.step(5)
        env._update_state()
        landings += env.first_contact
        times = torch.where(env.first_contact & (landings == 1.0), env.feet_air_time, times)
        env._end_step()
    assert (landings >= 1.0).all()
    # home height 0.278 puts the feet near the ground, so the fall is about 0.12 m: sqrt(2 * 0.12 / 9.81) = 0.16 s
    assert ((times > 0.12) & (times < 0.22)).all()


# ---- statistics


def test_statistics_are_the_sums_of_what_step_returned() -> None:
    overrides = {"env.episode_length_s": 0.3, "noise.level": 0.0, "termination.max_tilt": 20.0}
    env = make_env(16, overrides)
    means, totals = env.read_statistics(), torch.zeros(16)
    assert means["episodes"] == 0 and math.isnan(means["reward"]) and math.isnan(means["rew_pose"])
    terms, ages, rows, fell = torch.zeros(16, len(GO1_FLAT)), torch.zeros(16), [], 0
    finish = env._end_step

    def add_terms() -> None:
        """The terms of this step by name, straight from the methods, at the moment after the reward."""
        terms.add_(
            torch.stack([scale * getattr(env, f"_reward_{name}")() * DT for name, scale in GO1_FLAT.items()], dim=1)
        )
        finish()

    env._end_step = add_terms  # pyright: ignore[reportAttributeAccessIssue]
    for _ in range(40):
        _, reward, done, extras = env.step(torch.randn(16, 12) * 2.0)
        totals, ages = totals + reward, ages + 1.0
        fell += int((done & ~extras["time_outs"]).sum())
        rows += [(totals[i].item(), ages[i].item(), terms[i].tolist()) for i in range(16) if done[i]]
        totals[done], ages[done], terms[done] = 0.0, 0.0, 0.0
    stats, count = env.read_statistics(), len(rows)
    assert count > 30 and 2 < fell < count  # both kinds of ending are in it
    assert stats["episodes"] == count and stats["fell"] == fell and stats["broken"] == 0
    assert stats["reward"] == pytest.approx(sum(row[0] for row in rows) / count, rel=1e-4)
    assert stats["episode_length"] == pytest.approx(sum(row[1] for row in rows) / count)
    for k, name in enumerate(GO1_FLAT):
        expected = sum(row[2][k] for row in rows) / count / 0.3  # the episode length in seconds
        assert stats[f"rew_{name}"] == pytest.approx(expected, rel=1e-3, abs=1e-6), name
    broken_by = {"broken_by_action", *(f"broken_by/{joint}" for joint in env.robot.joint_names)}
    known = {
        "reward",
        "episode_length",
        "episodes",
        "fell",
        "broken",
        "overflowed",
        "walked",
        *(f"rew_{name}" for name in GO1_FLAT),
    }
    assert stats.keys() == known | broken_by
    again = env.read_statistics()
    assert again["episodes"] == again["fell"] == 0 and math.isnan(again["episode_length"])  # reading starts anew
