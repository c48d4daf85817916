"""Unitree Go2 stands up on its rear legs and stays there; randomized worlds. The machine's figures are in go2.xml."""

from configs.go1_footstand import Go1FootstandCfg
from configs.go2_handstand import Go2HandstandCfg
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go2FootstandCfg(Go2HandstandCfg):
    class asset(Go2HandstandCfg.asset):
        terminate_after_contacts_on = ["base", "R?_hip*", "R?_thigh*", "R?_calf*"]
        penalize_contacts_on = Go1FootstandCfg.asset.penalize_contacts_on

    class exam(Go2HandstandCfg.exam):
        nose, height, hands = Go1FootstandCfg.exam.nose, Go1FootstandCfg.exam.height, Go1FootstandCfg.exam.hands

    class rewards(Go2HandstandCfg.rewards):
        deviation_weights = Go1FootstandCfg.rewards.deviation_weights


TASK = Task(Handstand, Go2FootstandCfg, HandstandCfgPPO)
