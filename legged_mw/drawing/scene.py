"""Add sky, light, camera and terrain colours to the spec of a robot, for drawing only."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from legged_mw.drawing.terrain_look import add_relief, add_squares
from legged_mw.sim.ground import GROUND
from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel

GROUND_MATERIAL = "ground"  # name of the floor's material
_ZENITH, _HORIZON = (0.22, 0.32, 0.45), (0.56, 0.63, 0.70)
# default place of the camera "track" relative to the robot's centre of mass [reach of the robot]
CAMERA = (1.78, -2.18, 1.19)


def visual_model(robot: RobotModel, camera: Sequence[float] = ()) -> mujoco.MjModel:
    """A model of ``robot`` with visual geoms. It has the qpos, qvel and bodies of the simulated model.

    Takes a second for a large terrain.
    """
    return visual_spec(robot, camera).compile()


def visual_spec(robot: RobotModel, camera: Sequence[float] = ()) -> mujoco.MjSpec:
    """The spec of ``visual_model``."""
    spec = with_scene(robot, camera)
    if robot.terrain:
        add_relief(spec, robot.terrain, GROUND)
    return spec


def with_scene(robot: RobotModel, camera: Sequence[float] = ()) -> mujoco.MjSpec:
    """A copy of the robot's spec with a scene and a camera. Its terrain stays one height field.

    ``camera``: place relative to the robot, world axes [m]; empty: by the robot's size.
    """
    spec = robot.spec.copy()
    add_scene(spec)
    _add_camera(spec, robot.root, camera or [round(share * reach(robot), 1) for share in CAMERA])
    return spec


def reach(robot: RobotModel) -> float:
    """The largest distance [m] of the robot's parts from its root, with all joints at 0."""
    model, data = robot.physics, posed(robot.physics, np.zeros(len(robot.joint_names)))
    geoms = model.geom_bodyid > 0
    shapes = np.linalg.norm(data.geom_xpos[geoms], axis=1) + model.geom_rbound[geoms]
    return float(max(*np.linalg.norm(data.xpos[1:], axis=1), *shapes, 0.1))


def add_scene(spec: mujoco.MjSpec) -> None:
    """Add a sky, the material "ground", one key light that follows the first body, and render settings to ``spec``."""
    _add_sky(spec)
    add_squares(spec, GROUND_MATERIAL, [0.23, 0.26, 0.30], [0.28, 0.31, 0.35], [0.40, 0.43, 0.47])
    _add_light(spec)
    _set_quality(spec)
    if floor := spec.geom(GROUND):
        floor.material = GROUND_MATERIAL


def _add_camera(spec: mujoco.MjSpec, root: str, place: Sequence[float]) -> None:
    """Add a camera "track" that keeps its distance to the robot and looks at it."""
    away = np.array(place, dtype=float) / np.linalg.norm(place)  # a camera looks along its -z axis
    right = np.cross([0.0, 0.0, 1.0], away)
    right /= np.linalg.norm(right)
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(away, right), away], axis=1).ravel())
    spec.body(root).add_camera(name="track", mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACKCOM, pos=list(place), quat=quat)


def _add_sky(spec: mujoco.MjSpec) -> None:
    # The gradient runs from zenith to nadir, so its middle is the horizon. The haze has that colour,
    # which hides the edge of the ground.
    nadir = [2 * h - z for h, z in zip(_HORIZON, _ZENITH, strict=True)]
    sky = spec.add_texture(
        name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, rgb1=_ZENITH, rgb2=nadir, width=512, height=3072
    )
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    spec.visual.rgba.haze = [*_HORIZON, 1.0]


def _add_light(spec: mujoco.MjSpec) -> None:
    # trackcom: the shadow map covers a few metres around the walking robot. A directional light keeps its direction.
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
            geom.castshadow = False  # it can only shade itself, which makes moire patterns
    headlight = spec.visual.headlight
    headlight.active = 1
    headlight.ambient, headlight.diffuse, headlight.specular = [0.34, 0.35, 0.37], [0.26, 0.26, 0.26], [0.1, 0.1, 0.1]


def _set_quality(spec: mujoco.MjSpec) -> None:
    spec.stat.extent = 1.0  # [m] unit of clipping, fog and shadow; MuJoCo's own value would grow with the terrain
    vis = spec.visual
    vis.map.znear, vis.map.zfar = 0.02, 150.0  # [extent]
    vis.map.shadowclip = 2.0  # [extent] half width of the shadow map: 2 mm per pixel
    vis.map.haze = 0.9  # a plane fades into the horizon from 0.1 zfar on; fog stays off
    vis.quality.shadowsize = 2048  # 4096 lowers the frame rate of a software renderer by 1/7 with little visible gain
    vis.quality.offsamples = 4
    vis.quality.numslices, vis.quality.numstacks = 28, 12  # facets of round primitives
    vis.global_.offwidth, vis.global_.offheight = 1920, 1080  # [px] largest possible picture
