"""A position servo a joint in place of the file's actuators: gains are the caller's, force limits the machine's."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np

Range = tuple[float, float]
_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)
_NEVER, _ALWAYS = mujoco.mjtLimited.mjLIMITED_FALSE, mujoco.mjtLimited.mjLIMITED_TRUE


def take_limits(spec: mujoco.MjSpec, notes: list[str]) -> dict[str, Range]:
    """Joint -> lowest and highest force at the joint [N m]; the file's actuators are removed.

    Of what states one, in this order: the joint's actuatorfrcrange (a URDF's effort is read as that), the actuator's forcerange
    through its gear, a motor's ctrlrange through gain and gear.
    """
    limits = {j.name: (j.actfrcrange[0], j.actfrcrange[1]) for j in spec.joints if _limited(j.actfrclimited, j.actfrcrange)}
    if actuators := list(spec.actuators):
        notes.append(f"{len(actuators)} actuator{'s' * (len(actuators) > 1)} replaced by position servos")
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


def add_servos(
    spec: mujoco.MjSpec,
    joints: Sequence[mujoco.MjsJoint],
    angles: Sequence[Range],  # where each joint may be [rad]; infinite: anywhere
    gains: Sequence[float],  # [N m/rad]
    dampings: Sequence[float],  # [N m s/rad]
    limits: Mapping[str, Range],  # joint -> force [N m]
    notes: list[str],
) -> None:
    """One position servo a joint, clamped to the joint's range and to its force limit."""
    for joint, (low, high), kp, kd in zip(joints, angles, gains, dampings, strict=True):
        old = float(np.atleast_1d(joint.damping)[0])
        if old != kd:
            notes.append(f"{joint.name} damping: {old:g} -> {kd:g} N m s/rad")
        joint.damping = np.array([kd, *np.atleast_1d(joint.damping)[1:]]) if np.ndim(joint.damping) else kd
        servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp)
        notes.append(f"{joint.name} servo: kp {kp:g} N m/rad")
        if math.isfinite(low) and math.isfinite(high):
            servo.ctrllimited, servo.ctrlrange = True, [low, high]
        if joint.name in limits:  # on the servo and not on the joint, so that actuator_force is the clamped force
            servo.forcelimited, servo.forcerange = True, list(limits[joint.name])
            joint.actfrclimited, joint.actfrcrange = False, [0.0, 0.0]
    if endless := [joint.name for joint in joints if joint.name not in limits]:
        notes.append(f"warning: nothing limits the force of {', '.join(endless)}: these servos are stronger than any motor; set `effort`")


def set_joints(
    joints: Sequence[mujoco.MjsJoint], armature: Mapping[str, float], frictionloss: Mapping[str, float], notes: list[str]
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
