"""The step, its border, observations, resets and termination. Rewards are in test_rewards.py, commands and kicks in test_draws.py."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict
from torch import Tensor
from worlds import QUIET, STATE, changed, layout, make_env, same, snapshot, tensors

from legged_mw import ROOT
from legged_mw.check.held import Lost, everything
from legged_mw.check.recordable import recordable
from legged_mw.envs.base_task import BaseTask
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.envs.snapshot import put_snapshot, take_snapshot
from legged_mw.envs.statistics import BOUND, NonFinite, Statistics
from legged_mw.utils.errors import NotRecordable
from legged_mw.utils.task import load_task

HOME = [0.1, 0.9, -1.8, -0.1, 0.9, -1.8, 0.1, 0.9, -1.8, -0.1, 0.9, -1.8]  # [rad] FR, FL, RR, RL; hip, thigh, calf
FEET = ("FR", "FL", "RR", "RL")
KICKS = {"perturbation.kick": True, "perturbation.interval": [0.02, 0.1], "perturbation.duration": [0.06, 0.2]}
N = 10  # no other tensor has as many rows, so that a first dimension of 10 means worlds


@pytest.fixture(scope="module")
def quiet() -> LeggedRobot:
    """Nothing random within an episode."""
    return make_env(N, QUIET)


@pytest.fixture(scope="module")
def lively() -> LeggedRobot:
    """Kicks every few steps, new commands often and rewards below zero; no noise, so that observations equal what they observe."""
    return make_env(
        N, {**KICKS, "noise.level": 0.0, "commands.resampling_time": 0.1, "rewards.only_positive_rewards": False}
    )


def act(env: LeggedRobot, scale: float = 1.0) -> Tensor:
    return torch.randn(env.num_envs, env.num_actions) * scale


def run_a_while(env: LeggedRobot, steps: int = 20, seed: int = 1) -> None:
    """Well into an episode of every world; the same from the same seed, whatever was before."""
    torch.manual_seed(seed)
    env.reset()
    for _ in range(steps):
        env.step(act(env, 0.5))


# ---- what its worlds remember


class _Slots:
    __slots__ = ("kept",)
    written = ("kept",)

    def __init__(self, kept: Tensor) -> None:
        self.kept = kept


class _Holds(LeggedRobot):
    """A task whose buffers lie where attributes, dicts and lists are not all."""

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self.mine, self.frames = self.buffer(3, dtype=torch.long), deque([self.buffer(3)], maxlen=1)
        self.slots, self.table = self.remember(_Slots(self.buffer(3))), TensorDict({"robot": self.buffer(3)})
        self.net = torch.nn.Sequential(torch.nn.BatchNorm1d(3)).requires_grad_(False)
        self.remember(dict(self.net.named_buffers()))

    def own(self) -> dict[str, Tensor]:
        return {"mine": self.mine, "frames.0": self.frames[0], "slots.kept": self.slots.kept} | {
            "table.robot": self.table["robot"],
            "net._modules.0._buffers.running_mean": self.net[0].running_mean,
        }

    def _end_step(self) -> None:
        super()._end_step()
        for value in self.own().values():
            value.add_(1)


def test_worlds_go_on_where_they_were_wherever_a_task_holds_its_buffers() -> None:
    one, two = (make_env(N, QUIET, env_class=_Holds) for _ in range(2))
    lost = Lost(one)
    one.step(act(one))
    assert {"mine", "slots.kept", "feet.count", "observations._parts.state.frame"} <= one.remembered().keys()
    assert lost.named() == "" and put_snapshot(two, take_snapshot(one)) == ""
    for name, value in one.own().items():
        assert (value == 1.0).all() and torch.equal(two.own()[name], value), name
        assert torch.equal(everything(one)[name], value.flatten()), name


def test_what_a_step_writes_and_no_resumed_run_would_have_is_named(quiet: LeggedRobot) -> None:
    other, state = make_env(N, QUIET), take_snapshot(quiet)
    assert put_snapshot(other, state) == ""
    for held in ({torch.zeros(N)}, torch.Generator(), np.random.default_rng(1), np.array([None])):
        vars(other)["mine"] = held
        assert "mine" in Lost(other).named()
    for held in (torch.zeros(N, 2), np.zeros(N), deque([torch.zeros(N)])):
        vars(other)["mine"] = held
        lost = Lost(other)
        assert lost.named() == ""
        (held[0] if isinstance(held, deque) else held)[:1] += 1.0
        assert "mine" in lost.named()
    vars(other)["mine"] = mine = torch.zeros(N, 2)
    other.remember(mine[:, :1])
    lost = Lost(other)
    mine.zero_()
    assert "self.mine" in lost.named()  # a half of it is remembered


def test_a_snapshot_of_other_buffers_is_refused_and_changes_nothing(quiet: LeggedRobot) -> None:
    other, state = make_env(N, QUIET), take_snapshot(quiet)
    state["actions"].fill_(0.5)
    for wrong, why in (
        ({**state, "mine": torch.zeros(N)}, f"mine is float32 ({N},) there and missing here"),
        (
            {name: value for name, value in state.items() if name != "fell"},
            f"fell is missing there and bool ({N},) here",
        ),
        ({**state, "fell": torch.zeros(N)}, f"fell is float32 ({N},) there and bool ({N},) here"),
    ):
        assert put_snapshot(other, wrong) == why
    other.not_remembered = "self.mine is lost"
    assert put_snapshot(other, state) == "self.mine is lost" and not other.actions.any()


# ---- the recorded step


class _Reads(LeggedRobot):
    def _reward_pose(self) -> Tensor:
        return super()._reward_pose() * (1.0 if self.commands.sum() > 1e9 else 2.0)


class _Indexes(LeggedRobot):
    def reset_envs(self, mask: Tensor) -> None:
        super().reset_envs(mask)
        self.commands[mask] = 0.0


class _Creates(LeggedRobot):
    def _end_step(self) -> None:
        super()._end_step()
        self.commands += torch.tensor([0.0, 0.0, 0.1])


class _Shapes(LeggedRobot):
    def compute_observations(self) -> None:
        self.fell.nonzero()
        super().compute_observations()


@pytest.mark.parametrize(
    ("env_class", "message"),
    [
        (_Reads, "a tensor as a condition .* is read to the host"),
        (_Indexes, "a mask as an index has a shape that depends on data"),
        (_Creates, "tensor.. copies data from the host"),
        (_Shapes, "nonzero has a shape that depends on data"),
    ],
)
def test_guard_reaches_every_part_of_the_step(env_class: type[LeggedRobot], message: str) -> None:
    env = make_env(2, {"sim.engine": "mujoco_warp"}, env_class=env_class)
    with pytest.raises(NotRecordable, match=f"^{message}"), recordable():
        env._step()


# ---- the border: buffers in, copies out


def test_what_a_step_hands_out_is_never_written_again(lively: LeggedRobot) -> None:
    env = lively
    run_a_while(env, 5)
    # so that all flags are set now and cleared in the next step
    env.episode_length_buf = torch.full((N,), env.max_episode_length - 1)
    obs, reward, done, extras = env.step(act(env))
    handed = {**dict(obs.items()), "reward": reward, "done": done, "time_outs": extras["time_outs"]}
    kept = {name: value.clone() for name, value in handed.items()}
    assert done.all() and extras["time_outs"].all()
    later_obs, later_reward, later_done, later_extras = env.step(act(env))
    assert [name for name, value in handed.items() if not same(value, kept[name])] == []
    later = {
        **dict(later_obs.items()),
        "reward": later_reward,
        "done": later_done,
        "time_outs": later_extras["time_outs"],
    }
    assert [name for name, value in later.items() if same(value, kept[name])] == []  # every buffer did change meanwhile
    first = env.reset()
    kept_first = first["state"].clone()
    env.step(act(env))
    assert same(first["state"], kept_first)


def test_writing_into_what_was_handed_out_changes_nothing(quiet: LeggedRobot) -> None:
    run_a_while(quiet, 2)
    actions = act(quiet)
    obs, reward, done, extras = quiet.step(actions)
    before = snapshot(quiet)
    for value in [actions, *obs.values(), reward, done, extras["time_outs"]]:
        value.fill_(1)
    assert changed(quiet, before) == []


def test_actions_are_clipped_inside_and_the_callers_are_not(quiet: LeggedRobot) -> None:
    quiet.reset()
    actions = torch.linspace(-5.0, 5.0, N * 12).view(N, 12)
    kept = actions.clone()
    obs, *_ = quiet.step(actions)
    assert torch.equal(actions, kept)
    expected = kept.clamp(-2.0, 2.0)
    assert torch.equal(obs["state"][:, 33:45], expected)
    assert torch.allclose(quiet.sim.ctrl, torch.tensor(HOME) + 0.5 * expected, atol=1e-6)  # no world was reset


def test_episode_length_is_copied_in(quiet: LeggedRobot) -> None:
    buffer, ages = quiet.episode_length_buf, torch.arange(N)
    quiet.episode_length_buf = ages
    assert quiet.episode_length_buf is buffer and buffer is not ages
    ages.fill_(500)
    assert buffer.tolist() == list(range(N))
    quiet.episode_length_buf = torch.randint_like(buffer, high=quiet.max_episode_length)  # as rsl-rl does
    assert quiet.episode_length_buf is buffer
    quiet.reset()
    assert buffer.tolist() == [0] * N


def test_wrong_shape_of_actions(quiet: LeggedRobot) -> None:
    with pytest.raises(ValueError, match=r"actions must be \(10, 12\) \(environments, joints\); got \(12,\)"):
        quiet.step(torch.zeros(12))


def test_base_task_alone_has_no_step() -> None:
    class Empty(BaseTask):
        pass

    task = Empty(2, 3, "cpu")
    for call in (lambda: task.step(torch.zeros(2, 3)), task.reset):
        with pytest.raises(NotImplementedError):
            call()


# ---- groups


def test_groups_may_have_any_name() -> None:
    class Renamed(LeggedRobot):
        def observation_rows(self) -> dict[str, list[Row]]:
            return {"senses": super().observation_rows()["state"]}

    env = make_env(2, env_class=Renamed)
    env.step(torch.zeros(2, 12))
    assert env.obs_buf["senses"].shape == (2, 48)


def test_a_scale_of_zero_needs_no_method() -> None:
    assert "not_written_yet" not in make_env(1, {"rewards.scales.not_written_yet": 0.0}).reward_names


# ---- observations

PRIVILEGED = {
    "state": 48,
    "base_ang_vel": 3,
    "accelerometer": 3,
    "projected_gravity": 3,
    "base_lin_vel": 3,
    "base_ang_vel_world": 3,
    "dof_pos": 12,
    "dof_vel": 12,
    "torques": 12,
    "foot_contact": 4,
    "foot_lin_vel": 12,
    "feet_air_time": 4,
    "kick_force": 3,
    "kick_active": 1,
}
HALF_WIDTH = {"base_lin_vel": 0.1, "base_ang_vel": 0.2, "projected_gravity": 0.05, "dof_pos": 0.03, "dof_vel": 1.5}


def in_mujoco(env: LeggedRobot, world: int) -> dict[str, np.ndarray]:
    """What C MuJoCo says of a world's qpos and qvel: at the IMU, in its frame, unless named otherwise."""
    model = env.robot.physics
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = env.sim.qpos[world].numpy(), env.sim.qvel[world].numpy()
    mujoco.mj_forward(model, data)
    imu, velocity = model.site("imu").id, np.zeros((2, 6))
    for local in (0, 1):
        mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_SITE, imu, velocity[local], local)
    rotation = data.site_xmat[imu].reshape(3, 3)
    return {
        "base_lin_vel": velocity[1, 3:],
        "base_ang_vel": velocity[1, :3],
        "base_ang_vel_world": velocity[0, :3],
        "base_lin_vel_world": velocity[0, 3:],
        "projected_gravity": -rotation[2],
        "up": data.body("trunk").xmat.reshape(3, 3)[:, 2],
    }


def by_sensor(env: LeggedRobot, prefix: str) -> Tensor:
    """Readings (N, n) of the sensors ``<prefix>/<foot or site>`` by name."""
    columns = []
    for name in ["imu"] if prefix == "accelerometer" else FEET:
        sensor = env.robot.physics.sensor(f"{prefix}/{name}")
        columns += range(sensor.adr[0], sensor.adr[0] + sensor.dim[0])
    return env.sim.sensordata[:, columns]


def test_sizes_and_noise_of_the_layout() -> None:
    env = make_env(2, {"noise.level": 0.5})
    tables = layout(env)
    assert tables == {"state": STATE, "privileged_state": PRIVILEGED}
    assert [list(table) for table in tables.values()] == [list(STATE), list(PRIVILEGED)]  # the order
    assert {group: tuple(obs.shape) for group, obs in env.obs_buf.items()} == {
        "state": (2, 48),
        "privileged_state": (2, 123),
    }
    noise = [HALF_WIDTH.get(name, 0.0) * 0.5 for name, size in STATE.items() for _ in range(size)]
    vectors = {group: part._noise for group, part in env.observations._parts.items()}
    assert vectors["privileged_state"] is None and vectors["state"].tolist() == pytest.approx(noise)


def test_each_row_holds_what_its_name_says(lively: LeggedRobot) -> None:
    """Against MuJoCo, sensors by name, and this test's own account of actions, commands and contacts."""
    env = lively
    run_a_while(env, 0)
    body, seen = env.robot.physics.body("trunk").id, dict.fromkeys([*STATE, *PRIVILEGED], 0.0)
    air = torch.zeros(N, 4)
    for _ in range(20):
        actions = act(env)
        obs, _, done, _ = env.step(actions)
        contact = by_sensor(env, "contact") > 0
        air = torch.where(contact | done[:, None], 0.0, air + 0.02)
        mj = [in_mujoco(env, world) for world in range(N)]
        derived = {name: torch.tensor(np.stack([m[name] for m in mj]), dtype=torch.float) for name in mj[0]}
        expected = {
            **derived,
            "dof_pos": env.sim.qpos[:, 7:] - torch.tensor(HOME),
            "dof_vel": env.sim.qvel[:, 6:],
            "last_actions": torch.where(done[:, None], 0.0, actions.clamp(-2.0, 2.0)),
            "commands": env.commands,
            "state": obs["state"],
            "accelerometer": by_sensor(env, "accelerometer"),
            "torques": env.sim.actuator_force,
            "foot_contact": contact.float(),
            "foot_lin_vel": by_sensor(env, "linvel"),
            "feet_air_time": air,
            "kick_force": env.sim.xfrc_applied[:, body, :3],
            "kick_active": env.perturbation.kick_active[:, None].float(),
        }
        for group, table in (("state", STATE), ("privileged_state", PRIVILEGED)):
            spans = obs[group].split(list(table.values()), dim=1)
            for name, value in zip(table, spans, strict=True):
                assert torch.allclose(value, expected[name], atol=2e-5), f"{group}.{name}"
                seen[name] += float(value.abs().sum())
    assert [name for name, total in seen.items() if total == 0.0] == []  # nothing was compared while zero only


def test_a_standing_robot_senses_gravity_and_its_weight(quiet: LeggedRobot) -> None:
    """Sensors that nothing else checks: accelerometer up 9.81 m/s^2, all feet down and still, and the weight in no joint's sign wrong."""
    quiet.reset()
    quiet.sim.qvel.zero_()  # a pose alone does not catch every push that a reset draws
    for _ in range(60):
        obs, _, done, _ = quiet.step(torch.zeros(N, 12))
        assert not done.any()
    row = dict(zip(PRIVILEGED, obs["privileged_state"].split(list(PRIVILEGED.values()), dim=1), strict=True))
    assert (
        torch.allclose(row["accelerometer"].norm(dim=1), torch.tensor(9.81), atol=0.1)
        and (row["accelerometer"][:, 2] > 9.5).all()
    )
    assert (row["foot_contact"] == 1.0).all() and (row["feet_air_time"] == 0.0).all()
    assert (row["foot_lin_vel"].abs() < 0.05).all()
    # servos lag behind their targets under the weight: kp (target - q), and the calves carry most
    assert torch.allclose(row["torques"], -35.0 * row["dof_pos"], atol=0.05) and (row["torques"][:, 2::3] > 1.0).all()
    # foot spheres of 0.023 m, a little into the ground
    assert torch.allclose(quiet.foot_height, torch.tensor(0.02), atol=0.01)


def test_noise_is_uniform_within_its_half_width_and_new_for_each_number() -> None:
    env = make_env(N)
    run_a_while(env, 3)
    clean = torch.cat([row.value for row in env.observation_rows()["state"]], dim=1)
    samples = []
    for _ in range(400):
        env.compute_observations()
        obs = env.get_observations()
        assert torch.equal(obs["privileged_state"][:, :48], obs["state"])  # the same noisy sample
        samples.append(obs["state"] - clean)
    assert torch.equal(obs["privileged_state"][:, 48:51], env.base_ang_vel)  # and all that follows is clean
    noise = torch.stack(samples)  # (400, N, 48)
    assert (noise[..., 33:] == 0.0).all()  # last actions and commands
    width = torch.tensor([HALF_WIDTH[name] for name, size in STATE.items() for _ in range(size) if name in HALF_WIDTH])
    u = noise[..., :33] / width  # 4000 samples a number
    assert u.abs().max() < 1.001 and (u.amax(dim=(0, 1)) > 0.99).all() and (u.amin(dim=(0, 1)) < -0.99).all()
    assert (u.mean(dim=(0, 1)).abs() < 0.04).all()  # of a uniform: 0 +- 0.009
    assert ((u.std(dim=(0, 1)) - 1 / math.sqrt(3)).abs() < 0.02).all()
    assert (u.unique(dim=0).shape[0], u.flatten(0, 1).T.corrcoef().fill_diagonal_(0.0).abs().max() < 0.1) == (400, True)
    assert u.transpose(0, 1).flatten(1).corrcoef().fill_diagonal_(0.0).abs().max() < 0.1  # nor do worlds share it


# ---- velocity and gravity at the IMU


def test_velocity_and_gravity_at_the_imu_are_mujocos_own(quiet: LeggedRobot) -> None:
    """From qpos and qvel alone, for states far from home; and the rewards that use the world frame through them."""
    env = quiet
    torch.manual_seed(1)
    env.reset()
    for _ in range(3):
        attitude = torch.randn(N, 4)
        env.sim.qpos[:, 3:7] = attitude / attitude.norm(dim=1, keepdim=True)
        env.sim.qvel[:, :6] = torch.randn(N, 6) * 3.0
        env._refresh_base()
        rewards = {name: getattr(env, f"_reward_{name}")() for name in ("lin_vel_z", "ang_vel_xy", "orientation")}
        for world in range(N):
            expected = in_mujoco(env, world)
            for name in ("base_lin_vel", "base_ang_vel", "base_ang_vel_world", "projected_gravity"):
                assert getattr(env, name)[world].numpy() == pytest.approx(expected[name], abs=1e-5), name
            assert rewards["lin_vel_z"][world].item() == pytest.approx(expected["base_lin_vel_world"][2] ** 2, abs=1e-4)
            assert rewards["ang_vel_xy"][world].item() == pytest.approx(
                (expected["base_ang_vel_world"][:2] ** 2).sum(), abs=1e-4
            )
            assert rewards["orientation"][world].item() == pytest.approx((expected["up"][:2] ** 2).sum(), abs=1e-5)


# ---- resets


def test_reset_touches_the_masked_worlds_only(lively: LeggedRobot) -> None:
    env = lively
    run_a_while(env)
    mask = torch.arange(N) % 3 == 0
    before = snapshot(env)
    env.reset_envs(mask)
    assert changed(env, before, worlds=~mask) == []
    touched = {
        "sim.qpos",
        "sim.qvel",
        "sim.ctrl",
        "sim.sensordata",
        "sim.actuator_force",
        "sim.site_xpos",
        "env.perturbation._kick",
        "env.perturbation._clock",
    }
    touched |= {
        "env.commands",
        "env.command_timer",
        "env._episode",
        "env._episode_length_buf",
        "env.base_lin_vel",
        "env.foot_contact",
    }
    assert touched <= set(changed(env, before, worlds=mask))
    nothing = snapshot(env)
    env.reset_envs(torch.zeros(N, dtype=torch.bool))
    assert set(changed(env, nothing)) <= {"sim._reset_mask"}


def test_reset_forgets_everything(lively: LeggedRobot) -> None:
    """A world with a past and a new one, reset by the same draws, do the same afterwards, bit for bit."""
    env = lively
    runs = []
    for past in (0, 30):
        run_a_while(env, past)
        env.sim.xfrc_applied[:, 3] = 1.0 if past else 0.0
        torch.manual_seed(6)
        outputs = [env.reset()]
        for _ in range(5):
            obs, reward, done, _ = env.step(act(env))
            outputs.append(obs)
        runs.append(
            [o[group] for o in outputs for group in ("state", "privileged_state")]
            + [reward, done, env.sim.qpos.clone()]
        )
    assert all(same(a, b) for a, b in zip(*runs, strict=True))


def test_state_after_a_reset(lively: LeggedRobot) -> None:
    env = lively
    draws = []
    for seed in range(150):
        run_a_while(env, 15 if seed == 0 else 0, seed)
        if seed == 0:
            assert (
                (env.sim.qvel[:, 6:] != 0).any() and (env.sim.xfrc_applied != 0).any() and (env.last_actions != 0).all()
            )
            env.reset()
        sim = env.sim
        assert torch.allclose(sim.qpos[:, 7:], torch.tensor(HOME)) and (sim.qpos[:, 2] == 0.278).all()
        assert (sim.qpos[:, 4:6] == 0.0).all() and torch.allclose(sim.qpos[:, 3:7].norm(dim=1), torch.tensor(1.0))
        assert torch.allclose(sim.ctrl, torch.tensor(HOME)) and (sim.qvel[:, 6:] == 0.0).all()
        for name in ("sensordata", "actuator_force", "site_xpos", "xfrc_applied"):
            assert (getattr(sim, name) == 0.0).all(), name
        for name in ("last_actions", "feet_air_time", "swing_peak", "episode_sums", "episode_return", "episode_steps"):
            assert (getattr(env, name) == 0.0).all(), name
        assert (
            not env.foot_contact.any()
            and not env.perturbation.kick_active.any()
            and (env.perturbation.kick_force == 0.0).all()
            and (env.perturbation._clock == 0.0).all()
        )
        assert (env.episode_length_buf == 0).all()
        yaw = 2.0 * torch.atan2(sim.qpos[:, 6], sim.qpos[:, 3])
        yaw = torch.atan2(torch.sin(yaw), torch.cos(yaw))
        draws.append(torch.cat([sim.qpos[:, :2], yaw[:, None], sim.qvel[:, :6], env.commands], dim=1))
    check_uniform(torch.cat(draws), [0.5, 0.5, math.pi] + [0.5] * 6 + [1.5, 0.8, 1.2])


def check_uniform(samples: Tensor, half_width: list[float]) -> None:
    """Each column of (1500, n) is uniform over +- its half width, and none follows another."""
    u = samples / torch.tensor(half_width)
    assert u.shape == (1500, len(half_width))
    assert u.abs().max() <= 1.00001 and (u.amax(dim=0) > 0.98).all() and (u.amin(dim=0) < -0.98).all()
    quarters = torch.stack([((u > -1 + k / 2) & (u <= -0.5 + k / 2)).float().mean(dim=0) for k in range(4)])
    assert (quarters - 0.25).abs().max() < 0.05  # 0.25 +- 0.011
    assert u.T.corrcoef().fill_diagonal_(0.0).abs().max() < 0.12  # 0 +- 0.026


def test_reset_ranges_are_the_configs() -> None:
    ranges = {
        "pos_xy_range": 0.0,
        "yaw_range": 0.1,
        "lin_vel_range": 0.0,
        "ang_vel_range": 2.0,
        "pos": [3.0, -4.0, 0.5],
    }
    env = make_env(N, {**QUIET, **{f"init_state.{name}": value for name, value in ranges.items()}})
    assert (env.sim.qpos[:, :3] == torch.tensor([3.0, -4.0, 0.5])).all() and (env.sim.qvel[:, :3] == 0.0).all()
    assert 0.03 < 2 * env.sim.qpos[:, 6].abs().max() <= 0.1
    assert 1.0 < env.sim.qvel[:, 3:6].abs().max() <= 2.0


# ---- termination


def roll_by(env: LeggedRobot, degrees: list[float]) -> None:
    half = torch.tensor(degrees) * math.pi / 360.0
    env.sim.qpos[: len(degrees), 3:7] = torch.stack([half.cos(), half.sin(), 0 * half, 0 * half], dim=1)


@pytest.mark.parametrize(("limit", "ok", "fallen"), [(90.0, 89.5, 90.5), (40.0, 39.5, 40.5), (120.0, 119.5, 120.5)])
def test_tilt_beyond_the_limit_is_a_fall(limit: float, ok: float, fallen: float) -> None:
    env = make_env(4, {**QUIET, "termination.max_tilt": limit})
    roll_by(env, [ok, fallen, -ok, -fallen])
    env._refresh_base()
    env.check_termination()
    assert env.fell.tolist() == env.reset_buf.tolist() == [False, True, False, True]
    assert not env.time_out_buf.any() and not env.broken.any()


def test_a_fall_ends_the_episode_and_is_paid_for(quiet: LeggedRobot) -> None:
    run_a_while(quiet, 3)
    quiet.read_statistics()
    roll_by(quiet, [0.0, 180.0])
    _, reward, done, extras = quiet.step(torch.zeros(N, 12))
    assert done.tolist() == [False, True] + [False] * 8 and not extras["time_outs"].any()
    assert reward[1].item() == pytest.approx(-0.02) and (reward[[0, 2]] >= 0.0).all()  # all else is clipped at 0
    assert quiet.episode_length_buf.tolist() == [4, 0] + [4] * 8
    assert quiet.sim.qpos[1, 2].item() == pytest.approx(0.278)
    stats = quiet.read_statistics()
    assert (stats["episodes"], stats["fell"], stats["broken"]) == (1, 1, 0)


def test_the_share_of_the_commanded_speed_that_worlds_walk() -> None:
    """Of those that are told to walk: 0.5 of 1, 0 of 1, and backwards 1 of 2, in any direction."""
    env = make_env(4, QUIET)
    env.commands[:] = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.5], [-2.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    env.base_lin_vel[:] = torch.tensor([[0.5, 0.3, 0.0], [0.7, 0.0, 0.1], [-1.0, 0.2, 0.0], [3.0, 3.0, 0.0]])
    assert env.read_statistics()["walked"] == pytest.approx(1.5 / 4.0)
    env.commands.zero_()
    assert "walked" not in env.read_statistics(), "nobody is told to walk"


def test_time_out_at_exactly_the_episode_length() -> None:
    env = make_env(4, {**QUIET, "env.episode_length_s": 0.2})
    assert env.max_episode_length == 10
    env.episode_length_buf = torch.tensor([0, 5, 8, 9])
    ended = []
    for _ in range(12):
        _, _, done, extras = env.step(torch.zeros(4, 12))
        assert torch.equal(done, extras["time_outs"])
        ended.append(done.tolist())
    # after ten steps of an episode that began at 0, whatever the length of the one before
    assert [[t for t in range(1, 13) if ended[t - 1][world]] for world in range(4)] == [[10], [5], [2, 12], [1, 11]]
    assert env.read_statistics()["episode_length"] == pytest.approx((10 + 5 + 2 + 10 + 1 + 10) / 6)  # steps truly made


def test_a_fall_in_the_last_step_is_no_time_out(quiet: LeggedRobot) -> None:
    run_a_while(quiet, 3)
    quiet.read_statistics()
    quiet.episode_length_buf = torch.full((N,), 999)
    roll_by(quiet, [0.0, 180.0])
    quiet.sim.qvel[2, 7] = math.nan
    _, _, done, extras = quiet.step(torch.zeros(N, 12))
    assert done.all() and extras["time_outs"].tolist() == [True, False, False] + [True] * 7
    stats = quiet.read_statistics()
    assert (stats["episodes"], stats["fell"], stats["broken"]) == (N, 1, 1)


def _put(name: str, index: tuple[int, ...], value: float) -> Callable[[LeggedRobot, Tensor], None]:
    return lambda env, actions: getattr(env.sim, name).__setitem__(index, value)


# A lone NaN in the attitude is not among them: the simulator normalizes it away, and the state is finite after the step.
BREAKS: dict[str, Callable[[LeggedRobot, Tensor], None]] = {
    "qpos nan": _put("qpos", (3, 0), math.nan),
    "joint nan": _put("qpos", (3, 12), math.nan),
    "qpos inf": _put("qpos", (3, 1), math.inf),
    "qvel nan": _put("qvel", (3, 17), math.nan),
    "qvel inf": _put("qvel", (3, 2), -math.inf),
    "base too fast": _put("qvel", (3, 0), -2.0e4),
    "base spins too fast": _put("qvel", (3, 5), 2.0e4),
    "joint too fast": _put("qvel", (3, 9), 1.0e7),
    "force nan": _put("xfrc_applied", (3, 1, 2), math.nan),
    "action nan": lambda env, actions: actions.__setitem__((3, 4), math.nan),
}


@pytest.mark.parametrize("hurt", BREAKS.values(), ids=BREAKS)
def test_a_broken_world_is_reset_alone(quiet: LeggedRobot, hurt: Callable[[LeggedRobot, Tensor], None]) -> None:
    """Done and not a time out, no reward, counted once; nothing of it in the next step; the others as if it had not been."""
    env, runs, others = quiet, [], torch.arange(N) != 3
    for healthy in (True, False):
        run_a_while(env, 5)
        env.read_statistics()
        actions = [act(env, 0.5) for _ in range(3)]
        if not healthy:
            hurt(env, actions[0])
        runs.append([env.step(action) for action in actions])
        if not healthy:
            obs, reward, done, extras = runs[1][0]
            assert done.tolist() == (~others).tolist() and not extras["time_outs"].any() and reward[3].item() == 0.0
            assert env.episode_length_buf.tolist() == [8, 8, 8, 2, 8, 8, 8, 8, 8, 8]
            for value in tensors(env).values():
                assert torch.isfinite(value).all()
            stats = env.read_statistics()
            assert (stats["episodes"], stats["broken"], stats["fell"], stats["episode_length"]) == (1, 1, 0, 6)
            assert all(math.isfinite(value) for value in stats.values())
    for (obs, reward, done, _), (obs_2, reward_2, done_2, _) in zip(*runs, strict=True):
        for group in ("state", "privileged_state"):
            assert torch.isfinite(obs_2[group]).all()
            assert same(obs[group][others], obs_2[group][others])
        assert same(reward[others], reward_2[others]) and same(done[others], done_2[others])


def test_statistics_by_hand() -> None:
    """Means over the two episodes that ended, counts of all worlds, and present values, some divided by their count."""
    statistics = Statistics(["length"], ["episodes", "fell"], "cpu")
    ended, counts = torch.tensor([True, False, True]), torch.tensor([[1.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    statistics.add(ended, torch.tensor([[1.0], [math.nan], [4.0]]), counts)
    live = {"speed": torch.tensor(2.5), "level": torch.tensor([6.0, 3.0]), "unseen": torch.zeros(2)}
    taken = statistics.take(live).tolist()
    assert taken == [5.0, 2.0, 1.0, 2.5, 6.0, 3.0, 0.0, 0.0]
    assert statistics.name(taken) == {"length": 2.5, "episodes": 2.0, "fell": 1.0, "speed": 2.5, "level": 2.0}
    nothing = statistics.name(statistics.take({}).tolist())
    assert math.isnan(nothing["length"]) and (nothing["episodes"], nothing["fell"]) == (0.0, 0.0)


def test_bad_values_become_zero_and_are_counted_by_column() -> None:
    values = torch.tensor([[1.0, math.nan], [-BOUND, -math.inf], [1.1 * BOUND, 2.0]])
    bad = NonFinite(["one", "two"], "cpu")
    bad.clear(values)
    assert values.tolist() == [[1.0, 0.0], [-BOUND, 0.0], [0.0, 2.0]]
    assert bad.take().tolist() == [1.0, 2.0] and bad.take().tolist() == [0.0, 0.0]


def test_fast_but_not_too_fast_is_not_broken() -> None:
    env = make_env(3, {**QUIET, "termination.max_speed": 50.0})
    env.sim.qvel[:, 0] = torch.tensor([49.9, 50.1, -50.1])
    env.check_termination()
    assert env.broken.tolist() == env.reset_buf.tolist() == [False, True, True]
    assert not env.fell.any()


def test_infinite_actions_are_clipped(quiet: LeggedRobot) -> None:
    run_a_while(quiet, 2)
    obs, _, done, _ = quiet.step(torch.full((N, 12), math.inf))
    assert not done.any() and (obs["state"][:, 33:45] == 2.0).all()


def test_actions_with_gradients_leave_the_buffers_without(quiet: LeggedRobot) -> None:
    actions = torch.zeros(N, 12, requires_grad=True)
    quiet.step(actions * 2.0)
    obs, *_ = quiet.step(torch.zeros(N, 12))
    assert not quiet.actions.requires_grad and not obs["state"].requires_grad


def test_model_says_what_the_config_changed(quiet: LeggedRobot) -> None:
    notes = "\n".join(quiet.robot.overrides)
    for line in ("option timestep: 0.002 -> 0.004", "option iterations: 100 -> 1", "option ls_iterations: 50 -> 5"):
        assert line in notes
    assert (
        "ground: plane, friction 0.6, condim 3, priority 1" in notes
        and "keyframe 'home' read: pose and height of the root" in notes
    )


def test_camera_looks_at_the_robot_and_is_not_stepped(quiet: LeggedRobot) -> None:
    import mujoco

    from legged_mw.drawing.scene import visual_model

    visual = visual_model(quiet.robot, quiet.cfg.viewer.camera)
    data = mujoco.MjData(visual)
    mujoco.mj_forward(visual, data)
    camera = visual.camera("track").id
    to_robot = data.subtree_com[quiet.root_body] - data.cam_xpos[camera]
    looking = -data.cam_xmat[camera].reshape(3, 3)[:, 2]
    assert to_robot @ looking > 0.99 * (to_robot @ to_robot) ** 0.5
    assert quiet.robot.physics.ncam == 0 and quiet.robot.physics.nlight == 0


@pytest.mark.parametrize(
    ("foot_geoms", "felt"),
    [
        ({"left": ["left_*"], "right": ["right_*"]}, [False, True]),
        ({"left": ["left_toe"], "right": ["left_toe", "right_*"]}, [False, True]),
        ({"left": ["right_heel"], "right": ["right_heel"]}, [True, True]),
        ({"left": ["right_heel"], "right": ["left_toe"]}, [True, False]),
    ],
)
def test_a_foot_feels_all_of_its_geoms(foot_geoms: dict[str, list[str]], felt: list[bool]) -> None:
    task = load_task(str(ROOT / "examples" / "toy_biped.py"))
    task.cfg.env.num_envs = 2
    task.set("asset.foot_geoms", foot_geoms)
    env = LeggedRobot(task.cfg, "cpu")
    env.contact_count.zero_()
    env.contact_count[1, env.robot.contact_geoms.index("right_heel")] = 1.0
    env._update_state()
    assert env.foot_contact.tolist() == [[False, False], felt]
    assert all("*" not in geom for geoms in env.foot_geoms.values() for geom in geoms)
