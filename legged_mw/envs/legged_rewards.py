"""The reward terms of walking by command: ``LeggedRobot`` inherits them. Rules as in ``robot_rewards``.

Sources: [P] MuJoCo Playground; [L] legged_gym; [U] unitree_rl_gym; [I] Isaac Lab's velocity tasks; [H] holosoma.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from legged_mw.envs.gait import GaitClock
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_rewards import RobotRewards, need
from legged_mw.sim.mirror import Partners
from legged_mw.sim.pose import upright
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.math import quat_rotate, yaw_of

PHASE_SIGMA = 0.01  # [m^2] of feet_phase: 0.1 m beside the wanted height leave a share of 1/e [P]


class LeggedRewards(RobotRewards):
    """Terms about commands, feet and the gait clock; F feet."""

    # what the terms read: LeggedRobot makes it
    cfg: LeggedRobotCfg
    sim: Simulation
    num_feet: int
    root_quat: Tensor  # (N, 4)
    base_ang_vel: Tensor  # (N, 3) body frame [rad/s]
    commands: Tensor  # (N, C)
    moving: Tensor  # (N,) told to move
    default_dof_pos: Tensor  # (D,) [rad]
    foot_pos: Tensor  # (N, F, 3) [m, world]
    foot_height: Tensor  # (N, F) above the ground [m]
    foot_speed: Tensor  # (N, F) horizontal [m/s]
    foot_contact: Tensor  # (N, F) bool
    first_contact: Tensor  # (N, F) bool
    feet_air_time: Tensor  # (N, F) [s]
    swing_peak: Tensor  # (N, F) [m]
    gait: GaitClock | None

    feet_contact_time: Tensor  # (N, F) since touch-down [s]; only with `single_stance`
    foot_bodies: Tensor  # (F,) index of each foot's body; only with `feet_orientation`
    foot_up: Tensor  # (F, 3) the vertical in each foot's frame, in the default pose; likewise
    neighbours: Tensor  # (2, pairs) feet to the left and to the right of each other; only with `feet_distance`

    foot_names: tuple[str, ...]
    _partners: Callable[[], Partners]
    _times_contacts: bool  # `single_stance` is on

    tracking_sigma: Tensor  # () [m^2/s^2, rad^2/s^2]

    def anneal(self, done: float) -> None:
        """A training is ``done`` so far, from 0 to 1: ``tracking_sigma`` on its way to ``rewards.tracking_sigma_end``."""
        begin, end = self.cfg.rewards.tracking_sigma, self.cfg.rewards.tracking_sigma_end
        self.tracking_sigma.fill_(begin + (end - begin) * done if end else begin)

    def _init_foot_rewards(self) -> None:
        """What terms need beside the state, where they are on."""
        self.tracking_sigma = torch.tensor(self.cfg.rewards.tracking_sigma, device=self.device)
        on = self._active_scales()
        self._times_contacts = "single_stance" in on
        if not {"feet_orientation", "feet_distance"} & on.keys():
            return
        stands = upright(self.robot, self.default_dof_pos.tolist(), self.foot_names)
        self.foot_up = torch.tensor(stands.up, dtype=torch.float, device=self.device)
        self.foot_bodies = torch.tensor(stands.bodies, dtype=torch.long, device=self.device)
        if "feet_distance" in on and self.num_feet > 1:
            other = [1, 0] if self.num_feet == 2 else self._partners().sites
            pairs = [(i, j) for i, j in enumerate(other) if stands.places[i, 1] > stands.places[j, 1]]
            self.neighbours = torch.tensor(pairs, dtype=torch.long, device=self.device).view(-1, 2).T.contiguous()

    def _foot_reward_columns(self) -> dict[str, int]:
        """What an episode remembers for terms that are on."""
        return {"feet_contact_time": len(self.foot_names)} if "single_stance" in self._active_scales() else {}

    # ---- commands

    def _reward_tracking_lin_vel(self) -> Tensor:
        """Velocity in the plane at the IMU, body frame, as commanded. [L]"""
        error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1)
        return torch.exp(error / -self.tracking_sigma)

    def _reward_tracking_ang_vel(self) -> Tensor:
        """Yaw rate as commanded. [L]"""
        error = (self.commands[:, 2] - self.base_ang_vel[:, 2]).square()
        return torch.exp(error / -self.tracking_sigma)

    def _reward_stand_still(self) -> Tensor:
        """Joints away from the default pose while the command is to stand. [L]"""
        return self.dof_offset.abs().sum(dim=1).masked_fill_(self.moving, 0.0)

    # ---- feet

    def _reward_feet_clearance(self) -> Tensor:
        """Feet that move fast away from the swing height. [P]"""
        return ((self.foot_height - self.cfg.rewards.swing_height).abs() * self.foot_speed.sqrt()).sum(dim=1)

    def _reward_feet_height(self) -> Tensor:
        """At touch-down, how far the swing's peak was from the swing height, as a share of it. [P]"""
        error = (self.swing_peak / self.cfg.rewards.swing_height - 1.0).square()
        return (error * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_slip(self) -> Tensor:
        """Squared horizontal speed of feet in contact, while moving. [P]"""
        return (self.foot_speed.square() * (self.foot_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_air_time(self) -> Tensor:
        """At touch-down, how much longer than the minimum the foot was in the air [s], while moving. [L, P]"""
        excess = self.feet_air_time - self.cfg.rewards.min_air_time
        return (excess * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_distance(self) -> Tensor:
        """How much nearer than ``rewards.min_feet_distance`` left and right feet are sideways, in the base's heading [m]. [P, H]

        Feet that cross are nearer than 0. Of more than two feet it is the sum over mirrored pairs.
        """
        need(self.num_feet > 1, "feet_distance", "asset.foot_names has one foot, which has no neighbour")
        yaw, (left, right) = yaw_of(self.root_quat)[:, None], self.neighbours
        apart = self.foot_pos.index_select(1, left) - self.foot_pos.index_select(1, right)
        sideways = torch.cos(yaw) * apart[..., 1] - torch.sin(yaw) * apart[..., 0]
        return (self.cfg.rewards.min_feet_distance - sideways).clamp(min=0.0).sum(dim=1)

    def _reward_feet_orientation(self) -> Tensor:
        """Sum over feet of the squared sine of their tilt; a foot is flat as it is in the default pose. [H -5]"""
        up = quat_rotate(self.sim.xquat.index_select(1, self.foot_bodies), self.foot_up.expand(len(self.foot_contact), -1, -1))
        return up[..., :2].square().sum(dim=(1, 2))

    # ---- two legs

    def _reward_single_stance(self) -> Tensor:
        """Biped: how long it has stood on exactly one foot [s], up to ``rewards.max_single_stance``, while moving. [I]

        The lesser of the standing foot's contact time and the other one's air time, so that short steps earn little.
        """
        self._need_two_feet("single_stance")
        since = torch.where(self.foot_contact, self.feet_contact_time, self.feet_air_time).amin(dim=1)
        return torch.where(self._on_one_foot() & self.moving, since.clamp(max=self.cfg.rewards.max_single_stance), 0.0)

    def _reward_no_fly(self) -> Tensor:
        """Biped: 1 on exactly one foot while moving, and on both while told to stand; else 0. [L: Cassie; standing ours]"""
        self._need_two_feet("no_fly")
        return torch.where(self.moving, self._on_one_foot(), self.foot_contact.all(dim=1)).float()

    def _on_one_foot(self) -> Tensor:
        return self.foot_contact.sum(dim=1) == 1

    def _need_two_feet(self, term: str) -> None:
        need(self.num_feet == 2, term, f"it is for robots with two feet; asset.foot_names has {self.num_feet}")

    # ---- the gait clock

    def _clock(self, term: str) -> GaitClock:
        need(self.gait is not None, term, "there is no gait clock; set gait.period [s]")
        assert self.gait
        return self.gait

    def _reward_feet_phase(self) -> Tensor:
        """From 0 to 1: feet as high as the clock wants, ``rewards.swing_height`` in mid swing and 0 in stance. [P, H 5]"""
        swing = self._clock("feet_phase").swing()
        rise = 1.0 - (2.0 * swing - 1.0).abs()  # up to 1 in mid swing, and back
        wanted = self.cfg.rewards.swing_height * rise.square() * (3.0 - 2.0 * rise)  # a cubic, level at both ends [P]
        return torch.exp((self.foot_height - wanted).square().sum(dim=1) / -PHASE_SIGMA)

    def _reward_contact_phase(self) -> Tensor:
        """Share of the feet that stand or swing as the clock wants. [U 0.18]"""
        return (self.foot_contact == self._clock("contact_phase").wants_contact()).float().mean(dim=1)
