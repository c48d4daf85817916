"""Where each robot is in the motion that its policy follows, and what the policy sees of it."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import SCENE_FILE, Contract, digest, part
from legged_mw.deploy.motion import ATTITUDE, JOINT_POS, JOINT_VEL, MOTION_FILE, PLACE, POSITION, TURN
from legged_mw.deploy.reader import ContractError, compile_scene
from legged_mw.deploy.robot import Measurement
from legged_mw.skills.clip import Clip, Floats, conjugate, heading, multiply, read_clip


class Follower:
    """The phase of ``count`` robots: the frame that each is to reach in the step to come. After the last frame it is held.

    A real robot does not know where in the world it is: as it begins, the motion is moved and turned to where the robot stands.
    """

    def __init__(self, folder: Path, contract: Contract, count: int) -> None:
        """The file that ``contract.motion`` names. Raises ContractError for another one."""
        assert contract.motion
        file = folder / MOTION_FILE
        if not file.is_file() or digest(file) != contract.motion.digest:
            raise ContractError(
                f"{file} is missing, or not the motion that the policy was exported with; export the policy again"
            )
        self.clip: Clip = read_clip(file).at(1.0 / contract.period).of(contract.joints, MOTION_FILE)
        self._model = compile_scene(part(folder, SCENE_FILE))
        self._data, self._anchor = mujoco.MjData(self._model), self._model.body(contract.motion.anchor).id
        self._angles = [int(self._model.joint(name).qposadr[0]) for name in contract.joints]
        # the last frame is held at rest
        speed = np.concatenate([self.clip.qvel()[:, 6:], np.zeros((1, len(contract.joints)))])
        self._joints = np.concatenate([self.clip.joint_pos, self.clip.joint_pos[-1:]]), speed
        place, turn = self._anchors(self.clip.root_pos, self.clip.root_quat, self.clip.joint_pos)
        self._place, self._turn = np.concatenate([place, place[-1:]]), np.concatenate([turn, turn[-1:]])
        self.frame = np.ones(count, dtype=int)
        self.start: NDArray[np.int64] | None = None  # frames to be at instead, in the world's own frame: as in training
        self._shift, self._heading = np.zeros((count, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))

    def rows(self, measured: Measurement, fresh: NDArray[np.bool_]) -> dict[str, Floats]:
        """What the policy sees (N, ...); ``fresh`` (N,) are robots at their first step."""
        place, turn = self._measured(measured)
        shift, turned = self._moved(place, turn, fresh)
        frame = self._now()
        there, wanted = _rotate(turned, self._place[frame]) + shift, multiply(turned, self._turn[frame])
        off = _matrix(multiply(conjugate(turn), wanted))
        rows = {JOINT_POS: self._joints[0][frame], JOINT_VEL: self._joints[1][frame]}
        return rows | {PLACE: _rotate(conjugate(turn), there - place), TURN: off[:, :, :2].reshape(len(off), 6)}

    def keep(self, measured: Measurement, fresh: NDArray[np.bool_]) -> None:
        """A step was made."""
        self._shift, self._heading = self._moved(*self._measured(measured), fresh)
        self.frame = np.minimum(self._now() + 1, len(self._place) - 1)

    def reset(self, which: Any) -> None:
        """The robots ``which`` are at the first frame."""
        self.frame[which] = 1

    def ghost(self) -> Floats:
        """The frames that come next, where the motion was moved to: (N, nq) of the scene."""
        frame = np.minimum(self._now(), len(self.clip.root_pos) - 1)
        states = np.zeros((len(frame), self._model.nq))
        states[:, :3] = _rotate(self._heading, self.clip.root_pos[frame]) + self._shift
        states[:, 3:7], states[:, self._angles] = (
            multiply(self._heading, self.clip.root_quat[frame]),
            self.clip.joint_pos[frame],
        )
        return states

    def _now(self) -> NDArray[np.int64]:
        return np.minimum(self.frame if self.start is None else self.start, len(self._place) - 1)

    def _measured(self, measured: Measurement) -> tuple[Floats, Floats]:
        """Place (N, 3) and attitude (N, 4) of the anchor; from the root's and the joints' measured angles."""
        attitude = np.atleast_2d(measured.others[ATTITUDE])
        root = np.atleast_2d(measured.others.get(POSITION, np.zeros((len(attitude), 3))))
        return self._anchors(root, attitude, np.atleast_2d(measured.joint_pos))

    def _anchors(self, root: Floats, attitude: Floats, joints: Floats) -> tuple[Floats, Floats]:
        place, turn = np.zeros((len(root), 3)), np.zeros((len(root), 4))
        for i in range(len(root)):
            self._data.qpos[:3], self._data.qpos[3:7], self._data.qpos[self._angles] = root[i], attitude[i], joints[i]
            mujoco.mj_kinematics(self._model, self._data)
            place[i], turn[i] = self._data.xpos[self._anchor], self._data.xquat[self._anchor]
        return place, turn

    def _moved(self, place: Floats, turn: Floats, fresh: NDArray[np.bool_]) -> tuple[Floats, Floats]:
        """How the motion is moved (N, 3) and turned (N, 4); where ``fresh``, to the robot's own place and heading."""
        if self.start is not None:
            return self._shift, self._heading
        before = self._now() - 1
        turned = np.where(fresh[:, None], heading(multiply(turn, conjugate(self._turn[before]))), self._heading)
        shift = (place - _rotate(turned, self._place[before])) * [1.0, 1.0, 0.0]
        return np.where(fresh[:, None], shift, self._shift), turned


def _rotate(q: Floats, v: Floats) -> Floats:
    """Vectors (N, 3) turned by ``q`` (N, 4)."""
    return (_matrix(q) @ v[..., None])[..., 0]


def _matrix(q: Floats) -> Floats:
    """(N, 3, 3) of quaternions (N, 4)."""
    matrices = np.zeros((len(q), 9))
    for matrix, each in zip(matrices, q, strict=True):
        mujoco.mju_quat2Mat(matrix, each)
    return matrices.reshape(-1, 3, 3)
