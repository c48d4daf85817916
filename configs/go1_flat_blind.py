"""go1_flat without the velocity, which the robot does not measure: 45 values; the critic has it."""

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1FlatBlindCfg(Go1FlatCfg):
    class observations(Go1FlatCfg.observations):
        leave_out = {"state": ["base_lin_vel"]}  # no sensor measures it


TASK = Task(LeggedRobot, Go1FlatBlindCfg, Go1FlatCfgPPO)
