"""Unitree Go2 follows a joystick over slopes, stairs and blocks that it does not see, without knowing its velocity.

Sources: as configs/go1_rough.py, whose ground it walks on.
"""

from configs.go1_rough import Go1RoughCfg
from configs.go2_flat import Go2FlatCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.sim_to_real_config import SimToRealRoughCfgPPO
from legged_mw.utils.task import Task


class Go2RoughCfg(Go2FlatCfg):
    class commands(Go2FlatCfg.commands):
        curriculum = False  # the ground's is enough

        class ranges(Go2FlatCfg.commands.ranges):
            lin_vel_x, lin_vel_y, ang_vel_yaw = [-1.0, 1.0], [-0.5, 0.5], [-1.0, 1.0]  # [m/s], [m/s], [rad/s]

    class terrain(Go1RoughCfg.terrain):
        pass

    class termination(Go1RoughCfg.termination):
        pass

    class rewards(Go2FlatCfg.rewards):
        tracking_sigma, swing_height = 0.25, 0.15  # [-], [m]
        pose_weights = {"hip": 1.0, "thigh": 0.5, "calf": 0.1}

        class scales(Go2FlatCfg.rewards.scales):
            orientation, lin_vel_z, feet_clearance = -1.0, -0.2, -1.0


TASK = Task(LeggedRobot, Go2RoughCfg, SimToRealRoughCfgPPO)
