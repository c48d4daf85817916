"""Unitree Go2, four legs, 12 joints: for any task, and for walking. Masses, motors and ranges are in go2.xml.

Sources: [U] Unitree's own training configs for this robot; [P] MuJoCo Playground's Go1; [ours] docs/lab.md.
"""

from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.robot_task_config import RobotTaskCfg


class Go2(RobotTaskCfg):
    class asset(RobotTaskCfg.asset):
        file = "resources/robots/go2/go2.xml"
        joint_speed_limits = {"hip": 30.1, "thigh": 30.1, "calf": 15.7}  # [rad/s] [U]

    class init_state(RobotTaskCfg.init_state):
        pos = [0.0, 0.0, 0.33]  # [m]
        default_joint_angles = {  # [rad] [U]
            **{"R_hip": -0.1, "L_hip": 0.1, "thigh": 0.8},
            **{"RR_thigh": 1.0, "RL_thigh": 1.0, "calf": -1.5},
        }

    class control(RobotTaskCfg.control):
        stiffness = {"": 20.0}  # [N m/rad] [U]
        damping = {"": 0.5}  # [N m s/rad] [U]

    class ratings(RobotTaskCfg.ratings):
        # Unitree's unitree_rl_lab, unitree_actuators.py, "Go2HV"; a calf's by its lever, 1.917, as its limits of 45.43 N m
        # and 15.7 rad/s are. Of motors and battery no other figure is known to us: docs/heat.md
        peak_torque = {"": 20.2, "calf": 38.7}  # [N m]
        knee_speed = {"": 13.5, "calf": 7.04}  # [rad/s]
        top_speed = {"": 30.0, "calf": 15.65}  # [rad/s]


class WalkingGo2(Go2, LeggedRobotCfg):
    class asset(Go2.asset, LeggedRobotCfg.asset):
        foot_names = ["FR", "FL", "RR", "RL"]
        colliders = ["FR", "FL", "RR", "RL"]  # the feet alone touch the ground

    class control(Go2.control):
        action_scale = 0.25  # [rad] [U]

    class normalization(LeggedRobotCfg.normalization):
        clip_actions = 5.0  # [ours: 25 N m, the motors' limit]

    class rewards(LeggedRobotCfg.rewards):
        pose_weights = {"hip": 1.0, "thigh": 1.0, "calf": 0.1}  # [P]

    class exam(LeggedRobotCfg.exam):
        peer = "go2"


class RandomGo2(WalkingGo2):
    """Motors of up to about a real Go2's published numbers (docs/fit.md); a calf's armature begins at 0.018, not 0.01."""

    class asset(WalkingGo2.asset):
        armature = {"hip": 0.0135, "thigh": 0.015, "calf": 0.03}  # [kg m^2] between go2.xml's and the published

    class domain_rand(WalkingGo2.domain_rand):
        armature, frictionloss = [0.6, 1.75], [0.8, 3.5]  # [-]
        stiffness, damping = [0.8, 1.2], [0.8, 1.8]  # [-] from 0.8 and to 1.2 as in the hard exam
        base_mass = [-1.0, 4.0]  # [kg]
