"""Handstand and footstand: rise from four legs to two and stay. It has the task, its config and the learner's config.

Source [P]: MuJoCo Playground's Go1 handstand and footstand (commit d5e6b47); [ours] with the reason. The paper
penalises ground contacts of the legs in the air, Playground's code since a047305 those of any foot. Here it is as in
the paper.
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
        """The target of the reward and of the exam."""

        nose: Sign = -1.0  # -1 down, a handstand; 1 up, a footstand
        height: Positive = 0.55  # [m] of the root that suffices [P]
        hands: list[str] = []  # geoms that the robot stands on; no other may touch the ground

    class control(SkillCfg.control):
        action_scale = 0.5  # [rad] [ours, from the default pose; P 0.3 from the last targets, which no row shows]

    class normalization(SkillCfg.normalization):
        clip_actions = 4.0  # [ours: the thighs turn by 1.6 rad]

    class termination(SkillCfg.termination):
        max_tilt = 104.5  # [deg]: the trunk's z axis 0.25 below the horizon [P]

    class domain_rand(SkillCfg.domain_rand):
        base_mass, base_com, friction = [-0.5, 1.5], [-0.02, 0.02], [0.3, 1.2]  # [kg], [m], [-]

    class rewards(SkillCfg.rewards):
        soft_dof_pos_limit = 0.9  # [P]

        class scales(SkillCfg.rewards.scales):  # [P]: its pose is joint_deviation here, its contact collision
            stand_height, stand_attitude = 1.0, 1.0
            collision, dof_pos_limits, joint_deviation = -0.1, -0.5, -0.1
            # [P, in its fine-tuning, 0, -0.003, -2.5e-7: at first as large as the rewards]
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
        """1 where the root's x axis points as ``exam.nose``, 0.25 where it is level, 0 the other way. [P]"""
        return (0.5 - 0.5 * self.cfg.exam.nose * self.projected_gravity[:, 0]).square()
