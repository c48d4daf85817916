"""A simulated robot at the other end of the wire: MuJoCo at the motors' rate, with Unitree's messages.

Each step of 2 ms sends a state, reads the newest command and applies tau + kp (q - q_now) + kd (dq - dq_now).
Without a watchdog the last command stays active forever, as on a robot.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.contract import Contract
from legged_mw.deploy.robot import Floats, damped
from legged_mw.deploy.safety import limits_of
from legged_mw.deploy.simulated import read_scene, trunk_of
from legged_mw.unitree.client import STEP
from legged_mw.unitree.codec import LAYOUTS, WireMessage, encode_remote
from legged_mw.unitree.faults import NAN, SWAPS, Faults, Line
from legged_mw.unitree.robots import Machine, machine_of, order

# in q and dq: no position control, no velocity control [unitree_sdk2]
POSITION_STOP, VELOCITY_STOP = 2.146e9, 16000.0
LOW_LEVEL = (0xFE, 0xEF, 0xFF)  # head and level_flag of unitree_go
_MACHINE = {"g1": 5}  # mode_machine of a simulated robot
_TOUCH = 60  # foot_force of a foot on the ground, in the robot's own unit; ours
_FULL = 4.1  # [V] of a full battery cell
_MOST = 1e10  # limit of command values, also against NaN. Ours: above POSITION_STOP, and its square is finite
_PARTS = ("q", "dq", "tau", "kp", "kd")  # of a motor's command
_FAULT = 0x1  # motorstate of a motor with a fault
# [weights/m], [weights s/m], [s] ours: stiffness and damping of a soft rope, and the time to lower it
_HOIST, _HOIST_DAMPING, _LOWERING = 12.0, 1.2, 1.0

_HOOK = 0.2  # [m] ours: hook of the rope above the root, for a robot that hangs freely

LIMP, DAMPED, DRIVEN = "limp", "damped", "driven"  # state of the motors: no torque, only damping, more


@dataclass
class ServedRecord:
    """Measurements of a simulated robot, by its own clock."""

    commands: int = 0
    # commands of another size, with a wrong checksum, head or mode_machine, or with values that are not finite
    refused: int = 0
    # kind of rejection -> reason of the first one
    why: dict[str, str] = field(default_factory=dict)
    watchdog: int = 0  # number of times that the watchdog damped
    # [s] start of each motor state
    changes: deque[tuple[float, str]] = field(default_factory=lambda: deque([(0.0, LIMP)], maxlen=1000))
    beyond: float = 0.0  # [rad] largest joint angle outside the range
    fastest: float = 0.0  # [rad/s] fastest joint
    outside: float = 0.0  # [rad] largest target outside the servo's range
    asked: float = 0.0  # [share of the motor's torque] largest commanded

    def drive(self, time: float, acted: dict[str, Floats]) -> None:
        """Record that the motors apply ``acted``, (D,) each, from ``time`` [s] on."""
        driven = acted["kp"].any() or acted["tau"].any()
        what = DRIVEN if driven else DAMPED if acted["kd"].all() else LIMP
        if what != self.changes[-1][1]:
            self.changes.append((time, what))

    def damped_after(self, time: float) -> float | None:
        """[s] from ``time`` to the start of damping that lasts to the end.

        None if the motors do not damp at the end, or were not driven before ``time``.
        """
        before = next((what for since, what in reversed(self.changes) if since < time), LIMP)
        since, what = self.changes[-1]
        return since - time if before == DRIVEN and what == DAMPED and since >= time else None


class SimulatedUnitree:
    """One robot in MuJoCo with a Unitree's motors, sensors and messages. ``end`` is its end of the wire."""

    def __init__(
        self,
        folder: Path,
        contract: Contract,
        end: Any,
        *,
        faults: Faults | None = None,
        watchdog: float = math.inf,
        hoist: bool | None = None,
        lift: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Load the export's robot, limp: on the ground, or on a hoist (``hoist``; None: if it has two feet).

        ``lift``: [m] above its start, where it hangs freely.
        ``watchdog``: [s] without a command after which it damps.
        """
        self.machine: Machine = machine_of(contract.joints)
        self.contract, self.end, self.faults, self.record, self._watchdog = (
            contract,
            end,
            faults or Faults(),
            ServedRecord(),
            watchdog,
        )
        self._scene, self._lift = read_scene(folder, contract, whole=True), lift
        self.model, self._rng = self._scene.model, np.random.default_rng(seed)
        self._limits = limits_of(self.model, contract)
        self._make_motors()
        self.data, self.remote = mujoco.MjData(self.model), encode_remote()
        self._slots, self._state = (
            order(self.machine, contract.joints),
            WireMessage(LAYOUTS[self.machine.package, "LowState_"]),
        )
        self.reset()
        self._hung = trunk_of(self.model) if lift else 1  # the body that hangs on the rope
        self._height, self._weight = float(self.data.xpos[self._hung, 2]), 9.81 * float(self.model.body_subtreemass[1])
        self.hoist = len(contract.feet) < 4 if hoist is None else hoist
        self._rope = 1.0 if self.hoist else 0.0  # current share of the rope's force
        self._fill()

    def reset(self, after: float = 0.0) -> None:
        """Put the robot into its first keyframe, limp, ``after`` [s] from now.

        Delayed messages are dropped. Its clock and its record continue.
        """
        time = self.time + after
        self._in, self._out, self._last = Line(self._rng), Line(self._rng), -math.inf
        self.command: WireMessage | None = None  # the last accepted one
        self.acted = dict.fromkeys(_PARTS, np.zeros(len(self.contract.joints)))  # (D,) command that the motors apply
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.data.qpos[2] += self._lift
        self.data.time = time
        mujoco.mj_step1(self.model, self.data)

    def _make_motors(self) -> None:
        """Replace the scene's servos by torque motors. Damping is part of the motor law, not of the joints."""
        model, joints = self.model, [self.model.joint(name).id for name in self.contract.joints]
        self._dofs, self._angles = model.jnt_dofadr[joints], model.jnt_qposadr[joints]
        self._actuators = self._scene.actuators
        model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        model.dof_damping[self._dofs] = 0.0
        model.actuator_ctrllimited[:] = 0
        model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_gainprm[:], model.actuator_biasprm[:] = 0.0, 0.0

    @property
    def time(self) -> float:
        return float(self.data.time)

    @property
    def tick(self) -> int:
        """Tick [ms] of the last sent state."""
        return int(self._state["tick"])

    @property
    def joint_pos(self) -> Floats:
        """True joint angles (D,) [rad]."""
        return self.data.qpos[self._angles].copy()

    @property
    def joint_vel(self) -> Floats:
        """True joint speeds (D,) [rad/s]."""
        return self.data.qvel[self._dofs].copy()

    @property
    def torque(self) -> Floats:
        """Torques (D,) [N m] of the last step."""
        return self.data.actuator_force[self._actuators].copy()

    @property
    def upright(self) -> float:
        """Cosine of the root's tilt."""
        return float(self.data.xmat[1, 8])

    def step(self) -> None:
        """Send the state, take the newest command, advance by STEP."""
        if not self.faults.frozen:
            self._fill()
        if not self.faults.silent:
            self._out.put(self.time, self._state.body, self.faults)
        for body in self._out.due(self.time):
            self.end.send(body)
        self.end.answer()
        if (body := self.end.receive()) is not None:
            self._in.put(self.time, body, self.faults)
        for body in self._in.due(self.time):
            self._receive(body)
        self._move()
        self._pull()
        mujoco.mj_step2(self.model, self.data)
        mujoco.mj_step1(self.model, self.data)
        self.record.beyond = max(self.record.beyond, _outside(self.joint_pos, self._limits.low, self._limits.high))
        self.record.fastest = max(self.record.fastest, float(np.abs(self.joint_vel).max()))

    def _receive(self, body: bytes) -> None:
        """Handle one message of the wire, which may be invalid."""
        layout = LAYOUTS[self.machine.package, "LowCmd_"]
        if len(body) == layout.size:
            self._take(WireMessage(layout, body))
        else:
            self._refuse("size", f"a command of {len(body)} bytes, not {layout.size}")

    def _refuse(self, kind: str, why: str) -> None:
        self.record.refused += 1
        self.record.why.setdefault(kind, why)

    def _take(self, command: WireMessage) -> None:
        """Accept a valid command, reject any other."""
        if self.machine.package == "unitree_go":
            kind, sent, expected = (
                "head and level_flag",
                (*map(int, command["head"]), int(command["level_flag"])),
                LOW_LEVEL,
            )
        else:
            kind, sent, expected = "mode_machine", int(command["mode_machine"]), int(self._state["mode_machine"])
        wrong = [name for name in _PARTS if not (np.abs(command[f"motor_cmd.{name}"]) < _MOST).all()]
        if sent != expected:
            self._refuse(kind, f"a command with {kind} {sent}, not {expected}")
        elif not command.intact():
            self._refuse("checksum", f"a command with checksum {command['crc']:#x}, not {command.checksum():#x}")
        elif wrong:
            self._refuse("values", f"a command whose {wrong[0]} is not finite, or beyond {_MOST:g}")
        else:
            self._accept(command)

    def _accept(self, command: WireMessage) -> None:
        slots, signs = self._plugs()
        on, signs = command["motor_cmd.mode"][slots] != 0, {"q": signs, "dq": signs, "tau": signs}
        acted = {name: np.where(on, command[f"motor_cmd.{name}"][slots] * signs.get(name, 1.0), 0.0) for name in _PARTS}
        acted["kp"][np.abs(acted["q"]) >= POSITION_STOP / 2] = 0.0
        acted["kd"][np.abs(acted["dq"]) >= VELOCITY_STOP / 2] = 0.0
        self.command, self._last = command, self.time
        self.record.commands += 1
        self._obey(acted)

    def _obey(self, acted: dict[str, Floats]) -> None:
        """Apply a command from now on."""
        self.acted, record, limits = acted, self.record, self._limits
        torque = (
            acted["tau"] + acted["kp"] * (acted["q"] - self.joint_pos) + acted["kd"] * (acted["dq"] - self.joint_vel)
        )
        if (stiff := acted["kp"] > 0.0).any():
            record.asked = max(record.asked, float((np.abs(torque) / limits.motor).max()))
            action = self.contract.action
            outside = _outside(acted["q"][stiff], action.lowest[stiff], action.highest[stiff])
            record.outside = max(record.outside, outside)
        record.drive(self.time, acted)

    def _plugs(self) -> tuple[Any, Any]:
        """Slot of each joint's motor (D,), and its sign of rotation: 1 or -1, per joint or for all."""
        faults = self.faults
        slots = np.roll(self._slots, faults.joint_order) if faults.joint_order else self._slots
        turned = faults.turned_joints
        return slots, np.where([name in turned for name in self.contract.joints], -1.0, 1.0) if turned else 1.0

    def _move(self) -> None:
        """Set the motors' law in MuJoCo's affine actuators: tau + kp q + kd dq - kp q_now - kd dq_now."""
        acted = self.acted
        if self.command and self.time - self._last > self._watchdog and acted["kp"].any():
            zero = np.zeros(len(acted["q"]))
            self._obey(acted := {**dict.fromkeys(_PARTS, zero), "kd": damped(self.contract)})
            self.record.watchdog += 1
        law = np.stack(
            [acted["tau"] + acted["kp"] * acted["q"] + acted["kd"] * acted["dq"], -acted["kp"], -acted["kd"]], axis=1
        )
        law[[name in self.faults.dead_motors for name in self.contract.joints]] = 0.0
        self.model.actuator_biasprm[self._actuators, :3] = law

    def _pull(self) -> None:
        """Apply the force of the hoist's rope. It holds a body softly upright at its height, and lowers it slowly."""
        if not self.hoist:
            self._rope = max(0.0, self._rope - STEP / _LOWERING)
        data, rope, body, moves = self.data, self._rope * self._weight, self._hung, np.zeros(6)
        mujoco.mj_objectVelocity(self.model, data, mujoco.mjtObj.mjOBJ_XBODY, body, moves, 0)
        (x, y, z), turn, (vx, vy, vz) = data.xpos[body], moves[:3], moves[3:]
        lift = rope * (1.0 + _HOIST * (self._height - z) - _HOIST_DAMPING * vz)
        upright = _HOOK if self._lift else 2.0
        tilt = np.cross(data.xmat[body].reshape(3, 3)[:, 2], [0.0, 0.0, 1.0])
        side = (rope * (-_HOIST * at - _HOIST_DAMPING * speed) for at, speed in ((x, vx), (y, vy)))
        data.xfrc_applied[body, :3] = [*side, max(0.0, lift)]
        data.xfrc_applied[body, 3:] = rope * (upright * tilt - 0.1 * upright * turn)

    def _fill(self) -> None:
        """Fill the state message with the current state."""
        state, data, faults = self._state, self.data, self.faults
        orientation, roll = np.zeros(4), math.radians(faults.imu_tilt) / 2
        before = {part: state[NAN[part]] for part in NAN} if faults.stuck else {}
        mujoco.mju_mat2Quat(orientation, data.site(self.contract.imu).xmat)
        mujoco.mju_mulQuat(orientation, orientation.copy(), np.array([math.cos(roll), math.sin(roll), 0.0, 0.0]))
        state["imu_state.quaternion"] = orientation
        state["imu_state.gyroscope"] = self._sensor("ang_vel") + faults.gyro_bias
        state["imu_state.accelerometer"] = self._sensor("acceleration")
        if faults.imu_swap:
            order = SWAPS[faults.imu_swap]
            orientation[1:] = orientation[1:][order]
            state["imu_state.quaternion"] = orientation
            state["imu_state.gyroscope"] = state["imu_state.gyroscope"][order]
        state["imu_state.rpy"] = _roll_pitch_yaw(orientation)
        _, signs = self._plugs()
        state["motor_state.mode"] = self._in_slots(1.0)
        state["motor_state.q"] = self._in_slots(signs * self.joint_pos + faults.joint_bias)
        state["motor_state.dq"] = self._in_slots(signs * self.joint_vel + faults.joint_speed)
        state["motor_state.tau_est"] = self._in_slots(signs * self.torque)
        state["motor_state.temperature"] = int(faults.temperature)
        state["wireless_remote"] = 0 if faults.no_remote else list(self.remote)
        state["tick"] = max(1, round((data.time + faults.clock_jump) * 1000))
        if faults.stuck:
            self._stick(before)
        if faults.nan:
            state[NAN[faults.nan]] = math.nan
        self._fill_own()
        state.seal()
        if faults.bad_crc:
            state["crc"] = int(state["crc"]) ^ 1

    def _stick(self, before: dict[str, Floats]) -> None:
        """Set frozen parts to their values ``before``. A frozen encoder measures zero speed."""
        state, stuck = self._state, self.faults.stuck
        for part in stuck & NAN.keys():
            state[NAN[part]] = before[part]
        joints = self._in_slots([name in stuck for name in self.contract.joints]) > 0.0
        for part, values in (("q", before["q"]), ("dq", 0.0)):
            state[NAN[part]] = np.where(joints, values, state[NAN[part]])

    def _fill_own(self) -> None:
        """Fill the fields that only this package has."""
        state, faults = self._state, self.faults
        voltage = _FULL * self.machine.cells if faults.voltage is None else faults.voltage
        dead = self._in_slots([name in faults.dead_motors for name in self.contract.joints]).astype(int)
        if self.machine.package == "unitree_go":
            state["head"], state["level_flag"], state["power_v"] = LOW_LEVEL[:2], LOW_LEVEL[2], voltage
            state["motor_state.lost"] = state["motor_state.lost"] + dead  # messages to dead motors are lost
            force = np.zeros(4, dtype=int)
            for foot, where in zip(self.machine.feet_of(self.contract.feet), self._scene.contacts, strict=False):
                force[foot] = _TOUCH * (self.data.sensordata[where] > 0.0).any()
            state["foot_force"] = force
        else:
            body = _MACHINE.get(self.machine.name, 0) if faults.mode_machine is None else faults.mode_machine
            state["mode_machine"] = body
            state["motor_state.vol"], state["motor_state.motorstate"] = voltage, dead * _FAULT

    def _in_slots(self, values: Any) -> Floats:
        """Values (D,) of the joints in their motors' slots; zero elsewhere."""
        slots = np.zeros(self.machine.slots)
        slots[self._plugs()[0]] = values
        return slots

    def _sensor(self, quantity: str) -> Floats:
        return self.data.sensordata[self._scene.sensordata[quantity]]


def _outside(values: Floats, low: Floats, high: Floats) -> float:
    """[rad] Largest distance outside a range; 0 if all are inside."""
    return max(0.0, float(np.maximum(low - values, values - high).max()))


def _roll_pitch_yaw(quaternion: Sequence[float] | Floats) -> list[float]:
    w, x, y, z = quaternion
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return [
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        pitch,
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    ]
