"""A picture of rough ground from above: a row of tiles for each kind, harder to the right.

python benchmarks/terrain_picture.py terrain.png --task go1_rough
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
import legged_mw  # noqa: F401  (chooses what draws without a screen, before mujoco is imported)

# isort: split
import mujoco
import numpy as np

from legged_mw.drawing.scene import ground_model
from legged_mw.envs.terrain import build_terrain
from legged_mw.sim.terrain import KINDS, MEASURES, Terrain, measure
from legged_mw.utils.cli import Parser, apply_overrides, one_line_errors
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import shown
from legged_mw.utils.task import LoadedTask, load_task
from legged_mw.view.recorder import Frame, no_context, save_png, shrunk
from legged_mw.view.stage import ViewError

PROGRAM = "benchmarks/terrain_picture.py"
WIDTH, FINER = 1280, 2  # [px] of the picture; it is drawn that much larger and made smaller, which smooths it
# [px] with many levels it is wider, so that names have room; with few it is no higher, and less wide
WIDEST, HIGHEST = 2560, 1280
ELEVATION = 40.0  # [deg] of the camera, which looks along y, so that levels go to the right; without perspective
LIGHT = (-0.7, -0.45, -0.75)  # direction: low, from the upper right, so that slopes stand out
BRIGHTER = 2.0  # so low a light leaves level ground dark
# of WIDTH, left of the tiles: room for their names; between two lines of text, on the ground
MARGIN, LINE = 0.22, 0.027
NUMBER = 0.0375  # of WIDTH, from one level's number to the next


def picture(terrain: Terrain) -> Frame:
    """All of ``terrain``, (height, width, 3)."""
    model = ground_model(terrain)
    length, depth = terrain.levels * terrain.tile, len(terrain.kinds) * terrain.tile  # [m] to the right, away
    scale = _scale(terrain)
    # [m] between two lines of text; what is seen
    line, wide = LINE * WIDTH / scale, length * 1.02 + MARGIN * WIDTH / scale
    high = (depth + 3.0 * line) * math.sin(math.radians(ELEVATION))
    width, height = round(wide * scale) * FINER, round(high * scale) * FINER
    vis = model.vis
    vis.global_.offwidth, vis.global_.offheight, vis.global_.fovy = width, height, high
    vis.map.zfar = 10 * max(length, depth)
    model.light_dir0[:], model.light_castshadow[:], vis.headlight.diffuse[:], vis.headlight.ambient[:] = (
        LIGHT,
        False,
        0.0,
        0.3,
    )
    camera = mujoco.MjvCamera()
    camera.orthographic = 1
    camera.azimuth, camera.elevation, camera.distance = 90.0, -ELEVATION, 2 * max(length, depth)
    camera.lookat[:] = 0.51 * length - 0.5 * wide, 0.5 * line, 0.0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    try:
        renderer = mujoco.Renderer(model, height, width, font_scale=mujoco.mjtFontScale.mjFONTSCALE_300)
    except Exception as error:  # each OpenGL backend fails with a type of its own
        raise ViewError(no_context(error)) from error
    with renderer:
        renderer.update_scene(data, camera)
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        _label(renderer.scene, terrain, camera.lookat[0] - 0.5 * wide + 0.01 * WIDTH / scale, scale)
        frame = shrunk(renderer.render(), width // FINER)
    return np.minimum(frame * BRIGHTER, 255.0).astype(np.uint8)


def _scale(terrain: Terrain) -> float:
    """[px/m] that fills the width, if that is neither too high nor too small for two lines of text beside each tile."""
    length, depth = terrain.levels * terrain.tile * 1.02, len(terrain.kinds) * terrain.tile
    fits, most = ((width - MARGIN * WIDTH) / length for width in (WIDTH, WIDEST))
    low = (HIGHEST / math.sin(math.radians(ELEVATION)) - 3.0 * LINE * WIDTH) / depth
    return min(max(min(fits, low), 2.0 * LINE * WIDTH / terrain.tile), most)


def _label(scene: mujoco.MjvScene, terrain: Terrain, left: float, scale: float) -> None:
    """Names of the kinds, from ``left`` [m] on, and of the levels, as many as have room at ``scale`` [px/m]."""
    line, number = LINE * WIDTH / scale, NUMBER * WIDTH / scale  # [m]
    both = terrain.tile > 1.99 * line  # what makes a kind hard too
    for column in spaced(len(terrain.kinds), line / terrain.tile):
        kind, y = terrain.kinds[column], terrain.origins[0, column, 1]
        _write(scene, kind, (left, y + (0.1 if both else -0.4) * line))
        if both and kind in MEASURES:
            (name, low, unit), (_, high, _) = (measure(kind, terrain.difficulties[level]) for level in (0, -1))
            span = f"{low:.3g} to {high:.3g}" if low != high else f"{low:.3g}"
            _write(scene, f"{name} {span} {unit}", (left, y - 0.9 * line))
    top = terrain.origins[0, -1, 1] + 0.5 * terrain.tile + 0.6 * line
    _write(scene, "difficulty", (left, top))
    for level in spaced(terrain.levels, number / terrain.tile):
        _write(scene, f"{terrain.difficulties[level]:.2f}", (terrain.origins[level, 0, 0] - 0.6 * line, top))


def spaced(count: int, room: float) -> list[int]:
    """Of ``count`` things in a row those to name, at least ``room`` apart: in equal steps from the first, and the last."""
    step = math.ceil(room)
    return [*range(0, count - step, step), count - 1] if count > 1 else [0]


def _write(scene: mujoco.MjvScene, text: str, place: tuple[float, float]) -> None:
    """A geom that is nothing but its label, which begins at ``place`` [m]."""
    geom, sphere = scene.geoms[scene.ngeom], mujoco.mjtGeom.mjGEOM_SPHERE
    mujoco.mjv_initGeom(
        geom, sphere, np.full(3, 1e-3), np.array([*place, 0.0]), np.eye(3).ravel(), np.zeros(4, np.float32)
    )
    geom.label = text
    scene.ngeom += 1


def ground(task: LoadedTask, everything: bool) -> Terrain:
    """The tiles of ``task``, a column a kind, the first of them farthest away; ``everything``: of every kind there is."""
    terrain = task.cfg.terrain
    if terrain.mesh_type == "plane":
        raise ConfigError(
            f"{task.name} is on a plane; to see its section terrain all the same add --set terrain.mesh_type=heightfield"
        )
    kinds = list(KINDS) if everything else [kind for kind, share in terrain.terrain_proportions.items() if share > 0]
    terrain.terrain_proportions = dict.fromkeys(reversed(kinds), 1.0)
    terrain.num_cols, terrain.border_size = len(kinds), 1.0
    task.cfg.check()
    built = build_terrain(task.cfg)
    assert built is not None
    return built


def main() -> None:
    parser = Parser(prog=PROGRAM, description="A picture of a task's rough ground from above.", allow_abbrev=False)
    parser.add_argument(
        "file", nargs="?", default="terrain.png", help="where to write it, a PNG (default: terrain.png)"
    )
    parser.add_argument(
        "--task", metavar="NAME", default="go1_rough", help="whose ground: a task's name, or the path of a config file"
    )
    parser.add_argument("--all", action="store_true", help="every kind of ground there is, in place of the task's")
    parser.add_argument(
        "--set", action="append", default=[], metavar="PATH=VALUE", help="override a config field: terrain.num_rows=5"
    )
    parser.add_argument(
        "--override", action="append", default=[], metavar="FILE", help="override config fields from a YAML file"
    )
    args = parser.parse_args()
    task = load_task(args.task)
    apply_overrides(task, args)
    path = Path(args.file)
    if path.suffix.lower() != ".png":
        raise ConfigError(f"{path}: the picture is a PNG; give it a name that ends in .png")
    save_png(path, picture(ground(task, args.all)))
    print(f"written to {shown(path)}")


if __name__ == "__main__":
    with one_line_errors(PROGRAM):
        main()
