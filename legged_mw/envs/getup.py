"""Get up: from any fall to standing in the default pose, and staying there. The class, its config and its learner's.

Sources: [P] MuJoCo Playground's Go1 getup (commit d5e6b47); [H] HoST (OpenRobotLab), a G1; [ours] with the reason.
"""

from __future__ import annotations

from typing import Annotated

import torch
from torch import Tensor

from legged_mw.envs.observations import Row
from legged_mw.envs.pull import Pull
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg, RobotTaskCfgPPO
from legged_mw.sim.settle import fallen
from legged_mw.utils.bounds import Count, Part, Seconds, Share, Whole, above
from legged_mw.utils.math import assign

Settling = Annotated[float, above(0, 60, "s")]
UP_TILT, UP_HEIGHT = 0.966, 0.9  # cosine of the tilt (15 degrees), share of the standing height: it is up [ours: servos alone hold 0.92]


class GetupCfg(RobotTaskCfg):
    class env(RobotTaskCfg.env):
        num_envs, episode_length_s = 8192, 6.0  # [-], [s] [P]

    class asset(RobotTaskCfg.asset):
        self_collisions = True  # and all colliders touch the ground [P]

    class falls:
        share: Share = 0.75  # of episodes that begin in a fall; the others stand [P 0.6]
        states: Count = 2048  # settled falls to begin from; at most four a world are made [ours]
        seconds: Settling = 1.0  # from the drop to the state [P 0.5; ours: a roll takes longer]
        seed: Whole = 1  # the same seed makes the same falls; the exam has its own
        pull: Share = 0.0  # share of the weight that lifts the root of a robot that is not up; it fades as they learn [H 0.6]
        pull_fades: Part = 0.2  # of it, when every world has ended an episode up [ours]

    class control(RobotTaskCfg.control):
        action_scale = 0.5  # [rad] [P, H: of the present angles; ours: of the default pose, where action 0 stands]

    class normalization(RobotTaskCfg.normalization):
        clip_actions = 4.0  # [ours: the servos' whole torque, wherever the joints are]

    class observations(RobotTaskCfg.observations):
        leave_out = {"state": ["base_lin_vel"]}  # [P]

    class termination(RobotTaskCfg.termination):
        max_tilt = 180.0  # [deg]: no attitude ends an episode [P, H]

    class domain_rand(RobotTaskCfg.domain_rand):
        enable, observe = True, True
        base_mass, base_com, friction = [-1.0, 3.0], [-0.03, 0.03], [0.25, 1.2]  # [kg] [H -2 to 5], [m], [-] [H 0.1 to 1]
        stiffness, damping, strength = [0.9, 1.1], [0.9, 1.1], [0.9, 1.1]  # [H 0.85 to 1.15]
        encoder_offset = [-0.015, 0.015]  # [rad]

    class sim(RobotTaskCfg.sim):
        iterations, ls_iterations = 3, 10  # [ours: a robot that lies has many contacts]

    class exam:
        within: Seconds = 3.0  # [s] in which it must stand

    class rewards(RobotTaskCfg.rewards):
        only_positive_rewards = False  # [ours, P True: nothing ends an episode, and while it thrashes all would be clipped]

        class scales(RobotTaskCfg.rewards.scales):  # [P], with our terms of the same meaning
            upright, height, posture, stand_still = 1.0, 1.0, 1.0, 1.0
            action_rate, action_smoothness, torques, dof_acc, dof_pos_limits = -0.005, -0.001, -1e-5, -1e-8, -0.1
            fast_joints = -0.0003  # [ours, P -0.1 and dof_acc -2.5e-7: at first the noise would cost ten times what it gains]


class GetupCfgPPO(RobotTaskCfgPPO):
    class runner(RobotTaskCfgPPO.runner):
        num_steps_per_env, max_iterations = 20, 1000  # [P], [ours]

    class actor(RobotTaskCfgPPO.actor):
        hidden_dims = [256, 128, 64]  # [ours]

        class distribution_cfg(RobotTaskCfgPPO.actor.distribution_cfg):
            init_std, std_range = 0.6, [0.2, 1e6]  # [ours: those that stand want less noise, before the others have found how to turn over]

    class algorithm(RobotTaskCfgPPO.algorithm):
        gamma, num_mini_batches, entropy_coef = 0.98, 8, 0.01  # [P 0.97], [ours], [P]

    class anneal(RobotTaskCfgPPO.anneal):
        entropy_coef, desired_kl = 0.001, 0.003  # [ours]

    class symmetry(RobotTaskCfgPPO.symmetry):
        use_data_augmentation = True  # [ours]


class Getup(RobotTask):
    cfg: GetupCfg
    exam = "getup"

    def _init_buffers(self) -> None:
        super()._init_buffers()
        falls = self.cfg.falls
        states = fallen(self.robot.physics, min(falls.states, 4 * self.num_envs), falls.seed, falls.seconds)
        self.fallen_qpos, self.fallen_qvel = (self._tensor(values) for values in states)  # (P, nq), (P, nv)
        self.up_height = 0.99 * self.start_place[2]  # [m] of the root, standing [P: 0.275 of 0.278]
        self.upright, self.up = torch.zeros_like(self.rew_buf), self._zeros(dtype=torch.bool)
        self.pull = Pull(self.sim, self.root_body, falls.pull * 9.81 * self.total_mass, falls.pull_fades)

    def _refresh_base(self) -> None:
        super()._refresh_base()
        torch.neg(self.projected_gravity[:, 2], out=self.upright)
        self.up.copy_((self.upright > UP_TILT) & (self.base_height > UP_HEIGHT * self.up_height))

    def _apply_actions(self) -> None:
        super()._apply_actions()
        if self.cfg.falls.pull:
            self.pull.apply(self.up)

    def _update_curricula(self, mask: Tensor) -> None:
        super()._update_curricula(mask)
        if self.cfg.falls.pull:
            self.pull.update(mask & (self.episode_steps[:, 0] > 0.0), self.up)

    def _live_statistics(self) -> dict[str, Tensor]:
        level = {"pull": torch.stack([self.pull.level, torch.ones_like(self.pull.level)])} if self.cfg.falls.pull else {}
        return super()._live_statistics() | level

    def training_state(self) -> dict[str, Tensor]:
        return {**super().training_state(), "pull_level": self.pull.level.clone()}

    def load_training_state(self, state: dict[str, Tensor]) -> None:
        super().load_training_state(state)
        self.pull.level.copy_(state.get("pull_level", self.pull.level))

    def _reset_robots(self, mask: Tensor) -> None:
        """Standing as any task begins, or, by chance, in one of the settled falls."""
        super()._reset_robots(mask)
        fall = mask & (torch.rand_like(self.rew_buf) < self.cfg.falls.share)
        pick = torch.randint(len(self.fallen_qpos), (self.num_envs,), device=self.device)
        assign(self.sim.qpos, fall, self.fallen_qpos.index_select(0, pick))
        assign(self.sim.qvel, fall, self.fallen_qvel.index_select(0, pick))

    def _body_rows(self) -> list[Row]:
        return [*super()._body_rows(), Row("base_height", self.base_height[:, None], mirror="scalar")]  # above the ground [m] [P]

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

    def _reward_fast_joints(self) -> Tensor:
        """What joints are faster than a turn a second, squared [rad^2/s^2]. [P]"""
        return (self.dof_vel.abs() - 2.0 * torch.pi).clamp(min=0.0).square().sum(dim=1)
