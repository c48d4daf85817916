"""A simulated robot whose numbers were changed, and its chirp, in lockstep and without a network: for tests of the fit."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.chirp import Chirp, at_rate
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.joint_check import LIFT, JointCheck
from legged_mw.deploy.log import Log
from legged_mw.deploy.robot import Floats
from legged_mw.deploy.runner import Summary, run
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.unitree.client import UnitreeRobot
from legged_mw.unitree.link import Received
from legged_mw.unitree.serve import SimulatedUnitree
from tests.drivers import Script

ENCODER, SPEED, GYRO, FORCE = 0.001, 0.02, 0.005, 0.05  # [rad], [rad/s], [rad/s], [m/s^2] standard deviations of noise


@dataclass
class Change:
    """What another robot has in place of the scene's numbers: (D,) each."""

    delay: Floats  # [s] from a command to the motor
    armature: Floats  # [kg m^2]
    frictionloss: Floats  # [N m]
    damping: Floats  # [N m s/rad] beside the servo's
    gain: Floats  # factor on the servo's stiffness and damping
    offset: Floats  # [rad] of the encoder

    @staticmethod
    def draw(contract: Contract, model: Any, seed: int, delay: float) -> Change:
        """A robot of random numbers, with one ``delay`` [s] for all its joints."""
        rng, count = np.random.default_rng(seed), len(contract.joints)
        dofs = [model.joint(name).dofadr[0] for name in contract.joints]
        uniform = lambda low, high: rng.uniform(low, high, count)  # noqa: E731
        return Change(
            np.full(count, delay),
            model.dof_armature[dofs] * uniform(1.5, 5.0),
            uniform(0.2, 0.7) * np.minimum(1.0, contract.stiffness / 20.0),
            uniform(0.1, 0.4) * np.minimum(1.0, contract.stiffness / 20.0),
            uniform(0.8, 1.2),
            uniform(-0.015, 0.015),
        )


class ChangedUnitree(SimulatedUnitree):
    """Its motors, encoders and noise."""

    def __init__(self, folder: Path, contract: Contract, end: Any, change: Change, **settings: Any) -> None:
        self._change, self._noise = change, np.random.default_rng(1)
        super().__init__(folder, contract, end, **settings)
        model, dofs = self.model, self._dofs
        model.dof_armature[dofs], model.dof_frictionloss[dofs] = change.armature, change.frictionloss
        model.dof_damping[dofs] = change.damping
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self.faults.joint_bias = change.offset
        self._waiting: list[tuple[float, dict[str, Floats]]] = []

    def _obey(self, acted: dict[str, Floats]) -> None:
        """A command waits for its delay; the servos' targets are of what the encoders say."""
        change = self._change
        self._waiting.append((self.time + float(change.delay[0]), acted))

    def _move(self) -> None:
        change = self._change
        while self._waiting and self._waiting[0][0] <= self.time + 1e-9:
            acted = self._waiting.pop(0)[1]
            moved = {"q": acted["q"] - change.offset, "kp": change.gain * acted["kp"], "kd": change.gain * acted["kd"]}
            super()._obey({**acted, **moved})
        super()._move()

    def _fill_own(self) -> None:
        super()._fill_own()
        state, noise, slots = self._state, self._noise, self._slots
        for name, size, where in (("q", ENCODER, slots), ("dq", SPEED, slots)):
            values = state[f"motor_state.{name}"].copy()
            values[where] += noise.normal(0.0, size, len(where))
            state[f"motor_state.{name}"] = values
        for name, size in (("gyroscope", GYRO), ("accelerometer", FORCE)):
            state[f"imu_state.{name}"] = state[f"imu_state.{name}"] + noise.normal(0.0, size, 3)


class Memory:
    """Both ends of a wire without a network: a command that is sent lets the robot make one step."""

    def __init__(self) -> None:
        self.state, self.command = b"", b""
        self.sim: SimulatedUnitree | None = None

    def send(self, body: Any, stamp: float | None = None, safe: bool = False) -> None:
        """A state of the robot; with a stamp a command to it."""
        if stamp is None:
            self.state = bytes(body)
            return
        self.command = bytes(body)
        assert self.sim
        self.sim.step()

    def receive(self) -> Any:
        command, self.command = self.command, b""
        return command or None

    def answer(self) -> None: ...


class Owner:
    """The client's end."""

    def __init__(self, end: Memory) -> None:
        self.end = end

    def receive(self) -> Any:
        assert self.end.sim
        return Received(self.end.state, self.end.sim.time)

    def arm(self, damping: bytes) -> None: ...

    def send(self, body: bytes, stamp: float, safe: bool) -> None:
        self.end.send(body, stamp)

    def close(self, last: bytes) -> str:
        return ""


class Swept(Chirp):
    """A chirp without the joint check."""

    def _check(self, measured: Any) -> Any:
        self.state = "chirp"
        yield from self._chirp(measured)


def chirp(folder: Path, change: Change, path: Path, checked: bool = False) -> Summary:
    """Record the chirp of a changed robot that hangs."""
    contract, end = read_contract(folder), Memory()
    sim = end.sim = ChangedUnitree(folder, contract, end, change, hoist=True, lift=LIFT)
    sim.step()
    robot = UnitreeRobot(contract, Owner(end), Owner(end).receive(), simulated=True, clock=lambda: sim.time)
    fast, limits = at_rate(contract, Limits.of(folder, contract, robot.limits), robot)
    controller, safety = Controller(folder, fast), Safety(fast, limits)
    states: JointCheck = (Chirp if checked else Swept)(controller, [Script({500: "start"})], print, robot, limits)
    log = Log(path, fast, folder, "simulated")
    return run(robot, controller, lambda _: np.zeros(0), 300.0, live=False, safety=safety, states=states, log=log)
