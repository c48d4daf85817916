"""The recorded update against rsl-rl's own: same parameters, experience and order of samples in, same parameters out."""

from __future__ import annotations

import copy
from typing import Any

import learner
import pytest
import torch
from learner import SIZES, collect, difference, make, parameters, share_experience, turned
from rsl_rl.algorithms import PPO
from rsl_rl.models import MLPModel

from legged_mw.rl.learner_config import rsl_rl_config
from legged_mw.rl.networks import Linear
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.utils.task import load_task

SYMMETRY = {"data_augmentation_func": turned, "use_data_augmentation": True, "env": None}
VARIANTS: dict[str, dict[str, Any]] = {
    "adaptive rate": {},
    "fixed rate": {"schedule": "fixed", "learning_rate": 3e-4},
    "a rate that grows": {"desired_kl": 1.0},
    "a rate that shrinks": {"desired_kl": 1e-6},
    "plain value loss": {"use_clipped_value_loss": False},
    "advantages by minibatch": {"normalize_advantage_per_mini_batch": True},
    "a number of minibatches that leaves samples over": {"num_mini_batches": 5},
    "adamw": {"optimizer": "adamw"},
    "log std": {"distribution": {"std_type": "log", "std_range": (0.2, 1.0)}},
    "a std of each state": {"distribution": {"class_name": "HeteroscedasticGaussianDistribution"}},
    "symmetric samples": {"symmetry_cfg": SYMMETRY},
    "mirror loss": {
        "symmetry_cfg": SYMMETRY | {"use_data_augmentation": False, "use_mirror_loss": True, "mirror_loss_coeff": 0.5}
    },
    "both": {"symmetry_cfg": SYMMETRY | {"use_mirror_loss": True, "mirror_loss_coeff": 0.5}},
}


def update(alg: PPO, seed: int = 3) -> dict[str, float]:
    torch.manual_seed(seed)  # both draw one permutation first
    return {name: float(value) for name, value in alg.update().items()}


@pytest.mark.parametrize("settings", VARIANTS.values(), ids=VARIANTS.keys())
def test_same_parameters_as_rsl_rl(settings: dict[str, Any], double: None) -> None:
    """In float64: two updates, each from new experience that the stock learner gathered."""
    stock, ours = make(PPO, **settings), make(GraphedPPO, **settings)
    assert isinstance(ours, GraphedPPO) and difference(parameters(stock), parameters(ours)) == 0.0
    before = parameters(ours)
    for seed in range(2):
        collect(stock, seed=seed)
        share_experience(stock, ours)
        expected, got = update(stock), update(ours)
        assert difference(parameters(stock), parameters(ours)) < 1e-6  # our rate is float32, as the fused Adam wants it
        assert got == pytest.approx(expected, rel=1e-6, abs=1e-8)  # reported in float32
        assert ours.learning_rate == pytest.approx(stock.learning_rate, rel=1e-12)
    assert difference(before, parameters(ours)) > 1e-2


def test_same_rollout_as_rsl_rl() -> None:
    """Actions, values, log probabilities, returns and advantages, from equal random numbers."""
    stock, ours = make(PPO), make(GraphedPPO)
    collect(stock)
    collect(ours)
    for name in ("observations", "actions", "rewards", "dones", "values", "actions_log_prob", "returns", "advantages"):
        expected, got = getattr(stock.storage, name), getattr(ours.storage, name)
        pairs = [(expected[k], got[k]) for k in SIZES] if name == "observations" else [(expected, got)]
        for a, b in pairs:
            torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-5, msg=lambda text, name=name: f"{name}: {text}")
    for a, b in zip(stock.storage.distribution_params, ours.storage.distribution_params, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize(
    "kinds", [(PPO, GraphedPPO), (GraphedPPO, PPO), (GraphedPPO, GraphedPPO)], ids=["to ours", "to stock", "ours"]
)
def test_checkpoints_load_in_both_directions(kinds: tuple[type[PPO], type[PPO]]) -> None:
    """And learning goes on as if it had not been interrupted: Adam's memory and the adapted rate come along."""
    writer, other = (make(kind) for kind in kinds)
    collect(writer)
    update(writer)
    content = writer.save()
    assert {type(group["lr"]) for group in content["optimizer_state_dict"]["param_groups"]} == {float}
    other.load(copy.deepcopy(content), None, True)  # as from a file
    assert difference(parameters(writer), parameters(other)) == 0.0
    assert other.learning_rate == writer.learning_rate != 1e-3
    collect(writer, seed=5)
    share_experience(writer, other)
    update(writer)
    update(other)
    assert difference(parameters(writer), parameters(other)) < 1e-5
    assert other.learning_rate == pytest.approx(writer.learning_rate)


def test_checkpoint_is_in_the_form_of_rsl_rls_own() -> None:
    """Entry by entry: kinds, places and shapes of all that the file holds."""
    stock, ours = make(PPO), make(GraphedPPO)
    for alg in (stock, ours):
        collect(alg)
        update(alg)

    def form(value: Any) -> Any:
        if isinstance(value, dict):
            return {k: form(v) for k, v in value.items()}
        if isinstance(value, (list, tuple)):
            return [form(v) for v in value]
        return (value.dtype, value.shape, value.device.type) if isinstance(value, torch.Tensor) else type(value)

    assert form(ours.save()) == form(stock.save())


def test_learning_rate_can_be_set() -> None:
    ours = make(GraphedPPO, schedule="fixed")
    before = parameters(ours)
    ours.learning_rate = 0.0
    collect(ours)
    update(ours)
    trained = {k: v for k, v in parameters(ours).items() if "normalizer" not in k}
    assert difference({k: before[k] for k in trained}, trained) == 0.0
    assert ours.learning_rate == 0.0


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"optimizer": "sgd"}, "the optimizer is SGD"),
        ({"distribution": {"class_name": "BetaDistribution"}}, "drawn from a BetaDistribution"),
        ({"use_mixed_precision": True}, "use_mixed_precision is set"),
    ],
    ids=["sgd", "beta", "mixed precision"],
)
def test_what_cannot_be_recorded_is_left_to_rsl_rl(
    settings: dict, reason: str, capsys: pytest.CaptureFixture[str]
) -> None:
    alg = make(GraphedPPO, **settings)
    collect(alg)
    assert type(alg) is PPO and set(update(alg)) == {"value", "surrogate", "entropy"}
    said = capsys.readouterr().out
    assert said.count("rsl-rl's own update is used, not the recorded one: ") == 1 and reason in said


@pytest.mark.parametrize("rows", [384, 7, 1])
def test_linear_is_torchs_own(rows: int) -> None:
    """Value and all three gradients, also for inputs that are padded with columns of zeros."""
    torch.manual_seed(0)
    x, weight, bias = (
        torch.randn(rows, 5, requires_grad=True),
        torch.randn(3, 5, requires_grad=True),
        torch.randn(3, requires_grad=True),
    )
    padded = torch.nn.functional.pad(x.detach(), (0, 3))
    seed = torch.randn(rows, 3)
    expected = torch.nn.functional.linear(x, weight, bias)
    gradients = torch.autograd.grad(expected, (x, weight, bias), seed)
    torch.testing.assert_close(Linear.apply(x, weight, bias), expected)
    for got, wanted in zip(
        torch.autograd.grad(Linear.apply(x, weight, bias), (x, weight, bias), seed), gradients, strict=True
    ):  # type: ignore[arg-type]
        torch.testing.assert_close(got, wanted)
    torch.testing.assert_close(Linear.apply(padded, weight, bias), expected)
    for got, wanted in zip(
        torch.autograd.grad(Linear.apply(padded, weight, bias), (weight, bias), seed), gradients[1:], strict=True
    ):  # type: ignore[arg-type]
        torch.testing.assert_close(got, wanted)


def test_entropy_and_kl_target_may_change_between_updates() -> None:
    """They are not frozen into the record: the next update uses the new values, as rsl-rl's own does."""
    stock, ours = make(PPO), make(GraphedPPO)
    for alg in (stock, ours):
        alg.entropy_coef, alg.desired_kl = 0.5, 1.0
    collect(stock)
    share_experience(stock, ours)
    update(stock)
    update(ours)
    assert difference(parameters(stock), parameters(ours)) < 1e-5
    assert ours.learning_rate == pytest.approx(1e-2)  # it grows to the end, since no step is far enough


def test_the_adaptive_rate_goes_up_to_a_bound() -> None:
    ours = make(GraphedPPO, max_learning_rate=2e-3, desired_kl=1.0)
    collect(ours)
    update(ours)
    assert ours.learning_rate == pytest.approx(2e-3)


def test_a_rate_of_a_checkpoint_comes_down_to_the_bound() -> None:
    fast, bounded = make(GraphedPPO), make(GraphedPPO, max_learning_rate=2e-3)
    fast.learning_rate = 8e-3
    bounded.load(fast.save(), None, True)
    assert bounded.learning_rate == pytest.approx(2e-3)
    same = make(GraphedPPO)
    same.load(fast.save(), None, True)
    assert same.learning_rate == pytest.approx(8e-3)


def test_the_default_bound_is_no_bound_of_a_fixed_rate() -> None:
    task = load_task("go1_flat")
    task.set("algorithm.schedule", "fixed")
    assert "max_learning_rate" not in rsl_rl_config(task.train)["algorithm"]


class Encoder(MLPModel):
    """Learns something in a place that the recorded update would not reach."""

    def get_latent(self, *args: Any, **kwargs: Any) -> torch.Tensor:
        return super().get_latent(*args, **kwargs)


def test_a_network_of_ones_own_is_left_to_rsl_rl(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learner, "MODEL", Encoder)
    assert type(make(GraphedPPO)) is PPO
    assert "not the recorded one: a network is a Encoder" in capsys.readouterr().out


def test_a_critics_warm_up() -> None:
    """The actor stands to the bit, its normalizer and Adam's memory too; afterwards an adaptive rate begins at its lowest."""
    ours = make(GraphedPPO)
    ours.learn_critic_only(True)
    before = parameters(ours)
    for seed in range(2):
        collect(ours, seed=seed)
        assert update(ours).keys() == {"value", "surrogate", "entropy"}
    warm = parameters(ours)
    assert {name for name in warm if not torch.equal(warm[name], before[name])} == {
        name for name in warm if name.startswith("critic.")
    }
    assert ours.learning_rate == 1e-3 and not any(
        id(p) in map(id, ours.optimizer.state) for p in ours.actor.parameters()
    )
    ours.learn_critic_only(False)
    assert ours.learning_rate == 1e-5
    collect(ours)
    update(ours)
    assert (
        not torch.equal(parameters(ours)["actor.mlp.0.weight"], warm["actor.mlp.0.weight"])
        and ours.learning_rate > 1e-5
    )
    fixed = make(GraphedPPO, schedule="fixed", learning_rate=3e-4)
    for on in (True, False):
        fixed.learn_critic_only(on)
    assert fixed.learning_rate == 3e-4
