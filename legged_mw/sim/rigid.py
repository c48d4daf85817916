"""What does not move within a robot: joints that are held, links that are fused, and a sensor's place in the root's axes."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from legged_mw.sim.errors import ModelError
from legged_mw.utils.errors import unknown

ALIGNED = 1e-9  # of 1 minus a quaternion's first number: less is no turn
IMU = "imu"  # name of the site that is taken, or made, where none is asked for


def match_joints(joints: Sequence[str], patterns: Sequence[str], what: str) -> list[str]:
    """The joints that names or patterns mean, in the order of ``joints``."""
    for pattern in patterns:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise ModelError(f"{what}: {unknown('joint', pattern, joints, 'the MJCF')}")
    return [joint for joint in joints if any(fnmatchcase(joint, pattern) for pattern in patterns)]


def hold_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, angles: Mapping[str, float], notes: list[str]) -> None:
    """Weld each joint at its angle [rad]: the body stands turned, and the joint is gone. ``model`` is ``spec`` compiled."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    for name, angle in angles.items():
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
    for name, angle in angles.items():
        joint = spec.joint(name)
        body = joint.parent
        if (first := body.first_joint().name) != name and first not in angles:
            raise ModelError(
                f"`held_joints`: joint '{name}' moves together with '{first}' on body '{body.name}'; hold both of them, or neither"
            )
        _place(body, *_pose_in_parent(model, data, body.name))
        spec.delete(joint)
        notes.append(f"joint '{name}' held at {angle:g} rad")
    for tie in [tie for tie in spec.equalities if tie.type == mujoco.mjtEq.mjEQ_JOINT and {tie.name1, tie.name2} & {*angles}]:
        notes.append(f"equality '{tie.name}' dropped: it couples joints of which one is held")
        spec.delete(tie)


def _pose_in_parent(model: mujoco.MjModel, data: mujoco.MjData, body: str) -> tuple[np.ndarray, np.ndarray]:
    index = model.body(body).id
    parent = int(model.body_parentid[index])
    back, away, quat, place = np.zeros(4), np.zeros(3), np.zeros(4), np.zeros(3)
    mujoco.mju_negPose(away, back, data.xpos[parent], data.xquat[parent])
    mujoco.mju_mulPose(place, quat, away, back, data.xpos[index], data.xquat[index])
    return place, quat


def _place(body: mujoco.MjsBody, place: np.ndarray, quat: np.ndarray) -> None:
    """Put ``body`` there in its parent, however its orientation and frame were written."""
    body.set_frame(body.parent.add_frame())
    body.pos, body.quat = place, quat
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def fuse_fixed(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Bodies without a joint become part of what carries them: fewer bodies to step, and each is a link that moves."""
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


def sensed_site(spec: mujoco.MjSpec, model: mujoco.MjModel, root: str, asked: str, where: str, notes: list[str]) -> str:
    """Name of a site on the root with the root's axes: the one ``asked`` for, or a new one at its place.

    What is asked for may be turned, may be on any body that does not move against the root, and may be a body, which means its origin.
    Empty: "imu"; if there is none, or only one that moves against the root, a new one at the root's origin. ``model`` is ``spec``
    compiled. Raises ModelError for a site that there is not, or that moves.
    """
    name, base = asked or IMU, spec.body(root)
    is_site = spec.site(name) is not None
    if not is_site and asked and spec.body(name) is None:
        known = [thing.name for thing in (*spec.sites, *spec.bodies) if thing.name and thing.name != "world"]
        raise ModelError(f"`imu_site`: {unknown('site or body', name, known, where)}")
    beyond = _what_moves(model, root, name, is_site) if is_site or asked else ""
    if asked and beyond:
        raise ModelError(
            f"`imu_site`: '{name}' is on {beyond}, so what it senses is not the root's; take a site or body that is fixed to the root, or "
            "hold that joint by `held_joints`"
        )
    if not asked and (beyond or not is_site):
        made = f"{name}_root" if is_site else name
        base.add_site(name=made, group=3)
        why = f": '{name}' is on {beyond}; `imu_site` may name another" if beyond else ""
        notes.append(f"site '{made}' made at the origin of '{root}'{why}")
        return made
    body = int(model.site(name).bodyid[0]) if is_site else model.body(name).id
    place, turn = _pose_in_root(model, root, name, is_site)
    if is_site and model.body(body).name == root and turn < ALIGNED:
        return name
    made = name if not is_site else f"{name}_aligned"
    base.add_site(name=made, pos=place, group=3)
    notes.append(f"site '{made}' made at the place of '{name}' on '{model.body(body).name}', with the axes of the root '{root}'")
    return made


def _what_moves(model: mujoco.MjModel, root: str, name: str, is_site: bool) -> str:
    """Which body a site is on (or is), and the joint by which that moves against the root; "" if it does not."""
    body = int(model.site(name).bodyid[0]) if is_site else model.body(name).id
    if (welded := int(model.body_weldid[body])) == model.body_weldid[model.body(root).id]:
        return ""
    joint = model.joint(int(model.body_jntadr[welded])).name
    return f"body '{model.body(body).name}', which moves against the root '{root}' by joint '{joint}'"


def _pose_in_root(model: mujoco.MjModel, root: str, name: str, is_site: bool) -> tuple[np.ndarray, float]:
    """Place (3,) [m] of a site or body in the root's frame, and 1 minus the first number of its quaternion there: 0 is aligned."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base, there = data.body(root), data.site(name) if is_site else data.body(name)
    rotation = base.xmat.reshape(3, 3).T
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, (rotation @ there.xmat.reshape(3, 3)).ravel())
    return rotation @ (there.xpos - base.xpos), 1.0 - abs(float(quat[0]))
