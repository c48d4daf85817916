"""Unitree Go1 stands up on its rear legs and stays there; randomized worlds."""

from configs.base import UnitreeFootstandCfg
from configs.robots.go1 import Go1
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go1FootstandCfg(Go1, UnitreeFootstandCfg):
    class asset(Go1.asset, UnitreeFootstandCfg.asset):
        terminate_after_contacts_on = ["trunk", "R?_hip*", "R?_thigh*", "R?_calf*"]

    class exam(UnitreeFootstandCfg.exam):
        height = 0.53  # [m] [P]


TASK = Task(Handstand, Go1FootstandCfg, HandstandCfgPPO)
