"""Unitree Go2 stands up on its rear legs and stays there; randomized worlds."""

from configs.base import UnitreeFootstandCfg
from configs.robots.go2 import Go2
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go2FootstandCfg(Go2, UnitreeFootstandCfg):
    class asset(Go2.asset, UnitreeFootstandCfg.asset):
        terminate_after_contacts_on = ["base", "R?_hip*", "R?_thigh*", "R?_calf*"]

    class exam(UnitreeFootstandCfg.exam):
        height = 0.53  # [m] [ours: as a Go1's]


TASK = Task(Handstand, Go2FootstandCfg, HandstandCfgPPO)
