"""A robot alone as MJCF text: without the ground, servos and sensors that were added to it. No path in it is absolute."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import os
import re
from pathlib import Path

import mujoco

from legged_mw.sim.ground import GROUND
from legged_mw.sim.model import RobotModel


def stands_alone(file: Path) -> bool:
    """Whether ``file`` is an MJCF that needs no other file: then a copy of it is the robot."""
    text = file.read_text(errors="replace")
    return bool(re.search(r"<mujoco[\s>]", text)) and not re.search(
        r"<robot[\s>]|<include\s|\sfile\s*=|\sfile(right|left|up|down|front|back)\s*=", text
    )


def as_mjcf(robot: RobotModel, name: str, file: Path, folder: Path) -> str:
    """``robot``, which was read from ``file``, as text to be written into ``folder``; meshes are named relative to that."""
    spec = robot.spec.copy()
    for added in [*spec.actuators, *spec.sensors, *spec.keys, *[geom for geom in spec.geoms if geom.name.partition("/")[0] == GROUND]]:
        spec.delete(added)
    for joint, effort in zip([joint for joint in spec.joints if joint.type != mujoco.mjtJoint.mjJNT_FREE], robot.effort_range, strict=True):
        if effort[1] < float("inf"):
            joint.actfrclimited, joint.actfrcrange = True, [float(effort[0]), float(effort[1])]
    _name_files(spec, file.resolve().parent, folder.resolve())
    spec.modelname = name
    spec.comment = f"\n    {name}: facts of the machine, from {file.name}. Ground, servos and sensors are added where it is loaded.\n  "
    return spec.to_xml()


def _name_files(spec: mujoco.MjSpec, beside: Path, folder: Path) -> None:
    """Meshes and pictures are named relative to ``folder``; what is not there is left as it was written."""
    for items, home in ((spec.meshes, spec.meshdir), (spec.textures, spec.texturedir), (spec.hfields, "")):
        for item in items:
            if item.file and (path := beside / home / item.file).is_file():
                item.file = os.path.relpath(path, folder)
    spec.meshdir = spec.texturedir = ""
