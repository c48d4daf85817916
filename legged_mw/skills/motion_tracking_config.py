"""The fields of motion tracking, in addition to RobotTask's, with type, unit and source.

Source: BeyondMimic (arXiv 2508.08241), as its code and mjlab's have it; [ours] with the reason.
"""

from __future__ import annotations

from typing import Annotated

from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.utils.bounds import THREE, Bound, Duration, NonNegative, Positive, PositiveShare, Seconds
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

FileNames = list[Annotated[str, Bound("the name of a file", bool)]]
NonNegativeVector = Annotated[list[NonNegative], THREE]
_BEGINNINGS = {  # fields of init_state that have no effect, as episodes begin in a clip -> fields of motion instead
    "pos_xy_range": "start_pos",
    "yaw_range": "start_turn",
    "lin_vel_range": "start_lin_vel",
    "ang_vel_range": "start_ang_vel",
    **dict.fromkeys(["dof_pos_range", "dof_pos_offset", "dof_vel_range"], "start_joints"),
}


class MotionTrackingCfg(RobotTaskCfg):
    """Motion tracking of reference clips."""

    class env(RobotTaskCfg.env):
        episode_length_s = 10.0

    class motion:
        clips: FileNames = []  # .npz files from `python -m legged_mw.motion --out`; any frame rate
        bodies: list[str] = []  # bodies that are compared with the reference
        anchor: str = ""  # the body relative to which they are compared
        end_bodies: list[str] = []  # bodies whose height error beyond max_end_height is a fall
        # episodes begin anywhere in the clips, by the bins below; False: at the first clip's first frame
        random_start: bool = True
        hold_s: Duration = 1.0  # duration of the held last frame, before the time out [s] [ours: as deploy]
        bin_s: Seconds = 1.0  # length of a bin [s]
        failure_rate: PositiveShare = 0.001  # weight of a step in the moving average of failures per bin
        # share of the episodes that begin in any bin [-] [ours: B's code adds it to failures, where it is negligible]
        uniform: PositiveShare = 0.1
        # offsets from the reference as an episode begins, each U(-range, range): x, y, z [m]
        start_pos: NonNegativeVector = [0.05, 0.05, 0.01]
        start_turn: NonNegativeVector = [0.1, 0.1, 0.2]  # about x, y, z [rad]
        start_lin_vel: NonNegativeVector = [0.5, 0.5, 0.2]  # [m/s]
        start_ang_vel: NonNegativeVector = [0.52, 0.52, 0.78]  # [rad/s]
        start_joints: NonNegative = 0.1  # of each joint, within its soft limits [rad]

    class termination(RobotTaskCfg.termination):
        max_anchor_height: Positive = 0.25  # height error of the anchor; a larger one is a fall [m]
        max_anchor_tilt: Positive = 0.8  # tilt error of the anchor: difference of z components of the z axes [-]
        max_end_height: Positive = 0.25  # height error of an end body [m]

    class rewards(RobotTaskCfg.rewards):
        only_positive_rewards = False
        soft_dof_pos_limit = 0.9
        anchor_pos_sigma: Positive = 0.3  # a term is exp(-(error / sigma)^2) [m]
        anchor_ori_sigma: Positive = 0.4  # [rad]
        body_pos_sigma: Positive = 0.3  # error: root mean square over the bodies [m]
        body_ori_sigma: Positive = 0.4  # [rad]
        body_lin_vel_sigma: Positive = 1.0  # [m/s]
        body_ang_vel_sigma: Positive = 3.14  # [rad/s]

        class scales(RobotTaskCfg.rewards.scales):
            tracking_anchor_pos: float = 0.5
            tracking_anchor_ori: float = 0.5
            tracking_body_pos: float = 1.0
            tracking_body_ori: float = 1.0
            tracking_body_lin_vel: float = 1.0
            tracking_body_ang_vel: float = 1.0
            action_rate: float = -0.1
            dof_pos_limits: float = -10.0

    class noise(RobotTaskCfg.noise):
        class scales(RobotTaskCfg.noise.scales):
            lin_vel, dof_pos, dof_vel = 0.5, 0.01, 0.5
            anchor_pos: NonNegative = 0.25  # [m]
            anchor_ori: NonNegative = 0.05  # of an entry of the rotation matrix [-]

    def check(self) -> None:
        super().check()
        motion = self.motion
        for field, names in (("anchor", [motion.anchor]), ("end_bodies", motion.end_bodies)):
            for name in names:
                if name not in motion.bodies:
                    raise ConfigError(f"motion.{field}: {unknown('body', name, motion.bodies, 'motion.bodies')}")
        if not motion.clips:
            mend = "name a clip, as python -m legged_mw.motion FILE --out CLIP.npz writes it"
            raise ConfigError(f"motion.clips is empty; {mend}")
        given, default = self.init_state, MotionTrackingCfg.init_state
        if unread := [name for name in _BEGINNINGS if getattr(given, name) != getattr(default, name)]:
            names, instead = ", ".join(unread), ", ".join(dict.fromkeys(_BEGINNINGS[name] for name in unread))
            why = "not read here, as episodes begin in a motion"
            raise ConfigError(f"init_state: {names}: {why}; leave out, and write motion: {instead}")
