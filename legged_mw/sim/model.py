"""From an MJCF file to a compiled model: ground, servos and sensors are added here. Host only; nothing is stepped.

The MJCF states facts of the machine (mass, geometry, joint range, armature, friction, force limit); the caller's
numbers state choices (gains, ground, what collides, what is sensed). Every name that a choice uses must match
something in the MJCF, and what a choice changes is recorded in ``RobotModel.overrides``.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from legged_mw.sim.relief import add_relief
from legged_mw.sim.scene import add_scene
from legged_mw.utils.errors import UserError, unknown

if TYPE_CHECKING:
    from legged_mw.sim.terrain import Terrain

GROUND = "floor"  # name of the ground geom that build_model adds
_SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)


class ModelError(UserError, ValueError):
    """A name or number asked of a model that does not fit its MJCF; the message lists what exists."""


@dataclass(frozen=True)
class Physics:
    """Step and solver: written into the model's options."""

    timestep: float = 0.004  # [s]
    iterations: int = 1  # Newton iterations a substep
    ls_iterations: int = 5  # line-search iterations a Newton iteration


@dataclass(frozen=True)
class Ground:
    """The plane z = 0, or a height field. Its contact parameters win over the geom's that touches it (priority 1)."""

    friction: float = 0.6  # sliding [-]
    condim: int = 3  # 1 frictionless, 3 sliding, 4 and torsional, 6 and rolling
    terrain: Terrain | None = None  # None: the plane
    boxes: bool = False  # level pieces of the terrain as boxes, in what is stepped: for MuJoCo's own engine


@dataclass(frozen=True)
class RobotModel:
    """A compiled model and the tables of names that its user needs."""

    physics: mujoco.MjModel  # what is stepped: no visual geoms
    visual: mujoco.MjModel  # the same with visual geoms: same qpos, qvel and bodies
    root: str  # name of the body that carries the free joint
    joint_names: tuple[str, ...]  # scalar joints, in order of qpos[7:], qvel[6:] and ctrl
    joint_range: np.ndarray  # (D, 2) [rad]
    effort_range: np.ndarray  # (D, 2) [N m]; infinite where the MJCF states none
    sensors: dict[str, slice]  # "contact", "linvel", "accelerometer" -> span of sensordata
    spec: mujoco.MjSpec  # what ``visual`` was compiled from: to copy, never to change
    contact_geoms: tuple[str, ...] = ()  # in order of the span "contact"
    terrain: Terrain | None = None  # None: the plane
    overrides: list[str] = field(default_factory=list)  # what the caller's choices changed, a line each

    def ground_geoms(self) -> slice:
        """Indices of the geoms that are the ground: MuJoCo counts geoms body by body, and these are the world's."""
        count = int(self.physics.body_geomnum[0])
        names = [self.physics.geom(i).name for i in range(count)]
        first = names.index(GROUND)
        return slice(first, first + sum(name == GROUND or name.startswith(f"{GROUND}/") for name in names))

    def drawn(self) -> mujoco.MjModel:
        """``visual`` for somebody to look at: a terrain's steps and slopes are seen. Takes a second where it is large."""
        if self.terrain is None:
            return self.visual
        spec = self.spec.copy()
        add_relief(spec, self.terrain, GROUND)
        return spec.compile()

    def id(self, kind: str, name: str) -> int:
        """Index of the ``kind`` ("body", "geom", "site") called ``name``."""
        obj = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        index = mujoco.mj_name2id(self.physics, obj, name)
        if index < 0:
            count = getattr(self.physics, f"n{kind}")
            names = [mujoco.mj_id2name(self.physics, obj, i) for i in range(count)]
            raise ModelError(unknown(kind, name, [n for n in names if n], "the model"))
        return index


def per_joint(table: Mapping[str, float], joints: Sequence[str], what: str) -> list[float]:
    """Values (D,) for ``joints`` from a table keyed by joint name or a part of it.

    Raises ModelError if a joint matches no key or several, or a key matches no joint.
    """
    values = []
    for joint in joints:
        hits = [key for key in table if key in joint]
        if len(hits) != 1:
            raise ModelError(f"{what}: joint '{joint}' matches {hits or 'none'} of {list(table)}; exactly one must be a part of its name")
        values.append(float(table[hits[0]]))
    for key in table:
        if not any(key in joint for joint in joints):
            raise ModelError(f"{what}: {unknown('joint', key, joints, 'the MJCF')} (a key may be a part of a joint's name)")
    return values


def build_model(
    file: Path,
    *,
    physics: Physics,
    ground: Ground,
    stiffness: Mapping[str, float],  # part of joint name -> position gain [N m/rad]
    damping: Mapping[str, float],  # part of joint name -> passive joint damping [N m s/rad]
    colliders: Sequence[str],  # geoms that touch the ground: names or patterns with * and ?
    self_collisions: bool,
    contact_geoms: Sequence[str],  # sensed: number of contacts with the ground; names or patterns, each geom once
    velocity_sites: Sequence[str],  # sensed: linear velocity, world frame [m/s]
    accelerometer_site: str | None,  # sensed: proper acceleration, site frame [m/s^2]
    camera: Sequence[float] = (0.9, -1.1, 0.6),  # place of the camera "track" relative to the robot's centre of mass [m]
) -> RobotModel:
    """Compile the MJCF at ``file`` for stepping and for drawing."""
    if not file.is_file():
        raise ModelError(f"no MJCF at {file}")
    try:
        spec = mujoco.MjSpec.from_file(str(file))
    except ValueError as error:
        raise _invalid(file, error) from None
    notes: list[str] = []
    root, joints = _find_joints(spec, file.name)
    _set_physics(spec, physics, notes)
    _add_ground(spec, ground, file.name, notes)
    _set_collisions(spec, colliders, self_collisions, file.name, notes)
    limits = _add_servos(spec, joints, stiffness, damping, notes)
    touching = _match_geoms(spec, contact_geoms, file.name)
    _add_sensors(spec, touching, velocity_sites, accelerometer_site, file.name)
    add_scene(spec)
    _add_camera(spec, root, camera)
    try:
        visual = spec.compile()
    except ValueError as error:  # a missing mesh, a name used twice: all that parsing does not see
        raise _invalid(file, error) from None
    drawn = spec.copy()
    spec.compiler.discardvisual = True
    for light in list(spec.lights):
        spec.delete(light)  # mujoco-warp would move it in every step
    for view in list(spec.cameras):
        spec.delete(view)
    if ground.terrain and ground.boxes:
        _replace_level_pieces(spec, ground, notes)
    mj = spec.compile()
    names = tuple(j.name for j in joints)
    return RobotModel(
        physics=mj,
        visual=visual,
        root=root,
        joint_names=names,
        joint_range=np.array([mj.joint(n).range for n in names]).reshape(-1, 2),
        effort_range=np.array(limits).reshape(-1, 2),
        sensors=_sensor_spans(mj, len(touching), len(velocity_sites), accelerometer_site is not None),
        contact_geoms=touching,
        terrain=ground.terrain,
        spec=drawn,
        overrides=notes,
    )


def ground_model(terrain: Terrain) -> mujoco.MjModel:
    """The ground alone, to be looked at from afar."""
    spec = mujoco.MjSpec()
    _add_ground(spec, Ground(terrain=terrain), "the ground", [])
    add_scene(spec)
    add_relief(spec, terrain, GROUND, squares=False)
    return spec.compile()


def _invalid(file: Path, error: ValueError) -> ModelError:
    return ModelError(f"{file.name} is not a valid MJCF: {' '.join(str(error).split())}")


def _find_joints(spec: mujoco.MjSpec, where: str) -> tuple[str, list[mujoco.MjsJoint]]:
    first, *rest = list(spec.joints) or [None]
    if first is None or first.type != mujoco.mjtJoint.mjJNT_FREE:
        raise ModelError(f"{where}: the first joint must be the root body's free joint; it is {first.name if first else 'missing'}")
    for joint in rest:
        if joint.type not in _SCALAR_JOINTS or not joint.name:
            raise ModelError(f"{where}: joint '{joint.name}' must be a named hinge or slide joint")
    return first.parent.name, rest


def _set_physics(spec: mujoco.MjSpec, physics: Physics, notes: list[str]) -> None:
    wanted = {
        "timestep": physics.timestep,
        "iterations": physics.iterations,
        "ls_iterations": physics.ls_iterations,
        "solver": mujoco.mjtSolver.mjSOL_NEWTON,
        "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "integrator": mujoco.mjtIntegrator.mjINT_EULER,
        "disableflags": spec.option.disableflags | mujoco.mjtDisableBit.mjDSBL_EULERDAMP.value,
    }
    for name, value in wanted.items():
        old = getattr(spec.option, name)
        if old != value:
            notes.append(f"option {name}: {old:g} -> {getattr(value, 'name', value)}")
            setattr(spec.option, name, value)
    for key in list(spec.keys):
        notes.append(f"keyframe '{key.name}' dropped")
        spec.delete(key)  # poses are the caller's choice, and a keyframe must fit the actuators added below


def _add_ground(spec: mujoco.MjSpec, ground: Ground, where: str, notes: list[str]) -> None:
    if any(geom.name == GROUND for geom in spec.geoms):
        raise ModelError(f"{where} brings a geom '{GROUND}'; leave the ground to the config (section terrain)")
    spec.worldbody.add_geom(
        name=GROUND,
        **(_add_height_field(spec, ground.terrain) if ground.terrain else {"type": mujoco.mjtGeom.mjGEOM_PLANE, "size": [0, 0, 0.05]}),
        material="ground",
        contype=1,
        conaffinity=0,
        priority=1,
        condim=ground.condim,
        friction=[ground.friction, 0.005, 0.0001],
    )
    shape = "height field of {} x {} tiles".format(*ground.terrain.origins.shape[:2]) if ground.terrain else "plane"
    notes.append(f"ground: {shape}, friction {ground.friction:g}, condim {ground.condim}, priority 1")


def _add_height_field(spec: mujoco.MjSpec, terrain: Terrain) -> dict[str, object]:
    """Give ``spec`` the heights; returns what makes a geom of them."""
    rows, columns = terrain.heights.shape
    spec.add_hfield(name=GROUND, nrow=rows, ncol=columns)
    return {"type": mujoco.mjtGeom.mjGEOM_HFIELD, "hfieldname": GROUND, "pos": _fill_height_field(spec, terrain, terrain.heights)}


def _fill_height_field(spec: mujoco.MjSpec, terrain: Terrain, heights: np.ndarray) -> list[float]:
    """Put ``heights`` (R, C) [m] on the grid of ``terrain``; returns where the geom is to be."""
    low, (rows, columns) = float(heights.min()), heights.shape
    span = max(float(np.ptp(heights)), 1e-3)  # MuJoCo wants some; it scales what it is given to 0..1
    field = spec.hfield(GROUND)
    field.size = [(columns - 1) * terrain.cell / 2, (rows - 1) * terrain.cell / 2, span, 1.0]
    field.userdata = ((heights - low) / span).astype(np.float32).ravel()
    return [0.0, 0.0, low]


def _replace_level_pieces(spec: mujoco.MjSpec, ground: Ground, notes: list[str]) -> None:
    """Sink the height field where boxes are exact: MuJoCo makes a tilted contact with every triangle that is near.

    A small sphere has up to a dozen contacts with what stays a height field, which few iterations leave far from solved.
    """
    from legged_mw.sim.terrain import as_boxes

    assert ground.terrain
    boxes, heights, _ = as_boxes(ground.terrain)
    spec.geom(GROUND).pos, bottom = _fill_height_field(spec, ground.terrain, heights), float(heights.min()) - 1.0
    for number, box in enumerate(boxes):
        low, high = np.array([*box.low, bottom]), np.array([*box.high, box.top])
        add_ground_box(spec, low, high).name = f"{GROUND}/{number}"
    feel_all_ground(spec)
    for name, least in (("iterations", 20), ("ls_iterations", 50)):
        if (old := getattr(spec.option, name)) < least:
            notes.append(f"option {name}: {old:g} -> {least}, for the contacts of a height field")
            setattr(spec.option, name, least)
    notes.append(f"ground: {len(boxes)} boxes for its level pieces")


def add_ground_box(spec: mujoco.MjSpec, low: np.ndarray, high: np.ndarray) -> mujoco.MjsGeom:
    """A box between two corners (3,) [m] that touches as the ground does."""
    box, floor = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=(low + high) / 2, size=(high - low) / 2), spec.geom(GROUND)
    for name in ("contype", "conaffinity", "priority", "condim", "friction", "solref", "solimp"):
        setattr(box, name, getattr(floor, name))
    return box


def feel_all_ground(spec: mujoco.MjSpec) -> None:
    """Contact sensors that ask for the geom of the ground ask for all geoms of the world instead."""
    for sensor in spec.sensors:
        if sensor.type == mujoco.mjtSensor.mjSENS_CONTACT and sensor.refname == GROUND:
            sensor.reftype, sensor.refname = mujoco.mjtObj.mjOBJ_BODY, "world"


def _set_collisions(spec: mujoco.MjSpec, colliders: Sequence[str], self_collisions: bool, where: str, notes: list[str]) -> None:
    """Ground is contype 1. What may touch it has conaffinity 1; with self-collisions also bit 2 on both sides."""
    robot = [g for g in spec.geoms if g.name != GROUND and (g.contype or g.conaffinity)]
    named = [g.name for g in robot if g.name]
    for pattern in colliders:
        if not any(fnmatchcase(g.name, pattern) for g in robot):
            raise ModelError(f"colliders: {unknown('colliding geom', pattern, named, where)}")
    off = []
    for geom in robot:
        if geom.priority > 0:
            notes.append(f"geom '{geom.name}' priority: {geom.priority} -> 0, so that the ground's friction wins")
            geom.priority = 0
        touches = any(fnmatchcase(geom.name, pattern) for pattern in colliders)
        geom.contype = 2 if self_collisions and touches else 0
        geom.conaffinity = (3 if self_collisions else 1) if touches else 0
        if not touches:
            off.append(geom.name or "unnamed")
    if off:
        notes.append(f"collisions off: {', '.join(off)}")


def _add_camera(spec: mujoco.MjSpec, root: str, place: Sequence[float]) -> None:
    """A camera "track" that keeps its distance and looks at the robot; for viewers, the stepped model has none."""
    away = np.array(place, dtype=float) / np.linalg.norm(place)  # a camera looks along its -z
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(away, right), away], axis=1).ravel())
    spec.body(root).add_camera(name="track", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=list(place), quat=quat)


def _add_servos(
    spec: mujoco.MjSpec, joints: list[mujoco.MjsJoint], stiffness: Mapping[str, float], damping: Mapping[str, float], notes: list[str]
) -> list[list[float]]:
    """One position servo a joint, clamped to the joint's range and force range; returns the force ranges [N m]."""
    limits = {j.name: list(j.actfrcrange) for j in joints if j.actfrcrange[1] > j.actfrcrange[0]}
    for actuator in list(spec.actuators):
        if actuator.target not in limits and actuator.forcerange[1] > actuator.forcerange[0]:
            limits[actuator.target] = sorted(actuator.forcerange * actuator.gear[0])  # at the joint
        notes.append(f"actuator '{actuator.name}' replaced by a position servo")
        spec.delete(actuator)
    names = [j.name for j in joints]
    gains, dampings = per_joint(stiffness, names, "control.stiffness"), per_joint(damping, names, "control.damping")
    for joint, kp, kd in zip(joints, gains, dampings, strict=True):
        old = float(np.atleast_1d(joint.damping)[0])
        if old != kd:
            notes.append(f"{joint.name} damping: {old:g} -> {kd:g} N m s/rad")
        joint.damping = np.array([kd, *np.atleast_1d(joint.damping)[1:]]) if np.ndim(joint.damping) else kd
        servo = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        servo.set_to_position(kp)
        notes.append(f"{joint.name} servo: kp {kp:g} N m/rad")
        if joint.range[1] > joint.range[0]:
            servo.ctrllimited, servo.ctrlrange = True, list(joint.range)
        if joint.name in limits:  # on the servo and not on the joint, so that actuator_force is the clamped force
            servo.forcelimited, servo.forcerange = True, limits[joint.name]
            joint.actfrclimited, joint.actfrcrange = False, [0.0, 0.0]
    return [limits.get(name, [-float("inf"), float("inf")]) for name in names]


def _match_geoms(spec: mujoco.MjSpec, patterns: Sequence[str], where: str) -> tuple[str, ...]:
    """Names of the geoms that ``patterns`` mean, in their order, each once."""
    geoms = [g.name for g in spec.geoms if g.name]
    found: dict[str, None] = {}
    for pattern in patterns:
        hits = [name for name in geoms if fnmatchcase(name, pattern)]
        if not hits:
            raise ModelError(unknown("geom", pattern, geoms, where))
        found |= dict.fromkeys(hits)
    return tuple(found)


def _add_sensors(
    spec: mujoco.MjSpec, contact_geoms: Sequence[str], velocity_sites: Sequence[str], accelerometer_site: str | None, where: str
) -> None:
    """In an order that makes each group one span of sensordata."""
    sites = [s.name for s in spec.sites if s.name]
    for name in contact_geoms:
        spec.add_sensor(
            name=f"contact/{name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=name,
            reftype=mujoco.mjtObj.mjOBJ_GEOM,
            refname=GROUND,
            intprm=[1 << mujoco.mjtConDataField.mjCONDATA_FOUND.value, 0, 1],  # data, no reduction, one slot
        )
    for name in [*velocity_sites, *([accelerometer_site] if accelerometer_site else [])]:
        if name not in sites:
            raise ModelError(unknown("site", name, sites, where))
    site = mujoco.mjtObj.mjOBJ_SITE
    for name in velocity_sites:
        spec.add_sensor(name=f"linvel/{name}", type=mujoco.mjtSensor.mjSENS_FRAMELINVEL, objtype=site, objname=name)
    if accelerometer_site:
        spec.add_sensor(
            name=f"accelerometer/{accelerometer_site}", type=mujoco.mjtSensor.mjSENS_ACCELEROMETER, objtype=site, objname=accelerometer_site
        )


def _sensor_spans(mj: mujoco.MjModel, contacts: int, velocities: int, accelerometer: bool) -> dict[str, slice]:
    sizes = {"contact": contacts, "linvel": 3 * velocities, "accelerometer": 3 if accelerometer else 0}
    spans: dict[str, slice] = {}
    start = int(mj.sensor_adr[mj.nsensor - contacts - velocities - int(accelerometer)]) if sum(sizes.values()) else 0
    for name, size in sizes.items():
        spans[name] = slice(start, start + size)
        start += size
    return spans
