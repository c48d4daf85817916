"""Unitree G1 with 29 joints gets up after any fall and stays standing; randomized worlds."""

from configs.base import BipedGetupCfg, BipedGetupCfgPPO
from configs.robots.g1 import G1, SCALE
from legged_mw.skills.getup import Getup
from legged_mw.utils.task import Task


class G1GetupCfg(G1, BipedGetupCfg):
    class falls(BipedGetupCfg.falls):
        pull_on = "torso_link"  # [ours: lifted at the pelvis, it hangs head down]

    class normalization(BipedGetupCfg.normalization):
        clip_actions = 8.0  # [ours: folded knees are 2.6 rad away]

    class control(G1.control, BipedGetupCfg.control):
        # [UL: with [M]'s 28.5 it leaned on the end of its range, as the torso topples with 22 N m/rad]
        stiffness = {**G1.control.stiffness, "waist": 200.0}  # [N m/rad]
        damping = {**G1.control.damping, "waist": 5.0}  # [N m s/rad]
        action_scale = {**SCALE, "waist": 0.1}

    class rewards(BipedGetupCfg.rewards):
        pose_weights = {"": 0.3, "hip": 1.0, "knee": 1.0, "waist": 1.0}  # [ours]


TASK = Task(Getup, G1GetupCfg, BipedGetupCfgPPO)
