"""From a config to the robot that the simulator steps, and the place where it starts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import torch
from torch import Tensor

from legged_mw.envs.motors import motor_curves, motor_drive, motor_gains
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.envs.wording import config_words
from legged_mw.sim.joints import PARTIAL
from legged_mw.sim.model import Ground, RobotModel, Solver, build_model, standing_height
from legged_mw.sim.terrain import Terrain
from legged_mw.utils.config import ConfigError
from legged_mw.utils.files import find_file


def load_robot(
    cfg: RobotTaskCfg,
    law: str,
    engine: str,
    terrain: Terrain | None,
    contact_geoms: Sequence[str],
    sites: Mapping[str, Sequence[str]],
    more_sensors: Collection[str] = (),
) -> RobotModel:
    """The robot of ``asset.file``, with what the config says of its joints, contacts and sensors, and motors of ``law``."""
    asset, scale = cfg.asset, cfg.control.action_scale
    stiffness, damping = motor_gains(cfg, law)
    if not asset.file:
        raise ConfigError("asset.file is empty; name the robot's MJCF or URDF, e.g. 'resources/robots/go1/go1.xml'")
    robot = build_model(
        find_file(cfg, "asset.file"),
        solver=Solver(cfg.sim.dt, cfg.sim.iterations, cfg.sim.ls_iterations, cfg.sim.integrator),
        ground=Ground(
            cfg.terrain.friction, cfg.terrain.condim, terrain, boxes=engine == "mujoco", slope=cfg.terrain.slope
        ),
        stiffness=stiffness,
        damping=damping,
        colliders=asset.colliders,
        self_collisions=asset.self_collisions,
        contact_geoms=contact_geoms,
        velocity_sites=list(sites),
        imu_site=asset.imu_site,
        sites=sites,
        pose=cfg.init_state.default_joint_angles,
        tables={
            "control.action_scale": scale if isinstance(scale, Mapping) else {"": scale},
            "rewards.pose_weights": cfg.rewards.pose_weights,
            **motor_curves(cfg, law),
            "rewards.deviation_weights": cfg.rewards.deviation_weights,
        },
        held_joints=asset.held_joints,
        partial={name: getattr(asset, name) for name in PARTIAL},
        more_sensors=more_sensors,
        drive=motor_drive(cfg, law),
    )
    robot.overrides[:] = [config_words(line) for line in robot.overrides]
    return robot


def start_place(cfg: RobotTaskCfg, robot: RobotModel, colliders: Sequence[str]) -> list[float]:
    """x, y, z of the root [m]: the config's; or with its feet as high above the ground as in the keyframe; or with the lowest foot on it.

    Without feet it is the lowest of the ``colliders``.
    """
    if cfg.init_state.pos:
        return list(cfg.init_state.pos)
    feet = [geom for geoms in robot.site_geoms.values() for geom in geoms]
    feet = feet or robot.names.find(colliders, "asset.colliders", colliding=True)
    if robot.keyframe is None or robot.keyframe.height is None:
        return [0.0, 0.0, standing_height(robot, feet, robot.pose)]
    read = tuple(robot.keyframe.angles[name] for name in robot.joint_names)
    lower = 0.0 if read == robot.pose else standing_height(robot, feet, read) - standing_height(robot, feet, robot.pose)
    return [0.0, 0.0, robot.keyframe.height - lower]


def soft_limits(robot: RobotModel, share: float, device: str | torch.device) -> tuple[Tensor, Tensor]:
    """Lowest and highest angle (D,) [rad]: ``share`` of each joint's range, about its middle; infinite where it has no limits."""
    low, high = torch.tensor(robot.joint_range, dtype=torch.float, device=device).unbind(dim=1)
    middle, half = (low + high) / 2, (high - low) / 2 * share
    limited = half.isfinite()
    return torch.where(limited, middle - half, low), torch.where(limited, middle + half, high)
