"""The recorded distillation against rsl-rl's own: same parameters and experience in, same parameters out."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from learner import ACTIONS, SIZES, STEPS, WORLDS, Env, difference, observations
from rsl_rl.algorithms import Distillation
from rsl_rl.models import MLPModel

from legged_mw.check.recordable import recordable
from legged_mw.rl.learner_config import network_section
from legged_mw.rl.students.distillation import GraphedDistillation

VARIANTS: dict[str, dict[str, Any]] = {
    "steps in pairs": {"gradient_length": 2},
    "a rollout at once": {"gradient_length": STEPS, "num_learning_epochs": 3},
    "a bound on the gradient": {"gradient_length": 3, "max_grad_norm": 0.05},
    "huber": {"gradient_length": 2, "loss_type": "huber"},
    "adamw": {"gradient_length": 1, "optimizer": "adamw"},
    "gru": {"gradient_length": 2, "memory": "gru"},
    "lstm": {"gradient_length": 3, "num_learning_epochs": 2, "memory": "lstm"},
}


def make(
    kind: type[Distillation],
    device: str = "cpu",
    distribution: dict[str, Any] | None = None,
    sees: tuple[str, ...] = (*SIZES,),
    memory: str | None = None,
    **settings: Any,
) -> Any:
    """A learner whose networks come from a fixed seed; the teacher sees more than the student's "state". ``memory``: the student's."""
    torch.manual_seed(1)
    recurrent = (
        {"class_name": "RNNModel", "rnn_type": memory, "rnn_hidden_dim": 12, "rnn_num_layers": 2} if memory else {}
    )
    network = {"class_name": MLPModel, "hidden_dims": [32, 16], "activation": "elu", "obs_normalization": True}
    gaussian = {"class_name": "GaussianDistribution", "init_std": 0.1}
    cfg = {
        "obs_groups": {"student": ["state"], "teacher": [*sees]},
        "student": network_section({**network, **recurrent, "distribution_cfg": distribution or gaussian}),
        "teacher": {**network, "distribution_cfg": dict(gaussian)},
        "algorithm": {"class_name": kind, **settings},
        "num_steps_per_env": STEPS,
        "multi_gpu": None,
    }
    obs = observations(torch.Generator().manual_seed(0), device)
    alg = kind.construct_algorithm(obs, Env(), copy.deepcopy(cfg), device)  # type: ignore[arg-type]
    alg.train_mode()
    with torch.no_grad():  # as trained: it does not see zero mean and unit variance
        alg.teacher.obs_normalizer._mean.fill_(1.0)
        alg.teacher.obs_normalizer._std.fill_(2.0)
    return alg


def collect(alg: Any, device: str = "cpu", seed: int = 2) -> list[torch.Tensor]:
    """Fill the storage; returns the actions."""
    generator = torch.Generator().manual_seed(seed)
    torch.manual_seed(seed)
    acted = []
    with torch.inference_mode():
        for _ in range(STEPS):
            acted.append(alg.act(observations(generator, device)))
            ended = torch.rand(WORLDS, generator=generator).to(device) < 0.2
            alg.process_env_step(observations(generator, device), torch.zeros(WORLDS, device=device), ended, {})
    return acted


@torch.inference_mode()
def share_experience(source: Any, target: Any) -> None:
    """``target`` learns from what ``source`` has seen."""
    for name in ("actions", "privileged_actions", "dones"):
        getattr(target.storage, name).copy_(getattr(source.storage, name))
    for memory in target._memories.values():
        memory.start.copy_(memory.now)  # as the first step of a rollout does
    for group in target.storage.observations.keys():  # noqa: SIM118  (a TensorDict iterates over its rows)
        target.storage.observations[group].copy_(source.storage.observations[group])


@torch.no_grad()
def take_over(target: Any, source: Any) -> None:
    """``target`` gets the student and Adam's memory of ``source``, in place: what is recorded stays recorded."""
    for mine, other in zip(target.student.state_dict().values(), source.student.state_dict().values(), strict=True):
        mine.copy_(other)
    for mine, other in zip(target.student.parameters(), source.student.parameters(), strict=True):
        for name, memory in target.optimizer.state[mine].items():
            memory.copy_(source.optimizer.state[other][name])


def parameters(alg: Any) -> dict[str, torch.Tensor]:
    return {
        f"{which}.{k}": v.clone()
        for which in ("student", "teacher")
        for k, v in getattr(alg, which).state_dict().items()
    }


@pytest.mark.parametrize("settings", VARIANTS.values(), ids=VARIANTS.keys())
def test_same_parameters_as_rsl_rl(settings: dict[str, Any], double: None) -> None:
    """In float64: three updates, each from new experience that the stock learner gathered."""
    stock, ours = make(Distillation, **settings), make(GraphedDistillation, **settings)
    assert isinstance(ours, GraphedDistillation) and difference(parameters(stock), parameters(ours)) == 0.0
    before = parameters(ours)
    for seed in range(3):
        collect(stock, seed=seed)
        share_experience(stock, ours)
        expected, got = stock.update(), ours.update()
        assert difference(parameters(stock), parameters(ours)) < 1e-9
        assert float(got["behavior"]) == pytest.approx(expected["behavior"], rel=1e-9)
    moved = {k for k, v in parameters(ours).items() if not torch.equal(v, before[k])}
    assert {k for k in before if k.startswith("student.mlp.")} <= moved and not {
        k for k in moved if k.startswith("teacher.")
    }
    assert "student.obs_normalizer._std" in moved


def test_same_parameters_in_float32() -> None:
    stock, ours = make(Distillation, gradient_length=2), make(GraphedDistillation, gradient_length=2)
    collect(stock)
    share_experience(stock, ours)
    assert float(ours.update()["behavior"]) == pytest.approx(stock.update()["behavior"], rel=1e-5)
    assert difference(parameters(stock), parameters(ours)) < 1e-4


@pytest.mark.parametrize("memory", [None, "gru", "lstm"])
def test_same_rollout_as_rsl_rl(memory: str | None) -> None:
    """The student's noisy actions and the teacher's exact ones, from equal random numbers; what the teacher saw is not kept."""
    stock, ours = (make(kind, gradient_length=2, memory=memory) for kind in (Distillation, GraphedDistillation))
    for expected, got in zip(collect(stock), collect(ours), strict=True):
        torch.testing.assert_close(got, expected)
    for name in ("actions", "privileged_actions", "dones"):
        torch.testing.assert_close(getattr(ours.storage, name), getattr(stock.storage, name))
    torch.testing.assert_close(ours.storage.observations["state"], stock.storage.observations["state"])
    assert {*ours.storage.observations.keys()} == {"state"} and {*stock.storage.observations.keys()} == {*SIZES}
    assert ours.storage.actions.shape[-1] == ACTIONS and ours.storage.privileged_actions.std() > 0.01


def test_the_student_comes_nearer() -> None:
    """To a teacher that sees no more than it: the loss over one batch falls to a tenth of where it began."""
    alg = make(GraphedDistillation, sees=("state",), gradient_length=2, num_learning_epochs=5, learning_rate=3e-3)
    collect(alg)
    losses = [float(alg.update()["behavior"]) for _ in range(60)]  # an update leaves the batch as it is
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.parametrize("memory", [None, "gru", "lstm"])
def test_nothing_asks_the_host(memory: str | None) -> None:
    """The guard that watches a task's step watches acting and the update, which a GPU records."""
    alg = make(
        GraphedDistillation, gradient_length=2, memory=memory
    )  # torch clips by a .to() of the same device, which the guard takes for a copy
    collect(alg)
    alg.update()  # Adam's memory is made in the first update
    with recordable():
        with torch.inference_mode():
            alg._act()
        alg._update()


@pytest.mark.parametrize(
    "kinds", [(Distillation, GraphedDistillation), (GraphedDistillation, Distillation)], ids=["to ours", "to stock"]
)
def test_checkpoints_load_in_both_directions(kinds: tuple[type, type]) -> None:
    writer, other = (make(kind, gradient_length=2) for kind in kinds)
    collect(writer)
    writer.update()
    content = writer.save()
    assert {"student_state_dict", "teacher_state_dict", "optimizer_state_dict"} == content.keys()
    assert [
        (type(group["lr"]), group["fused"], group["capturable"])
        for group in content["optimizer_state_dict"]["param_groups"]
    ] == [(float, None, False)]
    other.load(copy.deepcopy(content), None, True)  # as from a file
    assert difference(parameters(writer), parameters(other)) == 0.0 and other.teacher_loaded
    collect(writer, seed=5)
    collect(other, seed=5)  # equal networks and random numbers: the same experience
    for alg in (writer, other):
        alg.update()
    assert difference(parameters(writer), parameters(other)) < 1e-5


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"gradient_length": 4}, f"gradient_length 4 does not divide a rollout of {STEPS} steps"),
        ({"gradient_length": 2, "optimizer": "sgd"}, "the optimizer is SGD"),
        ({"gradient_length": 2, "use_mixed_precision": True}, "use_mixed_precision is set"),
        ({"gradient_length": 2, "distribution": {"class_name": "BetaDistribution"}}, "drawn from a BetaDistribution"),
    ],
    ids=["leftover", "sgd", "mixed precision", "beta"],
)
@pytest.mark.filterwarnings("ignore:The product of 'num_learning_epochs'")
def test_what_cannot_be_recorded_is_left_to_rsl_rl(
    settings: dict, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    alg = make(GraphedDistillation, **settings)
    collect(alg)
    assert type(alg) is Distillation and {*alg.update()} == {"behavior"}
    said = capsys.readouterr().out
    assert said.count("rsl-rl's own update is used, not the recorded one: ") == 1 and reason in said
