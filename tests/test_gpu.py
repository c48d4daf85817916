"""What only a GPU can show: a replayed step is the eager step, and it asks the host nothing."""

from __future__ import annotations

import gc
import math
from collections.abc import Iterator
from pathlib import Path

import pytest
import test_distillation as distilling
import torch
from learner import apart, collect, difference, make, observations, parameters, share_experience, take_over
from mujoco_warp import DisableBit
from rsl_rl.algorithms import PPO, Distillation
from test_forces import SCALES, SETTINGS
from test_motors import CURVE, Springs, mlp, save
from test_ppo import VARIANTS, update
from test_recurrent import IMAGES, NETWORKS, share_memory

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.snapshot import take_snapshot
from legged_mw.eval.rollout import TrainingExam
from legged_mw.rl.learner_config import LeggedRobotCfgPPO
from legged_mw.rl.policies import PolicySource, Trained, attach_teacher_observations
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.runner import make_runner
from legged_mw.rl.students.distillation import GraphedDistillation
from legged_mw.rl.students.recurrent import memory_of
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.task import load_task

pytestmark = pytest.mark.gpu
DEVICE = "cuda:0"


def make_env(eager: bool, task_name: str = "go1_flat", **overrides: object) -> LeggedRobot:
    task = load_task(task_name)
    task.set("env.num_envs", 64)
    task.set("perturbation.kick", False)
    for path, value in overrides.items():
        task.set(path.replace("__", "."), value)
    torch.manual_seed(3)
    return task.env_class(task.cfg, DEVICE, eager=eager)


def without_constraints(env: LeggedRobot) -> LeggedRobot:
    """Physics that repeats bit for bit: mujoco-warp 4.0.0 orders constraint rows by an atomic counter, in any mode."""
    env.sim._model.opt.disableflags |= DisableBit.CONSTRAINT
    return env


def roll_out(env: LeggedRobot, actions: torch.Tensor) -> list[torch.Tensor]:
    torch.manual_seed(5)
    out = []
    for action in actions:
        obs, reward, done, extras = env.step(action)
        out += [obs["state"], obs["privileged_state"], reward, done, extras["time_outs"]]
    return out


RANDOMIZED: dict[str, object] = {
    "domain_rand__enable": True,
    "domain_rand__stiffness": [0.8, 1.2],
    "domain_rand__strength": [0.9, 1.1],
    "domain_rand__action_delay": [0, 2],
    "domain_rand__observation_delay": [0, 1],
    "domain_rand__observe": True,
    "perturbation__push": True,
    "perturbation__push_interval_s": 0.3,
}


ROUGH: dict[str, object] = {
    **RANDOMIZED,
    "terrain__mesh_type": "heightfield",
    "terrain__num_rows": 3,
    "terrain__num_cols": 8,
    "terrain__max_init_terrain_level": 2,
    "terrain__height_scan": ["state", "privileged_state"],
    "terrain__border_size": 1.0,
    "termination__min_base_height": 0.1,
    "commands__curriculum": True,
    "commands__end_probability": 0.2,
    "rewards__tracking_sigma_growth": {"stairs_up": 0.1},
    "sim__njmax": 56,
}


BIPED: dict[str, object] = {
    **{
        f"rewards__scales__{name}": 0.1
        for name in ("base_height", "dof_vel", "hip_pos", "single_stance", "contact_phase", "no_fly")
    },
    "rewards__base_height_target": 0.78,
    "rewards__hip_joints": ["hip_roll", "hip_yaw"],
    "rewards__torques_as": "squares",
    "init_state__dof_pos_offset": [-0.1, 0.1],
    "init_state__dof_vel_range": 0.5,
    "sim__integrator": "implicitfast",
    "commands__resampling_time": 0.4,
}

FORCES: dict[str, object] = {
    **{f"rewards__scales__{name}": scale for name, scale in SCALES.items()},
    **{name.replace(".", "__"): value for name, value in SETTINGS.items()},
    "observations__contact_forces": True,
}


@pytest.mark.parametrize(
    ("task", "settings"),
    [
        ("go1_flat", {}),
        ("go1_flat", RANDOMIZED),
        ("go1_flat", ROUGH),
        ("go1_flat", FORCES),
        ("go2_flat", {}),
        ("g1_flat", BIPED),
        ("g1_12dof_flat", {}),
        ("g1_rough", {}),
        ("go1_getup", {}),
        ("g1_getup", {}),
        ("go1_handstand", {}),
        ("g1_track", {"motion__hold_s": 0.1}),
    ],
    ids=[
        *("nominal", "randomized", "rough", "forces", "go2", "biped", "held joints", "biped on rough ground"),
        *("falls", "falls of a biped, lifted", "handstand", "a motion"),
    ],
)
def test_replay_equals_eager_over_100_steps(task: str, settings: dict[str, object]) -> None:
    """Bit for bit, with noise, kicks, falls, time outs and resets: the same random numbers are drawn in both."""
    overrides = {"perturbation__kick": True, "env__episode_length_s": 1.0, "termination__max_tilt": 10.0, **settings}
    eager, recorded = (without_constraints(make_env(eager, task, **overrides)) for eager in (True, False))
    actions = torch.randn(100, 64, eager.num_actions, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    expected, got = roll_out(eager, actions), roll_out(recorded, actions)
    assert recorded._graph.recorded and not eager._graph.recorded
    assert any(done.any() for done in expected[3::5])
    for i, (a, b) in enumerate(zip(expected, got, strict=True)):
        assert torch.equal(a, b), (
            f"step {i // 5}, output {i % 5}: largest difference {(a.float() - b.float()).abs().max():g}"
        )


@pytest.mark.parametrize("law", ["servo", "dc_motor", "speed", "torque", "network", "own"])
def test_motors_replay_as_they_run_eager(law: str, tmp_path: Path) -> None:
    """Bit for bit, delayed by 0 to 30 ms, with drawn gains and curves, and episodes that end."""
    net = save(mlp(torque_scale=20.0)[1], tmp_path)
    drawn = {
        f"domain_rand.{name}": [0.8, 1.2]
        for name in ("stiffness", "damping", "strength", "stall_torque", "no_load_speed")
    }
    fields: dict[str, object] = {**CURVE, **drawn, "domain_rand.enable": True, "domain_rand.delay_ms": [0.0, 30.0]}
    fields |= {
        "control.actuator": "servo" if law == "own" else law,
        "control.network": net,
        "env.episode_length_s": 0.5,
    }
    fields |= {"control.action_scale": 5.0} if law in ("torque", "speed") else {}
    if law == "speed":
        law, fields = "dc_motor", fields | {"control.actuator": "dc_motor", "control.action_origin": "speed"}
    task = load_task("go1_flat")
    for path, value in {"env.num_envs": 64, **fields}.items():
        task.set(path, value)
    outs = []
    for eager in (True, False):
        torch.manual_seed(3)
        env = without_constraints((Springs if law == "own" else task.env_class)(task.cfg, DEVICE, eager=eager))
        actions = torch.randn(60, 64, 12, generator=torch.Generator().manual_seed(0)).to(DEVICE)
        outs.append(roll_out(env, actions))
        assert env._graph.recorded != eager and env.actuators.law == law
    for i, (a, b) in enumerate(zip(*outs, strict=True)):
        assert torch.equal(a, b), (
            f"step {i // 5}, output {i % 5}: largest difference {(a.float() - b.float()).abs().max():g}"
        )


def test_rough_ground_trains_without_overflow_and_resumes_on_its_levels(tmp_path: Path) -> None:
    task = load_task("go1_rough")
    for path, value in {"env.num_envs": 256, "runner.num_steps_per_env": 8, "terrain.num_cols": 8}.items():
        task.set(path, value)
    env = task.env_class(task.cfg, DEVICE)
    runner = make_runner(env, task.train, None, DEVICE)
    runner.learn(6, init_at_random_ep_len=True)
    assert float(env.sim.overflowed_worlds()) == 0.0 and env.tiles
    levels = torch.arange(256, device=DEVICE) % 7
    env.tiles.put(levels)
    runner.save(str(tmp_path / "model_6.pt"))
    other = task.env_class(task.cfg, DEVICE)
    again = make_runner(other, task.train, None, DEVICE)
    again.load(str(tmp_path / "model_6.pt"))
    assert other.tiles and torch.equal(other.tiles.levels, levels)
    again.learn(1, init_at_random_ep_len=False)


def test_worlds_are_drawn_anew_under_a_recorded_step() -> None:
    """What the recording reads is written in place, the constants that masses feed too."""
    env = make_env(eager=False, **RANDOMIZED)
    actions = torch.zeros(64, 12, device=DEVICE)
    for _ in range(5):
        env.step(actions)
    mass = env.sim.field("body_mass").clone()
    env.domain_rand.redraw()
    _, reward, _, _ = env.step(actions)
    assert env._graph.recorded and not torch.equal(env.sim.field("body_mass"), mass) and torch.isfinite(reward).all()
    subtree = torch.as_tensor(env.sim._model.body_subtreemass.numpy()[:, 0])
    torch.testing.assert_close(subtree, env.sim.field("body_mass").sum(dim=1).cpu(), rtol=1e-5, atol=0)


def test_replay_equals_eager_with_contacts() -> None:
    """Real physics, where two eager runs differ in the last bit too: after 8 steps all but a few values agree."""
    actions = 0.3 * torch.randn(8, 64, 12, generator=torch.Generator().manual_seed(0)).to(DEVICE)
    expected, got = roll_out(make_env(True), actions), roll_out(make_env(False), actions)
    for a, b in zip(expected[0::5], got[0::5], strict=True):
        assert torch.quantile((a - b).abs(), 0.99) < 1e-3


def test_feet_carry_the_weight() -> None:
    """Forces of a recorded step, with what terms and the critic read of them."""
    still = {f"init_state__{name}": 0.0 for name in ("lin_vel_range", "ang_vel_range")}
    env = make_env(eager=False, **FORCES, **still)
    for _ in range(100):
        env.step(torch.zeros(64, 12, device=DEVICE))
    weight = 9.81 * env.total_mass
    assert env._graph.recorded and (env.contact_forces.sum(dim=1)[:, 2] - weight).abs().max() < 0.02 * weight
    seen = env.obs_buf["privileged_state"][:, env.observations.span("privileged_state", "contact_forces")]
    torch.testing.assert_close(100.0 * seen, env.contact_forces.flatten(1))


def test_step_never_waits_for_the_host() -> None:
    env = make_env(eager=False)
    actions = torch.randn(64, 12, device=DEVICE)
    for _ in range(5):
        env.step(actions)
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(5):
            env.step(actions)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_eager_step_asks_the_host_nothing_either() -> None:
    """Catches a host read that a capture would have refused with a poorer message."""
    env = make_env(eager=True)
    actions = torch.randn(64, 12, device=DEVICE)
    for _ in range(3):
        env.step(actions)
    torch.cuda.set_sync_debug_mode("error")
    try:
        env.step(actions)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_more_iterations_are_recorded_too() -> None:
    """4 iterations are unrolled, 20 are a conditional loop inside the graph."""
    for iterations in (4, 20):
        env = make_env(eager=False, sim__iterations=iterations)
        for _ in range(6):
            _, reward, _, _ = env.step(torch.zeros(64, 12, device=DEVICE))
        assert env._graph.recorded and torch.isfinite(reward).all()


def test_an_older_graph_that_nobody_needs_does_not_end_a_recording() -> None:
    """Only the collector frees it, and one that frees it while another is recorded ends that."""
    count = torch.zeros(4, device=DEVICE)

    def step() -> None:
        count.add_(1.0)
        assert [[] for _ in range(100_000)]  # the collector's turn comes again and again

    def recorded() -> StepGraph:
        graph = StepGraph(step, DEVICE)
        for _ in range(4):
            graph()
        return graph

    ring: list[object] = [recorded()]
    ring.append(ring)
    del ring
    assert recorded().recorded and (count == 8.0).all() and gc.isenabled()


# ---- the learner ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", VARIANTS.values(), ids=VARIANTS.keys())
def test_recorded_update_is_rsl_rls_own(settings: dict) -> None:
    """Each of six updates of 20 minibatches, the last three replayed, from equal states and the stock learner's experience."""
    stock, ours = make(PPO, DEVICE, **settings), make(GraphedPPO, DEVICE, **settings)
    assert isinstance(ours, GraphedPPO) and difference(parameters(stock), parameters(ours)) == 0.0
    for _ in six_equal_updates(stock, ours):
        assert ours.learning_rate == pytest.approx(stock.learning_rate, rel=1e-12)


def six_equal_updates(other: PPO, ours: GraphedPPO) -> Iterator[dict[str, float]]:
    """Six updates of both from equal states and the other's experience; yields our losses after each. The last three are replayed."""
    for seed in range(6):
        collect(other, DEVICE, seed=seed)
        share_experience(other, ours)
        take_over(ours, other)
        expected, got = update(other), update(ours)
        assert difference(parameters(other), parameters(ours)) < 1e-4
        assert got == pytest.approx(expected, rel=1e-3, abs=1e-5)
        yield got
    assert ours._update_graph.recorded


def test_recorded_update_in_bfloat16_learns_what_float32_does() -> None:
    """Six updates, the last three replayed, from equal states and experience; at first the policy that learns is the one that acted."""
    full, half = make(GraphedPPO, DEVICE), make(GraphedPPO, DEVICE)
    half.learn_in_half()
    for seed in range(6):
        collect(full, DEVICE, seed=seed)
        share_experience(full, half)
        take_over(half, full)
        before, expected, got = parameters(full), update(full), update(half)
        assert 0.0 < apart(before, full, half) < 0.15
        assert got == pytest.approx(expected, rel=0.05, abs=2e-3)
    assert half._update_graph.recorded and {p.dtype for p in half.actor.parameters()} == {torch.float32}
    collect(half, DEVICE)
    acted = half.storage.distribution_params[0].flatten(0, 1)
    half._share = half._size = len(acted)
    with torch.no_grad():
        learns = half._forward(half.actor, half._prepare(torch.arange(len(acted), device=DEVICE)).actor_input)
    assert half._act_graph.recorded and (learns - acted).norm() < 5e-3 * acted.norm()


@pytest.mark.parametrize("loss", ["estimate", "student"])
@pytest.mark.parametrize("settings", [{}, VARIANTS["symmetric samples"]], ids=["plain", "mirrored"])
def test_recorded_estimator_learns_as_step_by_step(settings: dict, loss: str) -> None:
    """Six updates, the last three replayed, beside a learner that records none, from equal states and experience."""
    network: dict = {"estimator": {}} if loss == "estimate" else {"concurrent": {}}
    eager, ours = (make(GraphedPPO, DEVICE, **network, **settings) for _ in range(2))
    eager._update_graph = StepGraph(eager._update, DEVICE, eager=True)
    for got in six_equal_updates(eager, ours):
        assert got[loss] > 0.0
    assert not eager._update_graph.recorded


@pytest.mark.parametrize("memory", NETWORKS.values(), ids=NETWORKS.keys())
def test_recorded_recurrent_update_is_rsl_rls_own(memory: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """As above; cuDNN multiplies in float32, and worlds come in their order."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    monkeypatch.setattr(torch, "randperm", lambda count, out: out.copy_(torch.arange(count, device=out.device)))
    stock, ours = make(PPO, DEVICE, memory=memory), make(GraphedPPO, DEVICE, memory=memory)
    for seed in range(6):
        collect(stock, DEVICE, seed=seed)
        share_experience(stock, ours)
        share_memory(stock, ours)
        take_over(ours, stock)
        expected, got = update(stock), update(ours)
        assert difference(parameters(stock), parameters(ours)) < 1e-3
        assert got == pytest.approx(expected, rel=1e-3, abs=1e-5)
    assert ours._update_graph.recorded


@pytest.mark.parametrize("images", [None, IMAGES], ids=["plain", "mirrored"])
def test_recorded_acting_remembers_as_rsl_rls_networks_do(images: dict | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Four rollouts with ends of episodes and returns between, most of them replayed."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    ours = make(GraphedPPO, DEVICE, memory=NETWORKS["two layers"], symmetry_cfg=images)
    generator = torch.Generator().manual_seed(0)
    for _ in range(4):
        with torch.inference_mode():
            for _ in range(6):
                obs, ended = observations(generator, DEVICE), (torch.rand(32, generator=generator) < 0.2).to(DEVICE)
                ours.act(obs)
                for model in (ours.actor, ours.critic):
                    held = ours._memories[model].now[:, 0].transpose(0, 1)
                    model(obs)
                    torch.testing.assert_close(held, memory_of(model, 32), rtol=1e-4, atol=1e-5)
                    model.reset(ended)
                ours.process_env_step(obs, torch.randn(32, device=DEVICE), ended, {"time_outs": ended})
            kept = {model: model.get_hidden_state() for model in (ours.actor, ours.critic)}
            ours.compute_returns(obs)
        ours.storage.clear()
        for model, state in kept.items():
            model.reset(hidden_state=state)
    assert ours._act_graph.recorded and ours._returns_graph.recorded


def test_checkpoints_go_both_ways_on_a_gpu(tmp_path: Path) -> None:
    """Also from a learner that replays into one that has not recorded, and back into one that has."""
    replaying, stock, fresh = make(GraphedPPO, DEVICE), make(PPO, DEVICE), make(GraphedPPO, DEVICE)
    for seed in range(5):
        collect(replaying, DEVICE, seed=seed)
        update(replaying)
    torch.save(replaying.save(), tmp_path / "model.pt")
    for alg in (stock, fresh, replaying):
        alg.load(torch.load(tmp_path / "model.pt", map_location=DEVICE, weights_only=True), None, True)
    collect(stock, DEVICE, seed=9)
    for alg in (fresh, replaying):
        share_experience(stock, alg)
    with torch.inference_mode():
        for alg in (stock, replaying):  # each share moves the acting policy
            alg.storage.distribution_params[0].copy_(fresh.storage.distribution_params[0])
    for alg in (stock, fresh, replaying):
        update(alg)
    assert difference(parameters(stock), parameters(fresh)) < 1e-4
    assert difference(parameters(stock), parameters(replaying)) < 1e-4


@pytest.mark.parametrize("network", ["MLPModel", "RNNModel", "with an estimator", "concurrent"])
def test_iteration_never_waits_for_the_host(network: str) -> None:
    """Rollout, returns, update and the report, once everything is recorded."""
    train = small_learner()
    if network == "with an estimator":
        train.actor.estimator.targets = ["base_lin_vel", "foot_contact"]
    elif network == "concurrent":
        train.actor.concurrent.groups = ["privileged_state"]
    else:
        train.actor.class_name = train.critic.class_name = network
    runner = make_runner(make_env(eager=False), train, None, DEVICE)
    runner.learn(5)
    obs = runner.env.get_observations()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(2):
            obs = runner._rollout(obs)
            with torch.inference_mode():
                runner.alg.compute_returns(obs)
            losses = runner.alg.update()
            report = runner._report(losses, (0.0, 0.0, 0.0))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    numbers = report.message.read()
    assert all(math.isfinite(value) for value in [*numbers.losses, *numbers.learning_rate])


def test_recorded_acting_explores() -> None:
    """Replays draw new noise each time, of the std that the policy has now."""
    alg = make(GraphedPPO, DEVICE)
    obs = observations(torch.Generator().manual_seed(0), DEVICE)
    with torch.inference_mode():
        for _ in range(5):
            alg.act(obs)
        assert alg._act_graph.recorded
        alg.actor.distribution.std_param.fill_(0.25)
        drawn = torch.stack([alg.act(obs) for _ in range(200)])
    assert drawn.std(dim=0).mean().item() == pytest.approx(0.25, rel=0.05)
    assert (drawn.mean(dim=0) - alg.actor(obs)).abs().max() < 0.1


def small_learner() -> LeggedRobotCfgPPO:
    train = load_task("go1_flat").train
    train.actor.hidden_dims = train.critic.hidden_dims = [32, 32]
    return train


def test_an_exam_leaves_the_gpus_generator_as_it_was() -> None:
    """Though its environment draws random numbers inside a recorded step of its own."""
    torch.manual_seed(7)
    before = torch.cuda.get_rng_state(DEVICE)
    examine = TrainingExam(load_task("go1_flat"), DEVICE)
    found = examine(lambda obs: torch.zeros(len(obs), 12, device=DEVICE))
    assert examine.env._graph.recorded and found["falls"] == 0
    assert torch.equal(torch.cuda.get_rng_state(DEVICE), before)


# ---- teacher and student ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings", distilling.VARIANTS.values(), ids=distilling.VARIANTS.keys())
def test_recorded_distillation_is_rsl_rls_own(settings: dict, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each of six updates, the last three replayed, from equal states and the stock learner's experience; cuDNN in float32."""
    monkeypatch.setattr(torch.backends.cudnn, "allow_tf32", False)
    stock, ours = (distilling.make(kind, DEVICE, **settings) for kind in (Distillation, GraphedDistillation))
    for seed in range(6):
        distilling.collect(stock, DEVICE, seed=seed)
        distilling.share_experience(stock, ours)
        distilling.take_over(ours, stock)
        expected, got = stock.update(), ours.update()
        assert difference(distilling.parameters(stock), distilling.parameters(ours)) < (
            1e-3 if "memory" in settings else 1e-4
        )
        assert float(got["behavior"]) == pytest.approx(expected["behavior"], rel=1e-3)
    assert ours._update_graph.recorded


def test_recorded_student_acts_with_noise_beside_its_teacher() -> None:
    alg = distilling.make(GraphedDistillation, DEVICE, gradient_length=1)
    obs = observations(torch.Generator().manual_seed(0), DEVICE)
    with torch.inference_mode():
        drawn = torch.stack([alg.act(obs) for _ in range(200)])
        assert alg._act_graph.recorded
        assert drawn[5:].std(dim=0).mean().item() == pytest.approx(0.1, rel=0.05)
        torch.testing.assert_close(alg.transition.privileged_actions, alg.teacher(obs), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "networks",
    [{}, {"estimator": {}}, {"concurrent": {}}, {"memory": NETWORKS["gru"]}],
    ids=["plain", "estimator", "concurrent", "memory"],
)
def test_a_recorded_warm_up_ends(networks: dict) -> None:
    """The actor stands to the bit while the critic learns, replayed too; then both learn, recorded anew."""
    alg = make(GraphedPPO, DEVICE, **networks)
    alg.learn_critic_only(True)
    before = parameters(alg)
    for seed in range(5):
        collect(alg, DEVICE, seed=seed)
        update(alg)
    assert alg._update_graph.recorded
    warm = parameters(alg)
    assert all(torch.equal(warm[name], before[name]) for name in before if name.startswith("actor."))
    assert not torch.equal(warm["critic.mlp.0.weight"], before["critic.mlp.0.weight"])
    alg.learn_critic_only(False)
    for seed in range(5):
        collect(alg, DEVICE, seed=seed)
        update(alg)
    assert alg._update_graph.recorded and not torch.equal(
        parameters(alg)["actor.mlp.0.weight"], warm["actor.mlp.0.weight"]
    )


def test_a_students_iteration_never_waits_for_the_host() -> None:
    env, teacher = make_env(eager=False), load_task("go1_flat")
    attach_teacher_observations(env, Trained(PolicySource(Path(), Path("model_1.pt"), False), teacher))
    runner = make_runner(env, small_learner(), None, DEVICE, teacher.train)
    runner.learn(5)
    obs = env.get_observations()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(2):
            obs = runner._rollout(obs)
            report = runner._report(runner.alg.update(), (0.0, 0.0, 0.0))
    finally:
        torch.cuda.set_sync_debug_mode("default")
    numbers = report.message.read()
    assert all(math.isfinite(value) for value in [*numbers.losses, *numbers.learning_rate])


def test_a_replayed_update_is_undone_to_the_last_bit() -> None:
    """What three eager updates and one replay have learned; then one that is good is taken over."""
    alg = make(GraphedPPO, DEVICE)
    for seed in range(6):
        collect(alg, DEVICE, seed=seed)
        before = {name: value.clone() for name, value in parameters(alg).items()}
        if seed in (0, 4):
            alg.storage.rewards[1, 2] = math.nan
            alg.compute_returns(alg.storage.observations[-1])
        alg.update()
        assert bool(alg.rollback.undone) == (seed in (0, 4)) == (difference(before, parameters(alg)) == 0.0)
    assert alg._update_graph.recorded
    assert all(bool(value.isfinite().all()) for memory in alg.optimizer.state.values() for value in memory.values())


def test_a_run_goes_on_in_the_worlds_that_it_left(tmp_path: Path) -> None:
    """Their state comes back to the bit; what follows differs by mujoco-warp's sums alone."""
    task = load_task("go1_flat_dr")
    for path, value in {"env.num_envs": 64, "runner.num_steps_per_env": 8, "runner.save_interval": 2}.items():
        task.set(path, value)
    env, other = (task.env_class(task.cfg, DEVICE) for _ in range(2))
    runner = make_runner(env, task.train, tmp_path, DEVICE)
    runner.learn(6)
    kept = take_snapshot(env)
    again = make_runner(other, task.train, None, DEVICE)
    again.load(str(tmp_path / "model_6.pt"))
    restored = take_snapshot(other)
    assert again.why_not_exact == "" and all(
        torch.equal(restored[name].nan_to_num(), value.nan_to_num()) for name, value in kept.items()
    )
    again.learn(5, init_at_random_ep_len=False)
    assert again.current_learning_iteration == 11
