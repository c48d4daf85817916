"""The chirp: after the joint check, the joints of a hanging robot follow sines of rising frequency.

``legged-mw fit`` reads its log, which has every measurement that the robot sends. A slot moves one joint of each of
several limbs. These limbs do not touch, and affect each other only through the root.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Sequence
from dataclasses import replace
from itertools import chain, product
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import InputSource
from legged_mw.deploy.joint_check import JointCheck, Moves
from legged_mw.deploy.robot import Floats, Measurement, Robot, RobotError
from legged_mw.deploy.safety import Limits
from legged_mw.deploy.simulated import SHAPES, DeployScene
from legged_mw.deploy.states import CHIRP, Order

SECONDS = 58.0  # [s] ours: total duration of all sweeps
MOVE, SETTLE, REST = 2.0, 1.0, 0.2  # [s] ours: motion to the pose; waiting there; pause before and after each sweep
FADE = 0.3  # [s] ours: rise and fall of a sweep's amplitude
AMPLITUDE, FASTEST = 0.4, 4.0  # [rad], [rad/s] ours: upper bounds of a target's amplitude and speed
TORQUE, ROOM, SPEED = 0.4, 0.8, 0.3  # shares of motor torque, of the distance to the limit, of top speed
SLOWEST, RANGE, ABOVE = 0.5, (3.0, 15.0), 3.0  # [Hz] first frequency; bounds of the last; last / servo's natural one
CLEAR = 0.02  # [m] ours: smallest distance of two limbs
ASIDE, FARTHEST, PASSES = 0.05, 12, 3  # [rad] ours: step of a joint; [-] most steps; passes over the joints


def at_rate(contract: Contract, limits: Limits, robot: Robot) -> tuple[Contract, Limits]:
    """Contract and limits for a step at each measurement of ``robot``. The policy does not act.

    Raises RobotError if the robot measures no faster than a policy acts.
    """
    if robot.step is None:
        raise RobotError(
            f"--chirp needs a measurement every few ms, and {type(robot).__name__} gives one per period: use --robot unitree, "
            "with --interface lo for a robot of --serve"
        )
    slower = contract.period / robot.step
    counted = {name: slower * getattr(limits, name) for name in ("age", "frozen", "late")}  # in steps
    return replace(contract, period=robot.step, decimation=1), limits.but(counted, "--chirp")


class ChirpPlan(NamedTuple):
    """The joints of a chirp and their motion."""

    pose: Floats  # (D,) [rad] centre of the sweeps
    amplitude: Floats  # (D,) [rad]
    highest: Floats  # (D,) [Hz]
    slots: list[list[int]]  # joints that sweep at the same time

    @property
    def seconds(self) -> float:
        """[s] duration of a sweep."""
        return SECONDS / len(self.slots) - 2 * REST


class Chirp(JointCheck):
    """The joint check of one robot. If all joints are right, the sweeps follow."""

    def __init__(
        self,
        controller: Controller,
        sources: Sequence[InputSource],
        say: Callable[[str], None],
        robot: Robot,
        limits: Limits,
    ) -> None:
        """Raises RobotError if the robot cannot change its gains."""
        super().__init__(controller, sources, say, robot, limits)
        self._swept = 0
        self.plan = plan(controller.contract, self._scene, limits)
        ratings = controller.contract.ratings
        top = SPEED * ratings.top_speed if ratings else np.full(len(self.joints), np.nan)
        self._speed = np.fmin(FASTEST, top)  # (D,) [rad/s] of a target

    @property
    def right(self) -> bool:
        """True if every joint is right and its sweep is complete."""
        return super().right and self._swept == len(self.joints)

    @property
    def report(self) -> str:
        return f"{super().report}\n{self._swept} of {len(self.joints)} joints swept"

    def _check(self, measured: Measurement) -> Moves:
        yield from super()._check(measured)
        if super().right:
            note = "the joints follow sines of rising frequency, one joint of each limb at a time"
            self._enter(CHIRP, self._now, note)
            yield from self._chirp(measured)

    def _chirp(self, begun: Measurement) -> Moves:
        """Move from the joint check's pose ``begun`` to the plan's pose, then run all sweeps."""
        begin = self.controller.contract.action.held(begun.joint_pos)
        count, settle = (round(seconds / self.controller.contract.period) for seconds in (MOVE, SETTLE))
        for step in range(count + settle):
            yield self._order(begin + min(1.0, (step + 1) / count) * (self.plan.pose - begin))
        for slot in self.plan.slots:
            yield from self._sweep(slot)
            self._swept += len(slot)

    def _sweep(self, slot: Sequence[int]) -> Generator[Order, Measurement, None]:
        self._tell(f"{', '.join(self.joints[joint] for joint in slot)} sweep")
        signs = (-1.0) ** np.arange(len(slot))  # neighbours move in opposite directions, so that the root swings less
        for targets in signs * np.stack([self.targets(joint) for joint in slot], axis=1):
            pose = self.plan.pose.copy()
            pose[slot] += targets
            yield self._order(pose)

    def targets(self, joint: int) -> Floats:
        """Targets (T,) [rad] of a joint's sweep about its pose."""
        period = self.controller.contract.period
        rest, seconds = round(REST / period), self.plan.seconds
        time = period * np.arange(round(seconds / period))
        rate = math.log(self.plan.highest[joint] / SLOWEST) / seconds
        frequency = 2.0 * math.pi * SLOWEST * np.exp(rate * time)  # [rad/s]
        size = np.minimum(self.plan.amplitude[joint], self._speed[joint] / frequency)
        fade = np.clip(np.minimum(time, time[-1] - time) / FADE, 0.0, 1.0)
        return np.pad(fade * size * np.sin((frequency - frequency[0]) / rate), (rest, rest))


# ---- the plan


def plan(contract: Contract, scene: DeployScene, limits: Limits) -> ChirpPlan:
    """Plan sweeps within the contract's limits.

    In a slot, shapes of two limbs keep a distance of CLEAR. The root's shapes are not checked. A joint that touches
    another limb from every tested pose gets its own slot.
    """
    data, inertia = mujoco.MjData(scene.model), np.zeros((scene.model.nv, scene.model.nv))
    mujoco.mj_resetDataKeyframe(scene.model, data, 0)
    mujoco.mj_forward(scene.model, data)
    mujoco.mj_fullM(scene.model, data, inertia)
    own = np.sqrt(contract.stiffness / np.diag(inertia)[scene.dofs]) / (2.0 * math.pi)
    highest = np.clip(ABOVE * own, *RANGE)
    low, high = np.maximum(limits.low, contract.action.lowest), np.minimum(limits.high, contract.action.highest)
    pose, most = contract.default_pose, np.minimum(AMPLITUDE, TORQUE * limits.motor / contract.stiffness)
    amplitude = np.minimum(most, np.maximum(ROOM * np.minimum(pose - low, high - pose), 0.0))
    limbs = _limbs(scene.model, contract.joints)
    touches = _touches(scene, contract.joints, limbs)
    pose = _clear_pose(pose, amplitude, low + amplitude / ROOM, high - amplitude / ROOM, touches)
    limb = [limbs[int(scene.model.joint(name).bodyid[0])] for name in contract.joints]
    return ChirpPlan(pose, amplitude, highest, _slots(limb, pose, amplitude, touches))


def _limbs(model: mujoco.MjModel, joints: Sequence[str]) -> dict[int, int]:
    """The limb of each body: 0 for the root, and one for each chain of joints up to a branch."""
    moved = {int(model.joint(name).bodyid[0]) for name in joints}
    carrier, limbs = dict[int, int](), dict[int, int]()
    for body in range(1, model.nbody):  # parents come first
        above = int(model.body_parentid[body])
        carrier[body] = above if above in moved or above not in carrier else carrier[above]
    carriers = [carrier[body] for body in moved]
    for body in range(1, model.nbody):
        above = limbs.get(int(model.body_parentid[body]), 0)
        begins = body in moved and (not above or carriers.count(carrier[body]) > 1)
        limbs[body] = max(limbs.values()) + 1 if begins else above
    return limbs


Touches = Callable[[Floats], int]


def _touches(scene: DeployScene, joints: Sequence[str], limbs: dict[int, int]) -> Touches:
    """A function that counts the shapes of different limbs with a distance below CLEAR in a pose (D,)."""
    spec = scene.spec.copy()
    for body in spec.bodies[1:]:
        limb = 1 << limbs[scene.model.body(body.name).id]
        for geom in body.geoms:
            own = geom.group == SHAPES and limb > 1
            geom.contype, geom.conaffinity = (limb, ~limb & 0x3FFFFFFF) if own else (0, 0)
            geom.margin = CLEAR
    for geom in spec.worldbody.geoms:
        geom.contype = geom.conaffinity = 0
    model = spec.compile()
    data, places = mujoco.MjData(model), [model.joint(name).qposadr[0] for name in joints]

    def touches(pose: Floats) -> int:
        data.qpos[places] = pose
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        return data.ncon

    return touches


def _ends(pose: Floats, amplitude: Floats, joints: Sequence[int]) -> list[Floats]:
    """The poses in which each of ``joints`` is at one end of its sweep."""
    poses = []
    for signs in product((-1.0, 1.0), repeat=len(joints)):
        poses.append(pose.copy())
        poses[-1][joints] += signs * amplitude[joints]
    return poses


def _clear_pose(pose: Floats, amplitude: Floats, low: Floats, high: Floats, touches: Touches) -> Floats:
    """A pose near ``pose`` from which each joint can sweep alone, if there is one."""
    default, pose = pose, pose.copy()
    offsets = sorted(ASIDE * np.arange(-FARTHEST, FARTHEST + 1), key=abs)
    for _ in range(PASSES):
        for joint in reversed(range(len(pose))):  # the last joints of a limb first
            angles = [default[joint] + offset for offset in offsets]
            inside = [angle for i, angle in enumerate(angles) if not i or low[joint] <= angle <= high[joint]]
            contacts = list[int]()
            for pose[joint] in inside:
                contacts.append(sum(map(touches, _ends(pose, amplitude, [joint]))))
                if not contacts[-1]:
                    break
            pose[joint] = inside[contacts.index(min(contacts))]
    return pose


def _slots(limb: Sequence[int], pose: Floats, amplitude: Floats, touches: Touches) -> list[list[int]]:
    """Put each joint into the first slot of joints of other limbs that it cannot touch."""
    slots = list[list[int]]()
    for joint in range(len(pose)):
        for slot in slots:
            pairs = [_ends(pose, amplitude, [joint, other]) for other in slot]
            if limb[joint] not in [limb[other] for other in slot] and not any(map(touches, chain(*pairs))):
                slot.append(joint)
                break
        else:
            slots.append([joint])
    return slots
