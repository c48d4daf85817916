"""Unitree Go1 stands up on its front legs and stays there; randomized worlds.

Sources: [P] MuJoCo Playground's Go1 handstand; the machine's figures are in go1.xml.
"""

from configs.go1_flat import Go1FlatCfg
from legged_mw.skills.handstand import Handstand, HandstandCfg, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go1HandstandCfg(HandstandCfg):
    class asset(HandstandCfg.asset):
        file, imu_site = Go1FlatCfg.asset.file, Go1FlatCfg.asset.imu_site
        joint_speed_limits = Go1FlatCfg.asset.joint_speed_limits
        terminate_after_contacts_on = ["trunk", "F?_hip*", "F?_thigh*", "F?_calf*"]  # [P]
        penalize_contacts_on = ["RR*", "RL*"]

    class init_state(HandstandCfg.init_state):
        pos, default_joint_angles = Go1FlatCfg.init_state.pos, Go1FlatCfg.init_state.default_joint_angles

    class control(HandstandCfg.control):
        stiffness, damping = Go1FlatCfg.control.stiffness, Go1FlatCfg.control.damping

    class exam(HandstandCfg.exam):
        hands = ["FR", "FL"]

    class rewards(HandstandCfg.rewards):
        deviation_weights = {"": 0.0, "RR_": 1.0, "RL_": 1.0}  # the legs in the air [P]


TASK = Task(Handstand, Go1HandstandCfg, HandstandCfgPPO)
