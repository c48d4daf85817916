"""Read motions of other programs: Unitree-style CSV, and the .npz of BeyondMimic and mjlab."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.sim.joints import posed
from legged_mw.sim.model import RobotModel
from legged_mw.skills.clip import KEYS, Clip, ClipError, checked, clip_of
from legged_mw.utils.files import read_arrays

CSV_FPS = 30.0  # of the LAFAN1 motions retargeted by Unitree
APART = 0.02  # [m] largest accepted distance between the bodies of a file and ours


def read_motion(path: Path, robot: RobotModel, fps: float | None = None) -> Clip:
    """The motion in ``path``, a .csv or .npz, for ``robot``. ``fps``: for a file without one. Raises ClipError."""
    if path.suffix.lower() == ".csv":
        return _read_csv(path, robot, CSV_FPS if fps is None else fps)
    if path.suffix.lower() != ".npz":
        raise ClipError(
            f"{path} is neither .csv nor .npz: a motion is Unitree's CSV, or an .npz of BeyondMimic, mjlab or legged_mw"
        )
    try:
        held = read_arrays(path)
    except ValueError as error:
        raise ClipError(f"{path} cannot be read as a motion: {error}") from None
    if {*KEYS} <= {*held}:
        return clip_of(path, held).of(robot.joint_names, str(path))
    return _read_bodies(path, robot, held, fps)


def _read_csv(path: Path, robot: RobotModel, fps: float) -> Clip:
    """One line per frame: root x, y, z [m], quaternion x, y, z, w, joints [rad] in the order of the robot's file."""
    try:
        lines = [line for line in path.read_text(encoding="utf-8-sig").splitlines() if line.partition("#")[0].strip()]
        if lines and not _is_number(lines[0].split(",")[0]):  # a header with names
            del lines[0]
        if not lines:
            raise ValueError("it holds none")
        table = np.loadtxt(lines, delimiter=",", ndmin=2)
    except (OSError, ValueError) as error:
        raise ClipError(f"{path} cannot be read as a CSV of numbers: {error}") from None
    count = 7 + len(robot.joint_names)
    if table.shape[1:] != (count,):
        columns = table.shape[1] if table.ndim > 1 else 0
        raise ClipError(
            f"{path} has {columns} columns; of this robot it must have {count}: root x y z, quaternion x y z w, then the joints"
        )
    return checked(path, fps, robot.joint_names, table[:, :3], table[:, [6, 3, 4, 5]], table[:, 7:])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _read_bodies(path: Path, robot: RobotModel, held: Mapping[str, Any], fps: float | None) -> Clip:
    """Joint angles without names, and the positions of all bodies: find the joint order that matches the positions."""
    for key in ("joint_pos", "body_pos_w", "body_quat_w"):
        if key not in held:
            raise ClipError(
                f"{path} has no '{key}'; a motion of BeyondMimic or mjlab has joint_pos, body_pos_w, body_quat_w and fps"
            )
    for key, axes in (("joint_pos", 2), ("body_pos_w", 3), ("body_quat_w", 3)):
        if held[key].ndim != axes or 0 in held[key].shape or held[key].dtype.kind not in "fiu":
            raise ClipError(
                f"{path}: {key} must be numbers with {axes} axes; it is {held[key].dtype} {held[key].shape}"
            )
    said = np.ravel(held.get("fps", fps or 0.0))
    if said.size != 1 or said.dtype.kind not in "fiu":
        raise ClipError(f"{path}: fps must be one number; it is {said.dtype} {said.shape}")
    rate = float(said[0])
    if not rate:
        raise ClipError(f"{path} does not say how many frames a second it has; say --fps")
    places, turns = held["body_pos_w"], held["body_quat_w"]
    distances = {}
    for words, names in {
        "as in the robot's file": list(robot.joint_names),
        "breadth first": breadth_first(robot),
    }.items():
        clip = checked(path, rate, names, places[:, 0], turns[:, 0], held["joint_pos"]).of(robot.joint_names, str(path))
        distances[words] = (
            max(_apart(robot, clip, places, frame) for frame in np.linspace(0, len(places) - 1, 5).astype(int)),
            clip,
        )
    apart, clip = min(distances.values(), key=lambda each: each[0])
    if not apart <= APART:  # NaN neither
        raise ClipError(
            f"{path}: with its joints in either order ({', '.join(distances)}) bodies are {apart:.2f} m from where it says; another robot?"
        )
    return clip


def breadth_first(robot: RobotModel) -> list[str]:
    """The joints in the order of Isaac Lab: breadth first from the root."""
    model, depth = robot.physics, {}
    for name in robot.joint_names:
        body, far = int(model.joint(name).bodyid[0]), 0
        while body:
            body, far = int(model.body_parentid[body]), far + 1
        depth[name] = far
    return sorted(robot.joint_names, key=depth.__getitem__)


def _apart(robot: RobotModel, clip: Clip, places: np.ndarray, frame: int) -> float:
    """The largest distance [m] from a body of the file to the nearest of our bodies."""
    model: mujoco.MjModel = robot.physics
    ours = posed(model, clip.joint_pos[frame], clip.qpos()[frame, :7]).xpos[1:]
    return float(np.linalg.norm(places[frame][:, None] - ours[None], axis=2).min(axis=1).max())
