"""Compute the numbers of a robot's health page with MuJoCo on a CPU: standing, stability of its servos, initial gains.

Shapes: D joints, V degrees of freedom (the first 6 are the root's), P points. Independent of configs and tasks.

The servo of one joint with inertia I and time step dt is
v' = v - d v - s x / dt, x' = x + dt v', with d = dt kd / I and s = dt^2 kp / I.
Its characteristic polynomial is z^2 - (2 - s - d) z + (1 - d). By Jury's conditions it is stable for 0 < d < 2 and
2 d + s < 4: without damping dt sqrt(kp / I) < 2, without stiffness dt kd / I < 2. For d > 1 the damping alone changes
the sign of the velocity in every substep: the joint rings. The integrator implicitfast uses v' in place of v in the
damping. Then it is stable for any d and s < 4 + 2 d.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.sim.capacity import Capacity, count_capacity
from legged_mw.sim.engines import make_simulation
from legged_mw.sim.joints import family, posed
from legged_mw.sim.model import RobotModel
from legged_mw.sim.robot_file import tilt

FloatArray = NDArray[np.float64]

STAND_SECONDS = 5.0  # [s] duration of the standing test
STAND_TILT = 60.0  # [deg] a larger tilt of the root is a fall
STAND_HEIGHT = 0.5  # share of the initial height; the robot sinks if it is lower
TOPPLED = 15.0  # [deg] with a larger tilt, the rigid robot does not rest on its feet
GRAVITY = 9.81  # [m/s^2]
_STIFF = 1e5  # [kg m^2] armature that locks a joint: 100 N m accelerate it by 1 mrad/s^2
_FAST = 1.0e4  # [m/s, rad/s] a faster state has diverged (termination.max_speed)


class Rest(NamedTuple):
    """The robot with locked joints, at rest on level ground."""

    qpos: FloatArray  # (7 + D,)
    torque: FloatArray  # (D,) [N m] joint torques that hold the pose
    points: FloatArray  # (P, 3) [m] contact points on the ground
    com: FloatArray  # (3,) centre of mass [m]
    contacts: int
    rows: int  # constraint rows of the simulated model: contacts, dry friction, active limits
    toppled: bool  # whether the robot falls over; if so, torque and points are computed with the root held upright


class Joint(NamedTuple):
    """The properties of a joint and its servo, and the servo's stability."""

    name: str
    low: float  # [rad]
    high: float  # [rad]; both infinite without limits
    effort: float  # [N m]
    speed: float  # [rad/s]; infinite if unknown
    armature: float  # [kg m^2]
    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]
    inertia: float  # [kg m^2] smallest inertia over the poses, with all other joints free
    pose: str  # the pose with this inertia
    held: float  # [kg m^2] inertia in the default pose with all other joints locked: diagonal of the mass matrix
    torque: float  # [N m] at rest

    def damping_step(self, dt: float) -> float:
        """dt kd / I"""
        return dt * self.kd / self.inertia

    def stiffness_step(self, dt: float) -> float:
        """dt sqrt(kp / I)"""
        return dt * math.sqrt(self.kp / self.inertia)

    def damping_ratio(self) -> float:
        """kd / (2 sqrt(kp I)); infinite without stiffness."""
        return self.kd / (2.0 * math.sqrt(self.kp * self.inertia)) if self.kp else math.inf

    def sag(self) -> float:
        """Position error at rest [rad]; infinite without stiffness."""
        return abs(self.torque) / self.kp if self.kp else math.inf

    def verdict(self, dt: float, implicit: bool) -> str:
        """The servo's stability at time step ``dt``: "" (stable), "rings" or "unstable"; see the top of this file."""
        d, s = self.damping_step(dt), self.stiffness_step(dt) ** 2
        if s >= 4.0 + 2.0 * d if implicit else (d >= 2.0 or 2.0 * d + s >= 4.0):
            return "unstable"
        return "rings" if d > 1.0 and not implicit else ""


class Mode(NamedTuple):
    """The fastest growing mode of the robot with all servos, without ground contact."""

    growth: float  # factor per substep; 1 belongs to the undamped free root
    joints: tuple[str, ...]  # joints with the largest amplitude


class Stand(NamedTuple):
    """The result of the standing test: the servos hold the pose of action zero."""

    seconds: float  # time until the robot fell, sank or diverged; else STAND_SECONDS
    end: str  # "stands", "falls", "sinks" or "diverges"
    joints: tuple[str, ...] = ()  # the fastest joints, if it diverges


@dataclass(frozen=True)
class RobotNumbers:
    """All numbers of the health page."""

    mass: float  # [kg]
    height: float  # [m] height of the root above the ground, at rest
    top: float  # [m] height of the robot's highest point
    margin: float  # [m] from the centre of mass to the edge of the support polygon; negative: outside
    rest: Rest
    joints: tuple[Joint, ...]
    mode: Mode
    stand: Stand
    dt: float  # [s] substep
    implicit: bool  # whether the integrator is implicitfast
    room: Capacity  # capacity for contacts and constraint rows in mujoco-warp

    @property
    def moment(self) -> float:
        """Weight times the height of the root [N m], for ``suggest``."""
        return GRAVITY * self.mass * self.height


def measure(
    robot: RobotModel, pose: Sequence[float], place: Sequence[float], decimation: int = 5, rough: bool = False
) -> RobotNumbers:
    """The numbers of ``robot`` in ``pose`` (D,) [rad], upright on level ground, with its root at ``place`` (3,) [m].

    ``rough``: compute the buffer capacity for rough terrain.
    """
    model, angles = robot.physics, np.array(pose, dtype=float)
    rest = stand_as_statue(robot, angles, np.array(place, dtype=float))
    matrices = mass_matrices(robot, angles)
    implicit = model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return RobotNumbers(
        mass=float(model.body_subtreemass[0]),
        height=float(rest.qpos[2]),
        top=_highest(robot, rest.qpos),
        margin=inside_by(rest.points[:, :2], rest.com[:2]),
        rest=rest,
        joints=what_joints_bear(robot, matrices, rest.torque),
        mode=max((fastest_mode(robot, matrix, implicit) for matrix in matrices.values()), key=lambda mode: mode.growth),
        stand=stand_on_servos(robot, angles, place, decimation),
        dt=float(model.opt.timestep),
        implicit=implicit,
        room=count_capacity(model, terrain=rough),
    )


# ---- at rest ----


def stand_as_statue(robot: RobotModel, pose: FloatArray, place: FloatArray) -> Rest:
    """Lower the robot onto level ground with its joints locked in ``pose`` (D,), until it rests."""
    free = _settle(robot, pose, place, upright=False)
    if toppled := tilt(free.qpos[3:7]) > TOPPLED:
        free = _settle(robot, pose, place, upright=True)
    model, data = robot.physics, mujoco.MjData(robot.physics)
    data.qpos[:] = free.qpos
    mujoco.mj_forward(model, data)
    torque = free.qfrc_bias - free.qfrc_constraint - free.qfrc_spring  # the servo torques at zero acceleration
    ground = robot.ground_geoms()
    touching = [c.pos for c in free.contact if any(ground.start <= geom < ground.stop for geom in c.geom)]
    points = np.array(touching).reshape(-1, 3)
    return Rest(free.qpos.copy(), torque[6:].copy(), points, free.subtree_com[0].copy(), data.ncon, data.nefc, toppled)


def _settle(robot: RobotModel, pose: FloatArray, place: FloatArray, upright: bool) -> mujoco.MjData:
    model = copy.copy(robot.physics)
    model.opt.timestep, model.opt.iterations, model.opt.ls_iterations = 0.002, 50, 50
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_AUTORESET
    model.dof_frictionloss[:], model.jnt_limited[:] = 0.0, 0  # switch off all other sources of joint torque
    model.dof_armature[6:] = _STIFF
    if upright:
        model.dof_armature[3:6] = _STIFF
    mass, size = float(model.body_subtreemass[0]), max(float(place[2]), 0.1)
    model.dof_damping[:6] = [10.0 * mass] * 3 + [3.0 * mass * size**2] * 3  # the robot is at rest within a second
    data = mujoco.MjData(model)
    data.qpos[:] = [*place, 1.0, 0.0, 0.0, 0.0, *pose]
    for _ in range(20):
        mujoco.mj_step(model, data, 100)
        if np.abs(data.qvel[:6]).max() < 1e-4 or tilt(data.qpos[3:7]) > TOPPLED:
            break
    mujoco.mj_forward(model, data)
    return data


def _corners(points: FloatArray) -> FloatArray:
    """The corners (C, 2) of the convex hull of ``points`` (P, 2): Andrew's monotone chain."""
    ordered = np.unique(points, axis=0)
    corners = list[FloatArray]()
    for side in (ordered, ordered[::-1]):
        chain = list[FloatArray]()
        for point in side:
            while len(chain) > 1 and _turn(chain[-2], chain[-1], point) <= 0.0:
                chain.pop()
            chain.append(point)
        corners += chain[:-1]
    return np.array(corners or [points[0]])


def _turn(a: FloatArray, b: FloatArray, c: FloatArray) -> float:
    """Positive if the path from a over b to c, (2,) each, turns left."""
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def inside_by(points: FloatArray, place: FloatArray) -> float:
    """The distance [m] of ``place`` (2,) to the edge of the convex hull of ``points`` (P, 2) [m]; negative if outside.

    It is the smallest support distance of the hull from ``place`` over all directions. The direction of the minimum is
    normal to a line through two of the points, or along the line from a point to ``place``.
    """
    if not len(points):
        return -math.inf
    away = (_corners(points) if len(points) > 32 else points) - place  # corners: the number of pairs is quadratic
    ways = np.concatenate([(away[:, None] - away[None]).reshape(-1, 2) @ [[0.0, 1.0], [-1.0, 0.0]], -away])
    lengths = np.linalg.norm(ways, axis=1)
    ways = ways[lengths > 1e-9] / lengths[lengths > 1e-9, None]
    return float((ways @ away.T).max(axis=1).min()) if len(ways) else 0.0


def _highest(robot: RobotModel, qpos: FloatArray) -> float:
    """The height [m] of the highest point of the robot's geoms, visual geoms included."""
    model = robot.spec.copy().compile()
    data = posed(model, qpos[7:], qpos[:7])
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid])
    upwards, box = data.geom_xmat[geoms, 6:], model.geom_aabb[geoms]
    tops = data.geom_xpos[geoms, 2] + (upwards * box[:, :3]).sum(axis=1) + (np.abs(upwards) * box[:, 3:]).sum(axis=1)
    return float(tops.max(initial=0.0))


# ---- servos ----


def mass_matrices(robot: RobotModel, pose: FloatArray) -> dict[str, FloatArray]:
    """Mass matrices (V, V) with armature, for four poses with an upright root.

    "default" is ``pose`` (D,) [rad]. "low", "middle" and "high" have all joints at that point of their ranges. A joint
    without limits has the range ``pose`` +- 1 rad.
    """
    limited = robot.physics.jnt_limited[1:] > 0
    low, high = robot.joint_range.T
    low, high = np.where(limited, low, pose - 1.0), np.where(limited, high, pose + 1.0)
    poses = {"default": pose, "low": low, "middle": (low + high) / 2, "high": high}
    return {name: _mass_matrix(robot.physics, each) for name, each in poses.items()}


def _mass_matrix(model: mujoco.MjModel, pose: FloatArray) -> FloatArray:
    data, matrix = posed(model, pose), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return matrix


def what_joints_bear(robot: RobotModel, matrices: dict[str, FloatArray], torque: FloatArray) -> tuple[Joint, ...]:
    """The properties of each joint, from ``mass_matrices`` and its ``torque`` (D,) at rest [N m]."""
    model, rows = robot.physics, []
    free = {name: 1.0 / np.diag(np.linalg.inv(matrix)) for name, matrix in matrices.items()}
    for i, name in enumerate(robot.joint_names):
        dof = 6 + i
        pose = min(free, key=lambda each, dof=dof: float(free[each][dof]))
        low, high = robot.joint_range[i]
        rows.append(
            Joint(
                *(
                    name,
                    float(low),
                    float(high),
                    float(robot.effort_range[i, 1]),
                    robot.speed_limits[i],
                    float(model.dof_armature[dof]),
                ),
                *(robot.tables["stiffness"][i], robot.tables["damping"][i]),
                *(float(free[pose][dof]), pose, float(matrices["default"][dof, dof]), float(torque[i])),
            )
        )
    return tuple(rows)


def fastest_mode(robot: RobotModel, matrix: FloatArray, implicit: bool) -> Mode:
    """The fastest growing mode of all joints per substep, without contact, from the mass ``matrix`` (V, V)."""
    model, size = robot.physics, len(matrix)
    dt = float(model.opt.timestep)
    stiffness = np.diag([0.0] * 6 + [*(np.array(robot.tables["stiffness"]) + model.jnt_stiffness[1:])])
    damping = np.diag([0.0] * 6 + robot.tables["damping"])
    left, right = (matrix + dt * damping, matrix) if implicit else (matrix, matrix - dt * damping)
    onto_x, onto_v = np.linalg.solve(left, -dt * stiffness), np.linalg.solve(left, right)
    step = np.block([[np.eye(size) + dt * onto_x, dt * onto_v], [onto_x, onto_v]])
    values, vectors = np.linalg.eig(step)
    worst = int(np.abs(values).argmax())
    share = np.abs(vectors[size + 6 :, worst])
    order = np.argsort(-share)[:2]
    return Mode(
        float(abs(values[worst])), tuple(robot.joint_names[i] for i in order if share[i] > 0.3 * share[order[0]])
    )


def stand_on_servos(robot: RobotModel, pose: FloatArray, place: Sequence[float], decimation: int) -> Stand:
    """Simulate the robot from ``pose`` (D,) [rad] with servo targets at ``pose``, like a task with action zero."""
    sim = make_simulation(robot.physics, 1, "cpu", engine="mujoco", nconmax=0, njmax=0)
    qpos, qvel = sim.qpos.numpy()[0], sim.qvel.numpy()[0]
    qpos[:], sim.ctrl.numpy()[0] = [*place, 1.0, 0.0, 0.0, 0.0, *pose], pose
    control_step = decimation * float(robot.physics.opt.timestep)
    speed = np.zeros(len(robot.joint_names))
    for step in range(1, round(STAND_SECONDS / control_step) + 1):
        sim.step(decimation)
        seconds = step * control_step
        if not np.isfinite(qpos).all() or not np.abs(qvel).max() <= _FAST:
            joints = np.abs(qvel[6:]) if np.isfinite(qvel).all() else speed
            return Stand(seconds, "diverges", tuple(robot.joint_names[i] for i in np.argsort(-joints)[:3]))
        speed = np.abs(qvel[6:]).copy()
        if tilt(qpos[3:7]) > STAND_TILT:
            return Stand(seconds, "falls")
        if qpos[2] < STAND_HEIGHT * place[2]:
            return Stand(seconds, "sinks")
    return Stand(STAND_SECONDS, "stands")


# ---- initial gains: our rules ----

UPRIGHT = 0.4  # servo torque at 1 rad / (robot's weight x height of the root)
LOAD, SAG = 2.0, 0.4  # factor on the torque at rest; largest position error [rad] at that torque
SWING = 2.0  # [Hz] natural frequency of a limb
DAMPING_TIME = 0.025  # [s] kd / kp
MOST = 0.5  # largest dt sqrt(kp / I) and dt kd / I for explicit Euler


class Gains(NamedTuple):
    """The gains of one joint."""

    kp: float  # [N m/rad]
    kd: float  # [N m s/rad]


def suggest(joints: Sequence[Joint], moment: float, firmness: float = 1.0) -> list[Gains]:
    """Gains for each joint: ``firmness`` times the rules. Left and right joints of a pair get equal gains.

    ``moment`` [N m]: the robot's weight times the height of its root. Published gains grow with the motor's effort and
    with the moment. So kp [N m/rad] is the geometric mean of effort / 1 rad and 0.4 moment / 1 rad. Its lower bound
    holds twice the torque at rest with an error of 0.4 rad, because half of the feet carry a walking robot. If the
    effort is unknown, kp is this bound, or the kp of a limb with a natural frequency of 2 Hz if that is larger. kd [N m
    s/rad] is 25 ms x kp. docs/your_own_robot.md compares these gains with published gains.
    """
    stiffness = [firmness * _wanted(joint, moment) for joint in joints]
    gains = []
    for joint in joints:
        same_family = [i for i, other in enumerate(joints) if family(other.name) == family(joint.name)]
        kp = _round(max(stiffness[i] for i in same_family))
        gains.append(Gains(kp, _round(DAMPING_TIME * kp)))
    return gains


def beyond_euler(joints: Sequence[Joint], gains: Sequence[Gains], dt: float) -> list[Joint]:
    """The joints whose ``gains`` need the integrator implicitfast, because they exceed MOST at substep ``dt`` [s]."""
    with_gains = [joint._replace(kp=gain.kp, kd=gain.kd) for joint, gain in zip(joints, gains, strict=True)]
    return [joint for joint in with_gains if max(joint.stiffness_step(dt), joint.damping_step(dt)) > MOST]


def _wanted(joint: Joint, moment: float) -> float:
    load = LOAD * abs(joint.torque) / SAG
    if math.isfinite(joint.effort):
        return max(math.sqrt(joint.effort * UPRIGHT * moment), load)
    return max(joint.held * (2.0 * math.pi * SWING) ** 2, load)


def _round(value: float) -> float:
    """Round to two significant digits."""
    return float(f"{value:.2g}")
