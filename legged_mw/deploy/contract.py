"""The contract of an exported policy: what ``policy.yaml`` states, checked against the network and the scene beside it.

The export writes it from here and ``legged_mw.deploy`` reads it with this. Nothing is stepped and no network is run.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from legged_mw.deploy.action import Action, check_pose, read_action, short
from legged_mw.deploy.estimate import ESTIMATE, Estimated, read_estimated
from legged_mw.deploy.memory import MEMORY, NetworkMemory, read_memory
from legged_mw.deploy.motion import JOINT_POS, JOINT_VEL, MOTION, PLACE, REFERENCE, TURN, FollowedMotion, read_motion
from legged_mw.deploy.motors import MOTORS, SERVOS, Motors, read_motors
from legged_mw.deploy.reader import MOST_VALUES, Reader, is_list, is_number
from legged_mw.deploy.reader import ContractError as ContractError
from legged_mw.deploy.seal import CHECKSUM, FREE, changes, sealed
from legged_mw.deploy.seal import checksum as checksum
from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.utils.config import load_yaml
from legged_mw.utils.errors import unknown
from legged_mw.utils.files import digest, finish_moving

FORMATS = (2, 3, 4, 5)  # 5: the range of targets, and checksums of the scenes; older ones take the range from the scene
CONTRACT_FILE, NETWORK_FILE, SCENE_FILE = "policy.yaml", "policy.onnx", "scene.xml"
TERRAIN_FILE = "terrain.mjz"  # the same robot among steps and blocks; only of policies that were trained on such ground


class Quantity(NamedTuple):
    """Where the value of an observation row comes from."""

    measured: str  # a field of robot.Measurement, or one of COMPUTED
    unit: str
    frame: str


# Observation rows that a task may use as they are. A row of another name names its sensors: Row(..., sensors=, unit=).
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
# by the controller; a robot measures all others
COMPUTED = ("joint_offset", "last_action", "command", "gait_clock", *REFERENCE)
# What the sensors of a scene measure; "up" is the world's z axis in the IMU's frame, opposite to gravity.
SENSED = ("lin_vel", "ang_vel", "up", "acceleration", "joint_pos", "joint_vel", "joint_torque")
FALL = "fall_contact"  # contacts of `ends: falls_on` with the ground; only where there are such geoms
SENSORS = "sensors"  # ContractRow.measured of a row that names sensors of the scene
SCAN = "height_scan"  # ContractRow.measured of the height scan
CLOCK = "gait_clock"  # ContractRow.measured of the gait clock
OWN = (SENSORS, SCAN, "")  # rows that come whole, in Measurement.others, by their names
_FARTHEST = 100.0  # [rad] or [m] of a joint's default, either way


@dataclass(frozen=True)
class ContractRow:
    """One row of the network's observation: ``history`` frames of ``size`` values, the oldest frame first."""

    name: str
    size: int
    unit: str
    frame: str
    noise: float  # half width of the uniform noise that it was trained with, in `unit`
    measured: str  # a field of robot.Measurement, one of COMPUTED, "sensors", or "" if the task does not state it
    sensors: tuple[str, ...] = ()
    scale: tuple[float, ...] = (1.0,)  # one a value, or one for all: the network sees scale * value
    history: int = 1  # after a reset all frames are the first one


class Ends(NamedTuple):
    """What counts as a fall and ends a walk; nothing does where none of it is set."""

    max_tilt: float | None = None  # [deg] between the robot's z axis and the vertical
    # [m] of the root above the ground; a real robot cannot judge it, a simulated one does
    min_base_height: float | None = None
    falls_on: tuple[str, ...] = ()  # geoms that must not touch the ground; judged in simulation, too
    not_covered: tuple[str, ...] = ()  # methods of the task that ended its episodes, too; nobody judges those here

    def tilted(self, gravity: np.ndarray) -> np.ndarray:
        """Whether ``gravity`` (..., 3), its direction in the body frame, means a fall; NaN does."""
        if self.max_tilt is None:
            return np.zeros(gravity.shape[:-1], dtype=bool)
        return ~(gravity[..., 2] <= -math.cos(math.radians(self.max_tilt)))


class HeightScan(NamedTuple):
    """Where a height scan looks: at each x, at each y [m] from the root, ahead and to the left."""

    x: tuple[float, ...]
    y: tuple[float, ...]
    standing: float  # [m] of the root above level ground, where the scan is zero


class Gait(NamedTuple):
    """A clock that begins at 0 when the robot is told to move, and rests at 0 while it is told to stand."""

    period: float  # [s]
    offsets: tuple[float, ...]  # (F,) of each foot's phase, share of the period
    min_command: float  # norm of (vx, vy, yaw rate) up to which a command means stand


@dataclass(frozen=True)
class Contract:
    """What a robot and a policy agree on; D joints, F feet, C commands. What is per joint is in the order of ``joints``."""

    task: str
    joints: tuple[str, ...]
    default_pose: np.ndarray  # (D,) [rad]
    action: Action
    stiffness: np.ndarray  # (D,) [N m/rad] of the position servos
    damping: np.ndarray  # (D,) [N m s/rad]
    period: float  # [s] between two actions
    timestep: float  # [s] of the physics that it was trained in
    decimation: int  # physics steps a period
    commands: tuple[Command, ...]  # as trained; none of a task without commands
    rows: tuple[ContractRow, ...]
    sensors: dict[str, tuple[str, ...]]  # quantity -> sensors of the scene
    feet: dict[str, tuple[str, ...]]  # foot -> its contact sensors: it touches the ground where one of them does
    ends: Ends
    imu: str
    mass: float  # [kg] of the whole robot
    input: str  # of the network: (batch, size of all rows)
    output: str  # (batch, D)
    digest: str  # SHA-256 of the network's file
    scan: HeightScan | None = None  # where a row asks for one
    gait: Gait | None = None  # likewise
    exam: Mapping[str, Any] | None = None  # the task's section `exam`, if the walking exam grades it
    safety: Mapping[str, Any] | None = None  # limits by name, other than the defaults of safety.Limits
    memory: NetworkMemory | None = None  # of a recurrent network
    estimate: tuple[Estimated, ...] = ()  # the network's second output, row by row
    motors: Motors = SERVOS
    motion: FollowedMotion | None = None  # that the policy follows
    scene: str = ""  # SHA-256 of the scene's file; none in a format before 5
    terrain: str = ""  # that of the scene among steps, if there is one

    @property
    def size(self) -> int:
        """Values of an observation."""
        return sum(row.size * row.history for row in self.rows)

    def held(self, command: Sequence[float] | np.ndarray) -> np.ndarray:
        """``command`` (C,) held within the trained ranges."""
        return np.clip(command, [c.low for c in self.commands], [c.high for c in self.commands])

    def to_dict(self) -> dict[str, Any]:
        """What policy.yaml holds."""
        ends = {
            name: list(value) if isinstance(value, tuple) else value
            for name, value in self.ends._asdict().items()
            if value
        }
        network = {"file": NETWORK_FILE, "sha256": self.digest, "input": self.input, "output": self.output}
        said = {
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
            **{name: dict(said) for name, said in (("exam", self.exam), ("safety", self.safety)) if said is not None},
            **({ESTIMATE: [row._asdict() for row in self.estimate]} if self.estimate else {}),
            **self.motors.to_dict(),
            **({MOTION: self.motion.to_dict()} if self.motion else {}),
        }
        return sealed(said)


def _row_to_dict(row: ContractRow) -> dict[str, Any]:
    entry = {name: getattr(row, name) for name in ("name", "size", "unit", "frame", "noise", "measured")}
    entry |= {"scale": short(row.scale), **({"sensors": list(row.sensors)} if row.sensors else {})}
    return entry | ({"history": row.history} if row.history > 1 else {})


# ---- reading -------------------------------------------------------------------------------------------------------


def read_contract(folder: Path, edited: bool = False) -> Contract:
    """The contract in ``folder``: complete, typed, of the network that lies beside it, and of the scenes, if there are any.

    ``edited``: it may have been changed in what the network was trained with; see ``edits``.
    Raises ContractError (or ConfigError, if the YAML is broken) with one line.
    """
    finish_moving(folder)
    contract = _read(Reader(said := load_yaml(part(folder, CONTRACT_FILE)), CONTRACT_FILE), folder)
    _check_rows(contract)
    part(folder, NETWORK_FILE)
    if digest(folder / NETWORK_FILE) != contract.digest:
        raise ContractError(
            f"{NETWORK_FILE} is not the file that {CONTRACT_FILE} was written for (its SHA-256 differs): "
            "it is damaged, or of another export; export the policy again"
        )
    if edited:
        check_pose(contract.action, contract.joints, contract.default_pose)
        return contract
    what_to_do = (
        "undo the change, export the policy again, or say --edited, which shows each number beside the exported one"
    )
    if CHECKSUM not in said:
        raise ContractError(
            f"{CONTRACT_FILE} has no line `{CHECKSUM}`, which says that it is as it was exported: {what_to_do}"
        )
    if checksum(said) != said[CHECKSUM]:
        raise ContractError(
            f"{CONTRACT_FILE} was changed in what the network was trained with (its {CHECKSUM} differs); only {', '.join(FREE)} may be: "
            f"{what_to_do}"
        )
    for name in _changed_files(folder, contract):
        raise ContractError(
            f"{name} is not the file that {CONTRACT_FILE} was written for (its SHA-256 differs): {what_to_do}"
        )
    return contract


def part(folder: Path, name: str) -> Path:
    """A file of the export in ``folder``. Raises ContractError if it is not there."""
    if not (folder / name).is_file():
        raise ContractError(
            f"no {name} in {folder}; make an export with: python play.py --task <task> --export {folder}"
        )
    return folder / name


def edits(folder: Path) -> list[str]:
    """A line for each number of the export in ``folder`` that was changed since, beside the exported one, and for each other file."""
    lines = changes(load_yaml(part(folder, CONTRACT_FILE)))
    files = _changed_files(folder, read_contract(folder, edited=True))
    return [f"{CONTRACT_FILE}: {line}" for line in lines] + [
        f"{name}: another file than the exported one" for name in files
    ]


def _changed_files(folder: Path, contract: Contract) -> list[str]:
    stated = {SCENE_FILE: contract.scene, TERRAIN_FILE: contract.terrain}
    return [
        name
        for name, wanted in stated.items()
        if wanted and (folder / name).is_file() and digest(folder / name) != wanted
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
        motion=read_motion(top.section(MOTION)) if MOTION in top.values else None,
        **_read_scenes(physics, version),
    )


def _read_scenes(physics: Reader, version: int) -> dict[str, Any]:
    """Their checksums."""
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
    """A misspelt rule would silently end nothing, so it is an error."""
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
    """Where the height scan looks, if a row is one."""
    if not any(row.values.get("measured") == SCAN for row in top.sections("observation")):
        return None
    scan = top.section(SCAN)
    x, y = (tuple(map(float, scan.take(key, "a list of numbers", lambda v: is_list(v, is_number)))) for key in "xy")
    return HeightScan(x, y, scan.above_zero("standing", _FARTHEST))


def _read_gait(top: Reader) -> Gait | None:
    """The clock, if a row is one."""
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
    """Values of a measured or computed quantity."""
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
    """Every row is one that can be measured, of the right size, and what ends a walk by falling on it is felt."""
    felt = [name.removeprefix("contact/") for name in contract.sensors.get(FALL, ())]
    for name in contract.ends.falls_on if felt else ():
        if name not in felt:
            raise ContractError(f"{CONTRACT_FILE}: ends: falls_on: {unknown('geom', name, felt, f'sensors: {FALL}')}")
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
                f"{where} is of a motion, and the contract has no section `{MOTION}`; export the policy again"
            )
        if row.measured not in measurable:
            raise ContractError(
                f"{where}: {unknown('quantity', row.measured, [*sorted(measurable), SENSORS], 'what a robot measures')}"
            )
        if row.size != (right := quantity_size(contract, row.measured)):
            raise ContractError(f"{where} has size {row.size}; {row.measured} has {right} values on this robot")
