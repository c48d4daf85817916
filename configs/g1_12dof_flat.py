"""Unitree G1 walks with its legs only; waist and arms are held, as on Unitree's G1 with 12 joints.

Its gains are WalkingG1's, with which the policy that ships was trained.
"""

from configs.base import UprightBipedCfg, UprightBipedCfgPPO
from configs.robots.g1 import UprightG1, WalkingG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G112DofFlatCfg(WalkingG1, UprightBipedCfg):
    class asset(WalkingG1.asset):
        held_joints = ["waist_*", "*_shoulder_*", "*_elbow_*", "*_wrist_*"]

    class rewards(UprightG1.rewards, UprightBipedCfg.rewards):
        pass


TASK = Task(LeggedRobot, G112DofFlatCfg, UprightBipedCfgPPO)
