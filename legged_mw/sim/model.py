"""From a robot's file to a compiled model, with ground, motors and sensors. Host only; nothing is stepped.

The file states facts of the machine (mass, geometry, joint range, armature, friction, force limit). The caller's
numbers state choices (gains, ground, what collides, what is sensed). Every name in a choice must match something in the
file. ``RobotModel.overrides`` lists what a choice changes.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from legged_mw.sim.fixed_bodies import fuse_fixed, sensed_site
from legged_mw.sim.geom_names import GeomNames, name_geoms
from legged_mw.sim.ground import GROUND, Ground, add_ground, replace_level_pieces
from legged_mw.sim.joints import PosedRobot, pose_joints, posed, set_machine
from legged_mw.sim.robot_file import Keyframe, RobotFile, naming, read_plain
from legged_mw.sim.sensors import add_more_sensors, add_sensors, sensor_spans
from legged_mw.sim.servos import Drive
from legged_mw.sim.surface_points import add_sites, surfaces
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.errors import ModelError, unknown

# option -> its values
_CHOICES = {"integrator": mujoco.mjtIntegrator, "cone": mujoco.mjtCone, "solver": mujoco.mjtSolver}
_FLAGS = {"disableflags": mujoco.mjtDisableBit, "enableflags": mujoco.mjtEnableBit}
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
    sensors: dict[str, slice]  # "contact", "linvel", "accelerometer", and what more was asked for -> span of sensordata
    spec: mujoco.MjSpec  # the same with visual geoms, without ``more_sensors``: to copy, never to change
    names: GeomNames  # of geoms and bodies
    contact_geoms: tuple[str, ...] = ()  # in order of the span "contact"
    site_geoms: dict[str, tuple[str, ...]] = field(default_factory=dict)  # of each site that was asked for with geoms
    terrain: Terrain | None = None  # None: the plane
    # what was dropped, added or changed, a line each; "warning: ..." needs the caller
    overrides: list[str] = field(default_factory=list)
    imu: str = ""  # site whose accelerometer is sensed, on the root and with its axes
    pose: tuple[float, ...] = ()  # (D,) the caller's, or else the keyframe's [rad]
    held: tuple[str, ...] = ()  # joints of the file that are welded
    # (D,) of the motors, unknown to the physics [rad/s]; infinite where nothing states one
    speed_limits: tuple[float, ...] = ()
    tables: dict[str, list[float]] = field(default_factory=dict)  # (D,) each, of the tables that were given
    keyframe: Keyframe | None = None  # the file's
    # names of its sensors, of which ``more_sensors`` are kept, and those that feel contact
    file_sensors: tuple[str, ...] = ()

    @property
    def joint_range(self) -> np.ndarray:
        """(D, 2) [rad]; infinite where the MJCF states none."""
        return np.where(self.physics.jnt_limited[1:, None] > 0, self.physics.jnt_range[1:], [-np.inf, np.inf])

    @property
    def effort_range(self) -> np.ndarray:
        """(D, 2) [N m]; infinite where the MJCF states none."""
        return np.where(
            self.physics.actuator_forcelimited[:, None] > 0, self.physics.actuator_forcerange, [-np.inf, np.inf]
        )

    def ground_geoms(self) -> slice:
        """Indices of the geoms that are the ground: MuJoCo counts geoms body by body, and these are the world's."""
        count = int(self.physics.body_geomnum[0])
        names = [self.physics.geom(i).name for i in range(count)]
        first = names.index(GROUND)
        return slice(first, first + sum(name == GROUND or name.startswith(f"{GROUND}/") for name in names))

    def columns(self, sensor: str) -> slice:
        """Columns of sensordata of the sensor called so."""
        index = self.id("sensor", sensor)
        start = int(self.physics.sensor_adr[index])
        return slice(start, start + int(self.physics.sensor_dim[index]))

    def id(self, kind: str, name: str) -> int:
        """Index of the ``kind`` ("body", "geom", "site", "sensor") called ``name``."""
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
    contact_geoms: Sequence[str],  # sensed: number of contacts with the ground; likewise, each geom once
    velocity_sites: Sequence[str],  # sensed: linear velocity, world frame [m/s]
    imu_site: str
    | None,  # sensed: acceleration in the root's axes [m/s^2]; see fixed_bodies.sensed_site; None: not at all
    sites: Mapping[str, Sequence[str]] | None = None,  # name -> geoms, likewise, for a site that the file lacks
    pose: Mapping[str, float] | None = None,  # as for per_joint: angles [rad], before the keyframe's; None: those, or 0
    tables: Mapping[str, Mapping[str, float]] = {},  # what -> a table, as for per_joint: for ``RobotModel.tables``
    held_joints: Sequence[str] = (),  # names or patterns: welded at the pose
    partial: Mapping[str, Mapping[str, float]]
    | None = None,  # tables of PARTIAL, as for some_joints: they win over the file
    more_sensors: Collection[str] = (),  # what else is sensed: names of sensors.py, or of the file's own sensors
    drive: Drive = "angle",  # what `ctrl` means; with servos.CURVE in `tables` motors have torque-speed curves
) -> RobotModel:
    """Compile the MJCF or URDF at ``file`` for stepping."""
    robot = read_file(file, more_sensors)
    spec, notes = robot.spec, robot.notes
    with naming(file):
        posed = pose_joints(robot, {"stiffness": stiffness, "damping": damping, **tables}, pose, held_joints)
        names = name_geoms(spec, robot.where, notes)
        imu = "" if imu_site is None else sensed_site(spec, posed.model, robot.root, imu_site, robot.where, notes)
        fuse_fixed(spec, notes)
        _set_options(spec, solver, notes)
        add_ground(spec, ground, notes)
        _set_collisions(spec, names.find(colliders, "colliders", colliding=True), self_collisions, notes)
        if self_collisions:
            _leave_out_neighbours(spec, posed.joints, posed.angles, notes)
        speeds = set_machine(robot, partial or {}, posed, drive)
        made = {name: names.find(geoms, "sites") for name, geoms in (sites or {}).items()}
        add_sites(spec, made, posed.angles, robot.where, notes)
        touching = names.find(contact_geoms, "contact_geoms")
        return _compile(robot, posed, names, ground, made, touching, velocity_sites, imu, speeds, more_sensors)


def read_file(file: Path, wanted: Collection[str] = ()) -> RobotFile:
    """The robot in ``file``; its own sensors called as ``wanted`` are kept. Raises ModelError for what is no robot."""
    robot = read_plain(file)
    if robot is None:
        from legged_mw.robot.vendor import read_robot  # this file is not plain

        robot = read_robot(file, wanted)
    return robot


def _compile(
    robot: RobotFile,
    posed: PosedRobot,
    names: GeomNames,
    ground: Ground,
    site_geoms: dict[str, tuple[str, ...]],
    touching: tuple[str, ...],
    velocity_sites: Sequence[str],
    imu: str,
    speeds: tuple[float, ...],
    more_sensors: Collection[str],
) -> RobotModel:
    """Add the sensors, and compile what is stepped."""
    add_sensors(robot.spec, touching, velocity_sites, imu, robot.where)
    whole = robot.spec.copy()
    add_more_sensors(robot.spec, robot.root, touching, more_sensors)
    physics = _compile_bare(robot.spec, ground, robot.notes)
    return RobotModel(
        physics=physics,
        root=robot.root,
        joint_names=tuple(posed.joints),
        sensors=sensor_spans(physics, touching, velocity_sites, imu, more_sensors),
        spec=whole,
        names=names,
        contact_geoms=touching,
        site_geoms=site_geoms,
        terrain=ground.terrain,
        overrides=robot.notes,
        imu=imu,
        pose=tuple(posed.angles),
        held=tuple(posed.held),
        speed_limits=speeds,
        tables=posed.tables,
        keyframe=robot.keyframe,
        file_sensors=robot.sensors,
    )


def _compile_bare(spec: mujoco.MjSpec, ground: Ground, notes: list[str]) -> mujoco.MjModel:
    """Compile what is stepped: without visual geoms, lights and cameras."""
    spec.compiler.discardvisual = True
    for extra in [*spec.lights, *spec.cameras]:  # mujoco-warp would move lights in every step
        spec.delete(extra)
    if ground.terrain and ground.boxes:
        replace_level_pieces(spec, ground.terrain, notes)
    return spec.compile()


def _set_options(spec: mujoco.MjSpec, solver: Solver, notes: list[str]) -> None:
    if solver.integrator not in _INTEGRATORS:
        raise ModelError(unknown("integrator", solver.integrator, _INTEGRATORS, "MuJoCo"))
    wanted = {
        "timestep": solver.timestep,
        "iterations": solver.iterations,
        "ls_iterations": solver.ls_iterations,
        "solver": mujoco.mjtSolver.mjSOL_NEWTON,
        "cone": mujoco.mjtCone.mjCONE_PYRAMIDAL,
        "integrator": _INTEGRATORS[solver.integrator],
        "impratio": 1.0,  # what is more is for the elliptic cone
        "noslip_iterations": 0,  # mujoco-warp has no such solver
        "enableflags": 0,
        # Euler's damping stays explicit, as it was trained with; implicitfast does not read this flag
        "disableflags": spec.option.disableflags | mujoco.mjtDisableBit.mjDSBL_EULERDAMP.value,
    }
    for name, value in wanted.items():
        old = getattr(spec.option, name)
        if old != value:
            notes.append(f"option {name}: {_option(name, old)} -> {_option(name, value)}")
            setattr(spec.option, name, value)


def _option(name: str, value: float) -> str:
    """A value of an option in the words of MJCF."""
    if name in _CHOICES:
        return _CHOICES[name](value).name.split("_")[1].lower()
    if name in _FLAGS:
        flags = [
            text.split("_")[1].lower()
            for text, flag in _FLAGS[name].__members__.items()
            if "_" in text and int(value) & flag.value
        ]
        return " ".join(flags) or "none"
    return f"{value:g}"


def _set_collisions(spec: mujoco.MjSpec, colliders: Sequence[str], self_collisions: bool, notes: list[str]) -> None:
    """The ground is contype 1 and colliders have conaffinity 1; with self-collisions both have bit 2 too."""
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


def _leave_out_neighbours(
    spec: mujoco.MjSpec, joints: Sequence[str], angles: Sequence[float], notes: list[str]
) -> None:
    """Exclude pairs of bodies that overlap with ``joints`` at ``angles`` [rad]: they would always push against each other.

    MuJoCo itself leaves out bodies that a joint joins.
    """
    for geom in [geom for geom in spec.geoms if geom.contype]:  # an exclusion needs names
        geom.parent.name = geom.parent.name or f"body_of_{geom.name}"
    copy = spec.copy()
    copy.delete(copy.geom(GROUND))
    model = copy.compile()
    data = mujoco.MjData(model)
    for name, angle in zip(joints, angles, strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    mujoco.mj_kinematics(model, data)
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


# ---- how it stands


class Upright(NamedTuple):
    """S sites of a robot whose root is upright at the world's origin, and their bodies."""

    places: np.ndarray  # (S, 3) of the sites in the root's frame [m]
    bodies: np.ndarray  # (S,) index of each site's body
    up: np.ndarray  # (S, 3) the vertical in the frame of each site's body


def upright(robot: RobotModel, joints: Sequence[float], sites: Sequence[str]) -> Upright:
    """The robot stands upright with its joints at ``joints`` (D,) [rad]: where ``sites`` are then."""
    model, data = robot.physics, posed(robot.physics, joints)
    where = [robot.id("site", name) for name in sites]
    bodies = model.site_bodyid[where]
    return Upright(data.site_xpos[where].copy(), bodies.copy(), data.xmat[bodies].reshape(-1, 3, 3)[:, 2].copy())


def standing_height(robot: RobotModel, geoms: Sequence[str], joints: Sequence[float]) -> float:
    """Height [m] of an upright root above the lowest point of ``geoms``, with the joints at ``joints`` (D,) [rad]."""
    points = surfaces(robot.physics, posed(robot.physics, joints), geoms)
    return -float(min(places[:, 2].min() for places in points.values()))
