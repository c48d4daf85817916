"""A motor network as one warp kernel: a thread a joint of a world, weights read by all, what it remembers in fixed memory."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportOperatorIssue=false, reportReturnType=false
# pyright: reportGeneralTypeIssues=false, reportInvalidTypeForm=false, reportAttributeAccessIssue=false, reportAssignmentType=false
# ruff: noqa: UP018, RUF046
# (warp compiles what it finds written here as its own language: int() makes a variable)
from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp
from torch import Tensor

from legged_mw.sim.motor_network import SimulatedNetwork
from legged_mw.sim.simulation import Simulation
from legged_mw.utils.math import assign
from legged_mw.utils.motor_network import ACTIVATIONS, MotorNetwork

_KINDS = list(ACTIVATIONS)


@wp.func
def _activate(kind: int, x: float) -> float:
    """In the order of ``ACTIVATIONS``: elu, relu, softsign, tanh."""
    if kind == 0:
        return wp.where(x > 0.0, x, wp.exp(wp.min(x, 0.0)) - 1.0)
    if kind == 1:
        return wp.max(x, 0.0)
    if kind == 2:
        return x / (1.0 + wp.abs(x))
    return wp.tanh(x)


@wp.func
def _sigmoid(x: float) -> float:
    return 1.0 / (1.0 + wp.exp(-x))


def _make_kernel(width: int) -> Any:
    """The kernel for networks of layers up to ``width``."""
    vec = wp.types.vector(length=width, dtype=float)

    @wp.kernel(module="unique", enable_backward=False)
    def torque(
        targets: wp.array2d[float],
        angle: wp.array2d[float],
        speed: wp.array2d[float],
        scales: wp.vec3,  # of error, speed, torque
        frames: wp.array[int],
        in_turns: int,
        units: wp.array[int],  # of each LSTM layer
        sizes: wp.array[int],  # values that go into each linear layer, and the one that comes out
        weights: wp.array[float],
        activation: int,
        past: wp.array3d[wp.vec2],  # (N, D, frames kept), newest first
        memory: wp.array4d[float],  # (2, N, D, units of all LSTM layers): h and c
        ctrl: wp.array2d[float],
    ):
        w, j = wp.tid()
        for age in range(past.shape[2] - 1, 0, -1):
            past[w, j, age] = past[w, j, age - 1]
        past[w, j, 0] = wp.vec2(scales[0] * (targets[w, j] - angle[w, j]), scales[1] * speed[w, j])
        x = vec()
        y = vec()
        count = frames.shape[0]
        for i in range(count):
            frame = past[w, j, frames[i]]
            if in_turns == 1:
                x[2 * i] = frame[0]
                x[2 * i + 1] = frame[1]
            else:
                x[i] = frame[0]
                x[count + i] = frame[1]
        inputs = 2 * count
        at = int(0)  # in weights
        first = int(0)  # in memory
        for layer in range(units.shape[0]):
            n = units[layer]
            at_h = at + 4 * n * inputs
            at_b = at_h + 4 * n * n
            for u in range(n):
                gates = wp.vec4()
                for gate in range(4):
                    row = gate * n + u
                    value = weights[at_b + row] + weights[at_b + 4 * n + row]
                    for i in range(inputs):
                        value += weights[at + row * inputs + i] * x[i]
                    for i in range(n):
                        value += weights[at_h + row * n + i] * memory[0, w, j, first + i]
                    gates[gate] = value
                c = _sigmoid(gates[1]) * memory[1, w, j, first + u] + _sigmoid(gates[0]) * wp.tanh(gates[2])
                memory[1, w, j, first + u] = c
                y[u] = _sigmoid(gates[3]) * wp.tanh(c)
            for u in range(n):
                memory[0, w, j, first + u] = y[u]
                x[u] = y[u]
            at = at_b + 8 * n
            first += n
            inputs = n
        last = sizes.shape[0] - 2
        for layer in range(last + 1):
            n = sizes[layer]
            outputs = sizes[layer + 1]
            for u in range(outputs):
                value = weights[at + n * outputs + u]
                for i in range(n):
                    value += weights[at + u * n + i] * x[i]
                y[u] = wp.where(layer < last, _activate(activation, value), value)
            for u in range(outputs):
                x[u] = y[u]
            at += (n + 1) * outputs
        ctrl[w, j] = scales[2] * x[0]

    return torque


class WarpNetwork(SimulatedNetwork):
    """``network`` on mujoco-warp."""

    def __init__(self, network: MotorNetwork, sim: Simulation) -> None:
        robots, joints = sim.ctrl.shape
        sizes = [network.linear[0][0].shape[1], *(len(bias) for _, bias in network.linear)]
        weights = [value for layer in (*network.recurrent, *network.linear) for value in layer]
        with wp.ScopedDevice(sim.device):
            frames, units, counts = (wp.array(values, dtype=int) for values in (network.frames, network.hidden, sizes))
            flat = wp.array(np.concatenate([value.ravel() for value in weights]), dtype=float)
        self._past = torch.zeros(robots, joints, network.frames[-1] + 1, 2, device=sim.device)
        self._memory = torch.zeros(2, robots, joints, sum(network.hidden), device=sim.device)
        memory = wp.from_torch(self._memory) if network.hidden else wp.zeros((2, 1, 1, 1), dtype=float, device=sim.device)
        scales = wp.vec3(network.error_scale, network.speed_scale, network.torque_scale)
        self._kernel = _make_kernel(max(*sizes, *network.hidden, 2 * len(network.frames)))
        self._before = [wp.from_torch(sim.qpos[:, -joints:]), wp.from_torch(sim.qvel[:, -joints:]), scales, frames, int(network.in_turns)]
        self._after = [units, counts, flat, _KINDS.index(network.activation), wp.from_torch(self._past, dtype=wp.vec2), memory]
        self._ctrl = wp.from_torch(sim.ctrl)

    def __call__(self, targets: Tensor) -> None:
        inputs = [wp.from_torch(targets), *self._before, *self._after]
        wp.launch(self._kernel, dim=self._ctrl.shape, inputs=inputs, outputs=[self._ctrl], device=self._ctrl.device)

    def reset(self, mask: Tensor) -> None:
        assign(self._past, mask, 0.0)
        self._memory.masked_fill_(mask[:, None, None], 0.0)
