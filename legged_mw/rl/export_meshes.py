"""Meshes that MuJoCo builds from some numbers, written as those numbers: as text, their vertices are most of an MJCF."""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import re
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

_BUILT = ("vertex", "normal", "texcoord", "face", "facenormal", "facetexcoord")  # what the numbers stand for
_PLACES = ("mesh_vertnum", "mesh_facenum", "mesh_vert", "mesh_pos", "mesh_quat", "geom_pos", "geom_quat", "geom_size")
TOLERANCE = 1e-5  # of places [m] and of quaternions: MuJoCo writes six digits


def shorten(xml: str, source: str) -> str:
    """``xml``, an MJCF that MuJoCo wrote, with meshes as ``source``, an MJCF that somebody wrote, has MuJoCo build them.

    As it was, where that would be another model: a mesh may have been renamed, or come from a file that ``source`` includes.
    """
    short = xml
    for name, numbers in built_meshes(source).items():
        start = f"<mesh name={quoteattr(name)}"
        element = re.search(rf"{re.escape(start)}[^>]*>", short)
        if element and " vertex=" in element[0]:
            left = re.sub(rf' ({"|".join(_BUILT)})="[^"]*"', "", element[0])
            short = short.replace(element[0], left.replace(start, f"{start} {numbers}", 1), 1)
    return short if short == xml or _same(short, xml) else xml


def built_meshes(source: str) -> dict[str, str]:
    """Mesh -> the attributes that build it, of the MJCF ``source``; none of what is no MJCF."""
    try:
        meshes = [
            mesh for mesh in ElementTree.fromstring(source).iter("mesh") if mesh.get("name") and mesh.get("builtin")
        ]
    except ElementTree.ParseError:
        return {}
    wanted = ("builtin", "params")
    return {
        mesh.attrib["name"]: " ".join(f"{key}={quoteattr(mesh.attrib[key])}" for key in wanted if key in mesh.attrib)
        for mesh in meshes
    }


def _same(short: str, xml: str) -> bool:
    try:
        new, old = (mujoco.MjModel.from_xml_string(text) for text in (short, xml))
    except ValueError:
        return False
    pairs = [(getattr(new, field), getattr(old, field)) for field in _PLACES]
    return all(a.shape == b.shape and np.allclose(a, b, rtol=0.0, atol=TOLERANCE) for a, b in pairs)
