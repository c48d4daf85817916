"""Motors that are networks, on either engine: numpy beside MuJoCo's own, one warp kernel on mujoco-warp, recorded with the step."""

from __future__ import annotations

from typing import Protocol

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
    def __init__(self, network: MotorNetwork, sim: Simulation) -> None:
        joints = sim.ctrl.shape[1]
        self._motors = NetworkMotors(network, sim.num_envs, joints)
        self._angle, self._speed, self._ctrl = (x.numpy() for x in (sim.qpos[:, -joints:], sim.qvel[:, -joints:], sim.ctrl))

    def __call__(self, targets: Tensor) -> None:
        self._ctrl[:] = self._motors.torque(targets.numpy() - self._angle, self._speed)

    def reset(self, mask: Tensor) -> None:
        self._motors.reset(mask.numpy())
