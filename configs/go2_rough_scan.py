"""Unitree Go2 trots over slopes, stairs and blocks whose heights it observes on a grid around it, with noise."""

from configs.base import SimToRealRoughCfgPPO, TrotRoughCfg
from configs.go2_rough import Go2RoughCfg
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Go2RoughScanCfg(TrotRoughCfg, Go2RoughCfg):
    class terrain(TrotRoughCfg.terrain, Go2RoughCfg.terrain):
        height_scan = ["state", "privileged_state"]


class Go2RoughScanCfgPPO(SimToRealRoughCfgPPO):
    class runner(SimToRealRoughCfgPPO.runner):
        max_iterations, matmul_precision = 3250, "bf16"  # 639 M steps, 13 minutes as one of two trainings on an H200


TASK = Task(LeggedRobot, Go2RoughScanCfg, Go2RoughScanCfgPPO)
