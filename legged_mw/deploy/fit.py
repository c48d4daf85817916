"""Fit a robot's own numbers to the log of its chirp: delay, armature, friction, damping, gain and encoder offset per joint.

Each joint's sweep is replayed in MuJoCo's C engine. Root and gravity move as the IMU measured them, so the robot may
swing on its rope; joints that are held are simulated too. mujoco.minimize.least_squares finds the numbers with which
angles and speeds are nearest to those measured.
"""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import minimize, rollout

from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.log import DriveLog, LogError, read_log
from legged_mw.deploy.robot import Floats
from legged_mw.deploy.simulated import DeployScene, read_scene
from legged_mw.deploy.states import CHIRP, STATES
from legged_mw.utils.errors import UserError, shown

SC = 'jac'
ANGLE, SPEED = 0.001, 0.02  # [rad], [rad/s] ours: weights of the residual, about the noise of encoders
HEAVY = 1e6  # [kg], [kg m^2] on the root, which then moves as it is told
SMOOTH = 5  # measurements over which the gyro is averaged before its slope is taken
STARTS = (4.0, 16.0)  # [ms] delays to begin with


class Parameter(NamedTuple):
    """A number that is fitted."""

    name: str
    unit: str
    scale: float  # in the unit of the fit: one per unit
    low: float
    high: float


PARAMETERS = (
    Parameter("delay", "ms", 1.0, 0.0, 60.0),
    Parameter("armature", "kg m^2", 0.01, 1e-4, 1.0),
    Parameter("frictionloss", "N m", 0.1, 0.0, 10.0),
    Parameter("damping", "N m s/rad", 0.1, 0.0, 10.0),
    Parameter("gain", "-", 0.1, 0.2, 3.0),
    Parameter("offset", "rad", 0.01, -0.2, 0.2),
)
NAMES = tuple(each.name for each in PARAMETERS)


class Fitted(NamedTuple):
    """The numbers of one joint, in the order of PARAMETERS."""

    joint: int
    values: Floats  # (6,)
    deviation: Floats  # (6,) standard deviation
    before: float  # [rad] RMS of the angle's error with the scene's numbers
    after: float  # [rad] with the fitted ones
    explained: float  # share of the variance of the angle
    time: Floats  # (T,) [s]
    measured: Floats  # (T,) [rad]
    nominal: Floats  # (T,) [rad] simulated with the scene's numbers
    simulated: Floats  # (T,) [rad] with the fitted ones


class Sweep(NamedTuple):
    """One joint's part of a log, at even times."""

    joint: int
    time: Floats  # (T,) [s] of measurements
    sent: Floats  # (S,) [s] of targets
    target: Floats  # (S, D) [rad]
    angle: Floats  # (T, D) [rad]
    speed: Floats  # (T, D) [rad/s]
    force: Floats  # (T, 6) on a heavy root


class Model:
    """The hanging robot: servos as actuators, a root that moves as it is told."""

    def __init__(self, spec: mujoco.MjSpec, contract: Contract, step: float, joint: str) -> None:
        """Raises nothing."""
        spec = spec.copy()
        own, root = spec.joint(joint).parent, spec.worldbody.first_body()
        while own.parent.name != root.name:
            own = own.parent
        for sensor in list(spec.sensors):
            spec.delete(sensor)
        for key in list(spec.keys):
            spec.delete(key)
        for body in list(root.bodies):
            if body.name != own.name:
                spec.delete(body)
        for body in spec.bodies[1:]:
            for geom in list(body.geoms):
                if body.explicitinertial:
                    spec.delete(geom)
        self.model = model = spec.compile()
        self.joints = [name for name in contract.joints if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0]
        self.index = [contract.joints.index(name) for name in self.joints]
        self.own = self.joints.index(joint)
        self.dofs = np.array([int(model.joint(name).dofadr[0]) for name in self.joints])
        self.actuators = np.array([model.actuator(name).id for name in self.joints])
        contract = replace(contract, joints=tuple(self.joints), stiffness=contract.stiffness[self.index], damping=contract.damping[self.index])
        self.angles = np.array([int(model.joint(name).qposadr[0]) for name in contract.joints])
        model.opt.timestep, model.opt.integrator = step, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        model.opt.iterations, model.opt.ls_iterations = 100, 50
        model.opt.gravity[:] = 0.0
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_SENSOR
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        model.dof_armature[:6] = HEAVY
        model.dof_damping[self.dofs] = 0.0
        model.actuator_ctrllimited[:] = 0
        model.actuator_biastype[:] = mujoco.mjtBias.mjBIAS_AFFINE
        model.actuator_gainprm[self.actuators, 0] = contract.stiffness
        model.actuator_biasprm[self.actuators, :3] = np.stack(
            [np.zeros_like(contract.stiffness), -contract.stiffness, -contract.damping], axis=1
        )
        self.nominal = np.array(
            [
                [0.0, model.dof_armature[dof], model.dof_frictionloss[dof], 0.0, 1.0, 0.0]
                for dof in self.dofs
            ]
        )
        mujoco.mj_setConst(model, mujoco.MjData(model))
        self._pool = rollout.Rollout(nthread=2)
        self._data = [mujoco.MjData(model) for _ in range(2)]

    def simulate(self, sweep: Sweep, values: Floats) -> tuple[Floats, Floats]:
        """Measured angles and speeds (K, T) of the sweep's joint with ``values`` (K, 6)."""
        joint, model = self.own, self.model
        dof, actuator = self.dofs[joint], self.actuators[joint]
        models = [copy.copy(model) for _ in values]
        count = len(sweep.time)
        control = np.empty((len(values), count, model.nu + model.nv))
        control[..., self.actuators] = [
            np.stack([np.interp(sweep.time, sweep.sent, each) for each in sweep.target[:, self.index].T], axis=1)
        ]
        control[..., model.nu :] = 0.0
        control[..., model.nu : model.nu + 6] = sweep.force
        size = mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        start = np.zeros((len(values), size))
        qpos = np.zeros(model.nq)
        qpos[3], qpos[self.angles] = 1.0, sweep.angle[:20, self.index].mean(axis=0)
        start[:, 1 : 1 + model.nq] = qpos
        for k, (own, (delay, armature, friction, damping, gain, offset)) in enumerate(zip(models, values, strict=True)):
            own.dof_armature[dof], own.dof_frictionloss[dof], own.dof_damping[dof] = armature, friction, damping
            own.actuator_gainprm[actuator, 0] *= gain
            own.actuator_biasprm[actuator, 1:3] *= gain
            control[k, :, actuator] = np.interp(sweep.time - delay / 1000.0, sweep.sent, sweep.target[:, sweep.joint]) - offset
            start[k, 1 + self.angles[joint]] -= offset
        spec = int(mujoco.mjtState.mjSTATE_CTRL) | int(mujoco.mjtState.mjSTATE_QFRC_APPLIED)
        states, _ = self._pool.rollout(models, self._data, start, control, control_spec=spec, skip_checks=False)
        # states after each step
        angle = np.concatenate([start[:, None, 1 + self.angles[joint]], states[:, :-1, 1 + self.angles[joint]]], axis=1)
        at = 1 + model.nq + dof
        speed = np.concatenate([start[:, None, at], states[:, :-1, at]], axis=1)
        return angle + values[:, 5:], speed


def sweeps(recording: DriveLog, contract: Contract, model: Any) -> list[Sweep]:
    rows = {name: values.astype(float) for name, values in recording.rows.items()}
    on = np.flatnonzero(rows["state"][:, 0] == STATES.index(CHIRP))
    rows = {name: values[on] for name, values in rows.items()}
    late = rows["time"][:, 0] + rows["behind"][:, 0]
    measured = late - np.nan_to_num(rows["age"][:, 0])
    sent = late + np.nan_to_num(np.append(rows["work"][1:, 0], rows["work"][-1:, 0]))
    step = float(np.median(np.diff(rows["time"][:, 0])))
    rest = rows["target"][-1]
    found = []
    for joint in range(len(contract.joints)):
        moves = np.flatnonzero(np.abs(rows["target"][:, joint] - rest[joint]) > 1e-6)
        moves = moves[moves > 1050]
        part = slice(max(0, moves[0] - 60), moves[-1] + 60)
        time = np.arange(measured[part][0], measured[part][-1], step)
        even = {
            name: np.stack([np.interp(time, measured[part], each) for each in rows[name][part].T], axis=1)
            for name in ("joint_pos", "joint_vel", "ang_vel", "acceleration")
        }
        found.append(
            Sweep(
                joint, time, sent[part], rows["target"][part], even["joint_pos"], even["joint_vel"],
                root_force(model, contract, even["ang_vel"], even["acceleration"], step),
            )
        )
    return found


def root_force(model: Any, contract: Contract, gyro: Floats, acceleration: Floats, step: float) -> Floats:
    """(T, 6) force and torque on the heavy root, that move it as an IMU in free fall would feel it."""
    site = model.site(contract.imu)
    data = mujoco.MjData(model)
    data.qpos[:] = 0.0
    data.qpos[3] = 1.0
    mujoco.mj_kinematics(model, data)
    turn, place = data.site_xmat[site.id].reshape(3, 3), data.site_xpos[site.id]
    omega, felt = gyro @ turn.T, acceleration @ turn.T
    window = np.ones(SMOOTH) / SMOOTH
    smooth = np.stack([np.convolve(np.pad(each, SMOOTH // 2, "edge"), window, "valid") for each in omega.T], axis=1)
    slope = np.gradient(smooth, step, axis=0)
    linear = felt - np.cross(slope, place) - np.cross(smooth, np.cross(smooth, place))
    quaternion, rotation, world = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(9), np.empty_like(linear)
    for i in range(len(linear)):
        mujoco.mju_quat2Mat(rotation, quaternion)
        world[i] = rotation.reshape(3, 3) @ linear[i]
        mujoco.mju_quatIntegrate(quaternion, smooth[i], step)
    return HEAVY * np.concatenate([world, slope], axis=1)


def fit_joint(model: Model, sweep: Sweep) -> Fitted:
    scale = np.array([each.scale for each in PARAMETERS])
    bounds = [np.array([getattr(each, end) for each in PARAMETERS]) / scale for end in ("low", "high")]
    measured = np.concatenate([sweep.angle[:, sweep.joint] / ANGLE, sweep.speed[:, sweep.joint] / SPEED])

    def residual(x: Floats) -> Floats:
        values = x.reshape(len(x), -1).T * scale
        angle, speed = model.simulate(sweep, values)
        return np.nan_to_num(np.concatenate([angle / ANGLE, speed / SPEED], axis=1).T - measured[:, None], nan=1e6)

    found = []
    rng = np.random.default_rng(0)
    many = np.tile(model.nominal[model.own], (64, 1))
    many[:, 0] = rng.uniform(0.0, 30.0, 64)
    many[:, 1] *= np.exp(rng.uniform(-1.0, 2.0, 64))
    many[:, 2] = np.exp(rng.uniform(-3.0, 0.0, 64)) * many[:, 2] * 5
    many[:, 3] = rng.uniform(0.0, 1.0, 64) * 0.5
    many[:, 4] = rng.uniform(0.7, 1.3, 64)
    cost = (residual((many / scale).T)**2).sum(axis=0)
    for begin in many[np.argsort(cost)[:2]]:
        x, trace = minimize.least_squares(begin / scale, residual, bounds=bounds, eps=1e-4, xtol=1e-4, verbose=0, max_iter=40, x_scale=SC)
        found.append((float(trace[-1].objective), x, len(trace)))
    objective, x, _ = min(found, key=lambda each: each[0])
    error = residual(x[:, None])
    jacobian, _ = minimize.jacobian_fd(residual, x[:, None], error, 1e-4, 0, [each[:, None] for each in bounds])
    error = error[:, 0]
    spread = float(error @ error) / (len(error) - len(x))
    cov = spread * np.linalg.pinv(jacobian.T @ jacobian)
    nominal, _ = model.simulate(sweep, model.nominal[model.own][None])
    simulated, _ = model.simulate(sweep, (x * scale)[None])
    angle = sweep.angle[:, sweep.joint]
    rms = lambda error: float(np.sqrt((error**2).mean()))
    print([f[2] for f in found], cost.min(), [f[0] for f in found])
    return Fitted(
        sweep.joint, x * scale, np.sqrt(np.diag(cov)) * scale, rms(nominal[0] - angle), rms(simulated[0] - angle),
        1.0 - rms(simulated[0] - angle) ** 2 / float(angle.var()), sweep.time, angle, nominal[0], simulated[0],
    )
