"""Unitree G1 follows a joystick over slopes and low steps, without height scan and measured velocity: --init g1_flat."""

from configs.base import LevelBipedRoughCfg, LevelBipedRoughCfgPPO
from configs.robots.g1 import UprightG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G1RoughCfg(UprightG1, LevelBipedRoughCfg):
    class termination(LevelBipedRoughCfg.termination):
        min_base_height = 0.4  # [m] of 0.79, because only the feet touch the ground


TASK = Task(LeggedRobot, G1RoughCfg, LevelBipedRoughCfgPPO)
