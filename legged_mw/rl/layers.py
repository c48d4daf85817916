"""Network layers for the recorded update: the same values and gradients as torch's own, in fewer and larger kernels."""

from __future__ import annotations

import math
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.modules import EmpiricalNormalization
from torch import Tensor, nn

_SUM_ROWS = 128  # summed by a thread; the rest of the rows is summed side by side


class Linear(torch.autograd.Function):
    """``x W^T + b`` for many rows, faster than torch's own in two places.

    Torch sums the bias gradient in one pass that leaves most of a GPU idle, this in two. ``x`` may have more columns than
    the weight, of zeros: a multiple of four of them is what TF32 products want.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        if x.shape[1] > weight.shape[1]:
            ctx.columns = weight.shape[1]
            weight = nn.functional.pad(weight, (0, x.shape[1] - weight.shape[1]))
        ctx.save_for_backward(x, weight)
        return torch.addmm(bias, x, weight.t())

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (grad,), (x, weight) = grads, ctx.saved_tensors
        columns = getattr(ctx, "columns", None)
        return grad @ weight if ctx.needs_input_grad[0] else None, (grad.t() @ x)[:, :columns], sum_rows(grad)


def sum_rows(x: Tensor) -> Tensor:
    """Sum over the rows of ``x`` (B, size), in two passes."""
    return x.view(-1, math.gcd(len(x), _SUM_ROWS), x.shape[1]).sum(dim=1).sum(dim=0)


def run_mlp(layers: nn.Module, x: Tensor) -> Tensor:
    """The output of an rsl-rl MLP for inputs (B, size)."""
    for layer in layers:  # type: ignore[attr-defined]
        x = Linear.apply(x, layer.weight, layer.bias) if type(layer) is nn.Linear else layer(x)  # type: ignore[misc]
    return x


def sample(model: MLPModel, latent: Tensor) -> Tensor:
    """Actions (N, A) drawn from a policy with a Gaussian, for what its MLP reads; torch.normal would check the std on the host."""
    assert model.distribution is not None
    model.distribution.update(model.mlp(latent))  # the forward pass without its own sample
    mean = model.output_mean
    return mean + model.output_std * torch.randn_like(mean)


def update_normalizer(normalizer: EmpiricalNormalization, x: Tensor, world_size: int) -> None:
    """rsl-rl's running mean and variance over ``x`` (B, size), in place and without its copy from the host."""
    if not normalizer.training:
        return
    count = x.shape[0] * world_size
    var, mean = torch.var_mean(x, dim=0, unbiased=False, keepdim=True)
    if world_size > 1:  # every rank brings as many samples
        own_mean = mean.clone()
        torch.distributed.all_reduce(mean)
        mean /= world_size
        var += (own_mean - mean).square()
        torch.distributed.all_reduce(var)
        var /= world_size
    normalizer.count += count
    rate = count / normalizer.count
    delta = mean - normalizer._mean
    normalizer._mean += rate * delta
    normalizer._var += rate * (var - normalizer._var + delta * (mean - normalizer._mean))
    normalizer._std.copy_(normalizer._var.sqrt())
