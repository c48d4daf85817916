"""go2_rough with a height scan: the policy observes the height of the ground on a grid around it, with noise."""

from configs.base import SimToRealRoughCfgPPO
from configs.go2_rough import Go2RoughCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go2RoughScanCfg(Go2RoughCfg):
    class observations(Go2RoughCfg.observations):
        history = {}  # none: a step is seen

    class terrain(Go2RoughCfg.terrain):
        height_scan = ["state", "privileged_state"]


TASK = Task(LeggedRobot, Go2RoughScanCfg, SimToRealRoughCfgPPO)
