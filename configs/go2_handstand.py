"""Unitree Go2 stands up on its front legs and stays there; randomized worlds."""

from configs.base import UnitreeHandstandCfg
from configs.robots.go2 import Go2
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go2HandstandCfg(Go2, UnitreeHandstandCfg):
    class asset(Go2.asset, UnitreeHandstandCfg.asset):
        terminate_after_contacts_on = ["base", "F?_hip*", "F?_thigh*", "F?_calf*"]

    class exam(UnitreeHandstandCfg.exam):
        height = 0.55  # [m] [ours: as a Go1's]


TASK = Task(Handstand, Go2HandstandCfg, HandstandCfgPPO)
