"""From an MJCF file to a compiled model: ground, servos and sensors are added here. Host only; nothing is stepped.

The MJCF states facts of the machine (mass, geometry, joint range, armature, friction, force limit); the caller's
numbers state choices (gains, ground, what collides, what is sensed). Every name that a choice uses must match
something in the MJCF, and what a choice changes is recorded in ``RobotModel.overrides``.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path

import mujoco
import numpy as np

from legged_mw.sim.errors import ModelError
from legged_mw.sim.ground import GROUND, Ground, add_ground, replace_level_pieces
from legged_mw.sim.shapes import add_sites
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.errors import unknown

_SCALAR_JOINTS = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
_INTEGRATORS = {"euler": mujoco.mjtIntegrator.mjINT_EULER, "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST}


@dataclass(frozen=True)
class Solver:
    """Step and solver: written into the model's options."""

    timestep: float = 0.004  # [s]
    iterations: int = 1  # Newton iterations a substep
    ls_iterations: int = 5  # line-search iterations a Newton iteration
    integrator: str = "euler"  # or "implicitfast": joint damping is then implicit in velocity, and stable however large


@dataclass(frozen=True)
class RobotModel:
    """A compiled model and the tables of names that its user needs."""

    physics: mujoco.MjModel  # what is stepped: no visual geoms
    root: str  # name of the body that carries the free joint
    joint_names: tuple[str, ...]  # scalar joints, in order of qpos[7:], qvel[6:] and ctrl
    sensors: dict[str, slice]  # "contact", "linvel", "accelerometer" -> span of sensordata
    spec: mujoco.MjSpec  # the same with visual geoms: to copy, never to change
    contact_geoms: tuple[str, ...] = ()  # in order of the span "contact"
    site_geoms: dict[str, tuple[str, ...]] = field(default_factory=dict)  # of each site that was asked for with geoms
    terrain: Terrain | None = None  # None: the plane
    overrides: list[str] = field(default_factory=list)  # what the caller's choices changed, a line each

    @property
    def joint_range(self) -> np.ndarray:
        """(D, 2) [rad]"""
        return self.physics.jnt_range[1:]

    @property
    def effort_range(self) -> np.ndarray:
        """(D, 2) [N m]; infinite where the MJCF states none."""
        return np.where(self.physics.actuator_forcelimited[:, None] > 0, self.physics.actuator_forcerange, [-np.inf, np.inf])

    def ground_geoms(self) -> slice:
        """Indices of the geoms that are the ground: MuJoCo counts geoms body by body, and these are the world's."""
        count = int(self.physics.body_geomnum[0])
        names = [self.physics.geom(i).name for i in range(count)]
        first = names.index(GROUND)
        return slice(first, first + sum(name == GROUND or name.startswith(f"{GROUND}/") for name in names))

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
    """Values (D,) for ``joints``: a joint takes the longest key that is its name or a part of it; "" is a part of every name.

    Raises ModelError for a key without a joint, for joints without a key, and for two keys that fit a joint equally well.
    """
    for key in table:
        if key and not any(key in joint for joint in joints):
            raise ModelError(f"{what}: {unknown('joint', key, joints, 'the MJCF')} (a key may be a part of a joint's name)")
    fitting = {joint: sorted((key for key in table if key in joint), key=len) for joint in joints}
    if without := [joint for joint, keys in fitting.items() if not keys]:
        raise ModelError(
            f"{what}: no value for {', '.join(without)}: none of {list(table)} is a part of these names; add keys, or '' for all others"
        )
    for joint, (*_, second, first) in ((joint, keys) for joint, keys in fitting.items() if len(keys) > 1):
        if len(first) == len(second):
            raise ModelError(f"{what}: '{second}' and '{first}' fit joint '{joint}' equally well; add the key '{joint}'")
    return [float(table[keys[-1]]) for keys in fitting.values()]


def build_model(
    file: Path,
    *,
    solver: Solver,
    ground: Ground,
    stiffness: Mapping[str, float],  # as for per_joint: position gain [N m/rad]
    damping: Mapping[str, float],  # as for per_joint: passive joint damping [N m s/rad]
    colliders: Sequence[str],  # geoms that touch the ground: names or patterns with * and ?
    self_collisions: bool,
    contact_geoms: Sequence[str],  # sensed: number of contacts with the ground; names or patterns, each geom once
    velocity_sites: Sequence[str],  # sensed: linear velocity, world frame [m/s]
    accelerometer_site: str | None,  # sensed: proper acceleration, site frame [m/s^2]
    sites: Mapping[str, Sequence[str]] | None = None,  # name -> geoms, names or patterns; a site that the MJCF lacks is made there
    pose: Mapping[str, float] | None = None,  # as for per_joint: angles [rad] at which a made site is the lowest point; None: all 0
) -> RobotModel:
    """Compile the MJCF at ``file`` for stepping."""
    spec, where, notes = _read(file), file.name, []
    root, joints = _find_joints(spec, where)
    names = [joint.name for joint in joints]
    _set_options(spec, solver, notes)
    add_ground(spec, ground, where, notes)
    _name_colliders(spec, notes)
    _set_collisions(spec, colliders, self_collisions, where, notes)
    _add_servos(spec, joints, per_joint(stiffness, names, "`stiffness`"), per_joint(damping, names, "`damping`"), notes)
    site_geoms = {name: _match_geoms(spec, geoms, where, f"`sites`: '{name}'") for name, geoms in (sites or {}).items()}
    touching = _match_geoms(spec, contact_geoms, where, "`contact_geoms`")
    with _naming(file):
        add_sites(spec, site_geoms, per_joint(pose, names, "`pose`") if pose else [0.0] * len(names), where, notes)
        _add_sensors(spec, touching, velocity_sites, accelerometer_site, where)
        whole = spec.copy()
        mj = _compile_bare(spec, ground, notes)
    spans = _sensor_spans(mj, len(touching), len(velocity_sites), accelerometer_site is not None)
    return RobotModel(mj, root, tuple(names), spans, whole, touching, site_geoms, ground.terrain, notes)


def _read(file: Path) -> mujoco.MjSpec:
    if not file.is_file():
        raise ModelError(f"no MJCF at {file}")
    with _naming(file):
        return mujoco.MjSpec.from_file(str(file))


@contextmanager
def _naming(file: Path) -> Iterator[None]:
    """MuJoCo's errors in one line, with the file's name."""
    try:
        yield
    except ModelError:
        raise
    except ValueError as error:  # parsing does not see a missing mesh or a name used twice, compiling does
        raise ModelError(f"{file.name} is not a valid MJCF: {' '.join(str(error).split())}") from None


def _compile_bare(spec: mujoco.MjSpec, ground: Ground, notes: list[str]) -> mujoco.MjModel:
    """What is stepped: without visual geoms, lights and cameras."""
    spec.compiler.discardvisual = True
    for extra in [*spec.lights, *spec.cameras]:  # mujoco-warp would move lights in every step
        spec.delete(extra)
    if ground.terrain and ground.boxes:
        replace_level_pieces(spec, ground.terrain, notes)
    return spec.compile()


def _find_joints(spec: mujoco.MjSpec, where: str) -> tuple[str, list[mujoco.MjsJoint]]:
    first, *rest = list(spec.joints) or [None]
    if first is None or first.type != mujoco.mjtJoint.mjJNT_FREE:
        raise ModelError(f"{where}: the first joint must be the root body's free joint; it is {first.name if first else 'missing'}")
    for joint in rest:
        if joint.type not in _SCALAR_JOINTS or not joint.name:
            raise ModelError(f"{where}: joint '{joint.name}' must be a named hinge or slide joint")
    return first.parent.name, rest


def _set_options(spec: mujoco.MjSpec, solver: Solver, notes: list[str]) -> None:
    if solver.integrator not in _INTEGRATORS:
        raise ModelError(unknown("integrator", solver.integrator, _INTEGRATORS, "`integrator`"))
    wanted = {
        "timestep": solver.timestep,
        "iterations": solver.iterations,
        "ls_iterations": solver.ls_iterations,
        "solver": mujoco.mjtSolver.mjSOL_NEWTON,
        "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "integrator": _INTEGRATORS[solver.integrator],
        # Euler's damping stays explicit, as it was trained with; implicitfast does not read this flag
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


def _name_colliders(spec: mujoco.MjSpec, notes: list[str]) -> None:
    """What may touch gets a name, ``<body>_<number>``, so that it can be asked for."""
    taken = {geom.name for geom in spec.geoms}
    for body in spec.bodies:
        for number, geom in enumerate(body.geoms):
            name = f"{body.name or 'body'}_{number}"
            if geom.name or not (geom.contype or geom.conaffinity):
                continue
            while name in taken:
                name += "_"
            geom.name = name
            taken.add(name)
            notes.append(f"geom of '{body.name}' without a name is called '{name}'")


def _set_collisions(spec: mujoco.MjSpec, colliders: Sequence[str], self_collisions: bool, where: str, notes: list[str]) -> None:
    """Ground is contype 1. What may touch it has conaffinity 1; with self-collisions also bit 2 on both sides."""
    robot = [g for g in spec.geoms if g.name != GROUND and (g.contype or g.conaffinity)]
    named = [g.name for g in robot]
    for pattern in colliders:
        if not any(fnmatchcase(name, pattern) for name in named):
            raise ModelError(f"`colliders`: {unknown('colliding geom', pattern, named, where)}")
    off = []
    for geom in robot:
        if geom.priority > 0:
            notes.append(f"geom '{geom.name}' priority: {geom.priority} -> 0, so that the ground's friction wins")
            geom.priority = 0
        touches = any(fnmatchcase(geom.name, pattern) for pattern in colliders)
        geom.contype = 2 if self_collisions and touches else 0
        geom.conaffinity = (3 if self_collisions else 1) if touches else 0
        if not touches:
            off.append(geom.name)
    if off:
        notes.append(f"collisions off: {', '.join(off)}")


def _add_servos(
    spec: mujoco.MjSpec, joints: Sequence[mujoco.MjsJoint], gains: Sequence[float], dampings: Sequence[float], notes: list[str]
) -> None:
    """One position servo a joint, clamped to the joint's range and force range."""
    limits = {j.name: list(j.actfrcrange) for j in joints if j.actfrcrange[1] > j.actfrcrange[0]}
    for actuator in list(spec.actuators):
        if actuator.target not in limits and actuator.forcerange[1] > actuator.forcerange[0]:
            limits[actuator.target] = sorted(actuator.forcerange * actuator.gear[0])  # at the joint
        notes.append(f"actuator '{actuator.name}' replaced by a position servo")
        spec.delete(actuator)
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


def _match_geoms(spec: mujoco.MjSpec, patterns: Sequence[str], where: str, what: str) -> tuple[str, ...]:
    """Names of the geoms that ``patterns`` mean, in their order, each once; an error begins with ``what`` asked for them."""
    geoms = [g.name for g in spec.geoms if g.name]
    found: dict[str, None] = {}
    for pattern in patterns:
        hits = [name for name in geoms if fnmatchcase(name, pattern)]
        if not hits:
            raise ModelError(f"{what}: {unknown('geom', pattern, geoms, where)}")
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
    """The sensors that were added last lie last."""
    sizes = {"contact": contacts, "linvel": 3 * velocities, "accelerometer": 3 if accelerometer else 0}
    ends = mj.nsensordata - sum(sizes.values()) + np.cumsum(list(sizes.values()))
    return {name: slice(int(end) - size, int(end)) for (name, size), end in zip(sizes.items(), ends, strict=True)}
