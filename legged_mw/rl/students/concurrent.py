"""Concurrent teacher and student: the policy reads a latent, of a teacher's encoder or of a student's.

The teacher's encoder reads rows that only the simulator knows, the student's the robot's own observations. Some worlds
act by the teacher's latent, the others by the student's. PPO trains the policy in all worlds, and the teacher's encoder
in the teacher's worlds. The student's encoder learns by regression to the teacher's latent, in all worlds. During an
update the policy reads the student's latent of the rollout. Play and export use the student's path.

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
# its multiples' fractions fill [0, 1) evenly, out of step with terrain columns and any other period
_GOLDEN = 0.6180339887498949


class ConcurrentModel(RegressingModel):
    """Its network reads the newest frames and a latent of unit length; ``estimator`` is the student's encoder."""

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
        """``concurrent``: the config section, and ``newest``, (start, stop) of observation columns; then MLPModel's.

        Without ``groups`` it is a student that only acts. ``obs`` must be of all N worlds otherwise.
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

    teacher_worlds: Tensor  # (N, 1): the worlds that act by the teacher's latent

    def _get_latent_dim(self) -> int:
        return sum(stop - start for start, stop in self._newest) + self._size

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        """The network's input (B, newest + E) with the student's latent, which has no gradient."""
        seen = super().get_latent(obs, masks, hidden_state)
        with torch.no_grad():
            return join(seen, self._newest, self.estimator(seen))

    def rollout_latent(self, obs: TensorDict) -> Tensor:
        return self._take_over(self.get_latent(obs), self.teacher(self._known(obs)), self.teacher_worlds)

    @torch.no_grad()
    def regression_batch(self, obs: TensorDict, worlds: Tensor) -> tuple[Tensor, ...]:
        """The encoders' inputs (B, ...), padded to a multiple of four columns, and whether the teacher acted (B, 1)."""
        seen, known = MLPModel.get_latent(self, obs), self.teacher[0](self._known(obs))
        by_teacher = self.teacher_worlds.index_select(0, worlds).repeat(len(seen) // len(worlds), 1)
        return *(nn.functional.pad(each, (0, -each.shape[1] % 4)) for each in (seen, known)), by_teacher

    def learn(self, latent: Tensor, regression_batch: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        seen, known, by_teacher = regression_batch
        wanted = run_mlp(self.teacher[1], known)
        output = run_mlp(self.mlp, self._take_over(latent, wanted, by_teacher))
        return output, nn.functional.mse_loss(unit(run_mlp(self.estimator, seen)), unit(wanted).detach())

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
        return {"concurrent": concurrent_settings(sections, env, learns)}


class _OnnxStudent(nn.Module):
    """Observations (B, size) in their units -> mean actions (B, A), by the student's latent."""

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
    """The ``newest`` columns of the observations, and the latent beside them."""
    return torch.cat([*(seen[:, start:stop] for start, stop in newest), unit(encoded)], dim=-1)


def unit(x: Tensor) -> Tensor:
    """Vectors (B, E) of length 1."""
    return nn.functional.normalize(x, dim=-1)


def pick_teacher_worlds(worlds: int, share: float) -> Tensor:
    """The worlds that act by the teacher's latent (N, 1), the same in each run. Neighbours include both kinds."""
    return ((torch.arange(worlds, dtype=torch.float64) * _GOLDEN) % 1.0 < share)[:, None]


def concurrent_settings(sections: dict[str, Any], env: RobotTask, learns: bool) -> dict[str, Any]:
    """Section ``actor.concurrent`` of the learner's ``sections`` as ConcurrentModel takes it. Raises ConfigError.

    ``learns``: False for a student that only acts, and needs no teacher.
    """
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
    return {**concurrent, "newest": newest, "groups": groups}
