"""The reward terms of walking by command: ``LeggedRobot`` inherits them. Rules as in ``robot_rewards``.

Sources: [P] MuJoCo Playground; [L] legged_gym; [U] unitree_rl_gym; [UL] unitree_rl_lab; [I] Isaac Lab's velocity tasks; [M] mjlab;
[H] holosoma; [W] walk-these-ways.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import ClassVar

import torch
from torch import Tensor

from legged_mw.envs.contacts import FootContacts
from legged_mw.envs.gait import GaitClock
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_rewards import RobotRewards, need, not_sensed
from legged_mw.sim.mirror import Partners
from legged_mw.sim.model import upright
from legged_mw.sim.sensors import CONTACT_FORCE
from legged_mw.utils.math import quat_rotate, yaw_of

PHASE_SIGMA = 0.01  # [m^2] of feet_phase: 0.1 m beside the wanted height leave a share of 1/e [P]


class LeggedRewards(RobotRewards):
    """Terms about commands, feet and the gait clock; F feet."""

    # what the terms read: LeggedRobot makes it
    cfg: LeggedRobotCfg
    num_feet: int
    root_quat: Tensor  # (N, 4)
    base_ang_vel: Tensor  # (N, 3) body frame [rad/s]
    commands: Tensor  # (N, C)
    moving: Tensor  # (N,) told to move
    default_dof_pos: Tensor  # (D,) [rad]
    foot_pos: Tensor  # (N, F, 3) [m, world]
    foot_height: Tensor  # (N, F) above the ground [m]
    foot_vel: Tensor  # (N, F, 3) world frame [m/s]
    foot_speed: Tensor  # (N, F) horizontal [m/s]
    foot_contact: Tensor  # (N, F) bool
    first_contact: Tensor  # (N, F) bool
    feet_air_time: Tensor  # (N, F) [s]
    swing_peak: Tensor  # (N, F) [m]
    gait: GaitClock | None
    feet: FootContacts

    SENSED_FOR: ClassVar[Mapping[str, str]] = {
        **RobotRewards.SENSED_FOR,
        **dict.fromkeys(("feet_contact_forces", "soft_landing", "stumble"), CONTACT_FORCE),
    }

    feet_contact_time: Tensor  # (N, F) since touch-down [s]; only with `single_stance` or `air_time_variance`
    last_air_time: Tensor  # (N, F) of the last swing that ended [s]; only with `air_time_variance`
    last_contact_time: Tensor  # (N, F) of the last stance that ended [s]; likewise
    last_foot_vel_z: Tensor  # (N, F) of the step before [m/s]; only with `feet_impact_vel`
    foot_bodies: Tensor  # (F,) index of each foot's body; only with `feet_orientation`
    foot_up: Tensor  # (F, 3) the vertical in each foot's frame, in the default pose; likewise
    neighbours: Tensor  # (2, pairs) feet to the left and to the right of each other; only with `feet_distance`

    foot_names: tuple[str, ...]
    _partners: Callable[[], Partners]

    tracking_sigma: Tensor | float  # () [m^2/s^2, rad^2/s^2]; a number where it stays, which takes an operation less

    def anneal(self, done: float) -> None:
        """A training is ``done`` so far, from 0 to 1: ``tracking_sigma`` on its way to ``rewards.tracking_sigma_end``."""
        super().anneal(done)
        begin, end = self.cfg.rewards.tracking_sigma, self.cfg.rewards.tracking_sigma_end
        if isinstance(self.tracking_sigma, Tensor):
            self.tracking_sigma.fill_(begin + (end - begin) * done)

    def _init_foot_rewards(self) -> None:
        """What terms need beside the state, where they are on."""
        sigma, changes = self.cfg.rewards.tracking_sigma, self.cfg.rewards.tracking_sigma_end > 0.0
        self.tracking_sigma = torch.tensor(sigma, device=self.device) if changes else sigma
        on = self._active_scales()
        if not {"feet_orientation", "feet_distance"} & on.keys():
            return
        stands = upright(self.robot, self.default_dof_pos.tolist(), self.foot_names)
        self.foot_up = torch.tensor(stands.up, dtype=torch.float, device=self.device)
        self.foot_bodies = torch.tensor(stands.bodies, dtype=torch.long, device=self.device)
        if "feet_distance" in on and self.num_feet > 1:
            other = [1, 0] if self.num_feet == 2 else self._partners().sites
            pairs = [(i, j) for i, j in enumerate(other) if stands.places[i, 1] > stands.places[j, 1]]
            self.neighbours = torch.tensor(pairs, dtype=torch.long, device=self.device).view(-1, 2).T.contiguous()

    def _columns_for_rewards(self) -> dict[str, int]:
        times = ["feet_contact_time", "last_air_time", "last_contact_time"]
        wanted = {"single_stance": times[:1], "air_time_variance": times, "feet_impact_vel": ["last_foot_vel_z"]}
        names = [name for term in self._active_scales() for name in wanted.get(term, [])]
        return {**super()._columns_for_rewards(), **dict.fromkeys(names, len(self.foot_names))}

    def _sensed_on_demand(self) -> list[str]:
        row = [CONTACT_FORCE] if self.cfg.observations.contact_forces else []
        return [*super()._sensed_on_demand(), *row]

    @property
    def contact_forces(self) -> Tensor:
        """(N, F, 3) Force of the ground on each foot in the last substep, world frame [N]; 0 in a world just reset."""
        if self.feet.forces is None:
            raise not_sensed("contact_forces")
        return self.feet.forces

    def _time_contacts(self) -> None:
        """How long feet stood and swung, where a term that is on reads it; ``feet_air_time`` has this step's already."""
        own = vars(self)
        if "last_air_time" in own:
            lifted = ~self.foot_contact & (self.feet_contact_time > 0.0)
            self.last_air_time.copy_(torch.where(self.first_contact, self.feet_air_time, self.last_air_time))
            self.last_contact_time.copy_(torch.where(lifted, self.feet_contact_time, self.last_contact_time))
        if "feet_contact_time" in own:
            self.feet_contact_time.add_(self.dt).masked_fill_(~self.foot_contact, 0.0)

    def _remember_for_rewards(self) -> None:
        super()._remember_for_rewards()
        if "last_foot_vel_z" in vars(self):
            self.last_foot_vel_z.copy_(self.foot_vel[..., 2])

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
        """Joints away from the default pose while the command is to stand [rad]. [L]"""
        return self.dof_offset.abs().sum(dim=1).masked_fill_(self.moving, 0.0)

    # ---- feet

    def _reward_feet_clearance(self) -> Tensor:
        """Feet that move fast away from the swing height [m^1.5/s^0.5]. [P]"""
        return ((self.foot_height - self.cfg.rewards.swing_height).abs() * self.foot_speed.sqrt()).sum(dim=1)

    def _reward_feet_height(self) -> Tensor:
        """At touch-down, how far the swing's peak was from the swing height, as a share of it. [P]"""
        error = (self.swing_peak / self.cfg.rewards.swing_height - 1.0).square()
        return (error * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_feet_slip(self) -> Tensor:
        """Squared horizontal speed of feet in contact, while moving [m^2/s^2]. [P]"""
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
        up = quat_rotate(
            self.sim.xquat.index_select(1, self.foot_bodies), self.foot_up.expand(len(self.foot_contact), -1, -1)
        )
        return up[..., :2].square().sum(dim=(1, 2))

    def _reward_air_time_variance(self) -> Tensor:
        """How unlike the feet's last swings were, and their last stances: variances of their times, up to 0.5 s each [s^2]. [I, UL -1]"""
        need(self.num_feet > 1, "air_time_variance", "asset.foot_names has one foot")
        swings, stances = (time.clamp(max=0.5).var(dim=1) for time in (self.last_air_time, self.last_contact_time))
        return swings + stances

    def _reward_feet_contact_without_cmd(self) -> Tensor:
        """How many feet are on the ground while told to stand. [UL]"""
        return self.foot_contact.sum(dim=1).float().masked_fill_(self.moving, 0.0)

    def _reward_feet_impact_vel(self) -> Tensor:
        """At touch-down, the square of how fast the foot sank a step before [m^2/s^2]. [W, which counts feet that stand too]"""
        return (self.last_foot_vel_z.clamp(max=0.0).square() * self.first_contact).sum(dim=1)

    # ---- forces on feet

    def _reward_feet_contact_forces(self) -> Tensor:
        """What the ground's forces on feet exceed ``rewards.max_contact_force`` by [N]. [L]"""
        return (self.contact_forces.norm(dim=2) - self.cfg.rewards.max_contact_force).clamp(min=0.0).sum(dim=1)

    def _reward_soft_landing(self) -> Tensor:
        """At touch-down, the ground's force on the foot [N], while moving. [M -1e-5]"""
        return (self.contact_forces.norm(dim=2) * (self.first_contact & self.moving[:, None])).sum(dim=1)

    def _reward_stumble(self) -> Tensor:
        """1 where a foot hits something upright: a horizontal force of more than five times the vertical one. [L]"""
        forces = self.contact_forces
        return (forces[..., :2].norm(dim=2) > 5.0 * forces[..., 2].abs()).any(dim=1).float()

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
