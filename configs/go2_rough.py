"""Unitree Go2 trots by command over slopes, stairs and blocks, without height scan and measured velocity."""

from configs.base import SimToRealRoughCfgPPO, TrotRoughCfg
from configs.robots.go2 import WalkingGo2
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go2RoughCfg(WalkingGo2, TrotRoughCfg):
    class commands(TrotRoughCfg.commands):
        class ranges(TrotRoughCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]  # [m/s], [m/s], [rad/s]

    class rewards(WalkingGo2.rewards, TrotRoughCfg.rewards):
        pose_weights = {"hip": 1.0, "thigh": 0.5, "calf": 0.1}  # [P 1, 1, 0.1] [ours: a high step lifts the thigh]


TASK = Task(LeggedRobot, Go2RoughCfg, SimToRealRoughCfgPPO)
