"""The motion that an exported policy follows, as the contract states it; its frames are in a file beside the network."""

from __future__ import annotations

from typing import Any, NamedTuple

from legged_mw.deploy.reader import Reader

MOTION, MOTION_FILE = "motion", "motion.npz"  # the contract's section; the file, as legged_mw.skills.clip has it
JOINT_POS, JOINT_VEL, PLACE, TURN = "reference_joint_pos", "reference_joint_vel", "anchor_pos", "anchor_ori"
REFERENCE = (JOINT_POS, JOINT_VEL, PLACE, TURN)  # what the controller makes of it
# in Measurement.others: of the root, (4,) w x y z, and (3,) [m], world frame
ATTITUDE, POSITION = "attitude", "position"


class FollowedMotion(NamedTuple):
    """What is followed: at the anchor, and with which bodies."""

    anchor: str
    bodies: tuple[str, ...]  # that were compared in training
    digest: str  # SHA-256 of MOTION_FILE

    def to_dict(self) -> dict[str, Any]:
        return {"file": MOTION_FILE, "sha256": self.digest, "anchor": self.anchor, "bodies": list(self.bodies)}


def read_motion(section: Reader) -> FollowedMotion:
    """From the contract's reader of the section."""
    bodies = section.texts("bodies")
    section.file("file", MOTION_FILE)
    return FollowedMotion(
        section.take("anchor", "one of `bodies`", lambda v: v in bodies), bodies, section.text("sha256")
    )
