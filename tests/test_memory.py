"""A recurrent policy where it acts: from its config through training and exam to the viewer, the export and deploy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from program import SMALL, refused, run
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.utils import resolve_class
from test_train import assert_equal, copy_world
from worlds import make_env

from legged_mw import ROOT
from legged_mw.deploy.contract import CONTRACT_FILE, read_contract
from legged_mw.deploy.controller import Controller, Network
from legged_mw.deploy.stage import DeployStage
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import rough
from legged_mw.eval.rollout import OVERRIDES, holding, roll_out
from legged_mw.export import replay as export_replay
from legged_mw.export.exporter import ExportError, export
from legged_mw.rl.learner_config import fit_cpu, rsl_rl_config
from legged_mw.rl.policies import load_policy
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.runner import make_runner
from legged_mw.rl.students.recurrent import forget, memory_of
from legged_mw.rl.training import advice_on_rate
from legged_mw.utils.config import ConfigError
from legged_mw.utils.task import LoadedTask, load_task
from legged_mw.view.playing import EnvStage

RECURRENT = {"class_name": "RNNModel", "rnn_hidden_dim": 8, "hidden_dims": [16, 16]}


def small_task(kind: str = "gru", layers: int = 1, settings: dict[str, Any] | None = None) -> LoadedTask:
    """go1_flat with its symmetry, small recurrent networks, few worlds and short episodes."""
    task = load_task("go1_flat")
    recurrent = RECURRENT | {"rnn_type": kind, "rnn_num_layers": layers}
    fields = {f"{network}.{name}": value for network in ("actor", "critic") for name, value in recurrent.items()}
    for path, value in {
        **fields,
        "env.num_envs": 8,
        "runner.num_steps_per_env": 6,
        "env.episode_length_s": 0.1,
        **(settings or {}),
    }.items():
        task.set(path, value)
    return task


def saved(task: LoadedTask, path: Path) -> MLPModel:
    """Networks that have seen no training, in a checkpoint; returns the actor, its normaliser not the identity."""
    torch.manual_seed(0)
    env = make_env(1)
    actor_class, settings = resolve_class(rsl_rl_config(task.train)["actor"])
    actor = actor_class(
        env.get_observations(), task.train.to_dict()["obs_groups"], "actor", env.num_actions, **settings
    )
    actor.obs_normalizer.update(torch.randn(50, 48) * 2.0 + 0.5)
    torch.save({"actor_state_dict": actor.state_dict()}, path)
    return actor.eval()


# ---- training


def test_resumed_learning_is_the_uninterrupted_one(tmp_path: Path) -> None:
    """Bit for bit, from worlds in equal states that remember nothing: a resumed run begins an episode in every world."""
    task = small_task("lstm")
    torch.manual_seed(0)
    one, two = (LeggedRobot(task.cfg, "cpu") for _ in range(2))
    uninterrupted, resumed = (make_runner(env, task.train, None, "cpu") for env in (one, two))
    assert isinstance(uninterrupted.alg, GraphedPPO) and isinstance(resumed.alg, GraphedPPO)
    uninterrupted.learn(1)
    uninterrupted.save(str(tmp_path / "model_1.pt"))
    copy_world(one, two)
    for memory in uninterrupted.alg._memories.values():
        assert memory.now.any()
        memory.now.zero_()
    resumed.alg._memories[resumed.alg.actor].now.fill_(1.0)  # what it remembers of other worlds is dropped
    uninterrupted.learn(1, False)
    resumed.load(str(tmp_path / "model_1.pt"))
    resumed.learn(1, False)
    assert_equal(resumed.alg.save(), uninterrupted.alg.save())


@pytest.mark.parametrize("algorithm", ["legged_mw.rl.ppo:GraphedPPO", "PPO"])
def test_an_exam_does_not_touch_what_training_remembers(algorithm: str) -> None:
    """It has other worlds, and begins with an empty memory."""
    task = small_task(settings={"algorithm.class_name": algorithm, "symmetry.use_data_augmentation": False})
    env = LeggedRobot(task.cfg, "cpu")
    runner = make_runner(env, task.train, None, "cpu")
    began: list[torch.Tensor] = []

    def examine(policy: Any) -> dict[str, float]:
        forget(policy)
        began.append(memory_of(policy, 3))
        policy(env.get_observations()[:3])
        return {"steps": 1.0}

    runner.learn(1)
    runner.examine = examine
    before = [memory.now.clone() for memory in getattr(runner.alg, "_memories", {}).values()]
    held = memory_of(runner.alg.get_policy(), 8).clone()
    runner._examine()
    assert runner.last_exam == (1, {"steps": 1.0}) and not began[0].any() and began[0].shape == (3, 1, 8)
    assert torch.equal(memory_of(runner.alg.get_policy(), 8), held) and held.any() == (algorithm == "PPO")
    assert_equal([memory.now for memory in getattr(runner.alg, "_memories", {}).values()], before)


DOCUMENTED = (ROOT / "docs/training.md").read_text().partition("# mine.py")[2].partition("```")[0]


def test_the_documented_task_trains_resumes_and_exports(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text(DOCUMENTED)
    args = ["--task", str(tmp_path / "mine.py"), *SMALL[2:], "--set", "cpu.rnn_hidden_dim=8"]
    first = run("train", tmp_path, *args, "--max_iterations", "1")
    assert first.code == 0 and "not the recorded one" not in first.out, first.err
    again = run("train", tmp_path, *args, "--max_iterations", "2", "--resume", "--set", "runner.export=true")
    assert again.code == 0 and "not exported" not in again.out, again.out + again.err
    [folder] = tmp_path.glob("logs/*/*/export")
    contract, stage = read_contract(folder), DeployStage(folder, 2)
    assert contract.memory and contract.memory.shape == (1, 8) and contract.to_dict()["format"] == 5
    for _ in range(3):
        stage.step(None)
    assert stage.controller.memory is not None and stage.controller.memory.all() and np.isfinite(stage.qpos()).all()
    stage.reset(1)
    assert stage.controller.memory[0].all() and not stage.controller.memory[1].any()
    play = [*args[:2], "--load_run", str(folder), "--device", "cpu"]
    assert run("play", tmp_path, *play, "--export", str(tmp_path / "again")).code == 0
    assert (tmp_path / "again/policy.onnx").read_bytes() == (folder / "policy.onnx").read_bytes()
    line = refused(tmp_path, "play", *play, "--set", "actor.class_name=MLPModel")
    assert "policy.onnx does not fit this task: actor rnn.rnn.weight_ih_l0 is (24, 48) there and missing here" in line


# ---- config


def test_only_a_network_with_a_memory_gets_its_fields() -> None:
    task = small_task("lstm", 2)
    task.set("critic.class_name", "MLPModel")
    learner = rsl_rl_config(task.train)
    assert (learner["actor"]["rnn_type"], learner["actor"]["rnn_num_layers"]) == ("lstm", 2)
    assert not [name for name in learner["critic"] if name.startswith("rnn_")] and learner["critic"]["hidden_dims"] == [
        16,
        16,
    ]


@pytest.mark.parametrize(
    ("settings", "advised"),
    [
        ({}, True),
        ({"actor.class_name": "MLPModel"}, True),  # the critic's memory
        ({"actor.class_name": "MLPModel", "critic.class_name": "MLPModel"}, False),
        ({"algorithm.max_learning_rate": 1e-3}, False),
        ({"algorithm.schedule": "fixed"}, False),
        ({"distillation.teacher": "go1_flat"}, False),
    ],
)
def test_a_memory_is_advised_to_learn_slowly_on_a_gpu(settings: dict[str, Any], advised: bool) -> None:
    assert ("--set algorithm.max_learning_rate=1e-3" in advice_on_rate(small_task(settings=settings))) == advised


def test_a_cpu_gets_a_smaller_memory() -> None:
    task = load_task("go1_flat")
    fit_cpu(task, 2)
    assert task.train.actor.rnn_hidden_dim == task.train.critic.rnn_hidden_dim == 64


# ---- acting


@pytest.fixture(scope="module")
def actor(tmp_path_factory: pytest.TempPathFactory) -> RNNModel:
    policy = saved(small_task(), tmp_path_factory.mktemp("actor") / "model.pt")
    assert isinstance(policy, RNNModel)
    return policy


def test_the_worlds_that_act_alone_do_not_depend_on_the_others(actor: RNNModel) -> None:
    """Each part of a roll-out remembers apart, from nothing on."""
    signals = {"action": lambda env: env.last_actions.clone(), "angle": lambda env: env.dof_pos.clone()}
    cases = [holding((0.1 * i, 0.0, 0.0)) for i in range(5)]
    few, many = (
        roll_out(make_env(count, OVERRIDES), actor, cases[:count], 12, signals, alone=2).signals for count in (2, 5)
    )
    for name in signals:
        np.testing.assert_array_equal(few[name], many[name][:, :2])
    assert not np.array_equal(few["action"][4], few["action"][11])


class Forgetful:
    """Stands still, and notes where it must forget."""

    is_recurrent = True

    def __init__(self) -> None:
        self.forgotten: list[Any] = []

    def reset(self, ended: torch.Tensor | None = None) -> None:
        self.forgotten.append(None if ended is None else ended.nonzero().flatten().tolist())

    def __call__(self, obs: Any) -> torch.Tensor:
        return torch.zeros(len(obs), 12)


def test_a_roll_out_and_a_crossing_say_where_an_episode_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    one, other = Forgetful(), Forgetful()
    roll_out(make_env(3, {**OVERRIDES, "env.episode_length_s": 0.06}), one, [holding((0.0, 0.0, 0.0))] * 3, 4, {})
    assert one.forgotten == [None, [], [], [0, 1, 2], []]
    monkeypatch.setattr(rough, "SECONDS", 0.06)
    task = load_task("go1_rough")
    task.set("terrain.terrain_proportions", {"flat": 1.0})
    rough.prepare(task, repeats=1)
    env = task.env_class(task.cfg, "cpu")
    env.max_episode_length = 2
    rough.run_crossing(env, other)
    everyone = list(range(env.num_envs))
    assert other.forgotten == [None, [], everyone, []]


def test_the_viewer_forgets_a_robot_that_starts_again(actor: RNNModel) -> None:
    forget(actor)
    env = make_env(3, {"noise.level": 0.0})
    stage = EnvStage(env, actor)
    for _ in range(2):
        stage.step(None)
    stage.reset(1)
    held = memory_of(actor, 3).abs().amax(dim=(1, 2))
    assert held[0] > 0.0 and held[1] == 0.0 and held[2] > 0.0
    env.episode_length_buf = torch.tensor([0, 0, env.max_episode_length])
    stage.step(None)
    held = memory_of(actor, 3).abs().amax(dim=(1, 2))
    assert held[0] > 0.0 and held[1] > 0.0 and held[2] == 0.0


# ---- the export


@pytest.mark.parametrize(("kind", "layers"), [("gru", 1), ("lstm", 2)])
def test_an_export_remembers_as_the_policy_does(kind: str, layers: int, tmp_path: Path) -> None:
    """Eight steps of random observations, one robot reset on the way; and the policy read back from the file."""
    task = small_task(kind, layers)
    policy = saved(task, tmp_path / "model.pt")
    exported = export(task, tmp_path / "model.pt", tmp_path / "out")
    assert exported.gap < 1e-5
    contract = read_contract(tmp_path / "out")
    assert contract.memory and contract.memory[:2] == ("state_in", "state_out")
    assert contract.memory.shape == (layers * (2 if kind == "lstm" else 1), 8)
    network, memory = Network(tmp_path / "out", contract), contract.memory.start(3)
    again = load_policy(tmp_path / "out/policy.onnx", make_env(1), task.train, "cpu")
    observations = torch.randn(8, 3, 48, generator=torch.Generator().manual_seed(1)) * 2.0
    ended = torch.tensor([False, True, False])
    for step, observation in enumerate(observations):
        with torch.inference_mode():
            expected, same = (model({"state": observation}) for model in (policy, again))
        got, memory = network(observation.numpy(), memory)
        np.testing.assert_allclose(got, expected.clamp(-2.0, 2.0), atol=1e-5)
        np.testing.assert_allclose(memory, memory_of(policy, 3), atol=1e-5)
        assert torch.equal(same, expected)
        if step == 4:
            forget(policy, ended)
            forget(again, ended)
            memory[ended.numpy()] = 0.0


def test_half_precision_rounds_what_remembers_too(tmp_path: Path) -> None:
    task = small_task()
    saved(task, tmp_path / "model.pt")
    exported = export(task, tmp_path / "model.pt", tmp_path / "out", half=True)
    halves = [
        each.name
        for each in onnx.load(tmp_path / "out/policy.onnx").graph.initializer
        if each.data_type == onnx.TensorProto.FLOAT16
    ]
    assert (
        "policy.rnn.rnn.weight_hh_l0" in halves
        and "policy.rnn.rnn.bias_hh_l0" not in halves
        and 0.0 < exported.gap < 0.01
    )
    DeployStage(tmp_path / "out", 2).step(None)


def test_an_export_whose_memory_deploy_would_not_forget_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = small_task()
    saved(task, tmp_path / "model.pt")

    class Forgetful(Controller):
        def reset(self, which: Any = slice(None)) -> None:
            memory = None if self.memory is None else self.memory.copy()
            super().reset(which)
            self.memory = memory

    monkeypatch.setattr(export_replay, "Controller", Forgetful)
    with pytest.raises(
        ExportError, match=r"deploy would act differently from the environment: memory \d is 0 in the environment and "
    ):
        export(task, tmp_path / "model.pt", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_memory_of_another_size_is_refused(tmp_path: Path) -> None:
    task = small_task()
    saved(task, tmp_path / "model.pt")
    with pytest.raises(
        ConfigError, match=r"does not fit this task: actor mlp.0.weight is \(16, 8\) there and \(16, 9\) here"
    ):
        load_policy(tmp_path / "model.pt", make_env(1), small_task(settings={"actor.rnn_hidden_dim": 9}).train, "cpu")
    with pytest.raises(
        ConfigError, match=r"does not fit this task: actor rnn.rnn.weight_ih_l0 is \(24, 48\) there and \(32, 48\) here"
    ):
        load_policy(tmp_path / "model.pt", make_env(1), small_task("lstm").train, "cpu")


def test_a_contract_without_a_memory_stays_of_the_older_format() -> None:
    contract = read_contract(ROOT / "resources/policies/go1_flat")
    assert (
        contract.memory is None and contract.to_dict()["format"] == 5 and "memory" not in contract.to_dict()["network"]
    )
    assert (ROOT / "resources/policies/go1_flat" / CONTRACT_FILE).read_text().startswith("format: 5\n")
