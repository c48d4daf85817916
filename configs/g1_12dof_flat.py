"""Unitree G1 walks with its legs only; waist and arms are held, as on Unitree's G1 with 12 joints."""

from configs.base import UprightBipedCfg, UprightBipedCfgPPO
from configs.robots.g1 import WalkingG1
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G112DofFlatCfg(WalkingG1, UprightBipedCfg):
    class asset(WalkingG1.asset):
        held_joints = ["waist_*", "*_shoulder_*", "*_elbow_*", "*_wrist_*"]

    class rewards(WalkingG1.rewards, UprightBipedCfg.rewards):
        min_feet_distance = 0.2  # [m]
        pose_weights = {"": 1.5, "hip_pitch": 0.14, "knee": 0.14, "ankle_roll": 3.4}  # [M]


TASK = Task(LeggedRobot, G112DofFlatCfg, UprightBipedCfgPPO)
