"""Batched rotations and masked writes without host reads. Quaternions are (w, x, y, z), unit, body to world."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.utils.opaque import traces


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """Rotate ``v`` (..., 3) from the frame of a body with attitude ``q`` (..., 4) to the world frame."""
    w, u = q[..., :1], q[..., 1:]
    t = torch.linalg.cross(u, v)
    return torch.addcmul(v, w, t, value=2.0).add_(torch.linalg.cross(u, t), alpha=2.0)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """Rotate ``v`` (..., 3) from the world frame to the frame of a body with attitude ``q`` (..., 4)."""
    w, u = q[..., :1], q[..., 1:]
    t = torch.linalg.cross(u, v)
    return torch.addcmul(v, w, t, value=-2.0).add_(torch.linalg.cross(u, t), alpha=2.0)


def yaw_of(q: Tensor) -> Tensor:
    """Heading of the body's x axis in the world's x-y plane [rad] (...,), from the attitude ``q`` (..., 4)."""
    w, x, y, z = q.unbind(dim=-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrap_to_pi(angle: Tensor) -> Tensor:
    """``angle`` [rad] plus a multiple of 2 pi, from -pi to pi."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def assign(dst: Tensor, mask: Tensor, src: Tensor | float) -> None:
    """Write ``src`` into the rows of ``dst`` (N, ...) where ``mask`` (N,) is true; in place, correct for NaN."""
    mask = mask.view(-1, *[1] * (dst.dim() - 1))
    if isinstance(src, Tensor):
        dst.copy_(torch.where(mask, src, dst))
    else:
        dst.masked_fill_(mask, src)


def maybe_any(mask: Tensor) -> bool:
    """Whether ``mask`` may be true anywhere. On a GPU and in a traced step always True, so that nothing is read."""
    return mask.device.type != "cpu" or bool(traces) or bool(mask.any())


def spread(values: Tensor, count: int) -> Tensor:
    """Resample values (M, ...) of M worlds to ``count`` worlds: each takes the value at its share of the order."""
    return values[torch.arange(count, device=values.device) * len(values) // count]


def columns(num_rows: int, device: str, **widths: int) -> tuple[Tensor, dict[str, Tensor]]:
    """A matrix of zeros (N, sum of widths), and name -> view (N, width) of its columns, to clear all at once."""
    matrix = torch.zeros(num_rows, sum(widths.values()), device=device)
    return matrix, dict(zip(widths, matrix.split(list(widths.values()), dim=1), strict=True))
