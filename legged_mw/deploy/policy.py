"""The network of an export, and the loop of thought around it: measurement and command in, servo targets out.

Knows no robot and no clock.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import CONTRACT_FILE, NETWORK_FILE, OWN, Contract, ContractError
from legged_mw.deploy.robot import Measurement
from legged_mw.utils.errors import UserError

Floats = NDArray[np.floating[Any]]


class Network:
    """``policy.onnx`` on one thread: observations (N, size) -> actions (N, D), float32."""

    def __init__(self, folder: Path, contract: Contract) -> None:
        """Load it; raises ContractError if its inputs and outputs are not the contract's."""
        try:
            import onnxruntime
        except ImportError:
            raise UserError("running an exported policy needs onnxruntime: pip install onnxruntime") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # a network this small loses by a second
        options.log_severity_level = 4
        try:
            self._session = onnxruntime.InferenceSession((folder / NETWORK_FILE).read_bytes(), options, providers=["CPUExecutionProvider"])
        except Exception:  # onnxruntime raises a type of its own for each way that a file is broken
            raise ContractError(f"{NETWORK_FILE} cannot be read as an ONNX network: it is damaged; export the policy again") from None
        self._input, self._output = contract.input, contract.output
        self._one_by_one = self._check(contract)

    def _check(self, contract: Contract) -> bool:
        """One input and one output of the contract's names and sizes; returns whether the batch is fixed to 1."""
        names = ", ".join(f"{row.name} {row.size}" for row in contract.rows)
        for what, ports, name, size, why in (
            ("input", self._session.get_inputs(), contract.input, contract.size, f"the rows of `observation`: {names}"),
            ("output", self._session.get_outputs(), contract.output, len(contract.joints), "one action a joint"),
        ):
            found = ", ".join(f"'{port.name}' {port.shape}" for port in ports)
            if len(ports) != 1 or ports[0].name != name or len(ports[0].shape) != 2 or ports[0].shape[1] != size:
                raise ContractError(
                    f"{NETWORK_FILE} does not fit {CONTRACT_FILE}: its {what} is {found}, the contract's is '{name}' [1, {size}] ({why})"
                )
        return self._session.get_inputs()[0].shape[0] == 1

    def __call__(self, obs: Floats) -> NDArray[np.float32]:
        rows = np.ascontiguousarray(obs, dtype=np.float32)
        if self._one_by_one and len(rows) != 1:
            return np.concatenate([self(row[None]) for row in rows])
        return np.asarray(self._session.run([self._output], {self._input: rows})[0])


class Controller:
    """A policy at work on ``count`` robots: builds observations as the contract says and remembers the last actions."""

    def __init__(self, folder: Path, contract: Contract, count: int = 1) -> None:
        self.contract, self._network = contract, Network(folder, contract)
        self.last_actions = np.zeros((count, len(contract.joints)), dtype=np.float32)

    def observe(self, measurement: Measurement, commands: Floats) -> NDArray[np.float32]:
        """The network's input (N, size) from a measurement of N robots (or of one, without the leading axis)."""
        values = {
            "command": commands,
            "last_action": self.last_actions,
            "joint_offset": measurement.joint_pos - self.contract.default_pose,
        }
        rows = []
        for row in self.contract.rows:
            if row.measured in OWN and row.name not in measurement.others:
                raise ContractError(f"the robot does not measure row '{row.name}': it must be in Measurement.others ({row.size} values)")
            value = measurement.others[row.name] if row.measured in OWN else values.get(row.measured)
            value = np.atleast_2d(getattr(measurement, row.measured) if value is None else value)
            rows.append((value * np.array(row.scale)).astype(np.float32))
        return np.concatenate(rows, axis=1)

    def act(self, measurement: Measurement, commands: Floats) -> NDArray[np.float64]:
        """Servo targets (N, D) [rad] for the next period; ``commands`` (N, 3): vx, vy [m/s], yaw rate [rad/s]."""
        clip = self.contract.action_clip
        self.last_actions = np.clip(self._network(self.observe(measurement, commands)), -clip, clip)
        return self.contract.default_pose + self.contract.action_scale * self.last_actions.astype(np.float64)

    def reset(self, which: Any = slice(None)) -> None:
        """Forget the last actions of the robots ``which``, that begin anew."""
        self.last_actions[which] = 0.0
