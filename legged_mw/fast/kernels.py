"""Warp kernels of the recorded update. Each replaces about a dozen of torch's kernels. A CPU uses torch's own.

They run in torch's stream, so torch's CUDA graphs record them.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportOperatorIssue=false
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportAttributeAccessIssue=false
# pyright: reportReturnType=false, reportAssignmentType=false, reportRedeclaration=false
# ruff: noqa: UP018
# (warp compiles this file as its own language: int() makes a variable, and types overload functions)
from __future__ import annotations

import functools
import math
from typing import Any

import torch
import warp as wp
from torch import Tensor

ROWS = 32  # number of rows that one thread sums
_AT_ONCE = 8  # number of rows read before a write, to wait for memory once
_Rows = wp.types.matrix(shape=(_AT_ONCE, 4), dtype=float)
_BLOCK = 128  # threads per block: small layers then use every processor
_HALF_LOG_2PI = wp.constant(0.5 * math.log(2.0 * math.pi))


def launch(kernel: Any, dim: int | tuple[int, ...], *inputs: Any) -> None:
    """Run a kernel over tensors and numbers in torch's stream."""
    wp.init()  # no effect if a simulation did so
    device = next(each.device for each in inputs if isinstance(each, Tensor))
    arrays = [_array(each.detach()) if isinstance(each, Tensor) else each for each in inputs]
    stream = _stream(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    wp.launch(kernel, dim=dim, inputs=arrays, device=str(device), stream=stream, block_dim=_BLOCK)


def load(device: str) -> None:
    """Compile all kernels for a device, or load them from the cache."""
    wp.load_module(__name__, device=device)


def _array(x: Tensor) -> wp.array:
    """A tensor as a warp array: (a, b, 4) becomes (a, b) vectors, a scalar one element."""
    return wp.from_torch(x, dtype=wp.vec4) if x.dim() == 3 else wp.from_torch(x.view(x.shape or 1))


_stream = functools.cache(wp.stream_from_torch)  # a stream must not be wrapped during capture


# ---- the networks ---------------------------------------------------------------------------------------------------


@wp.func
def _unpack(x: wp.vec4):
    return x


@wp.func
def _unpack(x: wp.int64):
    """Unpack four bfloat16 values, the first in the lowest bits. Their bits are the upper half of a float's."""
    bits = wp.cast(x, wp.uint64)
    low = wp.uint32(bits)
    high = wp.uint32(bits >> wp.uint64(32))
    mask = wp.uint32(65535) << wp.uint32(16)
    return wp.vec4(
        wp.cast(low << wp.uint32(16), float),
        wp.cast(low & mask, float),
        wp.cast(high << wp.uint32(16), float),
        wp.cast(high & mask, float),
    )


@wp.func
def _round(low: float, high: float):
    """Pack two values as bfloat16."""
    return (wp.uint32(wp.cast(wp.bfloat16(high), wp.uint16)) << wp.uint32(16)) | wp.uint32(
        wp.cast(wp.bfloat16(low), wp.uint16)
    )


@wp.func
def _pack(x: wp.vec4, like: wp.vec4):
    return x


@wp.func
def _pack(x: wp.vec4, like: wp.int64):
    return wp.cast((wp.uint64(_round(x[2], x[3])) << wp.uint64(32)) | wp.uint64(_round(x[0], x[1])), wp.int64)


@wp.kernel(enable_backward=False)
def _elu_backward(
    grad: wp.array2d[Any], out: wp.array2d[Any], into: wp.array2d[Any], sums: wp.array2d[wp.vec4], first: int
):
    block, c = wp.tid()
    total = wp.vec4()
    for row in range(block * ROWS, wp.min((block + 1) * ROWS, grad.shape[0]), _AT_ONCE):
        g = _Rows()
        y = _Rows()
        for k in range(_AT_ONCE):
            g[k] = _unpack(grad[row + k, c])
            y[k] = _unpack(out[row + k, c])
        for k in range(_AT_ONCE):
            value = g[k]
            for j in range(4):
                value[j] = value[j] * (wp.min(y[k, j], 0.0) + 1.0)
            into[row + k, c] = _pack(value, into[row + k, c])
            total += value
    sums[block, first + c] = total


for _types in ((wp.vec4, wp.vec4, wp.vec4), (wp.int64, wp.int64, wp.int64), (wp.vec4, wp.int64, wp.int64)):
    wp.overload(_elu_backward, [*(wp.array2d(dtype=each) for each in _types), wp.array2d(dtype=wp.vec4), int])


def _fours(x: Tensor) -> Tensor:
    """(B, C) as C / 4 columns of four values: an integer with the bits of four bfloat16, or a float32 vector."""
    return x.view(torch.int64) if x.dtype == torch.bfloat16 else x.unflatten(1, (-1, 4))


def fits(rows: int, sizes: list[int]) -> bool:
    """Whether ``elu_backward`` supports layers of these sizes."""
    return rows % _AT_ONCE == 0 and not any(size % 4 for size in sizes)


def elu_backward(grad: Tensor, out: Tensor, sums: Tensor, first: int) -> Tensor:
    """The gradient at an ELU's input, from the gradient at its output and the output itself, all (B, C).

    Its sums over every ROWS rows go to the columns of ``sums`` (B / ROWS, ...) from ``first`` on. float32 or bfloat16.
    """
    into = torch.empty_like(out)
    launch(_elu_backward, (len(sums), out.shape[1] // 4), *map(_fours, (grad, out, into, sums)), first // 4)
    return into


# ---- the losses -----------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def policy_loss(
    mean: wp.array2d[float],
    std: wp.array[float],
    actions: wp.array2d[float],
    advantages: wp.array2d[float],
    old_log_prob: wp.array2d[float],
    old_mean: wp.array2d[float],  # of samples without mirror images, which come first; also in the next lines
    old_std: wp.array2d[float],
    clip: float,
    of_mean: wp.array2d[float],
    # (B, A + 2): terms of the std's gradient, the surrogate loss, the KL divergence
    terms: wp.array2d[float],
):
    i = wp.tid()
    width = mean.shape[1]
    log_prob = float(0.0)
    kl = float(0.0)
    for a in range(width):
        z = (actions[i, a] - mean[i, a]) / std[a]
        log_prob -= 0.5 * z * z + wp.log(std[a]) + _HALF_LOG_2PI
        if i < old_mean.shape[0]:
            ratio_of_std = old_std[i, a] / std[a]
            moved = (old_mean[i, a] - mean[i, a]) / std[a]
            kl += 0.5 * (ratio_of_std * ratio_of_std + moved * moved - 1.0) - wp.log(ratio_of_std)
    ratio = wp.exp(log_prob - old_log_prob[i, 0])
    plain = -advantages[i, 0] * ratio
    clipped = -advantages[i, 0] * wp.clamp(ratio, 1.0 - clip, 1.0 + clip)
    weight = plain / float(mean.shape[0])
    if plain < clipped:
        weight = 0.0
    for a in range(width):
        z = (actions[i, a] - mean[i, a]) / std[a]
        of_mean[i, a] = weight * z / std[a]
        terms[i, a] = weight * (z * z - 1.0) / std[a]
    terms[i, width] = wp.max(plain, clipped)
    terms[i, width + 1] = kl


@wp.kernel(enable_backward=False)
def policy_sums(
    sums: wp.array[float],  # (A + 2,) over all samples
    std: wp.array[float],
    entropy_coef: wp.array[float],
    rows: float,
    size: float,  # number of samples without mirror images
    of_std: wp.array[float],
    parts: wp.array[float],  # surrogate loss, entropy, KL divergence
):
    width = std.shape[0]
    entropy = float(0.0)
    for a in range(width):
        entropy += wp.log(std[a]) + 0.5 + _HALF_LOG_2PI
        of_std[a] = sums[a] - entropy_coef[0] / std[a]
    parts[0] = sums[width] / rows
    parts[1] = entropy
    parts[2] = sums[width + 1] / size


@wp.kernel(enable_backward=False)
def value_loss(
    values: wp.array2d[float],
    old: wp.array2d[float],
    returns: wp.array2d[float],
    clip: float,  # 0: no clipping
    scale: float,
    of_values: wp.array2d[float],
    terms: wp.array2d[float],
):
    i = wp.tid()
    error = values[i, 0] - returns[i, 0]
    loss = error * error
    slope = 2.0 * error
    if clip > 0.0:
        moved = values[i, 0] - old[i, 0]
        near = old[i, 0] + wp.clamp(moved, -clip, clip) - returns[i, 0]
        if near * near > loss:
            loss = near * near
            if wp.abs(moved) > clip:
                slope = 0.0
    of_values[i, 0] = scale * slope / float(values.shape[0])
    terms[i, 0] = loss


# ---- the step -------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def adapt_rate(
    kl: wp.array[float],
    wanted: wp.array[wp.float64],
    rate: wp.array[wp.float64],
    adam_rate: wp.array[float],
    step: wp.float64,
    low: wp.float64,
    high: wp.float64,
):
    found = wp.float64(kl[0])
    if found > wanted[0] * wp.float64(2.0):
        rate[0] = wp.max(rate[0] / step, low)
    elif found < wanted[0] / wp.float64(2.0) and found > wp.float64(0.0):
        rate[0] = wp.min(rate[0] * step, high)
    adam_rate[0] = float(rate[0])


@wp.kernel(enable_backward=False)
def begin_adam(
    norm: wp.array[float],
    limit: float,
    rate: wp.array[float],
    beta1: wp.float64,
    beta2: wp.float64,
    decay: float,
    step: wp.array[float],
    factors: wp.array[float],
):
    step[0] = step[0] + 1.0
    count = wp.float64(step[0])
    one = wp.float64(1.0)
    factors[0] = wp.min(limit / (norm[0] + 1.0e-6), 1.0)
    if not wp.isfinite(norm[0]):
        factors[0] = limit / norm[0]
    factors[1] = float(wp.float64(rate[0]) / (one - wp.pow(beta1, count)))
    factors[2] = float(wp.sqrt(one - wp.pow(beta2, count)))
    factors[3] = rate[0] * decay


@wp.kernel(enable_backward=False)
def adam(
    grad: wp.array[float],
    factors: wp.array[float],
    beta1: float,
    beta2: float,
    eps: float,
    values: wp.array[float],
    mean: wp.array[float],
    square: wp.array[float],
):
    i = wp.tid()
    g = grad[i] * factors[0]
    m = mean[i] + (1.0 - beta1) * (g - mean[i])
    v = beta2 * square[i] + (1.0 - beta2) * g * g
    values[i] = values[i] - factors[3] * values[i] - factors[1] * m / (wp.sqrt(v) / factors[2] + eps)
    mean[i] = m
    square[i] = v
