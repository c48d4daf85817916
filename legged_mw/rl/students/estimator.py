"""An actor that reads its own estimate of values that a robot cannot measure, trained by regression.

The estimator maps the actor's observations to rows that only the simulator has. The policy reads the observations and
the estimate. No gradient of the policy reaches the estimator, and no gradient of the estimator reaches the policy.
In an update the policy reads the estimate from the rollout, and the estimator learns in parallel.
"""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import torch
from rsl_rl.modules import MLP, EmpiricalNormalization
from tensordict import TensorDict
from torch import Tensor, nn

from legged_mw.envs.observations import Row
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.networks import RegressingModel, run_mlp, update_normalizer
from legged_mw.rl.policies import ESTIMATE
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

SMALLEST = 0.01  # smallest standard deviation of a target, in its unit, like rsl-rl's eps for observations
FIELD = "actor.estimator.targets"


class Target(NamedTuple):
    """A row to estimate, and its place in an observation group."""

    name: str
    group: str
    start: int  # column of its newest frame in the group
    scale: list[float]  # the group holds scale * value


class TargetNormalizer(EmpiricalNormalization):
    """A normaliser without eps, so that an export has the exact standard deviation."""

    def forward(self, x: Tensor) -> Tensor:
        return (x - self._mean) / self._std.clamp(min=SMALLEST)

    def inverse(self, y: Tensor) -> Tensor:
        return y * self._std.clamp(min=SMALLEST) + self._mean


class EstimatingModel(RegressingModel):
    """A network that reads normalised observations and the normalised estimate of E values."""

    field, regression = FIELD, "estimate"

    def __init__(
        self,
        obs: TensorDict,
        obs_groups: dict[str, list[str]],
        obs_set: str,
        output_dim: int,
        *,
        estimator: dict[str, Any],
        **more: Any,
    ) -> None:
        """``estimator``: the config section with ``targets``, a list of ``Target``. Others: see MLPModel."""
        targets = [Target(*target) for target in estimator["targets"]]
        scales = [scale for target in targets for scale in target.scale]
        self._targets, self._size, self.learning_rate = targets, len(scales), estimator["learning_rate"]
        super().__init__(obs, obs_groups, obs_set, output_dim, **more)
        self.estimator = MLP(self.obs_dim, self._size, estimator["hidden_dims"], estimator["activation"])
        self.target_normalizer = TargetNormalizer(self._size)
        self.register_buffer("_scales", torch.tensor(scales), persistent=False)

    _scales: Tensor

    def _get_latent_dim(self) -> int:
        return self.obs_dim + self._size

    def get_latent(self, obs: TensorDict, masks: Tensor | None = None, hidden_state: Any = None) -> Tensor:
        """The network's input (B, obs + E). The estimate has no gradient."""
        seen = super().get_latent(obs, masks, hidden_state)
        with torch.no_grad():
            estimate = self.estimator(seen)
        return torch.cat([seen, estimate], dim=-1)

    @torch.no_grad()
    def regression_batch(self, obs: TensorDict, worlds: Tensor) -> tuple[Tensor, ...]:
        """The normalised targets (B, E) of the estimator."""
        return (self.target_normalizer(self.truth(obs)),)

    def learn(self, latent: Tensor, regression_batch: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """Run network and estimator. The estimator reads the first columns of ``latent``, the observations."""
        return run_mlp(self.mlp, latent), nn.functional.mse_loss(run_mlp(self.estimator, latent), regression_batch[0])

    def update_regression_normalizer(self, obs: TensorDict, ranks: int) -> None:
        update_normalizer(self.target_normalizer, self.truth(obs), ranks)

    def truth(self, obs: TensorDict) -> Tensor:
        """The targets (B, E) in their units, from the groups of ``obs``."""
        parts = [obs[each.group][:, each.start : each.start + len(each.scale)] for each in self._targets]
        return torch.cat(parts, dim=1) / self._scales

    def estimate(self, obs: TensorDict) -> Tensor:
        """The estimate (B, E) in the targets' units."""
        return self.target_normalizer.inverse(self.estimator(super().get_latent(obs)))

    def columns_of(self, row: str) -> slice | None:
        """Columns of a row in the estimate; None if it has no such row."""
        start = 0
        for target in self._targets:
            if target.name == row:
                return slice(start, start + len(target.scale))
            start += len(target.scale)
        return None

    def as_onnx(self, verbose: bool) -> nn.Module:
        return _OnnxEstimatingModel(self)

    @staticmethod
    def settings(sections: dict[str, Any], env: RobotTask, learns: bool) -> dict[str, Any]:
        targets = [tuple(target) for target, _ in find_targets(sections, env, learns)]
        return {"estimator": {**sections["actor"]["estimator"], "targets": targets}}


def believed_velocity(policy: Any, obs: TensorDict) -> Tensor | None:
    """The estimated vx, vy (N, 2) [m/s] of ``policy``; None without an estimator."""
    columns = policy.columns_of("base_lin_vel") if hasattr(policy, "columns_of") else None
    return None if columns is None else policy.estimate(obs)[:, columns][:, :2]


class _OnnxEstimatingModel(nn.Module):
    """Observations (B, size) in their units -> mean actions (B, A), and the estimate (B, E) in the targets' units."""

    outputs = [ESTIMATE]  # additional to the actions

    def __init__(self, model: EstimatingModel) -> None:
        super().__init__()
        parts = copy.deepcopy((model.obs_normalizer, model.mlp, model.estimator, model.target_normalizer))
        self.obs_normalizer, self.mlp, self.estimator, self.target_normalizer = parts
        self.target_normalizer._std.clamp_(min=SMALLEST)
        assert model.distribution is not None
        self.deterministic_output = model.distribution.as_deterministic_output_module()

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        seen = self.obs_normalizer(obs)
        estimate = self.estimator(seen)
        actions = self.deterministic_output(self.mlp(torch.cat([seen, estimate], dim=-1)))
        return actions, estimate * self.target_normalizer._std + self.target_normalizer._mean


# ---- the config section ---------------------------------------------------------------------------------------------


def find_targets(sections: dict[str, Any], env: RobotTask, learns: bool = True) -> list[tuple[Target, Row]]:
    """Each target and its row, from the critic's groups first; no row that the actor reads. Raises ConfigError."""
    names, obs_groups, groups = (
        sections["actor"]["estimator"]["targets"],
        sections["obs_groups"],
        env.observations.groups,
    )
    order = [
        group
        for group in dict.fromkeys([*obs_groups["critic"], *groups])
        if group in groups and group not in obs_groups["actor"]
    ]
    rows = {row.name: (group, row) for group in reversed(order) for row in groups[group] if not row.group}
    targets = []
    for i, name in enumerate(names):
        if name not in rows and not learns and (width := env.domain_rand.widths.get(name)):
            targets.append((Target(name, "", 0, [1.0] * width), Row(name, torch.zeros(1, width))))
            continue
        if name not in rows:
            hint = (
                f" (observations.{name} = True adds it)" if getattr(env.cfg.observations, name, None) is False else ""
            )
            where = ", ".join(f"'{group}'" for group in order) or "any group that the actor does not read"
            raise ConfigError(f"{FIELD}: {unknown('observation row', name, rows, where)}{hint}")
        if name in names[:i]:
            raise ConfigError(f"{FIELD} names '{name}' twice")
        group, row = rows[name]
        targets.append((Target(name, group, env.observations.newest(group, name).start, row.column_scales()), row))
    return targets
