"""Concurrent teacher and student: who learns from what, and the student's way through checkpoint, export and deploy."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learner import STEPS, WORLDS, collect, difference, make, parameters, share_experience
from program import SMALL, refused, run, trained
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from test_ppo import SYMMETRY, update
from test_train import assert_resumes_exactly, load, small_task
from torch import Tensor, nn

from legged_mw.check.describe import describe
from legged_mw.check.recordable import recordable
from legged_mw.deploy.stage import DeployStage
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.export.network import run_onnx
from legged_mw.rl.policies import act, attach_teacher_observations, begin_with, find_trained, load_policy, load_teacher
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.runner import make_runner
from legged_mw.rl.students.concurrent import ConcurrentModel, pick_teacher_worlds
from legged_mw.utils.task import LoadedTask

TAUGHT = {
    "observations.leave_out": {"state": ["base_lin_vel"]},
    "observations.history": {"state": 3},
    "actor.concurrent.groups": ["privileged_state"],
    "actor.concurrent.hidden_dims": [16],
    "actor.concurrent.latent_dim": 6,
}
FLAGS = [word for path, value in TAUGHT.items() for word in ("--set", f"{path}={value}")]


def task_with(**changes: Any) -> LoadedTask:
    task = small_task()
    for path, value in {**TAUGHT, **{path.replace("__", "."): value for path, value in changes.items()}}.items():
        task.set(path, value)
    return task


GRU = {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 8, "rnn_num_layers": 1}


# ---- learning


class Joined(MLPModel):
    """The teacher's path of a ConcurrentModel as a plain network, for rsl-rl's own update."""

    def __init__(self, *args: Any, concurrent: dict[str, Any], **more: Any) -> None:
        super().__init__(*args, **more)
        self.whole = ConcurrentModel(*args, concurrent=concurrent, **more)
        self.mlp, self.obs_normalizer, self.distribution = (
            self.whole.mlp,
            self.whole.obs_normalizer,
            self.whole.distribution,
        )

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        seen, encoded = self.obs_normalizer(obs["state"]), self.whole.teacher(obs["privileged_state"])
        return torch.cat([seen[:, 2:4], seen[:, 5:7], encoded / encoded.norm(dim=1, keepdim=True)], dim=1)

    def update_normalization(self, obs: TensorDict) -> None:
        super().update_normalization(obs)
        self.whole.teacher[0].update(obs["privileged_state"])  # type: ignore[operator]


@pytest.mark.parametrize("symmetry", [None, SYMMETRY], ids=["plain", "mirrored"])
def test_where_all_are_taught_it_is_rsl_rls_own_ppo(
    symmetry: Any, double: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Three updates: the gradient goes through the teacher's encoder, and the student's changes nothing of it."""
    ours = make(GraphedPPO, concurrent={"teacher_share": 1.0}, symmetry_cfg=symmetry)
    monkeypatch.setattr("learner.ConcurrentModel", Joined)
    stock = make(PPO, concurrent={"teacher_share": 1.0}, symmetry_cfg=symmetry)
    stock.actor.whole.load_state_dict(ours.actor.state_dict())
    stock.critic.load_state_dict(ours.critic.state_dict())
    for seed in range(3):
        collect(stock, seed=seed)
        share_experience(stock, ours)
        expected, got = update(stock), update(ours)
        assert got.pop("student") > 0.0 and got == pytest.approx(expected, rel=1e-4)
    theirs = {f"actor.{name}": value for name, value in stock.actor.whole.state_dict().items()}
    learned = {
        name: value for name, value in parameters(ours).items() if not name.startswith(("actor.estimator.", "critic."))
    }
    assert difference(learned, theirs) < 1e-5 and len(learned) > 10


def test_no_gradient_goes_astray() -> None:
    """The policy's loss does not reach the student's encoder, nor the teacher's where the student acts; the regression nothing else."""
    actor = make(GraphedPPO, concurrent={}).actor
    obs = TensorDict({"state": torch.randn(WORLDS, 7), "privileged_state": torch.randn(WORLDS, 11)}, [WORLDS])
    worlds, latent = torch.arange(WORLDS), nn.functional.pad(actor.get_latent(obs), (0, 3))
    assert latent.shape == (WORLDS, 4 + 5 + 3) and not latent.requires_grad

    def reached(loss: Tensor) -> set[str]:
        actor.zero_grad()
        loss.backward()
        return {
            name.partition(".")[0]
            for name, each in actor.named_parameters()
            if each.grad is not None and each.grad.any()
        }

    taught = actor.teacher_worlds[:, 0]
    assert reached(actor.learn(latent, actor.regression_batch(obs, worlds))[1]) == {"estimator"}
    assert reached(actor.learn(latent, actor.regression_batch(obs, worlds))[0][taught].sum()) == {"mlp", "teacher"}
    assert reached(actor.learn(latent, actor.regression_batch(obs, worlds))[0][~taught].sum()) == {"mlp"}
    torch.testing.assert_close(
        actor.learn(latent, actor.regression_batch(obs, worlds))[0], actor.mlp(actor.rollout_latent(obs))
    )


def test_the_regression_is_plain_torchs(double: None) -> None:
    """One gradient step by hand, from the teacher as it was."""
    alg = make(GraphedPPO, concurrent={}, num_learning_epochs=1, num_mini_batches=1)
    collect(alg)
    obs, network = alg.storage.observations.flatten(0, 1).clone(), copy.deepcopy(alg.actor.estimator)
    with torch.no_grad():
        wanted = alg.actor.teacher[1](obs["privileged_state"] / 1.01)  # no spread is known before the first update
    got, wanted = network(obs["state"] / 1.01), wanted / wanted.norm(dim=1, keepdim=True)
    loss = (got / got.norm(dim=1, keepdim=True) - wanted).square().mean()
    loss.backward()
    torch.optim.Adam(network.parameters(), lr=3e-3).step()
    assert update(alg)["student"] == pytest.approx(loss.item(), rel=1e-6)
    for ours, theirs in zip(alg.actor.estimator.parameters(), network.parameters(), strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-7)
    known = alg.actor.teacher[0]
    torch.testing.assert_close(known._mean[0], obs["privileged_state"].mean(dim=0))


def test_worlds_act_by_the_latent_that_is_theirs() -> None:
    actor = make(GraphedPPO, concurrent={}).actor
    obs = TensorDict({"state": torch.randn(WORLDS, 7), "privileged_state": torch.randn(WORLDS, 11)}, [WORLDS])
    latent, own, taught = actor.rollout_latent(obs), actor.get_latent(obs), actor.teacher_worlds[:, 0]
    assert torch.equal(latent[:, :4], own[:, :4]) and torch.equal(latent[~taught], own[~taught])
    assert (latent[taught, 4:] != own[taught, 4:]).all()
    torch.testing.assert_close(latent[:, 4:].norm(dim=1), torch.ones(WORLDS))
    torch.testing.assert_close(own[:, :2], actor.obs_normalizer(obs["state"])[:, 2:4])  # the newest frames
    obs["privileged_state"] += 1.0
    moved = actor.rollout_latent(obs)
    assert torch.equal(moved[~taught], latent[~taught]) and (moved[taught] != latent[taught]).any(dim=1).all()


@pytest.mark.parametrize(
    "settings", [{}, {"symmetry_cfg": SYMMETRY}, {"memory": {"critic": GRU}}], ids=["plain", "mirrored", "memory"]
)
def test_samples_are_learned_from_as_they_were_acted(settings: dict[str, Any]) -> None:
    """Of a sample's world, its mirror image's too, and where a critic with a memory learns from whole worlds."""
    alg = make(GraphedPPO, concurrent={}, **settings)
    collect(alg)
    alg.storage.observations["state"][..., 0] = torch.arange(WORLDS)
    alg._order[:] = torch.randperm(len(alg._order))
    batch = alg._prepare(alg._order[: alg._share])
    worlds = batch.batch.observations["state"][:, 0].abs().long()
    assert len(worlds) == (2 if "symmetry_cfg" in settings else 1) * STEPS * WORLDS // 4
    assert torch.equal(batch.regression_batch[2], alg.actor.teacher_worlds[worlds])
    assert update(alg)["student"] > 0.0


def test_every_part_of_the_worlds_has_teachers_and_students() -> None:
    """As many as asked, also of the columns of a terrain, which repeat with a period or lie side by side."""
    taught = pick_teacher_worlds(4000, 0.75)[:, 0].double()
    assert taught.mean().item() == pytest.approx(0.75, abs=2e-3)
    for period in (2, 4, 5, 8, 10, 20):
        grid = taught.view(-1, period)
        assert ((grid.mean(dim=0) - 0.75).abs() < 0.02).all()
        assert ((taught.view(period, -1).mean(dim=1) - 0.75).abs() < 0.02).all()
    assert pick_teacher_worlds(8, 1.0).all()


def test_the_update_asks_the_host_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    alg = make(GraphedPPO, concurrent={}, symmetry_cfg=SYMMETRY)
    for _ in range(2):
        collect(alg)
        update(alg)
    collect(alg)
    # torch's own: they move tensors to where they are
    monkeypatch.setattr(nn.utils, "clip_grad_norm_", lambda *_: None)
    monkeypatch.setattr(alg.optimizer, "step", lambda: None)
    with recordable():
        alg._act()
        alg._update()


def test_a_checkpoint_goes_on_bit_for_bit(tmp_path: Path) -> None:
    task = task_with(cpu__update_threads=1)  # else how long an update takes decides how it is rounded
    resumed, _ = assert_resumes_exactly(task, tmp_path / "model_2.pt")
    assert {"teacher.0._mean", "teacher.1.0.weight", "estimator.0.weight"} <= load(tmp_path / "model_2.pt")[
        "actor_state_dict"
    ].keys()
    assert resumed.alg.get_policy().get_buffer("teacher_worlds").sum() == 13


# ---- what the config asks for


def test_check_says_who_is_taught() -> None:
    task = task_with()
    said = describe(LeggedRobot(task.cfg, "cpu"), task)
    assert "\n75% of the worlds act by a teacher's latent (6) of privileged_state\n" in said


# ---- a run, its export, deploy


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three iterations in worlds that show the critic what was drawn; the last is exported to ``export`` beside the checkpoint."""
    drawn = ["--set", "domain_rand.enable=true", "--set", "domain_rand.observe=true", "--set", "runner.save_interval=1"]
    flags = [*FLAGS, *drawn, "--max_iterations", "3", "--set", "runner.export=true"]
    return trained(tmp_path_factory.mktemp("concurrent"), *flags, "--verbose", prints=("Student loss: ", "policy.onnx"))


@pytest.fixture(scope="module")
def policy(run_folder: Path) -> ConcurrentModel:
    """The student alone, in nominal worlds."""
    task = task_with()
    found = load_policy(run_folder / "model_3.pt", LeggedRobot(task.cfg, "cpu"), task.train, "cpu")
    assert isinstance(found, ConcurrentModel) and not hasattr(found, "teacher")
    return found


def test_both_learn(run_folder: Path) -> None:
    first, last = (load(run_folder / f"model_{i}.pt")["actor_state_dict"] for i in (1, 3))
    for name in ("teacher.1.0.weight", "teacher.0._mean", "estimator.0.weight", "mlp.0.weight"):
        assert not torch.equal(first[name], last[name])
    assert last["mlp.0.weight"].shape == (16, 45 + 6) and last["estimator.0.weight"].shape == (16, 135)


def test_the_onnx_is_the_students_path(policy: ConcurrentModel, run_folder: Path) -> None:
    obs = torch.randn(40, 135, generator=torch.Generator().manual_seed(0)) * 2.0
    groups = TensorDict({"state": obs}, [40])
    file, wanted = run_folder / "export/policy.onnx", act(policy, groups)
    np.testing.assert_allclose(run_onnx(file, obs.numpy()), wanted.clamp(-2.0, 2.0), atol=1e-5)
    seen = policy.obs_normalizer(obs)
    encoded = act(policy.estimator, seen)  # type: ignore[arg-type]
    frames = [seen[:, stop - size : stop] for stop, size in ((9, 3), (18, 3), (54, 12), (90, 12), (126, 12), (135, 3))]
    latent = torch.cat([*frames, encoded / encoded.norm(dim=1, keepdim=True)], dim=1)
    torch.testing.assert_close(policy.mlp(latent), wanted)  # the newest of three frames of each row
    task = task_with()
    assert torch.equal(act(load_policy(file, LeggedRobot(task.cfg, "cpu"), task.train, "cpu"), groups), wanted)


def test_deploy_acts_as_training_would(policy: ConcurrentModel, run_folder: Path) -> None:
    stage = DeployStage(run_folder / "export", 3)
    for _ in range(3):
        seen = stage.controller.observe(stage.measured, stage.commands())
        stage.step()
    wanted = act(policy, TensorDict({"state": torch.from_numpy(seen)}, [3])).clamp(-2.0, 2.0).numpy()
    np.testing.assert_allclose(stage.controller.last_actions, wanted, atol=1e-5)


def test_training_begins_with_a_checkpoint(run_folder: Path) -> None:
    task = task_with(domain_rand__enable=True, domain_rand__observe=True)
    model: Any = make_runner(LeggedRobot(task.cfg, "cpu"), task.train, None, "cpu").alg.get_policy()
    begin_with(model, find_trained(str(run_folder), run_folder.parent, "--init"))
    saved = load(run_folder / "model_3.pt")["actor_state_dict"]
    assert torch.equal(model.teacher[1][0].weight, saved["teacher.1.0.weight"])


@pytest.mark.parametrize("frames", [1, 5])
def test_it_teaches_a_student_that_reads_other_frames(frames: int, policy: ConcurrentModel, run_folder: Path) -> None:
    """Its newest frames are looked for among its own rows, not among those that the student's group of the same name has."""
    task = task_with(
        **{"observations.history": {"state": frames}, "observations.leave_out": {}, "actor.concurrent.groups": []}
    )
    env, teacher = LeggedRobot(task.cfg, "cpu"), find_trained(str(run_folder), run_folder.parent, "--teacher")
    attach_teacher_observations(env, teacher)
    runner: Any = make_runner(env, task.train, None, "cpu", teacher.task.train)
    load_teacher(runner.alg.teacher, teacher, env)
    obs = env.get_observations()
    assert torch.equal(act(runner.alg.teacher, obs), act(policy, TensorDict({"state": obs["teacher"]}, obs.batch_size)))
    assert runner.alg.teacher.obs_groups == ["teacher"] and obs["state"].shape[1] == 48 * frames


def test_the_newest_frames_of_rows_within_a_group_of_groups() -> None:
    """The critic's group begins with the actor's, three frames of each row, and shows one of its own rows."""
    task = task_with(**{"obs_groups.actor": ["privileged_state"], "actor.concurrent.groups": ["privileged_state"]})
    env = LeggedRobot(task.cfg, "cpu")
    newest = ConcurrentModel.settings(task.train.to_dict(), env, learns=False)["concurrent"]["newest"]
    assert newest[:6] == [(6, 9), (15, 18), (42, 54), (78, 90), (114, 126), (132, 135)]
    assert newest[-1][1] == env.observations.buffers["privileged_state"].shape[1]
    assert sum(stop - start for start, stop in newest) == newest[-1][1] - 2 * 45


def test_it_can_teach_a_student_that_is_distilled(run_folder: Path, tmp_path: Path) -> None:
    distil = ["--teacher", str(run_folder), "--max_iterations", "1"]
    result = run("train", tmp_path, *SMALL, *FLAGS[:4], *distil)
    assert result.code == 0, result.err
    assert (
        "symmetry is off while a student is distilled, as rsl-rl's distillation has none; PPO from the student has it"
        in result.out
    )
    line = refused(tmp_path, "train", *SMALL, *FLAGS, *distil)
    assert (
        "actor.concurrent.groups: only GraphedPPO's recorded update trains that, and a student learns nothing but to act"
        in line
    )
