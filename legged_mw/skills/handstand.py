"""Handstand and footstand: from standing on all legs to two of them, and staying there. The class, its config and its learner's.

Source [P]: MuJoCo Playground's Go1 handstand and footstand (commit d5e6b47); [ours] with the reason. Which legs may touch the ground:
the paper penalises those in the air, the code since a047305 any foot. As in the paper, here the legs that carry the robot are free to.
"""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.envs.robot_task import RobotTask
from legged_mw.skills.skill_config import SkillCfg, SkillCfgPPO
from legged_mw.utils.bounds import Names, Positive, Sign
from legged_mw.utils.config import ConfigError, fit
from legged_mw.utils.errors import unknown


class HandstandCfg(SkillCfg):
    class env(SkillCfg.env):
        episode_length_s = 10.0  # [s] [P]

    class exam:
        """What is asked, of the reward and in the exam."""

        nose: Sign = -1.0  # -1 down, a handstand; 1 up, a footstand
        height: Positive = 0.55  # [m] of the root that is high enough [P]
        hands: list[str] = []  # geoms that stand: nothing else may touch the ground

    class control(SkillCfg.control):
        # [rad] [ours, of the default pose; P 0.3 of the last targets, and no row says where they are]
        action_scale = 0.5

    class normalization(SkillCfg.normalization):
        clip_actions = 4.0  # [ours: the thighs turn by 1.6 rad]

    class termination(SkillCfg.termination):
        max_tilt = 104.5  # [deg]: the trunk's z axis 0.25 below the horizon [P]

    class domain_rand(SkillCfg.domain_rand):
        base_mass, base_com, friction = [-0.5, 1.5], [-0.02, 0.02], [0.3, 1.2]  # [kg], [m], [-]

    class rewards(SkillCfg.rewards):
        soft_dof_pos_limit = 0.9  # [P]

        # [P]; what it calls pose and contact is here joint_deviation, of angles, and collision
        class scales(SkillCfg.rewards.scales):
            stand_height, stand_attitude = 1.0, 1.0
            collision, dof_pos_limits, joint_deviation = -0.1, -0.5, -0.1
            # [P in its fine-tuning 0, -0.003, -2.5e-7: as much as it gains, at first]
            action_rate, energy, dof_acc = -0.002, -1e-4, -1e-8


class HandstandCfgPPO(SkillCfgPPO):
    class actor(SkillCfgPPO.actor):
        class distribution_cfg(SkillCfgPPO.actor.distribution_cfg):
            init_std, std_range = 0.8, [0.15, 1e6]  # [ours]


class Handstand(RobotTask):
    cfg: HandstandCfg
    exam = "handstand"

    def _init_buffers(self) -> None:
        super()._init_buffers()
        fit(self.cfg.exam.hands, Names, "exam.hands")
        geoms = [self.robot.physics.geom(i).name for i in range(self.robot.physics.ngeom)]
        if wrong := [name for name in self.cfg.exam.hands if name not in geoms]:
            raise ConfigError(f"exam.hands: {unknown('geom', wrong[0], geoms, self.cfg.asset.file)}")

    def _reward_stand_height(self) -> Tensor:
        """Height of the root up to ``exam.height``, exponential in metres. [P]"""
        return torch.exp(self.base_height.clamp(max=self.cfg.exam.height) - self.cfg.exam.height)

    def _reward_stand_attitude(self) -> Tensor:
        """The root's x axis points down, or up: 1; level: a quarter; the other way: 0. [P]"""
        return (0.5 - 0.5 * self.cfg.exam.nose * self.projected_gravity[:, 0]).square()
