"""Compile a robot's file into a model with ground, motors and sensors, on the host.

The file has the facts of the machine (mass, geometry, joint range, armature, friction, force limit). The caller chooses
gains, ground, colliders and sensors. Every name that the caller uses must exist in the file. ``RobotModel.overrides``
lists all changes to the file.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.sim.ground import GROUND, Ground, add_ground, replace_level_pieces
from legged_mw.sim.joints import pose_joints, posed
from legged_mw.sim.robot_file import Keyframe, RobotFile, naming, read_plain
from legged_mw.sim.sensors import add_more_sensors, add_sensors, sensed_site, sensor_spans
from legged_mw.sim.servos import Drive, set_machine
from legged_mw.sim.surface_points import add_sites, surfaces
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.errors import ModelError, unknown

_FLAGS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}  # options that are bit masks
_ENUMS = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone, "solver": mujoco.mjtSolver, **_FLAGS}
# flags of a file that would switch off physics of the robot
_NEEDED = ("CONSTRAINT", "EQUALITY", "FRICTIONLOSS", "LIMIT", "CONTACT", "SPRING", "DAMPER", "GRAVITY")
_NEEDED += ("CLAMPCTRL", "ACTUATION", "SENSOR")
_SWITCHED_OFF = sum(getattr(mujoco.mjtDisableBit, f"mjDSBL_{name}").value for name in _NEEDED)
_INTEGRATORS = {"euler": mujoco.mjtIntegrator.mjINT_EULER, "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST}


@dataclass(frozen=True)
class Solver:
    """Time step and solver, written into the model's options."""

    timestep: float = 0.004  # [s]
    iterations: int = 1  # Newton iterations per substep
    ls_iterations: int = 5  # line-search iterations per Newton iteration
    integrator: str = "euler"  # or "implicitfast", for which joint damping is implicit and always stable


@dataclass(frozen=True)
class RobotModel:
    """A compiled model, with names and tables for its users."""

    physics: mujoco.MjModel  # simulated model, without visual geoms
    root: str  # name of the body with the free joint
    joint_names: tuple[str, ...]  # scalar joints, in order of qpos[7:], qvel[6:] and ctrl
    sensors: dict[str, slice]  # "contact", "linvel", "accelerometer" and ``more_sensors`` -> columns of sensordata
    spec: mujoco.MjSpec  # the model with visual geoms and without ``more_sensors``; copy it, never change it
    names: GeomNames  # names of geoms and bodies
    contact_geoms: tuple[str, ...]  # in the order of the columns "contact"
    site_geoms: dict[str, tuple[str, ...]]  # site of ``sites`` -> geoms
    terrain: Terrain | None  # None: the plane
    overrides: list[str]  # a line for each dropped, added or changed thing; warnings start with "warning: "
    imu: str  # site of the accelerometer, on the root and with its axes
    pose: tuple[float, ...]  # (D,) [rad] from the caller, else from the keyframe
    held: tuple[str, ...]  # welded joints of the file
    speed_limits: tuple[float, ...]  # (D,) [rad/s] of the motors, not simulated; infinite without a limit
    tables: dict[str, list[float]]  # name of the caller's table -> (D,) values
    keyframe: Keyframe | None  # of the file
    file_sensors: tuple[str, ...]  # sensors of the file; only ``more_sensors`` and contact sensors are kept

    @property
    def joint_range(self) -> np.ndarray:
        """(D, 2) [rad]; infinite without a range in the MJCF."""
        return np.where(self.physics.jnt_limited[1:, None] > 0, self.physics.jnt_range[1:], [-np.inf, np.inf])

    @property
    def effort_range(self) -> np.ndarray:
        """(D, 2) [N m]; infinite without a force limit in the MJCF."""
        return np.where(
            self.physics.actuator_forcelimited[:, None] > 0, self.physics.actuator_forcerange, [-np.inf, np.inf]
        )

    @property
    def least_contact_time(self) -> float:
        """Two time steps [s]: MuJoCo takes a shorter time constant of a contact (solref) as this, if so flagged."""
        held = not self.physics.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_REFSAFE
        return 2.0 * self.physics.opt.timestep if held else 0.0

    def ground_geoms(self) -> slice:
        """Indices of the ground's geoms; all are geoms of the world body."""
        names = [self.physics.geom(i).name for i in range(int(self.physics.body_geomnum[0]))]
        first = names.index(GROUND)
        return slice(first, first + sum(name == GROUND or name.startswith(f"{GROUND}/") for name in names))

    def columns(self, sensor: str) -> slice:
        """Columns of ``sensor`` in sensordata."""
        index = self.id("sensor", sensor)
        start = int(self.physics.sensor_adr[index])
        return slice(start, start + int(self.physics.sensor_dim[index]))

    def id(self, kind: str, name: str) -> int:
        """Index of the ``kind`` (body, geom, site or sensor) called ``name``. Raises ModelError if there is none."""
        obj = getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")
        index = mujoco.mj_name2id(self.physics, obj, name)
        if index < 0:
            count = getattr(self.physics, f"n{kind}")
            names = [mujoco.mj_id2name(self.physics, obj, i) for i in range(count)]
            raise ModelError(unknown(kind, name, [n for n in names if n], "the model"))
        return index


def build_model(
    file: Path,
    *,
    solver: Solver,
    ground: Ground,
    stiffness: Mapping[str, float],  # as for per_joint: position gain [N m/rad]
    damping: Mapping[str, float],  # as for per_joint: passive joint damping [N m s/rad]
    colliders: Sequence[str],  # geoms that touch the ground: names of geoms or bodies, or patterns with * and ?
    self_collisions: bool,
    contact_geoms: Sequence[str],  # geoms with a ground contact sensor: names or patterns, as for colliders
    imu_site: str,  # site of the accelerometer, in the root's axes [m/s^2]; see sensed_site
    # site with a sensor of linear velocity, world frame [m/s] -> geoms (names or patterns) for it, if the file lacks it
    sites: Mapping[str, Sequence[str]] = {},
    pose: Mapping[str, float] | None = None,  # as for per_joint: angles [rad], over the keyframe's; None: these, or 0
    tables: Mapping[str, Mapping[str, float]] = {},  # name -> table, as for per_joint, for ``RobotModel.tables``
    held_joints: Sequence[str] = (),  # names or patterns of joints that are welded at the pose
    partial: Mapping[str, Mapping[str, float]] = {},  # tables of PARTIAL, as for some_joints; they override the file
    more_sensors: Collection[str] = (),  # additional sensors: names of SENSORS, or of the file's sensors
    drive: Drive = "angle",  # meaning of ``ctrl``; servos.CURVE in ``tables`` gives motors torque-speed curves
) -> RobotModel:
    """Compile the MJCF or URDF ``file`` for simulation. Raises ModelError."""
    robot = read_file(file, more_sensors)
    spec, notes, root = robot.spec, robot.notes, robot.root
    with naming(file):
        posed = pose_joints(robot, {"stiffness": stiffness, "damping": damping, **tables}, pose, held_joints)
        names = _name_geoms(spec, robot.where, notes, robot.lost)
        imu = sensed_site(robot, posed.model, imu_site)
        _fuse_fixed(spec, notes)
        _set_options(spec, solver, notes)
        add_ground(spec, ground, notes)
        _set_collisions(spec, names, colliders, self_collisions, notes)
        if self_collisions:
            _leave_out_neighbours(spec, posed.angles, notes)
        speeds = set_machine(robot, partial, posed, drive)
        site_geoms = {name: names.find(geoms, "sites") for name, geoms in sites.items()}
        add_sites(spec, site_geoms, posed.angles, robot.where, notes)
        touching = names.find(contact_geoms, "contact_geoms")
        add_sensors(spec, touching, [*sites], imu)
        whole = spec.copy()
        add_more_sensors(spec, root, touching, more_sensors)
        physics = _compile_bare(spec, ground, notes)
    return RobotModel(
        physics=physics,
        root=root,
        joint_names=tuple(posed.joints),
        sensors=sensor_spans(physics, more_sensors),
        spec=whole,
        names=names,
        contact_geoms=touching,
        site_geoms=site_geoms,
        terrain=ground.terrain,
        overrides=notes,
        imu=imu,
        pose=tuple(posed.angles),
        held=tuple(posed.held),
        speed_limits=speeds,
        tables=posed.tables,
        keyframe=robot.keyframe,
        file_sensors=robot.sensors,
    )


def read_file(file: Path, wanted: Collection[str] = ()) -> RobotFile:
    """Read the robot in ``file`` with its ``wanted`` sensors. Raises ModelError if it is not a robot."""
    robot = read_plain(file)
    if robot is None:
        from legged_mw.robot.vendor import read_robot  # this file is not plain

        return read_robot(file, wanted)
    return robot


def _fuse_fixed(spec: mujoco.MjSpec, notes: list[str]) -> None:
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


def _compile_bare(spec: mujoco.MjSpec, ground: Ground, notes: list[str]) -> mujoco.MjModel:
    """Compile the model without visual geoms, lights and cameras."""
    spec.compiler.discardvisual = True
    for extra in [*spec.lights, *spec.cameras]:  # mujoco-warp moves lights in every step
        spec.delete(extra)
    if ground.terrain and ground.boxes:
        replace_level_pieces(spec, ground.terrain, notes)
    return spec.compile()


def _set_options(spec: mujoco.MjSpec, solver: Solver, notes: list[str]) -> None:
    wanted = {
        "timestep": solver.timestep,
        "iterations": solver.iterations,
        "ls_iterations": solver.ls_iterations,
        "solver": mujoco.mjtSolver.mjSOL_NEWTON,
        "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "integrator": _INTEGRATORS[solver.integrator],
        "impratio": 1.0,  # other values are only for the elliptic cone
        "noslip_iterations": 0,  # mujoco-warp does not have it
        "enableflags": 0,
        # explicit joint damping with Euler; implicitfast ignores this flag
        "disableflags": spec.option.disableflags & ~_SWITCHED_OFF | mujoco.mjtDisableBit.mjDSBL_EULERDAMP.value,
    }
    for name, value in wanted.items():
        old = getattr(spec.option, name)
        if old != value:
            notes.append(f"option {name}: {_option(name, old)} -> {_option(name, value)}")
            setattr(spec.option, name, value)


def _option(name: str, value: float) -> str:
    """The value of an option as text, with the names of MJCF."""
    if name not in _ENUMS:
        return f"{value:g}"
    members = [(word, member.value) for word, member in _ENUMS[name].__members__.items() if "_" in word]
    fits = [word for word, bit in members if (int(value) & bit if name in _FLAGS else int(value) == bit)]
    return " ".join(word.split("_")[1].lower() for word in fits) or "none"


def _set_collisions(
    spec: mujoco.MjSpec, names: GeomNames, patterns: Sequence[str], self_collisions: bool, notes: list[str]
) -> None:
    """Set contype and conaffinity: ground contype 1, colliders conaffinity 1; self-collisions: bit 2 in both."""
    colliders = names.find(patterns, "colliders", colliding=True)
    notes += names.passed_over(patterns)
    robot = [g for g in spec.geoms if g.name != GROUND and (g.contype or g.conaffinity)]
    off = []
    for geom in robot:
        if geom.priority > 0:
            notes.append(f"geom '{geom.name}' priority: {geom.priority} -> 0, so that the ground's friction wins")
            geom.priority = 0
        touches = geom.name in colliders
        geom.contype = 2 if self_collisions and touches else 0
        geom.conaffinity = (3 if self_collisions else 1) if touches else 0
        if not touches:
            off.append(geom.name)
    if off:
        notes.append(f"collisions off: {', '.join(off)}")


def _leave_out_neighbours(spec: mujoco.MjSpec, angles: Sequence[float], notes: list[str]) -> None:
    """Exclude collisions of bodies that overlap at the joint angles ``angles`` (D,) [rad].

    MuJoCo already excludes bodies that are connected by a joint.
    """
    for geom in [geom for geom in spec.geoms if geom.contype]:  # an exclusion needs names of bodies
        geom.parent.name = geom.parent.name or f"body_of_{geom.name}"
    copy = spec.copy()
    copy.delete(copy.geom(GROUND))
    model = copy.compile()
    data = posed(model, angles)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    touching = {tuple(sorted(int(model.geom_bodyid[geom]) for geom in contact.geom)) for contact in data.contact}
    pairs = [tuple(model.body(body).name for body in pair) for pair in sorted(touching)]
    for first, second in pairs:
        spec.add_exclude(bodyname1=first, bodyname2=second)
    notes.append("self-collisions: bodies that a joint joins pass through one another")
    if pairs:
        overlapping = ", ".join(f"'{first}' and '{second}'" for first, second in pairs)
        notes.append(f"self-collisions left out, as they overlap in the pose: {overlapping}")


# ---- geoms by name


@dataclass(frozen=True)
class GeomNames:
    """Names of the geoms and bodies in a robot's file, including bodies that are fused later.

    A geom is meant by its own name, by that of a body (all its colliding geoms), or by a pattern with * and ?.
    """

    where: str  # name of the file
    geoms: tuple[str, ...]  # all geoms with a name
    colliding: tuple[str, ...]  # geoms that may collide
    bodies: dict[str, tuple[str, ...]]  # body -> its colliding geoms; without any, those of bodies fixed to it
    lost: Mapping[str, str]  # ``RobotFile.lost``

    def find(self, patterns: Sequence[str], what: str, colliding: bool = False) -> tuple[str, ...]:
        """The geoms that match ``patterns``, each once, in their order; with ``colliding`` only colliding ones.

        A name is first looked up among geoms, then among bodies. ``what``: name of the caller's parameter, for a
        ModelError. A pattern with * or ? does not need to match ``lost`` colliders.
        """
        matches: dict[str, None] = {}
        geoms = self.colliding if colliding else self.geoms
        for pattern in patterns:
            hits = [name for name in geoms if fnmatchcase(name, pattern)]
            bodies = [] if hits else [name for name in self.bodies if fnmatchcase(name, pattern)]
            hits += [geom for body in bodies for geom in self.bodies[body]]
            if not hits:
                for name in [name for name in self.lost if fnmatchcase(name, pattern)]:
                    raise ModelError.of((what, self.lost[name]))
                raise ModelError.of((what, self._no_geom(pattern, geoms, bodies, colliding)))
            matches |= dict.fromkeys(hits)
        return tuple(matches)

    def passed_over(self, patterns: Sequence[str]) -> list[str]:
        """A warning for each ``lost`` collider that matches one of ``patterns``."""
        fitting = [text for name, text in self.lost.items() if any(fnmatchcase(name, pattern) for pattern in patterns)]
        return [f"warning: {text}" for text in dict.fromkeys(fitting)]

    def _no_geom(self, pattern: str, geoms: Sequence[str], bodies: Sequence[str], colliding: bool) -> str:
        """Message for a ``pattern`` that matches no geom. ``bodies``: the bodies that it matches."""
        if bodies:
            have = ", ".join(name for name, own in self.bodies.items() if own) or "none"
            return f"body '{bodies[0]}' of {self.where} has no geom that collides; bodies that have: {have}"
        kind = "colliding geom or body" if colliding else "geom or body"
        text = unknown(kind, pattern, [*geoms, *self.bodies], self.where).partition("there are: ")[0]
        return f"{text}there are: geoms {', '.join(geoms) or 'none'}; bodies {', '.join(self.bodies)}"


def _name_geoms(spec: mujoco.MjSpec, where: str, notes: list[str], lost: Mapping[str, str]) -> GeomNames:
    """Give unnamed colliding geoms the name ``<body>_<number>``, and collect all names."""
    taken = {geom.name for geom in spec.geoms}
    for body in spec.bodies:
        for number, geom in enumerate(body.geoms):
            name = f"{body.name or 'body'}_{number}"
            if geom.name or not _collides(geom):
                continue
            while name in taken:
                name += "_"
            geom.name = name
            taken.add(name)
            notes.append(f"geom of '{body.name}' without a name is called '{name}'")
    named = [geom for geom in spec.geoms if geom.name]
    colliding = [geom.name for geom in named if _collides(geom)]
    bodies = {body.name: tuple(_own(body) or _fixed_to(body)) for body in spec.bodies[1:] if body.name}
    return GeomNames(where, tuple(geom.name for geom in named), tuple(colliding), bodies, lost)


def _collides(geom: mujoco.MjsGeom) -> bool:
    return bool(geom.contype or geom.conaffinity)


def _own(body: mujoco.MjsBody) -> list[str]:
    return [geom.name for geom in body.geoms if _collides(geom)]


def _fixed_to(body: mujoco.MjsBody) -> list[str]:
    """Names of the colliding geoms of bodies that are fixed to ``body``."""
    fixed = [child for child in body.bodies if not child.joints]
    return [name for child in fixed for name in (*_own(child), *_fixed_to(child))]


# ---- the standing robot


class Upright(NamedTuple):
    """S sites of a robot with an upright root."""

    places: np.ndarray  # (S, 3) positions in the root frame [m]
    bodies: np.ndarray  # (S,) indices of the sites' bodies
    up: np.ndarray  # (S, 3) vertical in the frame of each site's body


def upright(robot: RobotModel, joints: Sequence[float], sites: Sequence[str]) -> Upright:
    """Positions of ``sites`` with an upright root and joint angles ``joints`` (D,) [rad]."""
    model, data = robot.physics, posed(robot.physics, joints)
    where = [robot.id("site", name) for name in sites]
    bodies = model.site_bodyid[where]
    return Upright(data.site_xpos[where].copy(), bodies.copy(), data.xmat[bodies].reshape(-1, 3, 3)[:, 2].copy())


def standing_height(robot: RobotModel, geoms: Sequence[str], joints: Sequence[float]) -> float:
    """Height [m] of an upright root above the lowest point of ``geoms``, with joint angles ``joints`` (D,) [rad]."""
    points = surfaces(robot.physics, posed(robot.physics, joints), geoms)
    return -float(min(places[:, 2].min() for places in points.values()))
