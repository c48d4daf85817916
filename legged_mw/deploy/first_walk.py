"""The first walk of a robot: six steps, whose measured values are compared with those of a simulated robot.

The steps are hanging, joint check, stand, emergency stop, ten steps on the spot, a metre ahead. A person presses a
button before each step. The exam's robot is simulated from the export. It does the six steps first, and its values
are the expected values. If a difference is larger than allowed, the joints are damped and the walk ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.inputs import END, START, WALK, DriveInput, InputSource
from legged_mw.deploy.joint_check import LIFT, JointCheck, Moves
from legged_mw.deploy.odometry import Odometry
from legged_mw.deploy.robot import Floats, Health, Measurement, Robot
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits, Safety, Trip
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.states import CHECK, DAMPING, POLICY, RISE, STAND, ZERO, Order
from legged_mw.utils.commands import VELOCITY
from legged_mw.utils.errors import UserError

HANGING, JOINTS, STANDING, STOPPING, SPOT, METRE = STEPS = (
    "hanging",
    "joint check",
    "stand",
    "emergency stop",
    "on the spot",
    "a metre",
)
STOP = "the emergency stop"  # a button, like START and WALK
CALM, LOOK = 2.0, 1.0  # [s] ours: settling time; averaging time
TURN, AHEAD = 0.5, 0.5  # [rad/s], [m/s] ours: commands, clipped to the trained ranges
COUNT = 10  # steps of each foot, on average
PATIENCE, LONGEST = 2.0, 15.0  # ours: time limit / time of the exam's robot; time limit [s] of the exam's robot
# Allowed differences, ours: a simulated robot with 10 ms delay, noise and gains x 0.9 stays within them
# (docs/first_walk.md)
TILT, BEYOND, MOVED, LEFT = 15.0, 0.25, 0.05, 1.5  # [deg]; [rad]; [rad]; [N m] while damped
ASIDE, HEADING, YAW, TIME = 0.25, 20.0, 0.1, 0.3  # [m]; [deg]; [rad/s]; [s]
CARRIED, SHARE = 0.15, 0.3  # share of the exam's weight; share of its yaw rate, time of a metre and torques
PACE = 0.5  # share of its time of ten steps: with 20 ms of delay a right go2_flat takes 0.7 of it
STANDS, WALKS = 0.1, 0.07  # share of the motor's largest torque: in the stand; while the policy runs
SHORT = 1.0  # [N m] the torque may be less than requested by this, or by SHARE of it


class Value(NamedTuple):
    """A measured value of one step. Of a value per joint, only the joint with the largest difference is kept."""

    step: str
    name: str
    unit: str
    measured: float
    exam: float
    allowed: float

    @property
    def right(self) -> bool:
        return abs(self.measured - self.exam) <= self.allowed

    def __str__(self) -> str:
        verdict = "right" if self.right else f"DIFFERS by {self.measured - self.exam:+.2f}, {self.allowed:.2f} allowed"
        return f"{self.step:<15}{self.name:<58}{self.measured:8.2f}{self.exam:8.2f} {self.unit:<4} {verdict}"


HEADS = f"{'':<73}{'robot':>8}{'exam':>8}"


class Differs(Exception):
    """A value differs from the exam's value. The message says which."""


@dataclass
class _Walked:
    """Measurements since the command changed, one entry per control period."""

    torque: list[Floats] = field(default_factory=list)  # (D,) [N m]
    requested: list[Floats] = field(default_factory=list)  # (D,) [N m] stiffness x position error
    tilt: list[float] = field(default_factory=list)  # [rad]
    turn: list[float] = field(default_factory=list)  # [rad/s] about the body's z axis
    velocity: list[Floats] = field(default_factory=list)  # (2,) [m/s] by leg odometry, body frame
    stands: list[Any] = field(default_factory=list)  # (F,) feet on the ground

    @property
    def steps(self) -> float:
        """Mean number of touchdowns per foot."""
        down = np.array(self.stands)
        return float((down[1:] & ~down[:-1]).sum() / down.shape[1])

    def path(self, period: float) -> Floats:
        """(2,) [m] position ahead and to the left, relative to the first pose."""
        heading, (x, y) = np.cumsum(self.turn) * period, np.array(self.velocity).T
        cos, sin = np.cos(heading), np.sin(heading)
        return period * np.array([(cos * x - sin * y).sum(), (sin * x + cos * y).sum()])


class FirstWalk(JointCheck):
    """The first walk of one robot. ``values``: the compared values. ``found``: (step, name) -> measured values."""

    def __init__(
        self,
        controller: Controller,
        sources: Sequence[InputSource],
        say: Callable[[str], None],
        robot: Robot,
        limits: Limits,
        exam: Mapping[tuple[str, str], Floats] | None = None,
    ) -> None:
        """``exam``: ``found`` of the exam's robot, from ``rehearse``; None: ``robot`` is the exam's robot.

        Raises UserError if the policy has no velocity commands, RobotError as JointCheck, ContractError without feet.
        """
        super().__init__(controller, sources, say, robot, limits)
        contract = controller.contract
        if not {*VELOCITY} <= {each.name for each in contract.commands}:
            raise UserError(f"--first_walk needs a policy that follows {', '.join(VELOCITY)}; {contract.task} does not")
        self._robot, self._exam, self._odometry = robot, exam, Odometry(controller.folder, contract, 1, "torque")
        self.values, self.found = list[Value](), dict[tuple[str, str], Floats]()
        self.at, self.wants, self.ended = HANGING, "", ""  # step; next button; why the walk ended
        self._walk_command, self._steps = self._velocity(), self._all()
        self._walked, self._judged = _Walked(), 0
        next(self._steps)

    @property
    def over(self) -> bool:
        return bool(self.ended)

    @property
    def right(self) -> bool:
        """True if all steps are done and no value differs."""
        return self.at == METRE and not self.wants and all(value.right for value in self.values)

    def listen(self, health: Health, now: float) -> Trip | None:
        stop = super().listen(health, now)
        self.command = self._walk_command  # the joysticks have no effect
        return stop

    def step(self, measured: Measurement, now: float) -> Order:
        self._now = now
        try:
            if END in self._pressed:
                raise Differs(f"{END} was pressed")
            if self.at not in (HANGING, JOINTS):
                self._move_on(measured, now)
            return self._steps.send(measured)
        except StopIteration:
            self.ended = "the first walk is done"
        except Differs as reason:
            self.ended = str(reason)
        self._enter(DAMPING, now, self.ended)
        return Order(DAMPING)

    def trip(self, trip: Trip, now: float) -> Order:
        if trip.limit != "stop" or self.wants != STOP:
            self.ended = trip.text
        return super().trip(trip, now)

    def _begin(self, measured: Measurement, now: float) -> None:
        if self.wants != WALK:
            self._tell(f"{WALK} has to wait: {self.at} comes first")
            return
        super()._begin(measured, now)
        if self.state != POLICY:
            raise Differs(f"{self.at}: {self.note}")

    # ---- the steps: generators that receive measurements and yield orders

    def _all(self) -> Moves:
        measured = yield Order(ZERO)
        measured = yield from self._hangs(measured)
        measured = yield from self._joints(measured)
        measured = yield from self._get_up(measured, "lower the robot until its feet carry it and the rope is slack")
        measured = yield from self._stands(measured)
        measured = yield from self._stops(measured)
        measured = yield from self._get_up(measured, "lower the robot again")
        measured = yield from self._on_the_spot(measured)
        yield from self._a_metre(measured)

    def _hangs(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """The robot hangs at zero torque. Compare its tilt, and the distance of joint angles to their range."""
        while self._now < CALM:
            measured = yield Order(ZERO)
        self._want(START, f"{START}: joint check, if the robot hangs with its feet in the air")
        while START not in self._pressed:
            measured = yield Order(ZERO)
        angles = measured.joint_pos
        beyond = np.maximum(0.0, np.maximum(angles - self._limits.high, self._limits.low - angles))
        self._compare("tilt", "deg", math.degrees(_tilt(measured)), TILT)
        self._compare("beyond its range", "rad", beyond, BEYOND)
        self._judge()
        return measured

    def _joints(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """Run the joint check. Its verdict can also end the walk."""
        self.at = JOINTS
        self._want("", f"each joint moves a little; press {END} if the named joint is not the one that moves", CHECK)
        yield from self._check(measured)
        self._say(super().report)
        if wrong := [f"{self.joints[row.joint]}: {row.verdict}" for row in self.rows if row.verdict != "right"]:
            raise Differs(f"{self.at}: {'; '.join(wrong)}")
        if len(self.rows) < len(self.joints):
            raise Differs(f"{self.at}: {self.note}")
        self._compare("moved", "rad", np.array([abs(row.moved[row.joint]) for row in self.rows]), MOVED)
        self._judge()
        self.first, self.at = STAND, STANDING
        return (yield Order(DAMPING))

    def _get_up(self, measured: Measurement, how: str) -> Generator[Order, Measurement, Measurement]:
        """Go from damping to zero torque, then to the stand, and wait until the robot is at rest."""
        self._want(START, f"{how}; then {START}: zero torque", DAMPING)
        while self.state == DAMPING:
            measured = yield Order(DAMPING)
        if isinstance(self._robot, MujocoRobot):
            self._robot.lower()  # a person lowers a real robot
        self.wants = ""
        while self.state == ZERO:
            if self._now - self.since > CALM and not self.wants:
                self._want(START, f"{START}: stand")
            measured = yield Order(ZERO)
        self.wants = ""
        while self._now - self.since < RISE + CALM:
            measured = yield self._stand(measured, self._now)
        return measured

    def _stands(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """Compare the weight on the legs, computed from their torques, and the torque of each motor."""
        weights, torques, requested = [], [], []
        for _ in range(self._periods(LOOK)):
            order = self._stand(measured, self._now)
            assert order.targets is not None and order.stiffness is not None
            weights.append(self._odometry.legs(measured).force.sum() / self._odometry.gravity)
            torques.append(measured.joint_torque.copy())
            requested.append(order.stiffness * (order.targets - measured.joint_pos))
            measured = yield order
        if len(self.controller.contract.feet) > 2:  # the rope holds a biped until the policy starts
            self._compare("weight on the legs", "kg", np.mean(weights), 0.0, CARRIED)
            self._compare_torque("torque", torques, requested, STANDS)
        self._judge()
        return measured

    def _stops(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """The operator presses the emergency stop. Compare the remaining torque."""
        self.at = STOPPING
        self._want(STOP, f"now press {STOP}")
        while self.state == STAND:
            measured = yield self._stand(measured, self._now)
        self.wants, stopped = "", self._now
        while self._now - stopped < CALM:
            measured = yield Order(self.state)
        self._compare("torque left after 2 s", "N m", measured.joint_torque, LEFT)
        self._judge()
        self.at = SPOT
        return measured

    def _on_the_spot(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """The policy stands, then turns slowly for ten steps of each foot."""
        self._want(WALK, f"{WALK}: policy, ten steps on the spot")
        while self.state == STAND:
            measured = yield self._stand(measured, self._now)
        self.wants = ""
        self._odometry.reset()
        measured = yield from self._walk(measured, self._velocity(), lambda: self._lasted >= CALM + LOOK)
        last = slice(-self._periods(LOOK), None)
        self._compare_torque("torque at rest", self._walked.torque[last], self._walked.requested[last], WALKS)
        self._compare("largest tilt at rest", "deg", math.degrees(max(self._walked.tilt)), TILT)
        self._judge()
        done = "time of ten steps"
        measured = yield from self._walk(
            measured, self._velocity(ang_vel_yaw=TURN), lambda: self._walked.steps >= COUNT, done
        )
        self._compare("yaw rate", "rad/s", np.mean(self._walked.turn), YAW, SHARE)
        self._compare_walk(done, PACE)
        return (yield from self._rest(measured))

    def _a_metre(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """Walk a metre ahead, measured by leg odometry."""
        self.at = METRE
        self._want(WALK, f"{WALK}: a metre ahead, with the rope slack")
        while WALK not in self._pressed:
            measured = yield from self._rest(measured)
        self.wants, done = "", "time of a metre"
        period = self.controller.contract.period
        measured = yield from self._walk(
            measured, self._velocity(lin_vel_x=AHEAD), lambda: self._walked.path(period)[0] >= 1.0, done
        )
        self._compare("to the left", "m", self._walked.path(period)[1], ASIDE)
        self._compare("turned", "deg", math.degrees(sum(self._walked.turn) * period), HEADING)
        self._compare_walk(done, SHARE)
        return measured

    # ---- parts of the steps

    @property
    def _lasted(self) -> float:
        """[s] since the command changed."""
        return len(self._walked.tilt) * self.controller.contract.period

    def _periods(self, seconds: float) -> int:
        return round(seconds / self.controller.contract.period)

    def _velocity(self, **wanted: float) -> Floats:
        """Command (C,): the defaults and ``wanted``, clipped to the trained ranges."""
        contract = self.controller.contract
        return contract.held(
            [wanted.get(each.name, 0.0 if each.name in VELOCITY else each.default) for each in contract.commands]
        )

    def _walk(
        self, measured: Measurement, command: Floats, done: Callable[[], bool], timed: str = ""
    ) -> Generator[Order, Measurement, Measurement]:
        """Run the policy with ``command`` until ``done`` returns true. ``timed``: the name of the duration as a value.

        Raises Differs if the time limit is reached.
        """
        self._walk_command, self._walked = command, _Walked()
        exam = None if self._exam is None or not timed else self._exam[self.at, timed]
        longest = LONGEST if exam is None else PATIENCE * float(exam[0])
        while not (self._walked.tilt and done()):
            if self._lasted > longest:
                raise Differs(f"{self.at}: {timed}: not done after {longest:.1f} s")
            measured = yield from self._act(measured)
        return measured

    def _rest(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """Run the policy for one control period with the command zero."""
        self._walk_command = self._velocity()
        return (yield from self._act(measured))

    def _act(self, measured: Measurement) -> Generator[Order, Measurement, Measurement]:
        """Run the policy for one control period and record the measurements."""
        walked, estimate = self._walked, self._odometry(measured)
        walked.torque.append(measured.joint_torque.copy())
        walked.tilt.append(_tilt(measured))
        walked.turn.append(float(measured.ang_vel[2]))
        walked.velocity.append(estimate.lin_vel[:2].copy())
        walked.stands.append(self._odometry.stands(measured, self._odometry.legs(measured))[0])
        self.controller.act(measured, self._walk_command)
        targets = self.controller.last_targets[0].copy()
        clipped = self.controller.contract.action.held(targets)
        walked.requested.append(self.controller.contract.stiffness * (clipped - measured.joint_pos))
        return (yield Order(POLICY, targets))

    def _want(self, button: str, note: str, state: str = "") -> None:
        """Set the next button and print ``note``. Enter ``state`` if given."""
        self.wants = button
        if state and state != self.state:
            self._enter(state, self._now, note)
        else:
            self._tell(note)

    # ---- comparison with the exam's robot

    def _compare_walk(self, timed: str, share: float) -> None:
        self._compare(timed, "s", self._lasted, TIME, share)
        self._compare(
            "torque, rms",
            "N m",
            np.sqrt(np.mean(np.square(self._walked.torque), axis=0)),
            WALKS * self._motor_torque,
            SHARE,
        )
        self._compare("largest tilt", "deg", math.degrees(max(self._walked.tilt)), TILT)
        self._judge()

    @property
    def _motor_torque(self) -> Floats:
        """(D,) [N m] largest torque of the motors; 20 if unknown."""
        return np.where(np.isfinite(self._limits.motor), self._limits.motor, 20.0)

    def _compare_torque(self, name: str, torques: Sequence[Floats], requested: Sequence[Floats], share: float) -> None:
        """Compare mean torques (N, D) with the exam's, and with the requested torques: a weak motor gives less.

        If a motor reports its requested torque instead, the torque or the weight on the legs differs from the exam's.
        """
        torque = np.mean(torques, axis=0)
        deficit = np.abs(np.mean(requested, axis=0) - torque)
        self._compare(f"{name}, less than asked", "N m", deficit, np.maximum(SHORT, SHARE * np.abs(torque)))
        self._compare(name, "N m", torque, share * self._motor_torque, SHARE)

    def _compare(self, name: str, unit: str, measured: Any, least: float | Floats, share: float = 0.0) -> None:
        """Store a value, or one per joint (D,). It may differ by ``least`` or by ``share`` of the exam's, the larger."""
        measured = np.atleast_1d(measured)
        self.found[self.at, name] = measured
        exam = measured if self._exam is None else self._exam[self.at, name]
        allowed = np.maximum(least, share * np.abs(exam))
        worst = int(np.argmax(np.abs(measured - exam) / np.maximum(allowed, 1e-9)))
        joint_name = f" of {self.joints[worst]}" if len(measured) > 1 else ""
        self.values.append(
            Value(self.at, name + joint_name, unit, *(float(each[worst]) for each in (measured, exam, allowed)))
        )

    def _judge(self) -> None:
        """Print the values since the last call. Raises Differs if one differs by more than allowed."""
        new, self._judged = self.values[self._judged :], len(self.values)
        if new:
            self._say("\n".join([HEADS, *map(str, new)]))
        if wrong := [value for value in new if not value.right]:
            raise Differs(" ".join(str(wrong[0]).split()))

    @property
    def report(self) -> str:
        """A newline and the result in one line."""
        if self.right:
            return f"\nfirst walk: all {len(STEPS)} steps done, {len(self.values)} values as the exam's"
        return f"\nfirst walk: it ended at '{self.at}': {self.ended or self.note}"


def _tilt(measured: Measurement) -> float:
    """[rad] angle between gravity and the body's negative z axis."""
    return math.acos(float(np.clip(-measured.gravity[2], -1.0, 1.0)))


# ---- the exam's robot


class _ButtonPresser(InputSource):
    """An input source that presses the next button at once."""

    def __init__(self) -> None:
        self.walk: FirstWalk | None = None

    def poll(self, health: Health) -> DriveInput:
        wants = self.walk.wants if self.walk else ""
        return DriveInput(frozenset({wants} - {"", STOP}), stop="the exam's" if wants == STOP else "")


def first_walk(
    robot: Robot, folder: Path, contract: Contract, exam: Mapping[tuple[str, str], Floats] | None = None
) -> FirstWalk:
    """The first walk of a simulated ``robot`` that starts hanging. Each button is pressed at once."""
    controller, source = Controller(folder, contract), _ButtonPresser()
    limits = Limits.of(folder, contract, robot.limits)
    walk = source.walk = FirstWalk(controller, [source], lambda _: None, robot, limits, exam)
    run(robot, controller, lambda _: np.zeros(0), live=False, safety=Safety(contract, limits), states=walk)
    return walk


def rehearse(folder: Path, contract: Contract) -> Mapping[tuple[str, str], Floats]:
    """The measured values of the exam's robot. Raises UserError if it does not complete all steps."""
    walk = first_walk(MujocoRobot(folder, contract, whole=True, hoisted=True, lift=LIFT), folder, contract)
    if not walk.right:
        raise UserError(f"the exam's robot does not complete it:{walk.report.replace(chr(10), ' ')}; run --eval first")
    return walk.found
