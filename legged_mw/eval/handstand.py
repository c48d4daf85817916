"""The exam `handstand`: rise from four legs to a handstand or footstand and hold it for 5 s.

Needs only numpy and MuJoCo.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import mujoco
import numpy as np

from legged_mw.eval.skill import ExamGround, ExamRobot, Floats, Measure, Recording, Skill
from legged_mw.skills.clip import rotate

SEED, OFFSET = 30_000, 0.05  # of the starts: each joint angle is offset by U(-OFFSET, OFFSET) [rad] [ours]
WITHIN, HOLD = 3.0, 5.0  # [s] time limit for rising, time to hold [ours]
# The robot is up: [deg] largest angle from the root's x axis to the vertical, least share of the height [ours].
TILT, HIGH = 30.0, 0.8


@dataclass(frozen=True)
class HandstandExam(Skill):
    """64 attempts on each ground."""

    nose: float = -1.0  # direction of the root's x axis: -1 down, 1 up
    height: float = 0.55  # [m] of the root
    hands: tuple[str, ...] | list[str] = ()  # geoms that may touch the ground

    kind = "handstand"
    asks = "64 tries from standing on each ground: within 3 s it is up for 5 s, and nothing but the hands touches the ground"
    grounds: ClassVar = {"plane": ExamGround(), "slippery": ExamGround(friction=0.4), "loaded": ExamGround(load=1.0)}
    robots = 64
    measures = (
        Measure("holds", "share that holds for 5 s", 3, (0.95, 0.9)),
        Measure("up", "share that comes up", 3),
        Measure("median", "time until up, median [s]", 2),
        Measure("drift", "drift of the hands in 5 s, mean [m]", 3),
        Measure("power", "power while up, mean [W]", 0),
    )

    @property
    def seconds(self) -> float:
        return WITHIN + HOLD

    def starts(self, robot: ExamRobot, count: int) -> tuple[Floats, Floats]:
        qpos = np.tile(robot.home, (count, 1))
        qpos[:, 7:] += np.random.default_rng(SEED).uniform(-OFFSET, OFFSET, (count, robot.model.nq - 7))
        return qpos, np.zeros((count, robot.model.nv))

    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        touching, hands = self._ground_contact(robot, recording.qpos)
        ahead = rotate(recording.qpos[..., 3:7], np.array([1.0, 0.0, 0.0]))  # the root's x axis in the world frame
        upright = self.nose * ahead[..., 2] > np.cos(np.radians(TILT))
        alive = np.arange(len(touching))[:, None] <= recording.ended_at
        up = upright & (recording.qpos[..., 2] > HIGH * self.height) & ~touching & alive  # (T, N)
        hold = round(HOLD / robot.dt)
        held = np.asarray(np.lib.stride_tricks.sliding_window_view(up, hold, axis=0).all(axis=2))  # (T - hold + 1, N)
        holds, begin = held.any(axis=0), held.argmax(axis=0)
        each = np.arange(len(recording.ended_at))
        drift = np.linalg.norm(hands[begin + hold - 1, each] - hands[begin, each], axis=1)
        power = np.abs(recording.torque * recording.qvel[..., 6:]).sum(axis=2)  # (T, N)
        return {
            "holds": float(holds.mean()),
            "up": float(up.any(axis=0).mean()),
            "median": float(np.median(begin[holds]) * robot.dt) if holds.any() else None,
            "drift": float(drift[holds].mean()) if holds.any() else None,
            "power": float(power[up].mean()) if up.any() else None,
            # a robot that failed, else the one that drifted most
            "worst": int(np.argmax(np.where(holds, drift, np.inf))),
        }

    def _ground_contact(self, robot: ExamRobot, qpos: Floats) -> tuple[np.ndarray, np.ndarray]:
        """(T, N): a geom other than the hands touches the ground. (T, N, 2): the midpoint of the hands [m]."""
        model, data = robot.model, mujoco.MjData(robot.model)
        free = np.array([model.geom(name).id for name in self.hands])
        steps, count = len(qpos), qpos.shape[1]
        touching, middle = np.zeros((steps, count), dtype=bool), np.zeros((steps, count, 2))
        for at in np.ndindex(steps, count):
            data.qpos = qpos[at]
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mj_collision(model, data)
            pairs = data.contact.geom
            ground = (model.geom_bodyid[pairs] == 0).any(axis=1)
            touching[at] = bool((ground & ~np.isin(pairs, free).any(axis=1)).any())
            middle[at] = data.geom_xpos[free, :2].mean(axis=0)
        return touching, middle
