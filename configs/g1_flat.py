"""Unitree G1 (29 joints) follows a joystick on flat ground, without measured velocity; randomized worlds, pushes."""

from configs.base import LevelBipedCfg, LevelBipedCfgPPO
from configs.robots.g1 import UprightG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G1FlatCfg(UprightG1, LevelBipedCfg):
    class rewards(UprightG1.rewards, LevelBipedCfg.rewards):
        # it need not stay at 0, since trunk_orientation prices the torso [ours: docs/archive/go2_and_g1.md, a level torso]
        deviation_weights = {**UprightG1.rewards.deviation_weights, "waist": 0.2}


TASK = Task(LeggedRobot, G1FlatCfg, LevelBipedCfgPPO)
