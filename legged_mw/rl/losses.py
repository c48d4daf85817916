"""PPO's losses and their gradients with respect to the networks' outputs, in closed form: on a GPU one kernel each, not fifty.

What autograd would find, for a Gaussian policy. Tensors are of B samples, the mirror images after the samples they are of.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage import RolloutStorage
from torch import Tensor

from legged_mw.rl.layers import kernels_for, sum_rows

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class PolicyLoss(NamedTuple):
    """Parts of the actor's loss (), and its gradients."""

    of_mean: Tensor  # (B, A)
    of_std: Tensor  # as the std
    surrogate: Tensor
    entropy: Tensor
    kl: Tensor  # divergence from the policy that acted


def own_std(distribution: GaussianDistribution) -> Tensor:
    """The std (A,) of a policy that has one for all states, else (B, A)."""
    if type(distribution) is not GaussianDistribution:
        return distribution.std
    if distribution.std_type == "log":
        return distribution.log_std_param.clamp(*distribution.log_std_range).exp()
    return distribution.std_param.clamp(*distribution.std_range)


@torch.no_grad()
def policy_loss(mean: Tensor, std: Tensor, batch: RolloutStorage.Batch, clip: float, entropy_coef: Tensor) -> PolicyLoss:
    """PPO's clipped surrogate loss less ``entropy_coef`` times the entropy. Entropy and divergence are not of mirror images."""
    assert batch.old_distribution_params is not None
    size, width = batch.old_distribution_params[0].shape
    fused = _fused if kernels_for(mean) and std.dim() == 1 else _anywhere
    of_mean, of_std, surrogate, kl = fused(mean, std, batch, clip)
    if std.dim() == 1:
        entropy = std.log().sum() + width * (0.5 + _HALF_LOG_2PI)
        of_std = of_std - entropy_coef / std
    else:
        entropy = std[:size].log().sum() / size + width * (0.5 + _HALF_LOG_2PI)
        of_std[:size] -= entropy_coef / std[:size] / size
    return PolicyLoss(of_mean, of_std, surrogate / len(mean), entropy, kl / size)


def _fused(mean: Tensor, std: Tensor, batch: RolloutStorage.Batch, clip: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The gradients of the surrogate loss; its sum and that of the divergence."""
    (rows, width), of_mean, kernels = mean.shape, torch.empty_like(mean), kernels_for(mean)
    terms = mean.new_empty(rows, width + 2)
    samples = batch.actions, batch.advantages, batch.old_actions_log_prob, *(batch.old_distribution_params or ())
    kernels.launch(kernels.policy_loss, rows, mean, std, *samples, clip, of_mean, terms)
    sums = sum_rows(terms)
    return of_mean, sums[:width], sums[width], sums[width + 1]


def _anywhere(mean: Tensor, std: Tensor, batch: RolloutStorage.Batch, clip: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """As ``_fused``."""
    old_mean, old_std = batch.old_distribution_params  # type: ignore[misc]
    size, advantages = len(old_mean), batch.advantages
    z = (batch.actions - mean) / std  # type: ignore[operator]
    log_prob = -(0.5 * z.square() + std.log() + _HALF_LOG_2PI).sum(dim=1, keepdim=True)
    ratio = torch.exp(log_prob - batch.old_actions_log_prob)  # type: ignore[operator]
    plain, clipped = -advantages * ratio, -advantages * ratio.clamp(1.0 - clip, 1.0 + clip)  # type: ignore[operator]
    weight = torch.where(plain < clipped, 0.0, plain) / len(mean)  # a clipped ratio has no slope
    of_mean, of_std = weight * z / std, weight * (z.square() - 1.0) / std
    new_std = std[:size] if std.dim() == 2 else std
    ratio_of_std, moved = old_std / new_std, (old_mean - mean[:size]) / new_std
    kl = 0.5 * (ratio_of_std.square() + moved.square() - 1.0) - ratio_of_std.log()
    return of_mean, of_std if std.dim() == 2 else sum_rows(of_std), torch.max(plain, clipped).sum(), kl.sum()


@torch.no_grad()
def value_loss(values: Tensor, batch: RolloutStorage.Batch, clip: float, coef: float) -> tuple[Tensor, Tensor]:
    """The gradient (B, 1) of ``coef`` times the value loss, and the value loss (); clipped, unless ``clip`` is 0."""
    if kernels := kernels_for(values):
        of_values, terms = torch.empty_like(values), torch.empty_like(values)
        kernels.launch(kernels.value_loss, len(values), values, batch.values, batch.returns, clip, coef, of_values, terms)
        return of_values, terms.mean()
    error = values - batch.returns  # type: ignore[operator]
    slope, terms = 2.0 * error, error.square()
    if clip:
        moved = values - batch.values  # type: ignore[operator]
        near = (batch.values + moved.clamp(-clip, clip) - batch.returns).square()  # type: ignore[operator]
        slope = torch.where((near > terms) & (moved.abs() > clip), 0.0, slope)
        terms = torch.max(near, terms)
    return coef / len(values) * slope, terms.mean()
