"""Simulated robots in MuJoCo's C engine, from an export's ``scene.xml``: one ``Robot``, or a ``Fleet`` of many.

MuJoCo's sensors give the measurements. A physics step computes the sensors before it moves the robot. After each
period the sensors of position, velocity and contact are therefore computed again, in the new state.
Torque and acceleration need forces, so they are one physics step old, as in training.
In training, contact was also one physics step old.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import ArrayLike, NDArray

from legged_mw.deploy.contract import (
    ATTITUDE,
    CONTRACT_FILE,
    FALL,
    POSITION,
    SCAN,
    SCENE_FILE,
    SENSED,
    TERRAIN_FILE,
    Contract,
    ContractError,
    make_network,
    part,
    quantity_size,
    target_range,
)
from legged_mw.deploy.robot import QUANTITIES, Floats, Measurement, Robot, damped, layout
from legged_mw.deploy.user_scene import fit
from legged_mw.robot.mjcf import XmlSource, check_model
from legged_mw.utils.errors import unknown
from legged_mw.utils.machine import require_memory, usable_cores
from legged_mw.utils.motor_network import DC_DAMPING, DC_STIFFNESS
from legged_mw.view.posed_robot import lowest_point

# ---- pose from measurements -----------------------------------------------------------------------------------------


def place(model: Any, data: Any, joints: Sequence[str], angles: Floats, gravity: Floats, heading: float = 0.0) -> None:
    """Set the robot's pose in ``data``. It keeps (x, y) and puts the lowest point on the ground.

    ``angles`` (D,) [rad] of ``joints``; ``gravity`` (3,) in the body frame; ``heading`` [rad].
    """
    data.qpos[[model.joint(name).qposadr[0] for name in joints]] = angles
    # the world's z axis in the body frame
    up, tilt, turn = -gravity / np.linalg.norm(gravity), np.zeros(4), np.zeros(4)
    axis = np.cross(up, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])  # level, or upside down
    mujoco.mju_axisAngle2Quat(tilt, axis, math.acos(np.clip(up[2], -1.0, 1.0)))
    mujoco.mju_axisAngle2Quat(turn, np.array([0.0, 0.0, 1.0]), heading)
    mujoco.mju_mulQuat(data.qpos[3:7], turn, tilt)
    mujoco.mj_kinematics(model, data)
    touching = np.flatnonzero((model.geom_conaffinity > 0) & (model.geom_bodyid > 0)).tolist()
    data.qpos[2] -= min((lowest_point(model, data, geom) for geom in touching), default=0.0)


def trunk_of(model: mujoco.MjModel) -> int:
    """The heaviest body: the trunk of a quadruped, the torso of a humanoid."""
    return int(np.argmax(model.body_mass))


Change = Callable[[mujoco.MjModel], None]
_NOW = int(mujoco.mjtStage.mjSTAGE_VEL.value)  # recompute the sensors of position and velocity in the new state

_GROUND_GROUP = [1, 0, 0, 0, 0, 0]  # geom groups that a height scan detects; the robot's geoms are in other groups
SHAPES = 3  # geom group of a robot's collision shapes
_DEEP, _FAR = 0.1, 1e4  # [m] limits of a start pose: depth below the ground, distance from the origin
_ABOVE = 2.0  # [m] height above the root at which the scan's rays begin


class Fleet:
    """``count`` robots, each in its own world, stepped on ``threads`` threads (0: one per core)."""

    def __init__(
        self,
        folder: Path,
        contract: Contract,
        count: int = 1,
        threads: int = 0,
        scene_file: str | Path = SCENE_FILE,
        whole: bool = False,
        change: Change | None = None,
        each: Callable[[], None] | None = None,
    ) -> None:
        """Load the scene and put every robot into its first keyframe.

        ``scene_file``: the name of a file in the export, or the path of a user's scene, which changes ``contract``.
        ``whole``: the whole body can touch the ground, not only the feet.
        ``change`` edits the model before the first step. ``each`` is called after every physics step; ``read_data``
        then returns the forces of that step. Raises ContractError, and UserError for a user's scene.
        """
        scene, contract = enter_scene(folder, contract, scene_file, whole)
        self.contract, self.count, self.spec, self.model = contract, count, scene.spec, scene.model
        if change:
            change(self.model)
        # a world with non-finite values counts as a fall; nothing is printed
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        _keep_quiet()
        # the same check as in sim/engines.py
        require_memory(0.2 * mujoco.MjData(self.model).nbuffer * count, "cpu", f"--num_envs {count}", "take fewer")
        self._batch = Batch(self.model, count, threads or min(usable_cores(), count), persistent=each is not None)
        self._each = each
        self._sensors, self._layout = self._batch.bind("sensordata"), layout(contract)
        # (N, nq) view: position [m], quaternion, joints in MuJoCo's order
        self.qpos: Floats = self._batch.bind("qpos")
        self.qvel: Floats = self._batch.bind("qvel")  # (N, nv) view; the next step starts from the written values
        # (N, nv) of the last physics step. `forward` overwrites it with another robot's, so _driven is a copy
        self._forces: Floats = self._batch.bind("qfrc_actuator")
        self._driven = self._forces.copy()
        self._ctrl, self._actuators, self._dofs = self._batch.bind("ctrl"), scene.actuators, scene.dofs
        self._where, self._contacts = scene.sensordata, scene.contacts
        # (N,) true if MuJoCo failed to step the robot since its reset
        self.broken: NDArray[np.bool_] = np.zeros(count, dtype=bool)
        self._network = make_network(folder, contract.motors, count, len(contract.joints))
        # (N, D) [rad] or [N m] targets before the first action; `_sent`: targets of the last periods, newest first
        self._start = np.tile(contract.default_pose * contract.action.of_angles, (count, 1))
        self._sent = self._start[None].copy()
        self._late = np.zeros(count, dtype=int)  # (N,) delay from `write` to the motors, in physics steps
        # index of each joint in qpos
        self._angles = [int(self.model.joint(name).qposadr[0]) for name in contract.joints]
        self.reset()

    def read(self) -> Measurement:
        """The measurement of every robot, (N, ...) each. The arrays are copies."""
        values = {name: self._value(name) for name in self._layout}
        return Measurement(
            **{n: values[n] for n in QUANTITIES}, others={n: v for n, v in values.items() if n not in QUANTITIES}
        )

    def write(self, targets: Floats) -> None:
        """Advance every robot by one period with servo targets (N, D) [rad], or torques [N m]."""
        self._ctrl[:, self._actuators] = targets
        if not self._network and not self._each and not self._late.any():
            self._step(self.contract.decimation, _NOW)
            return
        self._sent = np.concatenate([targets[None], self._sent[: len(self._sent) - 1]])
        for step in range(self.contract.decimation):
            received = self._arrived(step)
            if self._network:
                received = self._network.torque(received - self.qpos[:, self._angles], self.qvel[:, self._dofs])
            self._ctrl[:, self._actuators] = received
            last = step == self.contract.decimation - 1
            self._step(1, _NOW if last and not self._each else 0)
            if self._each:
                self._each()
        if self._each:
            self.refresh()

    def motor_torque(self) -> Floats:
        """(N, D) [N m] torque of each motor in the last physics step, with a servo's damping at the present speed."""
        damping = self.contract.damping if self.damps_by_joint else 0.0
        return self._driven[:, self._dofs] - damping * self.qvel[:, self._dofs]

    def motor_speed(self) -> Floats:
        """(N, D) [rad/s] speed of each joint."""
        return self.qvel[:, self._dofs].copy()

    def _arrived(self, step: int) -> Floats:
        """The targets (N, D) that the motors have received in this physics step of a period."""
        age = np.maximum(self._late - step + self.contract.decimation - 1, 0) // self.contract.decimation
        return self._sent[age, np.arange(self.count)]

    def read_data(self, data: mujoco.MjData) -> None:
        """Copy the first robot's data into ``data``. With ``each`` it has the forces of the last physics step."""
        self._batch.get_data(0, data)

    def _step(self, count: int, stage: int) -> None:
        try:
            self._batch.step(nstep=count, stage=stage)
        except SimulationError as error:  # the other worlds have been stepped
            self.broken[error.ids] = True
        self._driven[:] = self._forces

    def fell(self) -> NDArray[np.bool_]:
        """(N,) true for a fall by the contract's `ends` or a state that is not finite."""
        ends = self.contract.ends
        fell = ends.tilted(self._value("gravity")) | ~np.isfinite(self.qvel).all(axis=1) | self.broken
        if ends.min_base_height is not None:
            fell |= self._heights([0.0], [0.0])[:, 0] < ends.min_base_height
        return fell | (self._sensors[:, self._where[FALL]] > 0.0).any(axis=1) if ends.falls_on else fell

    def touching(self) -> NDArray[np.bool_]:
        """(N, G) true for a foot geom on the ground, in the order of their sensors."""
        where = sorted({int(place) for places in self._contacts for place in places})
        return self._sensors[:, where] > 0.0

    def refresh(self) -> None:
        """Recompute the sensors of position, velocity and contact after a change of ``qpos`` or ``qvel``."""
        self._batch.forward(stage=_NOW)

    def reset(self, which: Any = None) -> None:
        """Reset the robots ``which`` (indices; None: all) to the first keyframe, at rest."""
        which = np.arange(self.count) if which is None else np.asarray(which)
        self._batch.reset(which, keyframe=0, stage=_NOW)
        self.broken[which], self._driven[which] = False, 0.0
        self._sent[:, which] = self._start[which]
        if self._network:
            self._network.reset(which)

    def set_gains(self, stiffness: Floats, damping: Floats) -> None:
        """Set the servo gains: (D,) or (N, D) [N m/rad] and [N m s/rad], in the contract's order.

        Damping is clipped to half of inertia / timestep, because more is unstable at this time step.
        Real drives use a shorter time step.
        Motors that are not servos keep the scene's gains. If the stiffness is zero, they are switched off.
        """
        scene, dofs, motors = self.model.dof_damping[self._dofs].ravel(), self._dofs, self.contract.motors
        stable = np.maximum(scene, 0.5 / (self.model.dof_invweight0[dofs] * self.contract.timestep))
        if motors.law == "servo":
            self._batch.expand("actuator_gainprm")[:, self._actuators, 0] = stiffness
            self._batch.expand("actuator_biasprm")[:, self._actuators, 1] = -stiffness
        else:
            for name in ("actuator_gainprm", "actuator_biasprm", "actuator_gear"):
                self._batch.expand(name)[:] = getattr(self.model, name)
            if not stiffness.any():
                motors.limp(self._batch)
        changes_damping = motors.law == "servo" or not stiffness.any()
        self._batch.expand("dof_damping")[:, dofs] = np.minimum(damping, stable) if changes_damping else scene

    def set_delay(self, seconds: Floats) -> None:
        """Delay the targets of each robot's motors by (N,) [s], rounded up to whole physics steps."""
        self._late = np.ceil(seconds / self.model.opt.timestep - 1e-6).astype(int)
        periods = 1 + -(-int(self._late.max()) // self.contract.decimation)
        self._sent = np.repeat(self._start[None], periods, axis=0)

    def scale_gains(self, factor: Floats) -> None:
        """Multiply each robot's stiffness and damping by ``factor`` (N,). Motors without gains: their torque."""
        law, shape = self.contract.motors.law, (-1, 1)
        gains = {"servo": (0,), "dc_motor": (DC_STIFFNESS, DC_DAMPING)}.get(law, ())
        for column in gains:
            self._batch.expand("actuator_gainprm")[:, self._actuators, column] *= factor.reshape(shape)
        if law == "servo":
            self._batch.expand("actuator_biasprm")[:, self._actuators, 1:3] *= factor.reshape(-1, 1, 1)
        if law == "servo" and self.damps_by_joint:
            self._batch.expand("dof_damping")[:, self._dofs] *= factor.reshape(shape)
        if not gains:
            self._batch.expand("actuator_gear")[:, self._actuators, 0] *= factor.reshape(shape)

    @property
    def damps_by_joint(self) -> bool:
        """True if the joints have the servos' damping, as in an export. In a user's scene the actuators have it."""
        return self.contract.motors.law == "servo" and not self.model.actuator_biasprm[self._actuators, 2].any()

    def add_load(self, body: int, mass: Floats) -> None:
        """Add ``mass`` (N,) [kg] to ``body`` of each robot. Its inertia is scaled in proportion."""
        ratio = 1.0 + mass / self.model.body_mass[body]
        self._batch.expand("body_mass")[:, body] *= ratio
        self._batch.expand("body_inertia")[:, body] *= ratio[:, None]
        self._batch.set_const()

    def set_friction(self, friction: Floats) -> None:
        """Set the sliding friction (N,) of all contacts of each robot; NaN: the scene's."""
        mask = np.isfinite(friction)
        self._batch.expand("geom_friction")[mask, :, 0] = friction[mask, None]
        if self.model.npair:
            self._batch.expand("pair_friction")[mask, :, :2] = friction[mask, None, None]

    def _value(self, name: str) -> Floats:
        if name == "gravity":
            return self._gravity()
        if name in (ATTITUDE, POSITION):
            return self.qpos[:, 3:7].copy() if name == ATTITUDE else self.qpos[:, :3].copy()
        if any(row.name == name and row.measured == SCAN for row in self.contract.rows):
            return self._scan()
        if name == "foot_contact":
            feet = [(self._sensors[:, where] > 0.0).any(axis=1) for where in self._contacts]
            return np.stack(feet, axis=1).astype(float) if feet else np.zeros((self.count, 0))
        return self._sensors[:, self._where[name]]

    def _gravity(self) -> Floats:
        """Direction of gravity (N, 3), body frame. A simulated slope tilts gravity towards the world's x axis."""
        up, (x, _, z) = (
            self._sensors[:, self._where["up"]],
            self.model.opt.gravity / np.linalg.norm(self.model.opt.gravity),
        )
        if not x:
            return -up
        w, i, j, k = self.qpos[:, 3:7].T
        return z * up + x * np.stack(
            [1.0 - 2.0 * (j * j + k * k), 2.0 * (i * j - w * k), 2.0 * (i * k + w * j)], axis=1
        )

    def _scan(self) -> Floats:
        """The contract's height scan (N, points) [m]."""
        assert self.contract.scan
        xs, ys, standing = self.contract.scan
        px, py = (grid.ravel() for grid in np.meshgrid(xs, ys, indexing="ij"))
        return np.clip(self._heights(px, py) - standing, -1.0, 1.0)

    def _heights(self, px: ArrayLike, py: ArrayLike) -> Floats:
        """Height (N, points) [m] of each root above the ground, at points ``px`` ahead and ``py`` to the left [m].

        Rays from above measure it. They hit geom group 0 only. Without ground the height is inf.
        """
        px, py, root, (w, x, y, z) = np.asarray(px), np.asarray(py), self.qpos[:, :3], self.qpos[:, 3:7].T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))[:, None]
        start = np.empty((self.count, len(px), 3))
        start[..., 0] = root[:, :1] + np.cos(yaw) * px - np.sin(yaw) * py
        start[..., 1] = root[:, 1:2] + np.sin(yaw) * px + np.cos(yaw) * py
        start[..., 2] = root[:, 2:] + _ABOVE
        distance, _ = self._batch.ray(start, [0.0, 0.0, -1.0], geomgroup=_GROUND_GROUP)
        return np.where(distance < 0.0, np.inf, distance - _ABOVE)


class MujocoRobot(Robot):
    """One simulated robot. ``write``, ``damp`` and ``limp`` advance the simulation by one period."""

    def __init__(
        self,
        folder: Path,
        contract: Contract,
        scene_file: str = SCENE_FILE,
        *,
        whole: bool = False,
        hoisted: bool = False,
        lift: float = 0.0,
    ) -> None:
        """Load the robot. ``whole``: the whole body can touch the ground.

        ``hoisted``: the base hangs ``lift`` [m] above its start position until ``write`` is called without gains.
        """
        self.fleet, self.hoisted = Fleet(folder, contract, 1, threads=1, scene_file=scene_file, whole=whole), hoisted
        self._targets, self._gains, self._closed = contract.default_pose, (contract.stiffness, contract.damping), False
        self._start, self.can_change_gains = self.fleet.qpos[0, :7].copy(), contract.motors.law == "servo"
        self._start[2] += lift
        self._lift = lift

    def read(self) -> Measurement:
        return self.fleet.read().of(0)

    def write(self, targets: Floats, *, stiffness: Floats | None = None, damping: Floats | None = None) -> None:
        contract, self.hoisted = self.fleet.contract, self.hoisted and stiffness is not None
        gains = (
            contract.stiffness if stiffness is None else stiffness,
            contract.damping if damping is None else damping,
        )
        self._move(np.asarray(targets), *gains)

    def damp(self) -> None:
        self._move(self._targets, 0.0 * self._gains[0], damped(self.fleet.contract))

    def limp(self) -> None:
        self._move(self._targets, 0.0 * self._gains[0], 0.0 * self._gains[1])

    def lower(self) -> None:
        """Lower a hanging robot to the ground. A robot with two feet stays on the hoist."""
        if self.hoisted:
            self._start[2], self._lift = self._start[2] - self._lift, 0.0
            self.fleet.qpos[0, :7], self.fleet.qvel[0, :6] = self._start, 0.0
            self.fleet.refresh()
            self.hoisted = len(self.fleet.contract.feet) == 2

    def close(self) -> None:
        """Damp the joints until the end. A later ``write`` does not change the gains."""
        self._set(0.0 * self._gains[0], damped(self.fleet.contract))
        self._closed = True

    def fell(self) -> bool:
        return bool(self.fleet.fell()[0])

    def _move(self, targets: Floats, stiffness: Floats, damping: Floats) -> None:
        """Advance by one period."""
        if not self._closed:
            self._set(stiffness, damping)
        self._targets = targets
        self.fleet.write(targets.reshape(1, -1))
        if self.hoisted:
            self.fleet.qpos[0, :7], self.fleet.qvel[0, :6] = self._start, 0.0
            self.fleet.refresh()

    def _set(self, *gains: Floats) -> None:
        """Set gains only if they changed."""
        if any((new != old).any() for new, old in zip(gains, self._gains, strict=True)):
            self.fleet.set_gains(*gains)
            self._gains = gains


def _keep_quiet() -> None:
    """Stop MuJoCo from printing and from writing a log file. ``Fleet.broken`` counts the errors."""
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    config.set()


# ---- scene ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DeployScene:
    """The robot's model in MuJoCo, and the indices of the contract's names."""

    spec: mujoco.MjSpec
    model: mujoco.MjModel  # compiled from `spec`
    actuators: np.ndarray  # (D,) index of each joint's servo in ctrl
    dofs: np.ndarray  # (D,) index of each joint in qvel
    sensordata: dict[str, np.ndarray]  # quantity, or name of a row with its own sensors -> indices in sensordata
    contacts: list[np.ndarray]  # per foot: indices of its contact sensors in sensordata


def enter_scene(folder: Path, contract: Contract, file: str | Path, whole: bool) -> tuple[DeployScene, Contract]:
    """The scene, and the contract for it. Raises ContractError, and UserError for a user's scene that does not fit."""
    if isinstance(file, str):
        return read_scene(folder, contract, file, whole), contract
    spec, contract = fit(file, folder, contract)
    return _find_all(spec, spec.compile(), file.name, contract), contract


def read_scene(folder: Path, contract: Contract, file: str = SCENE_FILE, whole: bool = False) -> DeployScene:
    """Load ``file`` of an export and check that it is the contract's robot. Raises ContractError.

    ``whole``, for a lying robot: every body with collision shapes (group 3) can touch the ground, and the solver uses
    MuJoCo's default iterations. Training has contacts of few bodies and fewer iterations. Bodies that have contacts,
    such as feet, stay unchanged.
    """
    if file == TERRAIN_FILE and not ((folder / file).is_file() and (contract.terrain or not contract.scene)):
        raise ContractError(
            f"no {file} in {folder}; an export has one if its task had steps or blocks; export an older one again"
        )
    part(folder, file)
    try:
        spec = XmlSource(folder / file, alone=True).spec()
        for body in spec.bodies[1:] if whole else ():
            shapes = [geom for geom in body.geoms if geom.group == SHAPES]
            for geom in shapes if not any(geom.conaffinity for geom in shapes) else ():
                geom.conaffinity = 1
        model = spec.compile()
        check_model(model)
        _check_start(spec, model)
        if whole:
            model.opt.iterations, model.opt.ls_iterations = 100, 50  # MuJoCo's defaults
    except ValueError as error:
        raise ContractError(f"{file} is not a valid MJCF: {' '.join(str(error).split())}") from None
    scene = _find_all(spec, model, file, contract)
    _check_order(model, contract)
    joints = [model.joint(name).id for name in contract.joints]
    _check_machine(model, file, contract, joints, scene.actuators.tolist())
    return scene


def _find_all(spec: mujoco.MjSpec, model: mujoco.MjModel, file: str, contract: Contract) -> DeployScene:
    """Find joints, servos and sensors by name."""
    joints = [_index(model, file, "joint", name, "joint") for name in contract.joints]
    actuators = [_index(model, file, "actuator", name, "servo") for name in contract.joints]
    needed = [*SENSED, *([FALL] if contract.ends.falls_on else [])]
    if missing := [name for name in needed if name not in contract.sensors]:
        raise ContractError(
            f"{CONTRACT_FILE}: sensors: '{missing[0]}' is missing; name the sensors of {file} that measure it"
        )
    own = {row.name: row for row in contract.rows if row.sensors}
    named, places = {**contract.sensors, **{name: row.sensors for name, row in own.items()}}, {}
    for name, sensors in named.items():
        places[name] = _places(model, file, sensors, name)
        size = own[name].size if name in own else quantity_size(contract, name)
        if len(places[name]) != size:
            raise ContractError(
                f"{file}: the sensors of '{name}' ({', '.join(sensors)}) have {len(places[name])} values, not {size}"
            )
    feet = [_places(model, file, names, foot) for foot, names in contract.feet.items()]
    return DeployScene(spec, model, np.array(actuators), model.jnt_dofadr[joints], places, feet)


def _check_start(spec: mujoco.MjSpec, model: mujoco.MjModel) -> None:
    """Raise ValueError if the first keyframe is not a valid start pose."""
    # without it, `size nkey` gives the model a keyframe of straight legs
    if not spec.keys or not len(spec.keys[0].qpos):
        raise ValueError("it has no keyframe; the first keyframe is the start pose")
    if not np.any(model.opt.gravity):
        raise ValueError("it has no gravity")
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    if not 0.9 < np.linalg.norm(data.qpos[3:7]) < 1.1 or np.abs(data.qpos).max() > _FAR:
        raise ValueError(
            "its first keyframe is not a pose: the root's quaternion does not have length 1, or a value is too large"
        )
    mujoco.mj_forward(model, data)
    depths = [contact.dist for contact in data.contact if 0 in model.body_weldid[model.geom_bodyid[contact.geom]]]
    planes = (model.geom_bodyid == 0) & (model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
    if (lowest := min([0.0, *depths, *(data.qpos[2] - model.geom_pos[planes, 2])])) < -_DEEP:
        raise ValueError(f"its first keyframe is {-lowest:.2g} m under the ground")


def _index(model: mujoco.MjModel, file: str, kind: str, name: str, word: str) -> int:
    index = mujoco.mj_name2id(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), name)
    if index < 0:
        raise ContractError(f"{CONTRACT_FILE}: joints: {unknown(word, name, _names(model, kind), file)}")
    return index


def _names(model: mujoco.MjModel, kind: str) -> list[str]:
    count = {"joint": model.njnt, "actuator": model.nu, "sensor": model.nsensor}[kind]
    names = [mujoco.mj_id2name(model, getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}"), i) for i in range(count)]
    return [name for name in names if name]


def _places(model: mujoco.MjModel, file: str, sensors: Sequence[str], what: str) -> np.ndarray:
    """Indices in sensordata of all values of ``sensors``."""
    spans = []
    for name in sensors:
        index = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SENSOR, name)
        if index < 0:
            raise ContractError(
                f"{CONTRACT_FILE}: sensors of '{what}': {unknown('sensor', name, _names(model, 'sensor'), file)}"
            )
        spans.append(np.arange(model.sensor_adr[index], model.sensor_adr[index] + model.sensor_dim[index]))
    return np.concatenate(spans)


def _check_order(model: mujoco.MjModel, contract: Contract) -> None:
    """Check that the joint sensors are in the contract's order."""
    for name, sensors in ((name, contract.sensors[name]) for name in ("joint_pos", "joint_vel")):
        for joint, sensor in zip(contract.joints, sensors, strict=True):
            if (measured := model.joint(int(model.sensor(sensor).objid[0])).name) != joint:
                raise ContractError(
                    f"{CONTRACT_FILE}: joints are in another order than sensors: {name}, where {sensor} measures {measured} "
                    f"in the place of {joint}; export the policy again"
                )


def _check_machine(
    model: mujoco.MjModel, file: str, contract: Contract, joints: Sequence[int], actuators: Sequence[int]
) -> None:
    """Check joints, gains, ranges, mass and time step against the contract."""
    if model.nq != 7 + len(joints) or model.nu != len(joints):
        others = [name for name in _names(model, "joint") if name not in contract.joints]
        raise ContractError(
            f"{file} has joints that {CONTRACT_FILE} does not: {', '.join(others[1:]) or f'{model.nu} servos'}"
        )
    dofs, motors = model.jnt_dofadr[list(joints)], contract.motors
    stated = {"stiffness": contract.stiffness, "damping": contract.damping}
    stated |= {"motors: stall_torque": motors.stall_torque, "motors: no_load_speed": motors.no_load_speed}
    lowest, highest = target_range(model, actuators)
    checks = {
        **{name: (stated[name], value) for name, value in contract.motors.gains(model, list(actuators), dofs).items()},
        "action: lowest": (contract.action.lowest, lowest),
        "action: highest": (contract.action.highest, highest),
        "robot: mass": (contract.mass, model.body_subtreemass[0]),
        "physics: timestep": (contract.timestep, model.opt.timestep),
    }
    for name, values in checks.items():
        if not np.allclose(*values, rtol=1e-4, atol=1e-6):
            expected, actual = (
                np.array2string(np.asarray(x), precision=6, separator=", ", max_line_width=10_000) for x in values
            )
            raise ContractError(
                f"{CONTRACT_FILE}: {name} is {expected}, but {file} has {actual}; change both, or export the policy again"
            )
