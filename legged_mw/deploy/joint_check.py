"""The joint check: each joint in turn moves 0.1 rad and back with low stiffness. The other joints are held.

It detects a wrong joint and a wrong sign. It replaces ``States``: zero torque -> (start) -> joint check -> damping.
The same safety limits apply.
Angles come from the motors' encoders. They look right if a motor is connected or mounted wrongly together with its
encoder. For legs, the tilt of a freely hanging body then shows the fault. For other joints a person must watch.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Sequence
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import END, START, InputSource
from legged_mw.deploy.robot import Floats, Measurement, Robot, RobotError
from legged_mw.deploy.safety import Limits
from legged_mw.deploy.simulated import read_scene
from legged_mw.deploy.states import CHECK, DAMPING, SOFT, ZERO, Order, States

STEP = 0.1  # [rad] motion of a joint
LIFT = 0.3  # [m] ours: height of a hanging simulated robot, whose feet must not touch the ground
SETTLE, RAMP, REST = 2.0, 0.8, 0.6  # [s] ours: until all joints are held; ramp between two poses; rest after each joint
SOFTLY, HOLD = 0.4, 1.2  # [s] ours, after the ramp: until the stiffness rises; until the verdict
# [share of the stiffness per second] until the joint moves enough; SOFT may be too weak for friction and weight
STIFFEN = 1.5
CLOSE, MOVED, FAR = 0.07, 0.03, 0.3  # [rad] ours: enough motion; smallest motion; motion that ends the check
LEAN, ALONG = 2e-3, 0.3  # ours: [rad] smallest useful tilt; [-] cosine at which a tilt agrees with the joint
HEAVY = 0.4  # [share of the mass] ours: if the joint moves more, as a waist does, the tilt is not used

Moves = Generator[Order, Measurement, None]


class JointResult(NamedTuple):
    """The result of one joint."""

    joint: int
    asked: float  # [rad] commanded motion
    moved: Floats  # (D,) [rad] measured motion of all joints
    stiffness: float  # [share of the contract's stiffness] at the end of the motion
    verdict: str  # "right", or the fault


class JointCheck(States):
    """The joint check of one robot. ``rows`` and ``report`` hold the result."""

    first = CHECK

    def __init__(
        self,
        controller: Controller,
        sources: Sequence[InputSource],
        say: Callable[[str], None],
        robot: Robot,
        limits: Limits,
    ) -> None:
        """Raises RobotError if the robot cannot change its gains."""
        if not robot.can_change_gains:
            raise RobotError(
                f"--check_joints needs low gains, and {type(robot).__name__} cannot change its gains: no joint was moved"
            )
        rest, self.rows = np.array([each.default for each in controller.contract.commands]), list[JointResult]()
        super().__init__(controller, sources, lambda _: rest, say)
        self.joints, self._limits, self._motors, self._moves = controller.contract.joints, limits, robot.motors, None
        self._scene, self._now = read_scene(controller.folder, controller.contract), 0.0

    @property
    def over(self) -> bool:
        return self.state == DAMPING and self._moves is not None

    @property
    def right(self) -> bool:
        """True if every joint is right."""
        return len(self.rows) == len(self.joints) and all(row.verdict == "right" for row in self.rows)

    def step(self, measured: Measurement, now: float) -> Order:
        self._now = now
        if self._moves is None:
            if self.state != ZERO or START not in self._pressed or END in self._pressed:
                return super().step(measured, now)
            self._enter(
                CHECK,
                now,
                f"each joint goes {STEP} rad and back; {END} if another one moves than the one that is named",
            )
            self.note, self._moves = "all joints are held", self._check(measured)
            return next(self._moves)
        if END in self._pressed:
            self._enter(DAMPING, now, f"{END} was pressed")
            return Order(DAMPING)
        try:
            return self._moves.send(measured)
        except StopIteration:
            self._enter(DAMPING, now, f"the {self.state} is over")
            return Order(DAMPING)

    def _enter(self, state: str, now: float, note: str) -> None:
        early = self.state == CHECK and len(self.rows) < len(self.joints)
        super()._enter(state, now, f"{note}, while {self.note}" if early else note)

    # ---- motions: generators that receive measurements and yield orders

    def _check(self, measured: Measurement) -> Moves:
        pose = self.controller.contract.action.held(measured.joint_pos)
        settle = round(SETTLE / self.controller.contract.period)
        for step in range(settle):
            measured = yield self._order(pose, (step + 1) / settle)
            if np.abs(error := measured.joint_pos - pose).max() > FAR:
                joint = int(np.abs(error).argmax())
                self._tell(
                    f"{self.joints[joint]} was held where it was and went {error[joint]:+.2f} rad: WRONG JOINT or WRONG SIGN"
                )
                return
        for joint in range(len(self.joints)):
            yield from self._one(joint, pose)
            if np.abs(self.rows[-1].moved).max() > FAR:
                return

    def _one(self, joint: int, pose: Floats) -> Moves:
        """Move a joint by STEP, hold it, and move it back. It moves by -STEP near its upper limit."""
        contract, gains, targets = self.controller.contract, np.ones(len(pose)), pose.copy()
        top = min(self._limits.high[joint], contract.action.highest[joint])
        step = STEP if pose[joint] + STEP <= top else -STEP
        self._tell(f"{self.joints[joint]}{self._motor(joint, ' (motor {})')} goes {step:+.2f} rad")
        ramp, soft, hold, rest = (round(seconds / contract.period) for seconds in (RAMP, SOFTLY, HOLD, REST))
        gains[joint] = SOFT
        before = measured = yield self._order(pose, gains)
        moved = np.zeros(len(pose))
        for tick in range(ramp + hold):
            targets[joint] = pose[joint] + step * min(1.0, (tick + 1) / ramp)
            measured = yield self._order(targets, gains)
            moved = measured.joint_pos - before.joint_pos
            if np.abs(moved).max() > FAR:
                break
            if tick >= ramp + soft and np.abs(moved).max() < CLOSE:
                gains[joint] = min(1.0, gains[joint] + STIFFEN * contract.period)
        there, back, gain = measured, measured, float(gains[joint])
        for tick in range(0 if np.abs(moved).max() > FAR else ramp + rest):
            targets[joint] = pose[joint] + step * max(0.0, 1.0 - (tick + 1) / ramp)
            gains[joint] += (1.0 - gains[joint]) / max(1, ramp - tick)
            back = yield self._order(targets, gains)
        self.rows.append(
            JointResult(
                joint, step, moved, gain, self._verdict(joint, step, moved, self._tilts(joint, before, there, back))
            )
        )

    def _order(self, targets: Floats, share: float | Floats = 1.0) -> Order:
        """Targets with a ``share`` of the contract's stiffness."""
        contract = self.controller.contract
        return Order(self.state, targets.copy(), share * contract.stiffness, contract.damping)

    # ---- verdicts

    def _verdict(self, joint: int, step: float, moved: Floats, tilts: bool) -> str:
        own, other = float(np.sign(step) * moved[joint]), self._other(joint, moved)
        if abs(moved[other]) > max(abs(own), MOVED):
            return f"WRONG JOINT: {self.joints[other]} moved in its place"
        if abs(own) < MOVED:
            return "STUCK: it did not move"
        if own < 0.0:
            return "WRONG SIGN: it turned the other way"
        if own > 1.5 * STEP:
            return "TOO FAR"
        return "right" if tilts else "WRONG SIGN OR JOINT: the body did not tilt as this joint tilts it"

    def _other(self, joint: int, moved: Floats) -> int:
        """Index of the other joint with the largest motion."""
        return int(np.argmax(np.where(np.arange(len(moved)) == joint, 0.0, np.abs(moved))))

    def _tilts(self, joint: int, before: Measurement, there: Measurement, back: Measurement) -> bool:
        """False if both measured tilts differ from the tilt of a freely hanging body.

        The centre of mass of a hanging body stays below the rope. True if a tilt is too small or the joint moves too
        much of the mass.
        """
        model, data, centres = self._scene.model, mujoco.MjData(self._scene.model), []
        for measured in (before, there):
            data.qpos[3:7] = (1.0, 0.0, 0.0, 0.0)  # body frame, like gravity
            data.qpos[[model.joint(name).qposadr[0] for name in self.joints]] = measured.joint_pos
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            centres.append(data.subtree_com[1].copy())
        shift = centres[1] - centres[0]
        shift -= (shift @ before.gravity) * before.gravity
        mass, body = model.body_subtreemass, model.joint(self.joints[joint]).bodyid[0]
        tilts = [there.gravity - reference.gravity for reference in (before, back)]
        sizes = [float(np.linalg.norm(tilt)) for tilt in tilts]
        useful = mass[body] < HEAVY * mass[1] and min(sizes) > LEAN
        return not useful or any(
            t @ shift > ALONG * n * np.linalg.norm(shift) for t, n in zip(tilts, sizes, strict=True)
        )

    def _motor(self, joint: int, form: str = "{}") -> str:
        return form.format(self._motors[self.joints[joint]]) if self._motors else ""

    @property
    def report(self) -> str:
        """A newline, one line per joint, and a summary."""
        width = max(map(len, self.joints))
        form = f"{{:<{width}}} {{:>5}} {{:>6}} {{:>6}} {{:>9}}  {{:<{width + 7}}} {{}}"
        lines = [form.format("joint", "motor", "asked", "moved", "stiffness", "most of the others", "verdict")]
        for joint, commanded, moved, stiffness, verdict in self.rows:
            other = self._other(joint, moved)
            largest_other = f"{self.joints[other]} {moved[other]:+.3f}" if abs(moved[other]) >= 0.001 else "-"
            own = f"{moved[joint]:+.3f}"
            lines.append(
                form.format(
                    self.joints[joint],
                    self._motor(joint) or "-",
                    f"{commanded:+.2f}",
                    own,
                    f"{stiffness:.0%}",
                    largest_other,
                    verdict,
                )
            )
        faulty = [self.joints[row.joint] for row in self.rows if row.verdict != "right"]
        summary = f"{len(self.rows)} of {len(self.joints)} joints checked" + (
            f"; wrong: {', '.join(faulty)}" if faulty else ""
        )
        early = "" if len(self.rows) == len(self.joints) else f"; ended early: {self.note}"
        return "\n".join(["", *lines, summary + (early or ("" if faulty else "; none is wrong"))])
