"""mjlab's Mjlab-Velocity-Flat-Unitree-Go1 as a class: its commands, rows, rewards, pushes and learner, as a port to copy from.

[M] is mjlab: tasks/velocity/velocity_env_cfg.py and config/go1/env_cfgs.py at 008c69c. Left out: its shares of robots that steer by
heading or walk straight ahead, the widening of commands after 5000 iterations, torsion and rolling friction, errors of the IMU's mount.
Gains and action scale are go1_flat's. Tables both ways: docs/coming_from.md. Run it with: python train.py --task examples/go1_mjlab.py
"""

from __future__ import annotations

import torch
from torch import Tensor

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class MjlabRobot(LeggedRobot):
    cfg: Go1MjlabCfg

    # ---- commands: mjlab's UniformVelocityCommand

    def _draw_timers(self) -> Tensor:
        """Between 3 and 8 s."""
        low, high = (limit / self.dt for limit in self.cfg.commands.resampling_range)
        return torch.empty(self.num_envs, 1, device=self.device).uniform_(low, high).round_()

    def _reset_commands(self, mask: Tensor) -> None:
        """Uniform commands; a tenth of the robots gets the command to stand."""
        super()._reset_commands(mask)
        stands = torch.rand(self.num_envs, device=self.device) < self.cfg.commands.standing_share
        self.commands.masked_fill_((stands & mask)[:, None], 0.0)

    def _resample_commands(self, mask: Tensor) -> None:
        self._reset_commands(mask)

    # ---- rewards: a term of mjlab is a function with parameters; here it is a method

    def _init_buffers(self) -> None:
        super()._init_buffers()
        calf = torch.tensor(["calf" in name for name in self.robot.joint_names], device=self.device)
        self.joint_std = torch.where(calf, 2.0, 1.0)  # (D,) the calf may deviate twice as much

    def _reward_tracking_lin_vel(self) -> Tensor:
        """track_linear_velocity: std^2 0.25, and no vertical velocity."""
        error = (self.commands[:, :2] - self.base_lin_vel[:, :2]).square().sum(dim=1) + self.base_lin_vel[:, 2].square()
        return torch.exp(-error / 0.25)

    def _reward_tracking_ang_vel(self) -> Tensor:
        """track_angular_velocity: std^2 0.5, and neither roll nor pitch rate."""
        error = (self.commands[:, 2] - self.base_ang_vel[:, 2]).square() + self.base_ang_vel[:, :2].square().sum(dim=1)
        return torch.exp(-error / 0.5)

    def _reward_upright(self) -> Tensor:
        """upright: std^2 0.2."""
        return torch.exp(-self.projected_gravity[:, :2].square().sum(dim=1) / 0.2)

    def _reward_pose(self) -> Tensor:
        """variable_posture: std 0.05 rad standing, 0.3 rad walking."""
        std = torch.where(self.moving, 0.3, 0.05)[:, None] * self.joint_std
        return torch.exp(-(self.dof_offset / std).square().mean(dim=1))

    def _reward_feet_clearance(self) -> Tensor:
        """feet_clearance: the speed itself, of which Playground takes the root, while moving [m^2/s]."""
        off = (self.foot_height - self.cfg.rewards.swing_height).abs() * self.foot_speed
        return (off * self.moving[:, None]).sum(dim=1)


class Go1MjlabCfg(Go1FlatCfg):
    class env(Go1FlatCfg.env):
        num_envs = 4096

    class asset(Go1FlatCfg.asset):
        colliders = ["*"]

    class control(Go1FlatCfg.control):
        decimation = 4

    class observations(Go1FlatCfg.observations):
        foot_height = contact_forces = True  # of the critic

    class noise(Go1FlatCfg.noise):
        class scales(Go1FlatCfg.noise.scales):
            lin_vel = 0.5  # [m/s]
            dof_pos = 0.01  # [rad]

    class commands(Go1FlatCfg.commands):
        resampling_range: list[float] = [3.0, 8.0]  # [s]
        standing_share: float = 0.1  # of the robots

        class ranges(Go1FlatCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-1.0, 1.0], [-1.0, 1.0], [-0.5, 0.5]  # [m/s], [m/s], [rad/s]

    class termination(Go1FlatCfg.termination):
        max_tilt = 70.0  # [deg]

    class rewards(Go1FlatCfg.rewards):
        only_positive_rewards = False
        soft_dof_pos_limit = 0.9
        min_command = 0.05

        class scales(Go1FlatCfg.rewards.scales):
            _only = True
            tracking_lin_vel = 2.0
            tracking_ang_vel = 2.0
            upright = 1.0
            pose = 1.0
            dof_pos_limits = -1.0
            action_rate = -0.1
            feet_clearance = -2.0
            feet_height = -0.25
            feet_slip = -0.1
            soft_landing = -1e-5

    class normalization(Go1FlatCfg.normalization):
        clip_actions = 100.0  # [M] has no bound

    class perturbation(Go1FlatCfg.perturbation):
        kick, push = False, True
        push_interval_s, max_push_vel_xy = 2.0, 0.5  # [s] [M: 1 to 3], [m/s]

    class domain_rand(Go1FlatCfg.domain_rand):
        enable = True
        friction, encoder_offset, base_com = [0.3, 1.5], [-0.015, 0.015], [-0.025, 0.025]  # [-], [rad], [m]
        link_mass = base_mass = armature = frictionloss = []

    class sim(Go1FlatCfg.sim):
        dt, iterations, ls_iterations = 0.005, 10, 20  # [s]
        nconmax = njmax = 0  # counted from the model


class Go1MjlabCfgPPO(Go1FlatCfgPPO):
    class runner(Go1FlatCfgPPO.runner):
        num_steps_per_env, max_iterations = 24, 10000

    class actor(Go1FlatCfgPPO.actor):
        class distribution_cfg(Go1FlatCfgPPO.actor.distribution_cfg):
            init_std = 1.0

    class algorithm(Go1FlatCfgPPO.algorithm):
        gamma, entropy_coef = 0.99, 0.01

    class anneal(Go1FlatCfgPPO.anneal):
        entropy_coef = desired_kl = 0.0  # both stay

    class symmetry(Go1FlatCfgPPO.symmetry):
        use_data_augmentation = False


TASK = Task(MjlabRobot, Go1MjlabCfg, Go1MjlabCfgPPO)
