"""Make steps and slopes of a height field visible: a texture over it, a steep light, flat ground to the horizon.

For drawing only; the simulation does not change. The looks of the plane are in scene.py.
"""

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

# [m] edge of a checker square, with a thin line at every second one: a scale for speed and stride length
SQUARE = 0.5
# direction of the key light over steps: steeper, so that risers in all directions are darker than treads
STEEP_LIGHT = (-0.25, 0.35, -1.0)
RELIEF, AROUND = "relief", "around"  # materials of the tiles, and of the flat ground around them
COARSE = 2  # factor on the cell size of a distant tile
# colour of level ground; the numbers below are lighter or darker shares of it
COLOUR = np.array([0.30, 0.33, 0.37], dtype=np.float32)
CHECKER, LINE, TILE_LINE = 0.05, 0.15, 0.3  # of a square, of the line at every metre, of the line around each tile
# Points above their neighbourhood are lighter: gain [1/m], width of the neighbourhood [m], largest share.
EDGE, EDGE_WIDTH, EDGE_MAX = 2.5, 0.1, 0.4
# Steep ground is darker: largest share, slopes [-] at which it starts and is full.
STEEP, STEEP_FROM, STEEP_TO = 0.3, 0.6, 1.6
HILL, HILL_HEIGHT = 0.12, 0.5  # hills are lighter and pits darker: largest share, reached at about this height [m]
REACH = 200.0  # [m] flat ground beyond the tiles; a camera sees 150 m


def add_relief(spec: mujoco.MjSpec, terrain: Terrain, ground: str) -> None:
    """Replace the geom ``ground`` in a ``spec`` with a scene by textured tiles of ``terrain``.

    Each tile has a fine and a hidden coarse height field. A slow renderer shows the coarse one for distant tiles
    (view/posed_robot.py).
    """
    floor, picture = spec.geom(ground), relief(terrain)
    spec.delete(spec.hfield(floor.hfieldname))
    for level, column in np.ndindex(terrain.levels, len(terrain.kinds)):
        _add_tile(spec, terrain, level, column, picture)
    for light in spec.lights:
        if light.name == "key":
            light.dir, light.diffuse = STEEP_LIGHT, [0.75, 0.74, 0.71]
    spec.visual.headlight.diffuse = [0.15, 0.15, 0.15]
    _add_surroundings(spec, terrain)
    # MuJoCo draws haze only for an infinite plane. This plane is invisible, because it would fill the pits.
    floor.type, floor.size, floor.pos, floor.hfieldname = mujoco.mjtGeom.mjGEOM_PLANE, [0, 0, 0.05], [0, 0, 0], ""
    floor.material, floor.rgba, floor.castshadow = "", [0, 0, 0, 0.001], False


def _add_tile(spec: mujoco.MjSpec, terrain: Terrain, level: int, column: int, picture: Picture) -> None:
    """Add one tile, fine and coarse. A level tile has only the coarse one."""
    rows, columns = terrain.vertices(level, column)
    heights = terrain.heights[rows, columns]
    name, n, half = f"{RELIEF}/{level}/{column}", len(heights) - 1, terrain.tile / 2
    low, span = float(heights.min()), max(float(np.ptp(heights)), 1e-3)  # MuJoCo requires a positive span
    image = picture[rows.start : rows.start + n, columns.start : columns.start + n]
    texture = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=n, height=n, nchannel=3)
    texture.data = image[::-1].tobytes()  # the first row of a texture is at the largest y
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
        geom.castshadow = False  # saves a second pass in a software renderer; edges are visible without shadows
        if step > 1 and not level_ground:
            geom.rgba = [*geom.rgba[:3], 0.0]


def relief(terrain: Terrain) -> Picture:
    """A picture of the ground from above: one pixel per cell, rows along +y, columns along +x."""
    heights = terrain.heights.astype(np.float32)
    above = heights - _blurred(heights, max(round(0.5 * EDGE_WIDTH / terrain.cell), 1))
    tone = 1.0 + np.clip(EDGE * above, -EDGE_MAX, EDGE_MAX) + HILL * np.tanh(heights / HILL_HEIGHT)
    steep = np.clip((_slopes(heights) / terrain.cell - STEEP_FROM) / (STEEP_TO - STEEP_FROM), 0.0, 1.0)
    cells = 0.25 * (tone[1:, 1:] + tone[1:, :-1] + tone[:-1, 1:] + tone[:-1, :-1])
    picture = cells * (1.0 - STEEP * steep) * (1.0 + _lines(terrain))
    return (np.minimum(picture[..., None] * COLOUR, 1.0) * 255).astype(np.uint8)


def _lines(terrain: Terrain) -> Tones:
    """The brightness of squares and lines at the centres of pixels."""
    at_square, at_metre, at_tile = [], [], []  # one array along x, one along y
    first = (along.start * terrain.cell for along in terrain.vertices(0, 0)[::-1])
    for count, corner, start in zip(terrain.heights.shape[::-1], terrain.corner, first, strict=True):
        place = corner + (np.arange(count - 1) + 0.5) * terrain.cell  # [m, world frame]
        at_square.append(np.floor(place / SQUARE).astype(int) % 2)
        for on, origin, every in ((at_metre, 0.0, 1.0), (at_tile, corner + start, terrain.tile)):
            share = (place - origin) / every
            on.append(np.abs(share - np.round(share)) * every < 0.51 * terrain.cell)
    (dark_x, dark_y), (metre_x, metre_y), (tile_x, tile_y) = at_square, at_metre, at_tile
    lines = np.where(metre_x | metre_y[:, None], LINE, CHECKER * (2 * (dark_x ^ dark_y[:, None]) - 1))
    return np.where(tile_x | tile_y[:, None], TILE_LINE, lines).astype(np.float32)


def _blurred(heights: Tones, cells: int) -> Tones:
    """The mean over squares with edges of ``2 cells + 1`` vertices, applied twice."""
    width, out = 2 * cells + 1, heights
    for axis in (0, 1, 0, 1):
        padded = np.pad(out, [(cells, cells) if axis == which else (0, 0) for which in (0, 1)], mode="edge")
        windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=axis)
        out = windows.mean(axis=-1, dtype=np.float32)
    return out


def _slopes(heights: Tones) -> Tones:
    """The larger height difference [m] along x or y within each cell."""
    x, y = np.abs(np.diff(heights, axis=1)), np.abs(np.diff(heights, axis=0))
    return np.maximum(np.maximum(x[1:], x[:-1]), np.maximum(y[:, 1:], y[:, :-1]))


def add_squares(spec: mujoco.MjSpec, name: str, dark: Colour, light: Colour, line: Colour) -> None:
    """Add a checker material. Its texture has 2 x 2 squares with a line around them."""
    picture = spec.add_texture(
        name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, rgb1=dark, rgb2=light, markrgb=line, width=512, height=512
    )
    picture.builtin, picture.mark = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, mujoco.mjtMark.mjMARK_EDGE
    # with texuniform, texrepeat counts per half size: at 1 the image of 2 x 2 squares covers 2 m
    add_material(spec, name, texuniform=True, texrepeat=[1 / SQUARE, 1 / SQUARE])


def add_material(spec: mujoco.MjSpec, name: str, **mapping: Any) -> None:
    """Add a matt material with the texture ``name``."""
    material = spec.add_material(name=name, specular=0.1, shininess=0.1, reflectance=0.0, **mapping)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def _add_surroundings(spec: mujoco.MjSpec, terrain: Terrain) -> None:
    """Add the flat ground around the tiles, up to the limit of sight."""
    add_squares(spec, AROUND, *(COLOUR * (1 + share) for share in (-CHECKER, CHECKER, LINE)))
    plane = {"type": mujoco.mjtGeom.mjGEOM_PLANE, "contype": 0, "conaffinity": 0, "castshadow": False}
    x, y = 0.5 * terrain.levels * terrain.tile, 0.5 * len(terrain.kinds) * terrain.tile
    reach = max(REACH, 2 * x, 2 * y)  # a picture of all tiles sees up to their length
    # [m] along x and y: a side of the tiles, plus the reach beyond its end
    wide, deep = (2 * x + reach, reach), (reach, 2 * y + reach)
    vanes = ((-x, y), (1, 1), wide), ((x, y), (1, -1), deep), ((x, -y), (-1, -1), wide), ((-x, -y), (-1, 1), deep)
    for corner, away, edges in vanes:  # each starts at a corner of the tiles, like the vanes of a pinwheel
        # a plane's texture starts 0.5 m from its centre; shift the centre so that lines lie at whole metres
        middle = [
            round(start + side * edge / 2 - 0.5) + 0.5 for start, side, edge in zip(corner, away, edges, strict=True)
        ]
        size = [abs(place - start) for place, start in zip(middle, corner, strict=True)]
        spec.worldbody.add_geom(pos=[*middle, 0.0], size=[*size, 0.05], material=AROUND, **plane)
