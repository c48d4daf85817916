"""Unitree G1, a humanoid of 29 joints: for any task, walking, tracking. Masses, motors and ranges are in g1.xml.

Sources: [U] unitree_rl_gym; [UL] unitree_rl_lab; [M] mjlab: 10 Hz, damping ratio 2; [B] BeyondMimic; [ours].
"""

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.skills.motion_tracking_config import MotionTrackingCfg

# [rad] 4 times this, times [M]'s stiffness, is the motors' highest torque
SCALE = {"": 0.44, "wrist_pitch": 0.075, "wrist_yaw": 0.075, "hip": 0.55, "waist_yaw": 0.55, "hip_roll": 0.35,
         "knee": 0.35, "ankle": 0.44, "waist": 0.44}  # fmt: skip


class G1(RobotTaskCfg):
    class asset(RobotTaskCfg.asset):
        file, imu_site = "resources/robots/g1/g1.xml", "imu_in_pelvis"

    class init_state(RobotTaskCfg.init_state):
        default_joint_angles = {"": 0.0, "hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2, "elbow": 0.8,  # [rad] [U]
                        "shoulder_pitch": 0.2, "left_shoulder_roll": 0.2, "right_shoulder_roll": -0.2}  # fmt: skip

    class control(RobotTaskCfg.control):  # [M], by motor: 5020; 4010; 7520-14; 7520-22; two 5020
        stiffness = {"": 14.25, "wrist_pitch": 16.78, "wrist_yaw": 16.78, "hip": 40.18, "waist_yaw": 40.18,  # [N m/rad]
                     "hip_roll": 99.1, "knee": 99.1, "ankle": 28.5, "waist": 28.5}  # fmt: skip
        damping = {"": 0.907, "wrist_pitch": 1.07, "wrist_yaw": 1.07, "hip": 2.56, "waist_yaw": 2.56,  # [N m s/rad]
                   "hip_roll": 6.31, "knee": 6.31, "ankle": 1.81, "waist": 1.81}  # fmt: skip
        action_scale = SCALE
        decimation = 4

    class ratings(RobotTaskCfg.ratings):
        # unitree_rl_lab's unitree_actuators.py; unknown: ankles, waist roll and pitch, each of two motors (docs/heat.md)
        peak_torque = {"hip": 71.0, "waist_yaw": 71.0, "hip_roll": 111.0, "knee": 111.0, "shoulder": 24.8,  # [N m]
                       "elbow": 24.8, "wrist_roll": 24.8, "wrist": 4.8}  # fmt: skip
        knee_speed = {"hip": 22.63, "waist_yaw": 22.63, "hip_roll": 14.5, "knee": 14.5, "shoulder": 30.86,  # [rad/s]
                      "elbow": 30.86, "wrist_roll": 30.86, "wrist": 15.3}  # fmt: skip
        top_speed = {"hip": 35.52, "waist_yaw": 35.52, "hip_roll": 22.7, "knee": 22.7, "shoulder": 40.13,  # [rad/s]
                     "elbow": 40.13, "wrist_roll": 40.13, "wrist": 24.76}  # fmt: skip

    class sim(RobotTaskCfg.sim):
        dt, iterations, ls_iterations = 0.005, 3, 10  # [s] [M], [ours: soles slip with 1; docs/lab.md]


class FirmWaistG1(G1):
    class control(G1.control):  # [UL: with [M]'s 28.5 the torso, which topples with 22 N m/rad, leans on the end stop]
        stiffness = {**G1.control.stiffness, "waist": 200.0}  # [N m/rad]
        damping = {**G1.control.damping, "waist": 5.0}  # [N m s/rad]
        action_scale = {**SCALE, "waist": 0.1}


class UprightG1(FirmWaistG1, LeggedRobotCfg):
    class asset(G1.asset, LeggedRobotCfg.asset):
        foot_names = ["left_foot", "right_foot"]
        foot_geoms = {"left_foot": ["left_foot[26]_collision"], "right_foot": ["right_foot[26]_collision"]}
        colliders = ["*_foot[26]_collision"]  # the outer two of a sole's seven capsules [ours]

    class control(FirmWaistG1.control, LeggedRobotCfg.control):  # legs [U]; beside [M]'s: docs/archive/go2_and_g1.md
        stiffness = {**FirmWaistG1.control.stiffness, "hip": 100.0, "hip_roll": 100.0, "knee": 150.0, "ankle": 40.0,
                     "waist_yaw": 200.0}  # [N m/rad]  # fmt: skip
        damping = {**FirmWaistG1.control.damping, "hip": 2.0, "hip_roll": 2.0, "knee": 4.0, "ankle": 2.0,
                   "waist_yaw": 5.0}  # [N m s/rad]  # fmt: skip
        action_scale = {**SCALE, "hip": 0.25, "knee": 0.25, "ankle": 0.31, "waist": 0.1, "waist_yaw": 0.1}  # [ours]

    class rewards(LeggedRobotCfg.rewards):
        min_feet_distance = 0.2  # [m]
        pose_weights = {"": 3.4, "hip_pitch": 0.14, "knee": 0.14, "hip_roll": 1.5, "hip_yaw": 1.5,  # [M]
                        "ankle_pitch": 1.5, "waist_yaw": 1.5, "shoulder_pitch": 1.5}  # fmt: skip
        deviation_weights = {"": 0.0, "waist": 1.0, "waist_yaw": 0.2, "hip_roll": 0.2, "hip_yaw": 0.2}  # [ours]

    class exam(LeggedRobotCfg.exam):
        peer = "g1"


class TrackedG1(G1, MotionTrackingCfg):
    class asset(G1.asset):
        colliders = ["*_foot?_collision"]  # all seven capsules of a sole [ours: it stands on one foot]

    class motion(MotionTrackingCfg.motion):  # [B]
        bodies = ["pelvis", "left_hip_roll_link", "left_knee_link", "left_ankle_roll_link",
                  "right_hip_roll_link", "right_knee_link", "right_ankle_roll_link",
                  "torso_link", "left_shoulder_roll_link", "left_elbow_link", "left_wrist_yaw_link",
                  "right_shoulder_roll_link", "right_elbow_link", "right_wrist_yaw_link"]  # fmt: skip
        anchor = "torso_link"
        end_bodies = ["left_ankle_roll_link", "right_ankle_roll_link", "left_wrist_yaw_link", "right_wrist_yaw_link"]
