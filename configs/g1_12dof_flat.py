"""g1_flat with the legs alone: waist and arms are held, as on Unitree's G1 with 12 joints."""

from configs.base import BipedCfgPPO
from configs.g1_flat import G1FlatCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class G112DofFlatCfg(G1FlatCfg):
    class asset(G1FlatCfg.asset):
        held_joints = ["waist_*", "*_shoulder_*", "*_elbow_*", "*_wrist_*"]


TASK = Task(LeggedRobot, G112DofFlatCfg, BipedCfgPPO)
