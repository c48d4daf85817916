"""Make the contract and the scenes of an export from the training environment."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import (
    CLOCK,
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
    make_ratings,
    target_range,
)
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.legged_robot_config import LeggedRobotCfg
from legged_mw.envs.motors import OWN as OWN_LAW
from legged_mw.envs.motors import motor_drive
from legged_mw.envs.robot_task import RobotTask
from legged_mw.export.network import INPUT, OUTPUT
from legged_mw.export.replay import ExportError, own_ends
from legged_mw.export.scene import Scene, among_steps, standalone
from legged_mw.rl.students.estimator import find_targets
from legged_mw.robot.mjcf import write_archive
from legged_mw.sim.model import ModelError
from legged_mw.sim.servos import CURVE
from legged_mw.sim.terrain import LEVEL, make_terrain
from legged_mw.skills.clip import save_clip
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.utils.files import digest, find_file
from legged_mw.utils.task import LoadedTask


def make_contract(env: RobotTask, task: LoadedTask, folder: Path, noise: float) -> Contract:
    """Make the contract of the network in ``folder``, trained with the noise level ``noise``. Writes the scene, too."""
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
        ratings=make_ratings(env.ratings, cfg.ratings.battery_power or None, len(robot.joint_names)),
        motion=_motion(env, folder),
        estimate=_estimated(env, task),
        scene=digest(folder / SCENE_FILE),
    )


def _exam(task: LoadedTask) -> dict[str, Any] | None:
    """The exam of an export: the section ``exam``, and its kind if that is not the walking exam."""
    section = task.cfg.to_dict().get("exam", {})
    if task.exam == "walking":  # without the task's own fields
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
    """Write the robot in its start pose as MJCF."""
    cfg, robot, law = env.cfg, env.robot, env.actuators.law
    if law == OWN_LAW:
        raise ExportError(
            f"{type(env).__name__}._compute_torques is a motor law in code, which an export cannot contain; "
            "train the policy that is to be exported with a law of control.actuator (docs/motors.md)"
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
    """The law of the motors. A network's file is copied to ``folder``."""
    curve = (tuple(env.robot.tables.get(name, ())) for name in CURVE)
    if env.actuators.law == "network":
        shutil.copyfile(find_file(env.cfg, "control.network"), folder / MOTORS_FILE)
    return Motors(
        env.actuators.law, *curve, digest=digest(folder / MOTORS_FILE) if env.actuators.law == "network" else ""
    )


def _motion(env: RobotTask, folder: Path) -> FollowedMotion | None:
    """The reference motion of the policy. Its frames are written to ``folder``."""
    if not isinstance(env, MotionTracking):
        return None
    save_clip(folder / MOTION_FILE, env.clips[0])
    return FollowedMotion(env.cfg.motion.anchor, tuple(env.cfg.motion.bodies), digest(folder / MOTION_FILE))


def _ends(env: RobotTask) -> Ends:
    """The task's rules for a fall."""
    rule, geoms = env.cfg.termination, [env.robot.contact_geoms[i] for i in env.terminating_contacts.tolist()]
    tilt = rule.max_tilt if rule.max_tilt < 180.0 else None
    return Ends(tilt, rule.min_base_height or None, tuple(geoms), own_ends(type(env)))


def _gait(env: RobotTask) -> Gait:
    """The gait clock of a row."""
    assert isinstance(env, LeggedRobot) and env.gait
    return Gait(env.cfg.gait.period, tuple(env.gait.offsets), env.cfg.rewards.min_command)


def contract_rows(env: RobotTask, group: str, noise: float) -> list[ContractRow]:
    """A group's rows, with their sensors if known. A row that is a group is replaced by its rows."""
    rows = []
    for row in env.observations.groups[group]:
        if row.group:
            if row.noise or row.history > 1 or any(scale != 1.0 for scale in row.column_scales()):
                raise ExportError(
                    f"observation row '{row.name}' of '{group}' is a group with its own noise, scale or history: "
                    "give those to its rows"
                )
            rows += contract_rows(env, row.group, noise)
            continue
        # the task's own clock
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


def write_terrain(env: RobotTask, task: LoadedTask, folder: Path) -> str:
    """Write the scene with steps and blocks of the trained kinds, at three levels. Returns why there is none, or ''."""
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
