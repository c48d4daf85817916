"""The exam `getup`: from falls that training never saw to standing, on four grounds. Needs numpy and MuJoCo alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from legged_mw.eval.skill import ExamGround, ExamRobot, Floats, Measure, Recording, Skill
from legged_mw.skills.clip import rotate
from legged_mw.skills.drop_states import fallen

SEED, SETTLING = 20_000, 1.5  # of the falls, [s] from the drop; training has seeds of its own: falls.seed
# share of the standing height, [deg] from the vertical, [rad/s] mean joint speed: ours
HIGH, TILT, SLOW = 0.9, 20.0, 0.5
HOLD, STAY = 0.5, 5.0  # [s] that it stands before it counts, [s] after that at which it must still
AT_LIMIT = 0.98  # share of the force limit from which a torque is at it


@dataclass(frozen=True)
class GetupExam(Skill):
    """256 falls on each ground."""

    within: float = 3.0  # [s] in which it must stand

    kind = "getup"
    asks = "256 falls on each ground: it stands high, upright and with joints at rest in time, and 5 s later still does"
    grounds: ClassVar = {
        "plane": ExamGround(),
        "slope": ExamGround(slope=10.0),
        "slippery": ExamGround(friction=0.3),
        "loaded": ExamGround(load=2.0),
    }
    robots = 256
    measures = (
        Measure("stands", "share that stands in time", 3, (0.99, 0.97)),
        Measure("stays", "share that still stands after 5 s", 3, (0.99, 0.97)),
        Measure("median", "time to stand, median [s]", 2),
        Measure("slowest", "time to stand, slowest [s]", 2),
        Measure("energy", "energy until it stands, mean [J]", 0),
        Measure("at_limit", "share of torques at the limit", 3),
    )
    overrides: ClassVar = {"falls.pull": 0.0, "falls.states": 1}  # its falls are those of `starts`

    @property
    def seconds(self) -> float:
        return self.within + STAY + HOLD

    def starts(self, robot: ExamRobot, count: int) -> tuple[Floats, Floats]:
        return fallen(robot.model, count, SEED, SETTLING)

    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        hold, stay, limit = (round(seconds / robot.dt) for seconds in (HOLD, STAY, self.within))
        held = _lasting(standing(robot, recording), hold)  # (T - hold + 1, N) it stands, for HOLD from here on
        up_at = np.where(held.any(axis=0), held.argmax(axis=0), len(held))  # (N,) first step, or never
        up = up_at <= limit
        still = held[np.minimum(up_at + stay, len(held) - 1), np.arange(held.shape[1])] & up
        until = np.arange(len(recording.qpos))[:, None] <= up_at  # (T, N) while it gets up
        seconds = np.where(up, up_at * robot.dt, np.inf)
        power = np.abs(recording.torque * recording.qvel[..., 6:]).sum(axis=2)
        highest = np.where(robot.model.actuator_forcelimited, robot.model.actuator_forcerange[:, 1], np.inf)
        at_limit = (np.abs(recording.torque) >= AT_LIMIT * highest).mean(axis=2)
        return {
            "stands": float(up.mean()),
            "stays": float(still.mean()),
            "median": float(np.median(seconds[up])) if up.any() else None,
            "slowest": float(seconds[up].max()) if up.any() else None,
            "energy": float((power * until).sum(axis=0)[up].mean() * robot.dt) if up.any() else None,
            "at_limit": float(at_limit[until].mean()),
            "worst": int(np.argmax(np.where(still, seconds, np.inf))),  # a robot that did not, or the slowest one
        }


def standing(robot: ExamRobot, recording: Recording) -> np.ndarray:
    """(T, N) High, upright and with joints at rest; where an episode ended, no more."""
    axis = rotate(recording.qpos[..., 3:7], np.array([0.0, 0.0, 1.0]))  # the root's z, in the world
    gravity = robot.model.opt.gravity / np.linalg.norm(robot.model.opt.gravity)
    upright = -(axis @ gravity) > np.cos(np.radians(TILT))
    high = recording.qpos[..., 2] > HIGH * robot.home[2]
    slow = np.abs(recording.qvel[..., 6:]).mean(axis=2) < SLOW
    return high & upright & slow & (np.arange(len(high))[:, None] <= recording.ended_at)


def _lasting(true: np.ndarray, steps: int) -> np.ndarray:
    """(T - steps + 1, N) Whether it is ``true`` for ``steps`` steps from each one on."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(true, steps, axis=0).all(axis=2))
