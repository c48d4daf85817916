"""What an episode draws: commands, their timers, and kicks; against the distributions and formulas of the task."""

from __future__ import annotations

import math
from typing import NamedTuple

import mujoco
import pytest
import torch
from torch import Tensor
from worlds import QUIET, make_env

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import load_task
from legged_mw.view.playing import NOMINAL

DT = 0.02  # [s] a control step
MASS = 12.74345  # [kg] of the whole robot
N = 64
AMPLITUDE = torch.tensor([1.5, 0.8, 1.2])  # vx, vy [m/s], yaw rate [rad/s]


@pytest.fixture(scope="module")
def env() -> LeggedRobot:
    return make_env(N)


# ---- commands


def test_a_new_command_component_by_component(env: LeggedRobot) -> None:
    """Each component changes with probability 0.5, and a changed one is not zero with 0.9, 0.25, 0.5, then uniform."""
    torch.manual_seed(2)
    # outside the ranges, so that a change shows
    everywhere, old = torch.ones(N, dtype=torch.bool), torch.tensor([9.0, 8.0, 7.0])
    draws = []
    for _ in range(400):
        env.commands.copy_(old.expand(N, 3))
        env._resample_commands(everywhere)
        draws.append(env.commands.clone())
    x = torch.cat(draws)  # (25600, 3)
    changed, nonzero = x != old, (x != old) & (x != 0.0)
    assert (changed.float().mean(dim=0) - 0.5).abs().max() < 0.015  # +- 0.003
    kept = nonzero.sum(dim=0) / changed.sum(dim=0)
    assert (kept - torch.tensor([0.9, 0.25, 0.5])).abs().max() < 0.02  # +- 0.004
    for i in range(3):
        u = x[nonzero[:, i], i] / AMPLITUDE[i]
        assert u.abs().max() <= 1.0 and u.max() > 0.99 and u.min() < -0.99
        assert abs(u.mean()) < 0.05 and abs(u.std() - 1 / math.sqrt(3)) < 0.02  # of at least 3200 samples: +- 0.01
    events = torch.cat([changed, nonzero], dim=1).float()
    both = events.T.corrcoef()
    for i in range(3):
        for j in range(3):
            if i != j:  # components are drawn independently of one another
                assert max(abs(both[i, j]), abs(both[i, 3 + j]), abs(both[3 + i, 3 + j])) < 0.03


def test_command_settings_reach_the_draw() -> None:
    env = make_env(
        N,
        {
            "commands.change_probability": 1.0,
            "commands.keep_probability": [1.0, 0.0, 1.0],
            "commands.ranges.lin_vel_x": [0.5, 1.0],
            "commands.ranges.ang_vel_yaw": [-0.2, -0.1],
        },
    )
    env.commands.fill_(9.0)
    env._resample_commands(torch.ones(N, dtype=torch.bool))
    x, y, yaw = env.commands.unbind(dim=1)
    assert x.min() >= 0.5 and x.max() <= 1.0 and x.max() - x.min() > 0.4
    assert (y == 0.0).all() and yaw.min() >= -0.2 and yaw.max() <= -0.1


def test_a_share_of_new_commands_is_at_an_end_of_its_range() -> None:
    """Either end as often, each command for itself; at rest as often as without it."""
    env = make_env(
        N,
        {
            "commands.change_probability": 1.0,
            "commands.keep_probability": [1.0, 1.0, 0.5],
            "commands.end_probability": 0.4,
            "commands.ranges.lin_vel_x": [-0.5, 1.0],
        },
    )
    draws = []
    for draw in (env._resample_commands, env._reset_commands):
        for _ in range(200):
            draw(torch.ones(N, dtype=torch.bool))
            draws.append(env.commands.clone())
    x, low, high = torch.stack(draws), *env.command_ranges
    share = torch.stack([(x == low).float(), (x == high).float()]).mean(dim=1)  # (2, worlds, commands)
    again, reset = (x[part] for part in (slice(200), slice(200, None)))
    assert (share.mean(dim=1)[:, :2] - 0.2).abs().max() < 0.01  # +- 0.003
    assert abs((again[..., 2] == 0.0).float().mean() - 0.5) < 0.02 and (reset[..., 2] != 0.0).all()
    both = (x == high).flatten(0, 1).float().T.corrcoef()
    assert abs(both[0, 1]) < 0.02
    inside = x[..., 0][(x[..., 0] != low[0]) & (x[..., 0] != high[0])]
    assert abs(inside.mean() - 0.25) < 0.01 and inside.min() > -0.5 and inside.max() < 1.0


def test_timers_are_exponential_with_a_mean_of_250_steps(env: LeggedRobot) -> None:
    torch.manual_seed(3)
    mask = torch.arange(N) < N // 2
    draws = []
    for use in (env._resample_commands, env._reset_commands):  # a new timer comes with every new command
        for _ in range(300):
            env.command_timer.fill_(-7.0)
            use(mask)
            assert (env.command_timer[~mask] == -7.0).all()
            draws.append(env.command_timer[mask, 0].clone())
    t = torch.cat(draws)  # 19200 [control steps]
    assert torch.equal(t, t.round()) and t.min() >= 0.0
    assert abs(t.mean() - 250.0) < 8.0 and abs(t.std() - 250.0) < 10.0  # +- 1.8 each
    for share, quantile in ((0.5, 173.3), (0.1, 26.3), (0.9, 575.6)):  # -250 log(1 - share)
        assert abs((t < quantile).float().mean() - share) < 0.015
    first, second = t.view(-1, N // 2).float()[:, 0], t.view(-1, N // 2)[:, 1]
    assert not torch.equal(first, second)  # each world its own


def test_a_command_holds_until_its_timer_ends_bit_for_bit() -> None:
    env = make_env(
        N, {"noise.level": 0.0, "commands.change_probability": 1.0, "commands.keep_probability": [1.0, 1.0, 1.0]}
    )
    env.command_timer.copy_((torch.arange(N) % 4 + 1.0)[:, None])  # 1, 2, 3, 4 steps
    due = torch.arange(N) % 4 + 1
    before = env.commands.clone()
    for t in (1, 2, 3):
        env._end_step()
        env.command_timer.masked_fill_((due <= t)[:, None], 1000.0)  # a new timer may be short
        for world in range(N):
            assert torch.equal(env.commands[world], before[world]) == bool(due[world] > t), (t, world)
        left = env.command_timer[due > t, 0]
        assert torch.equal(left, (due[due > t] - t).float())


def test_reward_is_for_the_command_that_the_policy_saw() -> None:
    """The command is redrawn after the reward, and the observation that goes with the next action shows the new one."""
    env = make_env(
        8, {"noise.level": 0.0, "commands.change_probability": 1.0, "commands.keep_probability": [1.0, 1.0, 1.0]}
    )
    seen = env.get_observations()["state"][:, 45:]
    env.command_timer.fill_(1.0)
    rewards = []
    original = env._reward_terms[env.reward_names.index("tracking_lin_vel")]
    env._reward_terms[env.reward_names.index("tracking_lin_vel")] = lambda: (
        rewards.append(env.commands.clone()),
        original(),
    )[1]
    obs, *_ = env.step(torch.zeros(8, 12))
    assert torch.equal(rewards[0], seen)
    assert torch.equal(obs["state"][:, 45:], env.commands) and (obs["state"][:, 45:] != seen).all()


def test_resampling_time_zero_never_changes_the_command() -> None:
    env = make_env(8, QUIET)
    before = env.commands.clone()
    assert (before != 0.0).all()
    for _ in range(40):
        env.step(torch.zeros(8, 12))
        assert torch.equal(env.commands, before)
    env.reset_envs(torch.arange(8) < 4)
    assert (env.commands[:4] != before[:4]).all() and torch.equal(env.commands[4:], before[4:])  # a reset still draws


# ---- kicks


class Kick(NamedTuple):
    """One kick, as read off the force over time in one world."""

    pause: int  # steps before it without any force
    steps: int  # that it lasts
    force: Tensor  # (steps, 3) [N]


KICKS = {
    "perturbation.kick": True,
    "perturbation.interval": [0.1, 0.3],
    "perturbation.duration": [0.08, 0.2],
    "perturbation.velocity": [0.0, 3.0],
}


def read_kicks(force: Tensor, active: Tensor) -> list[Kick]:
    """All whole kicks in the history of one world: ``force`` (T, 3), ``active`` (T,)."""
    kicks, start, pause = [], -1, 0
    for t, on in enumerate(active.tolist()):
        if on and start < 0:
            start = t
        elif not on:
            if start >= 0:
                kicks.append(Kick(pause, t - start, force[start:t]))
                start, pause = -1, 0
            pause += 1
    return kicks


@pytest.fixture(scope="module")
def history() -> list[Kick]:
    """Kicks of 64 worlds over 300 steps, as applied to the trunk; nothing but the trunk is pushed, and no torque acts."""
    env = make_env(N, {**KICKS, **QUIET})
    torch.manual_seed(8)
    env.reset()
    body = env.robot.physics.body("trunk").id
    force, active = [], []
    for _ in range(300):
        env.perturbation._kick_robots()
        applied = env.sim.xfrc_applied
        assert (
            (applied[:, :body] == 0).all() and (applied[:, body + 1 :] == 0).all() and (applied[:, body, 2:] == 0).all()
        )
        assert torch.equal(applied[:, body, :3], env.perturbation.kick_force)
        force.append(applied[:, body, :3].clone())
        active.append(env.perturbation.kick_active.clone())
    forces, actives = torch.stack(force), torch.stack(active)
    assert (forces[~actives] == 0.0).all()  # not a newton between kicks
    kicks = [kick for world in range(N) for kick in read_kicks(forces[:, world], actives[:, world])]
    assert len(kicks) > 1000
    return kicks


def test_a_kick_is_half_a_sine_in_one_horizontal_direction(history: list[Kick]) -> None:
    """0.5 sin(pi t / T) m dv / T: one unknown, dv in 0 .. 3 m/s, must explain every sample of a kick."""
    speeds = []
    for kick in history:
        t = torch.arange(kick.steps) * DT
        size = kick.force.norm(dim=1)
        unit = 0.5 * torch.sin(math.pi * t / (kick.steps * DT)) * MASS / (kick.steps * DT)  # force of dv = 1 m/s
        dv = (size.sum() / unit.sum()).item()
        assert torch.allclose(size, unit * dv, rtol=1e-4, atol=1e-3)
        direction = kick.force[1:] / size[1:, None]
        assert torch.allclose(direction, direction[:1].expand_as(direction), atol=1e-3) or dv < 1e-3
        speeds.append(dv)
    speed = torch.tensor(speeds)
    # +- 0.025
    assert speed.max() <= 3.0001 and speed.max() > 2.95 and speed.min() < 0.05 and abs(speed.mean() - 1.5) < 0.1


def test_every_kick_is_drawn_anew(history: list[Kick]) -> None:
    pause, steps = torch.tensor([k.pause for k in history]).float(), torch.tensor([k.steps for k in history]).float()
    peak = torch.stack([k.force.sum(dim=0) for k in history])
    angle = torch.atan2(peak[:, 1], peak[:, 0])
    assert set(pause.tolist()) == set(range(5, 16))  # 0.1 .. 0.3 s
    assert set(steps.tolist()) == set(range(4, 11))  # 0.08 .. 0.2 s
    assert abs(pause.mean() - 10.0) < 0.4 and abs(steps.mean() - 7.0) < 0.25  # +- 0.08, +- 0.05
    quarters = ((angle / math.pi + 1.0) * 2.0).floor().clamp(0, 3).long().bincount(minlength=4) / len(history)
    assert (quarters - 0.25).abs().max() < 0.05  # +- 0.012
    speed = peak.norm(dim=1)  # proportional to dv alone up to the sampling of the sine
    draws = torch.stack([pause, steps, angle, speed])
    assert draws.corrcoef().fill_diagonal_(0.0).abs().max() < 0.12
    following = torch.cat([draws[:, :-1], draws[:, 1:]]).corrcoef()[:4, 4:]  # a kick tells nothing of the next
    assert following.abs().max() < 0.12


def test_configured_kicks_are_the_tasks() -> None:
    """go1_flat: every 1 to 3 s, for 0.05 to 0.2 s, as in the joystick task; up to 8 m/s, which is ours."""
    env = make_env(N, {"perturbation.kick": True})
    draws = []
    for _ in range(60):
        env.perturbation._redraw(torch.ones(N, dtype=torch.bool))
        draws.append(env.perturbation._kick.clone())
    pause, steps, angle, dv = torch.cat(draws).unbind(dim=1)
    assert (pause.min(), pause.max()) == (50.0, 150.0) and torch.equal(pause, pause.round())
    # 0.05 s is 2.5 steps
    assert steps.min() in (2.0, 3.0) and steps.max() == 10.0 and torch.equal(steps, steps.round())
    assert angle.abs().max() <= math.pi + 1e-5 and angle.max() > 3.1 and angle.min() < -3.1
    assert dv.min() >= 0.0 and dv.max() <= 8.0 and dv.max() > 7.8
    off = make_env(2)
    for _ in range(5):
        off.step(torch.zeros(2, 12))
    assert (
        (off.sim.xfrc_applied == 0.0).all()
        and (off.perturbation.kick_force == 0.0).all()
        and not off.perturbation.kick_active.any()
    )


def test_a_pause_lasts_a_step_and_a_kick_two_at_least() -> None:
    """Of one sample, a half sine would have no force."""
    short = {"perturbation.interval": [0.001, 0.002], "perturbation.duration": [0.001, 0.02]}
    kicks = make_env(2, {**KICKS, **QUIET, **short, "perturbation.velocity": [3.0, 3.0]}).perturbation
    kicks._redraw(torch.ones(2, dtype=torch.bool))
    assert kicks._kick[:, :2].tolist() == [[1.0, 2.0]] * 2
    force = torch.zeros(2, 3)
    for _ in range(3):
        kicks._kick_robots()
        force += kicks.kick_force
    assert (force.norm(dim=1) * DT / MASS).tolist() == pytest.approx([0.75] * 2, rel=1e-3)  # dv / pi is 0.95


def test_reset_ends_a_kick_and_the_next_one_is_whole() -> None:
    env = make_env(N, {**KICKS, **QUIET})
    env.perturbation._kick.copy_(torch.tensor([2.0, 6.0, 0.5, 2.0]).expand(N, 4))
    env.perturbation._clock.zero_()
    for _ in range(5):  # two steps of pause, three of the kick
        env.perturbation._kick_robots()
    body = env.robot.physics.body("trunk").id
    assert env.perturbation.kick_active.all() and (env.sim.xfrc_applied[:, body, :2].norm(dim=1) > 1.0).all()
    mask = torch.arange(N) < N // 2
    env.reset_envs(mask)
    env.compute_observations()
    obs = env.get_observations()["privileged_state"]
    assert (env.sim.xfrc_applied[mask] == 0.0).all() and (obs[mask][:, 119:] == 0.0).all()
    assert (env.sim.xfrc_applied[~mask, body, :2].norm(dim=1) > 1.0).all() and (obs[~mask][:, 122] == 1.0).all()
    pause = env.perturbation._kick[mask, 0].clone()
    assert pause.min() >= 5.0 and pause.max() > pause.min()  # new draws
    for t in range(6):  # the others finish theirs; the reset worlds wait at least five steps
        env.perturbation._kick_robots()
        assert torch.equal(env.perturbation.kick_active[mask], pause <= t)


def test_a_kick_moves_the_robot_by_its_impulse() -> None:
    """In free flight the momentum of the whole robot gains the sum of force * dt, and the observation shows the force acting."""
    env = make_env(8, {**KICKS, **QUIET, "init_state.pos": [0.0, 0.0, 30.0], "init_state.ang_vel_range": 0.0})
    env.perturbation._kick.copy_(torch.tensor([2.0, 5.0, 0.0, 0.0]).expand(8, 4))
    env.perturbation._kick[:, 2], env.perturbation._kick[:, 3] = (
        torch.linspace(-3.0, 3.0, 8),
        torch.linspace(0.5, 3.0, 8),
    )
    env.perturbation._clock.zero_()
    angle, dv = env.perturbation._kick[:, 2].clone(), env.perturbation._kick[:, 3].clone()
    before, impulse, shown = momentum(env), torch.zeros(8, 3), []
    for _ in range(7):
        obs, _, done, _ = env.step(torch.zeros(8, 12))
        assert not done.any()
        impulse += obs["privileged_state"][:, 119:122] * DT
        shown.append(obs["privileged_state"][:, 122].mean().item())
    assert shown == [0.0, 0.0, 1.0, 1.0, 1.0, 1.0, 1.0]
    # sum of 0.5 m dv / T sin(pi i / 5) dt over i = 0 .. 4, T = 5 dt: 0.1 m dv * (2 sin 36 deg + 2 sin 72 deg)
    size = 0.1 * MASS * dv * 2 * (math.sin(math.pi / 5) + math.sin(2 * math.pi / 5))
    assert torch.allclose(
        impulse, torch.stack([size * angle.cos(), size * angle.sin(), 0 * size], dim=1), rtol=1e-4, atol=1e-4
    )
    gained = momentum(env) - before
    assert torch.allclose(gained[:, :2], impulse[:, :2], rtol=0.02, atol=0.02)


def momentum(env: LeggedRobot) -> Tensor:
    """Linear momentum (N, 3) of the whole robot [kg m/s], by MuJoCo."""
    model, rows = env.robot.physics, []
    for world in range(env.num_envs):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = env.sim.qpos[world].numpy(), env.sim.qvel[world].numpy()
        mujoco.mj_forward(model, data)
        mujoco.mj_subtreeVel(model, data)
        rows.append(torch.tensor(data.subtree_linvel[0] * MASS, dtype=torch.float))
    return torch.stack(rows)


def test_kicks_grow_with_what_a_world_survives() -> None:
    """Halfway, at the end of each episode, to the share of it that was survived; the time-out counts in full."""
    env = make_env(
        3, {**QUIET, "perturbation.kick": True, "perturbation.velocity": [2.0, 2.0], "perturbation.curriculum": True}
    )
    assert env.perturbation.kick_level.tolist() == [0.0, 0.0, 0.0] and not env.perturbation._kick[:, 3].any()
    env.episode_steps[:] = torch.tensor([[0.5], [0.25], [0.75]]) * env.max_episode_length
    env.time_out_buf[:] = torch.tensor([True, False, False])
    env.reset_envs(torch.tensor([True, True, False]))
    assert env.perturbation.kick_level.tolist() == [0.5, 0.125, 0.0]
    assert env.perturbation._kick[:, 3].tolist() == [1.0, 0.25, 0.0]  # the pause of the third goes on
    # no step in between: two of them had no episode that says anything
    env.reset_envs(torch.tensor([True, True, True]))
    assert env.perturbation.kick_level.tolist() == [0.5, 0.125, 0.375]


def test_kicks_grow_by_a_share_of_the_way() -> None:
    settings = {
        **QUIET,
        "perturbation.kick": True,
        "perturbation.curriculum": True,
        "perturbation.curriculum_rate": 0.25,
    }
    env = make_env(2, settings)
    for level in (0.25, 0.4375):  # a quarter of what is left to 1
        env.perturbation.update_level(torch.tensor([True, False]), torch.ones(2))
        assert env.perturbation.kick_level.tolist() == [level, 0.0]


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_kicks_grow_between_two_shares_of_a_training(engine: str) -> None:
    """Not with an episode: a kick that was drawn before grows too. Where nothing trains they are all there."""
    settings = {
        **QUIET,
        "sim.engine": engine,
        "perturbation.kick": True,
        "perturbation.velocity": [2.0, 2.0],
        "perturbation.growth": [0.2, 0.6],
    }
    env, kicks = (
        make_env(1, {**settings, "perturbation.interval": [0.02, 0.02], "perturbation.duration": [200.0, 200.0]}),
        [],
    )
    env.perturbation._clock.fill_(5001.0)  # [control steps] in the middle of a kick of 200 s
    for done in (None, 0.0, 0.2, 0.3, 0.6, 1.0):
        if done is not None:
            env.on_training_progress(done)
        env.step(torch.zeros(1, env.num_actions))
        kicks.append(float(env.perturbation.kick_force.norm()))
    full = env.perturbation._mass * 2.0 / 2.0 / 200.0
    assert kicks == pytest.approx([full, 0.0, 0.0, 0.25 * full, full, full], rel=1e-3, abs=1e-9)


def test_kicks_are_at_full_strength_without_the_curriculum() -> None:
    env = make_env(4, {"perturbation.kick": True, "perturbation.velocity": [2.0, 2.0]})
    env.reset()
    assert env.perturbation._kick[:, 3].tolist() == [2.0] * 4


def test_kicks_that_play_is_asked_for_have_their_strength() -> None:
    """go2_flat's kicks grew in training; play.py --set perturbation.kick=true asks for them at full strength."""
    task = load_task("go2_flat")
    for path, value in {**NOMINAL, "perturbation.kick": True, "perturbation.interval": [0.05, 0.05]}.items():
        if path.split(".")[1] in task.to_dict().get(path.split(".")[0], {}):
            task.set(path, value)
    env = task.env_class(task.cfg, "cpu", eager=True)
    forces = []
    for _ in range(20):
        env.step(torch.zeros(1, 12))
        forces.append(float(env.perturbation.kick_force.abs().max()))
    assert max(forces) > 1.0
