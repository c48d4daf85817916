"""Check a clip on a robot, and play it as a stage in the viewers."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from legged_mw.drawing.scene import visual_spec
from legged_mw.sim.model import RobotModel
from legged_mw.sim.surface_points import SPACING, spheres_on
from legged_mw.skills.clip import Clip, Floats, conjugate, rotate
from legged_mw.utils.commands import Command
from legged_mw.view.stage import BoolArray, FloatArray

DEEP, NEAR = 0.01, 0.005  # [m] largest accepted depth below the ground; largest height of a standing foot
SLIDING = 0.1  # [m/s] largest accepted speed of a standing foot
BEYOND = 1e-3  # [rad] largest accepted excess over a joint's limits


def page(robot: RobotModel, clip: Clip, feet: Sequence[str]) -> str:
    """A summary of the clip, and its faults on this robot. ``feet``: geoms of the feet."""
    speed = np.abs(clip.qvel()[:, 6:])
    fastest = int(speed.max(axis=0).argmax())
    lines = [
        f"{len(clip.root_pos)} frames, {clip.seconds:.2f} s at {clip.fps:g} frames a second, {len(clip.joint_names)} joints"
    ]
    lines.append(
        f"fastest joint: {clip.joint_names[fastest]}, {speed.max():.1f} rad/s after {_when(clip, speed[:, fastest])}"
    )
    heights, slides = _feet(robot, clip, feet)
    lowest, now = heights.min(), heights.min(axis=1)
    lines.append(f"lowest point: {round(1000 * lowest)} mm above the ground after {_when(clip, -now)}")
    lines.append(
        f"fastest slide of a foot within {1000 * NEAR:.0f} mm of the ground: {slides.max():.2f} m/s after {_when(clip, slides)}"
    )
    return "\n".join([*lines, *(f"warning: {text}" for text in wrong(robot, clip, float(lowest), float(slides.max())))])


def wrong(robot: RobotModel, clip: Clip, lowest: float, slide: float) -> list[str]:
    """The faults of the clip, one line each."""
    faults, (low, high) = [], robot.joint_range.T
    beyond = np.maximum(low - clip.joint_pos, clip.joint_pos - high)
    for joint in np.flatnonzero(beyond.max(axis=0) > BEYOND):
        far, limits = beyond[:, joint].max(), f"{low[joint]:.2f} to {high[joint]:.2f}"
        faults.append(
            f"{clip.joint_names[joint]} is {far:.3f} rad beyond its range ({limits}) after {_when(clip, beyond[:, joint])}"
        )
    if lowest < -DEEP:
        faults.append(f"a foot is {-1000 * lowest:.0f} mm in the ground; --lift {-lowest:.3f} raises the clip")
    if slide > SLIDING:
        faults.append(f"a foot slides on the ground at {slide:.2f} m/s")
    return faults


def _when(clip: Clip, values: Floats) -> str:
    return f"{int(np.argmax(values)) / clip.fps:.2f} s"


def _feet(robot: RobotModel, clip: Clip, feet: Sequence[str]) -> tuple[Floats, Floats]:
    """The height of each foot's lowest point (T, bodies) [m], and the speed of the fastest standing foot (T,) [m/s].

    The speed is that of the lowest point, so a foot that turns about its toe does not slide.
    """
    model, data, heights, speeds = robot.physics, mujoco.MjData(robot.physics), [], []
    points = {geom: spheres_on(model, geom, SPACING) for geom in (robot.id("geom", name) for name in feet)}
    bodies = sorted({int(model.geom_bodyid[geom]) for geom in points})
    lowest = dict.fromkeys(bodies, np.zeros(3))  # of the frame before, body frame
    places = lowest  # the same, world frame
    for row in clip.qpos():
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        turns = {body: data.xmat[body].reshape(3, 3) for body in bodies}
        now = {body: data.xpos[body] + turns[body] @ lowest[body] for body in bodies}
        speeds.append([np.linalg.norm((now[body] - places[body])[:2]) * clip.fps for body in bodies])
        places = {body: np.full(3, np.inf) for body in bodies}
        for geom, (spheres, radius) in points.items():
            body = int(model.geom_bodyid[geom])
            ends = data.geom_xpos[geom] + spheres @ data.geom_xmat[geom].reshape(3, 3).T - [0.0, 0.0, radius]
            places[body] = min(places[body], ends[ends[:, 2].argmin()], key=lambda place: place[2])
        lowest = {body: turns[body].T @ (places[body] - data.xpos[body]) for body in bodies}
        heights.append([places[body][2] for body in bodies])
    height, speed = np.array(heights), np.array(speeds)
    standing = (height[1:] < NEAR) & (height[:-1] < NEAR)
    return height, np.r_[0.0, np.where(standing, speed[1:], 0.0).max(axis=1)]


class ClipStage:
    """A clip as a stage: one robot, posed without physics; see ``view.stage.Stage``. The clip repeats at its end."""

    command_table: tuple[Command, ...] = ()
    num_worlds = 1

    def __init__(self, robot: RobotModel, clip: Clip) -> None:
        self.spec: mujoco.MjSpec = visual_spec(robot)
        self.dt, self._qpos, self._qvel, self._frame = 1.0 / clip.fps, clip.qpos(), clip.qvel(), 0
        self._imu = robot.physics.site(robot.imu).pos if robot.imu else np.zeros(3)

    def step(self, commands: FloatArray | None) -> None:
        self._frame = (self._frame + 1) % len(self._qpos)

    def commands(self) -> FloatArray:
        return np.zeros((1, 0))

    def velocity(self) -> FloatArray:
        velocity, turning = np.split(self._qvel[self._frame, :6], 2)  # of the root: world, body
        at_imu = rotate(conjugate(self._qpos[self._frame, 3:7]), velocity) + np.cross(turning, self._imu)
        return np.array([[*at_imu[:2], turning[2]]])

    def believed_velocity(self) -> FloatArray | None:
        return None

    def qpos(self) -> FloatArray:
        return self._qpos[self._frame][None]

    def ghost(self) -> FloatArray | None:
        return None

    def contacts(self) -> BoolArray:
        return np.zeros((1, 0), dtype=bool)

    def fell(self) -> BoolArray:
        return np.zeros(1, dtype=bool)

    def ground(self, world: int) -> str:
        return ""

    def push(self, world: int, velocity: FloatArray) -> None: ...

    def reset(self, world: int) -> None:
        self._frame = 0
