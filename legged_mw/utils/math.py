"""Batched rotations and masked writes, free of host reads. Quaternions are (w, x, y, z), unit, body to world."""

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


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """The attitude (..., 4) that turns by ``b`` first, then by ``a``."""
    w, u, s, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return torch.cat([w * s - (u * v).sum(dim=-1, keepdim=True), w * v + s * u + torch.linalg.cross(u, v)], dim=-1)


def rotation_quat(v: Tensor) -> Tensor:
    """The attitude (..., 4) that turns about ``v`` (..., 3) by its length [rad]."""
    half = v.norm(dim=-1, keepdim=True) / 2.0
    return torch.cat([torch.cos(half), v * (0.5 * torch.sinc(half / torch.pi))], dim=-1)


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
    """False if ``mask`` is true nowhere. A GPU is not asked, nor is anything of a step that is traced: there the answer is True."""
    return mask.device.type != "cpu" or tracing() or bool(mask.any())


def spread(values: Tensor, count: int) -> Tensor:
    """Values (M, ...) of M worlds for ``count`` worlds, each that of the nearest."""
    return values[torch.arange(count, device=values.device) * len(values) // count]


def columns(num_rows: int, device: str, **widths: int) -> tuple[Tensor, dict[str, Tensor]]:
    """One float matrix of zeros and a named view (N, width) of each span of its columns: cleared together, used apart."""
    matrix = torch.zeros(num_rows, sum(widths.values()), device=device)
    return matrix, dict(zip(widths, matrix.split(list(widths.values()), dim=1), strict=True))
