"""The exam `getup`: stand up from unseen falls, on four grounds. Needs only numpy and MuJoCo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from legged_mw.eval.skill import ExamGround, ExamRobot, Floats, Measure, Recording, Skill
from legged_mw.skills.clip import rotate
from legged_mw.skills.drop_states import fallen

# Seed of the falls (training uses falls.seed), and time [s] from the drop to the start of the test.
SEED, SETTLING = 20_000, 1.5
# The robot stands: least share of the standing height, largest tilt [deg], largest mean joint speed [rad/s]. Ours.
HIGH, TILT, SLOW = 0.9, 20.0, 0.5
# The robot must stand for HOLD [s] to count as up, and must still stand STAY [s] later.
HOLD, STAY = 0.5, 5.0
AT_LIMIT = 0.98  # share of the force limit: a larger torque counts as saturated


@dataclass(frozen=True)
class GetupExam(Skill):
    """256 falls on each ground."""

    within: float = 3.0  # [s] time limit for standing up

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
    overrides: ClassVar = {"falls.pull": 0.0, "falls.states": 1}  # the falls come from `starts`

    @property
    def seconds(self) -> float:
        return self.within + STAY + HOLD

    def starts(self, robot: ExamRobot, count: int) -> tuple[Floats, Floats]:
        return fallen(robot.model, count, SEED, SETTLING)

    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        hold, stay, limit = (round(seconds / robot.dt) for seconds in (HOLD, STAY, self.within))
        held = _lasting(standing(robot, recording), hold)  # (T - hold + 1, N): it stands for HOLD from this step on
        # (N,) first such step; the end if there is none
        up_at = np.where(held.any(axis=0), held.argmax(axis=0), len(held))
        up = up_at <= limit
        still = held[np.minimum(up_at + stay, len(held) - 1), np.arange(held.shape[1])] & up
        until = np.arange(len(recording.qpos))[:, None] <= up_at  # (T, N): still getting up
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
            "worst": int(np.argmax(np.where(still, seconds, np.inf))),  # a robot that failed, else the slowest
        }


def standing(robot: ExamRobot, recording: Recording) -> np.ndarray:
    """(T, N): the base is high, upright, the joints are at rest, and the episode has not ended."""
    axis = rotate(recording.qpos[..., 3:7], np.array([0.0, 0.0, 1.0]))  # the root's z axis in the world frame
    gravity = robot.model.opt.gravity / np.linalg.norm(robot.model.opt.gravity)
    upright = -(axis @ gravity) > np.cos(np.radians(TILT))
    high = recording.qpos[..., 2] > HIGH * robot.home[2]
    slow = np.abs(recording.qvel[..., 6:]).mean(axis=2) < SLOW
    return high & upright & slow & (np.arange(len(high))[:, None] <= recording.ended_at)


def _lasting(true: np.ndarray, steps: int) -> np.ndarray:
    """(T - steps + 1, N): ``true`` holds at this step and through the ``steps`` - 1 steps after it."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(true, steps, axis=0).all(axis=2))
