"""What is not finite, or absurd, costs at most one update: it is undone, counted and named, and three in a row end the run."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from learner import collect, make, parameters
from program import SMALL, Result, run
from rsl_rl.modules import EmpiricalNormalization
from torch import nn

from legged_mw.check.recordable import recordable
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Observations
from legged_mw.envs.statistics import NonFinite
from legged_mw.rl import ppo
from legged_mw.rl.iteration_log import FiniteCheck
from legged_mw.rl.ppo import GraphedPPO, UpdateRollback, value_loss
from legged_mw.rl.run_folder import checkpoints
from legged_mw.rl.runner import Runner

BAD = [math.nan, math.inf, -math.inf, 1e20, -1e38]
RUN = ["--num_envs", "8", "--eager", "--seed", "1", "--set", "runner.save_interval=1", "--set", "cpu.update_threads=1"]


def train(root: Path, iterations: int, *flags: str) -> Result:
    return run("train", root, *SMALL, *RUN, "--max_iterations", str(iterations), *flags)


def newest(root: Path) -> dict[str, Any]:
    [folder] = root.glob("logs/*/*")
    return torch.load([*checkpoints(folder).values()][-1], weights_only=True)


def all_finite(content: Any) -> bool:
    if isinstance(content, torch.Tensor):
        return bool(content.isfinite().all())
    values = content.values() if isinstance(content, dict) else content if isinstance(content, list | tuple) else ()
    return all(all_finite(value) for value in values)


class Spoiler:
    """Writes a bad value into what a method returns or leaves, in the first world, at some of its calls."""

    def __init__(self, value: float, at: Callable[[int], bool]) -> None:
        self.value, self.at, self.calls = value, at, 0

    def due(self, worlds: int) -> bool:
        self.calls += worlds == 8  # in training, not before it
        return worlds == 8 and self.at(self.calls)


def spoil_reward(patch: pytest.MonkeyPatch, spoiler: Spoiler) -> None:
    term = LeggedRobot._reward_tracking_lin_vel

    def spoiled(self: LeggedRobot) -> torch.Tensor:
        value = term(self).clone()
        if spoiler.due(len(value)):
            value[0] = spoiler.value
        return value

    patch.setattr(LeggedRobot, "_reward_tracking_lin_vel", spoiled)


def spoil_row(patch: pytest.MonkeyPatch, spoiler: Spoiler) -> None:
    compute = Observations.compute

    def spoiled(self: Observations) -> None:
        row = next(row for row in self.rows("state") if row.name == "commands").value
        kept = row.clone()
        if spoiler.due(len(row)):
            row[0, 0] = spoiler.value
        compute(self)
        row.copy_(kept)

    patch.setattr(Observations, "compute", spoiled)


def spoil_handed_out(patch: pytest.MonkeyPatch, spoiler: Spoiler) -> None:
    """Behind the table's back: what the learner is given."""
    step = LeggedRobot.step

    def spoiled(self: LeggedRobot, actions: torch.Tensor) -> Any:
        obs, *rest = step(self, actions)
        if spoiler.due(self.num_envs):
            obs["privileged_state"][0, 50] = spoiler.value
        return obs, *rest

    patch.setattr(LeggedRobot, "step", spoiled)


WAYS = {
    "reward": (
        spoil_reward,
        "reward term 'tracking_lin_vel' was not finite, or beyond 1e+06, in 1 of 64 steps of a world; 0 took its place",
    ),
    "row": (
        spoil_row,
        "observation row 'commands' of 'state' was not finite, or beyond 1e+06, in 1 of 64 steps of a world; 0 took its pla",
    ),
    "handed out": (
        spoil_handed_out,
        "had values that are not finite or beyond 1e+06) and is undone: 1 in a row, 1 so far",
    ),
}


@pytest.mark.parametrize(
    ("way", "value"), [("reward", math.nan), ("row", 1e20), ("handed out", 1e20), ("handed out", math.nan)]
)
def test_once_in_one_world_of_eight_ruins_nothing(
    way: str, value: float, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, said = WAYS[way]
    spoil(monkeypatch, Spoiler(value, lambda call: call == 20))
    result = train(tmp_path, 6)
    assert result.code == 0 and result.out.count("WARNING") == 1 and said in result.out, result
    assert all_finite(newest(tmp_path)) and newest(tmp_path)["iter"] == 6


def test_a_reward_that_stays_bad_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil_reward(monkeypatch, Spoiler(math.nan, lambda call: call > 16))
    result = train(tmp_path, 50)
    assert result.code == 2 and newest(tmp_path)["iter"] < 8 and all_finite(newest(tmp_path))
    why = "reward term 'tracking_lin_vel' is not finite, or beyond 1e+06, in 8 of 64 steps of a world, for 3 iterations; look at how it is"
    assert result.err.startswith(f"train.py: {why}") and result.err.count("\n") == 1, result.err


def test_a_row_that_stays_bad_ends_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil_row(monkeypatch, Spoiler(1e38, lambda call: call > 16))
    result = train(tmp_path, 50)
    assert (
        result.code == 2
        and "train.py: observation row 'commands' of 'state' is not finite, or beyond 1e+06, in " in result.err
    )


def test_three_dead_updates_in_a_row_end_the_run_at_the_last_good_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good: dict[str, Any] = {}
    update = Runner._update

    def note(self: Runner) -> Any:
        if self.current_learning_iteration == 2:
            good.update({name: value.clone() for name, value in self.alg.actor.state_dict().items()})  # type: ignore[attr-defined]
        return update(self)

    monkeypatch.setattr(Runner, "_update", note)
    spoil_handed_out(monkeypatch, Spoiler(math.nan, lambda call: call > 16))
    result = train(tmp_path, 50)
    text = "train.py: 3 updates in a row were not finite (observation row '"
    assert (
        result.code == 2
        and result.err.startswith(text)
        and "the networks are those of the last good one; look at" in result.err
    )
    end = newest(tmp_path)
    assert end["iter"] == 5 and all(torch.equal(end["actor_state_dict"][name], value) for name, value in good.items())


def test_two_dead_updates_are_not_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spoil_handed_out(monkeypatch, Spoiler(math.inf, lambda call: 17 <= call < 32))
    result = train(tmp_path, 6)
    assert result.code == 0 and "2 in a row, 2 so far" in result.out and all_finite(newest(tmp_path))


def test_rsl_rls_own_learner_is_undone_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its normalisers learn during the rollout."""
    spoil_handed_out(monkeypatch, Spoiler(math.nan, lambda call: call == 20))
    result = train(tmp_path, 5, "--set", "algorithm.class_name=PPO")
    assert result.code == 0 and "1 in a row, 1 so far" in result.out and all_finite(newest(tmp_path))


def test_rsl_rls_own_normaliser_rebinds_its_std_and_gets_the_old_one_back() -> None:
    layer, normaliser = nn.Linear(3, 2), EmpiricalNormalization(3)
    network = nn.ModuleList([layer, normaliser])
    stored = SimpleNamespace(observations={"state": torch.zeros(4, 5, 3)}, rewards=torch.zeros(4, 5, 1))
    rollback = UpdateRollback(
        SimpleNamespace(storage=stored, optimizer=torch.optim.Adam(network.parameters())), [network]
    )
    normaliser.update(3.0 * torch.randn(50, 3))
    before = {name: value.clone() for name, value in network.state_dict().items()}
    rollback.begin()
    normaliser.update(torch.full((50, 3), math.nan))
    rollback.finish()
    assert rollback.undone == 1 and all(
        torch.equal(before[name], value) for name, value in network.state_dict().items()
    )


def test_weights_that_explode_are_undone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ppo, "value_loss", lambda *args: tuple(each * math.nan for each in value_loss(*args)))
    result = train(tmp_path, 9)
    said = "train.py: 3 updates in a row were not finite (loss or weights); the networks are those of the last good one; lower"
    assert result.code == 2 and result.err.startswith(said), result.err
    assert all_finite(newest(tmp_path))


@pytest.mark.parametrize("value", BAD)
def test_an_update_is_undone_to_the_last_bit(value: float) -> None:
    """Parameters, optimizer and learning rate; the first one too, before which Adam remembers nothing. Nothing asks the host."""
    alg = make(GraphedPPO, max_grad_norm=1e30)
    for first in (True, False):
        before = {name: each.clone() for name, each in parameters(alg).items()}
        rate = alg.learning_rate
        collect(alg)
        alg.storage.rewards[1, 2] = value
        alg.compute_returns(alg.storage.observations[-1])
        with recordable() if not first else nullcontext():  # Adam's memory is made in the first update
            alg._update()
        alg.storage.clear()
        assert alg.rollback.undone == 1 and alg.rollback.wrong[-1] == 1 and alg.learning_rate == rate
        assert all(torch.equal(before[name], each) for name, each in parameters(alg).items())
        memory = [each for kept in alg.optimizer.state.values() for each in kept.values()]
        assert first == all(bool((each == 0).all()) for each in memory)
        collect(alg)
        alg.compute_returns(alg.storage.observations[-1])
        alg.update()
        assert alg.rollback.undone == 0 and not alg.rollback.wrong.any()


def test_what_is_finite_keeps_its_bits() -> None:
    look = NonFinite(["a", "b"], "cpu")
    values = torch.tensor([[1.0, math.nan], [-1e6, 1e7], [-0.0, math.inf], [3.0, -1e38]])
    kept = values[:, 0].clone()
    look.clear(values)
    assert torch.equal(values[:, 0], kept) and not values[:, 1].any() and look.take().tolist() == [0.0, 4.0]
    assert look.take().tolist() == [0.0, 0.0]


def test_a_warning_repeats_when_there_is_ten_times_as_much() -> None:
    health = FiniteCheck(["reward term 'x'"], ["the rewards"])
    said = [len(health.judge([1.0], 1000, False, [0.0])[0]) for _ in range(101)]
    assert [i + 1 for i, lines in enumerate(said) if lines] == [1, 10, 100]
