"""Unitree Go2 follows a joystick on flat ground, without measured velocity; randomized worlds, kicks and pushes."""

from configs.base import SimToRealCfg, SimToRealCfgPPO
from configs.robots.go2 import WalkingGo2
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go2FlatCfg(WalkingGo2, SimToRealCfg):
    class commands(SimToRealCfg.commands):
        class ranges(SimToRealCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-2.0, 2.0], [-1.0, 1.0], [-2.0, 2.0]  # [m/s], [m/s], [rad/s]


TASK = Task(LeggedRobot, Go2FlatCfg, SimToRealCfgPPO)
