"""PPO's losses for a Gaussian policy, as in rsl-rl, and their gradients with respect to the networks' outputs.

The formulas stand here once, and autograd differentiates them. On a GPU a kernel computes each with its gradient
(fast/kernels.py), and tests hold the kernels to the formulas. Tensors are of B samples; mirror images come last.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from rsl_rl.modules.distribution import GaussianDistribution
from rsl_rl.storage import RolloutStorage
from torch import Tensor, nn

from legged_mw.rl.layers import kernels_for, sum_rows

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


class PolicyLoss(NamedTuple):
    """Terms of the actor's loss (), and its gradients."""

    of_mean: Tensor  # (B, A)
    of_std: Tensor  # shaped as the std
    surrogate: Tensor
    entropy: Tensor
    kl: Tensor  # divergence from the policy of the rollout


def own_std(distribution: GaussianDistribution) -> Tensor:
    """The std (A,) of a policy that has one for all states, else (B, A)."""
    if type(distribution) is not GaussianDistribution:
        return distribution.std
    log = distribution.std_type == "log"
    own = distribution.log_std_param if log else distribution.std_param
    low, high = distribution.log_std_range if log else distribution.std_range
    std = nn.functional.hardtanh(own, min_val=low, max_val=high)  # a clamp whose gradient is one kernel, not five
    return std.exp() if log else std


@torch.no_grad()
def policy_loss(
    mean: Tensor, std: Tensor, batch: RolloutStorage.Batch, clip: float, entropy_coef: Tensor
) -> PolicyLoss:
    """PPO's clipped surrogate loss less ``entropy_coef`` times the entropy. Entropy and KL leave out mirror images."""
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
    """The gradient (B, 1) of ``coef`` times the value loss, and the value loss (); clipped, unless ``clip`` is 0."""
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
