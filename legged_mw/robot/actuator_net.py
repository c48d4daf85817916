"""Convert an actuator network in torchscript (legged_gym, walk-these-ways, Isaac Lab) to an .npz for `control.network`.

    python -m legged_mw.robot.actuator_net anydrive_v3_lstm.pt anydrive.npz

Loading a torchscript file runs its code, so convert only files that you trust. Loading the .npz runs no code. The
shapes of the weights give the layers. Activation and scales are those for which the outputs of both files agree.
Nothing is written if they differ.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch

from legged_mw.envs.motors import NetworkLaw
from legged_mw.utils.cli import number, one_line_errors
from legged_mw.utils.errors import UserError
from legged_mw.utils.files import writable
from legged_mw.utils.motor_network import ACTIVATIONS, MotorNetwork

_STEPS, _JOINTS = 12, 64  # size of the comparison
_TOLERANCE = 1e-4  # share of the largest torque


def convert(file: Path, frames: Sequence[int] = (), **layout: Any) -> tuple[MotorNetwork, float]:
    """The network in ``file``, and the error of its torques against the file, as a share of the largest torque.

    ``frames`` (empty: the last few simulation steps) and ``layout`` (in_turns, scales) describe the input of the file.
    Raises UserError.
    """
    try:
        module = torch.jit.load(str(file), map_location="cpu").eval()
    except (RuntimeError, ValueError, OSError) as error:
        reason = str(error).strip().splitlines()[0]
        raise UserError(
            f"{file} is no torchscript file, which torch.jit.script(network).save(FILE) writes: {reason}"
        ) from None
    converted = _layers({name: value.detach().numpy() for name, value in module.state_dict().items()}, file)
    width = (converted.recurrent or converted.linear)[0][0].shape[1]
    frames = tuple(frames or range(width // 2))
    if width != 2 * len(frames):
        raise UserError(
            f"{file.name} takes {width} values a joint, and --frames means {2 * len(frames)}: an error and a speed of each"
        )
    fed = replace(converted, frames=frames, **layout)
    states = _states()
    expected = _theirs(module, fed, states)
    activations = [*ACTIVATIONS] if len(fed.linear) > 1 else [fed.activation]
    fits = [_fit(replace(fed, activation=name), states, expected) for name in activations]
    network, gap = min(fits, key=lambda fit: fit[1])
    if not gap <= _TOLERANCE:
        raise UserError(
            f"{file.name} and its layers with scaled inputs have different outputs, by {gap:.1%} of the largest torque with the best "
            f"activation, {network.activation}: does it have other inputs (--frames, --in_turns)? See its code with: "
            f"python -c 'import torch; print(torch.jit.load(\"{file}\").code)'"
        )
    return network, gap


def _layers(state: dict[str, Any], file: Path) -> MotorNetwork:
    """Read LSTM layers by their names in torch, and all other matrices as linear layers in order."""
    recurrent, linear = [], []
    while ends := [name for name in state if name.endswith(f"weight_ih_l{len(recurrent)}")]:
        prefix, layer = ends[0].removesuffix(f"weight_ih_l{len(recurrent)}"), len(recurrent)
        recurrent.append(
            tuple(state[f"{prefix}{name}_l{layer}"] for name in ("weight_ih", "weight_hh", "bias_ih", "bias_hh"))
        )
    for name, value in state.items():
        if value.ndim == 2 and "weight_ih_l" not in name and "weight_hh_l" not in name:
            linear.append(
                (value, state.get(name.removesuffix("weight") + "bias", np.zeros(len(value), dtype=np.float32)))
            )
    if not linear or len(linear[-1][0]) != 1:
        raise UserError(
            f"{file.name} has no last layer of one value, a joint's torque; it has {', '.join(state) or 'no weights'}"
        )
    return MotorNetwork(recurrent, linear, "elu", (0,))


def _states() -> Any:
    """Typical joint errors [rad] and speeds [rad/s] of a walking robot, (T, 2, J)."""
    spread = np.array([[0.3], [3.0]])
    return (spread * np.random.default_rng(0).standard_normal((_STEPS, 2, _JOINTS))).astype(np.float32)


def _theirs(module: Any, fed: MotorNetwork, states: Any) -> Any:
    """The file's torques (T, J) for ``states``."""
    past, torques = np.zeros((fed.frames[-1] + 1, 2, _JOINTS), dtype=np.float32), []
    memory = (torch.zeros(len(fed.hidden), _JOINTS, fed.hidden[0]),) * 2 if fed.hidden else None
    for now in states:
        past[1:] = past[:-1].copy()
        past[0] = now * [[fed.error_scale], [fed.speed_scale]]
        rows = past[list(fed.frames)].transpose(2, 0, 1) if fed.in_turns else past[list(fed.frames)].transpose(2, 1, 0)
        fed_rows = torch.from_numpy(rows.reshape(_JOINTS, -1))
        with torch.inference_mode():
            torque, memory = module(fed_rows[:, None], memory) if memory else (module(fed_rows), None)
        torques.append(fed.torque_scale * np.asarray(torque, dtype=np.float32).reshape(-1))
    return np.array(torques)


def _fit(network: MotorNetwork, states: Any, wanted: Any) -> tuple[MotorNetwork, float]:
    """``network`` with the scales that the file may apply inside, and the error as a share of the largest torque."""

    def ours(factors: Any) -> tuple[MotorNetwork, Any]:
        scaled = replace(
            network, error_scale=network.error_scale * factors[0], speed_scale=network.speed_scale * factors[1]
        )
        angle, speed = torch.zeros(1, _JOINTS), torch.zeros(1, _JOINTS)
        law, torques = NetworkLaw(scaled, angle, speed), []
        for now in torch.from_numpy(states):
            speed.copy_(now[1:])
            torques.append(law(now[:1]).numpy()[0])
        return scaled, np.array(torques)

    def left(logs: Any) -> tuple[MotorNetwork, Any]:
        """The network and its error with the best torque scale, by linear least squares."""
        scaled, torques = ours(np.exp(logs))
        factor = float((torques * wanted).sum() / max((torques * torques).sum(), 1e-12))
        return replace(scaled, torque_scale=scaled.torque_scale * factor), (factor * torques - wanted).ravel()

    largest = max(float(np.abs(wanted).max()), 1e-9)
    exact = float(np.abs(ours(np.ones(2))[1] - wanted).max()) / largest
    if exact <= _TOLERANCE:
        return network, exact
    best = min(
        (np.array(logs) for logs in product(np.log([0.03, 0.1, 0.3, 1.0, 3.0, 10.0]), repeat=2)),
        key=lambda x: _norm(left(x)[1]),
    )
    for _ in range(30):  # Gauss-Newton, with step halving
        here = left(best)[1]
        slopes = np.stack([(left(best + step)[1] - here) / 1e-2 for step in 1e-2 * np.eye(2)], axis=1)
        move = -np.linalg.lstsq(slopes, here, rcond=None)[0]
        best = min((best + share * move for share in (1.0, 0.5, 0.1, 0.0)), key=lambda x: _norm(left(x)[1]))
    scaled, residual = left(best)
    return scaled, float(np.abs(residual).max()) / largest


def _norm(residual: Any) -> float:
    return float((residual**2).sum()) if np.isfinite(residual).all() else np.inf


def main(argv: Sequence[str] | None = None) -> None:
    """Convert one file to .npz."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("file", type=Path, help="the torchscript file")
    parser.add_argument("out", type=Path, help="the .npz to write")
    parser.add_argument(
        "--frames", type=int, nargs="+", default=None, help="ages in simulation steps, 0 is now (default: 0 1 2 ...)"
    )
    parser.add_argument("--in_turns", action="store_true", help="error, speed, error, speed ...; else errors first")
    for name, what in (
        ("error", "of target - angle [rad]"),
        ("speed", "of the speed [rad/s]"),
        ("torque", "of what comes out"),
    ):
        parser.add_argument(f"--{name}_scale", type=number(float), default=1.0, help=f"factor {what}")
    args = parser.parse_args(argv)
    writable(str(args.out), "OUT").parent.mkdir(parents=True, exist_ok=True)
    layout = {name: getattr(args, name) for name in ("in_turns", "error_scale", "speed_scale", "torque_scale")}
    network, gap = convert(args.file, args.frames or (), **layout)
    with args.out.open("wb") as out:
        np.savez(out, **network.to_arrays())
    sizes = [*(f"LSTM {units}" for units in network.hidden), *(str(len(bias)) for _, bias in network.linear)]
    scales = f"scales {network.error_scale:.4g} 1/rad, {network.speed_scale:.4g} s/rad, {network.torque_scale:.4g} N m"
    what = f"layers {', '.join(sizes)}, {network.activation}, {scales}"
    print(f"written to {args.out}: {what}; torques differ from the file's by {gap:.0e} of the largest")


if __name__ == "__main__":
    with one_line_errors():
        main()
