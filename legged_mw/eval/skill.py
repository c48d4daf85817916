"""Exams of tasks without commands: set the start states, run the policy, judge the recording.

Each kind of exam is a ``Skill``. The same object judges the training environment and an exported policy. It needs
numpy and MuJoCo, but neither torch nor warp.
"""

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
PUSH_EVERY, GOLDEN = 2.0, math.pi * (3.0 - 5.0**0.5)  # [s]; [rad] golden angle: directions that never repeat
Starts = tuple[Floats, Floats]  # qpos (N, nq), qvel (N, nv)


class ExamGround(NamedTuple):
    """The changes of one part of the exam to the trained task without randomization."""

    slope: float = 0.0  # [deg] of the plane; simulated by tilting gravity
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
    bodies: tuple[str, ...]  # bodies to compare with the reference
    anchor: str  # the body at which robot and reference are aligned


class ExamRobot(NamedTuple):
    """The robot of an exam."""

    model: mujoco.MjModel  # model of the simulation, with the gravity of the exam's ground
    home: Floats  # (nq,) qpos at the start of an episode, joints in the default pose
    dt: float  # [s] a control step
    motion: ReferenceMotion | None = None


class Recording(NamedTuple):
    """N robots over T control steps, sampled before each step: the first sample is the start state."""

    qpos: Floats  # (T, N, nq) position [m, world frame], quaternion wxyz, joint angles [rad]
    qvel: Floats  # (T, N, nv)
    torque: Floats  # (T, N, D) [N m], one simulation step old
    ended_at: Floats  # (N,) control step of the first end of an episode, or inf; later samples are of another one


class Measure(NamedTuple):
    """A figure of each part of an exam, with its pass marks on the task's own ground and on other grounds."""

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
    robots: ClassVar[int]  # in each part
    measures: ClassVar[Sequence[Measure]]
    overrides: ClassVar[Mapping[str, Any]] = {}  # config fields, in addition to exam.OVERRIDES

    @property
    @abstractmethod
    def seconds(self) -> float:
        """Duration of a recording [s]."""

    def steps(self, robot: ExamRobot) -> int:
        """Duration of a recording [control steps]."""
        return round(self.seconds / robot.dt)

    @abstractmethod
    def starts(self, robot: ExamRobot, count: int) -> Starts | None:
        """Start states qpos (count, nq) and qvel (count, nv), equal at every call. None: as the task's episodes."""

    @abstractmethod
    def judge(self, robot: ExamRobot, recording: Recording) -> dict[str, float | None]:
        """A value for each of ``measures``, or None if it cannot be measured. The result keeps further keys."""

    def result(self, parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
        """The exam's result, for JSON, from the return value of ``judge`` for each part."""
        asked = {"kind": self.kind, **asdict(self)}
        found = {name: {key: _plain(value) for key, value in part.items()} for name, part in parts.items()}
        passed = all(figure.passes() is not False for part in found for figure in self.figures(found, part))
        return {"asked": asked, "robots": self.robots, "parts": found, "passed": passed}

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
