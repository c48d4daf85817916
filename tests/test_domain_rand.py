"""Randomized worlds: what is drawn, what it writes, what it changes, and that nothing changes where nothing is asked for."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
import torch
from torch import Tensor
from worlds import QUIET, changed, layout, make_env, same, snapshot

from legged_mw.check.recordable import recordable
from legged_mw.envs.domain_rand import KINDS, ONLY_AT_START, world_fields
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.sim.engines import make_simulation
from legged_mw.sim.model import GROUND
from legged_mw.sim.simulation import GRAVITY
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import load_task

ENGINES = ["mujoco", "mujoco_warp"]
NOTHING: dict[str, Any] = {f"domain_rand.{name}": [] for name in KINDS} | {"domain_rand.enable": True}
STILL: dict[str, Any] = {"init_state.lin_vel_range": 0.0, "init_state.ang_vel_range": 0.0, "init_state.yaw_range": 0.0}
ALL: dict[str, Any] = {
    "domain_rand.enable": True,
    "domain_rand.contact_time": [0.01, 0.03],
    "domain_rand.stiffness": [0.8, 1.2],
    "domain_rand.damping": [0.7, 1.3],
    "domain_rand.strength": [0.9, 1.1],
    "domain_rand.action_delay": [0, 2],
    "domain_rand.observation_delay": [0, 1],
    "domain_rand.slope": [0.0, 12.0],
    "domain_rand.observe": True,
}


def make(num_envs: int, engine: str = "mujoco", **ranges: list[float]) -> LeggedRobot:
    """A quiet environment that randomizes ``ranges`` and nothing else."""
    asked = {f"domain_rand.{name}": span for name, span in ranges.items()}
    return make_env(num_envs, {**QUIET, **STILL, **NOTHING, **asked, "sim.engine": engine})


def nominal(env: LeggedRobot, field: str) -> Tensor:
    return torch.tensor(getattr(env.robot.physics, field), dtype=torch.float)


def walk(env: LeggedRobot, steps: int, seed: int = 0) -> Tensor:
    """States after each of ``steps`` random actions (steps, N, nq)."""
    torch.manual_seed(seed)  # of noise and resets
    dice = torch.Generator().manual_seed(seed)
    states = []
    for _ in range(steps):
        env.step(0.5 * torch.randn(env.num_envs, env.num_actions, generator=dice))
        states.append(env.sim.qpos.clone())
    return torch.stack(states)


# ---- nothing asked for, nothing done


@pytest.mark.parametrize("engine", ENGINES)
def test_neutral_ranges_change_nothing_bit_for_bit(engine: str) -> None:
    neutral = {
        f"domain_rand.{name}": [] if kind.neutral is None else [kind.neutral] * 2 for name, kind in KINDS.items()
    }
    for name in ("action_delay", "observation_delay"):
        neutral[f"domain_rand.{name}"] = [0, 0]
    plain = make_env(4, {"sim.engine": engine})
    randomized = make_env(4, {**NOTHING, **neutral, "sim.engine": engine})
    assert world_fields(randomized.cfg) == [] and not randomized.domain_rand.values
    assert torch.equal(walk(plain, 20), walk(randomized, 20))
    assert all(same(plain.obs_buf[group], randomized.obs_buf[group]) for group in plain.obs_buf)


def test_constants_are_left_alone_where_nothing_feeds_them(monkeypatch: pytest.MonkeyPatch) -> None:
    from legged_mw.sim.mujoco_engine import MujocoSimulation

    calls: list[int] = []
    monkeypatch.setattr(MujocoSimulation, "set_constants", lambda self: calls.append(self.num_envs))
    make(2, friction=[0.4, 1.0], stiffness=[0.8, 1.2])
    assert calls == []
    make(3, armature=[1.0, 1.05])
    assert calls == [3]


# ---- what is drawn is what the model has


@pytest.mark.parametrize("engine", ENGINES)
def test_masses_inertias_and_all_that_the_model_derives_from_them(engine: str) -> None:
    env = make(4, engine, link_mass=[0.8, 1.2], base_mass=[-1.0, 1.0], base_com=[-0.05, 0.05], armature=[1.0, 1.5])
    values, model, root = env.domain_rand.values, env.robot.physics, env.root_body
    assert (
        values["link_mass"].shape == (4, 13)
        and values["base_com"].shape == (4, 3)
        and values["armature"].shape == (4, 12)
    )
    for world in range(4):
        mass = model.body_mass.copy()
        mass[1:] *= values["link_mass"][world].numpy()  # Go1: the trunk, then a body a joint, in order
        mass[root] += values["base_mass"][world].item()
        np.testing.assert_allclose(env.sim.field("body_mass")[world], mass, rtol=1e-6)
        ratio = np.divide(mass, model.body_mass, out=np.ones_like(mass), where=model.body_mass > 0)
        one = env.robot.physics.__copy__()
        one.body_mass[:], one.body_inertia[:] = mass, model.body_inertia * ratio[:, None]
        one.body_ipos[root] += values["base_com"][world].numpy()
        one.dof_armature[6:] *= values["armature"][world].numpy()
        for name in ("body_inertia", "body_ipos", "dof_armature"):
            np.testing.assert_allclose(env.sim.field(name)[world], getattr(one, name), rtol=1e-5, atol=1e-9)
        mujoco.mj_setConst(one, mujoco.MjData(one))
        for name in ("body_subtreemass", "dof_invweight0"):
            np.testing.assert_allclose(derived(env, name)[world], getattr(one, name), rtol=2e-4)
    assert len(set(derived(env, "body_subtreemass")[:, 0].tolist())) == 4


def derived(env: LeggedRobot, name: str) -> np.ndarray:
    """A constant of the model, a row a world."""
    if env.sim.engine == "mujoco":
        return np.asarray(env.sim._batch.expand(name))  # type: ignore[attr-defined]
    return getattr(env.sim._model, name).numpy()  # type: ignore[attr-defined]


@pytest.mark.parametrize("engine", ENGINES)
def test_motors_and_ground(engine: str) -> None:
    names = ("friction", "contact_time", "frictionloss", "stiffness", "damping", "strength")
    env = make(3, engine, **{name: [0.5, 1.5] for name in names})
    values, field = env.domain_rand.values, env.sim.field
    ground = env.robot.id("geom", GROUND)
    assert torch.equal(field("geom_friction")[:, ground, 0], values["friction"][:, 0])
    assert torch.equal(field("geom_solref")[:, ground, 0], values["contact_time"][:, 0])
    torch.testing.assert_close(
        field("dof_frictionloss")[:, 6:], nominal(env, "dof_frictionloss")[6:] * values["frictionloss"]
    )
    torch.testing.assert_close(field("dof_damping")[:, 6:], nominal(env, "dof_damping")[6:] * values["damping"])
    assert torch.equal(field("dof_damping")[:, :6], nominal(env, "dof_damping")[:6].expand(3, 6))
    torch.testing.assert_close(field("actuator_gainprm")[:, :, 0], 35.0 * values["stiffness"])
    torch.testing.assert_close(field("actuator_biasprm")[:, :, 1], -35.0 * values["stiffness"])
    torch.testing.assert_close(
        field("actuator_forcerange"), nominal(env, "actuator_forcerange") * values["strength"][:, :, None]
    )
    assert all(len(set(value.flatten().tolist())) == value.numel() for value in values.values()), (
        "every world and joint its own"
    )
    assert all(value.min() >= 0.5 and value.max() <= 1.5 for value in values.values())


@pytest.mark.parametrize("engine", ENGINES)
def test_a_contact_time_is_what_the_ground_has(engine: str) -> None:
    """MuJoCo takes one below two simulation steps as two: it is drawn, and shown to the critic, as what acts."""
    env = make(40, engine, contact_time=[0.001, 0.02])
    drawn, ground = env.domain_rand.values["contact_time"][:, 0], env.robot.id("geom", GROUND)
    least = 2.0 * env.cfg.sim.dt
    assert drawn.min().item() == pytest.approx(least) and drawn.max() > least
    assert torch.equal(env.sim.field("geom_solref")[:, ground, 0], drawn)
    heights = []
    for seconds in (0.001, least, 0.02):
        other = make(1, engine, contact_time=[seconds, seconds])
        for _ in range(10):
            other.step(torch.zeros(1, 12))
        heights.append(other.sim.qpos[0, 2].item())
    assert heights[0] == heights[1] and abs(heights[2] - heights[1]) > 1e-4


def test_draws_fill_their_ranges_and_whole_numbers_are_equally_likely() -> None:
    env = make(3000, friction=[0.4, 1.0], action_delay=[1, 3])
    friction, delay = env.domain_rand.values["friction"], env.domain_rand.values["action_delay"]
    assert friction.min() < 0.41 and friction.max() > 0.99 and abs(friction.mean() - 0.7) < 0.01
    shares = [(delay == d).float().mean().item() for d in (1, 2, 3)]
    assert sum(shares) == pytest.approx(1.0) and max(shares) - min(shares) < 0.06


@pytest.mark.parametrize("engine", ENGINES)
def test_a_slope_for_each_world(engine: str) -> None:
    """It is what ``terrain.slope`` is, with an angle of its own: world k falls as in an environment that is all on its slope."""
    env = make(3, engine, slope=[0.0, 12.0])
    slopes = env.domain_rand.values["slope"][:, 0]
    lean = torch.deg2rad(slopes)
    assert len({*slopes.tolist()}) == 3 and slopes.min() >= 0.0 and slopes.max() <= 12.0
    down = torch.stack([lean.sin(), torch.zeros(3), -lean.cos()], dim=1)
    torch.testing.assert_close(env.gravity_dir, down)
    torch.testing.assert_close(env.sim.field(GRAVITY), 9.81 * down)
    for _ in range(5):
        env.step(torch.zeros(3, 12))
    for world in range(3):
        other = make_env(1, {**QUIET, **STILL, **NOTHING, "sim.engine": engine, "terrain.slope": float(slopes[world])})
        for _ in range(5):
            other.step(torch.zeros(1, 12))
        torch.testing.assert_close(env.sim.qpos[world, 2:], other.sim.qpos[0, 2:], atol=1e-5, rtol=1e-4)
        torch.testing.assert_close(env.projected_gravity[world], other.projected_gravity[0], atol=1e-5, rtol=0.0)
    before = env.gravity_dir.clone()
    env.reset_envs(torch.tensor([True, False, False]))
    assert (env.gravity_dir != before).any(dim=1).tolist() == [True, False, False]


def test_any_other_field_of_the_model() -> None:
    env = make_env(3, {**NOTHING, "domain_rand.model_factors": {"geom_size": [0.9, 1.1]}})
    factor = env.domain_rand.values["geom_size"]
    torch.testing.assert_close(env.sim.field("geom_size"), nominal(env, "geom_size") * factor[:, :, None])


# ---- what it changes


@pytest.mark.parametrize("engine", ENGINES)
def test_heavier_falls_further_into_its_servos_and_weaker_too(engine: str) -> None:
    heights = []
    for name, value in (("base_mass", 0.0), ("base_mass", 4.0), ("stiffness", 0.6)):
        env = make(2, engine, **{name: [value, value]})
        for _ in range(60):
            env.step(torch.zeros(2, 12))
        heights.append(env.sim.qpos[:, 2].mean().item())
    assert heights[0] > heights[1] + 0.004 and heights[0] > heights[2] + 0.004


@pytest.mark.parametrize("engine", ENGINES)
def test_a_slide_on_lower_friction_goes_further(engine: str) -> None:
    """A box at 1 m/s on ground of a friction mu a world: v^2 / 2 mu g, by Coulomb's law."""
    box = '<body pos="0 0 .05"><freejoint/><geom type="box" size=".1 .1 .05" mass="1"/></body>'
    floor = '<geom name="floor" type="plane" size="0 0 1" priority="1"/>'
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep=".002"/><worldbody>{floor}{box}</worldbody></mujoco>'
    )
    friction = torch.tensor([0.3, 0.4, 0.6, 1.0])
    sim = make_simulation(model, 4, "cpu", engine=engine, nconmax=8, njmax=64, world_fields=["geom_friction"])
    sim.field("geom_friction")[:, 0, 0] = friction
    sim.qvel[:, 0] = 1.0
    sim.step(300)
    torch.testing.assert_close(sim.qpos[:, 0], 1.0 / (2.0 * friction * 9.81), rtol=0.05, atol=0.0)


def test_delayed_actions_reach_the_servos_that_much_later() -> None:
    env = make(6, action_delay=[0, 2])
    delay = env.domain_rand.values["action_delay"][:, 0].long()
    delay.copy_(torch.tensor([0, 1, 2, 0, 1, 2]))
    env.domain_rand.values["action_delay"][:, 0] = delay.float()
    sent = 0.1 * torch.randn(5, 6, 12)
    for step, actions in enumerate(sent):
        env.step(actions)
        for world, late in enumerate(delay.tolist()):
            expected = sent[step - late, world] if step >= late else torch.zeros(12)
            torch.testing.assert_close(env.sim.ctrl[world], env.default_dof_pos + 0.5 * expected)
        assert torch.equal(env.last_actions, actions), "the policy sees what it sent"
    env.reset_envs(torch.tensor([True] * 3 + [False] * 3))
    env.domain_rand.values["action_delay"][:, 0] = delay.float()
    env.step(sent[0])
    assert torch.equal(env.sim.ctrl[2], env.default_dof_pos), "an episode's past is not the next one's"
    torch.testing.assert_close(env.sim.ctrl[5], env.default_dof_pos + 0.5 * sent[3, 5])


def test_late_observations() -> None:
    env = make(4, observation_delay=[0, 2])
    late = [0, 1, 2, 2]
    env.domain_rand.values["observation_delay"][:, 0] = torch.tensor(late, dtype=torch.float)
    env.reset()
    env.domain_rand.values["observation_delay"][:, 0] = torch.tensor(late, dtype=torch.float)
    seen, true = [env.obs_buf["state"].clone()], [env.obs_buf["privileged_state"][:, 48:].clone()]
    for _ in range(5):
        env.step(0.2 * torch.randn(4, 12))
        seen.append(env.obs_buf["state"].clone())
        true.append(env.obs_buf["privileged_state"][:, 48:].clone())
    for step in range(1, 6):
        for world, d in enumerate(late):
            past = true[max(step - d, 0)][world]
            torch.testing.assert_close(seen[step][world, 3:6], past[:3])  # gyro
            assert torch.equal(seen[step][world, 33:45], env.last_actions[world]) or step < 5, (
                "what it sent itself is not late"
            )


def test_setting_one_world_up_anew_leaves_the_others_observations() -> None:
    """Also what is on its way to them."""
    env = make_env(3, {**NOTHING, "domain_rand.observation_delay": [2, 2]})
    walk(env, 4)
    other = make_env(3, {**NOTHING, "domain_rand.observation_delay": [2, 2]})
    walk(other, 4)
    before = env.obs_buf["state"].clone()
    env.restart(torch.tensor([False, True, False]))
    assert same(env.obs_buf["state"][::2], before[::2]) and not torch.equal(env.obs_buf["state"][1], before[1])
    measured = slice(3, 33)  # gyro, gravity, joints: noise is drawn anew, but what was measured before is on its way
    for sim in (env, other):
        sim.step(torch.zeros(3, 12))
    assert same(env.obs_buf["state"][::2, measured], other.obs_buf["state"][::2, measured])


def test_encoders_that_are_off() -> None:
    env = make(3, encoder_offset=[-0.05, 0.05])
    offset = env.domain_rand.values["encoder_offset"]
    assert offset.abs().max() > 0.01
    env.step(torch.zeros(3, 12))
    torch.testing.assert_close(env.obs_buf["state"][:, 9:21], env.dof_offset + offset)
    torch.testing.assert_close(env.sim.ctrl, env.default_dof_pos - offset)
    assert torch.equal(env.joint_reading, env.dof_offset + offset) and not torch.equal(
        env.joint_reading, env.dof_offset
    )


# ---- when


def test_a_reset_redraws_its_own_worlds_and_never_the_masses() -> None:
    env = make(4, base_mass=[-1.0, 1.0], friction=[0.4, 1.0], stiffness=[0.8, 1.2])
    before, mask = snapshot(env), torch.tensor([True, False, True, False])
    env.reset_envs(mask)
    touched = changed(env, before, mask)
    assert any("geom_friction" in name for name in touched) and any("gainprm" in name for name in touched)
    assert not any("body_mass" in name for name in touched)
    kept = [name for name in changed(env, before, ~mask) if "domain_rand" in name or "_fields" in name]
    assert kept == []


def test_drawn_once_if_the_config_says_so() -> None:
    env = make_env(4, {**QUIET, **NOTHING, "domain_rand.friction": [0.4, 1.0], "domain_rand.redraw_at_reset": []})
    before = env.domain_rand.values["friction"].clone()
    env.reset()
    assert torch.equal(env.domain_rand.values["friction"], before)
    env.domain_rand.redraw()
    assert not torch.equal(env.domain_rand.values["friction"], before)


def test_the_same_seed_draws_the_same_worlds() -> None:
    first, second = make_env(3, ALL), make_env(3, ALL)
    assert all(torch.equal(value, second.domain_rand.values[name]) for name, value in first.domain_rand.values.items())
    assert torch.equal(walk(first, 5), walk(second, 5))


# ---- the step, the critic, the mirror


def test_the_whole_step_asks_the_host_nothing_with_everything_on() -> None:
    shaken = {"perturbation.kick": True, "perturbation.push": True, "perturbation.push_interval_s": 0.04}
    env = make_env(4, {**ALL, **shaken, "sim.engine": "mujoco_warp"})
    actions = torch.zeros(4, 12)
    with recordable():
        for _ in range(3):
            env.step(actions)


def test_what_was_drawn_is_readable() -> None:
    motors = {"control.actuator": "dc_motor", "control.stall_torque": {"": 23.7}, "control.no_load_speed": {"": 30.1}}
    curves = {
        "domain_rand.stall_torque": [0.9, 1.1],
        "domain_rand.no_load_speed": [0.9, 1.1],
        "domain_rand.delay_ms": [0.0, 20.0],
    }
    env = make_env(3, {**ALL, **motors, **curves})
    table = layout(env)["privileged_state"]
    assert {name: table[name] for name in KINDS} == {name: env.domain_rand.values[name].shape[1] for name in KINDS}
    assert env.obs_buf["privileged_state"].shape[1] == 123 + sum(
        value.shape[1] for value in env.domain_rand.values.values()
    )
    friction = env.observations.span("privileged_state", "friction").start
    assert torch.equal(env.obs_buf["privileged_state"][:, friction], env.domain_rand.values["friction"][:, 0])
    twice = env.mirror.observations["privileged_state"]
    sample = torch.randn(5, env.obs_buf["privileged_state"].shape[1])
    torch.testing.assert_close(twice(twice(sample)), sample)


def test_pushes_set_the_velocity_when_their_clock_says_so() -> None:
    env = make_env(
        64,
        {**QUIET, "perturbation.push": True, "perturbation.push_interval_s": 0.2, "perturbation.max_push_vel_xy": 1.0},
    )
    assert len(set(env.perturbation._push_clock.tolist())) > 5, "each world its own clock"
    env.perturbation._push_clock.copy_(torch.arange(64) % 10 + 1.0)
    pushed = torch.zeros(64, dtype=torch.long)
    for step in range(20):
        before = env.sim.qvel[:, :2].clone()
        env.perturbation._push_robots()
        moved = (env.sim.qvel[:, :2] != before).any(dim=1)
        assert torch.equal(moved, torch.arange(64) % 10 == step % 10)
        assert env.sim.qvel[moved, :2].abs().max() <= 1.0
        pushed += moved
    assert pushed.eq(2).all()
    plain = make_env(4, QUIET)
    assert torch.equal(walk(plain, 10), walk(make_env(4, QUIET), 10)) and plain.perturbation._push_clock.eq(0).all()


def test_a_push_turns_if_it_is_told_so() -> None:
    """Each axis of the angular velocity, at the moment of the push alone; without it nothing else is drawn."""
    push = {**QUIET, "perturbation.push": True, "perturbation.push_interval_s": 0.2}
    plain, turning = (make_env(64, {**push, "perturbation.max_push_ang_vel": most}) for most in (0.0, 0.5))
    for env in (plain, turning):
        env.perturbation._push_clock.copy_(torch.arange(64) % 2 + 1.0)
        torch.manual_seed(3)
        env.sim.qvel[:, 3:6] = 0.0
        env.perturbation._push_robots()
    pushed = torch.arange(64) % 2 == 0
    assert torch.equal(plain.sim.qvel[:, :2], turning.sim.qvel[:, :2]) and not plain.sim.qvel[:, 3:6].any()
    assert turning.sim.qvel[pushed, 3:6].abs().amax(dim=0).min() > 0.3 and turning.sim.qvel[:, 3:6].abs().max() <= 0.5
    assert not turning.sim.qvel[~pushed, 3:6].any()


def test_one_field_has_one_writer_under_a_law_in_code_too() -> None:
    """The law has a torque-speed curve, though control.actuator is "servo"."""

    class Springs(LeggedRobot):
        def _compute_torques(self, actions: torch.Tensor) -> torch.Tensor:
            return super()._compute_torques(actions)

    curve = {
        "control.stall_torque": {"": 20.0},
        "control.no_load_speed": {"": 25.0},
        "domain_rand.stall_torque": [0.9, 1.1],
    }
    factor = {"domain_rand.enable": True, "domain_rand.model_factors": {"actuator_gainprm": [0.9, 1.1]}}
    with pytest.raises(
        ConfigError, match=r"model_factors.actuator_gainprm: domain_rand.stall_torque writes that field"
    ):
        make_env(2, {**curve, **factor}, env_class=Springs)


def test_the_table_and_the_config_name_the_same() -> None:
    section = load_task("go1_flat").cfg.domain_rand
    fields = {name for name in vars(type(section)) if not name.startswith("_")} - {"enable", "observe", "model_factors"}
    assert fields - {"redraw_at_reset", "redraw_iterations"} == KINDS.keys()
    assert {"link_mass", "base_mass", "base_com", "armature"} == {*ONLY_AT_START}
    assert {*section.redraw_at_reset} == KINDS.keys() - {*ONLY_AT_START}
