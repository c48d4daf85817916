"""Unitree Go2 gets up after any fall and stays standing; randomized worlds."""

from configs.robots.go2 import Go2
from legged_mw.skills.getup import Getup, GetupCfg, GetupCfgPPO
from legged_mw.utils.task import Task


class Go2GetupCfg(Go2, GetupCfg):
    class control(Go2.control, GetupCfg.control):
        action_scale = 0.9  # [rad] [ours: as much torque as Go1's 0.5; at 2 nearly the knees' limit]


TASK = Task(Getup, Go2GetupCfg, GetupCfgPPO)
