"""The MJCF of an export: read, checked against the contract, and where its names are. Nothing is stepped."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from legged_mw.deploy.contract import CONTRACT_FILE, FALL, SCENE_FILE, SENSED, Contract, ContractError, quantity_size
from legged_mw.utils.errors import unknown


@dataclass(frozen=True)
class Scene:
    """The robot in MuJoCo, and where its names are."""

    model: mujoco.MjModel
    actuators: np.ndarray  # (D,) index of each joint's servo in ctrl
    sensordata: dict[str, np.ndarray]  # quantity, or name of a row with sensors of its own -> indices in sensordata
    contacts: list[np.ndarray]  # the same of each foot


def read_scene(folder: Path, contract: Contract, file: str = SCENE_FILE) -> Scene:
    """``scene.xml`` of an export, or another ``file`` in it, which must be the robot of the contract. Raises ContractError."""
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
    needed = [*SENSED, *([FALL] if contract.ends.falls_on else [])]
    if missing := [name for name in needed if name not in contract.sensors]:
        raise ContractError(f"{CONTRACT_FILE}: sensors: '{missing[0]}' is missing; name the sensors of {file} that measure it")
    own = {row.name: row for row in contract.rows if row.sensors}
    named, places = {**contract.sensors, **{name: row.sensors for name, row in own.items()}}, {}
    for name, sensors in named.items():
        places[name] = _places(model, file, sensors, name)
        size = own[name].size if name in own else quantity_size(contract, name)
        if len(places[name]) != size:
            raise ContractError(f"{file}: the sensors of '{name}' ({', '.join(sensors)}) have {len(places[name])} values, not {size}")
    return Scene(model, np.array(actuators), places, [_places(model, file, names, foot) for foot, names in contract.feet.items()])


def _index(model: mujoco.MjModel, file: str, kind: str, name: str, word: str) -> int:
    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        raise ContractError(f"{CONTRACT_FILE}: joints: {unknown(word, name, _names(model, kind), file)}")
    return index


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = {"joint": model.njnt, "actuator": model.nu, "sensor": model.nsensor}[kind]
    names = [mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i) for i in range(count)]
    return [name for name in names if name]


def _places(model: mujoco.MjModel, file: str, sensors: Sequence[str], what: str) -> np.ndarray:
    """Indices in sensordata of ``sensors``, side by side."""
    spans = []
    for name in sensors:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if index < 0:
            raise ContractError(f"{CONTRACT_FILE}: sensors of '{what}': {unknown('sensor', name, _names(model, 'sensor'), file)}")
        spans.append(np.arange(model.sensor_adr[index], model.sensor_adr[index] + model.sensor_dim[index]))
    return np.concatenate(spans)


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
    for name, values in checks.items():
        if not np.allclose(*values, rtol=1e-4, atol=1e-6):
            stated, found = (np.array2string(np.asarray(x), precision=6, separator=", ", max_line_width=10_000) for x in values)
            raise ContractError(f"{CONTRACT_FILE}: {name} is {stated}, but {file} has {found}; export the policy again")
