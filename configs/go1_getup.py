"""Unitree Go1 gets up after any fall and stays standing; randomized worlds."""

from configs.robots.go1 import Go1
from legged_mw.skills.getup import Getup, GetupCfg, GetupCfgPPO
from legged_mw.utils.task import Task


class Go1GetupCfg(Go1, GetupCfg):
    pass


TASK = Task(Getup, Go1GetupCfg, GetupCfgPPO)
