"""Run the hard exam of ``legged_mw.eval.hard`` on an export: all conditions in parallel, then the gait of one robot."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import SCENE_FILE, Contract, Ends, compile_scene, read_contract
from legged_mw.deploy.robot import Floats, Measurement
from legged_mw.deploy.simulated import Fleet, trunk_of
from legged_mw.deploy.stage import DeployStage
from legged_mw.deploy.user_scene import torque_limits
from legged_mw.eval import hard
from legged_mw.eval.hard import CONDITIONS, NOISE, Walk
from legged_mw.eval.walking import GRAVITY, ExamRules
from legged_mw.utils.commands import VELOCITY
from legged_mw.view.posed_robot import lowest_point, show_groups
from legged_mw.view.recorder import as_png, contact_sheet, make_renderer
from legged_mw.view.stage import ViewError

LOOK_SECONDS = 10.0  # [s] duration of the gait measurement, with the settling time
PICTURES, WIDTH, HEIGHT = 6, 240, 260  # number of pictures of one stride; [px] size of each
SEED = 1  # seed of the noise


def run_hard(
    folder: Path,
    rules: ExamRules,
    walks: bool,
    edited: bool = False,
    scene: str | Path = SCENE_FILE,
    seed: int = 0,
    contact: str | None = None,
) -> tuple[dict[str, Any], list[Floats]]:
    """The hard exam's result, and qpos (nq,) at PICTURES times of a stride; no qpos if the robot fell.

    ``walks``: the verdict of the walking exam. ``edited``: see read_contract. ``scene``: see Fleet. ``seed``: of the
    noise and of the start (see ``scatter``). ``contact``: see DeployStage. Raises ContractError, UserError.
    """
    contract = read_contract(folder, edited)
    load = hard.load_of(rules, contract.mass)
    make = partial(DeployStage, folder, edited=edited, scene_file=scene, contact=contact)
    conditions = run_conditions(make, contract, rules, load, seed)
    walk, poses = look(make, contract, rules, seed)
    figures = hard.looks(walk) if walk else None
    return hard.finish(rules, walks, conditions, figures, len(contract.feet), load), poses


# ---- the conditions -------------------------------------------------------------------------------------------------


def run_conditions(
    make: Callable[..., DeployStage], contract: Contract, rules: ExamRules, load: float, seed: int = 0
) -> dict[str, Any]:
    """Condition -> falls, errors, drift and pushes. Each condition has its own worlds.

    ``make``: DeployStage with folder, scene and source of velocity given.
    """
    velocities = [*hard.commands(rules), *[(hard.half_speed(rules), 0.0, 0.0)] * hard.PUSH_DIRECTIONS]
    count = len(velocities) * len(CONDITIONS)
    commands = commands_of(contract, velocities * len(CONDITIONS))
    ends = Ends(max_tilt=90.0, falls_on=contract.ends.falls_on)  # as in legged_mw.eval.rollout
    stage = make(count, ends=ends)
    stage.scatter(seed)
    apply_conditions(stage, np.repeat(np.arange(len(CONDITIONS)), len(velocities)), load, seed)
    ends_of_groups = range(len(velocities), count + 1, len(velocities))
    groups = [(end - hard.PUSH_DIRECTIONS, hard.push_speed(len(contract.feet))) for end in ends_of_groups]
    fell_at, velocity, position = np.full(count, math.inf), [], []
    for step in range(round(hard.SECONDS / stage.dt)):
        velocity.append(stage.velocity())
        position.append(stage.qpos()[:, :2])
        push_around(stage, step - round(hard.PUSH_AT / stage.dt), groups, hard.PUSH_DIRECTIONS)
        stage.step(commands)
        fell_at[stage.fell() & np.isinf(fell_at)] = step
    speeds, positions, results = np.stack(velocity), np.stack(position), {}
    for i, condition in enumerate(CONDITIONS):
        own = slice(i * len(velocities), (i + 1) * len(velocities))
        results[condition.name] = hard.grade_condition(rules, speeds[:, own], positions[:, own], fell_at[own], stage.dt)
    return results


def commands_of(contract: Contract, velocities: Sequence[Sequence[float]]) -> Floats:
    """Commands (N, C): ``velocities`` (N, 3) are vx, vy, yaw rate; other commands have their defaults."""
    names = [command.name for command in contract.commands]
    commands = np.tile([command.default for command in contract.commands], (len(velocities), 1))
    commands[:, [names.index(name) for name in VELOCITY]] = velocities
    return commands


def apply_conditions(stage: DeployStage, which: NDArray[np.int64], load: float, seed: int = 0) -> None:
    """Apply condition ``CONDITIONS[which[i]]`` to world i. ``load`` [kg] is added to the heaviest body."""
    fleet = stage.fleet
    fleet.set_delay(np.array([each.delay / 1000.0 for each in CONDITIONS])[which])
    fleet.scale_gains(np.array([each.gains for each in CONDITIONS])[which])
    fleet.add_load(trunk_of(fleet.model), np.array([load * each.loaded for each in CONDITIONS])[which])
    friction = [math.nan if each.friction is None else each.friction for each in CONDITIONS]
    fleet.set_friction(np.array(friction)[which])
    noisy, random = (
        np.array([float(each.noisy) for each in CONDITIONS])[which][:, None],
        np.random.default_rng(SEED + seed),
    )

    def disturb(measured: Measurement) -> Measurement:
        shapes = {name: getattr(measured, name).shape for name in NOISE}
        noise = {name: noisy * random.uniform(-NOISE[name], NOISE[name], shape) for name, shape in shapes.items()}
        return replace(measured, **{name: getattr(measured, name) + value for name, value in noise.items()})

    stage.disturb = disturb


def push_around(stage: DeployStage, k: int, groups: Sequence[tuple[int, float]], directions: int) -> None:
    """Push robot k of each group in direction k, world frame. ``groups``: first world, speed [m/s]."""
    if 0 <= k < directions:
        angle = 2.0 * math.pi * k / directions
        for first, speed in groups:
            stage.push(first + k, [speed * math.cos(angle), speed * math.sin(angle)])


# ---- the gait of one robot ------------------------------------------------------------------------------------------


def look(
    make: Callable[..., DeployStage], contract: Contract, rules: ExamRules, seed: int = 0
) -> tuple[Walk | None, list[Floats]]:
    """Record a walk ahead at half of the highest vx, and the qpos of one stride. None if the robot falls.

    ``make``: see run_conditions.
    """
    ends = Ends(max_tilt=90.0, falls_on=contract.ends.falls_on)
    recorder: list[Witness] = []
    stage = make(1, threads=1, ends=ends, change=_solve_well, each=lambda: recorder[0].sample())
    recorder.append(Witness(stage.fleet))  # before scatter, because the feet must be level
    stage.scatter(seed)
    commands = commands_of(contract, [(hard.half_speed(rules), 0.0, 0.0)])
    targets, poses, settling = [], [], round(hard.SETTLING / stage.dt)
    for step in range(round(LOOK_SECONDS / stage.dt)):
        stage.step(commands)
        if stage.fell()[0]:
            return None, []
        if step == settling - 1:
            recorder[0].forget()
        if step >= settling:
            targets.append(stage.controller.last_targets[0].copy())
            poses.append(stage.qpos()[0])
    walk = recorder[0].walk(np.array(targets))
    rate = hard.looks(walk)["strides"] or 1.0
    stride = np.linspace(0.0, min(1.0 / rate / stage.dt, len(poses)), PICTURES, endpoint=False).astype(int)
    return walk, [poses[len(poses) - 1 - stride[-1] + i] for i in stride]


def _solve_well(model: mujoco.MjModel) -> None:
    """Use MuJoCo's default iterations. After one, as in training, a foot force is random, up to 12 robot weights."""
    model.opt.iterations, model.opt.ls_iterations = max(model.opt.iterations, 100), max(model.opt.ls_iterations, 50)


class Witness:
    """A recorder of one robot at each physics step, for ``hard.looks``."""

    def __init__(self, fleet: Fleet) -> None:
        """``fleet`` has one robot in its start pose and calls ``sample`` at each physics step."""
        self.fleet, self.model, contract = fleet, fleet.model, fleet.contract
        self.trunk, self.feet = trunk_of(fleet.model), feet_of(fleet)
        self._joints = [self.model.joint(name).id for name in contract.joints]
        self._angles = self.model.jnt_qposadr[self._joints]
        bodies = [self.trunk, *(int(self.model.geom_bodyid[geoms[0]]) for geoms in self.feet)]
        start = mujoco.MjData(self.model)
        start.qpos[:] = fleet.qpos[0]
        mujoco.mj_kinematics(self.model, start)
        # (1 + F, 3, 3) rotation from the world frame to each body's frame in the start pose
        self._bodies, self._level = bodies, start.xmat[bodies].reshape(-1, 3, 3).transpose(0, 2, 1).copy()
        self._data, self._now = mujoco.MjData(self.model), mujoco.MjData(self.model)
        self._rows: list[dict[str, Floats]] = []

    def forget(self) -> None:
        """Clear the record."""
        self._rows = []

    def sample(self) -> None:
        """Record this physics step."""
        data, now = self._data, self._now
        self.fleet.read_data(data)
        now.qpos[:] = data.qpos
        mujoco.mj_kinematics(self.model, now)
        rotation = now.xmat[self._bodies].reshape(-1, 3, 3) @ self._level  # (1 + F, 3, 3) rotation since the start
        up = rotation[0].T @ [0.0, 0.0, 1.0]
        x, y = now.qpos[:2]
        heading = math.atan2(rotation[0][1, 0], rotation[0][0, 0])
        positions = np.array([now.geom_xpos[geoms].mean(axis=0) for geoms in self.feet]).reshape(-1, 3)
        sideways = math.cos(heading) * (positions[:, 1] - y) - math.sin(heading) * (positions[:, 0] - x)
        self._rows.append(
            {
                "tilt": np.array([math.atan2(up[1], up[2]), math.atan2(-up[0], up[2])]),
                "sideways": sideways,
                "height": np.array([min(lowest_point(self.model, now, geom) for geom in each) for each in self.feet]),
                "sole": np.arccos(np.clip(rotation[1:, 2, 2], -1.0, 1.0)),
                "force": self._forces(data),
                "angle": now.qpos[self._angles].copy(),
                "torque": self.fleet.motor_torque()[0],
                "speed": self.fleet.motor_speed()[0],
            }
        )

    def _forces(self, data: mujoco.MjData) -> Floats:
        """(F,) [N] ground force on each foot in the last physics step."""
        total, force = np.zeros((len(self.feet), 3)), np.zeros(6)
        for i, contact in enumerate(data.contact):
            pair = [int(geom) for geom in contact.geom]
            if 0 not in self.model.body_weldid[self.model.geom_bodyid[pair]]:
                continue
            for foot, geoms in enumerate(self.feet):
                if not {*pair} & {*geoms}:
                    continue
                mujoco.mj_contactForce(self.model, data, i, force)
                total[foot] += contact.frame.reshape(3, 3).T @ force[:3]
        return np.linalg.norm(total, axis=1)

    def walk(self, targets: Floats) -> Walk:
        """The record and the policy's ``targets`` (P, D) [rad]."""
        record: dict[str, Any] = {name: np.stack([row[name] for row in self._rows]) for name in self._rows[0]}
        if not all(has_sole(self.model, geoms) for geoms in self.feet):
            record["sole"] = None
        model, contract = self.model, self.fleet.contract
        limited = model.jnt_limited[self._joints] > 0
        low, high = model.jnt_range[self._joints].T
        return Walk(
            dt=model.opt.timestep,
            period=contract.period,
            weight=float(model.body_subtreemass[0]) * GRAVITY,
            target=targets,
            low=np.where(limited, low, -np.inf),
            high=np.where(limited, high, np.inf),
            limit=torque_limits(model, self._joints),
            joints=contract.joints,
            clock=1.0 / contract.gait.period if contract.gait else None,
            of_angles=contract.action.of_angles,
            **record,
        )


def feet_of(fleet: Fleet) -> list[list[int]]:
    """The geoms of each foot, which its contact sensors watch."""
    feet = fleet.contract.feet.values()
    return [[int(fleet.model.sensor(name).objid[0]) for name in names] for names in feet]


def has_sole(model: mujoco.MjModel, geoms: Sequence[int]) -> bool:
    """Whether a foot has a flat sole. A foot of one sphere has none."""
    return len(geoms) > 1 or model.geom_type[geoms[0]] != mujoco.mjtGeom.mjGEOM_SPHERE


# ---- pictures -------------------------------------------------------------------------------------------------------


VIEWS = {"side": 90.0, "front": 180.0}  # [deg] azimuth of the camera: at the robot's right, in front of it


def strip_png(folder: Path, poses: Sequence[Floats]) -> bytes:
    """A PNG of one stride: a row from the side and a row from the front. Empty without poses or OpenGL."""
    if not poses:
        return b""
    try:
        return as_png(contact_sheet(_frames(compile_scene(folder / SCENE_FILE), poses), PICTURES))
    except ViewError as error:
        print(f"no strip of pictures: {error}")
        return b""


def _frames(model: mujoco.MjModel, poses: Sequence[Floats]) -> list[NDArray[np.uint8]]:
    """One picture per pose and view of VIEWS. Raises ViewError."""
    data, camera, option = mujoco.MjData(model), mujoco.MjvCamera(), mujoco.MjvOption()
    show_groups(option)
    renderer = make_renderer(model, WIDTH, HEIGHT)
    data.qpos[:] = poses[0]
    mujoco.mj_forward(model, data)
    robot = np.flatnonzero(model.geom_bodyid)
    height = float(data.geom_xpos[robot, 2].max())
    width = 2.0 * float(np.linalg.norm(data.geom_xpos[robot, :2] - poses[0][:2], axis=1).max())
    frames = []
    for azimuth in VIEWS.values():
        for pose in poses:
            data.qpos[:] = pose
            mujoco.mj_forward(model, data)
            camera.lookat[:] = [pose[0], pose[1], 0.55 * height]
            camera.distance, camera.azimuth, camera.elevation = 1.5 * max(height, width) + 0.5, azimuth, -8.0
            mujoco.mjv_updateCamera(model, data, camera, renderer.scene)
            renderer.update_scene(data, camera, option)
            frames.append(renderer.render())
    renderer.close()
    return frames
