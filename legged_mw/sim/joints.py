"""The joints of a robot: tables of numbers a joint, which joints move, the pose that they stand in, and their motors.

A table is key -> number. A joint's value is that of its exact name, else of the longest key that is part of its name, else of "".
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from legged_mw.sim.fixed_bodies import hold_joints, match_joints
from legged_mw.sim.robot_file import RobotFile
from legged_mw.sim.servos import CURVE, Drive, Motor, Range, add_motors, curves_at_joints, set_efforts, set_joints
from legged_mw.utils.errors import ModelError, unknown

_BEYOND = 1e-3  # [rad] that a pose may be beyond a range by rounding
PARTIAL = ("effort", "armature", "frictionloss", "joint_speed_limits")  # tables that need not name every joint

_UPRIGHT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # place and attitude of a root
_NO_KIND = {"joint", "l", "r", "left", "right", "fl", "fr", "rl", "rr", "lf", "rf", "lh", "rh", "hl", "hr", "bl", "br"}
_NO_KIND |= {"front", "rear", "hind", "back"}


# ---- tables


def some_joints(
    table: Mapping[str, float], joints: Sequence[str], what: str, spare: Sequence[str] = ()
) -> dict[str, float]:
    """Joint -> value, for those of ``joints`` that a key fits. A key fits if it is the joint's name or a part of it.

    Raises ModelError for a key that fits no joint, also none of ``spare``, and for two keys that fit a joint equally well.
    """
    for key in table:
        if key and not any(key in joint for joint in (*joints, *spare)):
            raise ModelError.of(
                (what, f"{unknown('joint', key, joints, 'the MJCF')} (a key may be a part of a joint's name)")
            )
    found = {}
    for joint in joints:
        fitting = sorted((key for key in table if key in joint), key=len)
        if not fitting:
            continue
        *others, best = fitting
        if others and len(others[-1]) == len(best):
            raise ModelError.of(
                (what, f"'{others[-1]}' and '{best}' fit joint '{joint}' equally well; add the key '{joint}'")
            )
        found[joint] = float(table[best])
    return found


def per_joint(table: Mapping[str, float], joints: Sequence[str], what: str, spare: Sequence[str] = ()) -> list[float]:
    """Values (D,) for ``joints``. Raises ModelError for joints without a key, and as ``some_joints`` does."""
    found = some_joints(table, joints, what, spare)
    if without := [joint for joint in joints if joint not in found]:
        missing = f"no value for {', '.join(without)}: none of {list(table)} is a part of these names"
        raise ModelError.of((what, f"{missing}; add keys, or '' for all others"))
    return list(found.values())


def per_joint_all(
    tables: Mapping[str, Mapping[str, float]], joints: Sequence[str], spare: Sequence[str] = ()
) -> dict[str, list[float]]:
    """``per_joint`` of several tables (name -> table); one error lists what is wrong with all of them."""
    values, wrong = dict[str, list[float]](), list[tuple[str, str]]()
    for what, table in tables.items():
        try:
            values[what] = per_joint(table, joints, what, spare)
        except ModelError as error:
            wrong += error.wrong
    if wrong:
        raise ModelError.of(*wrong)
    return values


def family(name: str) -> str:
    """A joint's name without its side and the word joint: "hip" of "FR_hip_joint"; the whole name, if nothing is left."""
    return "_".join(part for part in name.split("_") if part.lower() not in _NO_KIND) or name


# ---- pose and motors


@dataclass(frozen=True)
class PosedRobot:
    """The D joints that move, their pose and their numbers; the others are welded."""

    model: mujoco.MjModel  # the robot alone, compiled, its held joints welded
    joints: list[str]  # D
    held: list[str]
    angles: list[float]  # D, the pose [rad]
    ranges: list[Range]  # D [rad]; infinite where there is no limit
    # D each: "stiffness" [N m/rad], "damping" [N m s/rad], CURVE at the joint, and the caller's other tables
    tables: dict[str, list[float]]


def pose_joints(
    robot: RobotFile, tables: Mapping[str, Mapping[str, float]], pose: Mapping[str, float] | None, held: Sequence[str]
) -> PosedRobot:
    """Weld the ``held`` joints, and give the others their numbers from ``tables`` (name -> table).

    A joint's angle comes from ``pose``, else from the keyframe, else it is 0 (held joints, or ``pose`` is None).
    Raises ModelError for joints that no key fits.
    """
    every = [joint.name for joint in robot.joints]
    welded = match_joints(every, held, "held_joints")
    moving = [name for name in every if name not in welded]
    needed = {"pose": pose} if robot.keyframe is None and pose is not None else {}
    values = per_joint_all({**tables, **needed}, moving, spare=welded)
    known = {**(robot.keyframe.angles if robot.keyframe else {}), **some_joints(pose or {}, every, "pose")}
    model = robot.model
    if welded:
        # the angle nearest to 0
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
                f"warning: in the pose {name} stands at {angle:g} rad, beyond its range from {low:g} to {high:g} rad"
            )
    return PosedRobot(model, moving, welded, angles, ranges, values | curves_at_joints(values))


def _ranges(model: mujoco.MjModel, joints: Sequence[str]) -> list[Range]:
    each = [model.joint(name) for name in joints]
    return [(float(j.range[0]), float(j.range[1])) if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in each]


def set_machine(
    robot: RobotFile, partial: Mapping[str, Mapping[str, float]], posed: PosedRobot, drive: Drive
) -> tuple[float, ...]:
    """Add motors with their force limits, armature and dry friction; ``partial`` (tables of PARTIAL) wins over the file.

    Returns the speed limits (D,) [rad/s], infinite where nothing states one.
    """
    said = {what: some_joints(partial.get(what, {}), posed.joints, what, posed.held) for what in PARTIAL}
    set_efforts(robot.limits, said["effort"], robot.notes)
    set_joints(robot.joints, said["armature"], said["frictionloss"], robot.notes)
    motors = map(Motor, *(posed.tables[name] for name in ("stiffness", "damping", *CURVE) if name in posed.tables))
    add_motors(robot.spec, robot.joints, posed.ranges, list(motors), drive, robot.limits, robot.notes)
    speeds = (
        robot.speeds
        | dict(zip(posed.joints, posed.tables.get(CURVE[1], ()), strict=False))
        | said["joint_speed_limits"]
    )
    return tuple(speeds.get(name, np.inf) for name in posed.joints)


def posed(model: mujoco.MjModel, joints: Iterable[float], root: Iterable[float] = _UPRIGHT) -> mujoco.MjData:
    """Places of bodies, geoms and sites, with the joints at ``joints`` (D,) [rad] and the root at ``root`` (7,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = [*root, *joints]
    mujoco.mj_kinematics(model, data)
    return data
