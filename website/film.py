"""Films of the shipped policies: robots walk past a camera over ground of one colour, so that files stay small.

MUJOCO_GL=egl python -m website.film               # the README's film; website/gallery.py makes the gallery's
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import legged_mw  # noqa: F401  (chooses what draws without a screen, before mujoco is imported)

# isort: split
import mujoco
import numpy as np
from PIL import Image

from legged_mw import ROOT
from legged_mw.deploy.contract import SCENE_FILE, TERRAIN_FILE
from legged_mw.deploy.stage import DeployStage
from legged_mw.skills.drop_states import fallen
from legged_mw.view.recorder import Frame

IMAGES = ROOT / "docs/images"
# ground; steps; every other one
LEVEL, STEP, EDGE = (1.0, 1.0, 1.0, 1.0), (0.84, 0.87, 0.90, 1.0), (0.66, 0.71, 0.76, 1.0)
SKY = (0.95, 0.96, 0.97)
FPS, FINER = 12.5, 2  # [1/s]; drawn so many times larger and made smaller, which smooths


class Shot(NamedTuple):
    """A policy in front of a camera that looks at the middle of its path."""

    policy: str  # a folder of resources/policies
    command: tuple[float, ...]  # vx, vy [m/s], yaw rate [rad/s]
    begin: float = 1.0  # [s] of walking before the film
    seconds: float = 2.8
    distance: float = 2.3  # of the camera [m]
    azimuth: float = 90.0  # [deg]: along y, so that a robot that walks along x goes to the right
    elevation: float = -12.0  # [deg]
    height: float = 0.0  # where it looks, above the robot's root [m]
    follow: float = 0.5  # share of the robot's way that the camera goes along; plain ground looks the same
    rough: bool = False  # among steps and blocks
    fall: int = 0  # it begins in the settled fall that this seed makes; 0: standing


FILM = [  # of the README, from left to right
    Shot(
        "go1_rough_scan",
        (0.6, 0.0, 0.0),
        begin=3.6,
        distance=2.3,
        elevation=-16.0,
        azimuth=75.0,
        follow=0.0,
        rough=True,
    ),
    Shot("go2_flat", (0.75, 0.0, 0.0), distance=1.9, elevation=-10.0),
    Shot("g1_flat", (0.7, 0.0, 0.0), distance=2.6, elevation=-6.0, height=-0.1),
    Shot("go1_getup", (), begin=0.0, seconds=3.0, distance=1.45, elevation=-14.0, fall=6),
]
BY_NAME = {  # of the gallery; a policy that is not here walks as the first does
    "go1_flat": Shot("go1_flat", (0.9, 0.0, 0.6), distance=1.8, azimuth=110.0),
    **{
        name: FILM[0]._replace(policy=name)
        for name in ("go1_rough", "go1_rough_scan", "go1_rough_student", "go2_rough", "go2_rough_scan")
    },
    "go2_flat": FILM[1],
    "g1_flat": FILM[2],
    "g1_12dof_flat": FILM[2]._replace(policy="g1_12dof_flat"),
    "go1_getup": FILM[3],
    "go2_getup": FILM[3]._replace(policy="go2_getup"),
    "g1_getup": FILM[3]._replace(policy="g1_getup", seconds=4.0, distance=2.4, elevation=-10.0),
    "go1_handstand": Shot("go1_handstand", (), begin=0.0, distance=1.9, height=0.1),
    "go1_footstand": Shot("go1_footstand", (), begin=0.0, distance=1.9, height=0.1),
    "g1_track": Shot("g1_track", (), begin=2.2, distance=2.6, elevation=-6.0, azimuth=40.0),
    "g1_rough": Shot(
        "g1_rough", (0.5, 0.0, 0.0), 2.0, distance=2.6, elevation=-14.0, azimuth=75.0, follow=0.0, rough=True
    ),
}


def record(shot: Shot, width: int, height: int) -> list[Frame]:
    """The frames of ``shot``, (height, width, 3)."""
    stage = DeployStage(
        ROOT / "resources/policies" / shot.policy,
        1,
        shot.command,
        scene_file=TERRAIN_FILE if shot.rough else SCENE_FILE,
    )
    if shot.fall:
        stage.put(*fallen(stage.fleet.model, 1, shot.fall, seconds=1.0))
    lies = [stage.qpos()[0]] * round(FPS) if shot.fall else []  # a second, before it gets up
    every, path = round(1.0 / FPS / stage.dt), lies
    for step in range(round((shot.begin + shot.seconds) / stage.dt)):
        stage.step()
        if step * stage.dt >= shot.begin and step % every == 0:
            path.append(stage.qpos()[0])
    model = _pale(stage.spec.compile())
    model.vis.global_.offwidth, model.vis.global_.offheight, model.vis.quality.offsamples = (
        width * FINER,
        height * FINER,
        4,
    )
    data, camera = mujoco.MjData(model), mujoco.MjvCamera()
    middle = (np.min(path, axis=0) + np.max(path, axis=0))[:3] / 2
    camera.lookat[:] = middle + [0.0, 0.0, shot.height]
    camera.azimuth, camera.elevation, camera.distance = shot.azimuth, shot.elevation, shot.distance
    renderer, option, frames = mujoco.Renderer(model, height * FINER, width * FINER), mujoco.MjvOption(), []
    option.geomgroup[3:] = 0
    for qpos in path:
        data.qpos[:] = qpos
        camera.lookat[:2] = middle[:2] + shot.follow * (qpos - np.mean(path, axis=0))[:2]
        mujoco.mj_forward(model, data)
        renderer.update_scene(data, camera, option)
        large = renderer.render().reshape(height, FINER, width, FINER, 3)
        frames.append(large.mean(axis=(1, 3)).astype(np.uint8))
    renderer.close()
    return frames


def _pale(model: mujoco.MjModel) -> mujoco.MjModel:
    """Ground of one light colour, every other step darker, and a plain sky: what does not move costs nothing then."""
    for geom in np.flatnonzero(model.geom_bodyid == 0):
        level = model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_PLANE
        model.geom_rgba[geom] = LEVEL if level else EDGE if model.geom_rgba[geom, 0] < 0.9 else STEP
        model.geom_matid[geom] = -1
    for texture in np.flatnonzero(model.tex_type == mujoco.mjtTexture.mjTEXTURE_SKYBOX):
        first, size = (
            model.tex_adr[texture],
            model.tex_height[texture] * model.tex_width[texture] * model.tex_nchannel[texture],
        )
        model.tex_data[first : first + size] = np.tile(np.array(SKY) * 255, size // 3).astype(np.uint8)
    model.vis.rgba.haze[:3] = SKY
    return model


def side_by_side(films: Sequence[Sequence[Frame]]) -> list[Frame]:
    """Films of one height as one, as long as the shortest."""
    return [np.concatenate(frames, axis=1) for frames in zip(*films, strict=False)]


def save_webp(path: Path, frames: Sequence[Frame], quality: int = 10) -> None:
    first, *others = map(Image.fromarray, frames)
    first.save(
        path,
        save_all=True,
        append_images=others,
        duration=round(1000 / FPS),
        loop=0,
        quality=quality,
        method=6,
        minimize_size=True,
    )


def main() -> None:
    save_webp(IMAGES / "film.webp", side_by_side([record(shot, 288, 216) for shot in FILM]), quality=40)


if __name__ == "__main__":
    main()
