"""Bodies without relative motion: weld held joints, fuse fixed links, add an IMU site on the root."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from legged_mw.sim.robot_file import RobotFile
from legged_mw.utils.errors import ModelError, unknown

_ALIGNED = 1e-4  # [rad] axes that differ by less are parallel
_IMU = "imu"  # default name of the IMU site


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


def fuse_fixed(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Fuse bodies without a joint into their parent link, so that fewer bodies are simulated."""
    fixed: dict[str, list[str]] = {}
    for body in spec.bodies:
        carrier = body
        while carrier.name != "world" and not carrier.joints:
            carrier = carrier.parent
        if carrier.name != body.name:
            fixed.setdefault(carrier.name, []).append(body.name or "one without a name")
    if not fixed:
        return
    spec.fuse_static()
    left = {body.name for body in spec.bodies}
    for carrier, names in fixed.items():
        if gone := [name for name in names if name not in left]:
            notes.append(f"fused into '{carrier}', to which they are fixed: {', '.join(gone)}")


def sensed_site(robot: RobotFile, model: mujoco.MjModel, wanted: str) -> str:
    """Name of a site on the root with the root's axes: ``wanted`` if it is one, else a new site at its position.

    ``wanted``: a site, or a body (its origin), that is fixed to the root. Empty: the site "imu", or the root's origin
    if that site is missing or not fixed to the root. ``model``: the compiled robot.
    Raises ModelError if ``wanted`` does not exist or is not fixed to the root.
    """
    spec, root, name = robot.spec, robot.root, wanted or _IMU
    is_site = spec.site(name) is not None
    if not wanted and not is_site:
        return _add_site(robot, name, np.zeros(3), f"at the origin of '{root}'")
    if not is_site and spec.body(name) is None:
        known = [thing.name for thing in (*spec.sites, *spec.bodies) if thing.name and thing.name != "world"]
        raise ModelError.of(("imu_site", unknown("site or body", name, known, robot.where)))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base, there = data.body(root), data.site(name) if is_site else data.body(name)
    body = model.body(model.site_bodyid[there.id] if is_site else there.id)
    welded = int(model.body_weldid[body.id])
    if welded != model.body_weldid[base.id]:
        joint = model.joint(int(model.body_jntadr[welded])).name
        beyond = f"'{name}' is on body '{body.name}', which moves against the root '{root}' by joint '{joint}'"
        if wanted:
            instead = "take a site or body that is fixed to the root, or hold that joint by held_joints"
            raise ModelError.of(("imu_site", f"{beyond}, so what it senses is not the root's; {instead}"))
        why = f"at the origin of '{root}': {beyond}; imu_site may name another"
        return _add_site(robot, f"{name}_root", np.zeros(3), why)
    axes = base.xmat.reshape(3, 3).T
    turn = axes @ there.xmat.reshape(3, 3)
    if is_site and body.name == root and np.allclose(turn, np.eye(3), rtol=0.0, atol=_ALIGNED):
        return name
    why = f"at the place of '{name}' on '{body.name}', with the axes of the root '{root}'"
    return _add_site(robot, f"{name}_aligned" if is_site else name, axes @ (there.xpos - base.xpos), why)


def _add_site(robot: RobotFile, name: str, place: np.ndarray, why: str) -> str:
    """Add a site to the root at ``place`` [m, root frame], and return its name."""
    while robot.spec.site(name):
        name += "_"
    robot.spec.body(robot.root).add_site(name=name, pos=place, group=3)
    robot.notes.append(f"site '{name}' made {why}")
    return name
