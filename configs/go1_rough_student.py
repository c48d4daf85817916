"""go1_rough with measured values only, without velocity; go1_rough_scan can be its teacher (docs/training.md)."""

from configs.go1_rough import Go1RoughCfg, Go1RoughCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1RoughStudentCfg(Go1RoughCfg):
    class observations(Go1RoughCfg.observations):
        leave_out = {"state": ["base_lin_vel"]}  # 53 values; the critic has it
        history = {"state": 10}  # frames [genesis_lr]: a step is felt, not seen


TASK = Task(LeggedRobot, Go1RoughStudentCfg, Go1RoughCfgPPO)
