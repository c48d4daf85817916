"""Unitree Go1 stands up on its rear legs and stays there; randomized worlds.

Source [P]: MuJoCo Playground's Go1 footstand, which ends on the front legs' geoms; here, as in a handstand, on those that stand.
"""

from configs.go1_handstand import Go1HandstandCfg
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go1FootstandCfg(Go1HandstandCfg):
    class asset(Go1HandstandCfg.asset):
        terminate_after_contacts_on = ["trunk", "R?_hip*", "R?_thigh*", "R?_calf*"]
        penalize_contacts_on = ["FR*", "FL*"]

    class exam(Go1HandstandCfg.exam):
        nose, height, hands = 1.0, 0.53, ["RR", "RL"]  # [-], [m] [P]

    class rewards(Go1HandstandCfg.rewards):
        deviation_weights = {"": 0.0, "FR_": 1.0, "FL_": 1.0}  # the legs in the air [P]


TASK = Task(Handstand, Go1FootstandCfg, HandstandCfgPPO)
