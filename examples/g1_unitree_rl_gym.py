"""unitree_rl_gym's G1 with 12 joints: its configuration, observations, rewards and LSTM, as a port to copy from.

[U] is unitree_rl_gym: envs/g1/g1_config.py and g1_env.py as of 2025; it descends from legged_gym, and so does this file from
go1_legged_gym.py. Tables both ways: docs/coming_from.md. Run it with: python train.py --task examples/g1_unitree_rl_gym.py
"""

from __future__ import annotations

from go1_legged_gym import Go1LeggedGymCfg, Go1LeggedGymCfgPPO, LeggedGymRobot
from torch import Tensor

from legged_mw.envs.observations import Row
from legged_mw.utils.task import Task

ANKLE = 0.037  # [m] height of the ankle, which [U] rewards, above the sole, where our foot's site is


class UnitreeG1(LeggedGymRobot):
    def observation_rows(self) -> dict[str, list[Row | str]]:
        """[U]'s 47 rows, and 2 more of the clock: a sine and a cosine per foot. The critic gets no noise, and the velocity."""
        rows = {row.name: row for row in super().observation_rows()["state"] if isinstance(row, Row)}
        velocity, clock = (
            rows.pop("base_lin_vel"),
            Row("gait_clock", self.gait.row if self.gait else self.actions, mirror="foot"),
        )
        seen = [*rows.values(), clock]
        return {
            "state": [*seen],
            "privileged_state": [row._replace(noise=0.0, measured=False) for row in (velocity, *seen)],
        }

    def _reward_contact(self) -> Tensor:
        """Number of feet that stand or swing by the clock."""
        return 2.0 * self._reward_contact_phase()

    def _reward_contact_no_vel(self) -> Tensor:
        """Squared velocity of stance feet [m^2/s^2]."""
        return (self.foot_vel.square().sum(dim=2) * self.foot_contact).sum(dim=1)

    def _reward_feet_swing_height(self) -> Tensor:
        """Squared height error of swinging ankles from 0.08 m above the ground [m^2]."""
        return ((self.foot_height + ANKLE - 0.08).square() * ~self.foot_contact).sum(dim=1)


class G1UnitreeCfg(Go1LeggedGymCfg):
    class asset(Go1LeggedGymCfg.asset):
        file = "resources/robots/g1/g1.xml"
        imu_site = "imu_in_pelvis"
        foot_names = ["left_foot", "right_foot"]
        foot_geoms = {"left_foot": ["left_foot[26]_collision"], "right_foot": ["right_foot[26]_collision"]}
        colliders = ["*_foot[26]_collision"]  # [U]: all bodies; its rewards count only contacts of the feet
        held_joints = ["waist_*", "*_shoulder_*", "*_elbow_*", "*_wrist_*"]
        penalize_contacts_on = []
        terminate_after_contacts_on = []

    class init_state(Go1LeggedGymCfg.init_state):
        pos = [0.0, 0.0, 0.8]  # [m]
        default_joint_angles = {"": 0.0, "hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2}  # [rad]

    class control(Go1LeggedGymCfg.control):
        stiffness = {"hip": 100.0, "knee": 150.0, "ankle": 40.0}  # [N m/rad]
        damping = {"hip": 2.0, "knee": 4.0, "ankle": 2.0}  # [N m s/rad]

    class gait(Go1LeggedGymCfg.gait):
        period, stance, random_start = 0.8, 0.55, False

    class termination(Go1LeggedGymCfg.termination):
        max_tilt, min_base_height = 70.0, 0.4  # [deg], [m]; [U]: the pelvis touches the ground

    class rewards(Go1LeggedGymCfg.rewards):
        base_height_target = 0.78  # [m]
        hip_joints = ["hip_roll", "hip_yaw"]

        class scales(Go1LeggedGymCfg.rewards.scales):
            _only = True
            tracking_lin_vel = 1.0
            tracking_ang_vel = 0.5
            lin_vel_z = -2.0
            ang_vel_xy = -0.05
            orientation = -1.0
            base_height = -10.0
            dof_acc = -2.5e-7
            dof_vel = -1e-3
            action_rate = -0.01
            dof_pos_limits = -5.0
            alive = 0.15
            hip_pos = -1.0
            contact_no_vel = -0.2
            feet_swing_height = -20.0
            contact = 0.18

    class perturbation(Go1LeggedGymCfg.perturbation):
        push_interval_s, max_push_vel_xy = 5.0, 1.5  # [s], [m/s]

    class domain_rand(Go1LeggedGymCfg.domain_rand):
        friction, base_mass = [0.1, 1.25], [-1.0, 3.0]  # [-], [kg]

    class sim(Go1LeggedGymCfg.sim):
        iterations, ls_iterations = 3, 10  # soles slip with 1 (docs/lab.md)
        nconmax = njmax = 0  # counted from the model


class G1UnitreeCfgPPO(Go1LeggedGymCfgPPO):
    class runner(Go1LeggedGymCfgPPO.runner):
        max_iterations = 10000

    class obs_groups(Go1LeggedGymCfgPPO.obs_groups):
        critic = ["privileged_state"]

    class actor(Go1LeggedGymCfgPPO.actor):
        class_name, rnn_type, rnn_hidden_dim = "RNNModel", "lstm", 64
        hidden_dims = [32]

        class distribution_cfg(Go1LeggedGymCfgPPO.actor.distribution_cfg):
            init_std = 0.8

    class critic(Go1LeggedGymCfgPPO.critic):
        class_name, rnn_type, rnn_hidden_dim = "RNNModel", "lstm", 64
        hidden_dims = [32]


TASK = Task(UnitreeG1, G1UnitreeCfg, G1UnitreeCfgPPO)
