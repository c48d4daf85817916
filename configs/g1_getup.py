"""Unitree G1 with 29 joints gets up after any fall and stays standing; randomized worlds."""

from configs.base import BipedGetupCfg, BipedGetupCfgPPO
from configs.robots.g1 import FirmWaistG1
from legged_mw.skills.getup import Getup
from legged_mw.utils.task import Task


class G1GetupCfg(FirmWaistG1, BipedGetupCfg):
    class falls(BipedGetupCfg.falls):
        pull_on = "torso_link"  # [ours: lifted at the pelvis, it hangs head down]

    class normalization(BipedGetupCfg.normalization):
        clip_actions = 8.0  # [ours: folded knees are 2.6 rad away]

    class rewards(BipedGetupCfg.rewards):
        pose_weights = {"": 0.3, "hip": 1.0, "knee": 1.0, "waist": 1.0}  # [ours]


TASK = Task(Getup, G1GetupCfg, BipedGetupCfgPPO)
