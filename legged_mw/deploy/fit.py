"""Fit the parameters of each joint to the log of a chirp: delay, armature, friction, damping, gain, encoder offset.

Each sweep is simulated in MuJoCo's C engine, with the bodies that the joint moves and the bodies that carry it. The
root follows the IMU and the other joints follow their measured angles, so the robot may swing on its rope. Joints
between the IMU and the rope carry what is below them (other_root.py). mujoco.minimize.least_squares minimizes the
error of angles and speeds.
"""

from __future__ import annotations

import argparse
import copy
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import minimize
from mujoco.rollout import Rollout

from legged_mw.deploy.chirp import REST, SLOWEST
from legged_mw.deploy.contract import Contract
from legged_mw.deploy.log import DriveLog, LogError, logged_export
from legged_mw.deploy.other_root import between, motion_of, with_root
from legged_mw.deploy.robot import Floats
from legged_mw.deploy.simulated import read_scene, trunk_of
from legged_mw.deploy.states import CHIRP, STATES
from legged_mw.utils.cli import Parser
from legged_mw.utils.config import save_yaml
from legged_mw.utils.errors import UserError, shown, unknown
from legged_mw.utils.files import typed
from legged_mw.utils.machine import usable_cores

ANGLE, SPEED = 0.001, 0.02  # [rad], [rad/s] ours: scale of the residuals, about the noise of an encoder
HEAVY = 1e6  # [kg], [kg m^2] ours: inertia of the root and of joints with a prescribed motion
SMOOTH = 9  # ours: window of the moving average [measurements], applied before differentiation
EXPECTED = (0.1, 0.01)  # [-], [rad] ours: standard deviations of the prior of gain and encoder offset
TRIES, REFINED = 64, 2  # ours: random starts; number of the best starts that are optimised
BLOCK = 50  # ours: consecutive measurements whose errors may be correlated
NOISE = 1.5  # ours: a residual below this is noise, and no other start is optimised
STEPS, DIFFERENCE, END = 40, 1e-3, 1e-4  # ours: iterations; step and tolerance, in the parameters' scale
SLOW = 0.005  # [s] ours: slower measurements do not determine delay and armature
MOVED, JUMP, EXPLAINED = 0.25, 0.1, 0.99  # [-], [rad], [-] ours: smallest motion; jump; explained variance


class Parameter(NamedTuple):
    """A fitted parameter."""

    name: str
    unit: str
    digits: int
    scale: float  # a significant change, for the optimiser
    low: float
    high: float
    start: tuple[float, float]  # range of the random starts; for the armature a factor on the scene's


PARAMETERS = (
    Parameter("delay", "ms", 1, 1.0, 0.0, 100.0, (0.0, 30.0)),
    Parameter("armature", "kg m^2", 4, 0.01, 1e-4, 1.0, (0.4, 8.0)),
    Parameter("friction", "N m", 3, 0.1, 0.0, 20.0, (0.0, 1.5)),
    Parameter("damping", "N m s/rad", 3, 0.1, 0.0, 20.0, (0.0, 0.6)),
    Parameter("gain", "-", 3, 0.1, 0.2, 3.0, (0.7, 1.3)),
    Parameter("offset", "rad", 4, 0.01, -0.2, 0.2, (0.0, 0.0)),
)
DELAY, ARMATURE, FRICTION, DAMPING, GAIN, OFFSET = range(len(PARAMETERS))
_SCALE, _LOW, _HIGH = (np.array([getattr(each, name) for each in PARAMETERS]) for name in ("scale", "low", "high"))


class Sweep(NamedTuple):
    """The part of a log with one joint's sweep, resampled at equal time steps."""

    joint: int
    begin: Floats  # (D,) [rad] at the start
    time: Floats  # (T,) [s] of the measurements
    angle: Floats  # (T, D) [rad]
    speed: Floats  # (T, D) [rad/s]
    slope: Floats  # (T, 6 + D) acceleration of the root without gravity, and of the joints
    spin: Floats  # (6 + D,) the same speeds at the start
    sent: Floats  # (S,) [s] times of the targets
    target: Floats  # (S,) [rad]


class FittedJoint(NamedTuple):
    """The fitted parameters of one joint, in the order of PARAMETERS, and the error of its simulated sweep."""

    joint: int
    values: Floats  # (6,)
    deviation: Floats  # (6,) standard deviation, from the residual and its derivatives
    before: float  # [rad] RMS error of the angle with the scene's parameters
    after: float  # [rad] with the fitted parameters
    time: Floats  # (T,) [s]
    angles: Floats  # (3, T) [rad] measured, simulated with the scene's parameters, simulated with the fitted ones


@dataclass(frozen=True)
class Fit:
    """The fit of one log."""

    contract: Contract
    recording: DriveLog
    joints: list[FittedJoint]
    seconds: float  # [s] duration of the fit

    @property
    def values(self) -> Floats:
        """(D, 6)"""
        return np.array([each.values for each in self.joints])

    @property
    def deviation(self) -> Floats:
        """(D, 6)"""
        return np.array([each.deviation for each in self.joints])


# ---- the log


def fit_log(path: Path, joints: Sequence[str] = (), leave_out: Sequence[str] = ()) -> Fit:
    """Fit ``joints`` (default: all) of the log, without those whose names contain a part of ``leave_out``.

    Raises LogError, ContractError.
    """
    began = time.monotonic()
    with logged_export(path) as (recording, folder, contract):
        scene = read_scene(folder, contract)
    for part in leave_out:
        if not any(part in name for name in contract.joints):
            raise UserError(f"--leave_out: {unknown('joint', part, contract.joints, shown(path))}")
    selected = [name for name in joints or contract.joints if not any(part in name for part in leave_out)]
    if not selected:
        raise UserError(f"--leave_out: {', '.join(leave_out)} leaves no joint of {shown(path)} to fit")
    sweeps = read_sweeps(path, recording, contract, scene.model, selected)
    hangs = trunk_of(scene.model)
    turned = between(scene.model, hangs)
    other = with_root(scene.model, hangs) if turned else scene.spec
    fitted = list[FittedJoint]()
    for sweep in sweeps:
        if contract.joints[sweep.joint] in turned:
            chain = Chain(other, contract, _seen_from(sweep, contract, scene.model, hangs))
        else:
            chain = Chain(scene.spec, contract, sweep)
        fitted.append(_fit_joint(chain))
    _check_explained(path, contract.joints, fitted)
    return Fit(contract, recording, fitted, time.monotonic() - began)


def read_sweeps(
    path: Path, recording: DriveLog, contract: Contract, model: mujoco.MjModel, joints: Sequence[str]
) -> list[Sweep]:
    """The sweeps of ``joints``. Raises LogError if the log has no chirp or a sweep cannot be fitted."""
    on = recording.rows["state"][:, 0] == STATES.index(CHIRP)
    rows = {name: values[on].astype(float) for name, values in recording.rows.items()}
    if not on.any():
        raise LogError(f"{shown(path)} has no chirp: record one with legged-mw deploy EXPORT --robot unitree --chirp")
    if (count := rows["joint_pos"].shape[1]) != len(contract.joints):
        raise LogError(f"{shown(path)} has {count} joints, and its export has {len(contract.joints)}")
    step = float(np.median(np.diff(rows["time"][:, 0])))
    if not 0.0 < step <= SLOW:
        raise LogError(
            f"{shown(path)} has a measurement each {1e3 * step:.0f} ms; a fit needs one each {1e3 * SLOW:.0f} ms, as --chirp logs"
        )
    targets, rest = rows["target"], round(REST / step)
    still = np.flatnonzero((np.diff(targets, axis=0) == 0.0).all(axis=1))
    begin = int(still[0]) if len(still) else len(targets) - 1  # start of the first sweep
    moved = np.abs(targets - targets[begin]) > 1e-5
    moved[:begin] = False
    sweeps = list[Sweep]()
    for name in joints:
        span = np.flatnonzero(moved[:, contract.joints.index(name)])
        if len(span) < 2 or span[-1] + rest // 2 > len(moved):
            raise LogError(f"{shown(path)} ends before the sweep of {name} ends: record the chirp again")
        part = {key: values[max(0, span[0] - rest) : span[-1] + rest] for key, values in rows.items()}
        _check_joint(path, name, contract.joints.index(name), part, step)
        sweeps.append(_sweep(contract.joints.index(name), part, contract, model, step))
    return sweeps


def _check_joint(path: Path, name: str, joint: int, rows: dict[str, Floats], step: float) -> None:
    """Raise LogError if the encoder is dead or the joint does not follow its target."""
    target, angle, speed = (rows[key][:, joint] for key in ("target", "joint_pos", "joint_vel"))
    jumps = float(np.abs(np.diff(angle) - step * speed[1:]).max())
    slow = slice(0, round(1.5 / SLOWEST / step))  # the slowest oscillations, which each joint can follow
    moved, commanded = float(np.ptp(angle[slow])), float(np.ptp(target[slow]))
    if not np.isfinite([angle, speed]).all() or not np.ptp(angle) > 0.0:
        why = "its encoder is dead: the angle is the same throughout"
    elif jumps > JUMP:
        why = f"its encoder jumps by {jumps:.2f} rad between two measurements"
    elif moved < MOVED * commanded:
        why = f"it moved by {moved:.2f} rad and its target by {commanded:.2f} rad: its motor is loose, or it is blocked"
    else:
        return
    raise LogError(f"{shown(path)}: {name} cannot be fitted: {why}")


def _check_explained(path: Path, joints: Sequence[str], fitted: Sequence[FittedJoint]) -> None:
    """Raise LogError if the simulation with the fitted parameters does not reproduce each joint's motion."""
    shares = {joints[each.joint]: max(0.0, 1.0 - each.after**2 / float(each.angles[0].var())) for each in fitted}
    if poor := {name: share for name, share in shares.items() if share < EXPLAINED}:
        named = ", ".join(f"{name} ({share:.1%})" for name, share in poor.items())
        without = " ".join(f"--leave_out {name}" for name in poor)
        raise LogError(
            f"{shown(path)}: cannot be fitted: {named}: the fitted parameters explain so little of the motion, not {EXPLAINED:.0%}: "
            f"a joint is loose, touches something, or carries the robot; {without} fits the others"
        )


def _sweep(joint: int, rows: dict[str, Floats], contract: Contract, model: mujoco.MjModel, step: float) -> Sweep:
    """One joint's rows, resampled at equal time steps, with the times of measuring and of sending."""
    begins = rows["time"][:, 0] + rows["behind"][:, 0]
    measured = begins - np.nan_to_num(rows["age"][:, 0])
    sent = begins + np.append(rows["work"][1:, 0], rows["work"][-1:, 0])  # a row has the work of the previous step
    times = np.arange(measured[0], measured[-1], step)
    names = ("joint_pos", "joint_vel", "ang_vel", "acceleration")
    angle, speed, gyro, acceleration = (
        np.stack([np.interp(times, measured, column) for column in rows[name].T], axis=1) for name in names
    )
    root, angular_velocity = _root_motion(contract, model, _smooth(gyro), acceleration, step)
    slope = np.concatenate([root, _difference(_smooth(speed)) / step], axis=1)
    spin = np.concatenate([np.zeros(3), angular_velocity, _smooth(speed)[0]])
    distance, rest = step * np.cumsum(_smooth(speed), axis=0), round(REST / step)
    begin = (angle - distance + distance[0])[:rest].mean(axis=0)
    target = rows["target"][:, joint]
    return Sweep(joint, begin, times - times[0], angle, speed, slope, spin, sent - times[0], target)


def _smooth(values: Floats) -> Floats:
    """Moving average over SMOOTH rows of (T, K)."""
    padded, window = np.pad(values, ((SMOOTH // 2, SMOOTH // 2), (0, 0)), "edge"), np.ones(SMOOTH) / SMOOTH
    return np.stack([np.convolve(column, window, "valid") for column in padded.T], axis=1)


def _difference(values: Floats) -> Floats:
    """Difference of each row to the next row (T, K). The last one is 0."""
    return np.diff(values, axis=0, append=values[-1:])


def _attitudes(omega: Floats, step: float) -> Floats:
    """(T, 4) attitude of the root, level at the start, from its angular velocity (T, 3), its frame."""
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (len(omega), 1))
    for i in range(1, len(omega)):
        attitude[i] = attitude[i - 1]
        mujoco.mju_quatIntegrate(attitude[i], omega[i], step)
    return attitude


def _seen_from(sweep: Sweep, contract: Contract, model: mujoco.MjModel, body: int) -> Sweep:
    """The sweep with the motion of ``body`` (id) in place of the root's."""
    step, joints = sweep.time[1], [model.joint(name).id for name in contract.joints]
    dofs = [*range(6), *model.jnt_dofadr[joints]]
    gained = step * np.cumsum(sweep.slope[:-1, 3:6], axis=0)
    omega = sweep.spin[3:6] + np.concatenate([np.zeros((1, 3)), gained])
    qpos = np.tile(model.qpos0, (len(sweep.time), 1))
    qvel, qacc = np.zeros((2, len(sweep.time), model.nv))
    qpos[:, :3], qpos[:, 3:7], qpos[:, model.jnt_qposadr[joints]] = 0.0, _attitudes(omega, step), sweep.angle
    qvel[:, dofs[3:]], qacc[:, dofs] = np.concatenate([omega, _smooth(sweep.speed)], axis=1), sweep.slope
    motion, spin = motion_of(model, body, qpos, qvel, qacc)
    slope = np.concatenate([motion, sweep.slope[:, 6:]], axis=1)
    return sweep._replace(slope=slope, spin=np.concatenate([np.zeros(3), spin, sweep.spin[6:]]))


def _root_motion(
    contract: Contract, model: mujoco.MjModel, gyro: Floats, acceleration: Floats, step: float
) -> tuple[Floats, Floats]:
    """(T, 6) acceleration of the root without gravity, starting level; (3,) its angular velocity at the start.

    ``gyro`` and ``acceleration`` (T, 3): of the IMU, its frame. Linear: world frame. Angular: body frame.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    data.qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    mujoco.mj_kinematics(model, data)
    position, turn = data.site(contract.imu).xpos, data.site(contract.imu).xmat.reshape(3, 3)
    omega = gyro @ turn.T
    angular_acceleration = _difference(omega) / step
    acceleration = np.append(acceleration[1:], acceleration[-1:], axis=0)  # mean since the last row
    root = acceleration @ turn.T - np.cross(angular_acceleration, position) - np.cross(omega, np.cross(omega, position))
    rotation, world = np.zeros(9), np.empty_like(root)
    for i, attitude in enumerate(_attitudes(omega, step)):
        mujoco.mju_quat2Mat(rotation, attitude)
        world[i] = rotation.reshape(3, 3) @ root[i]
    return np.concatenate([world, angular_acceleration], axis=1), omega[0]


# ---- the replay


class Chain:
    """A MuJoCo model of a sweep's joint, of the bodies that it moves and of the bodies that carry it."""

    def __init__(self, spec: mujoco.MjSpec, contract: Contract, sweep: Sweep) -> None:
        name = contract.joints[sweep.joint]
        self.sweep, self.model = sweep, (model := _only_chain(spec, name))
        self._gains = np.array([contract.stiffness[sweep.joint], contract.damping[sweep.joint]])
        joints = [model.joint(i).name for i in range(model.njnt)]
        self._all = [i for i, each in enumerate(contract.joints) if each in joints]  # index in the contract
        self._dofs = np.array([model.joint(contract.joints[i]).dofadr[0] for i in self._all])
        self._angles = np.array([model.joint(contract.joints[i]).qposadr[0] for i in self._all])
        joint, self._actuator = model.joint(name), model.actuator(name).id
        self._dof, self._angle = int(joint.dofadr[0]), int(joint.qposadr[0])
        own = [0.0, model.dof_armature[self._dof], model.dof_frictionloss[self._dof], 0.0, 1.0, 0.0]
        self.nominal: Floats = np.array(own)  # (6,) the scene's parameters
        self._mobility = float(model.dof_invweight0[self._dof])  # [1 / (kg m^2)]
        model.opt.timestep, model.opt.integrator = sweep.time[1], mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.iterations, model.opt.ls_iterations, model.opt.gravity[:] = 100, 50, 0.0
        model.opt.tolerance = 1e-12
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_AUTORESET
        model.dof_armature[:], model.dof_frictionloss[:], model.dof_damping[:] = HEAVY, 0.0, 0.0
        model.actuator_ctrllimited[:], model.actuator_biastype[:] = 0, mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_gainprm[:], model.actuator_biasprm[:] = 0.0, 0.0
        threads = usable_cores()
        self._rollout, self._data = Rollout(nthread=threads), [mujoco.MjData(model) for _ in range(threads)]

    def simulate(self, values: Floats) -> tuple[Floats, Floats]:
        """Simulated encoder angles and speeds (K, T) with the parameters ``values`` (K, 6)."""
        sweep, model, columns = self.sweep, self.model, [*range(6), *(6 + i for i in self._all)]
        control = np.zeros((len(values), len(sweep.time), model.nu + model.nv))
        forces = [model.nu + dof for dof in (*range(6), *self._dofs)]
        control[:, :, forces] = HEAVY * sweep.slope[:, columns]
        control[:, :, model.nu + self._dof] = 0.0
        start = np.zeros((len(values), mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
        start[:, 4], qvel = 1.0, 1 + model.nq  # a state is time, position, attitude, angles, speeds
        start[:, [qvel + dof for dof in (*range(6), *self._dofs)]] = sweep.spin[columns]
        start[:, 1 + self._angles] = sweep.begin[self._all]
        start[:, 1 + self._angle] -= values[:, OFFSET]
        for k, numbers in enumerate(values):
            targets = np.interp(sweep.time - numbers[DELAY] / 1000.0, sweep.sent, sweep.target)
            control[k, :, self._actuator] = targets - numbers[OFFSET]
        spec = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        models = [self._with(numbers) for numbers in values]
        after, _ = self._rollout.rollout(models, self._data, start, control, control_spec=spec)
        states = np.concatenate([start[:, None], np.asarray(after)[:, :-1]], axis=1)
        return states[..., 1 + self._angle] + values[:, OFFSET:], states[..., qvel + self._dof]

    def _with(self, numbers: Floats) -> mujoco.MjModel:
        """The model with the parameters (6,) of its joint."""
        model, (stiffness, damping) = copy.copy(self.model), numbers[GAIN] * self._gains
        model.dof_armature[self._dof], model.dof_frictionloss[self._dof] = numbers[ARMATURE], numbers[FRICTION]
        model.dof_damping[self._dof] = numbers[DAMPING]
        # MuJoCo scales the softness of friction by the joint's inverse inertia, which the armature changes
        added = numbers[ARMATURE] - self.nominal[ARMATURE]
        model.dof_invweight0[self._dof] = self._mobility / (1.0 + self._mobility * added)
        model.actuator_gainprm[self._actuator, 0] = stiffness
        model.actuator_biasprm[self._actuator, 1:3] = -stiffness, -damping
        return model


def _only_chain(spec: mujoco.MjSpec, joint: str) -> mujoco.MjModel:
    """Compile the robot without the bodies that ``joint`` does not move and that do not carry it."""
    spec = spec.copy()
    body, others = spec.joint(joint).parent, list[Any]()
    while (parent := body.parent).name != spec.worldbody.name:
        others += [each for each in parent.bodies if each.name != body.name]
        body = parent
    for each in [*spec.sensors, *spec.keys, *others]:
        spec.delete(each)
    return spec.compile()


# ---- the fit of a joint


def _fit_joint(chain: Chain) -> FittedJoint:
    """Fit one joint. The optimisation starts from the best of the random starts."""
    sweep, joint = chain.sweep, chain.sweep.joint
    angle, speed = sweep.angle[:, joint], sweep.speed[:, joint]
    measured = np.concatenate([angle / ANGLE, speed / SPEED])

    def residual(points: Floats) -> Floats:
        """(2 T + 2, K) of scaled parameters (6, K). The last two are the prior EXPECTED, weighted like BLOCK rows."""
        numbers = points.T * _SCALE
        simulated = chain.simulate(numbers)
        errors = np.concatenate([simulated[0] / ANGLE, simulated[1] / SPEED], axis=1) - measured
        prior = (numbers[:, GAIN:] - [1.0, 0.0]) / EXPECTED * BLOCK**0.5
        return np.nan_to_num(np.concatenate([errors, prior], axis=1), nan=1e6).T

    candidates = _starts(chain.nominal)
    starts = candidates[np.argsort((residual((candidates / _SCALE).T) ** 2).sum(axis=0))[:REFINED]]
    bounds = [_LOW / _SCALE, _HIGH / _SCALE]
    results = list[tuple[float, Floats]]()
    for start in starts / _SCALE:
        result, trace = minimize.least_squares(
            start, residual, bounds, eps=DIFFERENCE, xtol=END, max_iter=STEPS, x_scale="jac", verbose=0
        )
        results.append((float(trace[-1].objective), result[:, None]))
        if results[-1][0] < 0.5 * NOISE**2 * len(measured):
            break
    best = min(results, key=lambda each: each[0])[1]
    residuals = residual(best)
    jacobian, _ = minimize.jacobian_fd(
        residual, best, residuals, np.float64(DIFFERENCE), 0, [each[:, None] for each in bounds]
    )
    deviation = _deviation(jacobian, residuals[:, 0])
    fitted = best[:, 0] * _SCALE
    angles = np.stack([angle, *chain.simulate(np.stack([chain.nominal, fitted]))[0]])
    before, after = np.sqrt(((angles[1:] - angle) ** 2).mean(axis=1)).tolist()
    return FittedJoint(joint, fitted, deviation * _SCALE, before, after, sweep.time, angles)


def _deviation(jacobian: Floats, error: Floats) -> Floats:
    """Standard deviations (6,) from residuals (R,) and derivatives (R, 6). BLOCK consecutive rows count as one."""
    size = np.linalg.norm(jacobian, axis=0)
    jacobian = jacobian / size
    variance = BLOCK * float(error @ error) / (len(error) - len(size))
    return np.sqrt(variance * np.diag(np.linalg.inv(jacobian.T @ jacobian))) / size


def _starts(nominal: Floats) -> Floats:
    """Random starts (TRIES, 6). The armature is a factor times the scene's."""
    low, high = np.array([each.start for each in PARAMETERS]).T
    share = np.random.default_rng(0).random((TRIES, len(PARAMETERS)))
    starts = low + share * (high - low)
    starts[:, ARMATURE] *= nominal[ARMATURE]
    return starts


# ---- output


def table(fit: Fit) -> str:
    """One line per joint: parameters with standard deviations, and the angle's error before and after the fit."""
    names = [fit.contract.joints[each.joint] for each in fit.joints]
    width = max(map(len, names))
    heads = [f"{each.name} [{each.unit}]" for each in PARAMETERS]
    lines = ["".join([f"{'joint':<{width}}", *(f"{head:>20}" for head in heads), f"{'error [mrad]':>18}"])]
    for name, each in zip(names, fit.joints, strict=True):
        cells = [
            f"{value:.{p.digits}f} ± {deviation:.{p.digits}f}"
            for p, value, deviation in zip(PARAMETERS, each.values, each.deviation, strict=True)
        ]
        errors = f"{1e3 * each.before:.1f} -> {1e3 * each.after:.1f}"
        lines.append("".join([f"{name:<{width}}", *(f"{cell:>20}" for cell in cells), f"{errors:>18}"]))
    header = fit.recording.header
    return "\n".join([*lines, f"{header['task']}, {header['robot']}, {header['began']}; fitted in {fit.seconds:.0f} s"])


def overrides(fit: Fit) -> dict[str, dict[str, Any]]:
    """Fields of the task's config: means over joints of the same kind, and ranges.

    A range includes each joint's value and is two standard deviations wider on each side. Those of armature and friction
    loss are of the joints whose mean is larger than two standard deviations: of a joint that has hardly any, a factor
    says nothing.
    """
    values, deviation = fit.values, fit.deviation
    kinds = _kinds([fit.contract.joints[each.joint] for each in fit.joints])
    tables, ranges = dict[str, dict[str, float]](), dict[str, list[float]]()
    for field, column in (("armature", ARMATURE), ("frictionloss", FRICTION)):
        fitted, spread = values[:, column], deviation[:, column]
        tables[field] = {kind: _short(fitted[[each == kind for each in kinds]].mean()) for kind in dict.fromkeys(kinds)}
        mean = np.array([tables[field][kind] for kind in kinds])
        if (sure := mean > 2.0 * spread).any():
            ranges[field] = _range(fitted[sure] / mean[sure], spread[sure] / mean[sure], 1e-3)
    ranges["stiffness"] = _range(values[:, GAIN], deviation[:, GAIN], 1e-3)
    own = fit.contract.damping[[each.joint for each in fit.joints]]
    if own.all():
        damping = values[:, GAIN] + values[:, DAMPING] / own
        ranges["damping"] = _range(damping, deviation[:, GAIN] + deviation[:, DAMPING] / own, 1e-3)
    ranges["encoder_offset"] = _range(values[:, OFFSET], deviation[:, OFFSET], -1.0)
    ranges["delay_ms"] = _range(values[:, DELAY], deviation[:, DELAY], 0.0)
    return {"asset": tables, "domain_rand": {"enable": True, **ranges}}


def _kinds(joints: Sequence[str]) -> list[str]:
    """The part of each name that is the same for all sides: hip_joint of FL_hip_joint."""
    suffixes = [name.partition("_")[2] for name in joints]
    return [
        suffix if suffix and suffixes.count(suffix) > 1 else name for name, suffix in zip(joints, suffixes, strict=True)
    ]


def _range(values: Floats, deviation: Floats, least: float) -> list[float]:
    low, high = float((values - 2.0 * deviation).min()), float((values + 2.0 * deviation).max())
    return [_short(max(least, low)), _short(high)]


def _short(value: float) -> float:
    return float(f"{value:.4g}")


LINES = {"measured": ("0.75", 3.0), "by the scene's numbers": ("C1", 0.9), "fitted": ("C0", 0.9)}  # colour, width


def draw(fit: Fit, path: Path) -> None:
    """Write the picture: the angles of each joint, measured, with the scene's parameters and with the fitted ones."""
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise UserError("drawing a fit needs matplotlib: pip install matplotlib") from None
    columns = 3
    count = -(-len(fit.joints) // columns)
    figure = Figure((15, 2.4 * count + 0.5), layout="constrained")
    for i, each in enumerate(fit.joints):
        axes = figure.add_subplot(count, columns, i + 1)
        for angles, (label, (colour, width)) in zip(each.angles, LINES.items(), strict=True):
            axes.plot(each.time, angles, color=colour, label=label, linewidth=width)
        errors = f"{1e3 * each.before:.1f} -> {1e3 * each.after:.1f} mrad"
        axes.set_title(f"{fit.contract.joints[each.joint]}: {errors}", fontsize=8)
        axes.tick_params(labelsize=6)
    figure.axes[0].legend(fontsize=6)
    figure.supxlabel("[s]", fontsize=8)
    figure.supylabel("[rad]", fontsize=8)
    figure.savefig(path, dpi=90)


def parse() -> argparse.Namespace:
    parser = Parser(prog="legged-mw fit", description=__doc__, allow_abbrev=False)
    parser.add_argument("log", metavar="LOG", help="of legged-mw deploy EXPORT --chirp ...")
    out = "joints with this in their names are not fitted; again for more"
    parser.add_argument("--leave_out", action="append", default=[], metavar="NAME", help=out)
    return parser.parse_args()


def main() -> None:
    args = parse()
    path = typed(args.log)
    fit = fit_log(path, leave_out=args.leave_out)
    picture, fields = path.with_suffix(".png"), path.with_suffix(".yaml")
    print(table(fit))
    try:
        draw(fit, picture)
        save_yaml(fields, overrides(fit))
    except OSError as error:
        raise UserError(f"cannot write beside {shown(path)}: {error.strerror}; move the log") from None
    print(f"written to {shown(picture)} and {shown(fields)}; train with what was fitted:")
    print(f"legged-mw train --task {fit.contract.task} --override {shown(fields)}")
