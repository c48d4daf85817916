"""go1_rough with a height scan: the policy observes the height of the ground on a grid around it, with noise."""

from configs.go1_rough import Go1RoughCfg, Go1RoughCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go1RoughScanCfg(Go1RoughCfg):
    class terrain(Go1RoughCfg.terrain):
        height_scan = ["state", "privileged_state"]


TASK = Task(LeggedRobot, Go1RoughScanCfg, Go1RoughCfgPPO)
