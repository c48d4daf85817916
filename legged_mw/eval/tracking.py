"""The exam of motion tracking: follow the whole first clip from its start, with and without pushes."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.eval.skill import ExamGround, ExamRobot, Floats, Measure, Recording, Skill
from legged_mw.skills.clip import conjugate, from_rotation_vector, heading, multiply, rotate

# Offsets of a robot at the start: joint angles [rad], heading [rad], speed [m/s], each U(-off, off).
JOINTS_OFF, HEADING_OFF, SPEED_OFF = 0.05, 0.1, 0.1
# [m], [-] Errors of the anchor's height and tilt at which a robot is lost. Source: BeyondMimic.
LOST_HEIGHT, LOST_TILT = 0.25, 0.8
FAR = 1e9  # switches off the task's termination rules, because exported policies do not have them


@dataclass(frozen=True)
class TrackingExam(Skill):
    """Does the robot follow the clip to its end, and how closely?"""

    kind = "tracking"
    asks = "The whole clip from its start, by 32 robots that begin a little off it; pushed ones get 0.5 m/s every 2 s."
    grounds = {"not pushed": ExamGround(), "pushed": ExamGround(push=0.5)}
    robots = 32
    measures = (
        Measure("finished", "share that finishes", 2, (1.0, 0.9)),
        Measure("body_error", "error of bodies' places [mm]", 1, (50.0, 100.0), more_is_better=False),
        Measure("joint_error", "error of joint angles [rad]", 3, more_is_better=False),
        Measure("drift", "anchor from its place, at the end [m]", 2, more_is_better=False),
    )
    overrides = {
        "motion.random_start": False,
        **{f"termination.{name}": FAR for name in ("max_anchor_height", "max_anchor_tilt", "max_end_height")},
    }

    @property
    def seconds(self) -> float:
        return 0.0  # the clip sets the duration; see `steps`

    def steps(self, robot: ExamRobot) -> int:
        assert robot.motion
        return len(robot.motion.qpos)

    def starts(self, robot: ExamRobot, count: int) -> tuple[Floats, Floats]:
        assert robot.motion
        rng, first = np.random.default_rng(0), robot.motion.qpos[0]
        qpos, qvel = np.tile(first, (count, 1)), np.zeros((count, robot.model.nv))
        qpos[:, 7:] += rng.uniform(-JOINTS_OFF, JOINTS_OFF, (count, len(first) - 7))
        turn = rng.uniform(-HEADING_OFF, HEADING_OFF, (count, 1)) * np.array([0.0, 0.0, 1.0])
        qpos[:, 3:7] = multiply(from_rotation_vector(turn), qpos[:, 3:7])
        qvel[:, :2] = rng.uniform(-SPEED_OFF, SPEED_OFF, (count, 2))
        return qpos, qvel

    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        assert robot.motion
        motion, model, steps = robot.motion, robot.model, len(recording.qpos)
        bodies, anchor = [model.body(name).id for name in motion.bodies], motion.bodies.index(motion.anchor)
        wanted, wanted_turn = _posed(model, motion.qpos[:, None], bodies)  # (T, 1, B, 3), (T, 1, B, 4)
        found, turn = _posed(model, recording.qpos, bodies)
        turned = heading(multiply(turn[:, :, anchor], conjugate(wanted_turn[:, :, anchor])))[:, :, None]
        there = rotate(turned, wanted - wanted[:, :, anchor, None]) + wanted[:, :, anchor, None]
        off = found - there
        off[..., :2] -= (found - wanted)[:, :, anchor, None, :2]
        error = np.linalg.norm(off, axis=3).mean(axis=2)  # (T, N) [m]
        joints = np.abs(recording.qpos[..., 7:] - motion.qpos[:, None, 7:]).mean(axis=2)
        up = [1.0 - 2.0 * (q[..., 1] ** 2 + q[..., 2] ** 2) for q in (turn[:, :, anchor], wanted_turn[:, :, anchor])]
        away = np.abs(found - wanted)[:, :, anchor, 2]
        lost = ~((away <= LOST_HEIGHT) & (np.abs(up[0] - up[1]) <= LOST_TILT))  # NaN too
        lost |= np.arange(steps)[:, None] > recording.ended_at
        follows = ~np.maximum.accumulate(lost, axis=0)
        last, kept = follows[-1], follows.sum(axis=0)
        own = np.where(follows, error, 0.0).sum(axis=0) / np.maximum(kept, 1)
        drift = np.linalg.norm((found - wanted)[-1, last, anchor, :2], axis=1)
        return {
            "finished": float(last.mean()),
            # the robot that was lost first, else the one with the largest error
            "worst": int(np.argmax(np.where(last, own, FAR - kept))),
            "body_error": float(1000.0 * error[follows].mean()) if follows.any() else None,
            "joint_error": float(joints[follows].mean()) if follows.any() else None,
            "drift": float(drift.mean()) if last.any() else None,
        }


def _posed(model: mujoco.MjModel, qpos: Floats, bodies: list[int]) -> tuple[Floats, Floats]:
    """Positions (..., B, 3) [m] and quaternions wxyz (..., B, 4) of ``bodies`` in the states ``qpos`` (..., nq)."""
    data, flat = mujoco.MjData(model), qpos.reshape(-1, qpos.shape[-1])
    places, turns = np.full((len(flat), len(bodies), 3), np.nan), np.full((len(flat), len(bodies), 4), np.nan)
    for i in np.flatnonzero(np.isfinite(flat).all(axis=1)):
        data.qpos[:] = flat[i]
        mujoco.mj_kinematics(model, data)
        places[i], turns[i] = data.xpos[bodies], data.xquat[bodies]
    return tuple(values.reshape(*qpos.shape[:-1], *values.shape[1:]) for values in (places, turns))  # type: ignore[return-value]
