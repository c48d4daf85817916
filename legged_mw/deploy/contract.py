"""The contract of an exported policy: what ``policy.yaml`` says, checked against the network and the scene beside it.

Who exports writes it from here, who deploys reads it with this. Nothing is stepped and no network is run.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, NoReturn, TypeGuard

import mujoco
import numpy as np

from legged_mw.utils.config import load_yaml
from legged_mw.utils.errors import UserError, unknown

FORMAT = 1  # raised when a reader of the old format would misread the new one
CONTRACT_FILE, NETWORK_FILE, SCENE_FILE = "policy.yaml", "policy.onnx", "scene.xml"
TERRAIN_FILE = "terrain.xml"  # the same robot among steps and blocks; only of policies that were trained on such ground


class ContractError(UserError, ValueError):
    """An export that cannot be deployed; the text says which file, what it says, what was expected and what to do."""


class Kind(NamedTuple):
    """How rows of one name are measured, everywhere."""

    measured: str  # a field of robot.Measurement, or one of COMPUTED
    unit: str
    frame: str


# Observation rows that a task may use without saying more. A row of another name names its sensors: Row(..., sensors=, unit=).
ROWS: dict[str, Kind] = {
    "base_lin_vel": Kind("lin_vel", "m/s", "body, at the IMU"),
    "base_ang_vel": Kind("ang_vel", "rad/s", "body"),
    "projected_gravity": Kind("gravity", "1", "body; the direction of gravity"),
    "accelerometer": Kind("acceleration", "m/s^2", "body, at the IMU; standing still it reads +9.81 along z"),
    "dof_pos": Kind("joint_offset", "rad", "joint; minus default_pose"),
    "dof_vel": Kind("joint_vel", "rad/s", "joint"),
    "torques": Kind("joint_torque", "N m", "joint"),
    "foot_contact": Kind("foot_contact", "1", "foot; 1 where it touches the ground, else 0"),
    "last_actions": Kind("last_action", "1", "joint; clipped, 0 before the first"),
    "commands": Kind("command", "m/s, m/s, rad/s", "body; forward, left, turning left"),
    "height_scan": Kind(
        "height_scan",
        "m",
        "points on a grid around the root, which turns with its heading; how far the ground lies below where it is when "
        "the robot stands on level ground, within 1 m; x by x from behind, in each from right to left",
    ),
}
COMPUTED = ("joint_offset", "last_action", "command")  # by the controller; all else a robot measures
# What a scene measures by sensors; "up" is the world's z axis in the IMU's frame, opposite to gravity.
SENSED = ("lin_vel", "ang_vel", "up", "acceleration", "joint_pos", "joint_vel", "joint_torque", "foot_contact")
FALL = "fall_contact"  # contacts of `falls_on` with the ground; only where there are such geoms
SENSORS = "sensors"  # Row.measured of a row that names sensors of the scene
SCAN = "height_scan"  # Row.measured of the height scan
OWN = (SENSORS, SCAN)  # of rows that come whole, in Measurement.others, by their names


@dataclass(frozen=True)
class Row:
    """One row of the network's observation."""

    name: str
    size: int
    unit: str
    frame: str
    noise: float  # half width of the uniform noise that it was trained with, in `unit`
    measured: str  # a field of robot.Measurement, one of COMPUTED, "sensors", or "" if nobody said
    sensors: tuple[str, ...] = ()
    scale: tuple[float, ...] = (1.0,)  # one number, or one a value: the network sees scale * value


class HeightScan(NamedTuple):
    """Where a height scan looks: at each x, at each y [m] from the root, ahead and to the left."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    standing: float  # [m] of the root above level ground, where the scan is zero


@dataclass(frozen=True)
class Contract:
    """What a robot and a policy agree on; D joints, F feet. All that is per joint stands in the order of ``joints``."""

    task: str
    joints: tuple[str, ...]
    default_pose: np.ndarray  # (D,) [rad], the pose of action 0
    action_scale: float  # target = default_pose + action_scale * action [rad]
    action_clip: float  # |action| at most [-]
    stiffness: np.ndarray  # (D,) [N m/rad] of the position servos
    damping: np.ndarray  # (D,) [N m s/rad]
    period: float  # [s] between two actions
    timestep: float  # [s] of the physics that it was trained in
    decimation: int  # physics steps a period
    command_ranges: np.ndarray  # (2, 3) lowest and highest vx, vy [m/s], yaw rate [rad/s]
    rows: tuple[Row, ...]
    sensors: dict[str, tuple[str, ...]]  # quantity -> sensors of the scene
    feet: tuple[str, ...]
    falls_on: tuple[str, ...]  # geoms that must not touch the ground: if one does, it fell
    imu: str
    mass: float  # [kg] of the whole robot
    input: str  # of the network: (batch, size of all rows)
    output: str  # (batch, D)
    digest: str  # SHA-256 of the network's file
    scan: HeightScan | None = None  # where a row asks for one

    @property
    def size(self) -> int:
        """Values of an observation."""
        return sum(row.size for row in self.rows)

    def to_dict(self) -> dict[str, Any]:
        """What policy.yaml holds."""
        return {
            "format": FORMAT,
            "task": self.task,
            "network": {"file": NETWORK_FILE, "sha256": self.digest, "input": self.input, "output": self.output},
            "period": self.period,
            "joints": list(self.joints),
            "default_pose": self.default_pose.tolist(),
            "action": {"scale": self.action_scale, "clip": self.action_clip},
            "stiffness": self.stiffness.tolist(),
            "damping": self.damping.tolist(),
            "commands": dict(zip(("lowest", "highest"), self.command_ranges.tolist(), strict=True)),
            "observation": [_row_to_dict(row) for row in self.rows],
            "robot": {"mass": self.mass, "feet": list(self.feet), "falls_on": list(self.falls_on), "imu": self.imu},
            "physics": {"file": SCENE_FILE, "timestep": self.timestep, "decimation": self.decimation},
            "sensors": {name: list(names) for name, names in self.sensors.items()},
            **({SCAN: {"x": list(self.scan.x), "y": list(self.scan.y), "standing": self.scan.standing}} if self.scan else {}),
        }


def _row_to_dict(row: Row) -> dict[str, Any]:
    said = {name: getattr(row, name) for name in ("name", "size", "unit", "frame", "noise", "measured")}
    [first, *rest] = row.scale
    said["scale"] = [first, *rest] if rest else first
    return {**said, "sensors": list(row.sensors)} if row.sensors else said


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


# ---- reading -------------------------------------------------------------------------------------------------------


class _Reader:
    """Takes typed values out of a mapping; a missing or ill-typed one is one clear line."""

    def __init__(self, values: Mapping[str, Any], where: str) -> None:
        self.values, self.where = values, where

    def refuse(self, key: str, wanted: str) -> NoReturn:
        if key not in self.values:
            raise ContractError(f"{self.where}: '{key}' is missing; it must be {wanted}")
        raise ContractError(f"{self.where}: '{key}' is {self.values[key]!r}; it must be {wanted}")

    def section(self, key: str) -> _Reader:
        value = self.values.get(key)
        if not isinstance(value, dict):
            self.refuse(key, "a mapping")
        return _Reader(value, f"{self.where}: {key}")

    def sections(self, key: str) -> list[_Reader]:
        value = self.values.get(key)
        if not isinstance(value, list) or not value or not all(isinstance(item, dict) for item in value):
            self.refuse(key, "a list of mappings")
        return [_Reader(item, f"{self.where}: {key}[{i}]") for i, item in enumerate(value)]

    def text(self, key: str, empty: bool = False) -> str:
        value = self.values.get(key)
        if not isinstance(value, str) or not (value or empty):
            self.refuse(key, "text")
        return value

    def texts(self, key: str, empty: bool = False) -> tuple[str, ...]:
        value = self.values.get(key)
        if not isinstance(value, list) or not (value or empty) or not all(isinstance(item, str) for item in value):
            self.refuse(key, "a list of names")
        return tuple(value)

    def count(self, key: str) -> int:
        value = self.values.get(key)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            self.refuse(key, "a whole number from 1")
        return value

    def number(self, key: str, lowest: float = -math.inf) -> float:
        value = self.values.get(key)
        if not _is_number(value) or value < lowest:
            self.refuse(key, "a number" + (f" from {lowest:g}" if lowest > -math.inf else ""))
        return float(value)

    def above_zero(self, key: str) -> float:
        value = self.number(key)
        if value <= 0:
            self.refuse(key, "above zero")
        return value

    def some_numbers(self, key: str) -> tuple[float, ...]:
        value = self.values.get(key)
        if not isinstance(value, list) or not value or not all(map(_is_number, value)):
            self.refuse(key, "a list of numbers")
        return tuple(map(float, value))

    def numbers(self, key: str, count: int, of: str) -> np.ndarray:
        value = self.values.get(key)
        if not isinstance(value, list) or len(value) != count or not all(map(_is_number, value)):
            self.refuse(key, f"{count} numbers, one a {of}")
        return np.array(value, dtype=float)


def _is_number(value: object) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_contract(folder: Path) -> Contract:
    """The contract in ``folder``: complete, typed, and of the network that lies beside it.

    Raises ContractError (or ConfigError, if the YAML is broken) with one line.
    """
    path = folder / CONTRACT_FILE
    for file in (path, folder / NETWORK_FILE, folder / SCENE_FILE):
        if not file.is_file():
            raise ContractError(f"no {file.name} in {folder}; make an export with: python play.py --task <task> --export {folder}")
    top = _Reader(load_yaml(path), CONTRACT_FILE)
    if top.values.get("format") != FORMAT:
        top.refuse("format", f"{FORMAT}, the one that this version reads; export the policy again")
    network, action, robot, physics, commands = (top.section(name) for name in ("network", "action", "robot", "physics", "commands"))
    joints, measured = top.texts("joints"), top.section("sensors")
    count = len(joints)
    if len(set(joints)) < count:
        top.refuse("joints", "names, each once")
    contract = Contract(
        task=top.text("task"),
        joints=joints,
        default_pose=top.numbers("default_pose", count, "joint"),
        action_scale=action.number("scale"),
        action_clip=action.above_zero("clip"),
        stiffness=top.numbers("stiffness", count, "joint"),
        damping=top.numbers("damping", count, "joint"),
        period=top.above_zero("period"),
        timestep=physics.above_zero("timestep"),
        decimation=physics.count("decimation"),
        command_ranges=np.array([commands.numbers(name, 3, "of vx, vy, yaw rate") for name in ("lowest", "highest")]),
        rows=tuple(_read_row(row) for row in top.sections("observation")),
        sensors={name: measured.texts(name) for name in measured.values},
        feet=robot.texts("feet"),
        falls_on=robot.texts("falls_on", empty=True),
        imu=robot.text("imu"),
        mass=robot.above_zero("mass"),
        input=network.text("input"),
        output=network.text("output"),
        digest=network.text("sha256"),
        scan=_read_scan(top),
    )
    _check_rows(contract)
    if not math.isclose(contract.period, contract.timestep * contract.decimation, rel_tol=1e-6):
        top.refuse("period", f"physics: timestep * decimation = {contract.timestep * contract.decimation:g}")
    if digest(folder / NETWORK_FILE) != contract.digest:
        raise ContractError(
            f"{NETWORK_FILE} is not the file that {CONTRACT_FILE} was written for (its SHA-256 differs): "
            "it is damaged, or of another export; export the policy again"
        )
    return contract


def _read_scan(top: _Reader) -> HeightScan | None:
    """Where the height scan looks, if a row is one."""
    if not any(row.values.get("measured") == SCAN for row in top.sections("observation")):
        return None
    scan = top.section(SCAN)
    return HeightScan(scan.some_numbers("x"), scan.some_numbers("y"), scan.above_zero("standing"))


def _read_row(row: _Reader) -> Row:
    name = row.text("name")
    return Row(
        name=name,
        size=row.count("size"),
        unit=row.text("unit", empty=True),
        frame=row.text("frame", empty=True),
        noise=row.number("noise", 0.0),
        measured=row.text("measured", empty=True),
        sensors=row.texts("sensors") if "sensors" in row.values else (),
        scale=_read_scale(row),
    )


def _read_scale(row: _Reader) -> tuple[float, ...]:
    if isinstance(row.values.get("scale"), list):
        return tuple(row.numbers("scale", row.count("size"), "value of the row").tolist())
    return (row.number("scale"),)


def quantity_size(contract: Contract, name: str) -> int:
    """Values of a measured quantity."""
    joints, feet = len(contract.joints), len(contract.feet)
    per_joint = ("joint_pos", "joint_offset", "joint_vel", "joint_torque", "last_action")
    scan = len(contract.scan.x) * len(contract.scan.y) if contract.scan else 0
    counts = {**dict.fromkeys(per_joint, joints), "foot_contact": feet, FALL: len(contract.falls_on), SCAN: scan}
    return counts.get(name, 3)


def _check_rows(contract: Contract) -> None:
    """Every row is one that can be measured, of the right size."""
    measurable = {kind.measured for kind in ROWS.values()}
    for row in contract.rows:
        where = f"{CONTRACT_FILE}: observation row '{row.name}'"
        if row.measured == SENSORS and row.sensors:
            continue
        if not row.measured:
            raise ContractError(
                f"{where}: nothing says how it is measured, so it cannot be deployed; in the task write Row('{row.name}', ..., "
                f"sensors=(...), unit=...) with sensors of the MJCF, or use one of the rows {', '.join(ROWS)}; then export again"
            )
        if row.measured not in measurable:
            raise ContractError(f"{where}: {unknown('quantity', row.measured, [*sorted(measurable), SENSORS], 'what a robot measures')}")
        if row.size != (right := quantity_size(contract, row.measured)):
            raise ContractError(f"{where} has size {row.size}; {row.measured} has {right} values on this robot")


# ---- the scene -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """The robot in MuJoCo, and where its names are."""

    model: mujoco.MjModel
    qpos: np.ndarray  # (D,) index of each joint in qpos
    actuators: np.ndarray  # (D,) index of each joint's servo in ctrl
    sensordata: dict[str, np.ndarray]  # quantity, or name of a row with sensors of its own -> indices in sensordata


def read_scene(folder: Path, contract: Contract, file: str = SCENE_FILE) -> Scene:
    """``scene.xml`` of an export, or another ``file`` in it, which must be the robot that the contract speaks of."""
    if not (folder / file).is_file():
        raise ContractError(f"no {file} in {folder}; an export has one if its task was trained on ground with steps or blocks")
    try:
        model = mujoco.MjModel.from_xml_path(str(folder / file))
    except ValueError as error:
        raise ContractError(f"{file} is not a valid MJCF: {' '.join(str(error).split())}") from None
    joints = [_index(model, file, "joint", name, "joint") for name in contract.joints]
    actuators = [_index(model, file, "actuator", name, "servo") for name in contract.joints]
    _check_machine(model, file, contract, joints, actuators)
    if model.nkey < 1:
        raise ContractError(f"{file} has no keyframe; the first one says where the robot starts")
    named = {**contract.sensors, **{row.name: row.sensors for row in contract.rows if row.sensors}}
    needed = [*SENSED, *([FALL] if contract.falls_on else [])]
    if missing := [name for name in needed if name not in contract.sensors]:
        raise ContractError(f"{CONTRACT_FILE}: sensors: '{missing[0]}' is missing; name the sensors of {file} that measure it")
    data = {name: np.concatenate([_span(model, file, sensor, f"'{name}'") for sensor in names]) for name, names in named.items()}
    for name, where in data.items():
        size = next((row.size for row in contract.rows if row.sensors and row.name == name), None) or quantity_size(contract, name)
        if len(where) != size:
            raise ContractError(f"{file}: the sensors of '{name}' ({', '.join(named[name])}) have {len(where)} values, not {size}")
    return Scene(model, np.array([model.jnt_qposadr[j] for j in joints]), np.array(actuators), data)


def _index(model: mujoco.MjModel, file: str, kind: str, name: str, word: str) -> int:
    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        raise ContractError(f"{CONTRACT_FILE}: joints: {unknown(word, name, _names(model, kind), file)}")
    return index


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = {"joint": model.njnt, "actuator": model.nu, "sensor": model.nsensor}[kind]
    names = [mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i) for i in range(count)]
    return [name for name in names if name]


def _span(model: mujoco.MjModel, file: str, name: str, what: str) -> np.ndarray:
    index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
    if index < 0:
        raise ContractError(f"{CONTRACT_FILE}: sensors of {what}: {unknown('sensor', name, _names(model, 'sensor'), file)}")
    return np.arange(model.sensor_adr[index], model.sensor_adr[index] + model.sensor_dim[index])


def _check_machine(model: mujoco.MjModel, file: str, contract: Contract, joints: Sequence[int], actuators: Sequence[int]) -> None:
    """Joints, gains, mass and step are those that the contract names."""
    if model.nq != 7 + len(joints) or model.nu != len(joints):
        have = [name for name in _names(model, "joint") if name not in contract.joints]
        raise ContractError(f"{file} has joints that {CONTRACT_FILE} does not: {', '.join(have[1:]) or f'{model.nu} servos'}")
    dofs = model.jnt_dofadr[list(joints)]
    checks = {
        "stiffness": (contract.stiffness, model.actuator_gainprm[list(actuators), 0]),
        "damping": (contract.damping, model.dof_damping[dofs].reshape(len(joints), -1)[:, 0]),
        "robot: mass": (contract.mass, model.body_subtreemass[0]),
        "physics: timestep": (contract.timestep, model.opt.timestep),
    }
    for name, (said, found) in checks.items():
        if not np.allclose(said, found, rtol=1e-4, atol=1e-6):
            shown = [np.array2string(np.asarray(x), precision=6, separator=", ", max_line_width=10_000) for x in (said, found)]
            raise ContractError(f"{CONTRACT_FILE}: {name} is {shown[0]}, but {file} has {shown[1]}; export the policy again")
