"""Unitree G1 follows a joystick over slopes and low stairs, without height scan and measured velocity."""

from configs.base import BipedRoughCfg, BipedRoughCfgPPO
from configs.robots.g1 import WalkingG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G1RoughCfg(WalkingG1, BipedRoughCfg):
    class termination(BipedRoughCfg.termination):
        min_base_height = 0.4  # [m] of 0.79, because only the feet touch the ground


TASK = Task(LeggedRobot, G1RoughCfg, BipedRoughCfgPPO)
