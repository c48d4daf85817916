"""The joints of a robot that was read: which move, in which pose they stand, and their servos, limits and friction."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.sim.rigid import hold_joints, match_joints
from legged_mw.sim.robot_file import RobotFile
from legged_mw.sim.servos import Drive, Motor, Range, add_motors, set_efforts, set_joints
from legged_mw.sim.tables import per_joint_all, some_joints

_BEYOND = 1e-3  # [rad] that a pose may be beyond a range by rounding
# tables of motors with a torque-speed curve, before a "`gear`": [N m], [rad/s]
CURVE = ("`stall_torque`", "`no_load_speed`")
PARTIAL = ("effort", "armature", "frictionloss", "joint_speed_limits")  # tables that need not name every joint


@dataclass(frozen=True)
class Posed:
    """D joints that move, and what holds the others."""

    model: mujoco.MjModel  # the robot alone, compiled, its held joints welded
    joints: list[str]  # D
    held: list[str]
    angles: list[float]  # D, the pose [rad]
    ranges: list[Range]  # D [rad]; infinite where there is no limit
    # D each: "`stiffness`" [N m/rad], "`damping`" [N m s/rad], CURVE at the joint, what else was asked
    tables: dict[str, list[float]]


def pose_joints(
    robot: RobotFile, tables: Mapping[str, Mapping[str, float]], pose: Mapping[str, float] | None, held: Sequence[str]
) -> Posed:
    """Weld the ``held`` joints, and give the others their numbers from ``tables``, what -> table.

    The pose is the caller's, then the keyframe's; where both are silent 0 for a held joint, and for all of them if ``pose`` is None.
    Raises ModelError for joints that no key fits, of all tables at once.
    """
    every = [joint.name for joint in robot.joints]
    welded = match_joints(every, held, "`held_joints`")
    moving = [name for name in every if name not in welded]
    needed = {"`pose`": pose} if robot.keyframe is None and pose is not None else {}
    values = per_joint_all({**tables, **needed}, moving, spare=welded)
    known = {**(robot.keyframe.angles if robot.keyframe else {}), **some_joints(pose or {}, every, "`pose`")}
    model = robot.model
    if welded:
        # to 0
        nearest = {name: float(np.clip(0.0, *span)) for name, span in zip(welded, _ranges(model, welded), strict=True)}
        hold_joints(robot.spec, model, {name: known.get(name, nearest[name]) for name in welded}, robot.notes)
        model = robot.spec.copy().compile()
    ranges = _ranges(model, moving)
    if free := [name for name, span in zip(moving, ranges, strict=True) if not np.isfinite(span).all()]:
        robot.notes.append(f"joints without limits: {', '.join(free)}")
    angles = [known.get(name, 0.0) for name in moving]
    for name, angle, (low, high) in zip(moving, angles, ranges, strict=True):
        if pose is not None and not low - _BEYOND <= angle <= high + _BEYOND:
            robot.notes.append(
                f"warning: `pose`: {name} stands at {angle:g} rad, beyond its range from {low:g} to {high:g} rad"
            )
    for name, gear in zip(CURVE, (1.0, -1.0), strict=True):  # a motor's torque grows by its gear, its speed shrinks
        if name in values and "`gear`" in values:
            values[name] = [value * ratio**gear for value, ratio in zip(values[name], values["`gear`"], strict=True)]
    return Posed(model, moving, welded, angles, ranges, values)


def _ranges(model: mujoco.MjModel, joints: Sequence[str]) -> list[Range]:
    each = [model.joint(name) for name in joints]
    return [(float(j.range[0]), float(j.range[1])) if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in each]


def set_machine(
    robot: RobotFile, partial: Mapping[str, Mapping[str, float]], posed: Posed, drive: Drive
) -> tuple[float, ...]:
    """Motors with their force limits, armature and dry friction; what ``partial`` (of PARTIAL) says wins over the file.

    Returns the speed limits (D,) [rad/s], infinite where nothing states one.
    """
    said = {what: some_joints(partial.get(what, {}), posed.joints, f"`{what}`", posed.held) for what in PARTIAL}
    set_efforts(robot.limits, said["effort"], robot.notes)
    set_joints(robot.joints, said["armature"], said["frictionloss"], robot.notes)
    motors = map(Motor, *(posed.tables[name] for name in ("`stiffness`", "`damping`", *CURVE) if name in posed.tables))
    add_motors(robot.spec, robot.joints, posed.ranges, list(motors), drive, robot.limits, robot.notes)
    speeds = (
        robot.speeds
        | dict(zip(posed.joints, posed.tables.get(CURVE[1], ()), strict=False))
        | said["joint_speed_limits"]
    )
    return tuple(speeds.get(name, np.inf) for name in posed.joints)
