"""What the two learners with recorded updates share: when they leave it to rsl-rl, memories that forget, checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor

from legged_mw.rl.adam import make_recordable, plain_state
from legged_mw.rl.students.recurrent import HiddenStates


class Recorded:
    """Stands before rsl-rl's algorithm among the parents of a learner. Where ``graphed`` is false all is rsl-rl's own."""

    graphed: bool
    learning_rate: float
    optimizer: Any
    device: str
    _rates: Sequence[Tensor | float]  # of the optimizer's groups
    _memories: HiddenStates

    def _begin(self) -> None:
        """Fixed tensors, and graphs that are not recorded yet."""
        raise NotImplementedError

    def release(self) -> None:
        """Drop what is recorded: NCCL does not close a connection that a CUDA graph still names. The next calls record again."""
        if self.graphed:
            self._begin()

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Tensor]) -> None:
        """Store the transition; worlds whose episode ended are forgotten."""
        super().process_env_step(obs, rewards, dones, extras)  # type: ignore[misc]
        if self.graphed:
            self._memories.forget(dones)

    def save(self) -> dict[str, Any]:
        """The networks' and the optimizer's state, in the form that rsl-rl's own learner writes."""
        content = super().save()  # type: ignore[misc]
        if self.graphed:
            rates = [self.learning_rate, *map(float, self._rates[1:])]
            content["optimizer_state_dict"] = plain_state(content["optimizer_state_dict"], rates)
        return content

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Take over a checkpoint of this class or of rsl-rl's own learner; a student its teacher also from one of PPO."""
        iteration = super().load(loaded_dict, load_cfg, strict)  # type: ignore[misc]
        if self.graphed:
            make_recordable(self.optimizer, self._rates, str(self.device))
            self._begin()  # Adam's memory has moved
        return iteration


def why_stock(learner: Any, policy: MLPModel, networks: dict[MLPModel, tuple[type[MLPModel], ...]]) -> str | None:
    """What keeps a learner of ``policy`` from being recorded, or None. ``networks``: what each may be besides plain or recurrent."""
    for network, more in networks.items():
        if type(network) not in (MLPModel, RNNModel, *more):
            return f"a network is a {type(network).__name__}"
    if learner.use_mixed_precision:
        return "use_mixed_precision is set"
    if getattr(type(policy.distribution), "sample", None) is not GaussianDistribution.sample:
        return f"actions are drawn from a {type(policy.distribution).__name__}"
    if type(learner.optimizer) not in (torch.optim.Adam, torch.optim.AdamW):
        return f"the optimizer is {type(learner.optimizer).__name__}"
    return None
