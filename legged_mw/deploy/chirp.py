"""The chirp: after the joint check each joint of a hanging robot follows a sine of rising frequency, the others are held.

Its log is what ``legged-mw fit`` reads: joint after joint, every measurement that the robot sends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import InputSource
from legged_mw.deploy.joint_check import JointCheck, Moves
from legged_mw.deploy.robot import Floats, Measurement, Robot, RobotError
from legged_mw.deploy.safety import Limits
from legged_mw.deploy.simulated import DeployScene
from legged_mw.deploy.states import CHIRP, Order

SECONDS = 58.0  # [s] ours: of all sweeps together
MOVE, SETTLE, REST = 2.0, 1.0, 0.2  # [s] ours: to the default pose; there; before and after each sweep
FADE = 0.3  # [s] ours: in which a sweep's amplitude rises, and falls
AMPLITUDE, FASTEST = 0.4, 4.0  # [rad], [rad/s] ours: of a target, at most
TORQUE, ROOM, SPEED = 0.4, 0.8, 0.3  # [share] of the motor's torque, of the way to the range's end, of the top speed
SLOWEST, RANGE, ABOVE = 0.5, (3.0, 15.0), 3.0  # [Hz] begin and limits of the end; end by the servo's own frequency


def at_rate(contract: Contract, limits: Limits, robot: Robot) -> tuple[Contract, Limits]:
    """Contract and limits of a run in which each measurement of ``robot`` is a step, and the policy does not act.

    Raises RobotError if the robot measures no faster than a policy acts.
    """
    if robot.step is None:
        raise RobotError(
            f"--chirp needs measurements each few ms, and {type(robot).__name__} gives one a period: take --robot unitree, "
            "on lo for one that --serve simulates"
        )
    slower = contract.period / robot.step
    counted = {name: slower * getattr(limits, name) for name in ("age", "frozen", "late")}  # in steps
    return replace(contract, period=robot.step, decimation=1), limits.but(counted, "--chirp")


class Chirp(JointCheck):
    """The joint check of one robot; if all joints are right, their sweeps."""

    def __init__(
        self,
        controller: Controller,
        sources: Sequence[InputSource],
        say: Callable[[str], None],
        robot: Robot,
        limits: Limits,
    ) -> None:
        """Raises RobotError if the robot cannot move softly."""
        super().__init__(controller, sources, say, robot, limits)
        self._now, self._swept = 0.0, 0
        self._pose = controller.contract.default_pose
        self.amplitude, self.highest = _extent(controller.contract, self._scene, limits)  # (D,) [rad], [Hz]
        ratings = controller.contract.ratings
        top = SPEED * ratings.top_speed if ratings else np.full(len(self.joints), np.nan)
        self._speed = np.fmin(FASTEST, top)  # (D,) [rad/s] of a target

    @property
    def right(self) -> bool:
        """True if every joint is right and was swept."""
        return super().right and self._swept == len(self.joints)

    @property
    def report(self) -> str:
        return f"{super().report}\n{self._swept} of {len(self.joints)} joints swept"

    def step(self, measured: Measurement, now: float) -> Order:
        self._now = now
        return super().step(measured, now)

    def _check(self, measured: Measurement) -> Moves:
        yield from super()._check(measured)
        if super().right:
            self._enter(CHIRP, self._now, "each joint follows a sine of rising frequency")
            yield from self._chirp(measured)

    def _chirp(self, begun: Measurement) -> Moves:
        """From where the joint check held the joints, as ``begun``, to the default pose, and all sweeps."""
        begin = np.clip(begun.joint_pos, self._limits.lowest, self._limits.highest)
        count, settle = (round(seconds / self.controller.contract.period) for seconds in (MOVE, SETTLE))
        for step in range(count + settle):
            yield self._held(begin + min(1.0, (step + 1) / count) * (self._pose - begin))
        for joint in range(len(self.joints)):
            yield from self._sweep(joint)
            self._swept += 1

    def _sweep(self, joint: int) -> Generator[Order, Measurement, None]:
        for target in self.targets(joint):
            pose = self._pose.copy()
            pose[joint] += target
            yield self._held(pose)

    def targets(self, joint: int) -> Floats:
        """Targets (T,) [rad] of a joint's sweep about its pose."""
        period = self.controller.contract.period
        rest, seconds = round(REST / period), SECONDS / len(self.joints) - 2 * REST
        time = period * np.arange(round(seconds / period))
        rate = math.log(self.highest[joint] / SLOWEST) / seconds
        frequency = 2.0 * math.pi * SLOWEST * np.exp(rate * time)  # [rad/s]
        size = np.minimum(self.amplitude[joint], self._speed[joint] / frequency)
        fade = np.clip(np.minimum(time, time[-1] - time) / FADE, 0.0, 1.0)
        return np.pad(fade * size * np.sin((frequency - frequency[0]) / rate), (rest, rest))

    def _held(self, targets: Floats) -> Order:
        contract = self.controller.contract
        return Order(CHIRP, targets, contract.stiffness, contract.damping)


def _extent(contract: Contract, scene: DeployScene, limits: Limits) -> tuple[Floats, Floats]:
    """Amplitude (D,) [rad] and highest frequency (D,) [Hz] of each joint's sweep, by the contract's limits."""
    data, inertia = mujoco.MjData(scene.model), np.zeros((scene.model.nv, scene.model.nv))
    mujoco.mj_resetDataKeyframe(scene.model, data, 0)
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_fullM(scene.model, data, inertia)
    own = np.sqrt(contract.stiffness / np.diag(inertia)[scene.dofs]) / (2.0 * math.pi)
    pose = contract.default_pose
    room = ROOM * np.minimum(
        pose - np.maximum(limits.low, limits.lowest), np.minimum(limits.high, limits.highest) - pose
    )
    amplitude = np.minimum(AMPLITUDE, np.minimum(TORQUE * limits.motor / contract.stiffness, np.maximum(room, 0.0)))
    return amplitude, np.clip(ABOVE * own, *RANGE)
