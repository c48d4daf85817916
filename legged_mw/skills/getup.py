"""Get up: from any fall to standing in the default pose, and staying there. The class, its config and its learner's.

Sources: [P] MuJoCo Playground's Go1 getup (commit d5e6b47); [H] HoST (OpenRobotLab), a G1; [ours] with the reason.
"""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.envs.observations import Row
from legged_mw.skills.falls import Falls, FallsCfg
from legged_mw.skills.skill_config import SkillCfgPPO
from legged_mw.utils.bounds import Seconds

# cosine of the tilt (15 degrees), share of the standing height: it is up [ours: servos alone hold 0.92]
UP_TILT, UP_HEIGHT = 0.966, 0.9


class GetupCfg(FallsCfg):
    class env(FallsCfg.env):
        episode_length_s = 6.0  # [s] [P]

    class asset(FallsCfg.asset):
        self_collisions = True  # and all colliders touch the ground [P]

    class control(FallsCfg.control):
        # [P, H: about the default pose noise turns no robot over; docs/skills.md], [rad] [P]
        action_origin, action_scale = "joints", 0.5

    class termination(FallsCfg.termination):
        max_tilt = 180.0  # [deg]: no attitude ends an episode [P, H]

    class domain_rand(FallsCfg.domain_rand):
        # [kg] [H -2 to 5], [m], [-] [H 0.1 to 1]
        base_mass, base_com, friction = [-1.0, 3.0], [-0.03, 0.03], [0.25, 1.2]
        stiffness, damping, strength = [0.9, 1.1], [0.9, 1.1], [0.9, 1.1]  # [H 0.85 to 1.15]
        slope = [0.0, 12.0]  # [deg] [ours: the exam asks 10]

    class exam:
        within: Seconds = 3.0  # [s] in which it must stand

    class rewards(FallsCfg.rewards):
        # [ours, P True: nothing ends an episode, and while it thrashes all would be clipped]
        only_positive_rewards = False

        class scales(FallsCfg.rewards.scales):  # [P], with our terms of the same meaning
            upright, height, posture, stand_still = 1.0, 1.0, 1.0, 1.0
            action_rate, action_smoothness, torques, dof_acc, dof_pos_limits = -0.005, -0.001, -1e-5, -1e-8, -0.1
            # [ours, P -0.1 and dof_acc -2.5e-7: at first the noise would cost ten times what it gains]
            fast_joints = -0.0003


class GetupCfgPPO(SkillCfgPPO):
    class actor(SkillCfgPPO.actor):
        class distribution_cfg(SkillCfgPPO.actor.distribution_cfg):
            # [ours: those that stand want less noise, before the others have found how to turn over]
            init_std, std_range = 1.0, [0.2, 1e6]

    class algorithm(SkillCfgPPO.algorithm):
        gamma = 0.98  # [P 0.97]


class Getup(Falls):
    cfg: GetupCfg
    exam = "getup"

    def _init_buffers(self) -> None:
        super()._init_buffers()
        self.up_height = 0.99 * self.start_place[2]  # [m] of the root, standing [P: 0.275 of 0.278]
        self.upright = self.buffer()  # (N,) cosine of the tilt

    def _refresh_base(self) -> None:
        super()._refresh_base()
        torch.neg(self.projected_gravity[:, 2], out=self.upright)
        self.up.copy_((self.upright > UP_TILT) & (self.base_height > UP_HEIGHT * self.up_height))

    def _body_rows(self) -> list[Row]:
        # above the ground [m] [P]
        return [*super()._body_rows(), Row("base_height", self.base_height[:, None], mirror="scalar")]

    def _near_upright(self) -> Tensor:
        return torch.exp(-4.0 * (1.0 - self.upright))  # exp(-2 |g + z|^2) of unit vectors [P]

    def _reward_upright(self) -> Tensor:
        """How upright it is. [P: the second half alone, which is nothing from its side on; ours: the other is even over all angles]"""
        return 0.5 - torch.acos(self.upright.clamp(-1.0, 1.0)) / (2.0 * torch.pi) + 0.5 * self._near_upright()

    def _reward_height(self) -> Tensor:
        """Height of the root, a share of standing, less the less upright. [P: exp(height) - 1; ours: none for standing on its back]"""
        return (self.base_height / self.up_height).clamp(0.0, 1.0) * (0.5 + 0.5 * self.upright)

    def _reward_posture(self) -> Tensor:
        """The default pose, as far as it is upright. [P: exp(-0.5 x sum), which is flat where the legs are folded; ours: by the mean]"""
        return self._near_upright() * torch.exp(-2.0 * (self.dof_offset.square() * self.pose_weights).mean(dim=1))

    def _reward_stand_still(self) -> Tensor:
        """Joints at rest, the more it is up. [P: small actions, and all or nothing; ours: what the exam asks]"""
        high = ((self.base_height / self.up_height - 0.6) / 0.3).clamp(0.0, 1.0)
        return self._near_upright() * high * torch.exp(-0.5 * self.dof_vel.square().mean(dim=1))
