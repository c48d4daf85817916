"""What the learners with recorded updates share: networks that are more than an MLP, when rsl-rl's own update runs, checkpoints.

A network that trains something beside the policy's loss, or that has a memory, says here what a learner may ask of it. rl/students/
holds such networks; a learner knows none of them by name.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Protocol

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules.distribution import GaussianDistribution
from tensordict import TensorDict
from torch import Tensor, nn

from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.adam import make_recordable, plain_state

# What a network with a memory reads of a rollout in an update; its memory knows what is in it.
Sequenced = tuple[Tensor, ...]


class RegressingModel(MLPModel):
    """rsl-rl's MLPModel with an ``estimator``, which learns by regression; the network reads what it makes of the observations."""

    field: str  # of the config, that asks for it
    regression: str  # the name of the regression's loss
    estimator: nn.Module
    learning_rate: float  # of the estimator

    @staticmethod
    def settings(sections: dict[str, Any], env: RobotTask, learns: bool) -> dict[str, Any]:
        """What its constructor takes besides MLPModel's, from the learner's config; see ``classes.actor_settings``. Raises ConfigError."""
        raise NotImplementedError

    def rollout_latent(self, obs: TensorDict) -> Tensor:
        """What the network reads in a training's rollout, of all its worlds in order."""
        return self.get_latent(obs)

    def lesson(self, obs: TensorDict, worlds: Tensor) -> tuple[Tensor, ...]:
        """What ``learn`` needs besides the latent; it stays the same over an update.

        ``obs`` (S * B,) were seen in ``worlds`` (B,); S is 2 where mirror images come after them, else 1.
        """
        raise NotImplementedError

    def learn(self, latent: Tensor, lesson: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """The network's output, and the loss () of the regression, which is of other parameters.

        ``latent`` may have more columns, of zeros.
        """
        raise NotImplementedError

    def update_regression_normalizer(self, obs: TensorDict, ranks: int) -> None:
        """Update the normaliser of what the estimator learns from."""
        raise NotImplementedError


def trained_parts(actor: MLPModel, critic: MLPModel) -> tuple[list[list[nn.Parameter]], list[Tensor]]:
    """Parameters whose gradients are clipped together: the policy's, the critic's, the estimator's if there is one; and its rate ()."""
    if not isinstance(actor, RegressingModel):
        return [[*actor.parameters()], [*critic.parameters()]], []
    policy = [parameter for name, parameter in actor.named_parameters() if not name.startswith("estimator.")]
    rate = torch.tensor(actor.learning_rate, dtype=torch.float32, device=policy[0].device)
    return [policy, [*critic.parameters()], [*actor.estimator.parameters()]], [rate]


class Memory(Protocol):
    """The state of a recurrent network in each of N worlds, in tensors that stay."""

    now: Tensor  # (states, S, N, H): S is 2 where mirror images have a state of their own, else 1
    start: Tensor  # when the rollout began

    def advance(self, obs: Any) -> Tensor:
        """Take in observations (N,), or (2N,) with their images; returns what the MLP reads (N, H)."""
        ...

    def normalised(self, obs: Any) -> Tensor:
        """What the recurrent part reads of observations (B,): (B, size)."""
        ...

    def forget(self, ended: Tensor) -> None:
        """The state becomes 0 where ``ended`` (N,)."""

    def for_rsl_rl(self) -> Any:
        """A copy of the state in rsl-rl's form."""

    def sequence(self, inputs: Tensor, worlds: Tensor, dones: Tensor) -> Sequenced:
        """The rollout of ``worlds`` (B,) from ``inputs`` (S * T * B, size) and where a step ended an episode, ``dones`` (T, N, 1)."""
        ...

    def unroll(self, sequence: Sequenced) -> Tensor:
        """What the MLP reads (S * T * B, H) of a sequence, with gradients."""
        ...


class RememberingModel(RNNModel):
    """rsl-rl's recurrent network, which a recorded learner gives a memory of its own."""

    def memory(self, worlds: int, images: int, device: str) -> Memory:
        """An empty memory; with ``images`` 2 also of what the network has seen of mirror images."""
        raise NotImplementedError


class Memories(dict[nn.Module, Memory]):
    """Those of the networks with a memory among a learner's ``models``."""

    def __init__(self, models: Iterable[nn.Module], worlds: int, images: int, device: str) -> None:
        remembering = [model for model in models if isinstance(model, RememberingModel)]
        super().__init__({model: model.memory(worlds, images, device) for model in remembering})

    def begin_rollout(self) -> None:
        """Keep the present states as those that the rollout begins with."""
        for memory in self.values():
            memory.start.copy_(memory.now)

    def forget(self, ended: Tensor) -> None:
        """All states become 0 where ``ended`` (N,)."""
        for memory in self.values():
            memory.forget(ended)


class Recorded:
    """Stands before rsl-rl's algorithm among the parents of a learner. Where ``graphed`` is false all is rsl-rl's own."""

    graphed: bool
    learning_rate: float
    optimizer: Any
    device: str
    _rates: Sequence[Tensor | float]  # of the optimizer's groups
    _memories: Memories

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


def why_stock(learner: Any, policy: MLPModel, other: MLPModel, regressing: MLPModel) -> str | None:
    """What keeps a learner of two networks from being recorded, or None. Only ``regressing`` may be a RegressingModel."""
    for network in (policy, other):
        known = type(network) is MLPModel or isinstance(network, RememberingModel)
        if not known and not (network is regressing and isinstance(network, RegressingModel)):
            return f"a network is a {type(network).__name__}"
    if learner.use_mixed_precision:
        return "use_mixed_precision is set"
    if getattr(type(policy.distribution), "sample", None) is not GaussianDistribution.sample:
        return f"actions are drawn from a {type(policy.distribution).__name__}"
    if type(learner.optimizer) not in (torch.optim.Adam, torch.optim.AdamW):
        return f"the optimizer is {type(learner.optimizer).__name__}"
    return None
