"""Unitree G1 follows a joystick over slopes and stairs, without height scan and measured velocity: --init g1_flat."""

from configs.base import LevelBipedRoughCfg, LevelBipedRoughCfgPPO
from configs.robots.g1 import UprightG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G1RoughCfg(UprightG1, LevelBipedRoughCfg):
    class rewards(UprightG1.rewards, LevelBipedRoughCfg.rewards):
        min_feet_distance = 0.24  # [m] [ours]
        deviation_weights = {**UprightG1.rewards.deviation_weights, "waist": 0.2}  # [ours: as g1_flat]

    class termination(LevelBipedRoughCfg.termination):
        min_base_height = 0.4  # [m] of 0.79, because only the feet touch the ground


TASK = Task(LeggedRobot, G1RoughCfg, LevelBipedRoughCfgPPO)
