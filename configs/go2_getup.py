"""Unitree Go2 gets up from any fall and stays standing; randomized worlds. The machine's figures are in go2.xml."""

from configs.go2_flat import Go2FlatCfg
from legged_mw.skills.getup import Getup, GetupCfg, GetupCfgPPO
from legged_mw.utils.task import Task


class Go2GetupCfg(GetupCfg):
    class asset(GetupCfg.asset):
        file = Go2FlatCfg.asset.file
        joint_speed_limits = Go2FlatCfg.asset.joint_speed_limits

    class init_state(GetupCfg.init_state):
        pos, default_joint_angles = Go2FlatCfg.init_state.pos, Go2FlatCfg.init_state.default_joint_angles

    class control(GetupCfg.control):
        stiffness, damping = Go2FlatCfg.control.stiffness, Go2FlatCfg.control.damping
        action_scale = 0.9  # [rad] [ours: as much torque as Go1's 0.5; at 2 nearly what the knees have]


TASK = Task(Getup, Go2GetupCfg, GetupCfgPPO)
