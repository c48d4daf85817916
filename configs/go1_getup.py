"""Unitree Go1 gets up from any fall and stays standing; randomized worlds.

Sources: [P] MuJoCo Playground's Go1 getup; the machine's figures are in go1.xml.
"""

from configs.go1_flat import Go1FlatCfg
from legged_mw.skills.getup import Getup, GetupCfg, GetupCfgPPO
from legged_mw.utils.task import Task


class Go1GetupCfg(GetupCfg):
    class asset(GetupCfg.asset):
        file, imu_site = Go1FlatCfg.asset.file, Go1FlatCfg.asset.imu_site
        joint_speed_limits = Go1FlatCfg.asset.joint_speed_limits

    class init_state(GetupCfg.init_state):
        pos, default_joint_angles = Go1FlatCfg.init_state.pos, Go1FlatCfg.init_state.default_joint_angles

    class control(GetupCfg.control):
        stiffness, damping = Go1FlatCfg.control.stiffness, Go1FlatCfg.control.damping


TASK = Task(Getup, Go1GetupCfg, GetupCfgPPO)
