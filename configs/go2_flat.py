"""Unitree Go2 trots by a joystick on flat ground, without measured velocity; randomized worlds, kicks and pushes."""

from configs.base import SimToRealCfgPPO, TrotCfg
from configs.robots.go2 import RandomGo2
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go2FlatCfg(RandomGo2, TrotCfg):
    class commands(TrotCfg.commands):
        curriculum_step = 0.3  # [ours: docs/archive/go2_and_g1.md, five seeds]

        class ranges(TrotCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-2.0, 2.0], [-1.0, 1.0], [-2.0, 2.0]  # [m/s], [m/s], [rad/s]


TASK = Task(LeggedRobot, Go2FlatCfg, SimToRealCfgPPO)
