"""A robot alone as MJCF text, for one that is not an MJCF without other files already. No path in it is absolute."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import os
import re
from pathlib import Path
from xml.sax.saxutils import escape

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
        paths = _name_files(spec, _attached(file))
        text = spec.to_xml()
    for path in paths:
        text = text.replace(f'"{escape(str(path))}"', f'"{escape(os.path.relpath(path, folder.resolve()))}"')
    return text


def _attached(file: Path) -> list[Path]:
    """Folders of the models that the MJCF in ``file`` attaches, and of those that they attach."""
    if not file.is_file():
        return []
    named = re.findall(r"<model\s[^>]*?file\s*=\s*[\"']([^\"']+)", file.read_text(errors="replace"))
    models = [file.parent / name for name in named]
    return [folder for model in models for folder in (model.parent, *_attached(model))]


def _name_files(spec: mujoco.MjSpec, attached: list[Path]) -> set[Path]:
    """Give meshes and pictures absolute paths, and return these; what is not there is left as it was written."""
    found: set[Path] = set()

    def named(item: mujoco.MjsMesh | mujoco.MjsTexture, file: str) -> str:
        own = item.compiler.meshdir if isinstance(item, mujoco.MjsMesh) else item.compiler.texturedir
        places = [path_of(spec, item, file), *(folder / own / file for folder in attached)]
        path = next((place.resolve() for place in places if file and place.is_file()), None)
        found.update([path] if path else [])
        return str(path) if path else file

    for item in (*spec.meshes, *spec.textures):
        item.file = named(item, item.file)
    for texture in spec.textures:
        texture.cubefiles = [named(texture, file) for file in texture.cubefiles]
    spec.meshdir, spec.texturedir, spec.strippath = "", "", False
    return found
