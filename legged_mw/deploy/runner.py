"""The control loop between a policy and a robot, at the contract's period.

It does not depend on the type of robot or on the source of commands.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from legged_mw.deploy.controller import Controller
from legged_mw.deploy.log import Log
from legged_mw.deploy.loop import Loop, Timing
from legged_mw.deploy.odometry import Odometry
from legged_mw.deploy.robot import Floats, Health, Measurement, Robot, RobotError
from legged_mw.deploy.safety import TORQUE, Limits, Safety, Trip, Tripped
from legged_mw.deploy.states import DAMPING, POLICY, ZERO, Order, States

_RECENT = 10.0  # [s] of velocities that a run without an end stores


@dataclass
class Summary:
    """The result of a run."""

    steps: int = 0
    late: int = 0  # steps that began more than half a period late
    fell: float | None = None  # [s] of the fall that ended the walk, by the contract's `ends`
    velocity: Floats | None = None  # (3,) mean of vx, vy [m/s] and yaw rate [rad/s] over the second half
    timing: Timing | None = None  # of a live run
    trips: list[Trip] = field(default_factory=list)  # of a run with states; it continues with the robot damped


def run(
    robot: Robot,
    controller: Controller,
    command: Callable[[float], Floats],
    seconds: float = math.inf,
    *,
    live: bool = True,
    watch: Callable[[float, Any], None] | None = None,
    safety: Safety | None = None,
    states: States | None = None,
    log: Log | None = None,
    odometry: Odometry | None = None,
) -> Summary:
    """Run for ``seconds``, or until the robot falls. Each period reads the robot, computes an order and writes it.

    It closes the robot at the end, also after an error.
    ``command`` returns (C,) in the contract's order at a time [s] since the start. It is clipped to the trained ranges.
    ``live``: run in real time, as a real robot needs; otherwise as fast as possible.
    ``watch`` gets each measurement. With states it gets None for a step without a measurement.
    ``safety`` replaces the export's limits. An exceeded limit damps the robot and raises Tripped.
    ``states`` begin at zero torque and replace ``command``. A trip or a fall damps the robot, and the run continues.
    ``odometry`` replaces the measured velocity by its estimate.
    """
    safety = safety or Safety(controller.contract, Limits.of(controller.folder, controller.contract, robot.limits))
    step, velocities = (
        _Step(robot, controller, command, safety, states, log, odometry),
        _Velocities(controller.contract.period, seconds),
    )
    with ExitStack() as stack:
        for each in filter(None, (states, log)):
            stack.callback(each.close)
        loop = Loop(controller.contract.period, live)
        with suppress(*([KeyboardInterrupt] if states else [])):  # Ctrl-C is the normal end of a run with states
            stack.enter_context(loop)
            stack.enter_context(robot)
            controller.reset()
            for now in loop.ticks(seconds):
                measured = step.take(loop)
                if step.over:
                    break
                if measured:
                    velocities.add(measured)
                if watch and (measured or states):
                    watch(now, measured)
        if log and live:
            log.event(loop.now, str(loop.timing()))
    return replace(
        step.summary,
        velocity=velocities.mean(step.summary.steps),
        late=loop.late,
        timing=loop.timing() if live else None,
    )


class _Velocities:
    """The velocities of the last half of a run, or of the last seconds of a run without an end."""

    def __init__(self, period: float, seconds: float) -> None:
        self._kept: deque[list[float]] = deque(maxlen=math.ceil(min(seconds, 2 * _RECENT) / period / 2) + 1)

    def add(self, measured: Measurement) -> None:
        self._kept.append([*measured.lin_vel[:2], measured.ang_vel[2]])

    def mean(self, steps: int) -> Floats | None:
        """The mean (3,) over the second half of ``steps``; None without velocities."""
        return np.mean(list(self._kept)[-max(1, steps - steps // 2) :], axis=0) if self._kept else None


class _Step:
    """Runs one control period. Without states the policy acts at once, a trip raises and a fall ends the run."""

    def __init__(
        self,
        robot: Robot,
        controller: Controller,
        command: Callable[[float], Floats],
        safety: Safety,
        states: States | None,
        log: Log | None,
        odometry: Odometry | None,
    ) -> None:
        self.robot, self.controller, self.command, self.safety, self.states, self.log = (
            robot,
            controller,
            command,
            safety,
            states,
            log,
        )
        self.summary, self.odometry = Summary(), odometry
        if states and (type(robot).damp is Robot.damp or type(robot).limp is Robot.limp):
            raise RobotError(f"{type(robot).__name__} does not override damp() and limp(), which the states need")
        if states and controller.contract.action.origin == TORQUE:
            reason = "a policy of torques cannot stand a robot up: its states need servos"
            raise RobotError(f"{reason}; run it without states, or watch it in simulation without --drive")

    @property
    def over(self) -> bool:
        """True if the run ends with this step."""
        return self.summary.fell is not None or (self.states is not None and self.states.over)

    def take(self, loop: Loop) -> Measurement | None:
        """Run one step. Returns the measurement; None if there is none."""
        measured, health, trip = self._sense(loop)
        if self.summary.fell is not None:
            return measured
        self.summary.steps += 1
        if trip:
            order = self._trip(trip, loop.now)
        else:
            assert measured  # a missing measurement is always a trip
            order = self._decide(measured, loop.now)
            if not self.robot.can_change_gains:
                order = order._replace(stiffness=None, damping=None)
            if order.targets is not None:
                trip = self.safety.asked(measured, order.targets, order.stiffness, order.damping)
                clipped = self.controller.contract.action.held(order.targets)
                order = self._trip(trip, loop.now) if trip else order._replace(targets=clipped)
        self._do(order)
        if self.log and measured:
            self.log.add(
                loop,
                self.controller,
                measured,
                health,
                order,
                self.states.command if self.states else self._command(loop.now),
            )
        return measured

    def _sense(self, loop: Loop) -> tuple[Measurement | None, Health, Trip | None]:
        """The measurement, the health, and a trip if there is one."""
        measured, health, trip = None, Health(), None
        try:
            measured, health = self.robot.read(), self.robot.health()
            measured = self.odometry(measured) if self.odometry else measured
        except RobotError as error:
            if not self.states:
                raise
            trip = Trip("robot", str(error))
        stop = self.states.listen(health, loop.now) if self.states else None
        if measured is None or stop:
            return measured, health, stop or trip
        fell = self.controller.contract.ends.tilted(measured.gravity) or self.robot.fell()
        if fell and not self.states:
            self.summary.fell = loop.now
        if self.states is None or self.states.armed:
            skipped = loop.skipped if loop.steps > 2 else 0  # the first step may open a window
            trip = self.safety.sensed(measured, health, loop.now, loop.behind, skipped)
        if fell and self.states and self.states.state == POLICY:
            trip = trip or Trip("fall", "the robot fell")
        return measured, health, trip

    def _decide(self, measured: Measurement, now: float) -> Order:
        if self.states is None:
            self.controller.act(measured, self._command(now))
            return Order(POLICY, self.controller.last_targets[0].copy())
        before, order = self.states.armed, self.states.step(measured, now)
        if self.odometry and not self.states.armed:
            self.odometry.reset()  # the estimate can be wrong while the robot lies or hangs
        if self.states.armed and not before:
            self.safety.reset()
        return order

    def _trip(self, trip: Trip, now: float) -> Order:
        """Damp the robot. Raises Tripped without states."""
        if self.states is None:
            raise Tripped(trip)
        if self.states.state != DAMPING:
            self.summary.trips.append(trip)
            if self.log:
                self.log.event(now, f"{trip.limit}: {trip.text}")
        return self.states.trip(trip, now)

    def _do(self, order: Order) -> None:
        if order.targets is None:
            self.robot.limp() if order.state == ZERO else self.robot.damp()
        elif order.stiffness is None:
            self.robot.write(order.targets)
        else:
            self.robot.write(order.targets, stiffness=order.stiffness, damping=order.damping)

    def _command(self, now: float) -> Floats:
        return self.controller.contract.held(self.command(now))
