"""GRU and LSTM networks in the recorded rollout and update, against rsl-rl's own recurrent PPO."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import torch
from learner import (
    ACTIONS,
    STEPS,
    WORLDS,
    collect,
    difference,
    make,
    observations,
    parameters,
    share_experience,
    turned,
)
from rsl_rl.algorithms import PPO
from test_ppo import update
from torch import Tensor, nn

from legged_mw.check.recordable import recordable
from legged_mw.rl.ppo import GraphedPPO
from legged_mw.rl.students.recurrent import HiddenState, SequenceInput, step, unroll


def rnn(kind: str, layers: int = 1) -> dict[str, Any]:
    return {"class_name": "RNNModel", "rnn_type": kind, "rnn_hidden_dim": 12, "rnn_num_layers": layers}


NETWORKS: dict[str, dict[str, dict[str, Any]]] = {
    "gru": {"actor": rnn("gru"), "critic": rnn("gru")},
    "lstm": {"actor": rnn("lstm"), "critic": rnn("lstm")},
    "two layers": {"actor": rnn("gru", 2), "critic": rnn("lstm", 2)},
    "actor alone": {"actor": rnn("gru")},
    "critic alone": {"critic": rnn("lstm")},
}
SETTINGS: dict[str, dict[str, Any]] = {
    "worlds left over": {"num_mini_batches": 5},
    "advantages by minibatch": {"normalize_advantage_per_mini_batch": True},
    "plain value loss, fixed rate": {"use_clipped_value_loss": False, "schedule": "fixed"},
}
CASES = [
    *((memory, {}) for memory in NETWORKS.values()),
    *((NETWORKS["gru"], settings) for settings in SETTINGS.values()),
]
IMAGES = {"data_augmentation_func": turned, "use_data_augmentation": True, "env": None}


@pytest.fixture
def in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """rsl-rl takes the worlds of a minibatch in their order; here the order is drawn."""
    monkeypatch.setattr(torch, "randperm", lambda count, out: out.copy_(torch.arange(count, device=out.device)))


@torch.inference_mode()
def share_memory(source: PPO, target: GraphedPPO) -> None:
    """The states with which the stock learner's rollout began, into ours."""
    for model, saved in (
        (target.actor, source.storage.saved_hidden_state_a),
        (target.critic, source.storage.saved_hidden_state_c),
    ):
        if saved:
            target._memories[model].start.copy_(torch.cat([states[0] for states in saved])[:, None])


@pytest.mark.parametrize(("memory", "settings"), CASES, ids=[*NETWORKS, *SETTINGS])
def test_same_parameters_as_rsl_rl(
    memory: dict[str, Any], settings: dict[str, Any], double: None, in_order: None
) -> None:
    """In float64: two updates, each from new experience of the stock learner, whose memory goes on from one to the next."""
    stock, ours = make(PPO, memory=memory, **settings), make(GraphedPPO, memory=memory, **settings)
    assert isinstance(ours, GraphedPPO) and difference(parameters(stock), parameters(ours)) == 0.0
    before = parameters(ours)
    for seed in range(2):
        collect(stock, seed=seed)
        share_experience(stock, ours)
        share_memory(stock, ours)
        expected, got = update(stock), update(ours)
        assert difference(parameters(stock), parameters(ours)) < 1e-6  # our rate is float32, as the fused Adam wants it
        assert got == pytest.approx(expected, rel=1e-6, abs=1e-8)  # reported in float32
    assert difference(before, parameters(ours)) > 1e-2


@pytest.mark.parametrize("kind", ["gru", "lstm"])
def test_same_parameters_as_rsl_rl_in_float32(kind: str, in_order: None) -> None:
    """One update of 20 minibatches, as a share of each parameter's largest value."""
    stock, ours = (make(algorithm, memory=NETWORKS[kind]) for algorithm in (PPO, GraphedPPO))
    collect(stock)
    share_experience(stock, ours)
    share_memory(stock, ours)
    update(stock)
    update(ours)
    assert difference(parameters(stock), parameters(ours)) < 3e-5


@pytest.mark.parametrize("memory", NETWORKS.values(), ids=NETWORKS.keys())
def test_same_rollouts_as_rsl_rl(memory: dict[str, Any], in_order: None) -> None:
    """Float32: two rollouts with ends of episodes, an update between; actions, values, returns and what is remembered."""
    stock, ours = make(PPO, memory=memory), make(GraphedPPO, memory=memory)
    for seed in (2, 3):
        for alg in (stock, ours):
            collect(alg, seed=seed)
        assert 0 < int(stock.storage.dones.sum()) < WORLDS * STEPS
        for name in ("actions", "values", "actions_log_prob", "returns", "advantages"):
            torch.testing.assert_close(getattr(ours.storage, name), getattr(stock.storage, name), rtol=1e-4, atol=1e-4)
        for which in memory:
            theirs = getattr(stock, which).get_hidden_state()
            now = torch.cat(theirs) if isinstance(theirs, tuple) else theirs
            torch.testing.assert_close(ours._memories[getattr(ours, which)].now[:, 0], now, rtol=1e-4, atol=1e-5)
        for alg in (stock, ours):
            update(alg)
        assert difference(parameters(stock), parameters(ours)) < 1e-3  # two float32 updates of Adam


def test_a_critics_last_look_is_not_remembered() -> None:
    ours = make(GraphedPPO, memory=NETWORKS["lstm"])
    collect(ours)
    before = ours._memories[ours.critic].now.clone()
    with torch.inference_mode():
        ours.compute_returns(observations(torch.Generator().manual_seed(9), "cpu"))
    assert torch.equal(ours._memories[ours.critic].now, before) and ours.critic.get_hidden_state() is None


def test_minibatches_are_whole_worlds_of_a_drawn_order() -> None:
    """Each world in one of them, all of its steps in order."""
    ours = make(GraphedPPO, memory=NETWORKS["gru"])
    collect(ours)
    update(ours)
    order = ours._order.clone()
    assert sorted(order.tolist()) == list(range(WORLDS)) and order.tolist() != sorted(order.tolist())
    minibatch = ours._prepare(order[8:16])
    assert minibatch.actor_input.inputs.shape == (1, STEPS, 8, 8) and minibatch.critic_input.keep.shape == (STEPS, 8, 1)
    assert torch.equal(minibatch.batch.actions.view(STEPS, 8, ACTIONS), ours.storage.actions[:, order[8:16]])
    ended = ours.storage.dones[:, order[8:16]]
    assert torch.equal(minibatch.critic_input.keep[1:], 1.0 - ended[:-1].float()) and bool(
        (minibatch.critic_input.keep[0] == 1.0).all()
    )


@pytest.mark.parametrize("kind", [nn.GRU, nn.LSTM])
def test_an_unrolled_layer_is_torchs_own(kind: Any, double: None) -> None:
    """Values and the gradients of all parameters, where nothing ends; and of one step."""
    torch.manual_seed(0)
    network = kind(5, 7, 2)
    states = 4 if kind is nn.LSTM else 2
    x, state, weight = torch.randn(1, 6, 3, 5), torch.randn(states, 1, 3, 7), torch.randn(18, 7)
    expected, after = network(x[0], tuple(state[:, 0].split(2)) if kind is nn.LSTM else state[:, 0])
    got = unroll(network, SequenceInput(x, state, torch.ones(6, 3, 1)))
    torch.testing.assert_close(got, expected.flatten(0, 1))
    gradients = [torch.autograd.grad((y.reshape(18, 7) * weight).sum(), network.parameters()) for y in (expected, got)]  # type: ignore[arg-type]
    torch.testing.assert_close(*gradients)
    out, now = x.new_zeros(0), state[:, 0]
    for t in range(6):
        out, now = step(network, x[0, t], now)
    torch.testing.assert_close(out, expected[-1])
    torch.testing.assert_close(now, torch.cat(after) if kind is nn.LSTM else after)


def test_a_gru_by_hand(double: None) -> None:
    """One unit of one input, weights 1, biases 0; after the end of an episode it is as at first."""
    network = nn.GRU(1, 1)
    for parameter, value in zip(network.parameters(), (1.0, 1.0, 0.0, 0.0), strict=True):
        parameter.data.fill_(value)
    keep = torch.tensor([1.0, 1.0, 0.0]).view(3, 1, 1)
    got = unroll(network, SequenceInput(torch.ones(1, 3, 1, 1), torch.zeros(1, 1, 1, 1), keep)).flatten().tolist()
    # z = r = sigmoid(1) = 0.731059, n = tanh(1) = 0.761594: h = 0.268941 * 0.761594
    # then z = r = sigmoid(1.204824) = 0.769382, n = tanh(1 + 0.769382 * 0.204824) = 0.820252: h = 0.230618 * 0.820252 + 0.769382 * 0.204824
    assert got == pytest.approx([0.204824, 0.346753, 0.204824], abs=1e-6)


# ---- mirror images


def test_mirror_images_are_run_through_the_network(double: None, in_order: None) -> None:
    """As if a second learner had seen nothing but the mirror images: its states, and in the update its outputs, are ours."""
    plain, ours = (make(GraphedPPO, memory=NETWORKS["lstm"], symmetry_cfg=images) for images in (None, IMAGES))
    generator = torch.Generator().manual_seed(4)
    with torch.inference_mode():
        for _ in range(STEPS):
            obs, ended = observations(generator, "cpu"), torch.rand(WORLDS, generator=generator) < 0.2
            for alg, seen in ((plain, turned(None, obs, None)[0][WORLDS:]), (ours, obs)):  # type: ignore[index]
                alg.act(seen)
                alg.process_env_step(seen, torch.zeros(WORLDS), ended, {})
    for which in ("actor", "critic"):
        theirs, mine = (alg._memories[getattr(alg, which)].now for alg in (plain, ours))
        torch.testing.assert_close(mine[:, 1], theirs[:, 0])
        assert not torch.equal(mine[:, 0], mine[:, 1])
    assert ours.storage.actions.shape == (STEPS, WORLDS, ACTIONS)
    order = torch.arange(8)
    theirs, mine = (unroll(alg.actor.rnn.rnn, alg._prepare(order).actor_input) for alg in (plain, ours))
    torch.testing.assert_close(mine[STEPS * 8 :], theirs)


@pytest.mark.parametrize("coefficient", [0.0, 0.5])
def test_symmetric_samples_teach_a_recurrent_policy_symmetry(coefficient: float) -> None:
    """The distance to the mirror image shrinks, also where it is only reported."""
    images = IMAGES | ({"use_mirror_loss": True, "mirror_loss_coeff": coefficient} if coefficient else {})
    ours = make(
        GraphedPPO,
        memory=NETWORKS["gru"],
        symmetry_cfg=images,
        schedule="fixed",
        learning_rate=1e-2 if coefficient else 3e-3,
    )
    distances = []
    for seed in range(8):
        collect(ours, seed=seed)
        distances.append(update(ours)["symmetry"])
    assert distances[-1] < (0.5 if coefficient else 0.9) * distances[0]


# ---- what is refused, saved and recorded


@pytest.mark.parametrize(
    "kinds", [(PPO, GraphedPPO), (GraphedPPO, PPO), (GraphedPPO, GraphedPPO)], ids=["to ours", "to stock", "ours"]
)
def test_checkpoints_load_in_both_directions(kinds: tuple[type[PPO], type[PPO]]) -> None:
    """Whoever loads one begins every world's episode, and so remembers nothing."""
    writer, other = (make(kind, memory=NETWORKS["lstm"]) for kind in kinds)
    for alg in (writer, other):
        collect(alg)
    update(writer)
    other.load(copy.deepcopy(writer.save()), None, True)
    assert difference(parameters(writer), parameters(other)) == 0.0 and other.learning_rate == writer.learning_rate
    if isinstance(other, GraphedPPO):
        assert all(not memory.now.any() for memory in other._memories.values())


@pytest.mark.parametrize("symmetry", [None, IMAGES], ids=["plain", "mirrored"])
def test_rollout_and_update_can_be_recorded(symmetry: dict[str, Any] | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing asks the host; shapes do not depend on where episodes ended; nothing that stays is moved."""
    # torch moves the norms to the device where they are
    monkeypatch.setattr(nn.utils, "clip_grad_norm_", lambda *_: None)
    ours = make(GraphedPPO, memory=NETWORKS["two layers"], symmetry_cfg=symmetry)
    collect(ours)
    update(ours)
    collect(ours, seed=5)
    places = [memory.now.data_ptr() for memory in ours._memories.values()]
    ended = torch.arange(WORLDS) < 5
    with recordable():
        with torch.inference_mode():
            ours._act()
            ours._memories[ours.actor].forget(ended)
            ours._compute_returns()
        ours._update()
    assert places == [memory.now.data_ptr() for memory in ours._memories.values()]


def test_a_world_that_is_not_finite_is_forgotten() -> None:
    memory = HiddenState(make(GraphedPPO, memory=NETWORKS["gru"]).actor, 3, 1, "cpu")
    memory.now.fill_(float("nan"))
    memory.forget(torch.tensor([True, False, True]))
    finite: Tensor = memory.now.isfinite().all(dim=(0, 1, 3))  # type: ignore[call-overload]
    assert finite.tolist() == [True, False, True]
