"""The states of a robot, and the buttons that change them.

zero torque -> (start) -> stand -> (A) -> policy -> (select, a fall, a trip) -> damping -> (start) -> zero torque.

A person changes the state with a remote, a gamepad or keys. Only damping can begin without a person.
The caller passes the times. This module does not wait.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import END, START, WALK, InputSource
from legged_mw.deploy.odometry import Odometry
from legged_mw.deploy.robot import Floats, Health, Measurement
from legged_mw.deploy.safety import Trip

ZERO, STAND, POLICY, DAMPING, CHECK, CHIRP = STATES = (
    *("zero torque", "stand", "policy"),
    *("damping", "joint check", "chirp"),
)
ARMED = (STAND, POLICY, CHECK, CHIRP)  # states with limits; in the others the motors have no stiffness
RISE = 2.0  # [s] duration of standing up, from any pose to the default pose [unitree_rl_gym]
SOFT = 0.1  # [share of the stiffness] at the start of standing up
NEAR = 0.15  # [rad] ours: if a joint is farther from the pose after RISE, the stiffness of all joints is raised
# [share of the stiffness] upper bound; unitree_rl_lab stands a Go2 with 60 N m/rad, three times the gain of go2_flat
STIFFEST = 3.0
STIFFEN = 1.0  # [share of the stiffness per second]
# IMU check while the robot stands up. Ours: the shipped Go1 and Go2 tilt by 0.1 rad in total. With right axes the tilt
# by gyro or legs differs from the tilt by gravity by a share of 0.05, with wrong axes by 0.7.
TILTS, MISSED = 0.03, 0.6  # [rad] smallest tilt for a check; largest allowed difference, share of the tilt
TURN = 0.1  # [s] of measurements per mean; single measurements are noisy, and their times are not exact
# [rad] roll to each side while standing up, with three feet or more; largest joint motion for it
SWAY, BEND = 0.06, 0.15
# [deg] largest angle between gravity and the legs' estimate of it; it includes the slope and encoder offsets
STEEP = 25.0
PLUMB, PULL = 30.0, (8.0, 12.0)  # [deg] angle between gravity and accelerometer; [m/s^2] its range for a robot at rest
STANDS = 0.3  # [rad] largest distance from the pose to start a policy; ours: the shipped policies walk from there


_IMU = ("ang_vel", "gravity", "acceleration")
KEPT = 2.5  # [s] of stored measurements while standing up, longer than RISE; a gyro's bias accumulates


def _per_mean(period: float) -> int:
    """Measurements per mean."""
    return max(1, round(TURN / period))


def _in_turns(values: Floats, period: float) -> Floats:
    """Means (M, 3) over each TURN [s] of ``values`` (N, 3). They reduce noise and errors of the times."""
    count = _per_mean(period)
    return values[: len(values) // count * count].reshape(-1, count, 3).mean(axis=1)


def wrong_imu(seen: Sequence[Measurement], period: float) -> str:
    """Check the IMU's axes from one measurement per period.

    Returns the fault in words; "" if there is none, or if the robot moved too little.
    Gravity must rotate as the gyro measures, and at rest point against the accelerometer. Two faults pass both
    checks: all sensors of the IMU are rotated in the same way, or all swap the same axes and nothing tilts along the
    third. ``at_odds`` detects these.
    """
    if len(seen) <= _per_mean(period):
        return ""
    gyro, gravity, acceleration = (np.array([getattr(each, name) for each in seen]) for name in _IMU)
    increments = -period * np.cross(gyro[1:] + gyro[:-1], gravity[1:] + gravity[:-1]) / 4
    gyro_tilt, gravity_tilt = (
        np.diff(_in_turns(each, period), axis=0) for each in (np.cumsum(increments, axis=0), gravity[1:])
    )
    by_gyro, by_gravity, difference = (
        float(np.linalg.norm(each)) for each in (gyro_tilt, gravity_tilt, gyro_tilt - gravity_tilt)
    )
    if max(by_gyro, by_gravity) > TILTS and difference > MISSED * max(by_gyro, by_gravity):
        return f"while it stood up gravity tilted by {by_gravity:.2f} rad, by the gyro by {by_gyro:.2f}, and {difference:.2f} do not agree"
    mean_acceleration = acceleration[-round(1.0 / period) :].mean(axis=0)
    if not PULL[0] < (size := float(np.linalg.norm(mean_acceleration))) < PULL[1]:
        return ""
    angle = math.degrees(math.acos(np.clip(-(mean_acceleration @ gravity[-1]) / size, -1.0, 1.0)))
    return f"gravity is {angle:.0f} degrees from what the accelerometer feels" if angle > PLUMB else ""


def at_odds(legs: Floats, gravity: Floats, period: float) -> str:
    """Compare measured ``gravity`` (N, 3), one per ``period`` [s], with the estimate of the ``legs`` (N, 3).

    Returns the difference in words; "" if they agree, or if there are too few estimates.
    On a slope the two differ by a constant. Pitch and roll must therefore change equally, and the constant must not
    exceed STEEP.
    """
    known = np.isfinite(legs).all(axis=1)
    if known.sum() < _per_mean(period):
        return ""
    legs, gravity = (_in_turns(each[known], period) for each in (legs, gravity))
    for name, axis in (("pitched", 0), ("rolled", 1)):
        by_legs, by_gravity, difference = (float(np.ptp(each[:, axis])) for each in (legs, gravity, legs - gravity))
        if max(by_legs, by_gravity) > TILTS and difference > MISSED * max(by_legs, by_gravity):
            tilts = f"{by_legs:.2f} rad by its legs, by gravity {by_gravity:.2f}"
            return f"while it stood up it {name} by {tilts}, and {difference:.2f} do not agree"
    cosine = legs[-1] @ gravity[-1] / np.linalg.norm(legs[-1]) / np.linalg.norm(gravity[-1])
    angle = math.degrees(math.acos(np.clip(cosine, -1.0, 1.0)))
    return f"gravity is {angle:.0f} degrees from where the legs have the ground" if angle > STEEP else ""


class Order(NamedTuple):
    """The command to the servos for the next period."""

    state: str
    # (D,) [rad] before clipping, so that the limits check them; None: zero torque in ZERO, damped in DAMPING
    targets: Floats | None = None
    stiffness: Floats | None = None  # (D,); None: the contract's
    damping: Floats | None = None  # (D,); None: the contract's


class States:
    """The states of one robot. Input sources, limits and falls change them.

    ``command`` returns (C,) at a time [s] since the policy began. It applies while no input source gives a command.
    ``say`` gets one line for each change.
    """

    first = STAND  # the state after the start button
    over, report, right = False, "", True  # true if the run ends now; text at the end; true if the result is good

    def __init__(
        self,
        controller: Controller,
        sources: Sequence[InputSource],
        command: Callable[[float], Floats],
        say: Callable[[str], None] = print,
    ) -> None:
        self.controller, self.sources, self._own, self._say = controller, list(sources), command, say
        self.state, self.since = ZERO, 0.0  # state; [s] time at which it began
        self.command = controller.contract.held(command(0.0))  # (C,) command in use
        self.note = f"{START}: {self.first}"
        self._from: Floats = controller.contract.default_pose  # (D,) [rad] pose at the start of standing up
        self._stiffer = 1.0
        # measurements while standing up; the legs' estimate of gravity in each
        self._rise, self._down = list[Measurement](), list[Floats]()
        self._legs, self._sway = None, np.zeros(len(self._from))  # (D,) [rad] amplitude of the sway
        if len(controller.contract.feet) > 2:
            self._legs = Odometry(controller.folder, controller.contract)
            leaning = self._legs.leaning(self._from, np.array([1.0, 0.0, 0.0]))
            self._sway = leaning * min(SWAY, BEND / max(1e-9, float(np.abs(leaning).max())))
        self._pressed = frozenset[str]()

    @property
    def armed(self) -> bool:
        """True in the states with limits."""
        return self.state in ARMED

    def listen(self, health: Health, now: float) -> Trip | None:
        """Poll all input sources and set the command. Returns a trip for an emergency stop."""
        inputs = [source.poll(health) for source in self.sources]
        driver = next((i for i, each in enumerate(inputs) if each.command is not None), None)
        if driver is None:
            command = self._own(now - self.since if self.state == POLICY else 0.0)
        else:
            command = inputs[driver].command
            for source in self.sources[driver + 1 :]:
                source.let_go()
        self.command = self.controller.contract.held(np.asarray(command, dtype=float))
        self._pressed = frozenset().union(*(each.pressed for each in inputs))
        stop = next((each.stop for each in inputs if each.stop), "")
        return Trip("stop", stop) if stop and self.state != DAMPING else None

    def step(self, measured: Measurement, now: float) -> Order:
        """Change the state by the pressed buttons. Returns the command to the servos."""
        self._move_on(measured, now)
        if self.state == STAND:
            return self._stand(measured, now)
        if self.state == POLICY:
            self.controller.act(measured, self.command)
            return Order(POLICY, self.controller.last_targets[0].copy())
        return Order(self.state)

    def trip(self, trip: Trip, now: float) -> Order:
        """Damp the robot until a person starts it again."""
        if self.state != DAMPING:
            self._enter(DAMPING, now, trip.text)
        return Order(DAMPING)

    def close(self) -> None:
        """Close all input sources."""
        for source in self.sources:
            source.close()

    # ---- state changes

    def _move_on(self, measured: Measurement, now: float) -> None:
        pressed = self._pressed
        if END in pressed:
            if self.state != DAMPING:
                self._enter(DAMPING, now, f"{END} was pressed")
        elif START in pressed and self.state == DAMPING:
            self._enter(ZERO, now, f"{START}: {self.first}")
        elif START in pressed and self.state == ZERO:
            self._from, self._stiffer, self._rise, self._down = measured.joint_pos.copy(), 1.0, [], []
            self._enter(STAND, now, f"{RISE:g} s to the default pose; then {WALK}: policy")
        elif WALK in pressed and self.state == STAND:
            self._begin(measured, now)

    def _begin(self, measured: Measurement, now: float) -> None:
        """Start the policy if the robot stands and the IMU check finds no fault."""
        contract = self.controller.contract
        error = np.abs(measured.joint_pos - contract.default_pose)
        if now - self.since < RISE or contract.ends.tilted(measured.gravity) or error.max() > STANDS:
            joint = contract.joints[int(error.argmax())]
            self._tell(
                f"{WALK} has to wait until the robot stands: {joint} is {error.max():.2f} rad from its pose after {now - self.since:.1f} s"
            )
            return
        gravity = np.array([each.gravity for each in self._rise])
        if fault := wrong_imu(self._rise, contract.period) or (
            at_odds(np.array(self._down), gravity, contract.period) if self._legs else ""
        ):
            self._tell(f"{WALK} is refused: {fault}; look at how the IMU's axes are mounted and read")
            return
        self.controller.reset()
        self._enter(POLICY, now, f"{END}: damping")

    def _stand(self, measured: Measurement, now: float) -> Order:
        """Interpolate to the default pose and raise the gains. If a joint stays behind, raise all gains further.

        In the second half a robot with three feet or more rolls to both sides, so that the IMU check measures a roll.
        """
        contract = self.controller.contract
        if len(self._rise) * contract.period < KEPT:
            self._rise.append(replace(measured, **{name: np.array(getattr(measured, name)) for name in _IMU}))
            if self._legs:
                self._down.append(self._legs.down(measured))
        share = min(1.0, (now - self.since) / RISE)
        targets = self._from + share * (contract.default_pose - self._from)
        if 0.5 < share < 1.0:
            targets = targets + math.sin(4.0 * math.pi * share) * self._sway
        if share == 1.0 and np.abs(measured.joint_pos - targets).max() > NEAR:
            self._stiffer = min(STIFFEST, self._stiffer + STIFFEN * contract.period)
        gain = self._stiffer * (SOFT + (1.0 - SOFT) * share)
        return Order(STAND, targets, gain * contract.stiffness, max(1.0, gain**0.5) * contract.damping)

    def _enter(self, state: str, now: float, note: str) -> None:
        self.state, self.since = state, now
        if state != POLICY:  # what keys asked for before a stop must not move the robot after it
            for source in self.sources:
                source.let_go()
        self._tell(note)

    def _tell(self, note: str) -> None:
        self.note = note
        self._say(f"{self.state}: {note}")
