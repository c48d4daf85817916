"""The policies that ship: they load, both formats agree, play.py finds them, and they walk, or do what they are for."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import onnxruntime
import pytest
import torch
from program import run
from rsl_rl.models import MLPModel

from legged_mw import ROOT
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.exam import contract_skill, perform
from legged_mw.deploy.simulated import read_scene
from legged_mw.deploy.stage import DeployStage
from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval import rollout, walking
from legged_mw.export.exporter import FILES
from legged_mw.export.network import ExportedPolicy
from legged_mw.rl.policies import act, load_policy
from legged_mw.rl.run_folder import update_from_run
from legged_mw.utils.cli import seed_everything
from legged_mw.utils.config import load_yaml
from legged_mw.utils.files import digest
from legged_mw.utils.task import LoadedTask, load_task

POLICIES = sorted(path.parent for path in (ROOT / "resources/policies").glob("*/policy.onnx"))
SKILLED = [folder for folder in POLICIES if (read_contract(folder).exam or {}).get("kind")]


def test_there_are_some() -> None:
    assert {"go1_flat", "go1_rough", "go1_rough_scan"} <= {folder.name for folder in POLICIES}
    assert {"go1_getup", "go1_handstand", "go1_footstand", "g1_track"} <= {folder.name for folder in SKILLED}


def trained(folder: Path) -> LoadedTask:
    task = load_task(folder.name)
    update_from_run(task, load_yaml(folder / "config.yaml"), where="config.yaml")
    return task


@pytest.mark.parametrize(
    "folder", [folder for folder in POLICIES if [*folder.glob("*_training.yaml")]], ids=lambda folder: folder.name
)
def test_the_files_of_its_further_trainings_give_its_config(folder: Path) -> None:
    """The files over the task, in their order; aside are what a run begins with, its seed, length, exams and checkpoints."""
    task = load_task(folder.name)
    order = [f"{which}_training.yaml" for which in ("second", "third", "fourth", "fifth")]
    for file in sorted(folder.glob("*_training.yaml"), key=lambda file: order.index(file.name)):
        task.update(load_yaml(file), where=file.name)
    ran = trained(folder)
    assert task.cfg.to_dict() == ran.cfg.to_dict()
    ours, theirs = task.train.to_dict(), ran.train.to_dict()
    lengths = ("max_iterations", "save_interval", "keep_checkpoints", "exam_interval", "experiment_name")
    for config in (ours, theirs):
        config.pop("seed")
        config["warm_start"].pop("policy")
        for name in lengths:
            config["runner"].pop(name)
    assert ours == theirs


@pytest.mark.parametrize(
    "file",
    [file for folder in POLICIES for file in folder.glob("*.yaml") if file.name not in ("config.yaml", "policy.yaml")],
    ids=lambda file: f"{file.parent.name}/{file.name}",
)
def test_each_file_of_overrides_fits_its_task(file: Path) -> None:
    load_task(file.parent.name).update(load_yaml(file), where=file.name)


@pytest.mark.parametrize(
    "folder", [folder for folder in POLICIES if folder not in SKILLED], ids=lambda folder: folder.name
)
def test_walks_and_both_formats_agree(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By the first 4 s of each command; the whole exam is on the policy's page."""
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 4.0)
    rollout.prepare(task := trained(folder))
    env = task.env_class(task.cfg, "cpu")
    policy = check_formats(folder, task, env)
    result = rollout.run_exam(env, lambda state: act(policy, state))
    assert result["walks"], walking.table(result)


@pytest.mark.parametrize("folder", SKILLED, ids=lambda folder: folder.name)
def test_passes_its_exam_and_both_formats_agree(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On the first of its grounds, by a few robots."""
    task = trained(folder)
    task.cfg.env.num_envs = 1
    check_formats(folder, task, task.env_class(task.cfg, "cpu"))
    skill = contract_skill(read_contract(folder))
    monkeypatch.setattr(type(skill), "robots", 4)
    name, ground = next(iter(skill.grounds.items()))
    part = skill.judge(*perform(folder, skill, ground))
    assert all(figure.passes() is not False for figure in skill.figures({name: part}, name)), part


def check_formats(folder: Path, task: LoadedTask, env: RobotTask) -> MLPModel:
    policy = load_policy(folder / "policy.onnx", env, task.train, "cpu")

    obs = torch.randn(32, policy.obs_dim, generator=torch.Generator().manual_seed(0)) * 2.0
    with torch.inference_mode():
        expected = ExportedPolicy(policy, task.cfg.normalization.clip_actions)(obs)
    for name in FILES:
        assert (
            b"site-packages" not in (folder / name).read_bytes()
            and str(ROOT).encode() not in (folder / name).read_bytes()
        )
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    got = np.concatenate([session.run(["actions"], {"obs": row[None].numpy()})[0] for row in obs])
    np.testing.assert_allclose(got, expected.numpy(), atol=1e-4)  # float32 sums in another order

    contract = read_contract(folder)
    assert (
        contract.digest == digest(folder / "policy.onnx") and read_scene(folder, contract).model.nu == env.num_actions
    )
    return policy


def test_the_contract_and_the_network_alone_have_the_targets_that_servos_obey(tmp_path: Path) -> None:
    """Of go2_rough, whose policy asks its calves for more than their range at times; the scene is not there."""
    seed_everything(0)  # two simulations of an arbitrary walk may part by more than is compared
    folder, task = ROOT / "resources/policies/go2_rough", load_task("go2_rough")
    update_from_run(task, load_yaml(folder / "config.yaml"), where="config.yaml")
    rollout.prepare(task)
    task.cfg.env.num_envs = 2
    env, stage = task.env_class(task.cfg, "cpu"), DeployStage(folder, 2)
    policy, alone = load_policy(folder / "policy.onnx", env, task.train, "cpu"), tmp_path / "alone"
    alone.mkdir()
    for name in ("policy.yaml", "policy.onnx"):
        shutil.copy(folder / name, alone)
    contract = read_contract(alone)
    controller, obs = Controller(alone, contract, 2), env.get_observations()
    stage.fleet.qpos[:], stage.fleet.qvel[:] = env.sim.qpos.numpy(), env.sim.qvel.numpy()
    stage.fleet.refresh()
    stage.measured = stage.fleet.read()
    calves = [i for i, name in enumerate(contract.joints) if "calf" in name]
    beyond = []
    for _ in range(25):
        commands = env.commands.numpy().copy()
        obs, *_ = env.step(act(policy, obs))
        targets, asked = controller.act(stage.measured, commands), env.actuators.targets.numpy()
        stage.step(commands)
        np.testing.assert_allclose(controller.last_targets, asked, atol=1e-3)
        np.testing.assert_allclose(targets, np.clip(asked, *env.robot.physics.actuator_ctrlrange.T), atol=1e-3)
        beyond.append(np.abs(targets - asked)[:, calves].max())
    assert max(beyond) > 0.005  # [rad]


def test_play_takes_the_shipped_policy_where_nothing_is_trained(tmp_path: Path) -> None:
    (tmp_path / "resources").symlink_to(ROOT / "resources")
    result = run("play", tmp_path, "--task", "go1_flat", "--device", "cpu", "--export", str(tmp_path / "out"))
    assert result.code == 0, result.err
    assert (
        result.out.startswith("shipped policy: ")
        and "resources/policies/go1_flat/policy.onnx" in result.out.splitlines()[0]
    )
    assert (tmp_path / "out/policy.onnx").stat().st_size > 100_000
