"""Unitree G1 (29 joints) follows a joystick on flat ground, without measured velocity; randomized worlds, pushes."""

from configs.base import BipedCfg, BipedCfgPPO
from configs.robots.g1 import WalkingG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G1FlatCfg(WalkingG1, BipedCfg):
    pass


TASK = Task(LeggedRobot, G1FlatCfg, BipedCfgPPO)
