"""A robot alone as MJCF text, for one that is not an MJCF without other files already. No path in it is absolute."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from xml.sax.saxutils import escape

import mujoco

from legged_mw.robot.meshes import path_of
from legged_mw.robot.mjcf import Source
from legged_mw.robot.vendor import read_robot
from legged_mw.sim.robot_file import naming


def stands_alone(file: Path) -> bool:
    """Whether ``file`` is an MJCF that needs no other file: then a copy of it is the robot."""
    source = Source(file)
    return source.root.tag == "mujoco" and not source.named


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
        paths = _name_files(spec, Source(file).folders)
        text = spec.to_xml()
    for path in paths:
        text = text.replace(f'"{escape(str(path))}"', f'"{escape(os.path.relpath(path, folder.resolve()))}"')
    return text


def _name_files(spec: mujoco.MjSpec, folders: Iterable[str]) -> set[Path]:
    """Give meshes and pictures absolute paths, and return these; what is not there is left as it was written."""
    found: set[Path] = set()

    def named(item: mujoco.MjsMesh | mujoco.MjsTexture, file: str) -> str:
        own = item.compiler.meshdir if isinstance(item, mujoco.MjsMesh) else item.compiler.texturedir
        places = [path_of(spec, item, file), *(Path(folder) / own / file for folder in folders)]
        path = next((place.resolve() for place in places if file and place.is_file()), None)
        found.update([path] if path else [])
        return str(path) if path else file

    for item in (*spec.meshes, *spec.textures):
        item.file = named(item, item.file)
    for texture in spec.textures:
        texture.cubefiles = [named(texture, file) for file in texture.cubefiles]
    spec.meshdir, spec.texturedir, spec.strippath = "", "", False
    return found
