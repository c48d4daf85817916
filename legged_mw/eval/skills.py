"""The exams of tasks without commands. They set the start states, run the policy and grade the recording.

Each kind of exam is a ``Skill``. The same object grades a policy in training and an exported policy. It needs
numpy and MuJoCo, but neither torch nor warp.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.eval.walking import Figure
from legged_mw.skills.clip import conjugate, from_rotation_vector, heading, multiply, rotate
from legged_mw.skills.drop_states import fallen
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

Floats = NDArray[np.float64]
PUSH_EVERY, GOLDEN = 2.0, math.pi * (3.0 - 5.0**0.5)  # [s]; [rad] golden angle, so that no direction repeats
Starts = tuple[Floats, Floats]  # qpos (N, nq), qvel (N, nv)


class ExamGround(NamedTuple):
    """The changes of one part of the exam to the task without randomization."""

    slope: float = 0.0  # [deg] of the plane; gravity is tilted to simulate it
    friction: float | None = None  # [-] of the ground; None: as in the task
    load: float = 0.0  # [kg] payload on the root body
    push: float = 0.0  # [m/s] jump of each robot's horizontal velocity, every PUSH_EVERY seconds

    def pushes(self, step: int, count: int, dt: float) -> Floats | None:
        """Velocity jumps (count, 2) [m/s] at a control step of ``dt`` [s], or None.

        Robots are pushed one after another, in all directions.
        """
        every, robots = round(PUSH_EVERY / dt), np.arange(count)
        now = (step > 0) & ((step + robots * every // count) % every == 0)
        if not self.push or not now.any():
            return None
        angle = GOLDEN * (robots + count * (step // every))
        return self.push * now[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


class ReferenceMotion(NamedTuple):
    """The reference motion of a tracking exam."""

    qpos: Floats  # (T, nq) one frame per control step
    bodies: tuple[str, ...]  # tracked bodies
    anchor: str  # body that aligns the robot with the reference


class ExamRobot(NamedTuple):
    """The robot of an exam."""

    model: mujoco.MjModel  # model of the simulation, with the gravity of the exam's ground
    home: Floats  # (nq,) qpos at the start of an episode, joints in the default pose
    dt: float  # [s] control step
    motion: ReferenceMotion | None = None


class Recording(NamedTuple):
    """The record of N robots over T control steps, sampled before each step. The first sample is the start state."""

    qpos: Floats  # (T, N, nq) position [m, world frame], quaternion wxyz, joint angles [rad]
    qvel: Floats  # (T, N, nv)
    torque: Floats  # (T, N, D) [N m], one simulation step old
    ended_at: Floats  # (N,) control step at which the first episode ends, or inf; later samples are of another episode

    def alive(self) -> NDArray[np.bool_]:
        """(T, N) true if the first episode has not ended."""
        return np.arange(len(self.qpos))[:, None] <= self.ended_at

    def power(self) -> Floats:
        """(T, N) [W] sum of |torque * speed| over the joints."""
        return np.abs(self.torque * self.qvel[..., 6:]).sum(axis=2)


class Measure(NamedTuple):
    """A figure of each part of an exam, with its pass marks on the first ground and on the other grounds."""

    key: str
    text: str  # label with unit
    digits: int = 3
    marks: tuple[float, float] | None = None
    more_is_better: bool = True


@dataclass(frozen=True)
class Skill(ABC):
    """One kind of exam. Its fields are the fields of the task's config section ``exam``."""

    kind: ClassVar[str]
    asks: ClassVar[str]  # description for the table, one sentence
    grounds: ClassVar[Mapping[str, ExamGround]]  # part -> ground; the first part is also the exam during training
    robots: ClassVar[int]  # number of robots in each part
    measures: ClassVar[Sequence[Measure]]
    overrides: ClassVar[Mapping[str, Any]] = {}  # config fields, in addition to rollout.OVERRIDES

    @abstractmethod
    def steps(self, robot: ExamRobot) -> int:
        """Duration of a recording [control steps]."""

    @abstractmethod
    def starts(self, robot: ExamRobot, count: int) -> Starts | None:
        """Start states qpos (count, nq) and qvel (count, nv), equal at every call. None: the task's start states."""

    @abstractmethod
    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        """A value for each of ``measures``; None if it cannot be measured. The result stores other keys, too."""

    def result(self, parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """The exam's result, for JSON. ``parts``: name -> return value of ``judge``."""
        exam = {"kind": self.kind, **asdict(self)}
        results = {name: {key: _plain(value) for key, value in part.items()} for name, part in parts.items()}
        passed = all(figure.passes() is not False for part in results for figure in self.figures(results, part))
        return {"asked": exam, "robots": self.robots, "parts": results, "passed": passed}

    def figures(self, parts: Mapping[str, Mapping[str, Any]], part: str) -> list[Figure]:
        """The figures of one part with their marks."""
        first = part == next(iter(self.grounds))
        return [
            Figure(
                measure.text,
                parts[part][measure.key],
                measure.digits,
                measure.marks[0 if first else 1] if measure.marks else None,
                more_is_better=measure.more_is_better,
                without="none",
            )
            for measure in self.measures
        ]

    def table(self, result: Mapping[str, Any]) -> str:
        """The result as text: one row per figure, one column per part."""
        parts = result["parts"]
        columns = [self.figures(parts, name) for name in parts]
        width = max(10, *(len(name) + 2 for name in parts))
        lines = [self.asks, f"{'':<34}" + "".join(f"{name:>{width}}" for name in parts) + f"{'asks':>14}"]
        for row in zip(*columns, strict=True):
            marks = " / ".join(dict.fromkeys(figure.mark_text() for figure in row))
            lines.append(
                f"{row[0].name:<34}"
                + "".join(f"{figure.text(figure.value):>{width}}" for figure in row)
                + f"{marks:>14}"
            )
        return "\n".join([*(line.rstrip() for line in lines), f"passes: {'yes' if result['passed'] else 'no'}"])


def _plain(value: Any) -> Any:
    return round(float(value), 5) if isinstance(value, (float, np.floating)) else value


# ---- getup: stand up from falls that training did not use, on four grounds


# Seed of the falls (training uses falls.seed), and time [s] from the drop to the start of the test.
GETUP_SEED, GETUP_SETTLING = 20_000, 1.5
# Standing: smallest share of the standing height, largest tilt [deg], largest mean joint speed [rad/s]. Ours.
GETUP_HIGH, GETUP_TILT, GETUP_SLOW = 0.9, 20.0, 0.5
# The robot must stand for GETUP_HOLD [s] to count as up, and must still stand GETUP_STAY [s] later.
GETUP_HOLD, GETUP_STAY = 0.5, 5.0
AT_LIMIT = 0.98  # share of the force limit: a larger torque counts as saturated


@dataclass(frozen=True)
class GetupExam(Skill):
    """The exam of standing up, from 256 falls on each ground."""

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

    def steps(self, robot: ExamRobot) -> int:
        return round((self.within + GETUP_STAY + GETUP_HOLD) / robot.dt)

    def starts(self, robot: ExamRobot, count: int) -> tuple[Floats, Floats]:
        return fallen(robot.model, count, GETUP_SEED, GETUP_SETTLING)

    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        hold, stay, limit = (round(seconds / robot.dt) for seconds in (GETUP_HOLD, GETUP_STAY, self.within))
        # (T - hold + 1, N) true if it stands for GETUP_HOLD from this step
        held = _lasting(standing(robot, recording), hold)
        # (N,) first such step; len(held) if there is none
        up_at = np.where(held.any(axis=0), held.argmax(axis=0), len(held))
        up = up_at <= limit
        still = held[np.minimum(up_at + stay, len(held) - 1), np.arange(held.shape[1])] & up
        until = np.arange(len(recording.qpos))[:, None] <= up_at  # (T, N) true until it stands
        seconds = np.where(up, up_at * robot.dt, np.inf)
        highest = np.where(robot.model.actuator_forcelimited, robot.model.actuator_forcerange[:, 1], np.inf)
        at_limit = (np.abs(recording.torque) >= AT_LIMIT * highest).mean(axis=2)
        return {
            "stands": float(up.mean()),
            "stays": float(still.mean()),
            "median": float(np.median(seconds[up])) if up.any() else None,
            "slowest": float(seconds[up].max()) if up.any() else None,
            "energy": float((recording.power() * until).sum(axis=0)[up].mean() * robot.dt) if up.any() else None,
            "at_limit": float(at_limit[until].mean()),
            "worst": int(np.argmax(np.where(still, seconds, np.inf))),  # a robot that failed, else the slowest
        }


def standing(robot: ExamRobot, recording: Recording) -> np.ndarray:
    """(T, N) true if the base is high and upright, the joints are at rest, and the episode has not ended."""
    axis = rotate(recording.qpos[..., 3:7], np.array([0.0, 0.0, 1.0]))  # the root's z axis in the world frame
    gravity = robot.model.opt.gravity / np.linalg.norm(robot.model.opt.gravity)
    upright = -(axis @ gravity) > np.cos(np.radians(GETUP_TILT))
    high = recording.qpos[..., 2] > GETUP_HIGH * robot.home[2]
    slow = np.abs(recording.qvel[..., 6:]).mean(axis=2) < GETUP_SLOW
    return high & upright & slow & recording.alive()


def _lasting(true: np.ndarray, steps: int) -> np.ndarray:
    """(T - steps + 1, N) true if ``true`` (T, N) holds at this step and in the next ``steps`` - 1 steps."""
    return np.asarray(np.lib.stride_tricks.sliding_window_view(true, steps, axis=0).all(axis=2))


# ---- handstand: rise from a stand on four legs to a handstand or footstand and hold it for 5 s


# Seed; each joint angle at the start has an offset U(-HANDSTAND_OFFSET, HANDSTAND_OFFSET) [rad] [ours].
HANDSTAND_SEED, HANDSTAND_OFFSET = 30_000, 0.05
HANDSTAND_WITHIN, HANDSTAND_HOLD = 3.0, 5.0  # [s] time limit for rising, time to hold [ours]
# Handstand: largest angle between the root's x axis and the vertical [deg], smallest share of the height [ours].
HANDSTAND_TILT, HANDSTAND_HIGH = 30.0, 0.8


@dataclass(frozen=True)
class HandstandExam(Skill):
    """The exam of a handstand or footstand, with 64 attempts on each ground."""

    nose: float = -1.0  # direction of the root's x axis: -1 down, 1 up
    height: float = 0.55  # [m] height of the root
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

    def steps(self, robot: ExamRobot) -> int:
        return round((HANDSTAND_WITHIN + HANDSTAND_HOLD) / robot.dt)

    def starts(self, robot: ExamRobot, count: int) -> tuple[Floats, Floats]:
        qpos = np.tile(robot.home, (count, 1))
        qpos[:, 7:] += np.random.default_rng(HANDSTAND_SEED).uniform(
            -HANDSTAND_OFFSET, HANDSTAND_OFFSET, (count, robot.model.nq - 7)
        )
        return qpos, np.zeros((count, robot.model.nv))

    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        touching, hands = self._ground_contact(robot, recording.qpos)
        ahead = rotate(recording.qpos[..., 3:7], np.array([1.0, 0.0, 0.0]))  # the root's x axis in the world frame
        upright = self.nose * ahead[..., 2] > np.cos(np.radians(HANDSTAND_TILT))
        up = upright & (recording.qpos[..., 2] > HANDSTAND_HIGH * self.height) & ~touching & recording.alive()  # (T, N)
        hold = round(HANDSTAND_HOLD / robot.dt)
        held = _lasting(up, hold)
        holds, begin = held.any(axis=0), held.argmax(axis=0)
        each = np.arange(len(recording.ended_at))
        drift = np.linalg.norm(hands[begin + hold - 1, each] - hands[begin, each], axis=1)
        return {
            "holds": float(holds.mean()),
            "up": float(up.any(axis=0).mean()),
            "median": float(np.median(begin[holds]) * robot.dt) if holds.any() else None,
            "drift": float(drift[holds].mean()) if holds.any() else None,
            "power": float(recording.power()[up].mean()) if up.any() else None,
            # a robot that failed, else the robot with the largest drift
            "worst": int(np.argmax(np.where(holds, drift, np.inf))),
        }

    def _ground_contact(self, robot: ExamRobot, qpos: Floats) -> tuple[np.ndarray, np.ndarray]:
        """(T, N) true if a geom other than the hands touches the ground; (T, N, 2) [m] midpoint of the hands."""
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


# ---- motion tracking: track the whole first clip from its start, with and without pushes


# Offsets of a robot at the start: joint angles [rad], heading [rad], speed [m/s], each U(-off, off).
JOINTS_OFF, HEADING_OFF, SPEED_OFF = 0.05, 0.1, 0.1
# Largest errors of the anchor's height [m] and tilt [-]; beyond them tracking is lost. Source: BeyondMimic.
LOST_HEIGHT, LOST_TILT = 0.25, 0.8
FAR = 1e9  # switches off the task's termination rules, because exported policies do not have them


@dataclass(frozen=True)
class TrackingExam(Skill):
    """The exam of motion tracking: the share of robots that finish the clip, and their tracking errors."""

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
        "motion.hold_s": 1.0,  # an episode that ends with the clip would end before its last frame is judged
        **{f"termination.{name}": FAR for name in ("max_anchor_height", "max_anchor_tilt", "max_end_height")},
    }

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
        motion, model = robot.motion, robot.model
        bodies, anchor = [model.body(name).id for name in motion.bodies], motion.bodies.index(motion.anchor)
        reference, reference_turn = _posed(model, motion.qpos[:, None], bodies)  # (T, 1, B, 3), (T, 1, B, 4)
        actual, turn = _posed(model, recording.qpos, bodies)
        rotation = heading(multiply(turn[:, :, anchor], conjugate(reference_turn[:, :, anchor])))[:, :, None]
        aligned = rotate(rotation, reference - reference[:, :, anchor, None]) + reference[:, :, anchor, None]
        offset = actual - aligned
        offset[..., :2] -= (actual - reference)[:, :, anchor, None, :2]
        error = np.linalg.norm(offset, axis=3).mean(axis=2)  # (T, N) [m]
        joints = np.abs(recording.qpos[..., 7:] - motion.qpos[:, None, 7:]).mean(axis=2)
        up = [1.0 - 2.0 * (q[..., 1] ** 2 + q[..., 2] ** 2) for q in (turn[:, :, anchor], reference_turn[:, :, anchor])]
        height_error = np.abs(actual - reference)[:, :, anchor, 2]
        lost = ~((height_error <= LOST_HEIGHT) & (np.abs(up[0] - up[1]) <= LOST_TILT))  # also for NaN
        lost |= ~recording.alive()
        follows = ~np.maximum.accumulate(lost, axis=0)
        last, counts = follows[-1], follows.sum(axis=0)
        mean_error = np.where(follows, error, 0.0).sum(axis=0) / np.maximum(counts, 1)
        drift = np.linalg.norm((actual - reference)[-1, last, anchor, :2], axis=1)
        return {
            "finished": float(last.mean()),
            # the first robot that lost the motion, else the robot with the largest error
            "worst": int(np.argmax(np.where(last, mean_error, FAR - counts))),
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


# ---- exams by name


SKILLS: dict[str, type[Skill]] = {kind.kind: kind for kind in (GetupExam, HandstandExam, TrackingExam)}


def make_skill(kind: str, section: Mapping[str, Any]) -> Skill:
    """The exam ``kind`` with the values of a task's config section ``exam``. Raises ConfigError."""
    if kind not in SKILLS:
        raise ConfigError(unknown("exam", kind, SKILLS, "legged_mw/eval/skills.py"))
    known = [field.name for field in fields(SKILLS[kind])]
    for name in section:
        if name not in known:
            raise ConfigError(f"exam: {unknown('field', name, known, f'the exam {kind}')}")
    return SKILLS[kind](**section)
