"""The motors that an exported policy was trained with: the contract's section ``motors``, and those that MuJoCo does not have itself."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.reader import ContractError, Reader
from legged_mw.utils.files import digest
from legged_mw.utils.motor_network import (
    DC_CONSTANT,
    DC_DAMPING,
    DC_RESISTANCE,
    DC_STIFFNESS,
    Floats,
    MotorNetwork,
    read_network,
)

MOTORS, MOTORS_FILE = "motors", "motors.npz"
LAWS = ("servo", "dc_motor", "torque", "network")  # docs/motors.md
_ACTIVATIONS: dict[str, Callable[[Floats], Floats]] = {
    "elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, 0))),
    "relu": lambda x: np.maximum(x, 0),
    "softsign": lambda x: x / (1 + np.abs(x)),
    "tanh": np.tanh,
}


class Motors(NamedTuple):
    """What turns a joint target into a torque; a real robot's motors are their own law."""

    law: str = "servo"
    stall_torque: tuple[float, ...] = ()  # (D,) [N m] at the joint; empty: no torque-speed curve
    no_load_speed: tuple[float, ...] = ()  # (D,) [rad/s] likewise
    digest: str = ""  # SHA-256 of the network's file

    def to_dict(self) -> dict[str, Any]:
        """The section; nothing for servos."""
        curve = (
            {"stall_torque": list(self.stall_torque), "no_load_speed": list(self.no_load_speed)}
            if self.stall_torque
            else {}
        )
        network = {"file": MOTORS_FILE, "sha256": self.digest} if self.digest else {}
        return {MOTORS: {"law": self.law, **curve, **network}} if self.law != "servo" else {}

    def gains(self, model: mujoco.MjModel, actuators: list[int], dofs: np.ndarray) -> dict[str, np.ndarray]:
        """What ``model`` has of gains and curve, one a joint each, by the contract's names."""
        prm = model.actuator_gainprm[actuators]
        found = {}
        if self.law == "servo":
            found = {"stiffness": prm[:, 0], "damping": model.dof_damping[dofs].reshape(len(dofs), -1)[:, 0]}
        elif self.law == "dc_motor":
            found = {"stiffness": prm[:, DC_STIFFNESS], "damping": prm[:, DC_DAMPING]}
        if self.stall_torque:
            constant, resistance = np.maximum(prm[:, DC_CONSTANT], 1e-12), np.maximum(prm[:, DC_RESISTANCE], 1e-12)
            found |= {"motors: stall_torque": constant / resistance, "motors: no_load_speed": 1.0 / constant}
        return found

    def limp(self, batch: Any) -> None:
        """Switch the motors of ``batch``, which are no servos, off: what is left is damping, if there is any."""
        if self.law == "dc_motor":
            batch.expand("actuator_gainprm")[:, :, DC_STIFFNESS] = 0.0
        else:
            batch.expand("actuator_gear")[:] = 0.0


SERVOS = Motors()


def read_motors(section: Reader, joints: int) -> Motors:
    """The motors from the contract's reader of the section ``motors``."""
    law = section.take("law", f"one of {', '.join(LAWS)}", lambda value: value in LAWS)
    section.file("file", MOTORS_FILE)
    names = ("stall_torque", "no_load_speed") if law == "dc_motor" or "stall_torque" in section.values else ()
    curve = {name: tuple(section.numbers(name, joints, "joint").tolist()) for name in names}
    for name in names:
        section.take(name, "numbers above zero", lambda value: min(value) > 0)
    return Motors(law, digest=section.text("sha256") if law == "network" else "", **curve)


def make_network(folder: Path, motors: Motors, count: int, joints: int) -> NetworkMotors | None:
    """The motors of ``count`` robots, where they are a network. Raises ContractError, or UserError for a broken one."""
    if motors.law != "network":
        return None
    if not (folder / MOTORS_FILE).is_file():
        raise ContractError(f"no {MOTORS_FILE} in {folder}, the network of its motors; export the policy again")
    if digest(folder / MOTORS_FILE) != motors.digest:
        raise ContractError(
            f"{MOTORS_FILE} is not the file that policy.yaml was written for: its SHA-256 differs; export the policy again"
        )
    return NetworkMotors(read_network(folder / MOTORS_FILE), count, joints)


class NetworkMotors:
    """The motors of N robots with D joints: ``torque`` is called once a simulation step."""

    def __init__(self, network: MotorNetwork, robots: int, joints: int) -> None:
        self.network = network
        # newest first; errors, speeds, scaled
        self._past = np.zeros((network.frames[-1] + 1, 2, robots, joints), dtype=np.float32)
        # h and c of each layer
        self._memory = [np.zeros((2, robots, joints, units), dtype=np.float32) for units in network.hidden]

    def reset(self, which: Any = slice(None)) -> None:
        """The robots ``which`` (indices or a mask) begin again: nothing was ever off its target."""
        for memory in (self._past, *self._memory):
            memory[(slice(None), slice(None), which) if memory is self._past else (slice(None), which)] = 0.0

    def torque(self, error: NDArray[Any], speed: NDArray[Any]) -> Floats:
        """Torques (N, D) [N m] from target minus angle [rad] and speed [rad/s], (N, D) each."""
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
