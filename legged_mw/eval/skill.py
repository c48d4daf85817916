"""Exams of tasks without commands: robots are put into a start, the policy acts, and what was recorded is judged.

A kind of exam is a ``Skill``. The same object judges the robots of the training environment and those of an export: it needs
numpy and MuJoCo, neither torch nor warp.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, ClassVar, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.eval.rules import Figure

Floats = NDArray[np.float64]
PUSH_EVERY, GOLDEN = 2.0, math.pi * (3.0 - 5.0**0.5)  # [s]; [rad] directions that never repeat
Starts = tuple[Floats, Floats]  # qpos (N, nq), qvel (N, nv)


class ExamGround(NamedTuple):
    """What is another than in the task as it was trained, without randomization."""

    slope: float = 0.0  # [deg] of the plane; in simulation gravity leans and the plane stays
    friction: float | None = None  # [-] of the ground; None: the task's
    load: float = 0.0  # [kg] on the root
    push: float = 0.0  # [m/s] by which each robot's horizontal velocity jumps, every PUSH_EVERY seconds

    def pushes(self, step: int, count: int, dt: float) -> Floats | None:
        """Jumps (count, 2) [m/s] at a control step of ``dt`` [s]; None: none. Robots are pushed one after another, in all directions."""
        every, robots = round(PUSH_EVERY / dt), np.arange(count)
        now = (step > 0) & ((step + robots * every // count) % every == 0)
        if not self.push or not now.any():
            return None
        angle = GOLDEN * (robots + count * (step // every))
        return self.push * now[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)


class ReferenceMotion(NamedTuple):
    """What a robot is to follow."""

    qpos: Floats  # (T, nq) a frame a control step
    bodies: tuple[str, ...]  # that are compared
    anchor: str  # one of them, at which they are


class ExamRobot(NamedTuple):
    """The machine that an exam is about."""

    model: mujoco.MjModel  # as it is stepped, with the gravity of the exam's ground
    home: Floats  # (nq,) where an episode starts, joints in their default pose
    dt: float  # [s] a control step
    motion: ReferenceMotion | None = None


class Recording(NamedTuple):
    """N robots over T control steps, sampled before each step, so that the first sample is the start."""

    qpos: Floats  # (T, N, nq) [m, world], quaternion wxyz, joint angles [rad]
    qvel: Floats  # (T, N, nv)
    torque: Floats  # (T, N, D) [N m], one simulation step old
    ended_at: Floats  # (N,) control step in which the episode ended first, or inf; from there on it is another one


class Measure(NamedTuple):
    """A figure of each part of an exam, and what it must be on the task's own ground and on any other."""

    key: str
    text: str  # with its unit
    digits: int = 3
    marks: tuple[float, float] | None = None
    more_is_better: bool = True


@dataclass(frozen=True)
class Skill(ABC):
    """One kind of exam. Its fields are those of the task's config section ``exam``, if it has one."""

    kind: ClassVar[str]
    asks: ClassVar[str]  # one sentence for the table
    grounds: ClassVar[Mapping[str, ExamGround]]  # parts of the exam; the first is also the exam during training
    robots: ClassVar[int]  # of each part
    measures: ClassVar[Sequence[Measure]]
    overrides: ClassVar[Mapping[str, Any]] = {}  # config fields, beside those that every exam sets (exam.OVERRIDES)

    @property
    @abstractmethod
    def seconds(self) -> float:
        """How long robots are watched [s]."""

    def steps(self, robot: ExamRobot) -> int:
        """How long [control steps]."""
        return round(self.seconds / robot.dt)

    @abstractmethod
    def starts(self, robot: ExamRobot, count: int) -> Starts | None:
        """qpos (count, nq) and qvel (count, nv) to begin with, the same at every call; None: where the task's episodes begin."""

    @abstractmethod
    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        """A value for each of ``measures``; None where there is nothing to measure. Other keys are kept too."""

    def result(self, parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """The exam's result from what ``judge`` said of each part, for JSON."""
        asked = {"kind": self.kind, **asdict(self)}
        found = {name: {key: _plain(value) for key, value in part.items()} for name, part in parts.items()}
        passed = all(figure.passes() is not False for part in found for figure in self.figures(found, part))
        return {"asked": asked, "robots": self.robots, "parts": found, "passed": passed}

    def figures(self, parts: Mapping[str, Mapping[str, Any]], part: str) -> list[Figure]:
        """The figures of one part beside their marks."""
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
        """The result as text: a row a figure, a column a part."""
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
