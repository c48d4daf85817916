"""Unitree G1 with 29 joints follows a motion, a side kick held in balance, without knowing its place or its velocity.

[B]: BeyondMimic; [M]: mjlab; [ours]. With state estimation, as in [B]: --set "observations.leave_out={}" (docs/motions.md).
"""

from configs.g1_flat import G1FlatCfg
from legged_mw.rl.learner_config import RobotTaskCfgPPO
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg
from legged_mw.utils.task import Task


class G1TrackCfg(MotionTrackingCfg):
    class env(MotionTrackingCfg.env):
        num_envs = 8192

    class asset(MotionTrackingCfg.asset):
        file, imu_site = G1FlatCfg.asset.file, G1FlatCfg.asset.imu_site
        colliders = ["*_foot?_collision"]  # all seven capsules of a sole [ours: it stands on one foot]

    class init_state(MotionTrackingCfg.init_state):
        default_joint_angles = G1FlatCfg.init_state.default_joint_angles

    class control(MotionTrackingCfg.control):
        stiffness, damping = G1FlatCfg.control.stiffness, G1FlatCfg.control.damping
        action_scale, decimation = G1FlatCfg.control.action_scale, G1FlatCfg.control.decimation

    class motion(MotionTrackingCfg.motion):
        clips = ["resources/motions/g1_kick.npz"]
        bodies = [  # [B]
            *["pelvis", "left_hip_roll_link", "left_knee_link", "left_ankle_roll_link"],
            *["right_hip_roll_link", "right_knee_link", "right_ankle_roll_link"],
            *["torso_link", "left_shoulder_roll_link", "left_elbow_link", "left_wrist_yaw_link"],
            *["right_shoulder_roll_link", "right_elbow_link", "right_wrist_yaw_link"],
        ]
        anchor = "torso_link"  # [B]
        # [B]
        end_bodies = ["left_ankle_roll_link", "right_ankle_roll_link", "left_wrist_yaw_link", "right_wrist_yaw_link"]

    class observations(MotionTrackingCfg.observations):
        leave_out = {"state": ["anchor_pos", "base_lin_vel"]}  # no sensor gives them [B, without state estimation]

    class normalization(MotionTrackingCfg.normalization):
        clip_actions = 10.0  # [ours: B has no bound, and a squat's knees are four scales from the default pose]

    class domain_rand(MotionTrackingCfg.domain_rand):
        enable = True
        friction = [0.3, 1.2]  # [M]
        base_com = [-0.05, 0.05]  # [m] [B: of the torso]
        encoder_offset = [-0.01, 0.01]  # [rad] [B: of the default pose]
        link_mass, base_mass, armature, frictionloss = [], [], [], []  # [B]

    class perturbation(MotionTrackingCfg.perturbation):
        push, push_interval_s, max_push_vel_xy = True, 2.0, 0.5  # [s], [m/s] [B: each 1 to 3 s]

    class sim(MotionTrackingCfg.sim):
        dt, iterations, ls_iterations = G1FlatCfg.sim.dt, G1FlatCfg.sim.iterations, G1FlatCfg.sim.ls_iterations


class G1TrackCfgPPO(RobotTaskCfgPPO):
    class algorithm(RobotTaskCfgPPO.algorithm):
        desired_kl = 0.02  # [ours: of 29 joints together, as g1_flat's]

    class runner(RobotTaskCfgPPO.runner):
        max_iterations = 1400  # seven minutes on an H200

    class actor(RobotTaskCfgPPO.actor):
        hidden_dims = [224, 128, 64]  # [ours: one clip is learned by less than B's 512, 256, 128]

        class distribution_cfg(RobotTaskCfgPPO.actor.distribution_cfg):
            # [ours: with the 1.0 of B action_rate outweighs all of tracking at first, and it learns to fall soon]
            init_std = 0.4


TASK = Task(MotionTracking, G1TrackCfg, G1TrackCfgPPO)
