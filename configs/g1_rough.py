"""Unitree G1 follows a joystick over slopes and low stairs that it does not see, without knowing its velocity."""

from configs.base import BipedRoughCfg, BipedRoughCfgPPO
from configs.g1_flat import G1FlatCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G1RoughCfg(BipedRoughCfg, G1FlatCfg):
    class termination(G1FlatCfg.termination):
        min_base_height = 0.4  # [m] of 0.79: the feet alone touch the ground

    class rewards(BipedRoughCfg.rewards, G1FlatCfg.rewards):
        pass


TASK = Task(LeggedRobot, G1RoughCfg, BipedRoughCfgPPO)
