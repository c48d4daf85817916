"""Bodies that do not move against others: joints are welded, fixed links are fused, the IMU gets a site on the root."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase

import mujoco
import numpy as np

from legged_mw.utils.errors import ModelError, unknown

ALIGNED = 1e-4  # [rad] less is no turn
IMU = "imu"  # name of the site that is taken, or made, where none is asked for


def match_joints(joints: Sequence[str], patterns: Sequence[str], what: str) -> list[str]:
    """The joints that names or patterns mean, in the order of ``joints``."""
    for pattern in patterns:
        if not any(fnmatchcase(joint, pattern) for joint in joints):
            raise ModelError.of((what, unknown("joint", pattern, joints, "the MJCF")))
    return [joint for joint in joints if any(fnmatchcase(joint, pattern) for pattern in patterns)]


def hold_joints(spec: mujoco.MjSpec, model: mujoco.MjModel, angles: Mapping[str, float], notes: list[str]) -> None:
    """Weld each joint at its angle [rad]: turn its body, delete the joint. ``model`` is ``spec`` compiled."""
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
        _place(body, *_pose_in_parent(model, data, body.name))
        spec.delete(joint)
        notes.append(f"joint '{name}' held at {angle:g} rad")
    for tie in [
        tie for tie in spec.equalities if tie.type == mujoco.mjtEq.mjEQ_JOINT and {tie.name1, tie.name2} & {*angles}
    ]:
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
    """Set the pose of ``body`` in its parent, whichever frame and orientation attribute the file used."""
    body.set_frame(body.parent.add_frame())
    body.pos, body.quat = place, quat
    body.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT


def fuse_fixed(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Fuse bodies without a joint into the link that carries them: fewer bodies to step."""
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
    """Name of a site on the root with the root's axes: ``asked``, or a new one at its place.

    ``asked`` is a site or a body (its origin) that does not move against the root; it may be turned. Empty means the site "imu",
    or the root's origin if there is no such site or it moves. ``model`` is ``spec`` compiled. Raises ModelError if ``asked``
    does not exist or moves.
    """
    name = asked or IMU
    is_site = spec.site(name) is not None
    if not asked and not is_site:
        return _add_site(spec, root, name, np.zeros(3), f"at the origin of '{root}'", notes)
    if not is_site and spec.body(name) is None:
        known = [thing.name for thing in (*spec.sites, *spec.bodies) if thing.name and thing.name != "world"]
        raise ModelError.of(("imu_site", unknown("site or body", name, known, where)))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base, there = data.body(root), data.site(name) if is_site else data.body(name)
    body = model.body(model.site_bodyid[there.id] if is_site else there.id)
    if beyond := _what_moves(model, root, body.id):
        if asked:
            instead = "take a site or body that is fixed to the root, or hold that joint by held_joints"
            raise ModelError.of(
                ("imu_site", f"'{name}' is on {beyond}, so what it senses is not the root's; {instead}")
            )
        why = f"at the origin of '{root}': '{name}' is on {beyond}; imu_site may name another"
        return _add_site(spec, root, f"{name}_root", np.zeros(3), why, notes)
    axes = base.xmat.reshape(3, 3).T
    turn = axes @ there.xmat.reshape(3, 3)
    if is_site and body.name == root and np.allclose(turn, np.eye(3), rtol=0.0, atol=ALIGNED):
        return name
    why = f"at the place of '{name}' on '{body.name}', with the axes of the root '{root}'"
    made = f"{name}_aligned" if is_site else name
    return _add_site(spec, root, made, axes @ (there.xpos - base.xpos), why, notes)


def _add_site(spec: mujoco.MjSpec, root: str, name: str, place: np.ndarray, why: str, notes: list[str]) -> str:
    """Add a site to the root at ``place`` [m, root frame], and return its name."""
    while spec.site(name):
        name += "_"
    spec.body(root).add_site(name=name, pos=place, group=3)
    notes.append(f"site '{name}' made {why}")
    return name


def _what_moves(model: mujoco.MjModel, root: str, body: int) -> str:
    """The ``body`` and the joint by which it moves against the root; "" if it does not."""
    if (welded := int(model.body_weldid[body])) == model.body_weldid[model.body(root).id]:
        return ""
    joint = model.joint(int(model.body_jntadr[welded])).name
    return f"body '{model.body(body).name}', which moves against the root '{root}' by joint '{joint}'"
