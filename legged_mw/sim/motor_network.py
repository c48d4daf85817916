"""Motors that are networks, on either engine: numpy beside MuJoCo's own, one warp kernel on mujoco-warp, recorded with the step."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from legged_mw.sim.simulation import Simulation
from legged_mw.utils.motor_network import MotorNetwork, NetworkMotors


class SimulatedNetwork(Protocol):
    """Called before a substep with the joints' targets (N, D) [rad], it writes their torques to ``ctrl``."""

    def __call__(self, targets: Tensor) -> None: ...

    def reset(self, mask: Tensor) -> None:
        """Where ``mask`` (N,) is true nothing was ever off its target."""


def make_motor_network(network: MotorNetwork, sim: Simulation) -> SimulatedNetwork:
    """``network`` as the motors of all actuators of ``sim``, which must take torques; one actuator a joint, in their order."""
    if sim.engine == "mujoco":
        return _OnHost(network, sim)
    from legged_mw.sim.warp_motor_network import WarpNetwork

    return WarpNetwork(network, sim)


class _OnHost:
    written = ("_error", "_mask", "_memory")

    def __init__(self, network: MotorNetwork, sim: Simulation) -> None:
        joints = sim.ctrl.shape[1]
        self._motors = NetworkMotors(network, sim.num_envs, joints)
        self._memory = [torch.from_numpy(each) for each in self._motors.memory]
        self._error, self._mask = torch.zeros_like(sim.ctrl), torch.zeros(sim.num_envs, dtype=torch.bool)
        self._angle, self._speed, self._ctrl = sim.qpos[:, -joints:], sim.qvel[:, -joints:].numpy(), sim.ctrl.numpy()
        self._arrays = self._error.numpy(), self._mask.numpy()  # the same memory

    def __call__(self, targets: Tensor) -> None:
        torch.sub(targets, self._angle, out=self._error)
        self._ctrl[:] = self._motors.torque(self._arrays[0], self._speed)

    def reset(self, mask: Tensor) -> None:
        self._mask.copy_(mask)
        self._motors.reset(self._arrays[1])
