"""The loop that ties a policy to a robot at the contract's period. Knows neither what the robot is nor who commands it."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from legged_mw.deploy.policy import Controller
from legged_mw.deploy.robot import Floats, Measurement, Robot, RobotError

LATE = 0.5  # [periods] by which a step may be late before it is counted


@dataclass
class Summary:
    """What happened."""

    steps: int = 0
    late: int = 0  # steps that began more than LATE periods after their time
    fell: float | None = None  # [s] when its z axis pointed below the horizon, which ended the walk
    velocity: Floats | None = None  # (3,) mean of vx, vy [m/s], yaw rate [rad/s] over the second half


def run(
    robot: Robot,
    controller: Controller,
    command: Callable[[float], Floats],
    seconds: float = math.inf,
    *,
    live: bool = True,
    watch: Callable[[float, Measurement], None] | None = None,
) -> Summary:
    """Walk for ``seconds``, or until it falls: read, decide, write, once a period; then let go, whatever happens.

    ``command`` gives (3,) vx, vy [m/s], yaw rate [rad/s] at a time [s] since the start; it is held within the trained ranges.
    ``live``: in real time, as a robot needs it; else as fast as the robot answers. ``watch`` sees each measurement.
    """
    period, summary, seen = controller.contract.period, Summary(), []
    low, high = controller.contract.command_ranges
    controller.reset()
    with robot:
        due = time.perf_counter()
        while summary.steps * period < seconds - 1e-9:
            now = summary.steps * period
            if live:
                due = _wait(due, period, summary) + period
            measured = robot.read()
            if measured.gravity[2] > 0.0:
                summary.fell = now
                break
            targets = controller.act(measured, np.clip(command(now), low, high))[0]
            if not np.isfinite(targets).all():
                raise RobotError("the policy's targets are not finite: is what the robot measures? its joints were let go")
            robot.write(targets)
            seen.append([*measured.lin_vel[:2], measured.ang_vel[2]])
            if watch:
                watch(now, measured)
            summary.steps += 1
    if seen:
        summary.velocity = np.mean(seen[len(seen) // 2 :], axis=0)
    return summary


def _wait(due: float, period: float, summary: Summary) -> float:
    """Sleep until ``due``; returns when the step really begins. A late loop is not hurried afterwards: lost time stays lost."""
    behind = time.perf_counter() - due
    if behind > LATE * period:
        summary.late += 1
        return due + behind
    time.sleep(max(0.0, -behind))
    return due
