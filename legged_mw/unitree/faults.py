"""Faults of a simulated robot and its wire, set by ``--serve unitree --fault NAME[=VALUE][@SECONDS]``."""

from __future__ import annotations

import heapq
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from legged_mw.deploy.robot import Floats
from legged_mw.utils.errors import UserError, unknown

OFF = "off"  # value that ends a fault


@dataclass
class Faults:
    """The current faults. They may change at any time."""

    delay_ms: float = 0.0  # [ms] of every message, each way
    jitter_ms: float = 0.0  # [ms] standard deviation of the delay
    loss: float = 0.0  # share of lost messages
    bad_crc: bool = False  # states with a wrong checksum
    frozen: bool = False  # the same state is sent repeatedly
    # frozen parts of the state, by their names in NAN, and joints with frozen encoders
    stuck: set[str] = field(default_factory=set)
    silent: bool = False  # no states are sent
    no_remote: bool = False  # the remote is off, which is 40 zeros
    clock_jump: float = 0.0  # [s] offset of the robot's clock
    mode_machine: int | None = None  # sent value; None: the correct one
    joint_order: int = 0  # number of slots by which the motors' connectors are shifted
    turned_joints: set[str] = field(default_factory=set)  # joints with reversed motors
    dead_motors: set[str] = field(default_factory=set)  # joints with motors that give no torque and report a fault
    joint_bias: Floats | float = 0.0  # (D,) [rad] added to measured angles
    joint_speed: Floats | float = 0.0  # (D,) [rad/s] added to measured speeds
    gyro_bias: Floats | float = 0.0  # (3,) [rad/s]
    imu_tilt: float = 0.0  # [deg] roll added to the measured orientation
    imu_swap: str = ""  # swapped IMU axes, of SWAPS, in quaternion and gyro
    nan: str = ""  # a part of the state that is NaN
    temperature: float = 35.0  # [deg C] of every motor
    voltage: float | None = None  # [V]; None: a full battery


class FaultKind(NamedTuple):
    """A fault that the command line can name."""

    field: str  # of Faults
    value: Any  # default without "=VALUE"; None: the value is required
    low: float = -math.inf
    high: float = math.inf
    unit: str = ""


NAN = {
    "q": "motor_state.q",
    "dq": "motor_state.dq",
    "gyroscope": "imu_state.gyroscope",
    "quaternion": "imu_state.quaternion",
}
SWAPS = {"xy": [1, 0, 2], "xz": [2, 1, 0], "yz": [0, 2, 1]}
KINDS = {
    "delay": FaultKind("delay_ms", 200.0, 0, 1000, "ms"),
    "jitter": FaultKind("jitter_ms", 20.0, 0, 1000, "ms"),
    "loss": FaultKind("loss", 100.0, 0, 100, "%"),
    **{name: FaultKind(name, True) for name in ("bad_crc", "frozen", "silent", "no_remote")},
    "clock_jump": FaultKind("clock_jump", -1.0, -1000, 1000, "s"),
    "mode_machine": FaultKind("mode_machine", 4, 0, 255),
    "joint_order": FaultKind("joint_order", 1, -40, 40, "places"),
    "joint_sign": FaultKind("turned_joints", None),
    "motor_fault": FaultKind("dead_motors", None),
    "stuck": FaultKind("stuck", None),
    "joint_bias": FaultKind("joint_bias", 2.0, unit="rad"),
    "joint_speed": FaultKind("joint_speed", 100.0, unit="rad/s"),
    "gyro_bias": FaultKind("gyro_bias", 0.5, unit="rad/s"),
    "imu_tilt": FaultKind("imu_tilt", 180.0, unit="deg"),
    "imu_swap": FaultKind("imu_swap", "xz"),
    "nan": FaultKind("nan", "q"),
    "hot_motor": FaultKind("temperature", 95.0, 0, 127, "deg C"),
    "low_battery": FaultKind("voltage", 20.0, 0, unit="V"),
}


class Fault(NamedTuple):
    """One fault and its start."""

    text: str  # as written on the command line
    field: str  # of Faults
    value: Any
    time: float  # [s]

    def begin(self, faults: Faults) -> None:
        value = self.value
        if isinstance(value, set) and value:
            value = value | getattr(faults, self.field)  # add a joint to the set
        setattr(faults, self.field, value)


def parse_faults(texts: Sequence[str], joints: Sequence[str]) -> list[Fault]:
    """Parse comma-separated NAME[=VALUE][@SECONDS] texts; returns the faults sorted by time. Raises UserError."""
    faults = [_parse(part, joints) for text in texts for part in text.split(",")]
    return sorted(faults, key=lambda fault: fault.time)


def _parse(text: str, joints: Sequence[str]) -> Fault:
    name, value, time = re.fullmatch(r"([^=@]*)(?:=([^@]*))?(?:@(.*))?", text).groups()  # type: ignore[union-attr]
    where = f"--fault {text}"
    if name not in KINDS:
        raise UserError(f"{where}: {unknown('fault', name, KINDS, 'what a served robot can have')}")
    if not 0.0 <= (seconds := _number(time or "0")) < math.inf:
        raise UserError(f"{where}: after @ write the start time, a number of seconds from 0")
    kind = KINDS[name]
    return Fault(
        text,
        kind.field,
        getattr(Faults(), kind.field) if value == OFF else _value(name, kind, value, joints, where),
        seconds,
    )


def _value(name: str, kind: FaultKind, value: str | None, joints: Sequence[str], where: str) -> Any:
    words = {"nan": NAN, "imu_swap": SWAPS}
    known = words.get(name, [*joints, *NAN] if name == "stuck" else joints if kind.value is None else None)
    if known is not None and value is not None:
        if value not in known:
            raise UserError(f"{where}: {unknown('value', value, known, name)}")
        return value if name in words else {value}
    if value is None:
        if kind.value is None:
            raise UserError(f"{where}: name the joint, e.g. {name}={joints[0]}")
        return kind.value / 100 if name == "loss" else kind.value
    if kind.value is True:
        raise UserError(f"{where}: {name} has no value but {OFF}")
    if not kind.low <= (number := _number(value)) <= kind.high or math.isinf(number):
        ends = (
            ""
            if math.isinf(kind.low)
            else f" from {kind.low:g}" + ("" if math.isinf(kind.high) else f" to {kind.high:g}")
        )
        raise UserError(f"{where}: {name} is a number{ends}{f' [{kind.unit}]' if kind.unit else ''}, or {OFF}")
    return number / 100 if name == "loss" else int(number) if isinstance(kind.value, int) else number


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


class Line:
    """One direction of the wire, which delays, reorders or loses messages."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng, self._queue, self._count = rng, list[tuple[float, int, bytes]](), 0

    def put(self, now: float, body: bytes, faults: Faults) -> None:
        if faults.loss and self._rng.random() < faults.loss:
            return
        delay = max(
            0.0, faults.delay_ms + (faults.jitter_ms * self._rng.standard_normal() if faults.jitter_ms else 0.0)
        )
        self._count += 1
        heapq.heappush(self._queue, (now + delay / 1000, self._count, body))

    def due(self, now: float) -> list[bytes]:
        out = []
        while self._queue and self._queue[0][0] <= now + 1e-9:
            out.append(heapq.heappop(self._queue)[2])
        return out
