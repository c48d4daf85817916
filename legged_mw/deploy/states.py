"""The states of a robot, and the buttons between them.

zero torque -> (start) -> stand -> (A) -> policy -> (select, a fall, a trip) -> damping -> (start) -> zero torque.

A person changes the state by a remote, a gamepad or keys; only damping can begin by itself.
The caller passes times in: nothing waits here.
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
ARMED = (STAND, POLICY, CHECK, CHIRP)  # states with limits; in the others no motor pushes
RISE = 2.0  # [s] of standing up, from any pose to the default pose [unitree_rl_gym]
SOFT = 0.1  # [share of the stiffness] at the start of standing up
NEAR = 0.15  # [rad] ours: a joint farther from the pose after RISE carries weight and gets stiffer
# [share of the stiffness] at most; unitree_rl_lab stands a Go2 with 60 N m/rad, three times the gain of go2_flat
STIFFEST = 3.0
STIFFEN = 1.0  # [share of the stiffness per second]
# IMU check while the robot stands up. Ours: the shipped Go1 and Go2 tilt by 0.1 rad in all. With right axes gyro and
# legs differ from gravity by 0.05 of the tilt, with wrong axes by 0.7.
TILTS, MISSED = 0.03, 0.6  # [rad] least tilt for a check; share of it that may differ
TURN = 5  # measurements per mean: single ones are noisy, and their times are not exact
# [rad] roll to each side while standing up, with three feet or more; largest joint motion for it
SWAY, BEND = 0.06, 0.15
# [deg] between gravity and the legs' estimate of it: the steepest ground to start on, encoder offsets included
STEEP = 25.0
PLUMB, PULL = 30.0, (8.0, 12.0)  # [deg] between gravity and accelerometer; [m/s^2] range for a robot at rest
STANDS = 0.3  # [rad] from the pose, at most, to start a policy; ours: the shipped policies walk off from there


_IMU = ("ang_vel", "gravity", "acceleration")
KEPT = 125  # measurements kept while standing up: 2.5 s, since a gyro's bias adds up


def _in_turns(values: Floats) -> Floats:
    """Means (N // TURN, 3) over TURN rows of ``values`` (N, 3): less noise, and inexact times matter less."""
    return values[: len(values) // TURN * TURN].reshape(-1, TURN, 3).mean(axis=1)


def wrong_imu(seen: Sequence[Measurement], period: float) -> str:
    """What is wrong with the IMU's axes, from one measurement a period; "" if nothing, or if too little moved.

    Gravity must turn as the gyro says, and at rest point against the accelerometer. Two faults pass both
    checks: all sensors of the IMU are turned in the same way, or all swap the same axes and nothing tilts along the
    third. ``at_odds`` finds those.
    """
    if len(seen) <= TURN:
        return ""
    gyro, gravity, felt = (np.array([getattr(each, name) for each in seen]) for name in _IMU)
    turns = -period * np.cross(gyro[1:] + gyro[:-1], gravity[1:] + gravity[:-1]) / 4
    turned, tilted = (np.diff(_in_turns(each), axis=0) for each in (np.cumsum(turns, axis=0), gravity[1:]))
    by_gyro, by_gravity, missed = (float(np.linalg.norm(each)) for each in (turned, tilted, turned - tilted))
    if max(by_gyro, by_gravity) > TILTS and missed > MISSED * max(by_gyro, by_gravity):
        return f"while it stood up gravity tilted by {by_gravity:.2f} rad, by the gyro by {by_gyro:.2f}, and {missed:.2f} do not agree"
    pull = felt[-round(1.0 / period) :].mean(axis=0)
    if not PULL[0] < (size := float(np.linalg.norm(pull))) < PULL[1]:
        return ""
    angle = math.degrees(math.acos(np.clip(-(pull @ gravity[-1]) / size, -1.0, 1.0)))
    return f"gravity is {angle:.0f} degrees from what the accelerometer feels" if angle > PLUMB else ""


def at_odds(legs: Floats, gravity: Floats) -> str:
    """Compare measured ``gravity`` (N, 3), one a period, with the estimate of the ``legs`` (N, 3).

    Returns the difference in words; "" if they agree, or if too little is known.
    A slope shifts the two by a constant. Pitch and roll must therefore change alike, and the shift must not exceed the
    steepest slope.
    """
    known = np.isfinite(legs).all(axis=1)
    if known.sum() < TURN:
        return ""
    legs, gravity = (_in_turns(each[known]) for each in (legs, gravity))
    for name, axis in (("pitched", 0), ("rolled", 1)):
        by_legs, by_gravity, missed = (float(np.ptp(each[:, axis])) for each in (legs, gravity, legs - gravity))
        if max(by_legs, by_gravity) > TILTS and missed > MISSED * max(by_legs, by_gravity):
            both = f"{by_legs:.2f} rad by its legs, by gravity {by_gravity:.2f}"
            return f"while it stood up it {name} by {both}, and {missed:.2f} do not agree"
    cosine = legs[-1] @ gravity[-1] / np.linalg.norm(legs[-1]) / np.linalg.norm(gravity[-1])
    angle = math.degrees(math.acos(np.clip(cosine, -1.0, 1.0)))
    return f"gravity is {angle:.0f} degrees from where the legs have the ground" if angle > STEEP else ""


class Order(NamedTuple):
    """The command to the servos for the next period."""

    state: str
    # (D,) [rad] before clipping, for the limits to check; None: limp in ZERO, damped in DAMPING
    targets: Floats | None = None
    stiffness: Floats | None = None  # (D,); None: the contract's
    damping: Floats | None = None  # (D,); None: the contract's


class States:
    """The states of one robot. Input sources, limits and falls change them.

    ``command`` returns (C,) at a time [s] since the policy began; it applies while no source drives.
    ``say`` gets a line for each change.
    """

    first = STAND  # the state that the start button begins
    over, report, right = False, "", True  # true if the run ends now; text at its end, and whether that is good

    def __init__(
        self,
        controller: Controller,
        sources: Sequence[InputSource],
        command: Callable[[float], Floats],
        say: Callable[[str], None] = print,
    ) -> None:
        self.controller, self.sources, self._own, self._say = controller, list(sources), command, say
        self.state, self.since = ZERO, 0.0  # [s] begin of the state
        self.command = controller.contract.held(command(0.0))  # (C,) command in use
        self.note = f"{START}: {self.first}"
        self._from: Floats = controller.contract.default_pose  # (D,) [rad] pose at the start of standing up
        self._stiffer = 1.0
        # measurements since standing up began; the legs' estimate of gravity in each
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
        """Poll all input sources. Returns a trip for an emergency stop."""
        wishes = [source.poll(health) for source in self.sources]
        driving = next((i for i, wish in enumerate(wishes) if wish.command is not None), None)
        if driving is None:
            command = self._own(now - self.since if self.state == POLICY else 0.0)
        else:
            command = wishes[driving].command
            for source in self.sources[driving + 1 :]:
                source.let_go()
        self.command = self.controller.contract.held(np.asarray(command, dtype=float))
        self._pressed = frozenset().union(*(wish.pressed for wish in wishes))
        stop = next((wish.stop for wish in wishes if wish.stop), "")
        return Trip("stop", stop) if stop and self.state != DAMPING else None

    def step(self, measured: Measurement, now: float) -> Order:
        """Change the state by the pressed buttons; returns the servos' order."""
        self._move_on(measured, now)
        if self.state == STAND:
            return self._stand(measured, now)
        if self.state == POLICY:
            self.controller.act(measured, self.command)
            return Order(POLICY, self.controller.last_targets[0].copy())
        return Order(self.state)

    def trip(self, trip: Trip, now: float) -> Order:
        """A limit was passed: damp until a person starts the robot again."""
        if self.state != DAMPING:
            self._enter(DAMPING, now, trip.text)
        return Order(DAMPING)

    def close(self) -> None:
        """Release keys and files."""
        for source in self.sources:
            source.close()

    # ---- the changes

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
        """Start the policy if the robot stands."""
        contract = self.controller.contract
        off = np.abs(measured.joint_pos - contract.default_pose)
        if now - self.since < RISE or contract.ends.tilted(measured.gravity) or off.max() > STANDS:
            joint = contract.joints[int(off.argmax())]
            self._tell(
                f"{WALK} has to wait until the robot stands: {joint} is {off.max():.2f} rad from its pose after {now - self.since:.1f} s"
            )
            return
        gravity = np.array([each.gravity for each in self._rise])
        if why := wrong_imu(self._rise, contract.period) or (
            at_odds(np.array(self._down), gravity) if self._legs else ""
        ):
            self._tell(f"{WALK} is refused: {why}; look at how the IMU's axes are mounted and read")
            return
        self.controller.reset()
        self._enter(POLICY, now, f"{END}: damping")

    def _stand(self, measured: Measurement, now: float) -> Order:
        """Go straight to the default pose with rising gains. If a joint lags behind, all gains rise further.

        In the second half a robot with three feet or more sways to both sides, so that its IMU is seen to roll.
        """
        contract = self.controller.contract
        if len(self._rise) < KEPT:
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
        self._tell(note)

    def _tell(self, note: str) -> None:
        self.note = note
        self._say(f"{self.state}: {note}")
