"""Safety limits between a policy and a robot, checked in every step. An exceeded limit gives a `Trip`.

The caller of `Safety` damps the robot. This module moves no joint, reads no clock and depends on no type of robot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from legged_mw.deploy.contract import CONTRACT_FILE, SCENE_FILE, Contract, compile_scene, part
from legged_mw.deploy.loop import LATE
from legged_mw.deploy.robot import Floats, Health, Measurement, RobotError
from legged_mw.utils.errors import UserError, unknown

TORQUE = "torque"  # origin of an action: its targets are torques
OFF = math.inf  # value of a limit that is switched off
# Bounds that no valid measurement exceeds. Ours: a wheel may turn many times; gyros saturate at 35 rad/s.
_ABSURD = {"joint_pos": (1e5, "rad"), "joint_vel": (1e4, "rad/s"), "ang_vel": (1e3, "rad/s")}
# A sensor is frozen if its value is bitwise constant while another sensor measures motion.
# Both are compared over _ALONE * Limits.frozen measurements. The thresholds of motion are ours: the resolution of an
# encoder or a gyro is a hundredth of them, and a standing robot moves less.
_ALONE = 3.0  # 0.24 s at 50 Hz: one coarse sensor can repeat its value for this time, all sensors cannot
_MOVED = 0.05  # [rad] motion of a joint, of the body (by gyro or gravity), or of a target if the body also moves
_SWUNG = 0.1  # [rad] motion of a joint after which gyro and gravity must have changed
_ASKED = 0.2  # [rad] motion of a joint's target after which its encoder must have changed
_UNIT = 0.1  # [-] largest deviation of gravity's length from 1; ours: a unit quaternion in float32 gives 1e-6


class LimitError(UserError, ValueError):
    """An unknown limit or an invalid value of a limit."""


class Trip(NamedTuple):
    """An exceeded limit."""

    limit: str  # name of the limit: a field of Limits, or another such as "finite", "fall", "stop", "robot"
    text: str  # the measured value and the limit, in one line


class Tripped(RobotError):
    """A trip ended the run. The robot is damped."""

    def __init__(self, trip: Trip) -> None:
        self.trip = trip
        super().__init__(f"{trip.text}; the joints are damped")


@dataclass(frozen=True)
class Limits:
    """Limits of D joints in the contract's order. The first three come from the scene.

    A default without a source is ours: the largest value of the eleven shipped policies that walk, in the walking exam
    with the pushes of its mark (in brackets, 2026-11-30), plus a margin. A robot's class or a contract can set tighter
    limits.
    """

    low: Floats  # (D,) [rad] range of the joints
    high: Floats  # (D,) [rad]
    motor: Floats  # (D,) [N m] largest torque of the motors
    position: float = 0.25  # [rad] measured angle beyond the range [0.20: simulated joint limits are soft]
    target: float = 1.5  # [rad] target beyond the range [0.59; g1_rough 1.10, pushed]
    step: float = 2.5  # [rad] difference of two consecutive targets of a joint [1.91]
    torque: float = 2.0  # [share of `motor`] computed torque of a servo [1.46; go1_rough 2.10, pushed]
    speed: float = 60.0  # [rad/s] joint speed [55; go1_rough 59, pushed]
    # [deg] tilt of the body [20]. The contract's `max_tilt` replaces it if less or above 90; off without `max_tilt`
    tilt: float = 60.0
    temperature: float = 85.0  # [deg C] of a motor; drives switch off at 90
    voltage: float = -OFF  # [V] lowest voltage of the battery; a robot's class sets it
    age: float = 2.0  # [periods] age of the newest measurement
    frozen: float = 4.0  # bitwise identical consecutive measurements
    late: float = 5.0  # steps in one second that began more than half a period late, or not at all
    remote: float = 3.0  # [s] since the remote was last received, if it ever was [unitree_rl_lab]

    @staticmethod
    def of(
        folder: Path, contract: Contract, robot: Mapping[str, Any] | None = None, asked: Mapping[str, Any] | None = None
    ) -> Limits:
        """The limits of the export in ``folder``. Raises LimitError.

        There are four sources. A later one overrides: the scene, the contract's section ``safety``, ``robot``
        (limits of the robot's class), ``asked`` (limits of the command line).
        """
        max_tilt = OFF if contract.ends.max_tilt is None else contract.ends.max_tilt
        limits = replace(
            limits_of(compile_scene(part(folder, SCENE_FILE)), contract),
            tilt=max_tilt if max_tilt > 90.0 else min(Limits.tilt, max_tilt),
        )
        for values, where in (
            (contract.safety, f"{CONTRACT_FILE}: safety"),
            (robot, "Robot.limits"),
            (asked, "--limit"),
        ):
            limits = limits.but(values or {}, where)
        return limits

    def but(self, values: Mapping[str, Any], where: str) -> Limits:
        """A copy with the named limits replaced. "off" switches a limit off. Raises LimitError."""
        return replace(self, **{name: _value(name, value, where) for name, value in values.items()})


NAMES = tuple(f.name for f in fields(Limits) if f.default is not MISSING)


def parse_limits(texts: Sequence[str]) -> dict[str, str]:
    """Name -> value, from texts "NAME=VALUE" of the command line. Raises LimitError."""
    for text in texts:
        if "=" not in text:
            raise LimitError(f"--limit {text}: write NAME=VALUE or NAME=off; there are: {', '.join(NAMES)}")
    return {name.strip(): value.strip() for name, _, value in (text.partition("=") for text in texts)}


def _value(name: str, value: Any, where: str) -> float:
    if name not in NAMES:
        raise LimitError(f"{where}: {unknown('limit', name, NAMES, 'the safety layer')}")
    if value is False or value == "off":  # YAML reads `off` as False; a limit of 0 is not off
        return -OFF if name == "voltage" else OFF
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if isinstance(value, bool) or not number >= 0.0:
        raise LimitError(f"{where}: {name} is {value!r}; it must be a number from 0, or off")
    return number


def limits_of(model: Any, contract: Contract) -> Limits:
    """Joint ranges and torque limits from the compiled scene of an export. A missing one is "off"."""
    joints = [model.joint(name).id for name in contract.joints]
    servos = [model.actuator(name).id for name in contract.joints]
    low, high = np.where(model.jnt_limited[joints, None] > 0, model.jnt_range[joints], [-OFF, OFF]).T
    servo = np.where(model.actuator_forcelimited[servos] > 0, model.actuator_forcerange[servos, 1], OFF)
    joint = np.where(model.jnt_actfrclimited[joints] > 0, model.jnt_actfrcrange[joints, 1], OFF)
    return Limits(low, high, np.minimum(servo, joint))


class _Signals(NamedTuple):
    """The motion signals of one measurement, and the servos' previous target. Of N measurements each is (N, ...)."""

    joint_pos: Floats
    joint_vel: Floats
    ang_vel: Floats
    gravity: Floats
    target: Floats


class Safety:
    """Checks the measurements and targets of one robot. It stores the last steps only."""

    def __init__(self, contract: Contract, limits: Limits) -> None:
        if contract.action.origin == "speed":
            raise RobotError(
                f"{CONTRACT_FILE}: the policy commands speeds, which no limit here judges: grade and watch it in simulation"
            )
        self.contract, self.limits = contract, limits
        self.reset()

    def reset(self) -> None:
        """Forget all steps, for a new start of the robot."""
        self._last: Floats | None = None  # (D,) targets of the previous step, before clipping
        self._held: Floats | None = None  # (D,) the same after clipping
        self._seen = deque[_Signals](
            maxlen=max(1, math.ceil(_ALONE * self.limits.frozen)) if self.limits.frozen < OFF else 1
        )
        self._same = dict.fromkeys(_Signals._fields[:4], 0)  # sensor -> consecutive identical values
        self._stuck = np.zeros(len(self.contract.joints), int)  # (D,) consecutive identical angles
        self._changed = set[
            str
        ]()  # sensors except joint_pos that changed at least once; a missing sensor never changes
        self._late: deque[float] = deque()  # [s] times of late and left out steps in the last second
        self._remote: float | None = None  # [s] time at which the remote was last received

    def sensed(
        self, measured: Measurement, health: Health, now: float, behind: float = 0.0, skipped: int = 0
    ) -> Trip | None:
        """The first limit that a measurement exceeds.

        ``now`` [s]; ``behind`` [s]: delay of the step's begin; ``skipped``: periods that were left out before it.
        """
        return (
            self._finite(measured)
            or self._fresh(measured, health)
            or self._on_time(now, behind, skipped)
            or self._joints(measured)
            or self._tilt(measured)
            or self._machine(health)
            or self._heard(health, now)
        )

    def asked(
        self, measured: Measurement, targets: Floats, stiffness: Floats | None = None, damping: Floats | None = None
    ) -> Trip | None:
        """The first limit that ``targets`` (D,) [rad], or torques [N m], exceed.

        ``stiffness`` and ``damping`` (D,) of the servos; None: the contract's.
        """
        limits, contract = self.limits, self.contract
        text = "is asked for {value:.1f} N m, more than {most:.1f}"
        if not (finite := np.isfinite(targets)).all():
            joint = _first(~finite)
            return Trip("finite", f"the target of {contract.joints[joint]} is not finite: {targets[joint]}")
        if contract.action.origin == TORQUE and stiffness is None:
            return self._most("torque", text, np.abs(targets), limits.torque * limits.motor)
        stiffness = contract.stiffness if stiffness is None else stiffness
        damping = contract.damping if damping is None else damping
        held = contract.action.held(targets)
        torque = np.abs(stiffness * (held - measured.joint_pos) - damping * measured.joint_vel)
        step = np.zeros_like(targets) if self._last is None else np.abs(targets - self._last)
        trip = (
            self._range("target", "is told to go to", targets, limits.target)
            or self._most(
                "step",
                "is told to step by {value:.2f} rad from one target to the next, more than {most:.2f}",
                step,
                limits.step,
            )
            or self._most("torque", text, torque, limits.torque * limits.motor)
        )
        self._last, self._held = np.array(targets), held
        return trip

    # ---- one method per limit. NaN exceeds a limit.

    def _finite(self, measured: Measurement) -> Trip | None:
        for name in ("joint_pos", "joint_vel", "gravity", "ang_vel"):
            if not np.isfinite(getattr(measured, name)).all():
                return Trip("finite", f"a measured value is not finite: {name}")
        for name, (most, unit) in _ABSURD.items():
            if (value := np.abs(getattr(measured, name)).max()) > most:
                return Trip("finite", f"a measured value is impossible: {name} of {value:.3g} {unit}")
        if abs((length := float(np.linalg.norm(measured.gravity))) - 1.0) > _UNIT:
            return Trip(
                "finite",
                f"a measured value is impossible: gravity of length {length:.2f}, not 1: the IMU sends no orientation",
            )
        return None

    def _fresh(self, measured: Measurement, health: Health) -> Trip | None:
        age, most = health.age_s, self.limits.age * self.contract.period
        if age is not None and age < -most:
            return Trip("age", f"the newest measurement comes from {-1e3 * age:.0f} ms ahead: a clock went back")
        if age is not None and not age <= most:
            return Trip("age", f"the newest measurement is {1e3 * age:.0f} ms old, more than {1e3 * most:.0f}")
        return self._alive(measured)

    def _alive(self, measured: Measurement) -> Trip | None:
        """Trip if the measurement is frozen, or one sensor is frozen while others measure motion."""
        target = measured.joint_pos if self._held is None else self._held
        parts = measured.joint_pos, measured.joint_vel, measured.ang_vel, measured.gravity, target
        signals = _Signals(*map(np.array, parts))  # copies: a robot may reuse its arrays
        previous = self._seen[-1] if self._seen else signals
        self._seen.append(signals)
        self._stuck = np.where(signals.joint_pos == previous.joint_pos, self._stuck + 1, 1)
        self._same["joint_pos"] = int(self._stuck.min())
        for i, name in enumerate(_Signals._fields[1:4], start=1):
            self._same[name] = self._same[name] + 1 if signals[i].tobytes() == previous[i].tobytes() else 1
            if signals is not previous and self._same[name] == 1:
                self._changed.add(name)
        if (count := min(self._same[name] for name in ("joint_pos", "joint_vel", "ang_vel"))) >= self.limits.frozen:
            return Trip("frozen", f"{count} measurements in a row are the same")
        stuck = self._stuck >= _ALONE * self.limits.frozen
        frozen = [
            name for name in ("joint_pos", *sorted(self._changed)) if self._same[name] >= _ALONE * self.limits.frozen
        ]
        return self._contradicted(frozen, stuck) if frozen or stuck.any() else None

    def _contradicted(self, frozen: list[str], stuck: Any) -> Trip | None:
        """Trip on the first sensor of ``frozen`` or joint of ``stuck`` (D,) that moved according to other sensors."""
        seen = _Signals(*map(np.array, zip(*self._seen, strict=True)))
        count, period = len(seen.joint_pos), self.contract.period
        # a joint needs time to follow the newest targets
        by_target = np.ptp(seen.target[: count - count // 3], axis=0)
        by_speed = np.ptp(period * np.cumsum(seen.joint_vel, axis=0), axis=0)
        by_angle, by_gravity = float(np.ptp(seen.joint_pos, axis=0).max()), float(np.ptp(seen.gravity, axis=0).max())
        by_gyro = float(np.ptp(period * np.cumsum(np.cross(seen.ang_vel, seen.gravity), axis=0), axis=0).max())
        # if a person carries or pushes the robot, the joints may stay still
        driven = by_target.max() > _ASKED or (by_target.max() > _MOVED and max(by_gravity, by_gyro) > _MOVED)
        must_move = {
            "joint_pos": driven or by_speed.max() > _MOVED,
            "joint_vel": driven or by_angle > _MOVED,
            "ang_vel": by_angle > _SWUNG or by_gravity > _MOVED,
            "gravity": by_angle > _SWUNG or by_gyro > _MOVED,
        }
        for name in frozen:
            if must_move[name]:
                return Trip("frozen", f"{name} is the same in {count} measurements in a row, though the robot moves")
        if (faulty := stuck & ((by_speed > _MOVED) | (by_target > _ASKED))).any():
            joint = self.contract.joints[_first(faulty)]
            return Trip(
                "frozen", f"the angle of {joint} is the same in {count} measurements in a row, though it is driven"
            )
        return None

    def _on_time(self, now: float, behind: float, skipped: int) -> Trip | None:
        self._late.extend([now] * (skipped + (behind > LATE * self.contract.period)))
        while self._late and now - self._late[0] >= 1.0:
            self._late.popleft()
        if (count := len(self._late)) >= self.limits.late:
            what = f"the last by {1e3 * behind:.0f} ms" if behind else "by more than half a period"
            what = f"or not at all: {skipped} before this one" if skipped else what
            return Trip("late", f"{count} steps within a second began late, {what}")
        return None

    def _joints(self, measured: Measurement) -> Trip | None:
        text = "turns at {value:.1f} rad/s, more than {most:.1f}"
        return self._range("position", "is at", measured.joint_pos, self.limits.position) or self._most(
            "speed", text, np.abs(measured.joint_vel), self.limits.speed
        )

    def _tilt(self, measured: Measurement) -> Trip | None:
        """Trip if the tilt exceeds the robot's limit. The task's rule, ``Ends.tilted``, applies to the policy only."""
        tilt = math.degrees(math.acos(np.clip(-measured.gravity[2], -1.0, 1.0)))
        return (
            None
            if tilt <= self.limits.tilt
            else Trip("tilt", f"the body is tilted by {tilt:.0f} degrees, more than {self.limits.tilt:g}")
        )

    def _machine(self, health: Health) -> Trip | None:
        for joint, fault in health.motor_faults.items():
            return Trip("motor", f"the motor of {joint} reports a fault: {fault}")
        if health.voltage is not None and not health.voltage >= self.limits.voltage:
            return Trip("voltage", f"the battery has {health.voltage:.1f} V, less than {self.limits.voltage:g}")
        if health.temperatures is None:
            return None
        text = "has a motor of {value:.0f} deg C, more than {most:.0f}"
        return self._most("temperature", text, health.temperatures, self.limits.temperature)

    def _heard(self, health: Health, now: float) -> Trip | None:
        if health.remote is not None:
            self._remote = now
        if self._remote is None or now - self._remote < self.limits.remote:
            return None
        return Trip("remote", f"the remote was not heard for {now - self._remote:.1f} s")

    # ---- comparisons of all joints

    def _most(self, limit: str, words: str, values: Floats, most: float | Floats) -> Trip | None:
        most = np.broadcast_to(most, values.shape)
        if (within := values <= most).all():
            return None
        joint = _first(~within)
        return Trip(limit, f"{self.contract.joints[joint]} {words.format(value=values[joint], most=most[joint])}")

    def _range(self, limit: str, words: str, values: Floats, margin: float) -> Trip | None:
        low, high = self.limits.low, self.limits.high
        if (within := (values >= low - margin) & (values <= high + margin)).all():
            return None
        joint = _first(~within)
        name, ends = self.contract.joints[joint], f"{low[joint]:.2f} to {high[joint]:.2f}"
        beyond = max(low[joint] - values[joint], values[joint] - high[joint])
        return Trip(
            limit,
            f"{name} {words} {values[joint]:.2f} rad, {beyond:.2f} beyond its range {ends}; {margin:.2f} is the most",
        )


def _first(wrong: Any) -> int:
    """Index of the first true value."""
    return int(np.argmax(wrong))
