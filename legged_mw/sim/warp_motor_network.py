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

from legged_mw.sim.simulation import Simulation
from legged_mw.utils.math import assign
from legged_mw.utils.motor_network import ACTIVATIONS, MotorNetwork


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


@wp.struct
class _Net:
    scales: wp.vec3  # of error, speed, torque
    frames: wp.array[int]
    in_turns: int
    units: wp.array[int]  # of each LSTM layer
    sizes: wp.array[int]  # values that go into each linear layer, and the one that comes out of the last
    weights: wp.array[wp.vec4]  # as ``_in_fours`` has them
    activation: int


@wp.func
def _dot(weights: wp.array[wp.vec4], start: int, count: int, x: Any) -> wp.vec4:
    """Four sums at once: a thread waits for one weight after another, so the fewer turns the better."""
    value = wp.vec4()
    for i in range(count):
        value += x[i] * weights[start + i]
    return value


@wp.func
def _look(net: _Net, past: wp.array3d[wp.vec2], w: int, j: int, x: Any):
    """The network's input, in a vector like ``x``."""
    y = x * 0.0
    count = net.frames.shape[0]
    for i in range(count):
        frame = past[w, j, net.frames[i]]
        if net.in_turns == 1:
            y[2 * i] = frame[0]
            y[2 * i + 1] = frame[1]
        else:
            y[i] = frame[0]
            y[count + i] = frame[1]
    return y


@wp.func
def _recur(net: _Net, at: int, inputs: int, n: int, memory: wp.array4d[float], first: int, w: int, j: int, x: Any):
    """An LSTM layer of ``n`` units whose weights begin at ``at`` and whose memory at ``first``."""
    y = x * 0.0
    for u in range(n):
        start = at + u * (inputs + n + 1)
        gates = net.weights[start + inputs + n] + _dot(net.weights, start, inputs, x)
        for i in range(n):
            gates += memory[0, w, j, first + i] * net.weights[start + inputs + i]
        c = _sigmoid(gates[1]) * memory[1, w, j, first + u] + _sigmoid(gates[0]) * wp.tanh(gates[2])
        memory[1, w, j, first + u] = c
        y[u] = _sigmoid(gates[3]) * wp.tanh(c)
    for u in range(n):
        memory[0, w, j, first + u] = y[u]
    return y


@wp.func
def _combine(net: _Net, at: int, inputs: int, outputs: int, last: bool, x: Any):
    """A linear layer whose weights begin at ``at``, and its activation unless it is the last."""
    y = x * 0.0
    for four in range((outputs + 3) // 4):
        start = at + four * (inputs + 1)
        values = _dot(net.weights, start, inputs, x) + net.weights[start + inputs]
        for k in range(4):
            y[4 * four + k] = values[k] if last else _activate(net.activation, values[k])
    return y


def _in_fours(network: MotorNetwork) -> np.ndarray:
    """Its weights (W, 4): of an LSTM's unit the four gates side by side, of a linear layer four units; their biases come after them."""
    blocks = []
    for into, onward, *biases in network.recurrent:
        block = np.concatenate([into, onward, (biases[0] + biases[1])[:, None]], axis=1)
        blocks.append(block.reshape(4, -1, block.shape[1]).transpose(1, 2, 0))
    for weight, bias in network.linear:
        block = np.concatenate([weight, bias[:, None]], axis=1)
        block = np.pad(block, ((0, -len(block) % 4), (0, 0)))
        blocks.append(block.reshape(-1, 4, block.shape[1]).transpose(0, 2, 1))
    return np.concatenate([block.reshape(-1, 4) for block in blocks]).astype(np.float32)


def _make_kernel(width: int) -> Any:
    """The kernel for networks of layers up to ``width``, a multiple of four."""
    vec = wp.types.vector(length=width, dtype=float)

    @wp.kernel(module="unique", enable_backward=False)
    def torque(
        net: _Net,
        targets: wp.array2d[float],
        angle: wp.array2d[float],
        speed: wp.array2d[float],
        past: wp.array3d[wp.vec2],  # (N, D, frames kept), newest first
        memory: wp.array4d[float],  # (2, N, D, units of all LSTM layers): h and c
        ctrl: wp.array2d[float],
    ):
        w, j = wp.tid()
        for age in range(past.shape[2] - 1, 0, -1):
            past[w, j, age] = past[w, j, age - 1]
        past[w, j, 0] = wp.vec2(net.scales[0] * (targets[w, j] - angle[w, j]), net.scales[1] * speed[w, j])
        x = _look(net, past, w, j, vec())
        inputs = 2 * net.frames.shape[0]
        at = int(0)  # in weights
        first = int(0)  # in memory
        for layer in range(net.units.shape[0]):
            n = net.units[layer]
            x = _recur(net, at, inputs, n, memory, first, w, j, x)
            at += n * (inputs + n + 1)
            first += n
            inputs = n
        layers = net.sizes.shape[0] - 1
        for layer in range(layers):
            x = _combine(net, at, net.sizes[layer], net.sizes[layer + 1], layer == layers - 1, x)
            at += (net.sizes[layer] + 1) * ((net.sizes[layer + 1] + 3) // 4)
        ctrl[w, j] = net.scales[2] * x[0]

    return torque


class WarpNetwork:
    """``network`` on mujoco-warp, as ``motor_network.SimulatedNetwork`` promises."""

    written = ("_past", "_memory")

    def __init__(self, network: MotorNetwork, sim: Simulation) -> None:
        robots, joints = sim.ctrl.shape
        sizes = [network.linear[0][0].shape[1], *(len(bias) for _, bias in network.linear)]
        with wp.ScopedDevice(sim.device):
            net = _Net()
            net.scales = wp.vec3(network.error_scale, network.speed_scale, network.torque_scale)
            net.frames, net.units, net.sizes = (
                wp.array(values, dtype=int) for values in (network.frames, network.hidden, sizes)
            )
            net.weights = wp.array(_in_fours(network), dtype=wp.vec4)
            net.in_turns, net.activation = int(network.in_turns), list(ACTIVATIONS).index(network.activation)
        self._past = torch.zeros(robots, joints, network.frames[-1] + 1, 2, device=sim.device)
        self._memory = torch.zeros(2, robots, joints, max(1, sum(network.hidden)), device=sim.device)
        width = max(*sizes, *network.hidden, 2 * len(network.frames))
        self._kernel = _make_kernel(width + -width % 4)
        self._net, self._ctrl = net, wp.from_torch(sim.ctrl)
        self._state = [wp.from_torch(sim.qpos[:, -joints:]), wp.from_torch(sim.qvel[:, -joints:])]
        self._state += [wp.from_torch(self._past, dtype=wp.vec2), wp.from_torch(self._memory)]

    def __call__(self, targets: Tensor) -> None:
        inputs = [self._net, wp.from_torch(targets), *self._state]
        wp.launch(self._kernel, dim=self._ctrl.shape, inputs=inputs, outputs=[self._ctrl], device=self._ctrl.device)

    def reset(self, mask: Tensor) -> None:
        assign(self._past, mask, 0.0)
        self._memory.masked_fill_(mask[:, None, None], 0.0)
