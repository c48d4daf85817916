"""A motor a joint in place of the file's actuators: its law and gains are the caller's, its force limits the machine's."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from torch import Tensor

from legged_mw.utils.motor_network import DC_CONSTANT, DC_DAMPING, DC_RESISTANCE, DC_STIFFNESS

Range = tuple[float, float]
# what ctrl is: an angle that the motor turns to [rad], a speed [rad/s], or its torque [N m]
Drive = Literal["angle", "speed", "torque"]
# tables of motors with a torque-speed curve, before a "gear": [N m], [rad/s]
CURVE = ("stall_torque", "no_load_speed")
_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_INPUTS = {"angle": 1, "speed": 2, "torque": 4}  # of a DC motor: bits "pos", "vel" and "ff" of its input signature
_NEVER, _ALWAYS = mujoco.mjtLimited.mjLIMITED_FALSE, mujoco.mjtLimited.mjLIMITED_TRUE


def take_limits(spec: mujoco.MjSpec, notes: list[str]) -> dict[str, Range]:
    """Joint -> lowest and highest force at the joint [N m]; the file's actuators are removed.

    Of what states one, in this order: the joint's actuatorfrcrange (a URDF's effort is read as that), the actuator's forcerange
    through its gear, a motor's ctrlrange through gain and gear.
    """
    limits = {
        j.name: (j.actfrcrange[0], j.actfrcrange[1]) for j in spec.joints if _limited(j.actfrclimited, j.actfrcrange)
    }
    if actuators := list(spec.actuators):
        notes.append(f"{len(actuators)} actuator{'s' * (len(actuators) > 1)} replaced")
    for actuator in actuators:
        if actuator.trntype in _JOINTS and actuator.target not in limits:
            force = _force(actuator)
            if force is not None:
                limits[actuator.target] = (float(min(force)), float(max(force)))
        spec.delete(actuator)
    return limits


def _limited(switch: int, span: np.ndarray) -> bool:
    return bool(switch != _NEVER and span[1] > span[0])


def _force(actuator: mujoco.MjsActuator) -> np.ndarray | None:
    """What the actuator can do at the joint [N m], both ways; None: anything, or what only a simulation tells."""
    if _limited(actuator.forcelimited, actuator.forcerange):
        return actuator.forcerange * actuator.gear[0]
    is_motor = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
    if is_motor and _limited(actuator.ctrllimited, actuator.ctrlrange):
        return actuator.ctrlrange * actuator.gear[0] * actuator.gainprm[0]
    return None


def curves_at_joints(tables: Mapping[str, list[float]]) -> dict[str, list[float]]:
    """Those of CURVE that ``tables`` has, at the joint: a motor's torque grows by its gear, its speed shrinks."""
    gears = tables.get("gear", [])
    powers = {name: power for name, power in zip(CURVE, (1.0, -1.0), strict=True) if name in tables and gears}
    return {
        name: [value * gear**power for value, gear in zip(tables[name], gears, strict=True)]
        for name, power in powers.items()
    }


def scaled_gains(
    nominal: Mapping[str, Tensor], factors: Mapping[str, Tensor], curves: bool
) -> Iterator[tuple[str, int, Tensor]]:
    """Model field, place in it and its values (N, D): the gains of motors, ``nominal`` fields (1, D, ...) times ``factors`` (N, D).

    Of MuJoCo's DC motor, which those with ``curves`` are, the no-load speed is 1 over its constant, the stall torque constant over
    resistance.
    """
    field = "actuator_gainprm"
    gains = nominal[field]
    if not curves:
        yield field, 0, gains[:, :, 0] * factors["stiffness"]
        yield "actuator_biasprm", 1, nominal["actuator_biasprm"][:, :, 1] * factors["stiffness"]
        return
    speed, stall = factors.get("no_load_speed", 1.0), factors.get("stall_torque", 1.0)
    yield field, DC_CONSTANT, gains[:, :, DC_CONSTANT] / speed
    yield field, DC_RESISTANCE, gains[:, :, DC_RESISTANCE] / (speed * stall)
    yield field, DC_STIFFNESS, gains[:, :, DC_STIFFNESS] * factors.get("stiffness", 1.0)
    yield field, DC_DAMPING, gains[:, :, DC_DAMPING] * factors.get("damping", 1.0)


class Motor(NamedTuple):
    """What drives one joint; both speed and torques are the joint's, behind the gear."""

    stiffness: float  # [N m/rad] of a motor that is driven by an angle; 0 of one that is driven by a speed
    damping: float  # [N m s/rad] of a servo: in the joint; of a motor with a curve: in its law, under its limits
    stall_torque: float = 0.0  # [N m] that it gives at rest
    no_load_speed: float = 0.0  # [rad/s] at which it gives none; 0: it has no torque-speed curve

    def add_to(self, spec: mujoco.MjSpec, joint: mujoco.MjsJoint, drive: Drive) -> mujoco.MjsActuator:
        """The actuator: MuJoCo's DC motor at a supply of 1 V where there is a curve, else its position servo or its plain motor."""
        motor = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if self.no_load_speed:
            gains = (0.0, 0.0) if drive == "torque" else (self.stiffness, self.damping)
            motor.set_to_dcmotor(
                motorconst=[0.0, 0.0],
                resistance=0.0,
                nominal=[1.0, self.stall_torque, self.no_load_speed],
                controller=[gains[0], 0.0, gains[1], 0.0, 0.0, 1.0],
                ctrlspec=_INPUTS[drive],
            )
        elif drive == "angle":
            motor.set_to_position(self.stiffness)
        else:
            motor.set_to_motor()
        return motor


def add_motors(
    spec: mujoco.MjSpec,
    joints: Sequence[mujoco.MjsJoint],
    angles: Sequence[Range],  # where each joint may be [rad]; infinite: anywhere
    motors: Sequence[Motor],
    drive: Drive,
    limits: Mapping[str, Range],  # joint -> force [N m]
    notes: list[str],
) -> None:
    """One motor a joint, held to its force limit, and to the joint's range if an angle drives it."""
    for joint, (low, high), motor in zip(joints, angles, motors, strict=True):
        kp, kd, stall, speed = motor
        passive = kd if drive == "angle" and not speed else 0.0
        old = float(np.atleast_1d(joint.damping)[0])
        if old != passive:
            notes.append(f"{joint.name} damping: {old:g} -> {passive:g} N m s/rad")
        joint.damping = np.array([passive, *np.atleast_1d(joint.damping)[1:]]) if np.ndim(joint.damping) else passive
        servo = motor.add_to(spec, joint, drive)
        damped = f"kd {kd:g} N m s/rad"
        laws = {
            "angle": f"kp {kp:g} N m/rad" + (f", {damped}" if passive != kd else ""),
            "speed": damped,
            "torque": "a torque",
        }
        curve = f", {stall:g} N m at rest, none at {speed:g} rad/s" if speed else ""
        notes.append(f"{joint.name} {'motor' if speed or drive == 'torque' else 'servo'}: {laws[drive]}{curve}")
        if drive == "angle" and math.isfinite(low) and math.isfinite(high):
            servo.ctrllimited, servo.ctrlrange = True, [low, high]
        if joint.name in limits:  # on the motor and not on the joint, so that actuator_force is the clamped force
            servo.forcelimited, servo.forcerange = True, list(limits[joint.name])
            joint.actfrclimited, joint.actfrcrange = False, [0.0, 0.0]
    endless = [
        joint.name
        for joint, motor in zip(joints, motors, strict=True)
        if joint.name not in limits and not motor.no_load_speed
    ]
    if endless:
        notes.append(
            f"warning: nothing limits the force of {', '.join(endless)}: these servos are stronger than any motor; set effort"
        )


def set_joints(
    joints: Sequence[mujoco.MjsJoint],
    armature: Mapping[str, float],
    frictionloss: Mapping[str, float],
    notes: list[str],
) -> None:
    """What the caller knows better than the file: joint -> armature [kg m^2] and dry friction [N m]."""
    for what, unit, values in (("armature", "kg m^2", armature), ("frictionloss", "N m", frictionloss)):
        for joint in joints:
            if joint.name in values and (old := getattr(joint, what)) != values[joint.name]:
                notes.append(f"{joint.name} {what}: {old:g} -> {values[joint.name]:g} {unit}")
                setattr(joint, what, values[joint.name])


def set_efforts(limits: dict[str, Range], effort: Mapping[str, float], notes: list[str]) -> None:
    """Likewise: joint -> highest force [N m], the same both ways."""
    for name, most in effort.items():
        if limits.get(name) != (-most, most):
            notes.append(f"{name} force limit: {limits[name][1] if name in limits else math.inf:g} -> {most:g} N m")
        limits[name] = (-most, most)
