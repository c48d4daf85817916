"""Convert a policy of unitree_rl_lab to an export: python examples/unitree_rl_lab.py POLICY LIKE OUT

POLICY has ``params/deploy.yaml`` and ``exported/policy.onnx``. LIKE is our export of the same robot. Its scene gets
the policy's gains and start pose. The inverse is ``legged-mw deploy DIR --deploy_yaml OUT``.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from legged_mw.deploy.contract import (
    CONTRACT_FILE,
    MOST,
    NETWORK_FILE,
    ROWS,
    SCENE_FILE,
    Action,
    ContractRow,
    read_contract,
)
from legged_mw.unitree.deploy_yaml import RANGES, TERMS
from legged_mw.unitree.robots import machine_of
from legged_mw.utils.commands import VELOCITY, Command
from legged_mw.utils.config import save_yaml
from legged_mw.utils.files import digest


class Loader(yaml.SafeLoader):
    """Isaac Lab writes Python's slice(None) for all joints, which a safe loader does not know. It is not used here."""


Loader.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: None)


def main(policy: Path, like: Path, out: Path) -> None:
    said = yaml.load((policy / "params/deploy.yaml").read_text(), Loader)
    own = read_contract(like)
    names = {slot: joint for joint, slot in machine_of(own.joints).motors.items()}
    slots = said["joint_ids_map"]
    joints, pose = tuple(names[slot] for slot in slots), np.array(said["default_joint_pos"], dtype=float)
    (action,) = said["actions"].values()
    if action["clip"] is not None or not np.allclose(action["offset"], pose):
        raise SystemExit("this example is of policies without clip, whose actions add to the default pose")
    contract = replace(
        own,
        task=policy.name,
        joints=joints,
        default_pose=pose,
        action=Action(
            "default", np.array(action["scale"]), 100.0, np.full(len(joints), -MOST), np.full(len(joints), MOST)
        ),
        stiffness=np.array(said["stiffness"])[slots],
        damping=np.array(said["damping"])[slots],
        period=float(said["step_dt"]),
        decimation=round(said["step_dt"] / own.timestep),
        commands=commands_of(said["commands"]["base_velocity"]["ranges"]),
        rows=tuple(row(name, term) for name, term in said["observations"].items()),
        sensors={
            **own.sensors,
            **{what: tuple(f"{sensor}/{joint}" for joint in joints) for what, sensor in SENSORS.items()},
        },
        gait=None,
        exam={"peer": (own.exam or {}).get("peer", "")},
    )
    out.mkdir(parents=True, exist_ok=True)
    (out / NETWORK_FILE).write_bytes((policy / "exported/policy.onnx").read_bytes())
    (out / SCENE_FILE).write_text(scene_of(like / SCENE_FILE, contract))
    contract = replace(contract, digest=digest(out / NETWORK_FILE), scene=digest(out / SCENE_FILE), terrain="")
    save_yaml(out / CONTRACT_FILE, contract.to_dict())
    print(f"written to {out}: {len(joints)} joints, {contract.size} values of observation; mass {contract.mass:.1f} kg")


SENSORS = {"joint_pos": "jointpos", "joint_vel": "jointvel", "joint_torque": "torque"}  # names in our exports


def row(name: str, term: dict[str, Any]) -> ContractRow:
    """A row of the contract from a term of deploy.yaml."""
    measured = next((what for what, (theirs, _) in TERMS.items() if theirs == name), None)
    if measured is None:
        raise SystemExit(f"no row {name!r} here; there are: {', '.join(theirs for theirs, _ in TERMS.values())}")
    ours, (_, unit, frame) = next((ours, quantity) for ours, quantity in ROWS.items() if quantity.measured == measured)
    scale = tuple(map(float, term["scale"]))
    return ContractRow(ours, len(scale), unit, frame, 0.0, measured, scale=scale, history=term["history_length"])


def commands_of(ranges: dict[str, Any]) -> tuple[Command, ...]:
    units = ("m/s", "m/s", "rad/s")
    return tuple(
        Command(ours, float(ranges[theirs][0]), float(ranges[theirs][1]), unit)
        for ours, theirs, unit in zip(VELOCITY, RANGES, units, strict=True)
    )


def scene_of(file: Path, contract: Any) -> str:
    """The scene with the policy's gains and default pose, and targets without limits."""
    spec = mujoco.MjSpec.from_file(str(file))
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST  # Euler is unstable with 10 N m s/rad at a wrist
    for joint, stiffness, damping in zip(contract.joints, contract.stiffness, contract.damping, strict=True):
        servo = spec.actuator(joint)
        servo.gainprm[0], servo.biasprm[1] = stiffness, -stiffness
        servo.ctrllimited, servo.ctrlrange = mujoco.mjtLimited.mjLIMITED_FALSE, [0.0, 0.0]
        spec.joint(joint).damping = [damping, 0.0, 0.0]  # damping of the servo: in our exports it is at the joint
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.qpos[[model.joint(joint).qposadr[0] for joint in contract.joints]] = contract.default_pose
    mujoco.mj_forward(model, data)
    lowest = min([contact.dist for contact in data.contact], default=0.0)
    data.qpos[2] -= lowest
    key = spec.keys[0]
    key.qpos, key.ctrl = data.qpos, contract.default_pose[[contract.joints.index(a.name) for a in spec.actuators]]
    spec.compile()
    return spec.to_xml()


if __name__ == "__main__":
    if len(sys.argv) != 4:
        raise SystemExit(__doc__)
    main(*map(Path, sys.argv[1:]))
