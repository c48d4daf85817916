"""What makes steps and slopes of a height field seen: a picture laid over it, light from above, flat ground around it to the horizon.

For drawing alone: nothing that is stepped changes. The plane's looks are in scene.py.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.sim.terrain import Terrain

Colour = Sequence[float] | np.ndarray
Picture = NDArray[np.uint8]
Tones = NDArray[np.floating]  # float32: these arrays are large

SQUARE = 0.5  # edge of one checker square [m], a thin line every second one: to judge speed and stride by
# of the key light over steps: steeper, so that a riser is darker than a tread wherever it faces
STEEP_LIGHT = (-0.25, 0.35, -1.0)
RELIEF, AROUND = "relief", "around"  # materials of the tiles, and of the flat ground around them
COARSE = 2  # cells of a tile that is far away are so much longer
# of level ground; each number below is a share of it, lighter or darker
COLOUR = np.array([0.30, 0.33, 0.37], dtype=np.float32)
CHECKER, LINE, TILE_LINE = 0.05, 0.15, 0.3  # a square, a line every metre, a line around each tile
# what lies higher than its neighbourhood is lighter by [1/m], within [m], at most by
EDGE, EDGE_WIDTH, EDGE_MAX = 2.5, 0.1, 0.4
# ground as steep as a riser is darker; slopes [-] where that begins and is full
STEEP, STEEP_FROM, STEEP_TO = 0.3, 0.6, 1.6
HILL, HILL_HEIGHT = 0.12, 0.5  # hills are lighter and pits darker, at most by; at about [m]
REACH = 200.0  # of the flat ground beyond the tiles [m]; a camera sees as far as 150


def add_relief(spec: mujoco.MjSpec, terrain: Terrain, ground: str, squares: bool = True) -> None:
    """Dress the geom ``ground``, a height field of ``terrain``, in a ``spec`` that has a scene; ``squares``: for speed to be judged by.

    It is cut into its tiles, each of them there twice: as it is, and coarse and hidden, for a slow renderer, which shows that one
    instead where a tile is far away (view/posed_robot.py).
    """
    floor, picture = spec.geom(ground), relief(terrain, squares)
    spec.delete(spec.hfield(floor.hfieldname))
    for level, column in np.ndindex(terrain.levels, len(terrain.kinds)):
        _add_tile(spec, terrain, level, column, picture)
    for light in spec.lights:
        if light.name == "key":
            light.dir, light.diffuse = STEEP_LIGHT, [0.75, 0.74, 0.71]
    spec.visual.headlight.diffuse = [0.15, 0.15, 0.15]
    _add_surroundings(spec, terrain, squares)
    # MuJoCo draws haze where there is an endless plane; this one cannot be seen, for it would fill the pits
    floor.type, floor.size, floor.pos, floor.hfieldname = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.05], [0, 0, 0], ""
    floor.material, floor.rgba, floor.castshadow = "", [0, 0, 0, 0.001], False


def _add_tile(spec: mujoco.MjSpec, terrain: Terrain, level: int, column: int, picture: Picture) -> None:
    """One tile, in full and coarse; one that is level only coarse."""
    rows, columns = terrain.vertices(level, column)
    heights = terrain.heights[rows, columns]
    name, n, half = f"{RELIEF}/{level}/{column}", len(heights) - 1, terrain.tile / 2
    low, span = float(heights.min()), max(float(np.ptp(heights)), 1e-3)  # MuJoCo wants some span
    image = picture[rows.start : rows.start + n, columns.start : columns.start + n]
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=n, height=n, nchannel=3)
    texture.data = image[::-1].tobytes()  # a texture begins at the largest y
    add_material(spec, name, texuniform=False, texrepeat=[1, 1])
    x, y = (
        start + first.start * terrain.cell + half for start, first in zip(terrain.corner, (columns, rows), strict=True)
    )
    level_ground = not np.ptp(heights)
    coarse = next(step for step in ((n,) if level_ground else (COARSE, 3, 1)) if n % step == 0)
    for step in (coarse,) if level_ground else (1, coarse):
        some = ((heights[::step, ::step] - low) / span).astype(np.float32)
        spec.add_hfield(
            name=f"{name}/{step}", size=[half, half, span, 0.1], nrow=len(some), ncol=len(some), userdata=some.ravel()
        )
        geom = spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=f"{name}/{step}", pos=[x, y, low], material=name
        )
        geom.contype, geom.conaffinity = 0, 0
        geom.castshadow = False  # a software renderer would draw it once more, and edges show as it is
        if step > 1 and not level_ground:
            geom.rgba = [*geom.rgba[:3], 0.0]


def relief(terrain: Terrain, squares: bool = True) -> Picture:
    """The ground as seen from above, a pixel a cell, row = +y, column = +x."""
    heights = terrain.heights.astype(np.float32)
    above = heights - _blurred(heights, max(round(0.5 * EDGE_WIDTH / terrain.cell), 1))
    tone = 1.0 + np.clip(EDGE * above, -EDGE_MAX, EDGE_MAX) + HILL * np.tanh(heights / HILL_HEIGHT)
    steep = np.clip((_slopes(heights) / terrain.cell - STEEP_FROM) / (STEEP_TO - STEEP_FROM), 0.0, 1.0)
    cells = 0.25 * (tone[1:, 1:] + tone[1:, :-1] + tone[:-1, 1:] + tone[:-1, :-1])
    picture = cells * (1.0 - STEEP * steep) * (1.0 + _lines(terrain, squares))
    return (np.minimum(picture[..., None] * COLOUR, 1.0) * 255).astype(np.uint8)


def _lines(terrain: Terrain, squares: bool) -> Tones:
    """How much lighter squares and lines are, at the middles of pixels."""
    at_square, at_metre, at_tile = [], [], []  # along x, along y
    first = (along.start * terrain.cell for along in terrain.vertices(0, 0)[::-1])
    for count, corner, start in zip(terrain.heights.shape[::-1], terrain.corner, first, strict=True):
        place = corner + (np.arange(count - 1) + 0.5) * terrain.cell  # [m, world]
        at_square.append(np.floor(place / SQUARE).astype(int) % 2)
        for on, origin, every in ((at_metre, 0.0, 1.0), (at_tile, corner + start, terrain.tile)):
            share = (place - origin) / every
            on.append(np.abs(share - np.round(share)) * every < 0.51 * terrain.cell)
    (dark_x, dark_y), (metre_x, metre_y), (tile_x, tile_y) = at_square, at_metre, at_tile
    lines = np.where(metre_x | metre_y[:, None], LINE, CHECKER * (2 * (dark_x ^ dark_y[:, None]) - 1)) * squares
    return np.where(tile_x | tile_y[:, None], TILE_LINE, lines).astype(np.float32)


def _blurred(heights: Tones, cells: int) -> Tones:
    """The mean over squares of ``2 cells + 1`` vertices, of the mean over such squares."""
    width, out = 2 * cells + 1, heights
    for axis in (0, 1, 0, 1):
        padded = np.pad(out, [(cells, cells) if axis == which else (0, 0) for which in (0, 1)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=axis)
        out = windows.mean(axis=-1, dtype=np.float32)
    return out


def _slopes(heights: Tones) -> Tones:
    """The larger rise along either axis within each cell [m]."""
    x, y = np.abs(np.diff(heights, axis=1)), np.abs(np.diff(heights, axis=0))
    return np.maximum(np.maximum(x[1:], x[:-1]), np.maximum(y[:, 1:], y[:, :-1]))


def add_squares(spec: mujoco.MjSpec, name: str, dark: Colour, light: Colour, line: Colour) -> None:
    """A material of squares, 2 x 2 of them with a line around."""
    picture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, rgb1=dark, rgb2=light, markrgb=line, width=512, height=512
    )
    picture.builtin, picture.mark = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_EDGE
    # texuniform measures in half-sizes: texrepeat 1 lays the image, 2 x 2 squares with a line around it, over 2 m
    add_material(spec, name, texuniform=True, texrepeat=[1 / SQUARE, 1 / SQUARE])


def add_material(spec: mujoco.MjSpec, name: str, **mapping: Any) -> None:
    """A dull material with the texture of that name."""
    material = spec.add_material(name=name, specular=0.1, shininess=0.1, reflectance=0.0, **mapping)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_surroundings(spec: mujoco.MjSpec, terrain: Terrain, squares: bool) -> None:
    """The border, and flat ground on from there, as far as one sees."""
    add_squares(spec, AROUND, *(COLOUR * (1 + share * squares) for share in (-CHECKER, CHECKER, LINE)))
    plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "contype": 0, "conaffinity": 0, "castshadow": False}
    x, y = 0.5 * terrain.levels * terrain.tile, 0.5 * len(terrain.kinds) * terrain.tile
    reach = max(REACH, 2 * x, 2 * y)  # benchmarks/terrain_picture.py sees as far as the tiles are long
    # [m] along x and y: a side of the tiles and on beyond its end
    wide, deep = (2 * x + reach, reach), (reach, 2 * y + reach)
    vanes = ((-x, y), (1, 1), wide), ((x, y), (1, -1), deep), ((x, -y), (-1, -1), wide), ((-x, -y), (-1, 1), deep)
    for corner, away, edges in vanes:  # each from a corner of the tiles, like the vanes of a wheel
        # a plane's picture begins half a metre from its middle; lines are to lie at whole metres
        middle = [
            round(start + side * edge / 2 - 0.5) + 0.5 for start, side, edge in zip(corner, away, edges, strict=True)
        ]
        size = [abs(place - start) for place, start in zip(middle, corner, strict=True)]
        spec.worldbody.add_geom(pos=[*middle, 0.0], size=[*size, 0.05], material=AROUND, **plane)
