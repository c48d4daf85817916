"""Read a vendor's MJCF or URDF, unedited, as a ``RobotFile``.

``RobotFile.notes`` lists dropped, added and renamed elements. This module simulates nothing.
"""

from __future__ import annotations

import itertools
import re
import warnings
from collections.abc import Collection
from pathlib import Path

import mujoco
import numpy as np

from legged_mw.robot.meshes import compile_readable
from legged_mw.robot.mjcf import ON_JOINTS, XmlSource, add_rotors, check_model
from legged_mw.robot.urdf import read_urdf
from legged_mw.sim.robot_file import (
    SCALAR_JOINTS,
    SCENE,
    UPRIGHT,
    Keyframe,
    Range,
    RobotFile,
    is_limited,
    joint_limits,
    kind_of,
    naming,
    tilt,
)
from legged_mw.utils.errors import ModelError

_FREE = mujoco.mjtJoint.mjJNT_FREE
_COLUMNS = {_FREE: 7, mujoco.mjtJoint.mjJNT_BALL: 4}  # number of columns in qpos; other joints have one
_GRAVITY = (0.0, 0.0, -9.81)  # [m/s^2]
_ROUNDING = 1e-9  # share of the largest moment of inertia
_THIN = 1e-3  # smallest (thickness / length)^2 of a body with corrected inertia, about [ours]
_ADDED = {  # attributes of defaults that would apply to elements added to the robot
    "geom": "type pos quat contype conaffinity condim priority friction solmix solref solimp margin gap "
    "surfacevel adhesion rgba group density material",
    "site": "type size group rgba material",
    "actuator": "gaintype gainprm biastype biasprm dyntype dynprm gear ctrllimited ctrlrange forcelimited forcerange "
    "actlimited actrange armature damping delay nsample interp",
}
_KEPT_SENSORS = "TOUCH FORCE TORQUE RANGEFINDER CONTACT GEOMDIST GEOMNORMAL GEOMFROMTO USER PLUGIN TACTILE"
_SENSED = re.compile(
    r"(contact|linvel|accelerometer|velocimeter|gyro|up|jointpos|jointvel|torque)/.*|self_contacts|angular_momentum"
)
_OURS = {"geoms": SCENE, "hfields": SCENE, "materials": SCENE, "textures": SCENE, "sensors": _SENSED}


def read_robot(file: Path, wanted: Collection[str] = ()) -> RobotFile:
    """Read an MJCF or URDF and keep the sensors named in ``wanted``. Raises ModelError if it is not one valid robot."""
    if not file.is_file():
        raise ModelError(f"no {kind_of(file)} at {file}")
    where, notes, lost = file.name, list[str](), dict[str, str]()
    with naming(file):
        source = XmlSource(file)
        spec, speeds = read_urdf(source, notes, lost) if source.root.tag == "robot" else (source.spec(), {})
        _infer_inertias(spec)
        notes += add_rotors(spec)
        limits = _take_limits(spec, notes)
        keyframe = _take_keyframe(spec, notes)
        sensors = tuple(sensor.name for sensor in spec.sensors if sensor.name)
        _drop_sensors(spec, wanted, notes)
        _drop_world(spec, where, notes)
        _forget_defaults(spec)
        _free_root(spec, where, notes)
        _balance(spec, notes)
        _rename_clashes(spec, notes)
        with warnings.catch_warnings(record=True) as caught:
            model = compile_readable(spec, where, notes, lost)
        check_model(model)
        notes += [f"warning: {' '.join(str(each.message).split())}" for each in caught]
        if np.abs(model.opt.gravity - _GRAVITY).max() > 0.05:
            numbers = " ".join(f"{number:g}" for number in model.opt.gravity)
            notes.append(f"warning: gravity is {numbers} m/s^2, as the file says")
    _check_joints(spec, where)
    return RobotFile(spec, model, where, notes, limits, speeds, keyframe, sensors, lost)


def _infer_inertias(spec: mujoco.MjSpec) -> None:
    """Delete explicit inertias if the file computes all inertias from geoms. Then visual geoms can be dropped later."""
    kinds = mujoco.mjtInertiaFromGeom
    if spec.compiler.inertiafromgeom == kinds.mjINERTIAFROMGEOM_TRUE:
        spec.compiler.inertiafromgeom = kinds.mjINERTIAFROMGEOM_AUTO
        fresh = mujoco.MjSpec().worldbody.add_body()
        for body in spec.bodies[1:]:
            for name in ("explicitinertial", "mass", "ipos", "iquat", "inertia", "fullinertia"):
                setattr(body, name, getattr(fresh, name))


def _take_limits(spec: mujoco.MjSpec, notes: list[str]) -> dict[str, Range]:
    """Remove the file's actuators. Return joint -> lowest and highest force at the joint [N m].

    It is the first that exists: the joint's force range; an actuator's forcerange x gear; a motor's ctrlrange x gain x
    gear.
    """
    limits = joint_limits(spec)
    if actuators := list(spec.actuators):
        notes.append(f"{len(actuators)} actuator{'s' * (len(actuators) > 1)} replaced")
    for actuator in actuators:
        if actuator.trntype in ON_JOINTS and actuator.target not in limits:
            force = _force(actuator)
            if force is not None:
                limits[actuator.target] = (float(min(force)), float(max(force)))
        spec.delete(actuator)
    return limits


def _force(actuator: mujoco.MjsActuator) -> np.ndarray | None:
    """An actuator's force range at the joint [N m]; None if it has none or the range depends on the state."""
    if is_limited(actuator.forcelimited, actuator.forcerange):
        return actuator.forcerange * actuator.gear[0]
    is_motor = actuator.gaintype == mujoco.mjtGain.mjGAIN_FIXED and actuator.biastype == mujoco.mjtBias.mjBIAS_NONE
    if is_motor and is_limited(actuator.ctrllimited, actuator.ctrlrange):
        return actuator.ctrlrange * actuator.gear[0] * actuator.gainprm[0]
    return None


def _take_keyframe(spec: mujoco.MjSpec, notes: list[str]) -> Keyframe | None:
    """Return the keyframe "home", or the only one. Remove all keyframes, because they do not match the new servos."""
    keys, keyframe = list(spec.keys), None
    chosen = next((key for key in keys if key.name == "home"), keys[0] if len(keys) == 1 else None)
    qpos = list(chosen.qpos) if chosen else []
    starts = np.cumsum([0, *(_COLUMNS.get(joint.type, 1) for joint in spec.joints)])
    if chosen and len(qpos) == starts[-1]:
        angles = {
            joint.name: qpos[start]
            for joint, start in zip(spec.joints, starts[:-1], strict=True)
            if joint.type in SCALAR_JOINTS
        }
        first = next(iter(spec.joints), None)
        free = bool(first and first.type == _FREE)
        angle = tilt(qpos[3:7]) if free else 0.0
        keyframe = Keyframe(chosen.name, qpos[2] if free and angle < UPRIGHT else None, angles)
        notes.append(f"keyframe '{chosen.name}' read: pose and height of the root, where nothing else states them")
        if angle > UPRIGHT:
            text = f"warning: keyframe '{chosen.name}' tilts the root by {angle:.0f} degrees; that and its height are not read, the root "
            notes.append(f"{text}begins upright: state a pose for that")
    for key in keys:
        if key is not chosen:
            notes.append(f"keyframe '{key.name}' dropped")
        elif not keyframe:
            notes.append(
                f"keyframe '{key.name}' dropped: its qpos has {len(qpos)} numbers, the joints of the file have {starts[-1]}"
            )
        spec.delete(key)
    spec.nkey = 0
    return keyframe


def _drop_sensors(spec: mujoco.MjSpec, wanted: Collection[str], notes: list[str]) -> None:
    """Drop sensors whose values the state contains. Contact sensors and ``wanted`` sensors stay."""
    kept_types = {getattr(mujoco.mjtSensor, f"mjSENS_{name}", None) for name in _KEPT_SENSORS.split()}
    if dropped := [sensor for sensor in spec.sensors if sensor.type not in kept_types and sensor.name not in wanted]:
        notes.append(
            f"sensors dropped, as nothing reads them: {', '.join(sensor.name or 'one without a name' for sensor in dropped)}"
        )
    for sensor in dropped:
        spec.delete(sensor)


def _drop_world(spec: mujoco.MjSpec, where: str, notes: list[str]) -> None:
    """Drop the file's ground, objects, lights, cameras and sky, and the constraints between them and the robot."""
    for body in [body for body in spec.worldbody.bodies if not _has_joints(body) and _has_joints(spec.worldbody)]:
        notes.append(f"body '{body.name}' of the world dropped: it has no joint")
        spec.delete(body)
    if not spec.worldbody.bodies:
        raise ModelError(f"{where} has no body; it must hold a robot")
    _drop_spares(spec, notes)
    if len(moving := [body.name for body in spec.worldbody.bodies]) > 1:
        raise ModelError(
            f"{where} has {len(moving)} bodies with joints in its world: {', '.join(moving)}; leave one of them, the robot"
        )
    geoms = list(spec.worldbody.geoms)
    skies = [texture for texture in spec.textures if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX]
    dropped = {"world geoms": geoms, "lights": list(spec.lights), "cameras": list(spec.cameras), "skybox": skies}
    for kind, parts in dropped.items():
        if parts:
            reason = ", as the ground is added" if parts is geoms else ""
            notes.append(f"{kind} dropped{reason}: {', '.join(part.name or 'one without a name' for part in parts)}")
        for part in parts:
            spec.delete(part)
    if geoms or skies:
        _drop_unused(spec)
    _drop_ties(spec, notes)


def _drop_spares(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Drop bodies with a joint but no geom beside the robot. Unitree's files use them to number the motors."""
    spare = [body for body in spec.worldbody.bodies if not body.geoms and not body.bodies]
    if len(spare) == len(spec.worldbody.bodies):
        return
    if spare:
        names = ", ".join(f"'{body.name}'" for body in spare)
        notes.append(f"bodies of the world dropped: {names}, which have a joint and no geom")
    for body in spare:
        spec.delete(body)


def _has_joints(body: mujoco.MjsBody) -> bool:
    return bool(body.joints) or any(_has_joints(child) for child in body.bodies)


def _drop_unused(spec: mujoco.MjSpec) -> None:
    """Delete height fields, materials and textures that only the ground uses."""
    for hfield in [field for field in spec.hfields if field.name not in {geom.hfieldname for geom in spec.geoms}]:
        spec.delete(hfield)
    used = {thing.material for thing in (*spec.geoms, *spec.sites, *spec.meshes, *spec.skins, *spec.tendons)}
    for material in [material for material in spec.materials if material.name not in used]:
        spec.delete(material)
    used_textures = {name for material in spec.materials for name in material.textures}
    for texture in [texture for texture in spec.textures if texture.name not in used_textures]:
        spec.delete(texture)


def _drop_ties(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Drop geom pairs, and constraints that hold the robot to the world or to dropped objects."""
    bodies, sites = {body.name for body in spec.bodies} - {"world"}, {site.name for site in spec.sites}
    for pair in list(spec.pairs):
        notes.append(f"contact pair of '{pair.geomname1}' and '{pair.geomname2}' dropped")
        spec.delete(pair)
    for exclude in list(spec.excludes):
        if not {exclude.bodyname1, exclude.bodyname2} <= bodies:
            spec.delete(exclude)
    for tie in list(spec.equalities):
        kinds = {mujoco.mjtObj.mjOBJ_BODY: bodies, mujoco.mjtObj.mjOBJ_SITE: sites}
        known = kinds.get(tie.objtype)
        if known is not None and tie.type != mujoco.mjtEq.mjEQ_JOINT and not {tie.name1, tie.name2} <= known:
            notes.append(f"equality '{tie.name}' dropped: it holds '{tie.name1}' to the world")
            spec.delete(tie)


def _forget_defaults(spec: mujoco.MjSpec) -> None:
    """Reset the main defaults, because elements added later need MuJoCo's. The file's elements keep their values."""
    fresh = mujoco.MjSpec().default
    for kind, names in _ADDED.items():
        for name in names.split():
            setattr(getattr(spec.default, kind), name, getattr(getattr(fresh, kind), name))


def _free_root(spec: mujoco.MjSpec, where: str, notes: list[str]) -> None:
    """Give the root a name and one free joint without damping, friction or armature."""
    root = spec.worldbody.first_body()
    if not root.name:
        root.name = next(name for name in ("base", "root", "base_0") if spec.body(name) is None)
        notes.append(f"body without a name, the root, is called '{root.name}'")
    if not root.joints:
        root.add_freejoint()
        notes.append(f"free joint added to '{root.name}'")
    first = root.joints[0]
    if first.type != _FREE:
        raise ModelError(
            f"{where}: the first joint must be the root body's free joint; it is {first.name or 'one without a name'}"
        )
    for name in ("armature", "frictionloss"):
        if old := getattr(first, name):
            notes.append(f"free joint {name}: {old:g} -> 0")
            setattr(first, name, 0.0)
    if np.any(first.damping):
        notes.append(f"free joint damping: {float(np.atleast_1d(first.damping)[0]):g} -> 0")
        first.damping = np.zeros_like(first.damping)


def _balance(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Replace each physically impossible inertia by the nearest possible one, and note both.

    An inertia with a diagonal value that is not positive stays, so that MuJoCo refuses it.
    """
    for body in [body for body in spec.bodies if body.explicitinertial]:
        is_full = not np.isnan(body.fullinertia[0])
        xx, yy, zz, xy, xz, yz = body.fullinertia if is_full else [*body.inertia, 0.0, 0.0, 0.0]
        if not (min(xx, yy, zz) > 0.0 and np.isfinite([xx, yy, zz, xy, xz, yz]).all()):
            continue
        moments, axes = np.linalg.eigh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        deficit = (moments[2] - moments[0] - moments[1]) / moments[2]
        if deficit < -_ROUNDING:
            continue
        nearest = _nearest_moments(moments, _THIN if deficit > _ROUNDING else 1e-6)
        full = axes @ np.diag(nearest) @ axes.T
        if is_full:
            body.fullinertia = full[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        else:
            body.inertia = np.diag(full)
        if deficit > _ROUNDING:
            moments[np.abs(moments) < _ROUNDING * moments[2]] = 0.0
            before, after = (", ".join(f"{moment:.3g}" for moment in each) for each in (moments, nearest))
            notes.append(f"inertia of '{body.name}' balanced: no body has the moments {before} kg m^2; now {after}")


def _nearest_moments(moments: np.ndarray, thin: float) -> np.ndarray:
    """The physically possible principal moments of inertia (3,) nearest to ``moments`` (3,).

    Each is the sum of two second moments of mass along the axes. These are at least ``thin`` x the largest moment.
    """
    sums, bound = np.ones((3, 3)) - np.eye(3), thin * moments.max()
    options = []
    for free in itertools.product((False, True), repeat=3):  # axes that are not at the lower bound
        second, chosen = np.full(3, bound), np.array(free)
        rest = moments - sums[:, ~chosen].sum(axis=1) * bound
        second[chosen] = np.linalg.lstsq(sums[:, chosen], rest, rcond=None)[0]
        if second.min() >= bound * (1.0 - _ROUNDING):
            options.append(sums @ second)
    return min(options, key=lambda each: float(np.linalg.norm(each - moments)))


def _rename_clashes(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """Rename elements of the file whose names this package uses."""
    renamed: dict[str, dict[str, str]] = {}
    for kind, ours in _OURS.items():
        taken, new = {thing.name for thing in getattr(spec, kind)}, renamed.setdefault(kind, {})
        for thing in [thing for thing in getattr(spec, kind) if ours.fullmatch(thing.name)]:
            name = f"robot_{thing.name}"
            while name in taken:
                name = f"{name}_"
            taken.add(name)
            new[thing.name] = thing.name = name
    for kind, names in renamed.items():
        notes += [
            f"{kind.removesuffix('s')} '{old}' is called '{new}': the first name is one of ours"
            for old, new in names.items()
        ]
    for thing in (*spec.geoms, *spec.sites, *spec.meshes, *spec.skins, *spec.tendons):
        thing.material = renamed["materials"].get(thing.material, thing.material)
    for geom in spec.geoms:
        geom.hfieldname = renamed["hfields"].get(geom.hfieldname, geom.hfieldname)
    for material in spec.materials:
        material.textures = [renamed["textures"].get(name, name) for name in material.textures]
    for sensor in spec.sensors:
        for what in ("obj", "ref"):
            if getattr(sensor, f"{what}type") == mujoco.mjtObj.mjOBJ_GEOM:
                name = getattr(sensor, f"{what}name")
                setattr(sensor, f"{what}name", renamed["geoms"].get(name, name))


def _check_joints(spec: mujoco.MjSpec, where: str) -> None:
    if len(joints := list(spec.joints)[1:]) == 0:
        raise ModelError(f"{where} has no hinge or slide joint, so nothing of it can be moved")
    for joint in joints:
        if joint.type not in SCALAR_JOINTS or not joint.name:
            raise ModelError(f"{where}: joint '{joint.name}' must be a named hinge or slide joint")
