"""The recorded update's kernels against torch's own, on a CPU; and hidden layers in bfloat16 against float32."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from learner import collect, difference, make, parameters, share_experience
from rsl_rl.modules import MLP
from test_ppo import SYMMETRY, update

from legged_mw.rl import networks
from legged_mw.rl.networks import HalfWeights, elu_layers, run_mlp
from legged_mw.rl.ppo import GraphedPPO


@pytest.fixture
def fused(monkeypatch: pytest.MonkeyPatch) -> None:
    """The kernels that a GPU uses, compiled for the CPU."""
    monkeypatch.setattr(networks, "FUSED_ON", ["cpu"])


def flat(gradients: Any) -> torch.Tensor:
    return torch.cat([gradient.flatten() for gradient in gradients])


def error(got: torch.Tensor, expected: torch.Tensor) -> float:
    """Of a whole vector, as a share of its length."""
    return float((got - expected).detach().norm() / expected.detach().norm())


VARIANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "log std, adamw, plain value loss": {
        "distribution": {"std_type": "log", "std_range": (0.2, 1.0)},
        "optimizer": "adamw",
        "use_clipped_value_loss": False,
    },
    "a std of each state": {"distribution": {"class_name": "HeteroscedasticGaussianDistribution"}},
    "mirror images": {"symmetry_cfg": SYMMETRY | {"use_mirror_loss": True, "mirror_loss_coeff": 0.5}},
    "a clipped gradient": {"max_grad_norm": 0.01, "desired_kl": 1e-6},
    "rows and columns that do not fit": {"num_mini_batches": 5},
}


@pytest.mark.parametrize(
    ("variant", "half"), [*((name, False) for name in VARIANTS), ("plain", True), ("mirror images", True)]
)
def test_fused_update_is_torchs_own(variant: str, half: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two updates of 20 minibatches each, from equal experience: parameters, losses and rate to rounding, of bfloat16 if ``half``."""
    plain, fused = make(GraphedPPO, **VARIANTS[variant]), make(GraphedPPO, **VARIANTS[variant])
    for alg in (plain, fused) if half else ():
        alg.learn_in_half()
    for seed in range(2):
        collect(plain, seed=seed)
        share_experience(plain, fused)
        monkeypatch.setattr(networks, "FUSED_ON", [])
        expected = update(plain)
        monkeypatch.setattr(networks, "FUSED_ON", ["cpu"])
        got = update(fused)
        # one bit of bfloat16 is 0.004
        assert difference(parameters(plain), parameters(fused)) < (0.05 if half else 1e-4)
        assert got == pytest.approx(expected, rel=0.05 if half else 1e-4, abs=1e-3 if half else 1e-6)
        assert fused.learning_rate == pytest.approx(plain.learning_rate, rel=1e-9)


def test_what_is_not_finite_stays_so(fused: None) -> None:
    """A sample that is no number reaches the parameters, where it is found and undone."""
    alg = make(GraphedPPO)
    collect(alg)
    before = parameters(alg)
    alg.storage.actions[0, 0, 0] = float("nan")
    update(alg)
    assert alg.rollback.undone and difference(before, parameters(alg)) == 0.0


@pytest.mark.parametrize("kernels", [[], ["cpu"]], ids=["torch", "fused"])
@pytest.mark.parametrize("rows", [192, 7])
def test_elu_layers_are_torchs_own(rows: int, kernels: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Output and all gradients, of inputs too; in bfloat16 to its rounding."""
    monkeypatch.setattr(networks, "FUSED_ON", kernels)
    torch.manual_seed(0)
    net, x, seed = MLP(5, 3, [32, 16], "elu"), torch.randn(rows, 5, requires_grad=True), torch.randn(rows, 3)
    expected = net(x)
    gradients = torch.autograd.grad(expected, (x, *net.parameters()), seed)
    got = run_mlp(net, x)
    assert got.grad_fn is not None and "EluLayers" in got.grad_fn.name()
    torch.testing.assert_close(got, expected)
    for one, other in zip(torch.autograd.grad(got, (x, *net.parameters()), seed), gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)
    half = HalfWeights(elu_layers(net))
    rounded = run_mlp(net, half.prepare(x.detach()), half.read())
    assert rounded.dtype == torch.float32 and 1e-4 < error(rounded, expected) < 0.01
    found = torch.autograd.grad(rounded, (*net.parameters(),), seed)
    assert all(gradient.dtype == torch.float32 for gradient in found)
    assert 1e-4 < error(flat(found), flat(gradients[1:])) < 0.02


def test_other_activations_keep_full_precision() -> None:
    assert not elu_layers(MLP(5, 3, [32, 16], "relu")) and len(elu_layers(MLP(5, 3, [32, 16], "elu"))) == 3
    torch.manual_seed(0)
    net, x = MLP(5, 3, [32, 16], "relu"), torch.randn(8, 5)
    torch.testing.assert_close(run_mlp(net, x), net(x))


def test_half_acts_as_it_learns() -> None:
    """The policy of the first minibatch is the one that acted: else its ratios are not 1, and the rate adapts to rounding."""
    alg = make(GraphedPPO, num_mini_batches=1)
    exact = copy.deepcopy(alg.actor)
    alg.learn_in_half()
    collect(alg)
    st = alg.storage
    acted = st.distribution_params[0].flatten(0, 1)
    batch = alg._prepare(torch.arange(len(acted)))
    assert batch.actor_input.dtype == torch.bfloat16 and batch.actor_input.shape[1] == 8
    with torch.no_grad():
        learns = alg._forward(alg.actor, batch.actor_input)
        float32 = exact(st.observations.flatten(0, 1))
    assert error(learns, acted) < 1e-6 < 1e-4 < error(float32, acted) < 0.02


def test_half_learns_what_float32_does() -> None:
    """Three updates from equal experience move the parameters nearly alike; checkpoints hold float32."""
    full, half = make(GraphedPPO, schedule="fixed"), make(GraphedPPO, schedule="fixed")
    half.learn_in_half()
    before = parameters(full)
    for seed in range(3):
        collect(full, seed=seed)
        share_experience(full, half)
        update(full)
        update(half)
    moved = [flat([p - before[name] for name, p in parameters(alg).items() if "mlp" in name]) for alg in (full, half)]
    assert 0.0 < error(moved[1], moved[0]) < 0.1
    assert {value.dtype for value in half.save()["actor_state_dict"].values() if value.is_floating_point()} == {
        torch.float32
    }


def test_parameters_lie_in_one_tensor_a_part() -> None:
    """Each begins where fast products want it."""
    alg = make(GraphedPPO)
    for network in (alg.actor, alg.critic):
        starts = [parameter.data_ptr() for parameter in network.parameters()]
        assert len({parameter.untyped_storage().data_ptr() for parameter in network.parameters()}) == 1
        assert all((start - min(starts)) % 256 == 0 for start in starts)
