"""rsl-rl's PPO recorded as CUDA graphs: the same config keys, mathematics and checkpoints, without device-host syncs.

Acting, the returns and the whole update (all epochs and minibatches: forward, loss, backward, clipping, learning rate,
Adam) are one graph each. A graph reads fixed addresses, so tensors that rsl-rl rebinds every iteration (advantages, the
normalisers' std) are copied into fixed tensors. Actor and critic share no parameters, so they run in parallel.

On a CPU the same code runs without a graph. Each minibatch is prepared once per update, not once per epoch.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.extensions import Symmetry
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage import RolloutStorage
from rsl_rl.utils import resolve_optimizer
from tensordict import TensorDict
from torch import Tensor, nn

from legged_mw.envs.mirror import Columns
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.statistics import BOUND
from legged_mw.rl.learner_config import MAX_RATE
from legged_mw.rl.networks import (
    HalfWeights,
    Memories,
    RegressingModel,
    RememberingModel,
    Sequenced,
    elu_layers,
    kernels_for,
    run_mlp,
    sample,
    sum_rows,
    trained_parts,
    update_normalizer,
)
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.config import ConfigError

_MIN_RATE, _RATE_STEP = 1e-5, 1.5  # adaptive learning rate: lowest value, factor per change; as in rsl-rl


class Recorded:
    """First base class of a recorded learner. The second is rsl-rl's algorithm."""

    learning_rate: float
    optimizer: Any
    device: str
    _rates: Sequence[Tensor | float]  # learning rate of each optimizer group
    _memories: Memories

    def _begin(self) -> None:
        """Make the fixed tensors, and the graphs, which are recorded in later calls."""
        raise NotImplementedError

    def release(self) -> None:
        """Delete the recorded graphs: NCCL does not close a connection that a CUDA graph still uses."""
        self._begin()

    def process_env_step(self, obs: TensorDict, rewards: Tensor, dones: Tensor, extras: dict[str, Tensor]) -> None:
        """Store the transition, and clear the hidden states of worlds whose episode ended."""
        super().process_env_step(obs, rewards, dones, extras)  # type: ignore[misc]
        self._memories.forget(dones)

    def save(self) -> dict[str, Any]:
        """State of the networks and the optimizer, in rsl-rl's form."""
        content = super().save()  # type: ignore[misc]
        rates = [self.learning_rate, *map(float, self._rates[1:])]
        content["optimizer_state_dict"] = plain_state(content["optimizer_state_dict"], rates)
        return content

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a checkpoint of this class or of rsl-rl. Distillation also loads its teacher from a PPO checkpoint."""
        iteration = super().load(loaded_dict, load_cfg, strict)  # type: ignore[misc]
        make_recordable(self.optimizer, self._rates, str(self.device))
        self._begin()  # Adam's state has new addresses
        return iteration


def why_stock(policy: MLPModel, other: MLPModel, regressing: MLPModel, settings: Mapping[str, Any]) -> str | None:
    """Why a learner with two networks cannot be recorded, or None. Only ``regressing`` may be a RegressingModel.

    ``settings``: the arguments of rsl-rl's algorithm.
    """
    for network in (policy, other):
        known = type(network) is MLPModel or isinstance(network, RememberingModel)
        if not known and not (network is regressing and isinstance(network, RegressingModel)):
            return f"a network is a {type(network).__name__}"
    if settings.get("use_mixed_precision"):
        return "use_mixed_precision is set"
    if getattr(type(policy.distribution), "sample", None) is not GaussianDistribution.sample:
        return f"actions are drawn from a {type(policy.distribution).__name__}"
    optimizer: Any = resolve_optimizer(settings.get("optimizer", "adam"))
    if optimizer not in (torch.optim.Adam, torch.optim.AdamW):
        return f"the optimizer is {optimizer.__name__}"
    return None


class Minibatch(NamedTuple):
    """One minibatch: its samples and the inputs of the networks."""

    batch: RolloutStorage.Batch
    actor_input: Tensor | Sequenced  # (B, size), normalised; a sequence for a recurrent network
    critic_input: Tensor | Sequenced
    regression_batch: tuple[Tensor, ...] = ()  # for the actor's estimator


class GraphedPPO(Recorded, PPO):
    """PPO whose acting and update are replayed CUDA graphs.

    A minibatch holds random samples, or whole worlds if a network is recurrent (RNNModel). The first three updates run
    without a graph and the fourth is recorded, so no update is lost to warm-up. In these cases it is rsl-rl's own PPO
    instead, and a message says so: a network other than a plain MLPModel or RNNModel, shared parameters, RND, mixed
    precision, an optimizer other than Adam or AdamW, a distribution that is not Gaussian.
    """

    critic_only = False  # True during the critic's warm-up: the actor does not learn
    half = False  # see ``learn_in_half``
    _bound: float | None  # upper bound of the adaptive learning rate, or None
    rate: Tensor  # the learning rate (), float64 like rsl-rl's Python number; reading it does not wait for the device

    def __new__(cls, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, **settings: Any) -> Any:
        """Make a recorded learner, or rsl-rl's own if this configuration cannot be recorded."""
        reason = why_stock(actor, critic, actor, settings)
        if settings.get("rnd_cfg"):
            reason = "rnd_cfg is set"
        elif not {*map(id, actor.parameters())}.isdisjoint(map(id, critic.parameters())):
            reason = "the networks share parameters"
        symmetry = settings.get("symmetry_cfg") if actor.is_recurrent or critic.is_recurrent else None
        if symmetry and (reason or not symmetry["use_data_augmentation"]):
            raise ConfigError(
                "a recurrent network needs symmetry.use_data_augmentation for symmetry.use_mirror_loss, and for both "
                "this project's recorded update; switch the former on, or both off"
            )
        if not reason:
            return super().__new__(cls)
        if settings.pop("max_learning_rate", None):
            raise ConfigError(f"algorithm.max_learning_rate needs the recorded update, and rsl-rl's own runs: {reason}")
        print(f"PPO: rsl-rl's own update is used, not the recorded one: {reason}", flush=True)
        return PPO(actor, critic, storage, **settings)

    def __init__(self, actor: MLPModel, critic: MLPModel, storage: RolloutStorage, **settings: Any) -> None:
        self._recurrent = actor.is_recurrent or critic.is_recurrent
        symmetry, self._bound = settings.pop("symmetry_cfg", None), settings.pop("max_learning_rate", None)
        # first, because rsl-rl's PPO sets the learning rate
        self.rate, self._adam_rate = (
            torch.zeros((), dtype=dtype, device=settings["device"]) for dtype in (torch.float64, torch.float32)
        )
        super().__init__(actor, critic, storage, symmetry_cfg=None if self._recurrent else symmetry, **settings)
        if self._recurrent:
            if storage.num_envs < self.num_mini_batches:
                raise ConfigError(
                    f"algorithm.num_mini_batches is {self.num_mini_batches}, but a recurrent network learns from whole "
                    f"worlds, and env.num_envs is {storage.num_envs}: raise the latter or lower the former"
                )
            self.symmetry = Symmetry(**symmetry) if symmetry else None  # rsl-rl rejects it for recurrent networks
        self._parts, own_rates = trained_parts(self.actor, self.critic)
        self._rates = [self._adam_rate, *own_rates]
        learners = [self._parts[0] + self._parts[1], *self._parts[2:]]
        groups = [{"params": part, "lr": rate} for part, rate in zip(learners, self._rates, strict=True)]
        self.optimizer = type(self.optimizer)(groups)
        make_recordable(self.optimizer, self._rates, str(self.device))
        # cuDNN requires its own order of the weights of recurrent layers
        flat = [] if self._recurrent else enumerate(self._parts)
        self._adams = [FlatAdam(self.optimizer, max(0, i - 1), part, self.max_grad_norm) for i, part in flat]
        self.rollback = UpdateRollback(self, (self.actor, self.critic))
        self._begin()

    def _begin(self) -> None:
        st, device = self.storage, self.device
        drawn = st.num_envs if self._recurrent else st.num_envs * st.num_transitions_per_env
        self._share = drawn // self.num_mini_batches  # worlds or samples per minibatch
        self._size = self._share * (st.num_transitions_per_env if self._recurrent else 1)  # samples per minibatch
        first = {name: value[0].clone() for name, value in st.observations.items()}
        self._obs = TensorDict(first, [st.num_envs], device=device)
        # the world of each transition
        self._worlds = torch.arange(st.num_envs, device=device).expand(st.num_transitions_per_env, -1)
        self._order = torch.zeros(self._share * self.num_mini_batches, dtype=torch.long, device=device)
        self._memories = Memories((self.actor, self.critic), st.num_envs, 2 if self.symmetry else 1, device)
        self._advantages = torch.zeros_like(st.returns)
        more = ["symmetry"] if self.symmetry else []
        more += [self.actor.regression] if isinstance(self.actor, RegressingModel) else []
        self._loss_names = ("value", "surrogate", "entropy", *more)
        self._losses = torch.zeros(len(self._loss_names), device=device)
        self._entropy_coef = torch.zeros((), device=device)
        self._desired_kl = torch.zeros((), dtype=torch.float64, device=device)
        plain = [model for model in (self.actor, self.critic) if self.half and type(model) is MLPModel]
        self._half = {model: HalfWeights(linear) for model in plain if (linear := elu_layers(model.mlp))}
        self._side = torch.cuda.Stream(device) if str(device).startswith("cuda") else None
        self._act_graph, self._returns_graph, self._update_graph = (
            StepGraph(fn, str(device)) for fn in (self._act, self._compute_returns, self._update)
        )

    def learn_critic_only(self, on: bool) -> None:
        """From the next update on, train the critic only (``on``) or both networks.

        When the actor starts to learn again, an adaptive learning rate starts at its lowest value, so that the actor
        does not forget. The rate rises to its usual value within one update.
        """
        if on != self.critic_only:
            self.critic_only, self._update_graph = on, StepGraph(self._update, str(self.device))
            if not on and self.schedule == "adaptive":
                self.learning_rate = _MIN_RATE

    def learn_in_half(self) -> None:
        """Compute the hidden layers of MLPs with ELU in bfloat16, from now on.

        This includes acting: the update must compute the same policy as the rollout. Weights, their gradients, the last
        layer, sums and losses stay float32.
        """
        torch.backends.cuda.matmul.allow_bf16_reduced_precision_reduction = False
        self.half = True
        self.release()

    @contextmanager
    def _beside(self) -> Iterator[None]:
        """Run the body on a second CUDA stream, in parallel with the code after it until ``_meet``."""
        if self._side is None:
            yield
            return
        self._side.wait_stream(torch.cuda.current_stream(self._side.device))
        with torch.cuda.stream(self._side):
            yield

    def _meet(self) -> None:
        if self._side is not None:
            torch.cuda.current_stream(self._side.device).wait_stream(self._side)

    # ---- the rollout ----------------------------------------------------------------------------------------------

    def act(self, obs: TensorDict) -> Tensor:
        """Sample actions (N, A). ``transition`` holds values and distribution until ``process_env_step``."""
        if self.storage.step == 0:
            self._memories.begin_rollout()
        self._obs.copy_(obs)
        self._act_graph()
        self.transition.observations = self._obs
        self.transition.actions, self.transition.values, self.transition.actions_log_prob = self._acted
        self.transition.distribution_params = self._acted_params
        return self._acted[0].clone()

    def _act(self) -> None:
        actor, seen = self.actor, self._obs
        if self._memories and self.symmetry:
            seen, _ = self.symmetry.data_augmentation_func(env=self.symmetry.env, obs=seen, actions=None)
        with self._beside():
            values = self._act_by(self.critic, seen)
        actions = sample(actor, self._act_by(actor, seen))
        self._acted = (actions, values, actor.get_output_log_prob(actions))
        self._acted_params = tuple(actor.output_distribution_params)
        self._meet()

    def _act_by(self, model: MLPModel, seen: TensorDict) -> Tensor:
        """The output of the network's MLP."""
        latent = self._latent(model, seen)
        return self._forward(model, self._half[model].prepare(latent)) if model in self._half else model.mlp(latent)

    def _latent(self, model: MLPModel, seen: TensorDict) -> Tensor:
        """The MLP's input. ``seen``: the observations; for a recurrent network with symmetry also mirror images."""
        if model in self._memories:
            return self._memories[model].advance(seen)
        return model.rollout_latent(self._obs) if isinstance(model, RegressingModel) else model.get_latent(self._obs)

    def compute_returns(self, obs: TensorDict) -> None:
        """Write returns and advantages of the stored transitions into the storage."""
        self._obs.copy_(obs)
        self._returns_graph()
        self.storage.advantages = self._advantages

    def _compute_returns(self) -> None:
        memory = self._memories.get(self.critic)
        # rsl-rl's method steps the critic, so it gets a copy of the hidden state
        self.critic.reset(hidden_state=memory.for_rsl_rl() if memory else None)
        super().compute_returns(self._obs)
        self.critic.reset()
        self._advantages.copy_(self.storage.advantages)

    # ---- the update -----------------------------------------------------------------------------------------------

    def update(self) -> dict[str, Any]:
        """Run one update on the storage. Returns the mean losses as tensors ()."""
        torch.randperm(len(self._order), out=self._order)  # one permutation for all epochs, as in rsl-rl
        self._entropy_coef.fill_(self.entropy_coef)  # these two may change between updates
        self._desired_kl.fill_(self.desired_kl or 0.0)
        self._update_graph()
        self.storage.clear()
        return dict(zip(self._loss_names, self._losses.clone().unbind(), strict=True))

    def _update(self) -> None:
        self.rollback.begin()
        self._losses.zero_()
        batches = [self._prepare(indices) for indices in self._order.split(self._share)]
        for _ in range(self.num_learning_epochs):
            for batch in batches:
                self._minibatch(batch)
        self._losses /= self.num_learning_epochs * self.num_mini_batches
        with torch.no_grad():
            self._update_normalizers()
        self.rollback.finish(self._losses)

    def _prepare(self, indices: Tensor) -> Minibatch:
        """Gather the data that all epochs use: samples and their mirror images, normalised inputs, advantages."""
        st = self.storage

        def take(stored: Any) -> Tensor:
            if self._recurrent:
                return stored.index_select(1, indices).flatten(0, 1)
            return stored.flatten(0, 1).index_select(0, indices)

        assert st.distribution_params is not None
        batch = RolloutStorage.Batch(
            observations=TensorDict({name: take(value) for name, value in st.observations.items()}, [self._size]),
            actions=take(st.actions),
            values=take(st.values),
            advantages=take(st.advantages),
            returns=take(st.returns),
            old_actions_log_prob=take(st.actions_log_prob),
            old_distribution_params=tuple(take(stored) for stored in st.distribution_params),
        )
        if self.normalize_advantage_per_mini_batch:
            advantages: Any = batch.advantages
            batch.advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
        if self.symmetry:
            self.symmetry.augment_batch(batch, self._size)
        actor_input = self._input(self.actor, batch.observations, indices)
        critic_input = self._input(self.critic, batch.observations, indices)
        if not isinstance(self.actor, RegressingModel):
            return Minibatch(batch, actor_input, critic_input)
        regression_batch = self.actor.regression_batch(batch.observations, take(self._worlds))
        return Minibatch(batch, actor_input, critic_input, regression_batch)

    @torch.no_grad()
    def _input(self, model: MLPModel, obs: Any, indices: Tensor) -> Tensor | Sequenced:
        """The network's normalised input, padded with zero columns to a multiple of four or eight."""
        memory = self._memories.get(model)
        latent = memory.normalised(obs) if memory else model.get_latent(obs)
        if model in self._half:
            return self._half[model].prepare(latent)
        padded = nn.functional.pad(latent, (0, -latent.shape[1] % 4))
        return memory.sequence(padded, indices, self.storage.dones) if memory else padded

    def _minibatch(self, minibatch: Minibatch) -> None:
        """One gradient step."""
        batch, actor_input, critic_input, regression_batch = minibatch
        self.optimizer.zero_grad()
        with self._beside():
            values = self._forward(self.critic, critic_input)
            clip = self.clip_param if self.use_clipped_value_loss else 0.0
            of_values, of_critic = value_loss(values.detach(), batch, clip, self.value_loss_coef)
            values.backward(of_values)
        with torch.set_grad_enabled(not self.critic_only):  # no autograd graph for an actor that does not learn
            if isinstance(self.actor, RegressingModel) and isinstance(actor_input, Tensor):
                output, *regression = self.actor.learn(actor_input, regression_batch)
            else:
                output, regression = self._forward(self.actor, actor_input), []
            gradients, parts, kl = self._policy_loss(batch, output)
        if self.critic_only:
            kl = None  # the actor did not change, so the KL is rounding noise
        else:
            gradients += [(loss, torch.ones_like(loss)) for loss in regression]  # affects the estimator only
            trained = [(value, gradient) for value, gradient in gradients if value.requires_grad]
            torch.autograd.backward(*zip(*trained, strict=True))  # type: ignore[arg-type]
        self._meet()
        self._step(kl)
        self._losses.add_(torch.stack([value.detach() for value in (of_critic, *parts, *regression)]))

    def _policy_loss(
        self, batch: Any, output: Tensor
    ) -> tuple[list[tuple[Tensor, Tensor]], list[Tensor], Tensor | None]:
        """(tensor, gradient) pairs of the actor, loss terms as in ``_loss_names``, and the KL (None: fixed rate)."""
        assert self.actor.distribution is not None
        self.actor.distribution.update(output)
        mean, std = self.actor.output_mean, own_std(self.actor.distribution)  # type: ignore[arg-type]
        loss = policy_loss(mean.detach(), std.detach(), batch, self.clip_param, self._entropy_coef)
        gradients, parts = [(mean, loss.of_mean), (std, loss.of_std)], [loss.surrogate, loss.entropy]
        if self.symmetry:
            parts.append(self._symmetry_loss(batch))
            if self.symmetry.use_mirror_loss:
                gradients.append((parts[-1], torch.full_like(parts[-1], self.symmetry.mirror_loss_coeff)))
        return gradients, parts, loss.kl if self.desired_kl is not None and self.schedule == "adaptive" else None

    def _forward(self, model: MLPModel, inputs: Tensor | Sequenced) -> Tensor:
        """The network's output for normalised inputs (B, size), or over a sequence."""
        if not isinstance(inputs, Tensor):
            return run_mlp(model.mlp, self._memories[model].unroll(inputs))
        return run_mlp(model.mlp, inputs, self._half[model].read() if model in self._half else None)

    def _step(self, kl: Tensor | None) -> None:
        """Adapt the rate to ``kl``, clip each part's gradient, and step. KL and gradients are means over all ranks."""
        adams, gradients = self._adams, [adam.gradient() for adam in self._adams]
        if not adams:
            gradients = [p.grad for group in self.optimizer.param_groups for p in group["params"]]
        if self.is_multi_gpu:
            self._average_over_ranks([each for each in (*gradients, kl) if each is not None])
        if kl is not None:
            self._adapt_rate(kl)
        for adam, gradient in zip(adams, gradients if adams else [], strict=True):
            if gradient is not None:
                adam.step(gradient)
        if not adams:
            for part in self._parts:
                nn.utils.clip_grad_norm_(part, self.max_grad_norm)
            self.optimizer.step()

    def _average_over_ranks(self, parts: list[Tensor]) -> None:
        """Replace ``parts`` by their means over all ranks, with one all_reduce."""
        message = torch.cat([part.flatten() for part in parts])
        torch.distributed.all_reduce(message)
        message /= self.gpu_world_size
        means = message.split([part.numel() for part in parts])
        for part, mean in zip(parts, means, strict=True):
            part.copy_(mean.view_as(part))

    def _adapt_rate(self, kl: Tensor) -> None:
        """rsl-rl's rule: lower the rate if KL > 2 ``desired_kl``, raise it if KL < ``desired_kl`` / 2."""
        highest = self._bound or MAX_RATE
        if kernels := kernels_for(kl):
            kernels.launch(
                kernels.adapt_rate, 1, kl, self._desired_kl, self.rate, self._adam_rate, _RATE_STEP, _MIN_RATE, highest
            )
            return
        slower = (self.rate / _RATE_STEP).clamp(min=_MIN_RATE)
        faster = (self.rate * _RATE_STEP).clamp(max=highest)
        rate = torch.where((kl < self._desired_kl / 2.0) & (kl > 0.0), faster, self.rate)
        self.rate.copy_(torch.where(kl > self._desired_kl * 2.0, slower, rate))
        self._adam_rate.copy_(self.rate)

    def _update_normalizers(self) -> None:
        obs = self.storage.observations.flatten(0, 1)
        for model in (self.critic,) if self.critic_only else (self.actor, self.critic):
            if isinstance(model.obs_normalizer, EmpiricalNormalization):
                inputs = torch.cat([obs[group] for group in model.obs_groups], dim=-1)
                update_normalizer(model.obs_normalizer, inputs, self.gpu_world_size)
        if isinstance(self.actor, RegressingModel) and not self.critic_only:
            self.actor.update_regression_normalizer(obs, self.gpu_world_size)

    def _symmetry_loss(self, batch: Any) -> Tensor:
        """Mean squared difference between the actions for mirrored observations and the mirrored actions."""
        symmetry, size = self.symmetry, self._size
        assert symmetry is not None
        if not self._recurrent and (symmetry.use_mirror_loss or not symmetry.use_data_augmentation):
            return symmetry.compute_loss(self.actor, copy.copy(batch), size)  # a copy, because it adds mirror images
        # an augmented batch already holds the mirror images and their outputs
        means = self.actor.output_mean
        _, mirrored = symmetry.data_augmentation_func(env=symmetry.env, obs=None, actions=means[:size].detach())
        return nn.functional.mse_loss(means[size:], mirrored[size:])

    # ---- the learning rate ------------------------------------------------------------------------------------------

    def load(self, loaded_dict: dict, load_cfg: dict | None, strict: bool) -> bool:
        """Load a checkpoint and clip its learning rate to the bound."""
        iteration = super().load(loaded_dict, load_cfg, strict)
        if self._bound:
            self.learning_rate = min(self.learning_rate, self._bound)
        return iteration

    @property
    def learning_rate(self) -> float:  # type: ignore[override]
        """The current learning rate. Reading it waits for the device, setting it does not."""
        return float(self.rate)

    @learning_rate.setter
    def learning_rate(self, rate: float) -> None:
        self.rate.fill_(float(rate))
        self._adam_rate.fill_(float(rate))


# ---- the rollback of an update --------------------------------------------------------------------------------------


class UpdateRollback:
    """Rolls back an update whose parameters or losses are not finite, or whose inputs exceed BOUND.

    Call ``begin``, update, ``finish``. It never waits for the device, and changes no bit of a valid update.
    """

    def __init__(self, learner: Any, networks: Iterable[nn.Module]) -> None:
        """``learner``: has rsl-rl's ``storage`` and ``optimizer``. ``networks``: the trained networks."""
        self._learner, self._networks, stored = learner, list(networks), learner.storage.observations
        self.columns = [(group, i) for group, value in stored.items() for i in range(value[0, 0].numel())]
        device = learner.storage.rewards.device
        self.undone = torch.zeros((), device=device)  # 1 if the last update was rolled back
        # 1 where the last update read an invalid value: one entry per observation column, then the rewards
        self.wrong = torch.zeros(len(self.columns) + 1, device=device)

    def _learned(self) -> dict[str, Tensor]:
        """Name -> current tensor that an update changes. Read it each time: rsl-rl's normaliser rebinds its std."""
        optimizer, values = self._learner.optimizer, dict[str, Any]()
        for i, network in enumerate(self._networks):
            values |= {f"{i}.{name}": value for name, value in (*network.named_parameters(), *network.named_buffers())}
        for i, memory in enumerate(optimizer.state.values()):
            values |= {f"memory {i}.{name}": value for name, value in memory.items()}
        values |= {f"rate {i}": group["lr"] for i, group in enumerate(optimizer.param_groups)}
        values["rate"] = getattr(self._learner, "rate", None)
        return {name: value for name, value in values.items() if isinstance(value, Tensor) and value.numel()}

    @torch.no_grad()
    def begin(self) -> None:
        """Copy the current state."""
        self._before = [(list(kind), _join(kind.values())) for kind in _kinds(self._learned())]

    @torch.no_grad()
    def finish(self, losses: Tensor | None = None) -> None:
        """Restore the state if inputs, results or ``losses`` are invalid. Sets ``undone`` and ``wrong``."""
        stored = self._learner.storage
        wrong = [_beyond(value.flatten(0, 1).flatten(1)) for value in (*stored.observations.values(), stored.rewards)]
        self.wrong.copy_(torch.cat([*wrong[:-1], wrong[-1].any()[None]]))
        sound = ~self.wrong.any() if losses is None else losses.isfinite().all() & ~self.wrong.any()
        new, states = self._learned(), list[tuple[list[Tensor], Tensor, Tensor]]()
        for names, before in self._before:
            kind = [new.pop(name) for name in names]
            states.append((kind, before, _join(kind)))
        # Adam's first step creates its state; before it, the state is zero
        for kind in [list(kind.values()) for kind in _kinds(new)]:
            states.append((kind, torch.zeros_like(after := _join(kind)), after))
        for _, _, after in states:
            sound = sound & _on(after.isfinite().all(), sound.device)
        if getattr(self._learner, "is_multi_gpu", False):
            shared = sound.float()
            torch.distributed.all_reduce(shared, op=torch.distributed.ReduceOp.MIN)
            sound = shared > 0.5
        self.undone.copy_(~sound)
        for kind, before, after in states:
            parts = torch.where(_on(sound, after.device), after, before).split([value.numel() for value in kind])
            shaped = [part.view_as(value) for part, value in zip(parts, kind, strict=True)]
            torch._foreach_copy_(kind, shaped)  # pyright: ignore[reportPrivateImportUsage]
        del self._before


def _kinds(tensors: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
    """The tensors grouped by dtype and device, so that each group can be concatenated."""
    kinds: dict[Any, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        kinds.setdefault((tensor.dtype, tensor.device), {})[name] = tensor
    return list(kinds.values())


def _on(value: Tensor, device: torch.device) -> Tensor:
    """``value`` on ``device``. The step counts of rsl-rl's Adam are on the host."""
    return value if value.device == device else value.to(device)


def _join(tensors: Iterable[Tensor]) -> Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def _beyond(values: Tensor) -> Tensor:
    """(C,) True for each column of ``values`` (B, C) with a value that is not finite or exceeds BOUND."""
    low, high = torch.aminmax(values, dim=0)
    return ~((low >= -BOUND) & (high <= BOUND))


# ---- losses ---------------------------------------------------------------------------------------------------------
#
# The losses of a Gaussian policy, as in rsl-rl, and their gradients with respect to the networks' outputs. Autograd
# differentiates the formulas. On a GPU a kernel computes each loss and its gradient (fast/kernels.py), and tests
# compare the kernels with the formulas. Tensors have B samples; mirror images come last.


_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class PolicyLoss(NamedTuple):
    """Terms of the actor's loss (), and its gradients."""

    of_mean: Tensor  # (B, A)
    of_std: Tensor  # shape of the std
    surrogate: Tensor
    entropy: Tensor
    kl: Tensor  # KL divergence from the policy of the rollout


def own_std(distribution: GaussianDistribution) -> Tensor:
    """The std: (A,) if it does not depend on the state, else (B, A)."""
    if type(distribution) is not GaussianDistribution:
        return distribution.std
    log = distribution.std_type == "log"
    own = distribution.log_std_param if log else distribution.std_param
    low, high = distribution.log_std_range if log else distribution.std_range
    std = nn.functional.hardtanh(own, min_val=low, max_val=high)  # clamp; its gradient is one kernel, not five
    return std.exp() if log else std


@torch.no_grad()
def policy_loss(
    mean: Tensor, std: Tensor, batch: RolloutStorage.Batch, clip: float, entropy_coef: Tensor
) -> PolicyLoss:
    """PPO's clipped surrogate loss minus ``entropy_coef`` x entropy. Entropy and KL are without mirror images."""
    assert batch.old_distribution_params is not None
    kernels, old = kernels_for(mean), batch.old_distribution_params
    if kernels and std.dim() == 1:
        (rows, width), of_mean, of_std, parts = (
            mean.shape,
            torch.empty_like(mean),
            torch.empty_like(std),
            mean.new_empty(3),
        )
        terms = mean.new_empty(rows, width + 2)
        samples = batch.actions, batch.advantages, batch.old_actions_log_prob, *old
        kernels.launch(kernels.policy_loss, rows, mean, std, *samples, clip, of_mean, terms)
        kernels.launch(kernels.policy_sums, 1, sum_rows(terms), std, entropy_coef, rows, len(old[0]), of_std, parts)
        return PolicyLoss(of_mean, of_std, *parts.unbind())
    size, advantages, (old_mean, old_std) = len(old[0]), batch.advantages, old
    with torch.enable_grad():
        mean, std = mean.detach().requires_grad_(), std.detach().requires_grad_()
        z = (batch.actions - mean) / std  # type: ignore[operator]
        log_prob = -(0.5 * z.square() + std.log() + _HALF_LOG_2PI).sum(dim=-1, keepdim=True)
        ratio = torch.exp(log_prob - batch.old_actions_log_prob)  # type: ignore[operator]
        clipped_ratio = ratio.clamp(1.0 - clip, 1.0 + clip)
        surrogate = torch.max(-advantages * ratio, -advantages * clipped_ratio).mean()  # type: ignore[operator]
        own = std[:size] if std.dim() == 2 else std
        entropy = (own.log() + 0.5 + _HALF_LOG_2PI).sum(dim=-1).mean()
        of_mean, of_std = torch.autograd.grad(surrogate - entropy_coef * entropy, (mean, std))
    ratio_of_std, moved = old_std / own, (old_mean - mean[:size]) / own
    kl = (0.5 * (ratio_of_std.square() + moved.square() - 1.0) - ratio_of_std.log()).sum(dim=-1).mean()
    return PolicyLoss(of_mean, of_std, surrogate.detach(), entropy.detach(), kl)


@torch.no_grad()
def value_loss(values: Tensor, batch: RolloutStorage.Batch, clip: float, coef: float) -> tuple[Tensor, Tensor]:
    """The gradient (B, 1) of ``coef`` x value loss, and the value loss (). It is clipped unless ``clip`` is 0."""
    if kernels := kernels_for(values):
        of_values, terms = torch.empty_like(values), torch.empty_like(values)
        kernels.launch(
            kernels.value_loss, len(values), values, batch.values, batch.returns, clip, coef, of_values, terms
        )
        return of_values, terms.mean()
    with torch.enable_grad():
        values = values.detach().requires_grad_()
        losses = (values - batch.returns).square()  # type: ignore[operator]
        if clip:
            near = batch.values + (values - batch.values).clamp(-clip, clip)  # type: ignore[operator]
            losses = torch.max(losses, (near - batch.returns).square())  # type: ignore[operator]
        loss = losses.mean()
        (of_values,) = torch.autograd.grad(coef * loss, values)
    return of_values, loss.detach()


# ---- Adam -----------------------------------------------------------------------------------------------------------
#
# An Adam that a CUDA graph can record. All parameters are in one tensor, and the state has rsl-rl's form. A CPU runs
# the formulas below. On a GPU two kernels compute them (fast/kernels.py). Tests compare the kernels with the formulas,
# and the formulas with torch's Adam.


_ALIGNED = 64  # values; for fast matrix products each parameter starts at a multiple of it


def make_recordable(optimizer: torch.optim.Optimizer, rates: Sequence[Tensor | float], device: str) -> None:
    """Change a new or loaded Adam so that it can be recorded. ``rates``: learning rate of each group."""
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        group.update(lr=rate, fused=True, capturable=device.startswith("cuda"))
    for memory in optimizer.state.values():
        memory["step"] = memory["step"].to(device, torch.float32)


def plain_state(state: dict[str, Any], rates: Sequence[float]) -> dict[str, Any]:
    """The state of a recorded Adam in rsl-rl's form: one step count per parameter."""
    plain = {"fused": None, "capturable": False}
    return {
        "state": {i: {**memory, "step": memory["step"].cpu().clone()} for i, memory in state["state"].items()},
        "param_groups": [
            {**group, "lr": rate, **plain} for group, rate in zip(state["param_groups"], rates, strict=True)
        ],
    }


class FlatAdam:
    """Clips the gradient and steps a ``part`` of the parameters of an Adam or AdamW, stored in one tensor.

    Parameters and moments become views of flat tensors. The optimizer's state holds the views.
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, group: int, part: Sequence[nn.Parameter], limit: float
    ) -> None:
        """``group``: index of the part's optimizer group; ``limit``: largest norm of its gradient."""
        self._optimizer, self._group, self._limit = optimizer, optimizer.param_groups[group], limit
        self._part = [parameter for parameter in part if parameter.requires_grad]
        first = self._part[0].detach()
        self._gaps = [first.new_zeros(-parameter.numel() % _ALIGNED) for parameter in self._part]
        self._values = self._lay([parameter.detach() for parameter in self._part])
        self._memory = [torch.zeros_like(self._values) for _ in range(2)]
        self._step = torch.zeros((), dtype=torch.float32, device=first.device)
        self._factors = first.new_zeros(4)
        for parameter, value in zip(self._part, self._views(self._values), strict=True):
            parameter.data = value

    def _lay(self, tensors: Sequence[Tensor]) -> Tensor:
        return torch.cat(
            [piece for pair in zip(tensors, self._gaps, strict=True) for piece in (pair[0].flatten(), pair[1])]
        )

    def _views(self, flat: Tensor) -> list[Tensor]:
        sizes = [
            size for value, gap in zip(self._part, self._gaps, strict=True) for size in (value.numel(), gap.numel())
        ]
        return [piece.view_as(value) for piece, value in zip(flat.split(sizes)[::2], self._part, strict=True)]

    def gradient(self) -> Tensor | None:
        """The part's gradients in one tensor, or None."""
        if all(parameter.grad is None for parameter in self._part):
            return None
        return self._lay([torch.zeros_like(value) if value.grad is None else value.grad for value in self._part])

    def _take_over(self) -> None:
        """Copy the optimizer's new or loaded state into the flat tensors, and replace it by views of them."""
        states = [self._optimizer.state[parameter] for parameter in self._part]
        if states[0].get("step") is self._step:
            return
        for key, flat in zip(("exp_avg", "exp_avg_sq"), self._memory, strict=True):
            for state, view in zip(states, self._views(flat), strict=True):
                view.copy_(state[key]) if key in state else view.zero_()
                state[key] = view
        self._step.copy_(states[0]["step"]) if "step" in states[0] else self._step.zero_()
        for state in states:
            state["step"] = self._step

    @torch.no_grad()
    def step(self, gradient: Tensor) -> None:
        """One Adam step with ``gradient`` and the group's learning rate."""
        self._take_over()
        group, (mean, square), norm = self._group, self._memory, torch.linalg.vector_norm(gradient)
        rate, (beta1, beta2), eps, decay = (group[name] for name in ("lr", "betas", "eps", "weight_decay"))
        if kernels := kernels_for(gradient):
            kernels.launch(
                kernels.begin_adam, 1, norm, self._limit, rate, beta1, beta2, decay, self._step, self._factors
            )
            kernels.launch(
                kernels.adam, len(gradient), gradient, self._factors, beta1, beta2, eps, self._values, mean, square
            )
            return
        self._step += 1
        count = self._step.double()
        gradient = gradient * (self._limit / (norm + 1e-6)).clamp(max=1.0)
        mean.lerp_(gradient, 1.0 - beta1)
        square.mul_(beta2).addcmul_(gradient, gradient, value=1.0 - beta2)
        divisor = (square / (1.0 - beta2**count)).sqrt_().add_(eps)
        self._values.mul_(1.0 - rate.double() * decay).sub_(mean / divisor * (rate / (1.0 - beta1**count)))


# ---- mirror images --------------------------------------------------------------------------------------------------


def mirror(env: RobotTask, obs: TensorDict | None, actions: Tensor | None) -> tuple[TensorDict | None, Tensor | None]:
    """rsl-rl's ``data_augmentation_func``: the observations and actions of B samples, then of their mirror images.

    Mittal et al., "Symmetry Considerations for Learning Task Symmetric Robot Policies", ICRA 2024.

    ``obs`` may hold any of the environment's groups. A CUDA graph can record this function. Read ``env.mirror`` once
    before the recording, because its first use makes tensors.
    """
    table = env.mirror
    if obs is not None:
        groups = {name: _with_image(value, table.observations[name]) for name, value in obs.to_dict().items()}
        obs = TensorDict(groups, batch_size=[2 * obs.batch_size[0]], device=obs.device)
    return obs, None if actions is None else _with_image(actions, table.actions)


def _with_image(x: Tensor, columns: Columns) -> Tensor:
    return torch.cat([x, columns(x)])
