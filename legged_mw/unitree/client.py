"""A Unitree robot as a ``Robot``: state messages become measurements, targets become command messages.

Joint names select the motors. ``link`` calls the services that must run before the motors accept commands.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import ATTITUDE, COMPUTED, CONTRACT_FILE, PLACE, Contract
from legged_mw.deploy.odometry import ROW
from legged_mw.deploy.robot import Floats, Health, Measurement, Robot, RobotError, damped
from legged_mw.deploy.simulated import read_scene
from legged_mw.unitree import clock, guard, need_dds
from legged_mw.unitree.codec import LAYOUTS, WireMessage, decode_remote
from legged_mw.unitree.robots import Machine, check_body, check_slots, machine_of, order

TOO_OLD = 0.1  # [s] ours: an older measurement is not used
STEP = 0.002  # [s] robots send their state at 500 Hz
TOUCH = 20  # foot_force of a foot on the ground, in the robot's own unit; ours
_WRAP = 2**32 / 1000  # [s] after which a robot's tick wraps to 0
LOST = 5  # ours: messages that a motor may lose between two checks
_MEASURED = ("ang_vel", "gravity", "joint_pos", "joint_vel", "joint_torque", "acceleration")


class UnitreeRobot(Robot):
    """A Go2, G1 or H1. Its motors apply the contract's stiffness and damping at their own rate.

    Targets are sent unchanged: ``Action.held`` clips them to the servos' ranges, for every robot.
    """

    can_change_gains, step = True, STEP

    def __init__(
        self,
        contract: Contract,
        owner: guard.Guarded,
        first: Any,
        *,
        simulated: bool = False,
        odometry: bool = False,
        clock: Callable[[], float] = clock,
    ) -> None:
        """``owner`` of the wire. ``first``: the robot's last state. ``odometry``: measurements give the velocity.

        ``simulated``: each command has the tick of the state that it answers. If the first state has no checksum or no
        voltage, later states need none.

        Raises RobotError if this is not the contract's robot, or if it cannot measure the policy's observations.
        """
        self.contract, self._owner, self._clock, self._simulated = contract, owner, clock, simulated
        self.machine = machine_of(contract.joints)
        self.limits, self.motors = self.machine.limits, self.machine.motors
        check_rows(contract, self.machine, odometry)
        self._slots, self._feet = order(self.machine, contract.joints), self.machine.feet_of(contract.feet)
        self._state, self._stamp, self._open = self._decoded(first.body), first.stamp, True
        self.report = ""  # set by `close`: latencies of the wire
        self._sealed = not simulated or self._state["crc"] != 0
        self._metered = not simulated or self._voltage != 0.0
        if self._sealed and not self._state.intact():
            raise RobotError(
                f"the robot's states have a wrong checksum ({self._state['crc']:#x}): the cable, or another version of its messages"
            )
        check_body(self.machine, self._mode_machine)
        self._body = self._mode_machine
        check_slots(self.machine, (self._state["motor_state.q"] != 0.0) & (self._state["motor_state.mode"] != 0))
        self._default = contract.stiffness, contract.damping
        self._lost = self._state["motor_state.lost"].astype(int) if self.machine.package == "unitree_go" else None
        self._left_out = 0  # states since the last valid one
        self.dropped: Counter[str] = Counter()  # reason -> rejected states
        owner.arm(self._command(kd=damped(contract)))

    @property
    def _mode_machine(self) -> int:
        return int(self._state["mode_machine"]) if self.machine.package == "unitree_hg" else 0

    @property
    def _voltage(self) -> float:
        """Voltage [V] of the battery."""
        each = self.machine.package == "unitree_hg"  # each motor reports its own
        return float(np.median(self._state["motor_state.vol"][self._slots])) if each else float(self._state["power_v"])

    def _decoded(self, body: bytes) -> WireMessage:
        return WireMessage(LAYOUTS[self.machine.package, "LowState_"], body)

    def read(self) -> Measurement:
        self._listen()
        age = self._clock() - self._stamp
        if self._left_out and age > 2 * self.contract.period:
            raise RobotError(
                f"{self._left_out} states in a row have a wrong checksum: the newest good one is {1000 * age:.0f} ms old"
            )
        if age > TOO_OLD:
            raise RobotError(
                f"the newest measurement is {1000 * age:.0f} ms old: the robot is silent, or the link is down"
            )
        state, slots = self._state, self._slots
        w, x, y, z = (float(value) for value in state["imu_state.quaternion"])
        feet = np.zeros(len(self.contract.feet))
        if self._feet:
            feet = (np.asarray(state["foot_force"])[self._feet] > TOUCH).astype(float)
        q, dq, torque = (state[f"motor_state.{part}"][slots].astype(float) for part in ("q", "dq", "tau_est"))
        return Measurement(
            lin_vel=np.zeros(3),
            ang_vel=state["imu_state.gyroscope"].astype(float),
            # Not normalised: a quaternion of zeros gives zero gravity, not that of a level robot.
            gravity=-np.array([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z]),
            joint_pos=q,
            joint_vel=dq,
            joint_torque=torque,
            acceleration=state["imu_state.accelerometer"].astype(float),
            foot_contact=feet,
            others={ATTITUDE: np.array([w, x, y, z])} if self.contract.motion else {},
        )

    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        kp, kd = (
            own if given is None else given for own, given in zip(self._default, (stiffness, damping), strict=True)
        )
        self._send(q=targets, kp=kp, kd=kd)

    def damp(self) -> None:
        self._send(kd=damped(self.contract), safe=True)

    def limp(self) -> None:
        self._send(safe=True)

    def close(self) -> None:
        if self._open:
            self._open = False
            self.report = self._owner.close(self._command(kd=damped(self.contract)))
            if self.dropped:
                self.report += f"{'; ' if self.report else ''}states dropped: {', '.join(f'{n} {why}' for why, n in self.dropped.items())}"

    def health(self) -> Health:
        self._listen()
        state, slots = self._state, self._slots
        if self.machine.package == "unitree_go":
            temperatures = state["motor_state.temperature"][slots]
            before, self._lost = self._lost, state["motor_state.lost"].astype(int)
            wrong = {i: f"it lost {n} messages in a period" for i, n in enumerate(self._lost - before) if n > LOST}
        else:
            temperatures = state["motor_state.temperature"].reshape(-1, 2)[slots].max(axis=1)
            wrong = {
                i: f"error {state['motor_state.motorstate'][i]:#x}" for i in slots if state["motor_state.motorstate"][i]
            }
        faults = {name: wrong[i] for name, i in zip(self.contract.joints, slots, strict=True) if i in wrong}
        return Health(
            age_s=self._clock() - self._stamp,
            temperatures=temperatures.astype(float),
            voltage=self._voltage if self._metered else None,
            remote=decode_remote(state["wireless_remote"].tobytes()),
            motor_faults=faults,
        )

    def _listen(self) -> None:
        """Read the newest state, if it is intact and from the same robot. A simulator without ticks sends 0."""
        if not (received := self._owner.receive()):
            return
        state = self._decoded(received.body)
        if self._sealed and not state.intact():
            self._left_out += 1
            self.dropped["with a wrong checksum"] += 1
            return
        back = (int(self._state["tick"]) - int(state["tick"])) % 2**32 / 1000
        if 0 < back <= TOO_OLD:  # an older state arrived late; a larger step back means another robot
            self.dropped["late"] += 1
            return
        if TOO_OLD < back < _WRAP / 2:
            raise RobotError(f"the robot's clock went back by {back:.1f} s: it was started again, or two robots answer")
        self._state, self._stamp, self._left_out = state, received.stamp, 0
        if (body := self._mode_machine) != self._body:
            raise RobotError(
                f"mode_machine was {self._body} and is {body}: the robot has another body, or two robots answer"
            )

    def _command(self, **parts: Floats) -> bytes:
        """A command with checksum. ``parts``: fields (D,) of the joints; all other fields are zero."""
        machine, command = self.machine, WireMessage(LAYOUTS[self.machine.package, "LowCmd_"])
        used = np.isin(np.arange(machine.slots), self._slots)
        command["motor_cmd.mode"] = np.where(used, [machine.modes.get(i, 1) for i in range(machine.slots)], 0)
        for name, values in parts.items():
            column = np.zeros(machine.slots)
            column[self._slots] = values
            command[f"motor_cmd.{name}"] = column
        if machine.package == "unitree_go":
            command["head"], command["level_flag"] = (0xFE, 0xEF), 0xFF  # low level
        else:
            command["mode_pr"], command["mode_machine"] = 0, self._mode_machine  # ankles and waist by pitch and roll
        if self._simulated:
            command["reserve"] = self._state["tick"]
        return command.seal()

    def _send(self, safe: bool = False, **parts: Floats) -> None:
        if not all(np.isfinite(values).all() for values in parts.values()):
            raise RobotError(f"targets that are not finite are not sent: {', '.join(parts)}")
        self._owner.send(self._command(**parts), self._stamp, safe)


def check_rows(contract: Contract, machine: Machine, odometry: bool = False) -> None:
    """Raise RobotError for a policy with rows that this robot does not measure, or without angle commands."""
    if not contract.action.of_angles:
        raise RobotError(
            f"{CONTRACT_FILE}: the policy commands {contract.action.origin}s; a {machine.name} is driven by angles here"
        )
    measured = {
        *_MEASURED,
        *COMPUTED,
        *(["foot_contact"] if machine.feet_of(contract.feet) else []),
        *([ROW] if odometry else []),
    } - {PLACE}
    if wrong := [row for row in contract.rows if row.measured not in measured]:
        estimated = "add --velocity odometry, or " if [row.measured for row in wrong] == [ROW] else ""
        raise RobotError(
            f"{CONTRACT_FILE}: the policy observes {', '.join(row.name for row in wrong)}, which a {machine.name} does not measure; "
            f"{estimated}train one without: observations.leave_out = {{'state': [{', '.join(repr(row.name) for row in wrong)}]}}"
        )


def connect(
    folder: Path, contract: Contract, interface: str, domain: int | None = None, odometry: bool = False
) -> UnitreeRobot:
    """Connect to the robot on a network interface; a guard process owns the wire. Raises RobotError with the reason."""
    need_dds()
    from legged_mw.unitree.link import LOOPBACK, default_domain

    machine = machine_of(contract.joints)
    check_rows(contract, machine, odometry)
    read_scene(folder, contract)  # before anything is sent, raise for a scene that does not fit the contract
    domain = default_domain(interface) if domain is None else domain
    late = max(guard.LATE, 1.5 * contract.period)  # allow for a slow policy
    owner = guard.Guarded.start(machine.package, interface, domain, lies_down=machine.lies_down, late=late)
    try:
        return UnitreeRobot(contract, owner, owner.first, simulated=interface in LOOPBACK, odometry=odometry)
    except BaseException:
        owner.close(b"")
        raise
