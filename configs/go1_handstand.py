"""Unitree Go1 stands up on its front legs and stays there; randomized worlds."""

from configs.base import UnitreeHandstandCfg
from configs.robots.go1 import Go1
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go1HandstandCfg(Go1, UnitreeHandstandCfg):
    class asset(Go1.asset, UnitreeHandstandCfg.asset):
        terminate_after_contacts_on = ["trunk", "F?_hip*", "F?_thigh*", "F?_calf*"]  # [P]

    class exam(UnitreeHandstandCfg.exam):
        height = 0.55  # [m] [P]


TASK = Task(Handstand, Go1HandstandCfg, HandstandCfgPPO)
