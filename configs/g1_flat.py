"""Unitree G1 with 29 joints follows a joystick on flat ground without knowing its velocity; randomized worlds, kicks and pushes."""

from configs.base import BipedCfg, BipedCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


# sources: as BipedCfg's; [M]'s gains are from each rotor's inertia, at 10 Hz and a damping ratio of 2
class G1FlatCfg(BipedCfg):
    class asset(BipedCfg.asset):
        file = "resources/robots/g1/g1.xml"
        imu_site = "imu_in_pelvis"
        foot_names = ["left_foot", "right_foot"]
        foot_geoms = {"left_foot": ["left_foot[26]_collision"], "right_foot": ["right_foot[26]_collision"]}
        colliders = ["*_foot[26]_collision"]  # the outer two of a sole's seven capsules [ours]

    class init_state(BipedCfg.init_state):
        default_joint_angles = {"": 0.0, "hip_pitch": -0.1, "knee": 0.3, "ankle_pitch": -0.2, "elbow": 0.8,  # [rad] [U]
                                "shoulder_pitch": 0.2, "left_shoulder_roll": 0.2, "right_shoulder_roll": -0.2}  # fmt: skip

    class control(BipedCfg.control):  # [M], by motor: 5020; 4010; 7520-14; 7520-22; two 5020
        stiffness = {"": 14.25, "wrist_pitch": 16.78, "wrist_yaw": 16.78, "hip": 40.18, "waist_yaw": 40.18,  # [N m/rad]
                     "hip_roll": 99.1, "knee": 99.1, "ankle": 28.5, "waist": 28.5}  # fmt: skip
        damping = {"": 0.907, "wrist_pitch": 1.07, "wrist_yaw": 1.07, "hip": 2.56, "waist_yaw": 2.56,  # [N m s/rad]
                   "hip_roll": 6.31, "knee": 6.31, "ankle": 1.81, "waist": 1.81}  # fmt: skip
        action_scale = {"": 0.44, "wrist_pitch": 0.075, "wrist_yaw": 0.075, "hip": 0.55, "waist_yaw": 0.55,  # [rad]
                        "hip_roll": 0.35, "knee": 0.35, "ankle": 0.44, "waist": 0.44}  # fmt: skip
        decimation = 4

    class rewards(BipedCfg.rewards):
        # [ours]
        pose_weights = {
            "": 0.3,
            "hip_pitch": 0.02,
            "knee": 0.02,
            "ankle": 0.05,
            "hip_roll": 0.5,
            "hip_yaw": 0.5,
            "waist": 1.0,
        }

    class exam(BipedCfg.exam):
        peer = "g1"

    class sim(BipedCfg.sim):
        dt, ls_iterations = 0.005, 10  # [s] [M: 5 ms]


TASK = Task(LeggedRobot, G1FlatCfg, BipedCfgPPO)
