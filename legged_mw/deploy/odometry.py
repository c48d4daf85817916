"""Leg odometry: the velocity of the IMU [m/s] from joints, gyro, accelerometer and stance feet.

It is the velocity part of the filter of Bledt et al., "MIT Cheetah 3: Design and Control of a Robust, Dynamic Quadruped
Robot", IROS 2018. The accelerometer predicts the velocity. Each stance foot corrects it: the foot does not move, so
the leg's motion is the body's motion. The state has no positions of body or feet, so the ground can have any height.
All three axes have one variance. Ours: a foot that disagrees with the prediction gets a smaller weight (Cauchy's),
because it slips or has just touched down. This module depends on no robot class and no policy.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import CONTRACT_FILE, Contract, ContractError
from legged_mw.deploy.robot import Floats, Measurement
from legged_mw.deploy.simulated import read_scene

ROW = "lin_vel"  # ContractRow.measured of the velocity
# The noises are ours, tuned in the walking exam of go1_flat with and without sensor noise. Smaller DRIFT and DOUBT give
# a smoother estimate, but it reacts slower to a shock between two measurements, which the accelerometer misses.
DRIFT = 4.0  # [m/s^2] noise of the accelerometer over a period
STANDING = 0.2  # [m/s] velocity noise of a stance foot
# source of foot contact -> [m/s] foot speed at which the weight of a foot is halved
DOUBT = {"measured": 0.5, "torque": 0.3, "height": 0.3}
CONTACTS = tuple(DOUBT)  # sources of foot contact
LOADED = 0.1  # [share of the weight] smallest force of a stance foot, from joint torques
CARRIES = 0.6  # [share of the weight] smallest force of all feet, if neither belly nor rope carries the robot
LEVEL = 0.01  # [m] largest height of a stance foot above the lowest foot, if height is the source of contact
FLAT = 0.05  # [-] sine of the tilt up to which a foot lies flat, not on one of its ends


class Legs(NamedTuple):
    """Positions, velocities and forces of the legs of N robots, in the IMU's frame."""

    place: Floats  # (N, F, 3) [m] from the IMU to the foot's lowest point
    velocity: Floats  # (N, F, 3) [m/s] velocity of the IMU, if the foot stands still
    force: Floats  # (N, F) [N] downward force of the leg, from joint torques


class Odometry:
    """Estimates the velocity of ``count`` robots from one measurement per period."""

    def __init__(self, folder: Path, contract: Contract, count: int = 1, contact: str = "measured") -> None:
        """``contact``: the source of foot contact, one of CONTACTS. Raises ContractError."""
        if not contract.feet:
            raise ContractError(f"{CONTRACT_FILE}: robot: feet is empty; leg odometry needs feet")
        self.contract, self.contact, self._doubt, scene = (
            contract,
            contact,
            DOUBT[contact],
            read_scene(folder, contract),
        )
        self.model, self._dofs = scene.model, scene.dofs
        self._data = mujoco.MjData(self.model)
        self._angles = [int(self.model.joint(name).qposadr[0]) for name in contract.joints]
        self._imu = int(self.model.site(contract.imu).id)
        self._feet = [_Foot(self.model, names) for names in contract.feet.values()]
        self.gravity = float(np.linalg.norm(self.model.opt.gravity))
        self.velocity: Floats = np.zeros((count, 3))  # (N, 3) [m/s] body frame
        self._variance: Floats = np.zeros(count)  # (N,) [m^2/s^2] its variance, equal in all axes
        self._shock: Floats = np.full((count, 3), np.nan)  # (N, 3) [m/s^2] last accelerometer value
        self.reset()

    def reset(self, which: Any = slice(None)) -> None:
        """Reset the estimate of the robots ``which`` (indices or a mask) to zero velocity."""
        self.velocity[which], self._variance[which], self._shock[which] = 0.0, self._doubt**2, np.nan

    def __call__(self, measured: Measurement) -> Measurement:
        """Replace the velocity of ``measured`` by the estimate. N robots; one robot needs no leading axis."""
        gyro, gravity, specific_force = (
            np.atleast_2d(each) for each in (measured.ang_vel, measured.gravity, measured.acceleration)
        )
        last_force = np.where(np.isfinite(self._shock), self._shock, specific_force)
        self._shock = specific_force.copy()
        acceleration = 0.5 * (specific_force + last_force) + self.gravity * gravity
        velocity = self.velocity + self.contract.period * (acceleration - np.cross(gyro, self.velocity))
        variance = self._variance + (self.contract.period * DRIFT) ** 2
        legs = self.legs(measured)
        error = ((legs.velocity - velocity[:, None]) ** 2).sum(axis=2)
        noise = STANDING**2 * (1.0 + error / (self._doubt**2 + variance[:, None]))
        weight = np.where(self.stands(measured, legs), 1.0 / noise, 0.0)  # (N, F)
        self._variance = 1.0 / (1.0 / variance + weight.sum(axis=1))
        weighted_sum = velocity / variance[:, None] + (weight[..., None] * legs.velocity).sum(axis=1)
        estimate = weighted_sum * self._variance[:, None]
        self.velocity = estimate.copy()
        self.reset(~np.isfinite(estimate).all(axis=1))  # an estimate that is not finite is returned once, then reset
        return replace(measured, lin_vel=estimate.reshape(np.shape(measured.lin_vel)))

    def stands(self, measured: Measurement, legs: Legs) -> NDArray[np.bool_]:
        """(N, F) true for a stance foot, by the source of contact."""
        if self.contact == "measured":
            return np.atleast_2d(measured.foot_contact) > 0.0
        if self.contact == "torque":
            return legs.force > LOADED * self.contract.mass * self.gravity
        depth = (legs.place * np.atleast_2d(measured.gravity)[:, None]).sum(axis=2)
        return depth > depth.max(axis=1, keepdims=True) - LEVEL

    def legs(self, measured: Measurement) -> Legs:
        """Foot positions, body velocities from fixed feet, and foot forces, by the scene's kinematics."""
        parts = (measured.joint_pos, measured.joint_vel, measured.joint_torque, measured.ang_vel, measured.gravity)
        return Legs(*map(np.array, zip(*map(self._legs, *map(np.atleast_2d, parts)), strict=True)))

    def down(self, measured: Measurement) -> Floats:
        """Direction of gravity (3,) from the legs of one robot: the normal of the feet's plane. Exact on level ground.

        It does not use the IMU. NaN unless three feet or more carry the robot.
        """
        legs = self.legs(replace(measured, gravity=np.array([0.0, 0.0, -1.0]), ang_vel=np.zeros(3)))
        weight = self.contract.mass * self.gravity
        place = legs.place[0, legs.force[0] > LOADED * weight]
        if len(place) < 3 or legs.force.sum() < CARRIES * weight:
            return np.full(3, np.nan)
        normal = np.linalg.svd(place - place.mean(axis=0))[2][2]
        return normal * np.sign(normal @ place.mean(axis=0))

    def leaning(self, angles: Floats, axis: Floats) -> Floats:
        """(D,) [rad/rad] rotation of each joint per rotation of the body about ``axis`` (3,), with fixed feet."""
        place, jacobians = self._feet_of(angles, np.array([0.0, 0.0, -1.0]))
        rotation = np.linalg.lstsq(
            jacobians.reshape(-1, jacobians.shape[2]), np.cross(place, axis).ravel(), rcond=0.01
        )[0]
        return np.array(rotation, dtype=float)

    def _legs(
        self, angles: Floats, speeds: Floats, torques: Floats, gyro: Floats, gravity: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """``Legs`` of one robot, without the leading axis."""
        place, jacobians = self._feet_of(angles, gravity)
        wrench = np.linalg.solve(
            jacobians @ jacobians.transpose(0, 2, 1) + 1e-4 * np.eye(3), (jacobians @ torques)[..., None]
        )[..., 0]
        return place, -(np.cross(gyro, place) + jacobians @ speeds), wrench @ gravity

    def _feet_of(self, angles: Floats, gravity: Floats) -> tuple[Floats, Floats]:
        """Foot positions (F, 3) [m] and their Jacobians (F, 3, D), in the IMU's frame. The root is fixed."""
        model, data = self.model, self._data
        data.qpos[self._angles] = angles
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        origin, turn = data.site_xpos[self._imu], data.site_xmat[self._imu].reshape(3, 3)
        down, own, jacobians = turn @ gravity, np.zeros((3, model.nv)), np.zeros((len(self._feet), 3, model.nv))
        mujoco.mj_jac(model, data, own, None, origin, model.site_bodyid[self._imu])
        place = np.array([foot.lowest(data, down) for foot in self._feet])
        for jacobian, foot, point in zip(jacobians, self._feet, place, strict=True):
            mujoco.mj_jac(model, data, jacobian, None, point, foot.body)
        return (place - origin) @ turn, turn.T @ (jacobians - own)[:, :, self._dofs]


class _Foot:
    """The shapes of one foot. Each has a centre, half edges along its axes, and a radius around them."""

    def __init__(self, model: mujoco.MjModel, sensors: tuple[str, ...]) -> None:
        """The contact ``sensors`` name the shapes."""
        self.geoms = [int(model.sensor(name).objid[0]) for name in sensors]
        self.body = int(model.geom_bodyid[self.geoms[0]])
        kinds, sizes, boxes = model.geom_type[self.geoms], model.geom_size[self.geoms], model.geom_aabb[self.geoms]
        ball, rod = kinds == mujoco.mjtGeom.mjGEOM_SPHERE, kinds == mujoco.mjtGeom.mjGEOM_CAPSULE
        self.radius: Floats = np.where(ball | rod, sizes[:, 0], 0.0)
        self.centre: Floats = boxes[:, :3].copy()
        self.half: Floats = np.where(ball[:, None], 0.0, boxes[:, 3:])
        self.half[rod] = sizes[rod, 1:2] * [0.0, 0.0, 1.0]

    def lowest(self, data: Any, down: Floats) -> Floats:
        """The foot's farthest point (3,) in the direction ``down``."""
        turns = data.geom_xmat[self.geoms].reshape(-1, 3, 3)
        ends = self.centre + self.half * np.clip(down @ turns / FLAT, -1.0, 1.0)
        points = data.geom_xpos[self.geoms] + (turns @ ends[..., None])[..., 0] + self.radius[:, None] * down
        return points[np.argmax(points @ down)]
