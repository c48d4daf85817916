"""A robot and its ground to be looked at: sky, light, camera and relief around the spec of a model. Nothing here is stepped."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from legged_mw.drawing.terrain_look import add_relief, add_squares
from legged_mw.sim.ground import GROUND, Ground, add_ground
from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.sim.terrain import Terrain

GROUND_MATERIAL = "ground"  # of the floor
_ZENITH, _HORIZON = (0.22, 0.32, 0.45), (0.56, 0.63, 0.70)
# place of the camera "track", from the robot's centre of mass [reach of the robot], where none is given
CAMERA = (1.78, -2.18, 1.19)


def visual_model(robot: RobotModel, camera: Sequence[float] = ()) -> mujoco.MjModel:
    """``robot`` with its visual geoms: same qpos, qvel and bodies as what is stepped. Takes a second where the terrain is large."""
    return visual_spec(robot, camera).compile()


def visual_spec(robot: RobotModel, camera: Sequence[float] = ()) -> mujoco.MjSpec:
    """What ``visual_model`` is compiled from."""
    spec = with_scene(robot, camera)
    if robot.terrain:
        add_relief(spec, robot.terrain, GROUND)
    return spec


def with_scene(robot: RobotModel, camera: Sequence[float] = ()) -> mujoco.MjSpec:
    """A copy of the robot's spec with a scene and a camera; its terrain is still the one height field.

    ``camera``: its place from the robot, world axes [m]; empty: by the robot's size.
    """
    spec = robot.spec.copy()
    add_scene(spec)
    _add_camera(spec, robot.root, camera or [round(share * reach(robot), 1) for share in CAMERA])
    return spec


def reach(robot: RobotModel) -> float:
    """How far the robot reaches from its root with all joints at 0 [m]."""
    model, data = robot.physics, posed(robot.physics, np.zeros(len(robot.joint_names)))
    geoms = model.geom_bodyid > 0
    shapes = np.linalg.norm(data.geom_xpos[geoms], axis=1) + model.geom_rbound[geoms]
    return float(max(*np.linalg.norm(data.xpos[1:], axis=1), *shapes, 0.1))


def ground_model(terrain: Terrain) -> mujoco.MjModel:
    """The ground alone, to be looked at from afar."""
    spec = mujoco.MjSpec()
    add_ground(spec, Ground(terrain=terrain), [])
    add_scene(spec)
    add_relief(spec, terrain, GROUND, squares=False)
    return spec.compile()


def add_scene(spec: mujoco.MjSpec) -> None:
    """Give ``spec`` a sky, the material "ground", one key light that follows the first body, and render settings."""
    _add_sky(spec)
    add_squares(spec, GROUND_MATERIAL, [0.23, 0.26, 0.30], [0.28, 0.31, 0.35], [0.40, 0.43, 0.47])
    _add_light(spec)
    _set_quality(spec)
    if floor := spec.geom(GROUND):
        floor.material = GROUND_MATERIAL


def _add_camera(spec: mujoco.MjSpec, root: str, place: Sequence[float]) -> None:
    """A camera "track" that keeps its distance and looks at the robot."""
    away = np.array(place, dtype=float) / np.linalg.norm(place)  # a camera looks along its -z
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(away, right), away], axis=1).ravel())
    spec.body(root).add_camera(name="track", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=list(place), quat=quat)


def _add_sky(spec: mujoco.MjSpec) -> None:
    # the gradient runs from zenith to nadir, so the horizon is its middle; the haze has that colour, and the ground no edge
    nadir = [2 * h - z for h, z in zip(_HORIZON, _ZENITH, strict=True)]
    sky = spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, rgb1=_ZENITH, rgb2=nadir, width=512, height=3072
    )
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    spec.visual.rgba.haze = [*_HORIZON, 1.0]


def _add_light(spec: mujoco.MjSpec) -> None:
    # trackcom: the shadow map covers a few metres around the robot, wherever it walks. A directional light keeps its direction
    body = next(iter(spec.worldbody.bodies), spec.worldbody)
    body.add_light(
        name="key",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM,
        pos=[1.4, -1.8, 4.0],
        dir=[-0.35, 0.45, -1.0],
        diffuse=[0.62, 0.61, 0.58],
        specular=[0.35, 0.35, 0.35],
        castshadow=True,
    )
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_PLANE:
            geom.castshadow = False  # it has nothing to shade but itself, which shows as moire
    headlight = spec.visual.headlight
    headlight.active = 1
    headlight.ambient, headlight.diffuse, headlight.specular = [0.34, 0.35, 0.37], [0.26, 0.26, 0.26], [0.1, 0.1, 0.1]


def _set_quality(spec: mujoco.MjSpec) -> None:
    spec.stat.extent = 1.0  # [m] clipping, fog and shadow are multiples of it; computed, it would grow with the terrain
    vis = spec.visual
    vis.map.znear, vis.map.zfar = 0.02, 150.0  # [extent]
    vis.map.shadowclip = 2.0  # [extent] half-width of the shadow map: 2 mm a pixel
    vis.map.haze = 0.9  # from a tenth of zfar on, a plane fades into the horizon; fog stays off
    vis.quality.shadowsize = 2048  # 4096 costs a software renderer a seventh of its frames and is hardly seen
    vis.quality.offsamples = 4
    vis.quality.numslices, vis.quality.numstacks = 28, 12  # facets of round primitives
    vis.global_.offwidth, vis.global_.offheight = 1920, 1080  # [pixels] the largest picture, not the size of one
