"""Two views of the default pose, side by side: feet, IMU frame, colliders and joint axes with their names.

The names stand in columns beside the robot, with lines to their places, so the names of 29 joints are readable.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from legged_mw.drawing.scene import visual_spec
from legged_mw.sim.joints import family
from legged_mw.sim.model import RobotModel
from legged_mw.view.overlay import connect, draw_disc
from legged_mw.view.posed_robot import GROUPS_SHOWN, PosedRobots, boxes, patch
from legged_mw.view.recorder import Frame, contact_sheet, make_renderer, save_png, shrunk
from legged_mw.view.stage import FloatArray

WIDTH, HEIGHT = 1100, 1000  # [px] of one view
VIEWS = (("front left", 225.0, -14.0), ("left side", 270.0, -4.0))  # name, azimuth and elevation of the camera [deg]
ACROSS, LETTERS = 3, 46  # poses per row; characters in a text line
FILL = 0.7  # share of a view's smaller edge for the robot; the names get the rest
COLLIDER_RGBA, LOOK_ALPHA = (1.0, 0.55, 0.1, 0.42), 0.4
FOOT_RGBA = (0.0, 0.75, 0.52, 1.0)
AXES_RGB = ((0.95, 0.2, 0.2), (0.25, 0.85, 0.25), (0.3, 0.5, 1.0))  # x, y, z
# of the joint families: Okabe and Ito's palette with lighter versions, safe for the colour-blind
FAMILY_RGB = (
    (0.34, 0.71, 0.91),
    (0.94, 0.89, 0.26),
    (0.85, 0.55, 0.75),
    (0.55, 0.9, 0.75),
    (0.95, 0.6, 0.4),
    (0.75, 0.75, 0.95),
    (0.9, 0.9, 0.9),
)
MANY = 16  # number of joints above which the arrows are shorter
LEFT_COLUMN, ROW = 12, 22  # [px] from the edge to a column of names; smallest distance between two names
CAPTION = "joint axes: arrows (turn by the right hand)   feet: green   imu: x red, y green, z blue   colliders: orange"

Rgb = tuple[float, float, float]


class Label(NamedTuple):
    """A name, its place on the robot, and arrows from that place."""

    text: str
    place: FloatArray  # (3,) [m, world frame]
    rgb: Rgb
    # ends (3,) [m, world frame]; drawn over the picture, because the robot would hide them
    arrows: tuple[tuple[FloatArray, Rgb], ...] = ()


def draw(path: Path, robot: RobotModel, qpos: FloatArray, feet: Mapping[str, Sequence[str]], title: str) -> None:
    """Write the picture of the robot at ``qpos`` (7 + D,) to ``path`` (PNG). ``feet``: name -> geoms."""
    scene = _Picture(robot, qpos, feet)
    try:
        save_png(path, np.concatenate([scene.view(*view, title) for view in VIEWS], axis=1))
    finally:
        scene.close()


def draw_poses(path: Path, robot: RobotModel, poses: Sequence[tuple[FloatArray, str]]) -> None:
    """Write a picture of several poses from the left side to ``path`` (PNG): each a ``qpos`` (7 + D,) and a text."""
    scene, tiles = _Picture(robot, poses[0][0], {}), []
    try:
        for qpos, text in poses:
            scene.posed.pose(qpos)
            tiles.append(scene.plain(text))
    finally:
        scene.close()
    columns = min(ACROSS, len(tiles))
    tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
    save_png(path, contact_sheet(tiles, columns))


class _Picture:
    """One posed robot, drawn from several sides."""

    def __init__(self, robot: RobotModel, qpos: FloatArray, feet: Mapping[str, Sequence[str]]) -> None:
        self.robot, self.feet = robot, feet
        self.posed = PosedRobots(visual_spec(robot))
        self.posed.pose(qpos)
        self._paint()
        self._measure()
        self._renderer = make_renderer(self.posed.model, WIDTH, HEIGHT)

    def close(self) -> None:
        self._renderer.close()

    def view(self, name: str, azimuth: float, elevation: float, title: str) -> Frame:
        """The robot from one side, with joint names: of the near side in the second view, the others in the first."""
        camera = self._look(azimuth, elevation)
        joints = self._draw_joints()
        marks = [*self._draw_feet(), *self._draw_imu()]
        near = azimuth == VIEWS[1][1]
        labels = [label for label in joints if (label.place[1] > self.middle[1] - 1e-3) == near] + marks
        self._renderer.render()
        frame = self._write(labels, camera, f"{title}: {name}")
        for label in [*joints, *marks]:
            for end, rgb in label.arrows:
                _line(frame, self._project(label.place, camera), self._project(end, camera), rgb, wide=3)
        return frame

    def plain(self, text: str) -> Frame:
        """The robot from the left side without marks, in half the size, with ``text`` above."""
        self._look(*VIEWS[1][1:], smaller=1.3)
        self._renderer.render()
        context = self._renderer._mjr_context
        for number, line in enumerate(textwrap.wrap(text, LETTERS)):
            _text(context, line, 2 * LEFT_COLUMN, 48 + 48 * number, (1.0, 1.0, 1.0), mujoco.mjtFont.mjFONT_BIG)
        return shrunk(self._read(), WIDTH // 2)

    def _read(self) -> Frame:
        """The last picture, with what was written over it."""
        frame = np.empty((HEIGHT, WIDTH, 3), dtype=np.uint8)
        mujoco.mjr_readPixels(frame, None, self._renderer._rect, self._renderer._mjr_context)
        return np.flipud(frame).copy()

    def _look(self, azimuth: float, elevation: float, smaller: float = 1.0) -> mujoco.MjvCamera:
        """Make the scene seen from these angles [deg]. ``smaller``: factor on the distance, with space above."""
        camera, model = mujoco.MjvCamera(), self.posed.model
        camera.type, camera.azimuth, camera.elevation = mujoco.mjtCamera.mjCAMERA_FREE, azimuth, elevation
        half = math.tan(math.radians(model.vis.global_.fovy) / 2)
        camera.lookat[:], camera.distance = self.middle, smaller * 0.5 * self.size / half / FILL
        camera.lookat[2] += 0.6 * (smaller - 1.0) * self.size
        option = mujoco.MjvOption()
        option.geomgroup[:] = 1
        option.sitegroup[:] = 0
        self._renderer.update_scene(self.posed.data, camera, option)
        return camera

    # ---- robot ----

    def _paint(self) -> None:
        """Paint colliders orange and other parts of the robot half transparent. Hide everything else."""
        model = self.posed.model
        touching = {
            self.robot.physics.geom(g).name
            for g in range(self.robot.physics.ngeom)
            if self.robot.physics.geom_conaffinity[g]
        }
        for geom in np.flatnonzero(model.body_weldid[model.geom_bodyid]):
            collides = model.geom(geom).name in touching
            if collides:
                model.geom_rgba[geom], model.geom_matid[geom] = COLLIDER_RGBA, -1
            elif model.geom_group[geom] < GROUPS_SHOWN:
                material = int(model.geom_matid[geom])
                rgb = model.mat_rgba[material, :3] if material >= 0 else model.geom_rgba[geom, :3]
                model.geom_rgba[geom], model.geom_matid[geom] = [*rgb, LOOK_ALPHA], -1
            else:
                model.geom_rgba[geom, 3] = 0.0

    def _measure(self) -> None:
        """Compute the centre and the diagonal [m] of the axis-aligned box around the robot."""
        model, data = self.posed.model, self.posed.data
        moving = np.flatnonzero((model.body_weldid[model.geom_bodyid] > 0) & (model.geom_rgba[:, 3] > 0))
        centre, half = boxes(model, data, moving)
        places = np.concatenate([centre - half, centre + half, data.xpos[self.posed.base][None]])
        low, high = places.min(axis=0), places.max(axis=0)
        self.middle, self.size = (low + high) / 2, float(max(high[2] - low[2], 0.95 * np.linalg.norm((high - low)[:2])))

    def _draw_joints(self) -> list[Label]:
        families = list(dict.fromkeys(family(name) for name in self.robot.joint_names))
        labels, length = [], (0.16 if len(self.robot.joint_names) <= MANY else 0.1) * self.size
        for name in self.robot.joint_names:
            joint = self.posed.model.joint(name).id
            place, axis = self.posed.data.xanchor[joint].copy(), self.posed.data.xaxis[joint].copy()
            rgb = FAMILY_RGB[families.index(family(name)) % len(FAMILY_RGB)]
            self._arrow(place, axis, length, rgb)
            labels.append(Label(name, place, rgb, ((place + length * axis, rgb),)))
        return labels

    def _draw_feet(self) -> list[Label]:
        """Draw a disc under each foot, like the viewer's disc of a foot in contact."""
        labels, model = [], self.posed.model
        for name, geoms in self.feet.items():
            foot = patch(model, self.posed.data, [model.geom(geom).id for geom in geoms], self.posed.radius)
            foot.place[2] = 0.002
            draw_disc(self._renderer.scene, foot, 0.002, FOOT_RGBA)
            labels.append(Label(f"foot {name}", foot.place, FOOT_RGBA[:3]))
        return labels

    def _draw_imu(self) -> list[Label]:
        site = self.posed.model.site(self.robot.imu).id
        place, axes = self.posed.data.site_xpos[site].copy(), self.posed.data.site_xmat[site].reshape(3, 3)
        length = 0.2 * self.size
        for axis, rgb in zip(axes.T, AXES_RGB, strict=True):
            self._arrow(place, axis, length, rgb)
        ends = tuple((place + length * axis, rgb) for axis, rgb in zip(axes.T, AXES_RGB, strict=True))
        return [Label(self.robot.imu, place, (1.0, 1.0, 1.0), ends)]

    def _arrow(self, place: FloatArray, axis: FloatArray, length: float, rgb: Rgb) -> None:
        end = place + 2.0 * length * axis  # MuJoCo draws half of the length
        connect(self._renderer.scene, mujoco.mjtGeom.mjGEOM_ARROW, 0.009 * self.size, place, end, (*rgb, 1.0))

    # ---- names ----

    def _write(self, labels: list[Label], camera: mujoco.MjvCamera, title: str) -> Frame:
        """Write names in two columns over the last picture, and draw their lines. Return the picture."""
        placed = _columns([(label, self._project(label.place, camera)) for label in labels])
        context, lines = self._renderer._mjr_context, []
        for label, (x, y), row, left in placed:
            width = _width(context, label.text)
            start = LEFT_COLUMN if left else WIDTH - LEFT_COLUMN - width
            _text(context, label.text, start, row, label.rgb)
            lines.append(((start + width + 6 if left else start - 6, row), (x, y), label.rgb))
        _text(context, title, LEFT_COLUMN, 24, (1.0, 1.0, 1.0))
        for number, part in enumerate(CAPTION.split("   ")):
            _text(context, part, LEFT_COLUMN, HEIGHT - 24 * (4 - number) + 8, (1.0, 1.0, 1.0))
        frame = self._read()
        for start, end, rgb in lines:
            _line(frame, start, end, rgb)
        return frame

    def _project(self, place: FloatArray, camera: mujoco.MjvCamera) -> tuple[float, float]:
        """The pixel (x from the left, y from the top) of ``place`` (3,) [m, world frame]."""
        azimuth, elevation = math.radians(camera.azimuth), math.radians(camera.elevation)
        forward = np.array(
            [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
        )
        right = np.array([math.sin(azimuth), -math.cos(azimuth), 0.0])
        away = place - (np.array(camera.lookat) - camera.distance * forward)
        scale = 0.5 * HEIGHT / math.tan(math.radians(self.posed.model.vis.global_.fovy) / 2) / float(away @ forward)
        return WIDTH / 2 + scale * float(away @ right), HEIGHT / 2 - scale * float(away @ np.cross(right, forward))


def _columns(labels: list[tuple[Label, tuple[float, float]]]) -> list[tuple[Label, tuple[float, float], float, bool]]:
    """For each label: its pixel, the y of its name [px from the top], and whether its name is in the left column."""
    ordered, placed = sorted(labels, key=lambda each: each[1][0]), []
    half = len(ordered) // 2
    for left, column in ((True, ordered[:half]), (False, ordered[half:])):
        column = sorted(column, key=lambda each: each[1][1])
        low, high = 60.0, HEIGHT - 110.0
        gap = min(1.6 * ROW, (high - low) / max(len(column), 1))
        rows: list[float] = []
        for _, (_, y) in column:
            rows.append(max(y, rows[-1] + gap if rows else low))
        for i in reversed(range(len(rows))):  # push names up that are below the bottom
            rows[i] = min(rows[i], rows[i + 1] - gap if i + 1 < len(rows) else high)
        placed += [(label, pixel, row, left) for (label, pixel), row in zip(column, rows, strict=True)]
    return placed


def _width(context: mujoco.MjrContext, text: str) -> int:
    """The width of the text [px]."""
    return sum(int(context.charWidth[ord(letter)]) for letter in text if ord(letter) < 127)


def _text(
    context: mujoco.MjrContext, text: str, x: float, y: float, rgb: Rgb, font: int = mujoco.mjtFont.mjFONT_NORMAL
) -> None:
    """Write text with a dark edge. The centre of its first letter is at the pixel (x, y from the top)."""
    for shift, colour in ((1.2, (0.0, 0.0, 0.0)), (0.0, rgb)):
        down = (HEIGHT - y - shift - 6) / HEIGHT
        mujoco.mjr_text(font, text, context, (x + shift) / WIDTH, down, *colour)


def _line(
    frame: NDArray[np.uint8], start: tuple[float, float], end: tuple[float, float], rgb: Rgb, wide: int = 1
) -> None:
    """Draw a half transparent line between two pixels. ``wide``: its width [px]."""
    steps = max(2, int(np.hypot(end[0] - start[0], end[1] - start[1])))
    x, y = (np.linspace(a, b, steps).round().astype(int) for a, b in zip(start, end, strict=True))
    steep = abs(end[1] - start[1]) > abs(end[0] - start[0])
    for shift in range(wide):
        column, row = (x + shift, y) if steep else (x, y + shift)
        inside = (column >= 0) & (column < WIDTH) & (row >= 0) & (row < HEIGHT)
        column, row = column[inside], row[inside]
        frame[row, column] = (0.35 * frame[row, column] + 0.65 * 255.0 * np.array(rgb)).astype(np.uint8)
