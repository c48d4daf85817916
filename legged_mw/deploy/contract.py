"""The contract of an exported policy: ``policy.yaml``. It is checked against the network and the scene beside it.

The export writes it with this module, and ``legged_mw.deploy`` reads it. This module steps no physics and no policy.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.utils.config import load_yaml
from legged_mw.utils.errors import UserError, brief, unknown
from legged_mw.utils.files import digest, finish_moving
from legged_mw.utils.motor_heat import BATTERY, TABLES, Ratings
from legged_mw.utils.motor_network import (
    DC_CONSTANT,
    DC_DAMPING,
    DC_RESISTANCE,
    DC_STIFFNESS,
    Floats,
    MotorNetwork,
    read_network,
)

# ---- typed values of a contract -------------------------------------------------------------------------------------


MOST = 1e6  # upper bound of any quantity of a robot, in any unit
MOST_VALUES = 10_000_000  # upper bound of an observation's values; a camera picture has 10 % of it


class ContractError(UserError, ValueError):
    """The export cannot be deployed. The text names the file, the value, the expected value and what to do."""


class Reader:
    """Reads typed values from a mapping. A missing or ill-typed value raises ContractError with one line."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.values, self.where = values, where

    def take(self, key: str, wanted: str, fits: Callable[[Any], bool]) -> Any:
        """The value of ``key``. Raises ContractError unless it ``fits``. ``wanted`` describes a valid value."""
        if key not in self.values or not fits(self.values[key]):
            problem = f"is {brief(self.values[key])}" if key in self.values else "is missing"
            raise ContractError(f"{self.where}: '{key}' {problem}; it must be {wanted}")
        return self.values[key]

    def section(self, key: str) -> Reader:
        return Reader(self.take(key, "a mapping", lambda v: isinstance(v, dict)), f"{self.where}: {key}")

    def sections(self, key: str, empty: bool = False) -> list[Reader]:
        items = self.take(key, "a list of mappings", lambda v: is_list(v, lambda item: isinstance(item, dict), empty))
        return [Reader(item, f"{self.where}: {key}[{i}]") for i, item in enumerate(items)]

    def text(self, key: str, empty: bool = False) -> str:
        return self.take(key, "text", lambda v: isinstance(v, str) and (empty or v != ""))

    def texts(self, key: str, empty: bool = False) -> tuple[str, ...]:
        return tuple(self.take(key, "a list of names", lambda v: is_list(v, lambda item: isinstance(item, str), empty)))

    def count(self, key: str, most: int = MOST_VALUES) -> int:
        value = self.take(
            key, "a whole number from 1", lambda v: isinstance(v, int) and not isinstance(v, bool) and v >= 1
        )
        return value if value <= most else self.take(key, f"{most} at most", lambda v: False)

    def number(self, key: str, low: float = -MOST, high: float = MOST) -> float:
        beyond = is_number(self.values.get(key)) and abs(self.values[key]) > MOST
        limits = (f" from {low:g}" if beyond or low > -MOST else "") + (
            f" to {high:g}" if beyond or high < MOST else ""
        )
        return float(self.take(key, f"a number{limits}", lambda v: is_number(v) and low <= v <= high))

    def above_zero(self, key: str, high: float = MOST) -> float:
        self.number(key, -MOST, high)
        return float(self.take(key, "above zero", lambda v: v > 0))

    def numbers(self, key: str, count: int, of: str, low: float = -MOST, high: float = MOST) -> np.ndarray:
        value = self.take(key, f"{count} numbers, one a {of}", lambda v: is_list(v, is_number) and len(v) == count)
        self.take(key, f"numbers from {low:g} to {high:g}", lambda v: low <= min(v) and max(v) <= high)
        return np.array(value, dtype=float)

    def file(self, key: str, name: str) -> None:
        """Check a file name. The files of an export have fixed names and are beside the contract."""
        if key in self.values:
            self.take(key, f"{name}, which lies beside {self.where.partition(':')[0]}", lambda v: v == name)

    def scale(self, count: int, of: str) -> np.ndarray:
        """The value of ``scale``: one number per value. The file may give one number for all."""
        expected = f"a number, or {count} numbers, one a {of}"
        value = self.take("scale", expected, lambda v: is_number(v) or (is_list(v, is_number) and len(v) == count))
        self.take("scale", f"of {MOST:g} at most", lambda v: np.max(np.abs(v)) <= MOST)
        return np.full(count, value, dtype=float) if is_number(value) else np.array(value, dtype=float)


def compile_scene(file: Path) -> Any:
    """Compile the scene of an export. Raises ContractError."""
    from legged_mw.robot.mjcf import XmlSource, check_model  # imports MuJoCo

    try:
        model = XmlSource(file, alone=True).spec().compile()
        check_model(model)
    except (ValueError, OSError) as error:
        raise ContractError(f"{file.name} is not a valid MJCF: {' '.join(str(error).split())}") from None
    return model


def is_number(value: object) -> bool:
    # an int can be too large for a float
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300


def is_list(value: object, fits: Callable[[Any], bool], empty: bool = False) -> bool:
    return isinstance(value, list) and (empty or len(value) > 0) and all(map(fits, value))


# ---- action ---------------------------------------------------------------------------------------------------------


ORIGINS = ("default", "joints", "targets", "torque", "speed")
_LARGEST = 1000.0  # legged_gym clips at 100
_BEYOND = 1e-3  # [rad] tolerance of a pose beyond its range, for rounding


class Action(NamedTuple):
    """The meaning of an action: joint target [rad] = origin + scale * action.

    With the origins "torque" and "speed": torque [N m] or speed [rad/s] = scale * action.
    The limits and the origin "targets" use the target before clipping. The servo gets the clipped target.
    """

    # "default": the default pose; "joints": the measured angles; "targets": the last targets; "torque", "speed": zero
    origin: str
    scale: np.ndarray  # (D,) [rad], [N m] or [rad/s]
    clip: float  # [-] largest |action|
    lowest: np.ndarray  # (D,) lowest target of the servo, as in training; -MOST: no limit
    highest: np.ndarray  # (D,) highest target; MOST: no limit

    @property
    def of_angles(self) -> bool:
        """Whether the targets are angles, not torques or speeds."""
        return self.origin not in ("torque", "speed")

    def held(self, targets: np.ndarray) -> np.ndarray:
        """Clip ``targets`` (..., D) to the range; NaN stays."""
        return np.clip(targets, self.lowest, self.highest)

    def to_dict(self) -> dict[str, Any]:
        values = {
            name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in self._asdict().items()
        }
        return values | {"scale": short(values["scale"])}


def short(values: Sequence[Any]) -> Any:
    """One number if all values are equal, else the list."""
    return values[0] if len(set(values)) == 1 else list(values)


def read_action(action: Reader, joints: Sequence[str], scene: Path | None) -> Action:
    """Read the section ``action``. ``scene`` gives the range of the targets for formats before 5."""
    origin, count = action.take("origin", f"one of {', '.join(ORIGINS)}", lambda v: v in ORIGINS), len(joints)
    scale = action.scale(count, "joint")
    action.take("scale", "other than 0, which moves nothing", lambda _: bool(scale.any()))
    clip = action.above_zero("clip", _LARGEST)
    if scene:
        return Action(origin, scale, clip, *_range_of_scene(scene, joints))
    lowest, highest = (action.numbers(key, count, "joint") for key in ("lowest", "highest"))
    action.take("highest", "at least `lowest`", lambda _: bool((lowest <= highest).all()))
    return Action(origin, scale, clip, lowest, highest)


def target_range(model: mujoco.MjModel, actuators: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest target (D,) of the motors ``actuators``; -MOST and MOST without a limit."""
    held, ranges = model.actuator_ctrllimited[list(actuators), None] > 0, model.actuator_ctrlrange[list(actuators)]
    lowest, highest = np.where(held, ranges, [-MOST, MOST]).T
    return lowest, highest


def _range_of_scene(scene: Path, joints: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
    if not scene.is_file():
        raise ContractError(
            f"policy.yaml has an old format without the range of the targets, and {scene.name}, which has it, is missing: put it there, "
            "or export the policy again"
        )
    model = compile_scene(scene)
    names = [model.actuator(i).name for i in range(model.nu)]
    if missing := [name for name in joints if name not in names]:
        raise ContractError(f"policy.yaml: joints: {unknown('servo', missing[0], names, scene.name)}")
    return target_range(model, [names.index(name) for name in joints])


def check_pose(action: Action, joints: Sequence[str], pose: np.ndarray) -> None:
    """Raise ContractError if ``pose`` (D,) [rad] is beyond the range of the targets."""
    for joint in np.flatnonzero((pose < action.lowest - _BEYOND) | (pose > action.highest + _BEYOND)).tolist():
        raise ContractError(
            f"policy.yaml: default_pose of {joints[joint]} is {pose[joint]:g} rad, beyond the range of its targets, "
            f"{action.lowest[joint]:g} to {action.highest[joint]:g} rad (action: lowest, highest)"
        )


# ---- estimate -------------------------------------------------------------------------------------------------------


ESTIMATE = "estimate"  # name of the network's output, and of the contract's section with its rows


class Estimated(NamedTuple):
    """One row of the estimate."""

    name: str
    size: int
    unit: str
    frame: str


def read_estimated(rows: Sequence[Any]) -> tuple[Estimated, ...]:
    """Read the rows of the section ``estimate``."""
    return tuple(
        Estimated(row.text("name"), row.count("size"), row.text("unit", empty=True), row.text("frame", empty=True))
        for row in rows
    )


def columns_of(rows: Sequence[Estimated], name: str) -> slice | None:
    """Columns of the row ``name`` in the estimate; None if there is no such row."""
    start = 0
    for row in rows:
        if row.name == name:
            return slice(start, start + row.size)
        start += row.size
    return None


# ---- memory of a recurrent network ----------------------------------------------------------------------------------


MEMORY = "memory"  # subsection of `network` in the contract


class NetworkMemory(NamedTuple):
    """Memory of a recurrent network: an output (batch, *shape) that is an input of the next step. It starts at zero."""

    input: str
    output: str
    shape: tuple[int, ...]  # states, values per state; for an LSTM h of all layers, then c of all layers

    def start(self, count: int) -> NDArray[np.float32]:
        """The memory of ``count`` robots at the start: zeros."""
        return np.zeros((count, *self.shape), dtype=np.float32)

    def to_dict(self) -> dict[str, Any]:
        return {**self._asdict(), "shape": list(self.shape)}


def read_memory(section: Reader) -> NetworkMemory:
    """Read the section ``memory``."""
    expected = "two whole numbers from 1: states and the size of each"
    shape = section.take(
        "shape", expected, lambda v: isinstance(v, list) and len(v) == 2 and all(type(n) is int and n >= 1 for n in v)
    )
    section.take("shape", f"{MOST_VALUES} values at most", lambda v: v[0] * v[1] <= MOST_VALUES)
    return NetworkMemory(section.text("input"), section.text("output"), tuple(shape))


# ---- reference motion -----------------------------------------------------------------------------------------------


MOTION, MOTION_FILE = "motion", "motion.npz"  # section; file, in the format of legged_mw.skills.clip
JOINT_POS, JOINT_VEL, PLACE, TURN = "reference_joint_pos", "reference_joint_vel", "anchor_pos", "anchor_ori"
REFERENCE = (JOINT_POS, JOINT_VEL, PLACE, TURN)  # rows that the controller computes from the motion
# in Measurement.others: attitude (4,) w x y z and position (3,) [m] of the root, world frame
ATTITUDE, POSITION = "attitude", "position"


class FollowedMotion(NamedTuple):
    """The reference motion of a policy: its file, its anchor body and the tracked bodies."""

    anchor: str
    bodies: tuple[str, ...]  # tracked in training
    digest: str  # SHA-256 of MOTION_FILE

    def to_dict(self) -> dict[str, Any]:
        return {"file": MOTION_FILE, "sha256": self.digest, "anchor": self.anchor, "bodies": list(self.bodies)}


def read_motion(section: Reader) -> FollowedMotion:
    """Read the section ``motion``."""
    bodies = section.texts("bodies")
    section.file("file", MOTION_FILE)
    return FollowedMotion(
        section.take("anchor", "one of `bodies`", lambda v: v in bodies), bodies, section.text("sha256")
    )


# ---- motors ---------------------------------------------------------------------------------------------------------


MOTORS, MOTORS_FILE = "motors", "motors.npz"
LAWS = ("servo", "dc_motor", "torque", "network")  # docs/motors.md
_ACTIVATIONS: dict[str, Callable[[Floats], Floats]] = {
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "relu": lambda x: np.maximum(x, 0),
    "softsign": lambda x: x / (1 + np.abs(x)),
    "tanh": np.tanh,
}


class Motors(NamedTuple):
    """The motors in simulation: the law from joint target to torque. A real robot does not use it."""

    law: str = "servo"
    stall_torque: tuple[float, ...] = ()  # (D,) [N m] at the joint; empty: no torque-speed curve
    no_load_speed: tuple[float, ...] = ()  # (D,) [rad/s] at the joint; empty: no torque-speed curve
    digest: str = ""  # SHA-256 of the network's file

    def to_dict(self) -> dict[str, Any]:
        """The section ``motors``; empty for servos."""
        curve = (
            {"stall_torque": list(self.stall_torque), "no_load_speed": list(self.no_load_speed)}
            if self.stall_torque
            else {}
        )
        network = {"file": MOTORS_FILE, "sha256": self.digest} if self.digest else {}
        return {MOTORS: {"law": self.law, **curve, **network}} if self.law != "servo" else {}

    def gains(self, model: mujoco.MjModel, actuators: list[int], dofs: np.ndarray) -> dict[str, np.ndarray]:
        """Gains and torque-speed curve of ``model``: name in the contract -> (D,)."""
        prm = model.actuator_gainprm[actuators]
        gains = {}
        if self.law == "servo":
            gains = {"stiffness": prm[:, 0], "damping": model.dof_damping[dofs].reshape(len(dofs), -1)[:, 0]}
        elif self.law == "dc_motor":
            gains = {"stiffness": prm[:, DC_STIFFNESS], "damping": prm[:, DC_DAMPING]}
        if self.stall_torque:
            constant, resistance = np.maximum(prm[:, DC_CONSTANT], 1e-12), np.maximum(prm[:, DC_RESISTANCE], 1e-12)
            gains |= {"motors: stall_torque": constant / resistance, "motors: no_load_speed": 1.0 / constant}
        return gains

    def limp(self, batch: Any) -> None:
        """Switch off the motors of ``batch``, which are not servos. DC motors keep their damping."""
        if self.law == "dc_motor":
            batch.expand("actuator_gainprm")[:, :, DC_STIFFNESS] = 0.0
        else:
            batch.expand("actuator_gear")[:] = 0.0


SERVOS = Motors()
RATINGS = "ratings"


def make_ratings(tables: Mapping[str, Sequence[float | None]], battery_power: float | None, joints: int) -> Ratings:
    """Ratings from lists (D,). None is an unknown value; a missing table is unknown."""
    full = {name: np.array(tables.get(name, [None] * joints), dtype=float) for name in TABLES}
    return Ratings(**full, battery_power=math.nan if battery_power is None else battery_power)


def read_ratings(section: Reader, joints: int) -> Ratings:
    """Read the section ``ratings``. Each table has one number for all motors or one per joint; null: unknown."""
    for name in section.values:
        if name not in Ratings._fields:
            raise ContractError(f"{section.where}: {unknown('rating', name, Ratings._fields, RATINGS)}")
    tables, expected = {}, f"a number above zero, or {joints} of them, one a joint, null where unknown"
    for name in TABLES:
        if name in section.values:
            value = section.take(
                name, expected, lambda v: _rates(v) or (is_list(v, _rates_or_none) and len(v) == joints)
            )
            tables[name] = value if isinstance(value, list) else [value] * joints
    return make_ratings(tables, section.above_zero(BATTERY) if BATTERY in section.values else None, joints)


def ratings_to_dict(ratings: Ratings) -> dict[str, Any]:
    """The section ``ratings``: the known ratings, one number if equal for all motors. Empty if none is known."""
    known = {name: values for name in TABLES if not np.isnan(values := getattr(ratings, name)).all()}
    lists = {name: [None if math.isnan(value) else value for value in known[name].tolist()] for name in known}
    battery = {} if math.isnan(ratings.battery_power) else {BATTERY: ratings.battery_power}
    section = {name: short(values) for name, values in lists.items()} | battery
    return {RATINGS: section} if section else {}


def _rates(value: object) -> bool:
    return is_number(value) and 0 < value <= MOST  # type: ignore[operator]


def _rates_or_none(value: object) -> bool:
    return value is None or _rates(value)


def read_motors(section: Reader, joints: int) -> Motors:
    """Read the section ``motors``."""
    law = section.take("law", f"one of {', '.join(LAWS)}", lambda value: value in LAWS)
    section.file("file", MOTORS_FILE)
    names = ("stall_torque", "no_load_speed") if law == "dc_motor" or "stall_torque" in section.values else ()
    curve = {name: tuple(section.numbers(name, joints, "joint").tolist()) for name in names}
    for name in names:
        section.take(name, "numbers above zero", lambda value: min(value) > 0)
    return Motors(law, digest=section.text("sha256") if law == "network" else "", **curve)


def make_network(folder: Path, motors: Motors, count: int, joints: int) -> NetworkMotors | None:
    """The network motors of ``count`` robots; None for another law. Raises ContractError or UserError."""
    if motors.law != "network":
        return None
    if not (folder / MOTORS_FILE).is_file():
        raise ContractError(f"no {MOTORS_FILE} in {folder}, the network of its motors; export the policy again")
    if digest(folder / MOTORS_FILE) != motors.digest:
        raise ContractError(f"{MOTORS_FILE} is not the exported file: its SHA-256 differs; export the policy again")
    return NetworkMotors(read_network(folder / MOTORS_FILE), count, joints)


class NetworkMotors:
    """Motors of N robots with D joints, modelled by a network. Call ``torque`` once a simulation step."""

    def __init__(self, network: MotorNetwork, robots: int, joints: int) -> None:
        self.network = network
        # scaled errors and speeds, newest first
        self._past = np.zeros((network.frames[-1] + 1, 2, robots, joints), dtype=np.float32)
        # per layer: h and c
        self._memory = [np.zeros((2, robots, joints, units), dtype=np.float32) for units in network.hidden]

    def reset(self, which: Any = slice(None)) -> None:
        """Set the history and the memory of the robots ``which`` (indices or a mask) to zero."""
        for memory in (self._past, *self._memory):
            memory[(slice(None), slice(None), which) if memory is self._past else (slice(None), which)] = 0.0

    def torque(self, error: NDArray[Any], speed: NDArray[Any]) -> Floats:
        """Torques (N, D) [N m] from ``error`` (target minus angle) [rad] and ``speed`` [rad/s], (N, D) each."""
        net, past = self.network, self._past
        past[1:] = past[:-1].copy()
        past[0] = net.error_scale * error, net.speed_scale * speed
        x = np.moveaxis(past[list(net.frames)], (0, 1), (-2, -1) if net.in_turns else (-1, -2))
        x = x.reshape(*error.shape, -1)
        for memory, (w_x, w_h, b_x, b_h) in zip(self._memory, net.recurrent, strict=True):
            i, f, g, o = np.split(x @ w_x.T + b_x + memory[0] @ w_h.T + b_h, 4, axis=-1)
            memory[1] = _sigmoid(f) * memory[1] + _sigmoid(i) * np.tanh(g)
            x = memory[0] = _sigmoid(o) * np.tanh(memory[1])
        for layer, (weight, bias) in enumerate(net.linear):
            x = x @ weight.T + bias
            if layer < len(net.linear) - 1:
                x = _ACTIVATIONS[net.activation](x)
        return net.torque_scale * x[..., 0]


def _sigmoid(x: Floats) -> Floats:
    return 1 / (1 + np.exp(-np.clip(x, -80.0, 80.0)))


FORMATS = (
    2,
    3,
    4,
    5,
)  # 5 adds the range of targets and the scenes' checksums; for older formats the scene gives the range
CONTRACT_FILE, NETWORK_FILE, SCENE_FILE = "policy.yaml", "policy.onnx", "scene.xml"
TERRAIN_FILE = "terrain.mjz"  # scene with steps and blocks; only for policies trained on such ground


class Quantity(NamedTuple):
    """The source of an observation row."""

    measured: str  # a field of robot.Measurement, or one of COMPUTED
    unit: str
    frame: str


# Observation rows that a task can use by name. Any other row names its sensors: Row(..., sensors=, unit=).
ROWS: dict[str, Quantity] = {
    "base_lin_vel": Quantity("lin_vel", "m/s", "body, at the IMU"),
    "base_ang_vel": Quantity("ang_vel", "rad/s", "body"),
    "projected_gravity": Quantity("gravity", "1", "body; the direction of gravity"),
    "accelerometer": Quantity("acceleration", "m/s^2", "body, at the IMU; standing still it reads +9.81 along z"),
    "dof_pos": Quantity("joint_offset", "rad", "joint; minus default_pose"),
    "dof_vel": Quantity("joint_vel", "rad/s", "joint"),
    "torques": Quantity("joint_torque", "N m", "joint"),
    "foot_contact": Quantity("foot_contact", "1", "foot; 1 where it touches the ground, else 0"),
    "last_actions": Quantity("last_action", "1", "joint; clipped, 0 before the first"),
    "gait_clock": Quantity("gait_clock", "1", "sine of each foot's phase, then cosine of each; 0 while told to stand"),
    "commands": Quantity("command", "", "in the order of `commands`"),
    JOINT_POS: Quantity(JOINT_POS, "rad", "joint; of the motion, at the end of the step to come"),
    JOINT_VEL: Quantity(JOINT_VEL, "rad/s", "joint; likewise"),
    PLACE: Quantity(PLACE, "m", "the anchor's: from it to the motion's, at the end of the step to come"),
    TURN: Quantity(TURN, "1", "the anchor's: the first two columns of the rotation to the motion's, row by row"),
    "height_scan": Quantity(
        "height_scan",
        "m",
        "points on a grid around the root, which turns with its heading; how far the ground lies below where it is when "
        "the robot stands on level ground, within 1 m; x by x from behind, in each from right to left",
    ),
}
# computed by the controller; a robot measures all others
COMPUTED = ("joint_offset", "last_action", "command", "gait_clock", *REFERENCE)
# Quantities that the scene's sensors measure. "up" is the world's z axis in the IMU's frame, opposite to gravity.
SENSED = ("lin_vel", "ang_vel", "up", "acceleration", "joint_pos", "joint_vel", "joint_torque")
FALL = "fall_contact"  # ground contacts of the geoms in `ends: falls_on`; absent without such geoms
SENSORS = "sensors"  # ContractRow.measured of a row that names sensors of the scene
SCAN = "height_scan"  # ContractRow.measured of the height scan
CLOCK = "gait_clock"  # ContractRow.measured of the gait clock
OWN = (SENSORS, SCAN, "")  # rows that Measurement.others holds by name
_FARTHEST = 100.0  # [rad] or [m] largest absolute value of a joint's default angle or of a height


@dataclass(frozen=True)
class ContractRow:
    """One row of the network's observation: ``history`` frames of ``size`` values, the oldest frame first."""

    name: str
    size: int
    unit: str
    frame: str
    noise: float  # half range of the uniform noise in training, in `unit`
    measured: str  # a field of robot.Measurement, one of COMPUTED, "sensors", or "" if the task does not state it
    sensors: tuple[str, ...] = ()
    scale: tuple[float, ...] = (1.0,)  # one per value, or one for all; the network's input is scale * value
    history: int = 1  # number of frames; at a reset the first frame fills all


class Ends(NamedTuple):
    """The rules for a fall, which ends a walk. A rule that is not set has no effect."""

    max_tilt: float | None = None  # [deg] angle between the robot's z axis and the vertical
    # [m] height of the root above the ground; checked in simulation only
    min_base_height: float | None = None
    falls_on: tuple[str, ...] = ()  # geoms that must not touch the ground; checked in simulation only
    not_covered: tuple[str, ...] = ()  # methods of the task that ended episodes in training; not checked here

    def tilted(self, gravity: np.ndarray) -> np.ndarray:
        """True if ``gravity`` (..., 3), its direction in the body frame, means a fall or is NaN.

        ``Safety._tilt`` checks the robot's own limit.
        """
        if self.max_tilt is None:
            return np.zeros(gravity.shape[:-1], dtype=bool)
        return ~(gravity[..., 2] <= -math.cos(math.radians(self.max_tilt)))


class HeightScan(NamedTuple):
    """The grid of a height scan: all pairs of x ahead of the root and y to its left [m]."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    standing: float  # [m] height of the root above level ground at which the scan is zero


class Gait(NamedTuple):
    """A gait clock. It starts at phase 0 with a command to move and stays at 0 with a command to stand."""

    period: float  # [s]
    offsets: tuple[float, ...]  # (F,) phase of each foot, share of the period
    min_command: float  # largest norm of (vx, vy, yaw rate) of a command to stand


@dataclass(frozen=True)
class Contract:
    """The interface of a robot and a policy; D joints, F feet, C commands. Joints are in the order of ``joints``."""

    task: str
    joints: tuple[str, ...]
    default_pose: np.ndarray  # (D,) [rad]
    action: Action
    stiffness: np.ndarray  # (D,) [N m/rad] of the position servos
    damping: np.ndarray  # (D,) [N m s/rad]
    period: float  # [s] between two actions
    timestep: float  # [s] of the physics in training
    decimation: int  # physics steps a period
    commands: tuple[Command, ...]  # as trained; empty for a task without commands
    rows: tuple[ContractRow, ...]
    sensors: dict[str, tuple[str, ...]]  # quantity -> sensors of the scene
    feet: dict[str, tuple[str, ...]]  # foot -> its contact sensors; one of them in contact: the foot is on the ground
    ends: Ends
    imu: str
    mass: float  # [kg] of the whole robot
    input: str  # input of the network: (batch, size of all rows)
    output: str  # output of the network: (batch, D)
    digest: str  # SHA-256 of the network's file
    scan: HeightScan | None = None  # if a row needs it
    gait: Gait | None = None  # if a row needs it
    exam: Mapping[str, Any] | None = None  # the task's section `exam`, if the walking exam grades it
    safety: Mapping[str, Any] | None = None  # limits by name that replace the defaults of safety.Limits
    memory: NetworkMemory | None = None  # of a recurrent network
    estimate: tuple[Estimated, ...] = ()  # rows of the network's second output
    motors: Motors = SERVOS
    ratings: Ratings | None = None  # of the motors and the battery; None: unknown
    motion: FollowedMotion | None = None  # the reference motion, if the policy follows one
    scene: str = ""  # SHA-256 of the scene's file; empty in formats before 5
    terrain: str = ""  # SHA-256 of the scene with steps, if there is one

    @property
    def size(self) -> int:
        """Number of values in an observation."""
        return sum(row.size * row.history for row in self.rows)

    def held(self, command: Sequence[float] | np.ndarray) -> np.ndarray:
        """Clip ``command`` (C,) to the trained ranges."""
        return np.clip(command, [c.low for c in self.commands], [c.high for c in self.commands])

    def to_dict(self) -> dict[str, Any]:
        """The content of policy.yaml."""
        ends = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in self.ends._asdict().items()
            if value
        }
        network = {"file": NETWORK_FILE, "sha256": self.digest, "input": self.input, "output": self.output}
        content = {
            "format": FORMATS[-1],
            "task": self.task,
            "network": network | ({MEMORY: self.memory.to_dict()} if self.memory else {}),
            "period": self.period,
            "joints": list(self.joints),
            "default_pose": self.default_pose.tolist(),
            "action": self.action.to_dict(),
            "stiffness": self.stiffness.tolist(),
            "damping": self.damping.tolist(),
            "commands": [
                {"name": c.name, "unit": c.unit, "lowest": c.low, "highest": c.high, "default": c.default}
                for c in self.commands
            ],
            "observation": [_row_to_dict(row) for row in self.rows],
            "ends": ends,
            "robot": {
                "mass": self.mass,
                "feet": {foot: list(names) for foot, names in self.feet.items()},
                "imu": self.imu,
            },
            "physics": {
                **{"file": SCENE_FILE, "sha256": self.scene, "timestep": self.timestep, "decimation": self.decimation},
                **({"terrain": {"file": TERRAIN_FILE, "sha256": self.terrain}} if self.terrain else {}),
            },
            "sensors": {name: list(names) for name, names in self.sensors.items()},
            **(
                {SCAN: {"x": list(self.scan.x), "y": list(self.scan.y), "standing": self.scan.standing}}
                if self.scan
                else {}
            ),
            **({"gait": {**self.gait._asdict(), "offsets": list(self.gait.offsets)}} if self.gait else {}),
            **{name: dict(item) for name, item in (("exam", self.exam), ("safety", self.safety)) if item is not None},
            **({ESTIMATE: [row._asdict() for row in self.estimate]} if self.estimate else {}),
            **self.motors.to_dict(),
            **(ratings_to_dict(self.ratings) if self.ratings else {}),
            **({MOTION: self.motion.to_dict()} if self.motion else {}),
        }
        return sealed(content)


def _row_to_dict(row: ContractRow) -> dict[str, Any]:
    entry = {name: getattr(row, name) for name in ("name", "size", "unit", "frame", "noise", "measured")}
    entry |= {"scale": short(row.scale), **({"sensors": list(row.sensors)} if row.sensors else {})}
    return entry | ({"history": row.history} if row.history > 1 else {})


# ---- reading -------------------------------------------------------------------------------------------------------


def read_contract(folder: Path, edited: bool = False) -> Contract:
    """Read the contract in ``folder`` and check it against the network and the scenes beside it.

    ``edited``: accept changes of values that training used; see ``edits``.
    Raises ContractError, or ConfigError for invalid YAML.
    """
    finish_moving(folder)
    contract = _read(Reader(content := load_yaml(part(folder, CONTRACT_FILE)), CONTRACT_FILE), folder)
    _check_rows(contract)
    part(folder, NETWORK_FILE)
    if digest(folder / NETWORK_FILE) != contract.digest:
        raise ContractError(
            f"{NETWORK_FILE} is not the exported file (its SHA-256 differs): "
            "it is damaged, or of another export; export the policy again"
        )
    if edited:
        check_pose(contract.action, contract.joints, contract.default_pose)
        return contract
    advice = (
        "undo the change, export the policy again, or say --edited, which shows each number beside the exported one"
    )
    if CHECKSUM not in content:
        raise ContractError(
            f"{CONTRACT_FILE} has no line `{CHECKSUM}`, which says that it is as it was exported: {advice}"
        )
    if checksum(content) != content[CHECKSUM]:
        raise ContractError(
            f"{CONTRACT_FILE} was changed in what the network was trained with (its {CHECKSUM} differs); only {', '.join(FREE)} may be: "
            f"{advice}"
        )
    for name in _changed_files(folder, contract):
        raise ContractError(f"{name} is not the exported file (its SHA-256 differs): {advice}")
    return contract


def part(folder: Path, name: str) -> Path:
    """The path of the file ``name`` of the export in ``folder``. Raises ContractError if it is missing."""
    if not (folder / name).is_file():
        raise ContractError(
            f"no {name} in {folder}; make an export with: python play.py --task <task> --export {folder}"
        )
    return folder / name


def edits(folder: Path) -> list[str]:
    """One line for each changed value of the export in ``folder``, with the exported value, and per changed file."""
    lines = changes(load_yaml(part(folder, CONTRACT_FILE)))
    files = _changed_files(folder, read_contract(folder, edited=True))
    return [f"{CONTRACT_FILE}: {line}" for line in lines] + [
        f"{name}: another file than the exported one" for name in files
    ]


def _changed_files(folder: Path, contract: Contract) -> list[str]:
    checksums = {SCENE_FILE: contract.scene, TERRAIN_FILE: contract.terrain}
    return [
        name
        for name, expected in checksums.items()
        if expected and (folder / name).is_file() and digest(folder / name) != expected
    ]


def _read(top: Reader, folder: Path) -> Contract:
    version = top.take(
        "format",
        f"one of {', '.join(map(str, FORMATS))}, which this version reads; export the policy again",
        lambda v: v in FORMATS,
    )
    network, action, robot, physics, measured = (
        top.section(name) for name in ("network", "action", "robot", "physics", "sensors")
    )
    network.file("file", NETWORK_FILE)
    joints, feet = top.texts("joints"), robot.section("feet")
    top.take("joints", "names, each once", lambda names: len(set(names)) == len(names))
    count, timestep, decimation = len(joints), physics.above_zero("timestep"), physics.count("decimation", 10_000)
    step = timestep * decimation
    top.take(
        "period",
        f"physics: timestep * decimation = {step:g}",
        lambda v: is_number(v) and math.isclose(v, step, rel_tol=1e-6),
    )
    return Contract(
        task=top.text("task"),
        joints=joints,
        default_pose=top.numbers("default_pose", count, "joint", -_FARTHEST, _FARTHEST),
        action=read_action(action, joints, None if version >= 5 else folder / SCENE_FILE),
        stiffness=top.numbers("stiffness", count, "joint", 0.0),
        damping=top.numbers("damping", count, "joint", 0.0),
        period=top.above_zero("period", 10.0),
        timestep=timestep,
        decimation=decimation,
        commands=tuple(map(_read_command, top.sections("commands", empty=True))),
        rows=tuple(map(_read_row, top.sections("observation"))),
        sensors={name: measured.texts(name) for name in measured.values},
        feet={name: feet.texts(name) for name in feet.values},
        ends=_read_ends(top.section("ends")),
        imu=robot.text("imu"),
        mass=robot.above_zero("mass"),
        input=network.text("input"),
        output=network.text("output"),
        digest=network.text("sha256"),
        scan=_read_scan(top),
        gait=_read_gait(top),
        **{name: top.section(name).values for name in ("exam", "safety") if name in top.values},
        memory=read_memory(network.section(MEMORY)) if MEMORY in network.values else None,
        estimate=read_estimated(top.sections(ESTIMATE)) if ESTIMATE in top.values else (),
        motors=read_motors(top.section(MOTORS), count) if MOTORS in top.values else SERVOS,
        ratings=read_ratings(top.section(RATINGS), count) if RATINGS in top.values else None,
        motion=read_motion(top.section(MOTION)) if MOTION in top.values else None,
        **_read_scenes(physics, version),
    )


def _read_scenes(physics: Reader, version: int) -> dict[str, Any]:
    """Read the checksums of the scenes."""
    physics.file("file", SCENE_FILE)
    if version < 5:
        return {}
    if "terrain" not in physics.values:
        return {"scene": physics.text("sha256")}
    (terrain := physics.section("terrain")).file("file", TERRAIN_FILE)
    return {"scene": physics.text("sha256"), "terrain": terrain.text("sha256")}


def _read_command(command: Reader) -> Command:
    low = command.number("lowest")
    high = command.number("highest", low)
    return Command(
        command.text("name"), low, high, command.text("unit", empty=True), default=command.number("default", low, high)
    )


def _read_row(row: Reader) -> ContractRow:
    size = row.count("size")
    return ContractRow(
        name=row.text("name"),
        size=size,
        unit=row.text("unit", empty=True),
        frame=row.text("frame", empty=True),
        noise=row.number("noise", 0.0),
        measured=row.text("measured", empty=True),
        sensors=row.texts("sensors") if "sensors" in row.values else (),
        scale=tuple(row.scale(size, "value of the row").tolist()),
        history=row.count("history", MOST_VALUES // size) if "history" in row.values else 1,
    )


def _read_ends(ends: Reader) -> Ends:
    """Read the section ``ends``. Raises ContractError for an unknown rule."""
    for name in ends.values:
        if name not in Ends._fields:
            raise ContractError(f"{ends.where}: {unknown('rule', name, Ends._fields, 'the rules that end a walk')}")
    return Ends(
        max_tilt=ends.number("max_tilt", 0.0, 180.0) if "max_tilt" in ends.values else None,
        min_base_height=ends.number("min_base_height", -_FARTHEST, _FARTHEST)
        if "min_base_height" in ends.values
        else None,
        falls_on=ends.texts("falls_on") if "falls_on" in ends.values else (),
        not_covered=ends.texts("not_covered") if "not_covered" in ends.values else (),
    )


def _read_scan(top: Reader) -> HeightScan | None:
    """Read the grid of the height scan; None if no row needs it."""
    if not any(row.values.get("measured") == SCAN for row in top.sections("observation")):
        return None
    scan = top.section(SCAN)
    x, y = (tuple(map(float, scan.take(key, "a list of numbers", lambda v: is_list(v, is_number)))) for key in "xy")
    return HeightScan(x, y, scan.above_zero("standing", _FARTHEST))


def _read_gait(top: Reader) -> Gait | None:
    """Read the gait clock; None if no row needs it."""
    if not any(row.values.get("measured") == CLOCK for row in top.sections("observation")):
        return None
    gait, names = top.section("gait"), [command.values.get("name") for command in top.sections("commands", empty=True)]
    if missing := [name for name in VELOCITY if name not in names]:
        raise ContractError(
            f"{top.where}: {CLOCK} rests by the commands {', '.join(VELOCITY)}; missing: {', '.join(missing)}"
        )
    feet = len(top.section("robot").section("feet").values)
    return Gait(
        gait.above_zero("period"),
        tuple(gait.numbers("offsets", feet, "foot").tolist()),
        gait.number("min_command", 0.0),
    )


def quantity_size(contract: Contract, name: str) -> int:
    """The number of values of a measured or computed quantity."""
    per_joint = ("joint_pos", "joint_offset", "joint_vel", "joint_torque", "last_action", JOINT_POS, JOINT_VEL)
    scan = len(contract.scan.x) * len(contract.scan.y) if contract.scan else 0
    counts = {
        **dict.fromkeys(per_joint, len(contract.joints)),
        "foot_contact": len(contract.feet),
        "command": len(contract.commands),
    }
    clock = 2 * len(contract.gait.offsets) if contract.gait else 0
    return {**counts, FALL: len(contract.ends.falls_on), SCAN: scan, CLOCK: clock, TURN: 6}.get(name, 3)


def _check_rows(contract: Contract) -> None:
    """Check that every row can be measured and has the right size. Check that `falls_on` geoms have contact sensors."""
    sensed = [name.removeprefix("contact/") for name in contract.sensors.get(FALL, ())]
    for name in contract.ends.falls_on if sensed else ():
        if name not in sensed:
            raise ContractError(f"{CONTRACT_FILE}: ends: falls_on: {unknown('geom', name, sensed, f'sensors: {FALL}')}")
    measurable = {quantity.measured for quantity in ROWS.values()}
    for row in contract.rows:
        where = f"{CONTRACT_FILE}: observation row '{row.name}'"
        if row.measured == SENSORS and row.sensors:
            continue
        if not row.measured:
            raise ContractError(
                f"{where}: nothing says how it is measured, so it cannot be deployed; in the task write Row('{row.name}', ..., "
                f"sensors=(...), unit=...) with sensors of the MJCF, or use one of the rows {', '.join(ROWS)}; then export again"
            )
        if row.measured in REFERENCE and not contract.motion:
            raise ContractError(
                f"{where} needs a motion, and the contract has no section `{MOTION}`; export the policy again"
            )
        if row.measured not in measurable:
            raise ContractError(
                f"{where}: {unknown('quantity', row.measured, [*sorted(measurable), SENSORS], 'what a robot measures')}"
            )
        if row.size != (expected := quantity_size(contract, row.measured)):
            raise ContractError(f"{where} has size {row.size}; {row.measured} has {expected} values on this robot")


# ---- checksum of a contract -----------------------------------------------------------------------------------------
#
# It covers all values that training used. The contract holds a copy of the exported values, because no other file of
# an export has all of them. `changes` compares the contract with this copy.


CHECKSUM = "checksum"  # of the values that training used
EXPORTED = "exported"  # those values at the export: base64 of zlib of JSON
# sections that may change: grading, supervision, and ratings of the motors
FREE = ("task", "ends", "exam", "safety", RATINGS)
_MOST_TEXT = 1 << 22  # [byte] limit of the unpacked `exported`; that of G1 has 0.25 % of it


def checksum(content: Mapping[str, Any]) -> str:
    """SHA-256 of the contract's values that training used (joints, rows, scales ...), in their order."""
    return hashlib.sha256(_bound(content).encode()).hexdigest()


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """The contract's content with the lines `exported` and `checksum` added."""
    text = _bound({**content, EXPORTED: ""}).encode()
    return {
        **content,
        EXPORTED: base64.b64encode(zlib.compress(text, 9)).decode(),
        CHECKSUM: hashlib.sha256(text).hexdigest(),
    }


def changes(content: Mapping[str, Any]) -> list[str]:
    """One line for each value that differs from the exported value, with both values."""
    if EXPORTED not in content and content.get(CHECKSUM) == checksum(content):  # formats before 5 have no copy
        return []
    try:
        packed = base64.b64decode(str(content[EXPORTED]), validate=True)
        text = zlib.decompressobj().decompress(packed, _MOST_TEXT)
        if hashlib.sha256(text).hexdigest() != content.get(CHECKSUM, hashlib.sha256(text).hexdigest()):
            raise ValueError("the copy was changed, too")
        exported, current = dict(_values(json.loads(text))), dict(_values(json.loads(_bound(content))))
    except (KeyError, ValueError, zlib.error, RecursionError):
        return [f"what was exported is unknown: its line `{EXPORTED}` is missing, or was changed too"]
    pairs = [
        (place, *(brief(values[place]) if place in values else "nothing" for values in (current, exported)))
        for place in {**exported, **current}
    ]
    return [f"{place}: {new}, exported {old}" for place, new, old in pairs if new != old]


def _bound(content: Mapping[str, Any]) -> str:
    # formats before 5 have no copy, and their checksum does not cover `format`
    free = (*FREE, EXPORTED, CHECKSUM, *([] if EXPORTED in content else ["format"]))
    return json.dumps({name: value for name, value in content.items() if name not in free}, default=str, skipkeys=True)


def _values(tree: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Each value in nested mappings and lists with its path, e.g. observation[3].scale."""
    if isinstance(tree, dict) and tree:
        for name, value in tree.items():
            yield from _values(value, f"{place}.{name}" if place else str(name))
    elif isinstance(tree, list) and tree:
        for i, value in enumerate(tree):
            yield from _values(value, f"{place}[{i}]")
    else:
        yield place, tree
