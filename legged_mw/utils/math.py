"""Batched rotations and masked writes without host reads. Quaternions are (w, x, y, z), unit, body to world."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.utils.opaque import tracing


def quat_rotate(q: Tensor, v: Tensor) -> Tensor:
    """The body-frame vector ``v`` (..., 3) of a body with attitude ``q`` (..., 4), in the world frame."""
    w, u = q[..., :1], q[..., 1:]
    t = torch.linalg.cross(u, v)
    return torch.addcmul(v, w, t, value=2.0).add_(torch.linalg.cross(u, t), alpha=2.0)


def quat_rotate_inverse(q: Tensor, v: Tensor) -> Tensor:
    """The world-frame vector ``v`` (..., 3) in the frame of a body with attitude ``q`` (..., 4)."""
    w, u = q[..., :1], q[..., 1:]
    t = torch.linalg.cross(u, v)
    return torch.addcmul(v, w, t, value=-2.0).add_(torch.linalg.cross(u, t), alpha=2.0)


def yaw_of(q: Tensor) -> Tensor:
    """Heading of the body's x axis in the world's plane [rad] (...,) from the attitude ``q`` (..., 4)."""
    w, x, y, z = q.unbind(dim=-1)
    return torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def wrap_to_pi(angle: Tensor) -> Tensor:
    """The same angle [rad] between -pi and pi."""
    return torch.remainder(angle + torch.pi, 2.0 * torch.pi) - torch.pi


def assign(dst: Tensor, mask: Tensor, src: Tensor | float) -> None:
    """Write ``src`` into the rows of ``dst`` (N, ...) where ``mask`` (N,) is true; fixed shape, in place, NaN-safe."""
    mask = mask.view(-1, *[1] * (dst.dim() - 1))
    if isinstance(src, Tensor):
        dst.copy_(torch.where(mask, src, dst))
    else:
        dst.masked_fill_(mask, src)


def maybe_any(mask: Tensor) -> bool:
    """False if ``mask`` is all false on a CPU. On a GPU and in a traced step always True, so that nothing is read."""
    return mask.device.type != "cpu" or tracing() or bool(mask.any())


def spread(values: Tensor, count: int) -> Tensor:
    """Stretch or thin out values (M, ...) of M worlds to ``count`` worlds, in order."""
    return values[torch.arange(count, device=values.device) * len(values) // count]


def columns(num_rows: int, device: str, **widths: int) -> tuple[Tensor, dict[str, Tensor]]:
    """A float matrix of zeros, to clear all columns at once, and a view (N, width) of each named span of columns."""
    matrix = torch.zeros(num_rows, sum(widths.values()), device=device)
    return matrix, dict(zip(widths, matrix.split(list(widths.values()), dim=1), strict=True))
