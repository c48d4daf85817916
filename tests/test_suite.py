"""What holds for every task in configs/ and examples/, on one file: it builds, steps, resets, mirrors, exports, and deploys as it trained.

What a task does of its own is tested elsewhere. A new task file is tested here without a word.
"""

from __future__ import annotations

import math
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from torch import Tensor, nn
from worlds import changed, same, snapshot, tensors

from legged_mw import ROOT
from legged_mw.check.guard import check_recordable
from legged_mw.check.recordable import recordable
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.stage import DeployStage
from legged_mw.export import exporter as exporting
from legged_mw.export.exporter import Exported, export
from legged_mw.rl.policies import act, load_policy
from legged_mw.rl.ppo import mirror
from legged_mw.rl.runner import make_runner
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import ModelError
from legged_mw.utils.task import LoadedTask, load_task, task_names

# the numbers or the robot of others: built in test_skills, or shipped and tested in test_shipped
VARIANTS = {
    *("go2_getup", "g1_getup", "go1_footstand", "go2_handstand", "go2_footstand"),
    *("go1_flat_dr", "go1_rough", "go2_rough_scan", "g1_rough"),
}
EXAMPLES = [str(path) for path in sorted(ROOT.glob("examples/*.py")) if "TASK = " in path.read_text()]
N = 10  # no other tensor has as many rows, so that a first dimension of 10 means worlds
TINY = {  # of a task on rough ground, and of one that begins in falls
    "falls.states": 4,
    "terrain.num_rows": 2,
    "terrain.num_cols": 2,
    "terrain.border_size": 1.0,
    "terrain.terrain_proportions": {"stairs_up": 1.0, "flat": 1.0},
    "terrain.max_init_terrain_level": 1,
}
KICKS = {"perturbation.kick": True, "perturbation.interval": [0.02, 0.1], "perturbation.duration": [0.06, 0.2]}
STRIPPED = {"noise.level": 0.0, "commands.resampling_time": 0.0, "rewards.only_positive_rewards": False}
NOMINAL = {  # the robot as its contract states it
    **STRIPPED,
    "terrain.mesh_type": "plane",
    "domain_rand.enable": False,
    "perturbation.kick": False,
    "perturbation.push": False,
    "gait.random_start": False,
    "falls.pull": 0.0,
    "falls.share": 0.0,  # the many contacts of a robot that lies make much of rounding
    "motion.random_start": False,
    "motion.start_turn": [0.0, 0.0, 0.0],  # a deployed robot has the heading of its motion as it begins
    "motion.start_joints": 0.0,
}


def small(name: str, changes: dict[str, Any] | None = None, worlds: int = N) -> LoadedTask:
    """The task in a few worlds; of ``changes``, by dotted path, those whose field it has."""
    task = load_task(name)
    fields = task.to_dict()
    for path, value in {
        "env.num_envs": worlds,
        "sim.engine": "mujoco",
        "sim.threads": 1,
        **TINY,
        **(changes or {}),
    }.items():
        section, field = path.split(".")
        if field in fields.get(section, {}):
            task.set(path, value)
    return task


def build(name: str, changes: dict[str, Any] | None = None, worlds: int = N) -> Any:
    """Its environment, always from the same seed."""
    task = small(name, changes, worlds)
    torch.manual_seed(0)
    return task.env_class(task.cfg, "cpu")


def random_actions(env: Any, scale: float = 1.0) -> Tensor:
    return torch.randn(env.num_envs, env.num_actions) * scale


@pytest.fixture(
    scope="module",
    params=[name for name in (*task_names(), *EXAMPLES) if name not in VARIANTS],
    ids=lambda name: Path(name).stem,
)
def name(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def env(name: str) -> Any:
    """With kicks every few steps."""
    return build(name, KICKS)


# ---- the step


def test_passes_the_guard_and_nothing_is_changed(name: str) -> None:
    task = load_task(name)
    before, threads = task.to_dict(), torch.get_num_threads()
    states = torch.get_rng_state(), random.getstate(), np.random.get_state(legacy=False)["state"]["key"]
    assert check_recordable(task) == ""  # a resumed run has all that a step writes
    assert task.to_dict() == before and torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), states[0]) and random.getstate() == states[1]
    assert np.array_equal(np.random.get_state(legacy=False)["state"]["key"], states[2])


def test_whole_step_asks_the_host_nothing(name: str) -> None:
    check_whole_step(name, {})


@pytest.mark.parametrize("task", ["go1_flat", "g1_track"])
def test_nor_does_it_with_kicks_and_without_noise_resampling_and_clip(task: str) -> None:
    check_whole_step(task, {**KICKS, **STRIPPED})


def check_whole_step(name: str, changes: dict[str, Any]) -> None:
    """On the engine of a GPU, so that physics is looked at, too."""
    # all its shapes would compile for a minute
    feet = {"asset.colliders": ["FR", "FL", "RR", "RL"]} if name == "go1_getup" else {}
    env = build(name, {**changes, **feet, "sim.engine": "mujoco_warp"}, worlds=4)
    env.sim.qpos[1] = math.nan
    env.episode_length_buf = torch.tensor([0, 0, env.max_episode_length, 0])
    for _ in range(2):
        env.actions.copy_(random_actions(env))
        with recordable():
            env._step()
        assert env.reset_buf.tolist() == [False, True, True, False] or not env.reset_buf.any()


def test_steps_are_finite_whatever_the_actions(env: Any) -> None:
    torch.manual_seed(1)
    env.reset()
    env.episode_length_buf = torch.full((N,), env.max_episode_length - 50)  # who does not fall runs out of time
    resets = 0
    for _ in range(60):
        obs, rewards, dones, extras = env.step(random_actions(env, 3.0))
        for group, rows in env.observations.groups.items():
            assert obs[group].shape == (N, sum(row.size for row in rows)) and obs[group].isfinite().all(), group
        assert rewards.shape == dones.shape == extras["time_outs"].shape == (N,) and rewards.isfinite().all()
        assert not env.broken.any()
        resets += int(dones.sum())
    assert env.sim.qpos.isfinite().all() and env.sim.qpos.std(dim=0)[7:].all()
    assert resets > 0 and env.read_statistics()["episodes"] == resets


def test_buffers_are_never_rebound(env: Any) -> None:
    """A CUDA graph keeps addresses: each tensor is the same object at the same address after steps with resets of all kinds."""
    before = tensors(env)
    assert {
        "env.actions",
        "env.rew_buf",
        "env.obs_buf.state",
        "env.observations._parts.state._noise",
        "env._episode",
        "sim.qpos",
    } <= before.keys()
    addresses = {name: (tensor.data_ptr(), tensor.shape, tensor.stride()) for name, tensor in before.items()}
    env.reset()
    for t in range(5):
        if t == 2:
            env.sim.qvel[1] = math.nan
            env.episode_length_buf = torch.tensor([env.max_episode_length, *range(5, N + 4)])
        dones = env.step(random_actions(env))[2]
        assert dones[:2].all() or t != 2
    env.reset()
    env.read_statistics()
    after = tensors(env)
    assert after.keys() == before.keys()
    assert [name for name in before if after[name] is not before[name]] == []
    assert [
        name for name in before if addresses[name] != (after[name].data_ptr(), after[name].shape, after[name].stride())
    ] == []


def test_no_buffer_takes_the_name_of_another(env: Any) -> None:
    """A class that gives its own buffer a parent's name gets what the parent writes into it."""
    assert [name for name in env.remembered() if name.partition(" ")[2].isdigit()] == []


# ---- resets


def test_restart_touches_the_masked_worlds_only(env: Any) -> None:
    torch.manual_seed(2)
    env.reset()
    for _ in range(20):
        env.step(random_actions(env, 0.3))
    mask = torch.arange(N) % 3 == 0
    before = snapshot(env)
    env.restart(mask)
    of_all = {"env.command_curriculum"}  # counts the episodes of all worlds
    assert set(changed(env, before, worlds=~mask)) <= of_all
    touched = {
        "sim.qpos",
        "sim.qvel",
        "sim.ctrl",
        "sim.sensordata",
        "env._episode",
        "env._episode_length_buf",
        "env.base_lin_vel",
    }
    assert touched <= set(changed(env, before, worlds=mask))
    assert {f"env.obs_buf.{group}" for group in env.obs_buf} <= set(changed(env, before, worlds=mask))


def live_on(name: str, way: str = "") -> dict[str, Tensor]:
    """State and observations 5 steps after a reset of every third world; without a ``way`` none is reset."""
    env = build(name, {"noise.level": 0.0})
    for _ in range(10):
        env.step(random_actions(env, 0.3))
    if way:
        getattr(env, way)(torch.arange(N) % 3 == 0)
    for step in range(5):
        torch.manual_seed(step)  # on a CPU the end of an episode draws numbers, and without one none are drawn
        obs = env.step(random_actions(env, 0.3))[0]
    state = {key: getattr(env.sim, key).clone() for key in ("qpos", "qvel", "sensordata", "actuator_force")}
    return {**state, **{group: obs[group] for group in env.obs_buf}}


@pytest.fixture(scope="module")
def undisturbed(name: str) -> dict[str, Tensor]:
    return live_on(name)


@pytest.mark.parametrize("way", ["reset_envs", "restart"])
def test_neighbours_of_a_reset_world_live_on_as_without_it(name: str, way: str, undisturbed: dict[str, Tensor]) -> None:
    """What no tensor shows (warm start, contacts, delays): the other worlds' next steps are the same with and without a reset."""
    mask, disturbed = torch.arange(N) % 3 == 0, live_on(name, way)
    for key, alone in undisturbed.items():
        assert same(alone[~mask], disturbed[key][~mask]), key
        assert not same(alone[mask], disturbed[key][mask]), key


# ---- left and right


def test_mirroring_twice_is_the_identity(name: str, env: Any) -> None:
    """A robot without a mirror image says so, and learns without one."""
    symmetry = load_task(name).train.symmetry
    try:
        _ = env.mirror
    except (ConfigError, ModelError) as error:
        assert "symmetry.use_data_augmentation = False" in str(error) or "do without what mirrors the robot" in str(
            error
        )
        assert not symmetry.use_data_augmentation and not symmetry.use_mirror_loss
        return
    torch.manual_seed(3)
    obs = TensorDict({group: torch.randn(5, value.shape[1]) for group, value in env.obs_buf.items()}, batch_size=[5])
    actions = torch.randn(5, env.num_actions)
    both, both_actions = mirror(env, obs, actions)
    assert both is not None and both_actions is not None
    image, image_actions = both[5:], both_actions[5:]
    twice, twice_actions = mirror(env, image, image_actions)
    assert twice is not None and twice_actions is not None
    for group in env.obs_buf:
        assert torch.equal(both[group][:5], obs[group]) and torch.allclose(twice[group][5:], obs[group], atol=1e-6)
        assert not torch.equal(image[group], obs[group])
    assert torch.equal(both_actions[:5], actions) and torch.equal(twice_actions[5:], actions)
    assert not torch.equal(image_actions, actions)


# ---- the export, and deploy


class Made(NamedTuple):
    """An export of the task's untrained policy."""

    task: LoadedTask
    checkpoint: Path
    folder: Path
    exported: Exported


@pytest.fixture(scope="module")
def onnx_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Networks of the same weights are traced once: it takes seconds, and most tasks here have the same network."""
    traced: dict[bytes, Path] = {}
    save, folder = exporting.save_onnx, tmp_path_factory.mktemp("onnx")

    def save_once(policy: MLPModel, clip_actions: float, path: Path) -> None:
        weights = nn.utils.parameters_to_vector([value.float() for value in policy.state_dict().values()])
        key = repr((policy, clip_actions)).encode() + weights.numpy().tobytes()
        if key not in traced:
            traced[key] = folder / f"{len(traced)}.onnx"
            save(policy, clip_actions, traced[key])
        shutil.copy(traced[key], path)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "save_onnx", save_once)
        yield


@pytest.fixture(scope="module")
def made(name: str, onnx_once: None, tmp_path_factory: pytest.TempPathFactory) -> Made:
    task, root = small(name), tmp_path_factory.mktemp("made")
    env = task.env_class(task.cfg, "cpu")
    torch.manual_seed(0)
    make_runner(env, task.train, None, "cpu").save(str(root / "model_0.pt"))
    return Made(task, root / "model_0.pt", root / "export", export(task, root / "model_0.pt", root / "export"))


def test_export_states_what_the_policy_sees(made: Made, env: Any) -> None:
    assert made.exported.unknown == () and made.exported.observations > 0 and made.exported.gap < 1e-4
    contract = read_contract(made.folder)
    assert contract.task == made.task.name and contract.joints == env.robot.joint_names
    assert contract.size == sum(env.obs_buf[group].shape[1] for group in made.task.train.obs_groups.actor)
    assert [command.name for command in contract.commands] == [command.name for command in env.command_table]
    assert tuple(contract.feet) == tuple(getattr(env, "foot_names", ()))


def test_deployed_it_acts_and_moves_as_in_its_environment(name: str, made: Made, tmp_path: Path) -> None:
    """From the same state, each in its own physics: the same observations, joint targets and motion, to float32's rounding.

    The contract and the network alone, without the scene, know the targets that the servos obey: those are held within their range.
    """
    task = small(name, NOMINAL, worlds=4)
    torch.manual_seed(6)  # so that no part of a G1 hits another, where the convex collider makes much of rounding
    env = task.env_class(task.cfg, "cpu")
    policy, stage = load_policy(made.checkpoint, env, task.train, "cpu"), DeployStage(made.folder, 4, threads=1)
    stage.fleet.qpos[:], stage.fleet.qvel[:] = env.sim.qpos.numpy(), env.sim.qvel.numpy()
    stage.fleet.refresh()
    stage.measured, obs = stage.fleet.read(), env.get_observations()
    for file in ("policy.yaml", "policy.onnx") + ("scene.xml", "motion.npz") * (stage.contract.motion is not None):
        shutil.copy(made.folder / file, tmp_path)
    alone, physics = Controller(tmp_path, read_contract(tmp_path), 4), env.robot.physics
    obeyed = np.where(physics.actuator_ctrllimited[:, None] > 0, physics.actuator_ctrlrange, [-np.inf, np.inf]).T
    for _ in range(8):
        commands = env.commands.numpy().copy() if env.command_table else np.zeros((4, 0))
        seen = np.concatenate([obs[group].numpy() for group in task.train.obs_groups.actor], axis=1)
        np.testing.assert_allclose(stage.controller.observe(stage.measured, commands), seen, atol=1e-3)
        obs, _, dones, _ = env.step(act(policy, obs))
        targets = alone.act(stage.measured, commands)
        stage.step(commands)
        np.testing.assert_allclose(targets, np.clip(env.actuators.targets.numpy(), *obeyed), atol=1e-4)
        assert not dones.any() and not stage.fell().any()
        np.testing.assert_allclose(stage.controller.last_targets, env.actuators.targets.numpy(), atol=1e-4)
        np.testing.assert_allclose(stage.qpos(), env.sim.qpos.numpy(), atol=1e-4)
    assert np.abs(stage.controller.last_targets - stage.contract.default_pose).max() > 1e-3  # it does act
