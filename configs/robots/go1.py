"""Unitree Go1, four legs, 12 joints: for any task, and for walking. Masses, motors and ranges are in go1.xml.

Source: [P] MuJoCo Playground's tasks for this robot.
"""

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task_config import RobotTaskCfg


class Go1(RobotTaskCfg):
    class asset(RobotTaskCfg.asset):
        file = "resources/robots/go1/go1.xml"
        imu_site = "imu"
        # Unitree's go1.urdf has 30.1 for all, at 23.7 N m; a lever of 1.5 gives the calf 35.55 N m and less speed
        joint_speed_limits = {"hip": 30.1, "thigh": 30.1, "calf": 20.06}  # [rad/s]

    class init_state(RobotTaskCfg.init_state):
        pos = [0.0, 0.0, 0.278]  # [m] [P]
        default_joint_angles = {  # [rad] [P]
            **{"FR_hip": 0.1, "FL_hip": -0.1, "RR_hip": 0.1, "RL_hip": -0.1},
            **{"thigh": 0.9, "calf": -1.8},
        }

    class control(RobotTaskCfg.control):
        stiffness = {"joint": 35.0}  # [N m/rad] [P]
        damping = {"joint": 0.5}  # [N m s/rad] [P]

    class ratings(RobotTaskCfg.ratings):
        # Of the motors (GO-M8010-6) and the battery no other figure is known to us: docs/heat.md
        top_speed = {"hip": 30.1, "thigh": 30.1, "calf": 20.06}  # [rad/s], of joint_speed_limits


class WalkingGo1(Go1, LeggedRobotCfg):
    class asset(Go1.asset, LeggedRobotCfg.asset):
        foot_names = ["FR", "FL", "RR", "RL"]
        colliders = ["FR", "FL", "RR", "RL"]  # the feet alone touch the ground [P]

    class rewards(LeggedRobotCfg.rewards):
        pose_weights = {"hip": 1.0, "thigh": 1.0, "calf": 0.1}  # [P]

    class exam(LeggedRobotCfg.exam):
        peer = "go1"
