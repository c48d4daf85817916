"""A robot and its ground to be looked at: scene, camera and relief around the spec of a model. Nothing here is stepped."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from legged_mw.sim.ground import GROUND, Ground, add_ground
from legged_mw.sim.model import RobotModel
from legged_mw.sim.relief import add_relief
from legged_mw.sim.scene import GROUND_MATERIAL, add_scene
from legged_mw.sim.terrain import Terrain

CAMERA = (0.9, -1.1, 0.6)  # place of the camera "track" relative to the robot's centre of mass [m]


def visual_model(robot: RobotModel, camera: Sequence[float] = CAMERA) -> mujoco.MjModel:
    """``robot`` with its visual geoms: same qpos, qvel and bodies as what is stepped. Takes a second where the terrain is large."""
    return visual_spec(robot, camera).compile()


def visual_spec(robot: RobotModel, camera: Sequence[float] = CAMERA) -> mujoco.MjSpec:
    """What ``visual_model`` is compiled from."""
    spec = dressed(robot, camera)
    if robot.terrain:
        add_relief(spec, robot.terrain, GROUND)
    return spec


def dressed(robot: RobotModel, camera: Sequence[float] = CAMERA) -> mujoco.MjSpec:
    """A copy of the robot's spec with a scene and a camera; its terrain is still the one height field."""
    spec = robot.spec.copy()
    _add_scene(spec)
    _add_camera(spec, robot.root, camera)
    return spec


def ground_model(terrain: Terrain) -> mujoco.MjModel:
    """The ground alone, to be looked at from afar."""
    spec = mujoco.MjSpec()
    add_ground(spec, Ground(terrain=terrain), "the ground", [])
    _add_scene(spec)
    add_relief(spec, terrain, GROUND, squares=False)
    return spec.compile()


def _add_scene(spec: mujoco.MjSpec) -> None:
    add_scene(spec)
    spec.geom(GROUND).material = GROUND_MATERIAL


def _add_camera(spec: mujoco.MjSpec, root: str, place: Sequence[float]) -> None:
    """A camera "track" that keeps its distance and looks at the robot."""
    away = np.array(place, dtype=float) / np.linalg.norm(place)  # a camera looks along its -z
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(away, right), away], axis=1).ravel())
    spec.body(root).add_camera(name="track", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=list(place), quat=quat)
