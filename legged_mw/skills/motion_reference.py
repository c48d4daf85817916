"""Reference clips as fixed tensors: the current frame of each world, and the start of new episodes.

Shapes: N worlds, B bodies, M frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from legged_mw.skills.clip import Clip, read_clip
from legged_mw.skills.kinematics import Bodies, Kinematics, product, rotate
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg
from legged_mw.utils.files import find_file


class Reference:
    """Concatenated clips, each with its last frame held. ``frame`` is each world's target in the next step."""

    written = ("frame", "failures", "_row", "wanted_pos", "wanted_rot")

    def __init__(
        self, clips: Sequence[Clip], kinematics: Kinematics, num_envs: int, device: str, *, held: int, bin_frames: int
    ) -> None:
        """A clip's last frame is held for ``held`` frames. Bins for new episodes have about ``bin_frames`` frames."""

        def places(values: Sequence[int]) -> Tensor:
            return torch.tensor(list(values), dtype=torch.long, device=device)

        tables, last, bins, bin_of = [], [], [], []
        for clip in clips:
            start, count = len(last), len(clip.root_pos)
            states = clip.qpos(), clip.qvel()
            qpos, qvel = (torch.tensor(values, dtype=torch.float, device=device) for values in states)
            still = torch.cat([qpos[-1:], torch.zeros_like(qvel[-1:])], dim=1).expand(held, -1)
            state = torch.cat([torch.cat([qpos, qvel], dim=1), still])
            bodies = kinematics(*state.split([qpos.shape[1], qvel.shape[1]], dim=1))
            tables.append(torch.cat([state, *(part.flatten(1) for part in bodies)], dim=1))
            parts = max(1, round((count - 1) / bin_frames))
            edges = [start + (count - 1) * i // parts for i in range(parts + 1)]
            bin_of += [len(bins) + min(i * parts // (count - 1), parts - 1) for i in range(count)]
            bin_of += [len(bins) + parts - 1] * held
            bins += [(low, high - low) for low, high in zip(edges, edges[1:], strict=False)]
            last += [start + count - 1 + held] * (count + held)
        self._table = torch.cat(tables)  # (M, W)
        self._last, self._bin_of, self._bins = places(last), places(bin_of), torch.tensor(bins, device=device)
        self.frame = torch.zeros(num_envs, dtype=torch.long, device=device)  # (N,)
        self.failures = torch.zeros(len(bins), device=device)  # moving average: share of worlds that fall there
        self._row = torch.zeros(num_envs, self._table.shape[1], device=device)
        widths = [qpos.shape[1], qvel.shape[1], *(part[0].numel() for part in bodies)]
        self.qpos, self.qvel, *parts = self._row.split(widths, dim=1)
        self.joint_pos, self.joint_vel = self.qpos[:, 7:], self.qvel[:, 6:]
        self.bodies = Bodies(*(part.unflatten(1, shape.shape[1:]) for part, shape in zip(parts, bodies, strict=True)))
        self.wanted_pos, self.wanted_rot = torch.zeros_like(self.bodies.pos), torch.zeros_like(self.bodies.rot)

    def read(self) -> None:
        """Read the current frames of the worlds from the table."""
        torch.index_select(self._table, 0, self.frame, out=self._row)

    def align(self, body: Bodies, anchor: int) -> None:
        """Move the frames' bodies to a robot's ``anchor``: to its x, y and heading, with the clip's height."""
        ours, theirs = body.rot[:, anchor], self.bodies.rot[:, anchor]
        cos, sin = (ours[:, :2] * theirs[:, :1]).sum(dim=2).unbind(dim=1)  # of the yaw between both
        size = torch.hypot(cos, sin).clamp(min=1e-6)
        cos, sin, zero = cos / size, sin / size, torch.zeros_like(cos)
        turn = torch.stack([cos, -sin, zero, sin, cos, zero, zero, zero, zero + 1.0], dim=1).unflatten(1, (1, 3, 3))
        middle = self.bodies.pos[:, anchor, None]
        torch.add(rotate(turn, self.bodies.pos - middle), middle, out=self.wanted_pos)
        self.wanted_pos[..., :2] += body.pos[:, anchor, None, :2] - middle[..., :2]
        self.wanted_rot.copy_(product(turn, self.bodies.rot))

    def advance(self) -> None:
        """Go to the next frame, except at the last one."""
        self.frame.copy_(torch.minimum(self.frame + 1, self._last.index_select(0, self.frame)))

    def over(self) -> Tensor:
        """(N,) True at the last frame, after the held ones."""
        return self.frame >= self._last.index_select(0, self.frame)

    def remember_failures(self, fell: Tensor, rate: float) -> None:
        """Update the moving average of failures in each bin with the worlds that ``fell`` (N,). [BeyondMimic]"""
        count = torch.zeros_like(self.failures).scatter_add_(0, self._bin_of.index_select(0, self.frame), fell.float())
        self.failures.lerp_(count / len(fell), rate)

    def draw(self, uniform: float) -> Tensor:
        """(N,) Start frames. Bins are drawn by failures, or uniformly with probability ``uniform``. [BeyondMimic]"""
        chance = torch.rand(2, len(self.frame), device=self.frame.device)
        weights = self.failures / self.failures.sum().clamp(min=1e-9) * (1.0 - uniform) + uniform / len(self.failures)
        weights = weights.cumsum(0)
        which = torch.searchsorted(weights, chance[0] * weights[-1], right=True).clamp(max=len(weights) - 1)
        first, count = self._bins.index_select(0, which).unbind(dim=1)
        return first + torch.minimum((chance[1] * count).long(), count - 1)

    def begin(self, mask: Tensor, start: Tensor | None) -> tuple[Tensor, Tensor]:
        """Begin at frames ``start`` (N,) where ``mask`` (N,) is true; None: at the first frame of the first clip.

        Returns the states at ``start``: qpos (N, nq), qvel (N, nv). The target is the next frame.
        """
        start = torch.zeros_like(self.frame) if start is None else start
        self.frame.copy_(torch.where(mask, start + 1, self.frame))
        widths = [self.qpos.shape[1], self.qvel.shape[1]]
        qpos, qvel = self._table[:, : sum(widths)].index_select(0, start).split(widths, dim=1)
        return qpos, qvel


def load_clips(cfg: MotionTrackingCfg, joints: Sequence[str], rate: float) -> list[Clip]:
    """The clips ``motion.clips`` with these ``joints``, at ``rate`` frames per second."""
    files = [find_file(cfg, "motion.clips", name) for name in cfg.motion.clips]
    return [read_clip(file).at(rate).of(joints, file.name) for file in files]


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """(...,) [rad] angle between rotations (..., 3, 3): their difference has the norm sqrt(8) sin(angle / 2)."""
    return 2.0 * torch.asin(((a - b).square().sum(dim=(-1, -2)) / 8.0).clamp(max=1.0).sqrt())
