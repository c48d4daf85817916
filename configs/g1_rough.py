"""Unitree G1 follows a joystick over slopes and low stairs that it does not see, without knowing its velocity."""

from configs.g1_flat import G1FlatCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.sim_to_real_config import BipedRoughCfgPPO
from legged_mw.utils.task import Task


class G1RoughCfg(G1FlatCfg):
    class terrain(G1FlatCfg.terrain):
        mesh_type = "heightfield"
        height_scan = ["privileged_state"]  # the critic sees the ground, the robot does not
        difficulty = [0.0, 0.6]  # [ours: stairs up to 14 cm]

    class termination(G1FlatCfg.termination):
        min_base_height = 0.4  # [m] of 0.79: the feet alone touch the ground

    class rewards(G1FlatCfg.rewards):
        swing_height = 0.12  # [m]


TASK = Task(LeggedRobot, G1RoughCfg, BipedRoughCfgPPO)
