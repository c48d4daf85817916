"""The estimator: what it learns from, what its gradient does not reach, and its way through checkpoint, export, deploy and exam."""

from __future__ import annotations

import copy
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from learner import STEPS, WORLDS, collect, make, parameters
from program import trained
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from test_deploy import main, put, rewrite, without
from test_ppo import SYMMETRY, update
from test_train import assert_equal, assert_resumes_exactly, load, small_task
from torch import Tensor, nn
from worlds import QUIET, layout, make_env

from legged_mw.check.describe import describe
from legged_mw.check.recordable import recordable
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.exam import run_exam
from legged_mw.deploy.stage import DeployStage
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import figures, plots, report, rollout, walking
from legged_mw.eval.report import Column
from legged_mw.eval.rollout import Record, holding, roll_out, training_figures
from legged_mw.eval.walking import ExamRules
from legged_mw.export.network import ExportedPolicy, run_onnx
from legged_mw.rl.learner_config import rsl_rl_config
from legged_mw.rl.policies import ESTIMATE, act, begin_with, find_trained, load_policy
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.runner import make_runner
from legged_mw.rl.students.estimator import SMALLEST, EstimatingModel
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.task import LoadedTask, load_task

BLIND = {
    "observations.leave_out": {"state": ["base_lin_vel"]},
    "observations.history": {"state": 2},
    "observations.foot_height": True,
    "actor.estimator.targets": ["foot_height", "base_lin_vel"],
    "actor.estimator.hidden_dims": [16],
}
FLAGS = [word for path, value in BLIND.items() for word in ("--set", f"{path}={value}")]


def part(alg: Any, which: str) -> dict[str, Tensor]:
    """Learned parameters of the actor's policy, of its estimator, or of the critic."""
    found = {name: value for name, value in parameters(alg).items() if "normalizer" not in name}
    ours = {name for name in found if name.startswith("actor.estimator.")}
    wanted = {"estimator": ours, "policy": {n for n in found if n.startswith("actor.")} - ours}.get(
        which
    ) or found.keys() - ours
    return {name: found[name] for name in wanted}


def learned(estimator: dict[str, Any], good: float, **settings: Any) -> Any:
    """A learner after an update; ``good`` turns around what is good."""
    alg = make(GraphedPPO, estimator=estimator, **settings)
    collect(alg)
    with torch.inference_mode():
        alg.storage.advantages.mul_(good)
        alg.storage.returns.mul_(good)
    update(alg)
    return alg


# ---- the regression


@pytest.mark.parametrize(
    "settings", [{}, {"symmetry_cfg": SYMMETRY}, {"max_grad_norm": 0.02}], ids=["plain", "mirrored", "clipped"]
)
def test_neither_gradient_reaches_the_other(settings: dict[str, Any]) -> None:
    """Another reward leaves the estimator as it is, bit for bit, and another estimator's rate the policy and the critic."""
    alg, punished = learned({}, 1.0, **settings), learned({}, -1.0, **settings)
    eager = learned({"learning_rate": 0.03}, 1.0, **settings)
    assert_equal(part(alg, "estimator"), part(punished, "estimator"))
    for which in ("policy", "critic"):
        assert_equal(part(alg, which), part(eager, which))
        assert any(not torch.equal(value, part(punished, which)[name]) for name, value in part(alg, which).items())
    assert any(not torch.equal(value, part(eager, "estimator")[name]) for name, value in part(alg, "estimator").items())


@pytest.mark.parametrize("mirrored", [False, True])
def test_the_regression_is_plain_torchs(mirrored: bool, double: None) -> None:
    """Two updates by hand: normalised inputs and targets, mean square error, Adam at a rate of its own, clipped by itself."""
    alg = make(GraphedPPO, estimator={}, max_grad_norm=0.3, symmetry_cfg=SYMMETRY if mirrored else None)
    network = copy.deepcopy(alg.actor.estimator)
    optimizer = torch.optim.Adam(network.parameters(), lr=3e-3)
    mean, std = torch.zeros(3), torch.ones(3)
    for round_ in range(2):
        collect(alg, seed=round_)
        obs = {name: value.flatten(0, 1).clone() for name, value in alg.storage.observations.items()}
        target = torch.stack(
            [obs["privileged_state"][:, 2], obs["privileged_state"][:, 3], obs["privileged_state"][:, 6] / 2.0], dim=1
        )
        center, spread = alg.actor.obs_normalizer._mean.clone(), alg.actor.obs_normalizer._std.clone()
        torch.manual_seed(3)
        batches, losses = torch.randperm(WORLDS * STEPS).split(WORLDS * STEPS // 4), []
        for _ in range(5):
            for batch in batches:
                x, y = obs["state"][batch], target[batch]
                if mirrored:
                    x, y = torch.cat([x, -x]), torch.cat([y, -y])
                loss = (network((x - center) / (spread + 0.01)) - (y - mean) / std).square().mean()
                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(network.parameters(), 0.3)
                optimizer.step()
                losses.append(loss.item())
        assert update(alg)["estimate"] == pytest.approx(sum(losses) / 20, rel=1e-6)
        for got, wanted in zip(alg.actor.estimator.parameters(), network.parameters(), strict=True):
            # our rate is float32, as the fused Adam wants it
            torch.testing.assert_close(got, wanted, rtol=1e-5, atol=1e-7)
        if round_ == 0:
            mean, std = target.mean(dim=0), target.std(dim=0, unbiased=False)
            torch.testing.assert_close(alg.actor.target_normalizer._mean[0], mean)
            torch.testing.assert_close(alg.actor.target_normalizer._std[0], std)
    torch.testing.assert_close(alg.actor.truth(TensorDict(obs)), target)


def test_the_policy_reads_the_estimate_without_its_gradient() -> None:
    alg = make(GraphedPPO, estimator={})
    obs, actor = alg.storage.observations[0].clone().apply(lambda x: torch.randn_like(x)), alg.actor
    latent = actor.get_latent(obs)
    assert latent.shape == (WORLDS, 7 + 3) and not latent.requires_grad
    torch.testing.assert_close(actor.target_normalizer.inverse(latent[:, 7:]), actor.estimate(obs))
    assert [actor.columns_of(name) for name in ("speed", "height", "weight")] == [slice(0, 2), slice(2, 3), None]
    before = actor(obs)
    with torch.no_grad():
        actor.estimator[-1].bias += 1.0
    assert not torch.allclose(actor(obs), before)


def test_a_target_that_never_changes_is_not_divided_by_zero() -> None:
    normalizer = make(GraphedPPO, estimator={}).actor.target_normalizer
    normalizer._std[0, 1] = 0.0
    x = torch.tensor([[1.0, 1.0, 1.0]])
    assert normalizer(x).tolist() == [[1.0, 1.0 / SMALLEST, 1.0]]
    torch.testing.assert_close(normalizer.inverse(normalizer(x)), x)


def test_the_update_asks_the_host_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    alg = make(GraphedPPO, estimator={}, symmetry_cfg=SYMMETRY)
    collect(alg)
    update(alg)
    collect(alg)
    # torch's own: they move tensors to where they are
    monkeypatch.setattr(nn.utils, "clip_grad_norm_", lambda *_: None)
    monkeypatch.setattr(alg.optimizer, "step", lambda: None)
    with recordable():
        alg._update()


def test_a_checkpoint_goes_on_bit_for_bit(tmp_path: Path) -> None:
    """Adam's memory of the estimator, its own rate and the normaliser of targets too, from a file that holds no code."""
    task = task_with(cpu__update_threads=1)  # else how long an update takes decides how it is rounded
    assert_resumes_exactly(task, tmp_path / "model_2.pt")
    saved = load(tmp_path / "model_2.pt")
    groups = saved["optimizer_state_dict"]["param_groups"]
    assert [len(group["params"]) for group in groups] == [7 + 6, 4] and groups[1]["lr"] == pytest.approx(1e-3)
    assert {"estimator.0.weight", "target_normalizer._mean"} <= saved["actor_state_dict"].keys()


# ---- what the config asks for


def task_with(**changes: Any) -> LoadedTask:
    task = small_task()
    for path, value in {**BLIND, **{path.replace("__", "."): value for path, value in changes.items()}}.items():
        task.set(path, value)
    return task


def test_what_is_randomized_can_be_estimated_and_the_policy_acts_in_nominal_worlds(tmp_path: Path) -> None:
    task = task_with(
        **{
            "domain_rand__enable": True,
            "domain_rand__observe": True,
            "actor__estimator__targets": ["encoder_offset", "friction", "base_lin_vel"],
        }
    )
    runner = make_runner(LeggedRobot(task.cfg, "cpu"), task.train, None, "cpu")
    runner.learn(1)
    runner.save(str(tmp_path / "model_1.pt"))
    task.set("domain_rand.enable", False)
    env = LeggedRobot(task.cfg, "cpu")
    policy, obs = load_policy(tmp_path / "model_1.pt", env, task.train, "cpu"), env.get_observations()
    assert isinstance(policy, EstimatingModel) and policy.columns_of("base_lin_vel") == slice(13, 16)
    assert policy.estimate(obs).shape == (16, 16) and act(policy, obs).shape == (16, 12)
    with pytest.raises(ConfigError, match="'encoder_offset'"):
        make_runner(env, task.train, None, "cpu")


def test_check_says_what_is_estimated() -> None:
    task = task_with()
    assert "\nthe actor estimates foot_height (4), base_lin_vel (3)\n" in describe(LeggedRobot(task.cfg, "cpu"), task)


def test_without_targets_the_actor_is_rsl_rls_own() -> None:
    task = small_task()
    runner = make_runner(LeggedRobot(task.cfg, "cpu"), task.train, None, "cpu")
    assert type(runner.alg.actor) is MLPModel and len(runner.alg.optimizer.param_groups) == 1
    assert "estimator" not in rsl_rl_config(task.train)["actor"]


def test_the_height_of_feet_is_a_row_where_it_is_asked_for() -> None:
    assert "foot_height" not in layout(make_env(1))["privileged_state"]
    env = make_env(2, {**QUIET, "observations.foot_height": True})
    env.step(torch.randn(2, 12))
    seen = env.obs_buf["privileged_state"][:, env.observations.span("privileged_state", "foot_height")]
    assert torch.equal(seen, env.foot_height) and (seen != 0.0).any()
    _ = env.mirror


def test_go1_flat_blind_reads_what_a_robot_measures() -> None:
    env = make_env(1, task="go1_flat_blind")
    rows = layout(env)
    assert rows["state"] == {
        **{"base_ang_vel": 3, "projected_gravity": 3, "dof_pos": 12, "dof_vel": 12, "last_actions": 12, "commands": 3},
    }
    critic, seeing = rows["privileged_state"], layout(make_env(1))["privileged_state"]
    assert critic == {**seeing, "state": 45} and critic["base_lin_vel"] == 3


# ---- export and deploy


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three iterations; the last is exported to ``export`` beside the checkpoint."""
    flags = [*FLAGS, "--max_iterations", "3", "--set", "runner.export=true"]
    return trained(tmp_path_factory.mktemp("estimator"), *flags, "--verbose", prints=("Estimate loss: ", "policy.onnx"))


@pytest.fixture(scope="module")
def policy(run_folder: Path) -> EstimatingModel:
    task = task_with()
    found = load_policy(run_folder / "model_3.pt", LeggedRobot(task.cfg, "cpu"), task.train, "cpu")
    assert isinstance(found, EstimatingModel)
    return found


def test_both_outputs_of_the_onnx_are_torchs(policy: EstimatingModel, run_folder: Path) -> None:
    obs = torch.randn(40, 90, generator=torch.Generator().manual_seed(0)) * 2.0
    groups = TensorDict({"state": obs}, [40])
    file = run_folder / "export/policy.onnx"
    np.testing.assert_allclose(run_onnx(file, obs.numpy()), act(policy, groups).clamp(-2.0, 2.0), atol=1e-5)
    with torch.no_grad():
        np.testing.assert_allclose(run_onnx(file, obs.numpy(), ESTIMATE), policy.estimate(groups), atol=1e-5)
    # else the normaliser would not have been tried
    assert policy.state_dict()["target_normalizer._mean"].abs().min() > 0.0
    task = task_with()
    again = load_policy(file, LeggedRobot(task.cfg, "cpu"), task.train, "cpu")
    assert isinstance(again, EstimatingModel)
    assert torch.equal(again.estimate(groups), policy.estimate(groups)) and torch.equal(
        act(again, groups), act(policy, groups)
    )
    actions, estimate = ExportedPolicy(policy, 2.0)(obs)
    assert actions.shape == (40, 12) and estimate.shape == (40, 7)


def test_training_goes_on_from_an_exported_estimate(policy: EstimatingModel, run_folder: Path) -> None:
    """The file holds no variance and no count of the targets: the next update must not forget what the estimate is measured in."""
    model, wanted = copy.deepcopy(policy), policy.state_dict()
    for value in model.state_dict().values():
        value.zero_()
    begin_with(model, find_trained(str(run_folder / "export"), run_folder.parent, "--init"))
    got = model.state_dict()
    torch.testing.assert_close(got["target_normalizer._mean"], wanted["target_normalizer._mean"])
    torch.testing.assert_close(got["target_normalizer._var"], wanted["target_normalizer._var"].clamp(min=SMALLEST**2))
    assert got["target_normalizer.count"] == got["obs_normalizer.count"] == 10**8


def test_the_contract_names_the_rows(run_folder: Path) -> None:
    said = load_yaml(run_folder / "export/policy.yaml")
    assert said["format"] == 5 and said["estimate"] == [
        {"name": "foot_height", "size": 4, "unit": "m", "frame": "site above the ground under it"},
        {"name": "base_lin_vel", "size": 3, "unit": "m/s", "frame": "body, at the IMU"},
    ]
    assert [row.name for row in read_contract(run_folder / "export").estimate] == ["foot_height", "base_lin_vel"]


def test_deploy_believes_what_training_would(policy: EstimatingModel, run_folder: Path) -> None:
    """From the same observations; of several robots, and before the first step."""
    stage = DeployStage(run_folder / "export", 3)
    assert stage.controller.estimate("foot_height") is None and stage.believed_velocity() is None
    for _ in range(3):
        seen = stage.controller.observe(stage.measured, stage.commands())
        stage.step()
    with torch.no_grad():
        believed = policy.estimate(TensorDict({"state": torch.from_numpy(seen)}, [3])).numpy()
    velocity, height = stage.believed_velocity(), stage.controller.estimate("foot_height")
    assert velocity is not None and height is not None and stage.controller.estimate("commands") is None
    np.testing.assert_allclose(velocity, believed[:, 4:6], atol=1e-5)
    np.testing.assert_allclose(height, believed[:, :4], atol=1e-5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            put("estimate.0.size", 5),
            "its output is 'actions' ['batch', 12], 'estimate' ['batch', 7], the contract's is 'actions' [1, 12], 'estimate' [1, 8]",
        ),
        (without("estimate"), "'estimate' ['batch', 7], the contract's is 'actions' [1, 12] (one action a joint)"),
        (lambda said: said["estimate"][1].pop("unit"), "policy.yaml: estimate[1]: 'unit' is missing; it must be text"),
    ],
)
def test_a_contract_that_does_not_fit(
    change: Any, said: str, run_folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("policy.onnx", "policy.yaml", "scene.xml"):
        (tmp_path / name).write_bytes((run_folder / "export" / name).read_bytes())
    rewrite(tmp_path, change)
    code, _, err = main(capsys, tmp_path, "--eval", "--no_hard")
    assert code == 2 and said in err and err.count("\n") == 1, err


# ---- exam and report


class Believer:
    """Stands still, and believes that it is faster than it says of itself by (0.1, -0.2) m/s."""

    def __call__(self, obs: TensorDict) -> Tensor:
        return torch.zeros(len(obs), 12)

    def columns_of(self, row: str) -> slice | None:
        return slice(1, 4) if row == "base_lin_vel" else None

    def estimate(self, obs: TensorDict) -> Tensor:
        return torch.nn.functional.pad(obs["state"][:, :3] + torch.tensor([0.1, -0.2, 0.0]), (1, 0))


@pytest.fixture(scope="module")
def record() -> Record:
    task = load_task("go1_flat")
    rollout.prepare(task, 3)
    return roll_out(
        LeggedRobot(task.cfg, "cpu"), Believer(), [holding((0.5, 0.0, 0.0))] * 3, 30, rollout.SIGNALS, alone=2
    )


def test_an_estimate_stands_beside_the_velocity_of_the_same_moment(record: Record) -> None:
    off = record.signals["estimate"] - record.signals["velocity"][..., :2]
    np.testing.assert_allclose(off, np.broadcast_to([0.1, -0.2], off.shape), atol=1e-6)
    assert off.shape == (30, 3, 2) and np.abs(record.signals["velocity"][1:]).max() > 1e-3


def graded(off: tuple[float, float] | None, fell: int = 0) -> dict[str, Any]:
    """The result of an exam in which the first ``fell`` commands fell; ``off`` is the estimate's error, of either sign."""
    asked = ExamRules.from_config(load_task("go1_flat").cfg)
    steps, n = 500, asked.worlds()
    signals = {"velocity": np.random.default_rng(0).normal(size=(steps, n, 3)), "position": np.zeros((steps, n, 2))}
    signals |= {"power": np.zeros((steps, n)), "joint_speed": np.zeros((steps, n))}
    fell_at = np.where(np.arange(n) < fell, 200.0, math.inf)
    if off:
        signals["estimate"] = signals["velocity"][..., :2] + np.array(off) * (-1.0) ** np.arange(steps)[:, None, None]
        signals["estimate"][:100] += 9.0  # not settled
        signals["estimate"][:, fell_at < math.inf] += 9.0
        signals["estimate"][:, 22:] += 9.0  # pushed
    return asked.grade(signals, last_position=np.zeros((n, 2)), fell_at=fell_at, mass=10.0, dt=0.02)


def test_the_exams_root_mean_square_error() -> None:
    """Over the commands at which it did not fall, settled; and nothing is said of a policy that estimates nothing."""
    result = graded((0.03, 0.04), fell=2)
    assert result["estimate_rms"] == pytest.approx([0.03, 0.04], abs=1e-5)
    table = walking.table(result)
    assert "estimate of vx, rms [m/s]            0.030\nestimate of vy, rms [m/s]            0.040\n" in table
    fallen = graded((0.03, 0.04), fell=22)
    assert fallen["estimate_rms"] is None and "estimate of vx, rms [m/s]             none\n" in walking.table(fallen)
    assert "estimate_rms" not in graded(None) and "estimate" not in walking.table(graded(None))


def test_the_exam_during_training_has_it_too(record: Record) -> None:
    # settled after 10
    longer = Record(*record[:2], record.commands, record.fell_at, record.last_position, record.signals)._replace(dt=0.2)
    found = training_figures(longer, 2)
    assert (found["estimate_vx"], found["estimate_vy"]) == pytest.approx((0.1, 0.2), abs=1e-5)
    del longer.signals["estimate"]
    assert not [name for name in training_figures(longer, 2) if name.startswith("estimate")]


def test_the_report_draws_it_and_compares_it_with_a_policy_that_has_none() -> None:
    rows = np.random.default_rng(0).normal(size=(50, 22, 2))
    fell_at = np.where(np.arange(22) == 3, 10.0, math.inf)
    both = Record(
        0.02, 1.0, np.zeros((50, 22, 3)), fell_at, np.zeros((22, 2)), {"velocity": rows, "estimate": rows + 1.0}
    )
    commands = ExamRules.from_config(load_task("go1_flat").cfg).commands()
    found = figures.estimates(both, commands, 0.4)
    assert (
        found["seconds"] == pytest.approx(0.4)
        and [len(found[key][0]) for key in ("truth", "estimate")] == [22 * 20] * 2
    )
    assert (
        found["truth"][1][20] == pytest.approx(rows[30, 1, 1], abs=1e-4)
        and found["estimate"][0][3 * 20 : 4 * 20] == [None] * 20
    )
    panels = plots._estimates([("one", {"estimate": found}), ("other", {})])
    assert len(panels) == 2
    [first, _] = plots.svgs(plots.Section("estimate", "Estimate", panels, across=1))
    assert "estimated" in first and "vx [m/s], one" in first
    columns = [Column("one", {}, graded((0.03, 0.04))), Column("other", {}, graded(None))]
    results = [column.exam for column in columns]
    asked = ExamRules.from_mapping(results[0]["rules"])
    table = report.exam_table(columns, [asked.figures(result, others=results) for result in results], "")
    assert "estimate of vx, rms [m/s]</th>" in table and ">0.030</span>" in table and ">none</span>" in table


def test_deploys_exam_measures_it_as_the_environments_does(
    policy: EstimatingModel, run_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two seconds and a half of both, of a policy that has learned nothing: the same truth and the same belief."""
    for module in (walking, rollout):
        monkeypatch.setattr(module, "EXAM_SECONDS", 2.5)
    task = task_with(**{"exam__push_speeds": [1.0], "exam__push_mark": 1.0})
    asked = ExamRules.from_config(task.cfg)
    rollout.prepare(task)
    here = rollout.run_exam(LeggedRobot(task.cfg, "cpu"), policy)
    there = run_exam(run_folder / "export", asked)
    assert here["falls"] == there["falls"] < 22
    assert here["estimate_rms"] == pytest.approx(there["estimate_rms"], rel=0.02)
