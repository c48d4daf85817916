"""legged_gym's A1 rough task on plane ground, for Go1: its configuration, observations and rewards, as a port to copy from.

[L] is legged_gym 0548121: envs/base/legged_robot_config.py, legged_robot.py, envs/a1/a1_config.py. What differs from it, and
why, is in docs/from_legged_gym.md. Run it with: python train.py --task examples/go1_legged_gym.py
"""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.observations import Row
from legged_mw.rl.learner_config import LeggedRobotCfgPPO
from legged_mw.utils.task import Task


class LeggedGymRobot(LeggedRobot):
    """The parts of legged_gym's robot that LeggedRobot lacks or computes differently."""

    cfg: Go1LeggedGymCfg

    # ---- commands

    def _draw_timers(self) -> Tensor:
        """The constant ``resampling_time``. [L]"""
        return torch.full_like(self.command_timer, self.cfg.commands.resampling_time / self.dt)

    def _reset_commands(self, mask: Tensor) -> None:
        """Uniform commands; velocities too small for walking are set to zero. [L]"""
        super()._reset_commands(mask)
        small = torch.linalg.vector_norm(self.commands[:, :2], dim=1) <= self.cfg.commands.min_lin_vel
        self.commands[:, :2].masked_fill_((small & mask)[:, None], 0.0)

    def _resample_commands(self, mask: Tensor) -> None:
        self._reset_commands(mask)  # legged_gym redraws the whole command, LeggedRobot a part of it

    # ---- observations

    def observation_rows(self) -> dict[str, list[Row | str]]:
        """One group: legged_gym's actor and critic have the same observations."""
        noise, scale = self.cfg.noise.scales, self.cfg.normalization.obs_scales
        velocities = (scale.lin_vel, scale.lin_vel, scale.ang_vel)
        return {
            "state": [
                Row(
                    "base_lin_vel",
                    self.base_lin_vel,
                    noise.lin_vel,
                    mirror="imu_velocity",
                    scale=scale.lin_vel,
                    measured=True,
                ),
                Row(
                    "base_ang_vel", self.base_ang_vel, noise.ang_vel, mirror="axial", scale=scale.ang_vel, measured=True
                ),
                Row("projected_gravity", self.projected_gravity, noise.gravity, mirror="polar", measured=True),
                Row("commands", self.commands, mirror="command", scale=velocities),
                Row("dof_pos", self.joint_reading, noise.dof_pos, mirror="joint", scale=scale.dof_pos, measured=True),
                Row("dof_vel", self.dof_vel, noise.dof_vel, mirror="joint", scale=scale.dof_vel, measured=True),
                Row("last_actions", self.last_actions, mirror="action"),
                *(row._replace(scale=scale.height_scan) for row in self._height_rows("state", noise.height_scan)),
            ]
        }

    # ---- rewards that LeggedRobot lacks or computes differently. All [L].

    def _reward_lin_vel_z(self) -> Tensor:
        """Square of the vertical velocity, body frame."""
        return self.base_lin_vel[:, 2].square()

    def _reward_ang_vel_xy(self) -> Tensor:
        """Roll and pitch rates, body frame."""
        return self.base_ang_vel[:, :2].square().sum(dim=1)

    def _reward_feet_air_time(self) -> Tensor:
        """At touch-down, the foot's air time beyond ``min_air_time`` [s], unless commanded to stand or turn."""
        excess = (self.feet_air_time - self.cfg.rewards.min_air_time) * self.first_contact
        walking = torch.linalg.vector_norm(self.commands[:, :2], dim=1) > 0.1
        return excess.sum(dim=1) * walking


class Go1LeggedGymCfg(LeggedRobotCfg):
    class env(LeggedRobotCfg.env):
        num_envs = 4096
        episode_length_s = 20.0

    class asset(LeggedRobotCfg.asset):
        file = "resources/robots/go1/go1.xml"
        foot_names = ["FR", "FL", "RR", "RL"]
        colliders = ["*"]
        penalize_contacts_on = ["*_thigh_*", "*_calf_*"]
        terminate_after_contacts_on = ["trunk_*"]

    class init_state(LeggedRobotCfg.init_state):
        pos = [0.0, 0.0, 0.42]
        default_joint_angles = {
            "FL_hip": 0.1,
            "RL_hip": 0.1,
            "FR_hip": -0.1,
            "RR_hip": -0.1,
            "FL_thigh": 0.8,
            "RL_thigh": 1.0,
            "FR_thigh": 0.8,
            "RR_thigh": 1.0,
            "calf": -1.5,
        }
        dof_pos_range = [0.5, 1.5]
        pos_xy_range = 0.0
        yaw_range = 0.0

    class control(LeggedRobotCfg.control):
        stiffness = {"joint": 20.0}
        damping = {"joint": 0.5}
        action_scale = 0.25
        decimation = 4

    class commands(LeggedRobotCfg.commands):
        heading_command = True
        resampling_time = 10.0
        min_lin_vel: float = 0.2  # norm of (vx, vy) below which both are zero [m/s]

        class ranges(LeggedRobotCfg.commands.ranges):
            lin_vel_x = [-1.0, 1.0]
            lin_vel_y = [-1.0, 1.0]
            ang_vel_yaw = [-1.0, 1.0]
            heading = [-3.14, 3.14]  # [rad]

    class termination(LeggedRobotCfg.termination):
        max_tilt = 180.0  # no limit: only a contact of the trunk is a fall

    class rewards(LeggedRobotCfg.rewards):
        soft_dof_pos_limit = 0.9
        soft_torque_limit = 1.0
        base_height_target = 0.25  # [m]
        torques_as = "squares"
        min_air_time = 0.5

        class scales(LeggedRobotCfg.rewards.scales):
            tracking_lin_vel = 1.0
            tracking_ang_vel = 0.5
            lin_vel_z = -2.0
            ang_vel_xy = -0.05
            torques = -0.0002
            dof_acc = -2.5e-7
            feet_air_time = 1.0
            collision = -1.0
            action_rate = -0.01
            dof_pos_limits = -10.0
            # zero in legged_gym too
            orientation = 0.0
            base_height = 0.0
            torque_limits = 0.0
            dof_vel = 0.0
            stand_still = 0.0
            termination = 0.0
            # fields of LeggedRobotCfg that legged_gym does not have
            pose = 0.0
            energy = 0.0
            feet_clearance = 0.0
            feet_height = 0.0
            feet_slip = 0.0

    class normalization(LeggedRobotCfg.normalization):
        clip_actions = 100.0

        class obs_scales:
            lin_vel: float = 2.0
            ang_vel: float = 0.25
            dof_pos: float = 1.0
            dof_vel: float = 0.05
            height_scan: float = 5.0

    class noise(LeggedRobotCfg.noise):
        class scales(LeggedRobotCfg.noise.scales):
            lin_vel = 0.1
            ang_vel = 0.2
            gravity = 0.05
            dof_pos = 0.01
            dof_vel = 1.5
            height_scan = 0.1

    class perturbation(LeggedRobotCfg.perturbation):
        push = True
        push_interval_s = 15.0
        max_push_vel_xy = 1.0

    class domain_rand(LeggedRobotCfg.domain_rand):
        enable = True
        friction = [0.5, 1.25]
        # legged_gym does not randomize these
        base_mass = []
        link_mass = []
        base_com = []
        armature = []
        frictionloss = []
        encoder_offset = []

    class terrain(LeggedRobotCfg.terrain):
        friction = 1.0  # where domain_rand is off

    class sim(LeggedRobotCfg.sim):
        dt = 0.005
        nconmax = 24  # all geoms collide, not only the feet: at most 14 were measured for robots that thrash
        njmax = 120  # 24 of the joints, 4 per contact


class Go1LeggedGymCfgPPO(LeggedRobotCfgPPO):
    class runner(LeggedRobotCfgPPO.runner):
        num_steps_per_env = 24
        max_iterations = 1500
        save_interval = 50

    class obs_groups(LeggedRobotCfgPPO.obs_groups):
        critic = ["state"]

    class actor(LeggedRobotCfgPPO.actor):
        obs_normalization = False  # obs_scales replace it

        class distribution_cfg(LeggedRobotCfgPPO.actor.distribution_cfg):
            init_std = 1.0

    class critic(LeggedRobotCfgPPO.critic):
        obs_normalization = False

    class algorithm(LeggedRobotCfgPPO.algorithm):
        entropy_coef = 0.01
        learning_rate = 1e-3
        gamma = 0.99
        lam = 0.95
        desired_kl = 0.01


TASK = Task(LeggedGymRobot, Go1LeggedGymCfg, Go1LeggedGymCfgPPO)
