"""Concurrent teacher and student: the policy reads a latent from a teacher's encoder or a student's encoder.

The teacher's encoder reads rows that only the simulator has. The student's encoder reads the robot's observations.
Some worlds act with the teacher's latent, the others with the student's. PPO trains the policy in all worlds, and the
teacher's encoder in the teacher's worlds. The student's encoder learns the teacher's latent by regression, in all.
In an update the policy reads the student's latent from the rollout. Play and export use the student.

Wang et al., "CTS: Concurrent Teacher-Student Reinforcement Learning for Legged Locomotion", RA-L 2024.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import MLP, EmpiricalNormalization
from tensordict import TensorDict
from torch import Tensor, nn

from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.networks import RegressingModel, run_mlp, update_normalizer
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

FIELD = "actor.concurrent.groups"
# golden ratio: the fractions of its multiples fill [0, 1) evenly, with no period in common with terrain columns
_GOLDEN = 0.6180339887498949


class ConcurrentModel(RegressingModel):
    """A network that reads the newest frames and a latent of length 1. ``estimator`` is the student's encoder."""

    field, regression = FIELD, "student"

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        concurrent: dict[str, Any],
        **more: Any,
    ) -> None:
        """``concurrent``: the config section with ``newest``, (start, stop) of observation columns. Then MLPModel's.

        Without ``groups`` it is a student that only acts. Otherwise ``obs`` must have all N worlds.
        """
        self._newest, self._size, self._groups = concurrent["newest"], concurrent["latent_dim"], concurrent["groups"]
        self.learning_rate = concurrent["learning_rate"]
        super().__init__(obs, obs_groups, obs_set, output_dim, **more)
        encoder = self._size, concurrent["hidden_dims"], concurrent["activation"]
        self.estimator = MLP(self.obs_dim, *encoder)
        if self._groups:
            known = sum(obs[group].shape[1] for group in self._groups)
            self.teacher = nn.Sequential(
                EmpiricalNormalization(known) if self.obs_normalization else nn.Identity(), MLP(known, *encoder)
            )
            self.register_buffer(
                "teacher_worlds", pick_teacher_worlds(obs.batch_size[0], concurrent["teacher_share"]), persistent=False
            )

    teacher_worlds: Tensor  # (N, 1): True for worlds that act with the teacher's latent

    def _get_latent_dim(self) -> int:
        return sum(stop - start for start, stop in self._newest) + self._size

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        """The network's input (B, newest + E) with the student's latent, without gradient."""
        seen = super().get_latent(obs, masks, hidden_state)
        with torch.no_grad():
            return join(seen, self._newest, self.estimator(seen))

    def rollout_latent(self, obs: TensorDict) -> Tensor:
        return self._take_over(self.get_latent(obs), self.teacher(self._known(obs)), self.teacher_worlds)

    @torch.no_grad()
    def regression_batch(self, obs: TensorDict, worlds: Tensor) -> tuple[Tensor, ...]:
        """The encoders' inputs (B, ...), padded to a multiple of four columns; true where the teacher acted (B, 1)."""
        seen, known = MLPModel.get_latent(self, obs), self.teacher[0](self._known(obs))
        by_teacher = self.teacher_worlds.index_select(0, worlds).repeat(len(seen) // len(worlds), 1)
        return *(nn.functional.pad(each, (0, -each.shape[1] % 4)) for each in (seen, known)), by_teacher

    def learn(self, latent: Tensor, regression_batch: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        seen, known, by_teacher = regression_batch
        target = run_mlp(self.teacher[1], known)
        output = run_mlp(self.mlp, self._take_over(latent, target, by_teacher))
        return output, nn.functional.mse_loss(unit(run_mlp(self.estimator, seen)), unit(target).detach())

    def update_regression_normalizer(self, obs: TensorDict, ranks: int) -> None:
        if isinstance(normalizer := self.teacher[0], EmpiricalNormalization):
            update_normalizer(normalizer, self._known(obs), ranks)

    def _known(self, obs: TensorDict) -> Tensor:
        return torch.cat([obs[group] for group in self._groups], dim=-1)

    def _take_over(self, own: Tensor, encoded: Tensor, by_teacher: Tensor) -> Tensor:
        """The network's input (B, ...), with the teacher's latent where ``by_teacher`` (B, 1)."""
        stop = self._get_latent_dim()
        start = stop - self._size
        return torch.cat(
            [own[:, :start], torch.where(by_teacher, unit(encoded), own[:, start:stop]), own[:, stop:]], dim=1
        )

    def as_onnx(self, verbose: bool) -> nn.Module:
        return _OnnxStudent(self)

    @staticmethod
    def settings(sections: dict[str, Any], env: RobotTask, learns: bool) -> dict[str, Any]:
        concurrent, read = sections["actor"]["concurrent"], sections["obs_groups"]["actor"]
        groups = concurrent["groups"] if learns else []
        for group in groups:
            if group not in env.observations.groups:
                raise ConfigError(
                    f"{FIELD}: {unknown('observation group', group, env.observations.groups, 'the observation table')}"
                )
            if group in read:
                raise ConfigError(
                    f"{FIELD}: the actor reads '{group}' itself; the teacher's encoder is for what a robot does not measure"
                )
        newest, stop = [], 0
        for row in (row for group in read for row in env.observations.rows(group)):
            stop += row.size
            newest.append((stop - row.value.shape[1], stop))
        return {"concurrent": {**concurrent, "newest": newest, "groups": groups}}


class _OnnxStudent(nn.Module):
    """Observations (B, size) in their units -> mean actions (B, A), with the student's latent."""

    def __init__(self, model: ConcurrentModel) -> None:
        super().__init__()
        self._newest = model._newest
        self.obs_normalizer, self.mlp, self.estimator = copy.deepcopy(
            (model.obs_normalizer, model.mlp, model.estimator)
        )
        assert model.distribution is not None
        self.deterministic_output = model.distribution.as_deterministic_output_module()

    def forward(self, obs: Tensor) -> Tensor:
        seen = self.obs_normalizer(obs)
        return self.deterministic_output(self.mlp(join(seen, self._newest, self.estimator(seen))))


def join(seen: Tensor, newest: list[tuple[int, int]], encoded: Tensor) -> Tensor:
    """Concatenate the ``newest`` columns of the observations and the latent."""
    return torch.cat([*(seen[:, start:stop] for start, stop in newest), unit(encoded)], dim=-1)


def unit(x: Tensor) -> Tensor:
    """Normalise vectors (B, E) to length 1."""
    return nn.functional.normalize(x, dim=-1)


def pick_teacher_worlds(worlds: int, share: float) -> Tensor:
    """(N, 1) True for worlds that act with the teacher's latent, equal in each run. Neighbours include both kinds."""
    return ((torch.arange(worlds, dtype=torch.float64) * _GOLDEN) % 1.0 < share)[:, None]
