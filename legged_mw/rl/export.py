"""A trained policy to take away: network, contract and scene, compared with what was trained before anything is written.

What the files mean is in ``legged_mw.deploy.contract``; nothing here is needed to run them.
"""

from __future__ import annotations

import copy
import dataclasses
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rsl_rl.models import MLPModel, RNNModel

from legged_mw.deploy.contract import (
    CLOCK,
    CONTRACT_FILE,
    FALL,
    MOTION_FILE,
    MOTORS_FILE,
    NETWORK_FILE,
    ROWS,
    SCAN,
    SCENE_FILE,
    SENSORS,
    TERRAIN_FILE,
    Action,
    Contract,
    ContractRow,
    Ends,
    Estimated,
    FollowedMotion,
    Gait,
    HeightScan,
    Motors,
    NetworkMemory,
    read_contract,
    target_range,
)
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.motors import OWN as OWN_LAW
from legged_mw.envs.motors import motor_drive
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.export_replay import ExportError, own_ends, record, replay
from legged_mw.rl.export_scene import Scene, among_steps, standalone
from legged_mw.rl.keeping import sweep
from legged_mw.rl.network import (
    ESTIMATE,
    INPUT,
    MEMORY_INPUT,
    MEMORY_OUTPUT,
    OUTPUT,
    ExportedPolicy,
    halve,
    round_weights,
    run_onnx,
    save_onnx,
)
from legged_mw.rl.policies import load_policy
from legged_mw.rl.runs import CONFIG_FILE
from legged_mw.rl.students.estimator import EstimatingModel, find_targets
from legged_mw.rl.students.recurrent import states_of
from legged_mw.robot.mjcf import write_archive
from legged_mw.sim.model import ModelError
from legged_mw.sim.servos import CURVE
from legged_mw.sim.terrain import LEVEL, make_terrain
from legged_mw.skills.clip import save_clip
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.utils.config import save_yaml
from legged_mw.utils.errors import shown
from legged_mw.utils.files import STAGED, digest, find_file, finish_moving
from legged_mw.utils.task import LoadedTask

FILES = (CONFIG_FILE, NETWORK_FILE, SCENE_FILE, CONTRACT_FILE)  # the contract last: it names the others
SOMETIMES = (TERRAIN_FILE, MOTORS_FILE, MOTION_FILE)
ONCE = ("terrain.xml",)  # what older exports had
WORLDS = 8  # of the roll-out that the export is tried on
TOLERANCE = 1e-4  # between actions of the same observation, relative above 1: float32 sums in another order


class Exported(NamedTuple):
    """What an export made."""

    files: tuple[str, ...]
    gap: float  # largest difference of an action to the trained policy's
    observations: int  # that it was tried on
    # observation rows without a statement of how to measure them: the export cannot be deployed
    unknown: tuple[str, ...]
    no_terrain: str = ""  # why there is no scene among steps though training had some; else empty
    not_covered: tuple[str, ...] = ()  # methods of the task that ended episodes in training and cannot end a walk
    half: bool = False  # the weights are rounded to float16

    def text(self, folder: Path) -> str:
        """What was written, in a line, and what stands in the way of its use."""
        rounded = ", its weights rounded to half precision" if self.half else ""
        lines = [f"written to {shown(folder)}: {', '.join(self.files)}{rounded}"]
        lines[0] += f"; actions differ from the trained policy's by {self.gap:.0e} at most"
        if self.unknown:
            names = ", ".join(self.unknown)
            lines.append(
                f"nothing says how to measure {names}: legged_mw.deploy will refuse it (docs/deploy.md, Rows of your own)"
            )
        if self.not_covered:
            names = ", ".join(self.not_covered)
            lines.append(
                f"{names} ended episodes in training; a deployed robot walks on ({CONTRACT_FILE}: ends: not_covered)"
            )
        if self.no_terrain:
            lines.append(f"no {TERRAIN_FILE}: {self.no_terrain}")
        return "\n  ".join(lines)


def export(trained: LoadedTask, checkpoint: Path, folder: Path, half: bool = False) -> Exported:
    """Write the policy in ``checkpoint``, of the task as it was ``trained``, to ``folder``: all files, or none.

    ``half``: round its weights to float16 first, and store them so: half the size. What is tried is the rounded policy.
    Raises ExportError, ContractError, ConfigError or ModelError; an earlier export in the folder stays as it was then.
    """
    precision = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")  # training may have set less, and some CPUs follow it
    try:
        with torch.random.fork_rng(devices=[]):  # the roll-out must not change the caller's draws
            torch.default_generator.manual_seed(0)
            return _export(trained, checkpoint, folder, half)
    finally:
        torch.set_float32_matmul_precision(precision)


def _export(trained: LoadedTask, checkpoint: Path, folder: Path, half: bool) -> Exported:
    task = copy.deepcopy(trained)
    config, noise = task.to_dict(), task.cfg.noise.level
    ground = getattr(task.cfg.terrain, "mesh_type", "plane")
    env = _small_env(task)
    policy = load_policy(checkpoint, env, task.train, "cpu")
    groups, clip, exact = task.train.obs_groups.actor, task.cfg.normalization.clip_actions, copy.deepcopy(policy)
    if half:
        round_weights(policy)
    with _all_or_nothing(folder) as new:
        save_yaml(new / CONFIG_FILE, config)
        _write_network(policy, clip, new / NETWORK_FILE, half)
        memory = NetworkMemory(MEMORY_INPUT, MEMORY_OUTPUT, states_of(policy)) if isinstance(policy, RNNModel) else None
        contract = dataclasses.replace(make_contract(env, task, new, noise), memory=memory)
        no_terrain = _write_terrain(env, task, new) if ground != "plane" else ""
        contract = dataclasses.replace(
            contract, terrain=digest(new / TERRAIN_FILE) if (new / TERRAIN_FILE).is_file() else ""
        )
        save_yaml(new / CONTRACT_FILE, contract.to_dict())
        steps = record(env, policy, groups, contract, new)
        observations, actions = (
            np.concatenate([getattr(step, name) for step in steps]) for name in ("observation", "actions")
        )
        remembered = np.concatenate([step.memory for step in steps]) if memory else None
        acted = run_onnx(new / NETWORK_FILE, observations, memory=remembered)
        gap = _compare(acted, np.clip(actions, -clip, clip))
        if isinstance(policy, EstimatingModel):
            _compare(
                run_onnx(new / NETWORK_FILE, observations, ESTIMATE),
                _run(policy, clip, observations)[1],
                does="estimates",
            )
        if half:
            gap = _gap(acted, _run(exact, clip, observations, remembered)[0])
        replay(env, contract, steps, new)
        if all(row.measured for row in contract.rows):
            read_contract(new)  # as every reader will
        files = (*FILES, *(name for name in SOMETIMES if (new / name).exists()))
    unknown_rows = tuple(row.name for row in contract.rows if not row.measured)
    return Exported(files, gap, len(observations), unknown_rows, no_terrain, contract.ends.not_covered, half)


def _small_env(task: LoadedTask) -> RobotTask:
    """The task as trained, kicks and pushes too, but small, on a CPU, and without slopes and what stands between a robot and its policy."""
    settings = {"env.num_envs": WORLDS, "sim.engine": "mujoco", "noise.level": 0.0}
    settings |= {f"domain_rand.{name}": [] for name in ("action_delay", "delay_ms", "observation_delay", "slope")}
    if hasattr(task.cfg, "motion"):
        settings["motion.clips"] = task.cfg.motion.clips[:1]  # that a deployed robot follows
    if hasattr(task.cfg.terrain, "mesh_type"):
        settings["terrain.mesh_type"] = "plane"  # the scene is the robot's alone
    for path, value in settings.items():
        task.set(path, value, where="export")
    return task.env_class(task.cfg, "cpu", eager=True)


def _write_network(policy: MLPModel, clip: float, path: Path, half: bool) -> None:
    try:
        save_onnx(policy, clip, path)
    except Exception as error:  # the exporter's own, one for each thing that a network may do and it may not
        first = next(iter(str(error).strip().splitlines()), type(error).__name__)
        raise ExportError(f"the network ({type(policy).__name__}) cannot be exported: {first}") from error
    if half:
        halve(policy, path)


def _run(policy: MLPModel, clip: float, *inputs: np.ndarray | None) -> list[np.ndarray]:
    """What an exported network should give: actions, and its memory or its estimate if there is one."""
    with torch.inference_mode():
        outputs = ExportedPolicy(policy, clip)(*(torch.from_numpy(values) for values in inputs if values is not None))
    return [output.numpy() for output in (outputs if isinstance(outputs, tuple) else (outputs,))]


def _gap(got: np.ndarray, wanted: np.ndarray) -> float:
    """The largest difference, relative above 1."""
    return (
        float((np.abs(got - wanted) / np.maximum(1.0, np.abs(wanted))).max())
        if got.shape == wanted.shape
        else float("inf")
    )


def _compare(got: np.ndarray, wanted: np.ndarray, does: str = "acts") -> float:
    """The largest difference; refuses a network that acts or estimates otherwise than the policy."""
    gap = _gap(got, wanted)
    if not gap <= TOLERANCE:  # NaN too
        raise ExportError(
            f"{NETWORK_FILE} {does} otherwise than the trained policy: up to {gap:g} apart on {len(wanted)} recorded observations "
            f"(at most {TOLERANCE:g} is allowed); nothing was written"
        )
    return gap


# ---- files ---------------------------------------------------------------------------------------------------------


@contextmanager
def _all_or_nothing(folder: Path) -> Iterator[Path]:
    """A temporary folder in ``folder``; once all files are in it a rename makes them the export: a kill after that leaves it to finish."""
    if folder.exists() and not folder.is_dir():
        raise ExportError(f"{folder} is a file; name a folder to export to")
    new, mine = folder / f".export.{os.getpid()}.tmp", [part for part in (folder, *folder.parents) if not part.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
        shutil.rmtree(new, ignore_errors=True)  # of a process that had this one's number
        new.mkdir()
        finish_moving(folder)  # of an export that was killed before
        sweep(folder)
        yield new
        for name in (*FILES, *SOMETIMES, *ONCE):
            (new / name).touch()  # empty: one of an earlier export, which would be another policy's
            _flush(new / name)
        _flush(new)
        os.replace(new, folder / STAGED)
        finish_moving(folder)
    except OSError as error:
        raise ExportError(f"cannot write an export to {folder}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(new, ignore_errors=True)
        with suppress(OSError):
            for part in mine:  # those that are empty: nothing was written
                part.rmdir()


def _flush(path: Path) -> None:
    """Have a file, or a folder's list of files, on the disk itself, where a power cut does not reach it."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


# ---- the contract --------------------------------------------------------------------------------------------------


def make_contract(env: RobotTask, task: LoadedTask, folder: Path, noise: float) -> Contract:
    """The contract of the network in ``folder``, trained with the noise level ``noise``; writes the scene there."""
    cfg, robot = task.cfg, env.robot
    scene = _write_scene(env, folder)
    ends = _ends(env)
    origin = "torque" if env.actuators.law == "torque" else cfg.control.action_origin
    scale, held = (
        np.array(robot.tables["control.action_scale"]),
        target_range(robot.physics, range(len(robot.joint_names))),
    )
    action = Action(origin, scale, cfg.normalization.clip_actions, *held)
    rows = tuple(row for group in task.train.obs_groups.actor for row in contract_rows(env, group, noise))
    ground, scanned = cfg.terrain, any(row.measured == SCAN for row in rows)
    feet = {foot: tuple(f"contact/{geom}" for geom in geoms) for foot, geoms in getattr(env, "foot_geoms", {}).items()}
    return Contract(
        task=task.name,
        joints=robot.joint_names,
        default_pose=np.array(robot.pose),
        action=action,
        stiffness=np.array(robot.tables["stiffness"]),
        damping=np.array(robot.tables["damping"]),
        period=round(env.dt, 9),
        timestep=cfg.sim.dt,
        decimation=cfg.control.decimation,
        commands=env.command_table,
        rows=rows,
        scan=HeightScan(tuple(ground.measured_points_x), tuple(ground.measured_points_y), env.start_place[2])
        if scanned
        else None,
        sensors={name: tuple(names) for name, names in scene.sensors.items()}
        | ({FALL: tuple(f"contact/{name}" for name in ends.falls_on)} if ends.falls_on else {}),
        gait=_gait(env) if any(row.measured == CLOCK for row in rows) else None,
        feet=feet,
        ends=ends,
        imu=robot.imu,
        mass=round(env.total_mass, 6),
        input=INPUT,
        output=OUTPUT,
        digest=digest(folder / NETWORK_FILE),
        exam=_exam(task),
        motors=_motors(env, folder),
        motion=_motion(env, folder),
        estimate=_estimated(env, task),
        scene=digest(folder / SCENE_FILE),
    )


def _exam(task: LoadedTask) -> dict[str, Any] | None:
    """What grades an export: the section ``exam``, and its kind where that is not the walking exam."""
    section = task.cfg.to_dict().get("exam", {})
    if task.exam == "walking":  # a task's own fields are no part of it
        return {name: section[name] for name in LeggedRobotCfg().to_dict()["exam"] if name in section}
    return {"kind": task.exam, **section} if task.exam else None


def _estimated(env: RobotTask, task: LoadedTask) -> tuple[Estimated, ...]:
    """The rows of the network's second output."""
    rows = [(row, ROWS.get(row.name)) for _, row in find_targets(task.train.to_dict(), env, learns=False)]
    return tuple(
        Estimated(
            row.name,
            row.value.shape[1],
            row.unit or (known.unit if known else ""),
            row.frame or (known.frame if known else ""),
        )
        for row, known in rows
    )


def _write_scene(env: RobotTask, folder: Path) -> Scene:
    """The robot in its start, as MJCF."""
    cfg, robot, law = env.cfg, env.robot, env.actuators.law
    if law == OWN_LAW:
        raise ExportError(
            f"{type(env).__name__}._compute_torques is a motor law in code, which no export can state; train the policy that is to be "
            "exported with a law of control.actuator (docs/motors.md)"
        )
    start = [*env.start_place, 1.0, 0.0, 0.0, 0.0, *robot.pose]
    if isinstance(env, MotionTracking):
        start = env.clips[0].qpos()[0].tolist()
    held = start[7:] if motor_drive(cfg, law) == "angle" else [0.0] * len(robot.pose)
    source = find_file(cfg, "asset.file").read_text(encoding="utf-8", errors="replace")
    scene = standalone(robot, robot.imu, qpos=start, ctrl=held, camera=cfg.viewer.camera, source=source)
    (folder / SCENE_FILE).write_text(scene.xml, encoding="utf-8")
    return scene


def _motors(env: RobotTask, folder: Path) -> Motors:
    """The law of the motors; a network is copied to ``folder``."""
    curve = (tuple(env.robot.tables.get(name, ())) for name in CURVE)
    if env.actuators.law == "network":
        shutil.copyfile(find_file(env.cfg, "control.network"), folder / MOTORS_FILE)
    return Motors(
        env.actuators.law, *curve, digest=digest(folder / MOTORS_FILE) if env.actuators.law == "network" else ""
    )


def _motion(env: RobotTask, folder: Path) -> FollowedMotion | None:
    """What the policy follows, whose frames are written to ``folder``."""
    if not isinstance(env, MotionTracking):
        return None
    save_clip(folder / MOTION_FILE, env.clips[0])
    return FollowedMotion(env.cfg.motion.anchor, tuple(env.cfg.motion.bodies), digest(folder / MOTION_FILE))


def _ends(env: RobotTask) -> Ends:
    """The task's rule for a fall."""
    rule, geoms = env.cfg.termination, [env.robot.contact_geoms[i] for i in env.terminating_contacts.tolist()]
    tilt = rule.max_tilt if rule.max_tilt < 180.0 else None
    return Ends(tilt, rule.min_base_height or None, tuple(geoms), own_ends(type(env)))


def _gait(env: RobotTask) -> Gait:
    """The clock that a row shows."""
    assert isinstance(env, LeggedRobot) and env.gait
    return Gait(env.cfg.gait.period, tuple(env.gait.offsets), env.cfg.rewards.min_command)


def contract_rows(env: RobotTask, group: str, noise: float) -> list[ContractRow]:
    """A group's rows with what is known of how they are measured; a row that is a group itself is written out."""
    rows = []
    for row in env.observations.groups[group]:
        if row.group:
            if row.noise or row.history > 1 or any(scale != 1.0 for scale in row.column_scales()):
                raise ExportError(
                    f"observation row '{row.name}' of '{group}' is a group with its own noise, scale or history: give those to its rows"
                )
            rows += contract_rows(env, row.group, noise)
            continue
        # a clock of the task's own
        known = ROWS.get(row.name) if row.name != CLOCK or getattr(env, "gait", None) else None
        units = ", ".join(command.unit for command in env.command_table) if row.name == "commands" else ""
        rows.append(
            ContractRow(
                name=row.name,
                size=int(row.value.shape[1]),
                unit=row.unit or (known.unit if known else "") or units,
                frame=row.frame or (known.frame if known else ""),
                noise=row.noise * noise,
                measured=SENSORS if row.sensors else known.measured if known else "",
                sensors=tuple(row.sensors),
                scale=tuple(row.column_scales()),
                history=row.history,
            )
        )
    return rows


def _write_terrain(env: RobotTask, task: LoadedTask, folder: Path) -> str:
    """The scene among steps and blocks of the kinds that were trained, at three levels; or why there is none."""
    ground = task.cfg.terrain
    kinds = [kind for kind, share in ground.terrain_proportions.items() if share > 0 and kind in LEVEL - {"flat"}]
    if not kinds:
        return ""
    terrain = make_terrain(
        levels=3,
        difficulty=(0.1, 0.7),
        proportions=dict.fromkeys(kinds, 1.0),
        columns=len(kinds),
        tile=ground.tile_size,
        cell=ground.horizontal_scale,
        border=4.0,
        seed=ground.seed,
    )
    start = terrain.origins[0, kinds.index("stairs_up") if "stairs_up" in kinds else 0] + np.array(env.start_place)
    try:
        xml = among_steps((folder / SCENE_FILE).read_text(encoding="utf-8"), terrain, start.tolist())
    except ModelError as error:
        return str(error)
    write_archive(folder / TERRAIN_FILE, xml)
    return ""
