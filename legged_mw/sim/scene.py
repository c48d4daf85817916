"""What a picture needs and physics does not: sky, ground material, light, render quality. Host only.

No geom is added here and nothing that is stepped changes; the names given are for others to refer to.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

Colour = Sequence[float] | np.ndarray
GROUND_MATERIAL = "ground"  # for the floor or terrain geom
_ZENITH, _HORIZON = (0.22, 0.32, 0.45), (0.56, 0.63, 0.70)
SQUARE = 0.5  # edge of one checker square [m], a thin line every second one: to judge speed and stride by
STEEP_LIGHT = (-0.25, 0.35, -1.0)  # of the key light over steps: steeper, so that a riser is darker than a tread wherever it faces


def add_scene(spec: mujoco.MjSpec) -> None:
    """Give ``spec`` a sky, the material "ground", one key light that follows the first body, and render settings."""
    _add_sky(spec)
    add_squares(spec, GROUND_MATERIAL, [0.23, 0.26, 0.30], [0.28, 0.31, 0.35], [0.40, 0.43, 0.47])
    _add_light(spec)
    _set_quality(spec)


def _add_sky(spec: mujoco.MjSpec) -> None:
    # the gradient runs from zenith to nadir, so the horizon is its middle; the haze has that colour, and the ground no edge
    nadir = [2 * h - z for h, z in zip(_HORIZON, _ZENITH, strict=True)]
    sky = spec.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, rgb1=_ZENITH, rgb2=nadir, width=512, height=3072)
    sky.builtin = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT
    spec.visual.rgba.haze = [*_HORIZON, 1.0]


def add_squares(spec: mujoco.MjSpec, name: str, dark: Colour, light: Colour, line: Colour) -> None:
    """A material of squares, 2 x 2 of them with a line around."""
    picture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, rgb1=dark, rgb2=light, markrgb=line, width=512, height=512)
    picture.builtin, picture.mark = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_EDGE
    # texuniform measures in half-sizes: texrepeat 1 lays the image, 2 x 2 squares with a line around it, over 2 m
    add_material(spec, name, texuniform=True, texrepeat=[1 / SQUARE, 1 / SQUARE])


def add_material(spec: mujoco.MjSpec, name: str, **mapping: Any) -> None:
    """A dull material with the texture of that name."""
    material = spec.add_material(name=name, specular=0.1, shininess=0.1, reflectance=0.0, **mapping)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


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
