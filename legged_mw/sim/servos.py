"""One motor per joint. The caller chooses law and gains; force limit, armature and dry friction are the machine's."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Literal

import mujoco
import numpy as np
from torch import Tensor

from legged_mw.sim.joints import PARTIAL, PosedRobot, some_joints
from legged_mw.sim.robot_file import Range, RobotFile
from legged_mw.utils.motor_network import DC_CONSTANT, DC_DAMPING, DC_RESISTANCE, DC_STIFFNESS

# meaning of ctrl: target angle [rad], target speed [rad/s], or torque [N m]
Drive = Literal["angle", "speed", "torque"]
# tables of a torque-speed curve of the motor, before its gear: [N m], [rad/s]
CURVE = ("stall_torque", "no_load_speed")
_INPUTS = {"angle": 1, "speed": 2, "torque": 4}  # DC motor: bits "pos", "vel" and "ff" of its input signature


def set_machine(
    robot: RobotFile, partial: Mapping[str, Mapping[str, float]], posed: PosedRobot, drive: Drive
) -> tuple[float, ...]:
    """Add motors with force limits, armature and dry friction. ``partial`` (tables of PARTIAL) overrides the file.

    Torque-speed curves in ``posed.tables`` are changed from motor to joint. Returns speed limits (D,) [rad/s]; infinite
    without a limit.
    """
    tables, notes = posed.tables, robot.notes
    tables.update(_curves_at_joints(tables))
    given = {what: some_joints(partial.get(what, {}), posed.joints, what, posed.held) for what in PARTIAL}
    for name, most in given["effort"].items():
        if robot.limits.get(name) != (-most, most):
            old = robot.limits[name][1] if name in robot.limits else math.inf
            notes.append(f"{name} force limit: {old:g} -> {most:g} N m")
        robot.limits[name] = (-most, most)
    for what, unit in (("armature", "kg m^2"), ("frictionloss", "N m")):
        for joint in robot.joints:
            old = getattr(joint, what)
            new = given[what].get(joint.name, old)
            if old != new:
                notes.append(f"{joint.name} {what}: {old:g} -> {new:g} {unit}")
                setattr(joint, what, new)
    for number, (joint, span) in enumerate(zip(robot.joints, posed.ranges, strict=True)):
        _add_motor(robot, joint, span, {name: values[number] for name, values in tables.items()}, drive)
    curves = dict(zip(posed.joints, tables.get("no_load_speed", ()), strict=False))
    if endless := [name for name in posed.joints if name not in robot.limits and not curves.get(name)]:
        text = f"warning: nothing limits the force of {', '.join(endless)}"
        notes.append(f"{text}: these servos are stronger than any motor; set effort")
    speeds = robot.speeds | curves | given["joint_speed_limits"]
    return tuple(speeds.get(name, np.inf) for name in posed.joints)


def _curves_at_joints(tables: Mapping[str, list[float]]) -> dict[str, list[float]]:
    """The torque-speed curves at the joints: a gear multiplies the motor's torque and divides its speed."""
    curves = {}
    for name, power in zip(CURVE, (1.0, -1.0), strict=True):
        if name in tables and "gear" in tables:
            pairs = zip(tables[name], tables["gear"], strict=True)
            curves[name] = [value * gear**power for value, gear in pairs]
    return curves


def _add_motor(
    robot: RobotFile, joint: mujoco.MjsJoint, span: Range, numbers: Mapping[str, float], drive: Drive
) -> None:
    """Add MuJoCo's DC motor at 1 V if the joint has a curve, else a position servo or plain motor, with force limits.

    A target angle is clipped to ``span``, the joint's range [rad]. A servo's damping is joint damping, which the force
    limit does not limit. A DC motor's damping is part of its torque, which the force limit limits.
    """
    kp, kd, speed = numbers["stiffness"], numbers["damping"], numbers.get("no_load_speed", 0.0)
    motor = robot.spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    if speed:
        gains = (0.0, 0.0) if drive == "torque" else (kp, kd)
        motor.set_to_dcmotor(
            motorconst=[0.0, 0.0],
            resistance=0.0,
            nominal=[1.0, numbers["stall_torque"], speed],
            controller=[gains[0], 0.0, gains[1], 0.0, 0.0, 1.0],
            ctrlspec=_INPUTS[drive],
        )
    elif drive == "angle":
        motor.set_to_position(kp)
    else:
        motor.set_to_motor()
    passive = kd if drive == "angle" and not speed else 0.0
    if joint.damping[0] != passive:
        robot.notes.append(f"{joint.name} damping: {joint.damping[0]:g} -> {passive:g} N m s/rad")
        joint.damping = [passive, *joint.damping[1:]]
    damped = f"kd {kd:g} N m s/rad"
    laws = {
        "angle": f"kp {kp:g} N m/rad" + (f", {damped}" if passive != kd else ""),
        "speed": damped,
        "torque": "a torque",
    }
    curve = f", {numbers['stall_torque']:g} N m at rest, none at {speed:g} rad/s" if speed else ""
    robot.notes.append(f"{joint.name} {'motor' if speed or drive == 'torque' else 'servo'}: {laws[drive]}{curve}")
    if drive == "angle" and np.isfinite(span).all():
        motor.ctrllimited, motor.ctrlrange = True, span
    if joint.name in robot.limits:  # limit the motor, not the joint, so that actuator_force is the clamped force
        motor.forcelimited, motor.forcerange = True, list(robot.limits[joint.name])
        joint.actfrclimited, joint.actfrcrange = False, [0.0, 0.0]


def scaled_gains(
    nominal: Mapping[str, Tensor], factors: Mapping[str, Tensor], curves: bool
) -> Iterator[tuple[str, int, Tensor]]:
    """(model field, index, values (N, D)): ``nominal`` gains (1, D, ...) times ``factors`` (N, D).

    With ``curves`` motors are MuJoCo's DC motors: no-load speed = 1 / constant, stall torque = constant / resistance.
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
