"""An export in the format of unitree_rl_lab's program for a robot: ``params/deploy.yaml``, ``exported/policy.onnx``.

Names and meanings are those of its ``export_deploy_cfg.py`` and ``deploy/include`` (commit e72a072c). Gains are in the
order of the motors; all other values are in the policy's order.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime

from legged_mw.deploy.contract import MOST, NETWORK_FILE, Contract, ContractError, ContractRow
from legged_mw.unitree.robots import machine_of, order
from legged_mw.utils.commands import VELOCITY
from legged_mw.utils.config import save_yaml
from legged_mw.utils.files import writable

# quantity of a row -> name in that program, parameters
TERMS: dict[str, tuple[str, dict[str, Any]]] = {
    "ang_vel": ("base_ang_vel", {}),
    "gravity": ("projected_gravity", {}),
    "command": ("velocity_commands", {"command_name": "base_velocity"}),
    "joint_offset": ("joint_pos_rel", {}),
    "joint_vel": ("joint_vel_rel", {}),
    "last_action": ("last_action", {}),
}
RANGES = ("lin_vel_x", "lin_vel_y", "ang_vel_z")  # the program's names of VELOCITY


def write(folder: Path, contract: Contract, out: Path) -> str:
    """Write both files into ``out``. Returns a message. Raises ContractError for settings that they cannot express."""
    settings = deploy_settings(contract)
    network, config = out / "exported" / NETWORK_FILE, out / "params" / "deploy.yaml"
    for file in (network, config):
        writable(str(file), "--deploy_yaml").parent.mkdir(parents=True, exist_ok=True)
    _fix_batch(folder / NETWORK_FILE, network)
    save_yaml(config, settings)
    return f"written to {out}: params/deploy.yaml and exported/{NETWORK_FILE}, whose batch is 1"


def deploy_settings(contract: Contract) -> dict[str, Any]:
    """The content of deploy.yaml. Raises ContractError, and RobotError for a robot that is not Unitree's."""
    slots = order(machine_of(contract.joints), contract.joints)
    _check(contract)
    action = contract.action
    gains = {name: np.zeros(slots.max() + 1) for name in ("stiffness", "damping")}
    for name, by_motor in gains.items():
        by_motor[slots] = getattr(contract, name)
    held = bool((action.lowest > -MOST).any() or (action.highest < MOST).any())
    commands = {command.name: [command.low, command.high] for command in contract.commands}
    ranges = {name: commands[own] for name, own in zip(RANGES, VELOCITY, strict=True)} if commands else {}
    return {
        "joint_ids_map": slots.tolist(),
        "step_dt": contract.period,
        **{name: by_motor.tolist() for name, by_motor in gains.items()},
        "default_joint_pos": contract.default_pose.tolist(),
        "commands": {"base_velocity": {"ranges": {**ranges, "heading": None}}} if ranges else {},
        "actions": {
            "JointPositionAction": {
                "clip": np.stack([action.lowest, action.highest], axis=1).tolist() if held else None,
                "joint_names": [".*"],
                "scale": action.scale.tolist(),
                "offset": contract.default_pose.tolist(),
                "joint_ids": None,
            }
        },
        "observations": dict(map(_term, contract.rows)),
    }


def _term(row: ContractRow) -> tuple[str, dict[str, Any]]:
    name, params = TERMS[row.measured]
    scale = list(row.scale) if len(row.scale) == row.size else [row.scale[0]] * row.size
    return name, {"params": params, "clip": None, "scale": scale, "history_length": row.history}


def _check(contract: Contract) -> None:
    """Raise ContractError for the first setting that unitree_rl_lab's program does not support."""
    measured = [row.measured for row in contract.rows]
    unknown = [row.name for row in contract.rows if row.measured not in TERMS]
    twice = [row.name for row in contract.rows if measured.count(row.measured) > 1]
    names = [command.name for command in contract.commands]
    wrong = {
        f"the row {', '.join(unknown)}; its rows measure {', '.join(TERMS)}": unknown,
        f"one row twice: {', '.join(twice)}": twice,
        f"the commands {', '.join(names)}; it has {', '.join(VELOCITY)}": names and names != list(VELOCITY),
        f"an action from the origin {contract.action.origin}; it has default": contract.action.origin != "default",
        "a network with a memory": contract.memory,
    }
    for what, is_so in wrong.items():
        if is_so:
            raise ContractError(f"--deploy_yaml: unitree_rl_lab's program does not know {what}")


def _fix_batch(source: Path, target: Path) -> None:
    """Copy the network with a batch of 1, because the program reads tensor shapes from the file."""
    options = onnxruntime.SessionOptions()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    options.optimized_model_filepath = str(target)
    inputs = onnxruntime.InferenceSession(str(source), providers=["CPUExecutionProvider"]).get_inputs()
    for axis in {each.shape[0] for each in inputs if isinstance(each.shape[0], str)}:
        options.add_free_dimension_override_by_name(axis, 1)
    onnxruntime.InferenceSession(str(source), options, providers=["CPUExecutionProvider"])
