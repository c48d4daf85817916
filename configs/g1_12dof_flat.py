"""Unitree G1 walks with its legs only; waist and arms are held, as on Unitree's G1 with 12 joints."""

from configs.base import LevelBipedCfg, LevelBipedCfgPPO
from configs.robots.g1 import UprightG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G112DofFlatCfg(UprightG1, LevelBipedCfg):
    class asset(UprightG1.asset):
        held_joints = ["waist_*", "*_shoulder_*", "*_elbow_*", "*_wrist_*"]

    class rewards(UprightG1.rewards, LevelBipedCfg.rewards):
        class scales(LevelBipedCfg.rewards.scales):
            orientation, trunk_orientation = -20.0, 0.0  # its torso is fixed to its pelvis


TASK = Task(LeggedRobot, G112DofFlatCfg, LevelBipedCfgPPO)
