"""The joints of a robot: held and moving joints, their pose, and tables with a value per joint.

A table maps keys to values. The value of a joint is that of the key equal to its name, else of the longest key that is
part of its name, else of "".
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from legged_mw.sim.robot_file import Range, RobotFile
from legged_mw.utils.errors import ModelError, unknown

_BEYOND = 1e-3  # [rad] allowed rounding error of a pose outside of a range
PARTIAL = ("effort", "armature", "frictionloss", "joint_speed_limits")  # tables that may omit joints

_UPRIGHT = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0)  # position [m] and quaternion wxyz of an upright root
_SIDES = {"joint", "l", "r", "left", "right", "fl", "fr", "rl", "rr", "lf", "rf", "lh", "rh", "hl", "hr", "bl", "br"}
_SIDES |= {"front", "rear", "hind", "back"}


# ---- tables


def some_joints(
    table: Mapping[str, float], joints: Sequence[str], what: str, spare: Sequence[str] = ()
) -> dict[str, float]:
    """Joint -> value, for ``joints`` with a fitting key. A key fits if it is the joint's name or a part of it.

    Raises ModelError for a key that fits neither ``joints`` nor ``spare``, and for two fitting keys of equal length.
    """
    for key in table:
        if key and not any(key in joint for joint in (*joints, *spare)):
            text = unknown("joint", key, joints, "the MJCF")
            raise ModelError.of((what, f"{text} (a key may be a part of a joint's name)"))
    values = {}
    for joint in joints:
        fitting = sorted((key for key in table if key in joint), key=len)
        if len(fitting) > 1 and len(fitting[-2]) == len(fitting[-1]):
            both = f"'{fitting[-2]}' and '{fitting[-1]}'"
            raise ModelError.of((what, f"{both} fit joint '{joint}' equally well; add the key '{joint}'"))
        if fitting:
            values[joint] = float(table[fitting[-1]])
    return values


def per_joint(table: Mapping[str, float], joints: Sequence[str], what: str, spare: Sequence[str] = ()) -> list[float]:
    """Values (D,) of ``joints``. Raises ModelError for joints without a key, and as ``some_joints``."""
    values = some_joints(table, joints, what, spare)
    if without := [joint for joint in joints if joint not in values]:
        missing = f"no value for {', '.join(without)}: none of {list(table)} is a part of these names"
        raise ModelError.of((what, f"{missing}; add keys, or '' for all others"))
    return list(values.values())


def per_joint_all(
    tables: Mapping[str, Mapping[str, float]], joints: Sequence[str], spare: Sequence[str] = ()
) -> dict[str, list[float]]:
    """``per_joint`` for several tables (name -> table). One ModelError lists the faults of all tables."""
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
    """A joint's name without its side and "joint": "FR_hip_joint" -> "hip"; if nothing is left, the whole name."""
    return "_".join(part for part in name.split("_") if part.lower() not in _SIDES) or name


# ---- held joints, and the pose


def match_joints(joints: Sequence[str], patterns: Sequence[str], what: str) -> list[str]:
    """The joints that match a name or pattern, in the order of ``joints``. Raises ModelError without a match."""
    for pattern in patterns:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise ModelError.of((what, unknown("joint", pattern, joints, "the MJCF")))
    return [joint for joint in joints if any(fnmatchcase(joint, pattern) for pattern in patterns)]


def hold_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, angles: Mapping[str, float], notes: list[str]) -> None:
    """Weld each joint at its angle [rad]: turn its body and delete the joint. ``model``: the compiled ``spec``."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    for name, angle in angles.items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    for name, angle in angles.items():
        joint = spec.joint(name)
        body = joint.parent
        if (first := body.first_joint().name) != name and first not in angles:
            together = f"joint '{name}' moves together with '{first}' on body '{body.name}'"
            raise ModelError.of(("held_joints", f"{together}; hold both of them, or neither"))
        _set_pose(body, model, data)
        spec.delete(joint)
        notes.append(f"joint '{name}' held at {angle:g} rad")
    for tie in list(spec.equalities):
        if tie.type == mujoco.mjtEq.mjEQ_JOINT and {tie.name1, tie.name2} & {*angles}:
            notes.append(f"equality '{tie.name}' dropped: it couples joints of which one is held")
            spec.delete(tie)


def _set_pose(body: mujoco.MjsBody, model: mujoco.MjModel, data: mujoco.MjData) -> None:
    """Set the pose of ``body`` relative to its parent to the pose in ``data``."""
    here, parent = data.body(body.name), data.body(int(model.body(body.name).parentid[0]))
    back, away, quat, place = np.zeros(4), np.zeros(3), np.zeros(4), np.zeros(3)
    mujoco.mju_negPose(away, back, parent.xpos, parent.xquat)
    mujoco.mju_mulPose(place, quat, away, back, here.xpos, here.xquat)
    body.set_frame(body.parent.add_frame())
    body.pos, body.quat = place, quat
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


@dataclass(frozen=True)
class PosedRobot:
    """The D moving joints, their pose and their values; the other joints are welded."""

    model: mujoco.MjModel  # the compiled robot without ground, with its held joints welded
    joints: list[str]  # D
    held: list[str]
    angles: list[float]  # (D,) the pose [rad]
    ranges: list[Range]  # (D,) [rad]; infinite without a limit
    tables: dict[str, list[float]]  # (D,) each: "stiffness" [N m/rad], "damping" [N m s/rad], and the caller's tables


def pose_joints(
    robot: RobotFile, tables: Mapping[str, Mapping[str, float]], pose: Mapping[str, float] | None, held: Sequence[str]
) -> PosedRobot:
    """Weld the ``held`` joints, and compute the values of the others from ``tables`` (name -> table).

    A joint's angle comes from ``pose``, else from the keyframe, else it is 0 (held joints, or ``pose`` is None).
    Raises ModelError for joints without a fitting key.
    """
    every = [joint.name for joint in robot.joints]
    welded = match_joints(every, held, "held_joints")
    moving = [name for name in every if name not in welded]
    needed = {"pose": pose} if robot.keyframe is None and pose is not None else {}
    values = per_joint_all({**tables, **needed}, moving, spare=welded)
    known = {**(robot.keyframe.angles if robot.keyframe else {}), **some_joints(pose or {}, every, "pose")}
    model = robot.model
    if welded:
        spans = zip(welded, _ranges(model, welded), strict=True)
        nearest_to_0 = {name: float(np.clip(0.0, *span)) for name, span in spans}
        hold_joints(robot.spec, model, {name: known.get(name, nearest_to_0[name]) for name in welded}, robot.notes)
        model = robot.spec.copy().compile()
    ranges = _ranges(model, moving)
    if free := [name for name, span in zip(moving, ranges, strict=True) if not np.isfinite(span).all()]:
        robot.notes.append(f"joints without limits: {', '.join(free)}")
    angles = [known.get(name, 0.0) for name in moving]
    for name, angle, (low, high) in zip(moving, angles, ranges, strict=True):
        if pose is not None and not low - _BEYOND <= angle <= high + _BEYOND:
            where = f"{name} stands at {angle:g} rad, beyond its range from {low:g} to {high:g} rad"
            robot.notes.append(f"warning: in the pose {where}")
    return PosedRobot(model, moving, welded, angles, ranges, values)


def _ranges(model: mujoco.MjModel, joints: Sequence[str]) -> list[Range]:
    each = [model.joint(name) for name in joints]
    return [(float(j.range[0]), float(j.range[1])) if model.jnt_limited[j.id] else (-np.inf, np.inf) for j in each]


def posed(model: mujoco.MjModel, joints: Iterable[float], root: Iterable[float] = _UPRIGHT) -> mujoco.MjData:
    """Kinematics of ``model`` with joint angles ``joints`` (D,) [rad] and the root pose ``root`` (7,) [m, wxyz]."""
    data = mujoco.MjData(model)
    data.qpos[:] = [*root, *joints]
    mujoco.mj_kinematics(model, data)
    return data
