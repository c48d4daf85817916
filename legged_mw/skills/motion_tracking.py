"""A robot tracks reference clips. Read the class from top to bottom. The rules of ``robot_task`` also hold here.

The method is BeyondMimic's [B] (arXiv 2508.08241), as in its code and in mjlab's [M]. Bodies are compared relative to
the anchor: the reference is moved to the anchor's x, y and heading. Shapes: N worlds, D joints, B bodies, M frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from legged_mw.envs.mirror import Block, body_blocks
from legged_mw.envs.observations import Row
from legged_mw.envs.robot_task import RobotTask
from legged_mw.skills.clip import Clip, read_clip
from legged_mw.skills.kinematics import Bodies, Kinematics, product, rotate
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg
from legged_mw.utils.files import find_file
from legged_mw.utils.math import assign


class MotionTracking(RobotTask):
    """N robots, each of which tracks a clip from a drawn frame to the end."""

    cfg: MotionTrackingCfg
    exam = "tracking"

    # ---- the step ---------------------------------------------------------------------------------------------------

    def _refresh_base(self) -> None:
        super()._refresh_base()
        for buffer, value in zip(self.body, self.kinematics(self.sim.qpos, self.sim.qvel), strict=True):
            buffer.copy_(value)

    def _update_state(self) -> None:
        super()._update_state()
        self.reference.align(self.body, self.anchor)

    def _end_step(self) -> None:
        super()._end_step()
        self.reference.remember_failures(self.fell, self.cfg.motion.failure_rate)
        self.reference.advance()

    def _fallen(self) -> Tensor:
        """(N,) True after a fall, or far from the reference in height or tilt."""
        end, ours, theirs = self.cfg.termination, self.body, self.reference.bodies
        down = super()._fallen()
        down |= (ours.pos[:, self.anchor, 2] - theirs.pos[:, self.anchor, 2]).abs() > end.max_anchor_height
        down |= (ours.rot[:, self.anchor, 2, 2] - theirs.rot[:, self.anchor, 2, 2]).abs() > end.max_anchor_tilt
        off = (ours.pos - self.reference.wanted_pos).index_select(1, self.ends)[..., 2].abs()
        down |= (off > end.max_end_height).any(dim=1)
        return down

    def _timed_out(self) -> Tensor:
        """(N,) True at the time limit, or at the end of the clip."""
        return super()._timed_out() | self.reference.over()

    def _reset_robots(self, mask: Tensor) -> None:
        """Set robots near the reference, at a frame drawn by past failures."""
        motion = self.cfg.motion
        qpos, qvel = self.reference.begin(mask, self.reference.draw(motion.uniform) if motion.random_start else None)
        off = torch.rand(self.num_envs, len(self.start_range), device=self.device).mul_(2.0).sub_(1.0)
        off.mul_(self.start_range)
        place, turn, speed, bend = off.split([3, 3, 6, self.num_actions], dim=1)
        attitude = quat_multiply(rotation_quat(turn), qpos[:, 3:7])
        joints = (qpos[:, 7:] + bend).clamp(self.soft_lower, self.soft_upper)
        assign(self.sim.qpos, mask, torch.cat([qpos[:, :3] + place, attitude, joints], dim=1))
        assign(self.sim.qvel, mask, torch.cat([qvel[:, :6] + speed, qvel[:, 6:]], dim=1))
        self.actuators.reset(mask)
        self.observations.restart(mask)

    # ---- observations -----------------------------------------------------------------------------------------------

    def compute_observations(self) -> None:
        self.reference.read()
        place, turn = self._anchor_seen()
        theirs, seen = self.reference.bodies, turn.transpose(1, 2)
        self.anchor_pos.copy_(rotate(seen, theirs.pos[:, self.anchor] - place))
        self.anchor_ori.copy_(product(seen, theirs.rot[:, self.anchor])[..., :2].flatten(1))
        ours = self.body.rot[:, self.anchor].transpose(1, 2)
        self.body_pos.copy_(rotate(ours[:, None], self.body.pos - self.body.pos[:, self.anchor, None]).flatten(1))
        self.body_ori.copy_(product(ours[:, None], self.body.rot)[..., :2].flatten(1))
        super().compute_observations()

    def _anchor_seen(self) -> tuple[Tensor, Tensor]:
        """Position (N, 3) [m] and attitude (N, 3, 3) of the anchor from the encoders, which may have offsets."""
        if self.actuators.encoder_offset is None:
            return self.body.pos[:, self.anchor], self.body.rot[:, self.anchor]
        joints = self.dof_pos + self.actuators.encoder_offset
        seen = self.anchor_kinematics(torch.cat([self.sim.qpos[:, :7], joints], dim=1), self.sim.qvel)
        return seen.pos[:, 0], seen.rot[:, 0]

    def observation_rows(self) -> dict[str, list[Row | str]]:
        noise = self.cfg.noise.scales
        # [rad], [rad/s]
        angles = {"reference_joint_pos": self.reference.joint_pos, "reference_joint_vel": self.reference.joint_vel}
        clip = [Row(name, value, mirror="joint") for name, value in angles.items()]
        # the reference's anchor relative to the robot's: position [m], two columns of its rotation
        anchors = [
            Row("anchor_pos", self.anchor_pos, mirror="polar"),
            Row("anchor_ori", self.anchor_ori, mirror="turn"),
        ]
        levels = noise.anchor_pos, noise.anchor_ori
        seen = [row._replace(noise=level, measured=True) for row, level in zip(anchors, levels, strict=True)]
        return {
            "state": [*clip, *seen, *(row for row in self._measured_rows() if row.name != "projected_gravity")],
            "privileged_state": [
                *clip,
                *anchors,
                Row("body_pos", self.body_pos, mirror="body_polar"),  # of each body, anchor frame [m]
                Row("body_ori", self.body_ori, mirror="body_turn"),  # two columns of each body's rotation
                *self._body_rows(),
                Row("last_actions", self.last_actions, mirror="action"),
                *self._disturbance_rows(),
            ],
        }

    def _mirror_blocks(self) -> dict[str, Block]:
        return super()._mirror_blocks() | body_blocks(self.robot, self._partners(), self.cfg.motion.bodies)

    # ---- rewards ----------------------------------------------------------------------------------------------------

    def _near(self, squares: Tensor, sigma: float) -> Tensor:
        """(N,) exp(-mean of ``squares`` (N, bodies) / sigma^2)."""
        return torch.exp(-squares.mean(dim=1) / sigma**2)

    def _reward_tracking_anchor_pos(self) -> Tensor:
        """The anchor's place in the world. [B]"""
        off = self.body.pos - self.reference.bodies.pos
        return self._near(off[:, self.anchor, None].square().sum(dim=2), self.cfg.rewards.anchor_pos_sigma)

    def _reward_tracking_anchor_ori(self) -> Tensor:
        """The anchor's attitude in the world. [B]"""
        off = angle_between(self.body.rot[:, self.anchor, None], self.reference.bodies.rot[:, self.anchor, None])
        return self._near(off.square(), self.cfg.rewards.anchor_ori_sigma)

    def _reward_tracking_body_pos(self) -> Tensor:
        """The bodies' places, at the anchor. [B]"""
        off = self.body.pos - self.reference.wanted_pos
        return self._near(off.square().sum(dim=2), self.cfg.rewards.body_pos_sigma)

    def _reward_tracking_body_ori(self) -> Tensor:
        """The bodies' attitudes, at the anchor. [B]"""
        off = angle_between(self.body.rot, self.reference.wanted_rot)
        return self._near(off.square(), self.cfg.rewards.body_ori_sigma)

    def _reward_tracking_body_lin_vel(self) -> Tensor:
        """The bodies' velocities, world frame. [B]"""
        off = self.body.lin_vel - self.reference.bodies.lin_vel
        return self._near(off.square().sum(dim=2), self.cfg.rewards.body_lin_vel_sigma)

    def _reward_tracking_body_ang_vel(self) -> Tensor:
        """The bodies' angular velocities, world frame. [B]"""
        off = self.body.ang_vel - self.reference.bodies.ang_vel
        return self._near(off.square().sum(dim=2), self.cfg.rewards.body_ang_vel_sigma)

    def _live_statistics(self) -> dict[str, Tensor]:
        """Mean distance of the bodies from the reference, relative to the anchor [mm], without worlds just reset."""
        off = (self.body.pos - self.reference.wanted_pos).norm(dim=2).mean(dim=1) * 1000.0
        goes_on = ~self.reset_buf  # ``wanted_pos`` of the others is of the episode that ended
        mean = torch.stack([torch.where(goes_on, off, 0.0).sum(), goes_on.sum(dtype=off.dtype)])
        return super()._live_statistics() | {"body_error_mm": mean}

    # ---- checkpoint, buffers ----------------------------------------------------------------------------------------

    def training_state(self) -> dict[str, Tensor]:
        return {**super().training_state(), "motion_failures": self.reference.failures.clone()}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        """Load ``training_state`` and start new episodes, unless the clips have changed."""
        super().load_training_state(state)
        if "motion_failures" in state and state["motion_failures"].shape == self.reference.failures.shape:
            self.reference.failures.copy_(state["motion_failures"])
            self._reset_all()

    def _init_buffers(self) -> None:
        super()._init_buffers()
        motion = self.cfg.motion
        self.anchor = motion.bodies.index(motion.anchor)
        ends = [motion.bodies.index(name) for name in motion.end_bodies]
        self.ends = torch.tensor(ends, dtype=torch.long, device=self.device)
        bodies = [self.robot.id("body", name) for name in motion.bodies]
        self.kinematics = Kinematics(self.robot.physics, bodies, self.device)
        self.anchor_kinematics = Kinematics(self.robot.physics, [bodies[self.anchor]], self.device)
        files = [find_file(self.cfg, "motion.clips", name) for name in motion.clips]
        self.clips = [read_clip(file).at(1.0 / self.dt).of(self.robot.joint_names, file.name) for file in files]
        frames = {"held": round(motion.hold_s / self.dt), "bin_frames": max(1, round(motion.bin_s / self.dt))}
        self.reference = self.remember(Reference(self.clips, self.kinematics, self.num_envs, self.device, **frames))
        ranges = [*motion.start_pos, *motion.start_turn, *motion.start_lin_vel, *motion.start_ang_vel]
        self.start_range = self._tensor(ranges + [motion.start_joints] * self.num_actions)
        self.body = self.remember(Bodies(*(torch.zeros_like(part) for part in self.reference.bodies)))
        self.anchor_pos, self.anchor_ori = self.buffer(3), self.buffer(6)
        self.body_pos, self.body_ori = self.buffer(3 * len(bodies)), self.buffer(6 * len(bodies))


class Reference:
    """The clips one after the other in fixed tensors, each with its last frame held.

    ``frame`` is each world's target in the next step.
    """

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


def quat_multiply(a: Tensor, b: Tensor) -> Tensor:
    """The product of attitudes (..., 4): rotation ``b``, then ``a``."""
    w, u, s, v = a[..., :1], a[..., 1:], b[..., :1], b[..., 1:]
    return torch.cat([w * s - (u * v).sum(dim=-1, keepdim=True), w * v + s * u + torch.linalg.cross(u, v)], dim=-1)


def rotation_quat(v: Tensor) -> Tensor:
    """The attitude (..., 4) rotated about ``v`` (..., 3) by its length [rad]."""
    half = v.norm(dim=-1, keepdim=True) / 2.0
    return torch.cat([torch.cos(half), v * (0.5 * torch.sinc(half / torch.pi))], dim=-1)


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """(...,) [rad] angle between rotations (..., 3, 3): their difference has the norm sqrt(8) sin(angle / 2)."""
    return 2.0 * torch.asin(((a - b).square().sum(dim=(-1, -2)) / 8.0).clamp(max=1.0).sqrt())
