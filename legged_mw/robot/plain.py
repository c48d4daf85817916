"""A robot alone as MJCF text, for one that is not an MJCF without other files already. No path in it is absolute."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import os
import re
from pathlib import Path

import mujoco

from legged_mw.sim.meshes import path_of
from legged_mw.sim.vendor import naming, read_robot


def stands_alone(file: Path) -> bool:
    """Whether ``file`` is an MJCF that needs no other file: then a copy of it is the robot."""
    text = file.read_text(errors="replace")
    return bool(re.search(r"<mujoco[\s>]", text)) and not re.search(
        r"<robot[\s>]|<include\s|\sfile\s*=|\sfile(right|left|up|down|front|back)\s*=", text
    )


def as_mjcf(name: str, file: Path, folder: Path) -> str:
    """The robot in ``file`` as text to be written into ``folder``; meshes are named relative to that."""
    robot = read_robot(file)
    spec = robot.spec
    for joint in robot.joints:
        if joint.name in robot.limits:
            joint.actfrclimited, joint.actfrcrange = True, [*robot.limits[joint.name]]
    spec.modelname = name
    spec.comment = f"\n    {name}: facts of the machine, from {file.name}. Ground, servos and sensors are added where it is loaded.\n  "
    with naming(file):
        spec.compile()
        _name_files(spec, folder.resolve())
        return spec.to_xml()


def _name_files(spec: mujoco.MjSpec, folder: Path) -> None:
    """Meshes and pictures are named relative to ``folder``; what is not there is left as it was written."""
    for item in (*spec.meshes, *spec.textures):
        if item.file and (path := path_of(spec, item).resolve()).is_file():
            item.file = os.path.relpath(path, folder)
    spec.meshdir, spec.texturedir, spec.strippath = "", "", False
