"""Unitree Go2 follows a joystick on flat ground without knowing its velocity; randomized worlds, kicks and pushes."""

from configs.base import SimToRealCfg, SimToRealCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go2FlatCfg(SimToRealCfg):  # [U] Unitree's own training configs for this robot; [ours] docs/lab.md
    class asset(SimToRealCfg.asset):
        file = "resources/robots/go2/go2.xml"
        foot_names = ["FR", "FL", "RR", "RL"]
        colliders = ["FR", "FL", "RR", "RL"]  # the feet alone touch the ground
        joint_speed_limits = {"hip": 30.1, "thigh": 30.1, "calf": 15.7}  # [rad/s] [U]

    class init_state(SimToRealCfg.init_state):
        pos = [0.0, 0.0, 0.33]  # [m]
        # [rad] [U]
        default_joint_angles = {
            "R_hip": -0.1,
            "L_hip": 0.1,
            "thigh": 0.8,
            "RR_thigh": 1.0,
            "RL_thigh": 1.0,
            "calf": -1.5,
        }

    class control(SimToRealCfg.control):
        stiffness = {"": 20.0}  # [N m/rad] [U]
        damping = {"": 0.5}  # [N m s/rad] [U]
        action_scale = 0.25  # [rad] [U]

    class normalization(SimToRealCfg.normalization):
        clip_actions = 5.0  # [ours: 25 N m, what the motors have]

    class commands(SimToRealCfg.commands):
        class ranges(SimToRealCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-2.0, 2.0], [-1.0, 1.0], [-2.0, 2.0]  # [m/s], [m/s], [rad/s]

    class rewards(SimToRealCfg.rewards):
        pose_weights = {"hip": 1.0, "thigh": 1.0, "calf": 0.1}  # [P]

    class exam(SimToRealCfg.exam):
        peer = "go2"


TASK = Task(LeggedRobot, Go2FlatCfg, SimToRealCfgPPO)
