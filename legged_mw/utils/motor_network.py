"""A small neural network as motor model: it computes a joint's torque from recent position errors and speeds.

All joints use the same network. Reading its .npz runs no code. envs/motors.py and deploy/contract.py evaluate it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.utils.errors import UserError, unknown
from legged_mw.utils.files import read_arrays

Floats = NDArray[Any]  # float32
ACTIVATIONS = ("elu", "relu", "softsign", "tanh")
DC_RESISTANCE, DC_CONSTANT, DC_STIFFNESS, DC_DAMPING = 0, 1, 4, 6  # indices in actuator_gainprm of MuJoCo's DC motor
_RECURRENT = ("weight_ih", "weight_hh", "bias_ih", "bias_hh")
_SCALES = ("error_scale", "speed_scale", "torque_scale")


@dataclass(frozen=True)
class MotorNetwork:
    """LSTM layers, if any, then linear layers with an activation between them. Weights are (out, in), as in torch.

    Input of a joint: error_scale * (target - angle) [rad] of all ``frames``, then speed_scale * speed [rad/s] of all
    ``frames``; with ``in_turns`` error and speed alternate. ``frames``: ages in simulation steps, 0 is now. Output x
    torque_scale: torque [N m].
    """

    recurrent: list[tuple[Floats, Floats, Floats, Floats]]  # (4 H, in), (4 H, H), (4 H,), (4 H,); gates i, f, g, o
    linear: list[tuple[Floats, Floats]]  # (out, in), (out,)
    activation: str
    frames: tuple[int, ...]
    in_turns: bool = False
    error_scale: float = 1.0
    speed_scale: float = 1.0
    torque_scale: float = 1.0

    @property
    def hidden(self) -> list[int]:
        """Number of units of each LSTM layer."""
        return [layer[1].shape[1] for layer in self.recurrent]

    def to_arrays(self) -> dict[str, Any]:
        """Name -> array, for the .npz."""
        arrays: dict[str, Any] = {name: getattr(self, name) for name in ("activation", "in_turns", *_SCALES)}
        for i, layer in enumerate(self.recurrent):
            arrays |= {f"{name}_l{i}": value for name, value in zip(_RECURRENT, layer, strict=True)}
        for i, (weight, bias) in enumerate(self.linear):
            arrays |= {f"weight{i}": weight, f"bias{i}": bias}
        return {**arrays, "frames": np.array(self.frames)}


def read_network(file: Path) -> MotorNetwork:
    """Read the network in ``file``. Raises UserError if the file has none."""
    try:
        arrays = read_arrays(file)
    except ValueError:
        arrays = {}
    if not any(name.startswith("weight") for name in arrays):  # a torchscript file is a zip too
        remedy = f"a torchscript file becomes one by: python -m legged_mw.robot.actuator_net {file.name}"
        raise UserError(f"{file.name} is no .npz of a network's arrays; {remedy}")
    try:
        return _read(arrays)
    except (KeyError, ValueError, TypeError, OverflowError) as error:
        raise UserError(f"{file.name}: {error.args[0]}") from None


def _read(arrays: Mapping[str, Any]) -> MotorNetwork:
    frames = tuple(int(age) for age in np.ravel(arrays.get("frames", 0)))
    if not frames or list(frames) != sorted({*frames}) or frames[0] < 0 or frames[-1] > 10_000:
        must = "they must be ages in simulation steps, the newest first, 10000 at most"
        raise ValueError(f"frames is {list(frames)[:99]}; {must}")
    activation = str(arrays.get("activation", "elu"))
    if activation not in ACTIVATIONS:
        raise ValueError(unknown("activation", activation, ACTIVATIONS, "motor networks"))
    width, recurrent, linear = 2 * len(frames), [], []
    while f"weight_ih_l{len(recurrent)}" in arrays:
        layer = f"l{len(recurrent)}"
        units = _take(arrays, f"weight_hh_{layer}", -1, -1).shape[1]
        shapes = ((4 * units, width), (4 * units, units), (4 * units,), (4 * units,))
        named = zip(_RECURRENT, shapes, strict=True)
        recurrent.append(tuple(_take(arrays, f"{name}_{layer}", *shape) for name, shape in named))
        width = units
    while f"weight{len(linear)}" in arrays:
        weight = _take(arrays, f"weight{len(linear)}", -1, width)
        linear.append((weight, _take(arrays, f"bias{len(linear)}", len(weight))))
        width = len(weight)
    if not linear or width != 1:
        outputs = width if linear else "none: there is no weight0"
        raise ValueError(f"the last layer must give one value, a joint's torque; it gives {outputs}")
    scales = {name: float(_take({name: 1.0, **arrays}, name)) for name in _SCALES}
    return MotorNetwork(recurrent, linear, activation, frames, bool(arrays.get("in_turns", False)), **scales)


def _take(arrays: Mapping[str, Any], name: str, *shape: int) -> Floats:
    """The array ``name``. Raises ValueError if it is missing, not finite or not of ``shape``; -1: any size."""
    if name not in arrays:
        raise ValueError(f"array '{name}' is missing")
    value = np.asarray(arrays[name], dtype=np.float32)
    same = value.ndim == len(shape)
    expected = tuple(own if size < 0 else size for own, size in zip(value.shape, shape, strict=True)) if same else shape
    if value.shape != expected:
        why = "(out, in), in from the layer before or the frames"
        raise ValueError(f"array '{name}' has shape {value.shape}, it must be {expected}: {why}")
    if not np.isfinite(value).all():
        raise ValueError(f"array '{name}' has values that are not finite")
    return value
