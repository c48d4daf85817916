"""rsl-rl's Distillation recorded as CUDA graphs: the same config keys, mathematics, checkpoints; no device reads.

A student learns the actions of a teacher with more observations, in the states that the student visits (DAgger).
"""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.algorithms import Distillation
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import EmpiricalNormalization
from rsl_rl.storage import RolloutStorage
from tensordict import TensorDict
from torch import Tensor, nn

from legged_mw.rl.networks import Memories, run_mlp, sample, update_normalizer
from legged_mw.rl.ppo import Recorded, UpdateRollback, make_recordable, why_stock
from legged_mw.rl.students.recurrent import step
from legged_mw.sim.graph import StepGraph


class GraphedDistillation(Recorded, Distillation):
    """Distillation with acting and update as replayed CUDA graphs.

    In these cases it is rsl-rl's own Distillation instead, and a message says so: a network other than a plain MLPModel
    or RNNModel, mixed precision, an optimizer other than Adam or AdamW, a distribution that is not Gaussian. On a CPU
    nothing is recorded.
    """

    def __new__(cls, student: MLPModel, teacher: MLPModel, storage: RolloutStorage, **settings: Any) -> Any:
        """Make a recorded learner, or rsl-rl's own if this configuration cannot be recorded."""
        # a teacher may have an estimator, because it does not learn
        reason = why_stock(student, teacher, teacher, settings)
        steps, length = storage.num_transitions_per_env, settings["gradient_length"]
        if steps % length:
            reason = f"gradient_length {length} does not divide a rollout of {steps} steps"
        if not reason:
            return super().__new__(cls)
        print(f"Distillation: rsl-rl's own update is used, not the recorded one: {reason}", flush=True)
        return Distillation(student, teacher, storage, **settings)

    def __init__(self, student: MLPModel, teacher: MLPModel, storage: RolloutStorage, **settings: Any) -> None:
        super().__init__(student, teacher, storage, **settings)
        self._rates = [self.learning_rate]
        make_recordable(self.optimizer, self._rates, str(self.device))
        seen = storage.observations.select(*student.obs_groups, *teacher.obs_groups)
        self._obs = TensorDict(
            {name: value[0].clone() for name, value in seen.items()}, [storage.num_envs], device=self.device
        )
        # the student learns from its own groups only
        storage.observations = storage.observations.select(*student.obs_groups)
        self._loss = torch.zeros((), device=self.device)
        self.rollback = UpdateRollback(self, (self.student,))
        self._begin()

    def _begin(self) -> None:
        """Make empty memories, and graphs that the next calls record."""
        self._memories = Memories((self.student, self.teacher), self.storage.num_envs, 1, str(self.device))
        self._act_graph, self._update_graph = (StepGraph(fn, str(self.device)) for fn in (self._act, self._update))

    # ---- the rollout ----------------------------------------------------------------------------------------------

    def act(self, obs: TensorDict) -> Tensor:
        """The student's sampled actions (N, A). The transition holds the teacher's until ``process_env_step``."""
        if self.storage.step == 0:
            self._memories.begin_rollout()
        self._obs.copy_(obs.select(*self._obs.keys()))
        self._act_graph()
        self.transition.observations = self._obs.select(*self.student.obs_groups)
        self.transition.actions, self.transition.privileged_actions = self._acted
        return self._acted[0].clone()

    def _act(self) -> None:
        actions = sample(self.student, self.student.mlp(self._latent(self.student)))
        target = self._mean(self.teacher, self._latent(self.teacher))
        self._acted = actions.detach(), target.detach()

    def _latent(self, model: MLPModel) -> Tensor:
        """The input of the network's MLP. It updates a memory with the observations."""
        return self._memories[model].advance(self._obs) if model in self._memories else model.get_latent(self._obs)

    def _mean(self, model: MLPModel, latent: Tensor) -> Tensor:
        output = run_mlp(model.mlp, latent)
        return model.distribution.deterministic_output(output) if model.distribution else output

    # ---- the update -----------------------------------------------------------------------------------------------

    def update(self) -> dict[str, Any]:
        """Learn from the storage step by step. Returns the mean loss as a tensor ()."""
        self.num_updates += 1
        self._update_graph()
        self.storage.clear()
        return {"behavior": self._loss.clone()}

    def _update(self) -> None:
        self.rollback.begin()
        st, memory = self.storage, self._memories.get(self.student)
        with torch.no_grad():
            seen = torch.cat([st.observations[group] for group in self.student.obs_groups], dim=-1).flatten(0, 1)
            inputs = self.student.obs_normalizer(seen).unflatten(0, st.rewards.shape[:2])
        chunks = [
            *zip(
                *(each.split(self.gradient_length) for each in (inputs, st.privileged_actions, st.dones.bool())),
                strict=True,
            )
        ]
        state = None
        self._loss.zero_()
        for _ in range(self.num_learning_epochs):
            state = memory.start[:, 0] if memory else None
            for inputs, targets, ended in chunks:
                latent, state = self._unroll(inputs, ended, state)
                self._gradient_step(latent, targets.flatten(0, 1))
        self._loss /= self.num_learning_epochs * len(chunks)
        if memory and state is not None:
            memory.now[:, 0].copy_(state)  # of the updated student, as in rsl-rl
        if isinstance(self.student.obs_normalizer, EmpiricalNormalization):
            with torch.no_grad():
                update_normalizer(self.student.obs_normalizer, seen, self.gpu_world_size)
        self.rollback.finish(self._loss)

    def _unroll(self, inputs: Tensor, ended: Tensor, state: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """The inputs of the student's MLP (S * N, size) over S steps, and the hidden state after them, detached.

        ``ended`` (S, N, 1): the episode ended in that step.
        """
        if state is None or not isinstance(self.student, RNNModel):
            return nn.functional.pad(
                inputs.flatten(0, 1), (0, -inputs.shape[2] % 4)
            ), None  # TF32 products are faster with a multiple of 4
        seen = []
        for x, over in zip(inputs, ended, strict=True):
            latent, state = step(self.student.rnn.rnn, x, state)
            seen.append(latent)
            state = state.masked_fill(over, 0.0)
        return torch.cat(seen), state.detach()

    def _gradient_step(self, latent: Tensor, target: Tensor) -> None:
        """One step towards the actions ``wanted`` (B, A). The loss is a sum of each step's mean, as in rsl-rl."""
        loss = self.loss_fn(self._mean(self.student, latent), target)
        self.optimizer.zero_grad()
        (loss * self.gradient_length).backward()
        if self.is_multi_gpu:
            self.reduce_parameters()
        if self.max_grad_norm:
            nn.utils.clip_grad_norm_(self.student.parameters(), self.max_grad_norm)
        self.optimizer.step()
        self._loss += loss.detach()
