"""Unitree Go2 stands up on its front legs and stays there; randomized worlds. The machine's figures are in go2.xml."""

from configs.go1_handstand import Go1HandstandCfg
from configs.go2_flat import Go2FlatCfg
from legged_mw.skills.handstand import Handstand, HandstandCfgPPO
from legged_mw.utils.task import Task


class Go2HandstandCfg(Go1HandstandCfg):
    class asset(Go1HandstandCfg.asset):
        file, imu_site = Go2FlatCfg.asset.file, Go2FlatCfg.asset.imu_site
        joint_speed_limits = Go2FlatCfg.asset.joint_speed_limits
        terminate_after_contacts_on = ["base", "F?_hip*", "F?_thigh*", "F?_calf*"]

    class init_state(Go1HandstandCfg.init_state):
        pos, default_joint_angles = Go2FlatCfg.init_state.pos, Go2FlatCfg.init_state.default_joint_angles

    class control(Go1HandstandCfg.control):
        stiffness, damping = Go2FlatCfg.control.stiffness, Go2FlatCfg.control.damping


TASK = Task(Handstand, Go2HandstandCfg, HandstandCfgPPO)
