"""A picture strip of one robot in an exam, from left to right in time."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from legged_mw.drawing.scene import visual_spec
from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval.skill import Floats
from legged_mw.view.recorder import RobotRenderer, contact_sheet, save_png
from legged_mw.view.stage import Moment

PICTURES, COLUMNS, WIDTH, HEIGHT = 12, 6, 320, 240  # pictures, pictures per row, [px] of each


def strip(env: RobotTask, qpos: Floats) -> bytes:
    """A PNG of the robot at PICTURES times, evenly spaced over ``qpos`` (T, nq). Raises ViewError if drawing fails."""
    renderer, none = RobotRenderer(visual_spec(env.robot, env.cfg.viewer.camera), WIDTH, HEIGHT), np.zeros((1, 3))
    frames = []
    for step in np.linspace(0, len(qpos) - 1, PICTURES).round().astype(int):
        lines = ((f"{step * env.dt:.1f} s", ""),)
        there = np.concatenate([qpos[0, :2], qpos[step, 2:]])  # keep x and y at the start, in view of the camera
        moment = Moment(
            step * env.dt, there[None], none[:, :0], np.nan * none, none, np.zeros((1, 0), dtype=bool), lines=lines
        )
        frames.append(renderer.frame(moment))
    renderer.close()
    with TemporaryDirectory() as folder:
        save_png(path := Path(folder) / "strip.png", contact_sheet(frames, COLUMNS))
        return path.read_bytes()
