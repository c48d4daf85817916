"""Unitree G1 with 29 joints tracks a motion, a held side kick, without measured position and velocity.

With state estimation, as in BeyondMimic: --set "observations.leave_out={}" (docs/motions.md).
"""

from configs.base import TrackingCfg, TrackingCfgPPO
from configs.robots.g1 import TrackedG1
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.utils.task import Task


class G1TrackCfg(TrackedG1, TrackingCfg):
    class motion(TrackedG1.motion):
        clips = ["resources/motions/g1_kick.npz"]


TASK = Task(MotionTracking, G1TrackCfg, TrackingCfgPPO)
