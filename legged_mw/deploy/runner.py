"""The loop between a policy and a robot, at the contract's period. It knows neither the kind of robot nor the source of commands."""

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
    fell: float | None = None  # [s] of the fall that ended the walk, by the contract's `ends`
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
    """Run for ``seconds``, or until the robot falls: read, decide, write, once a period; then close the robot, also after an error.

    ``command`` gives (C,), in the contract's order, at a time [s] since the start; it is held within the trained ranges.
    ``live``: in real time, as a robot needs it; else as fast as the robot answers. ``watch`` gets each measurement.
    """
    contract, summary, velocities = controller.contract, Summary(), []
    period = contract.period
    controller.reset()
    with robot:
        due = time.perf_counter()
        while summary.steps * period < seconds - 1e-9:
            now = summary.steps * period
            if live:
                due = _wait(due, period, summary) + period
            measured = robot.read()
            if contract.ends.tilted(measured.gravity) or robot.fell():
                summary.fell = now
                break
            targets = controller.act(measured, contract.held(command(now)))[0]
            if not np.isfinite(targets).all():
                raise RobotError("the policy's targets are not finite: is what the robot measures? its servos were switched off")
            robot.write(targets)
            velocities.append([*measured.lin_vel[:2], measured.ang_vel[2]])
            if watch:
                watch(now, measured)
            summary.steps += 1
    if velocities:
        summary.velocity = np.mean(velocities[len(velocities) // 2 :], axis=0)
    return summary


def _wait(due: float, period: float, summary: Summary) -> float:
    """Sleep until ``due``; returns when the step really begins. A late loop does not hurry afterwards: lost time stays lost."""
    behind = time.perf_counter() - due
    if behind > LATE * period:
        summary.late += 1
        return due + behind
    time.sleep(max(0.0, -behind))
    return due
