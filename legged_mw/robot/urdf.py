"""Prepare a URDF for MuJoCo's reader: find mesh files, drop unreadable visuals, remove tiny masses."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import mujoco

from legged_mw.robot.meshes import READABLE, why_unreadable
from legged_mw.robot.mjcf import XmlSource
from legged_mw.utils.errors import ModelError

_KNOWN = ("link", "joint", "material", "mujoco")  # elements for the reader; the rest is for other programs
_COMPILER = {"fusestatic": "false", "discardvisual": "false", "strippath": "false"}
_SPECK = 1e-9  # [kg] a lighter link has no mass
SHAPES = "give the <collision> a <box>, <cylinder> or <sphere>"


def read_urdf(source: XmlSource, notes: list[str], lost: dict[str, str]) -> tuple[mujoco.MjSpec, dict[str, float]]:
    """The spec with one body per link, and joint -> speed limit [rad/s]. ``lost``: see ``RobotFile``.

    It modifies the tree of ``source``. Raises ValueError for a file that is not a URDF.
    """
    file, robot = source.file, source.root
    if any(element.tag.startswith("xacro:") for element in robot.iter()):
        raise ModelError(f"{file.name} has xacro macros; expand them first: xacro {file.name} > robot.urdf")
    for other in [child for child in robot if child.tag not in _KNOWN]:
        robot.remove(other)
    _drop_places(robot, notes)
    joints = {joint.get("name", ""): joint for joint in robot.findall("joint")}
    if mimics := [name for name, joint in joints.items() if joint.find("mimic") is not None]:
        notes.append(f"mimic dropped: {', '.join(mimics)} are independent joints")
    _drop_points(robot, file, notes)
    _keep_one_material(robot, notes)
    _drop_specks(robot, notes)
    files = _find_meshes(robot, file, notes, lost)
    extension = robot.find("mujoco")
    extension = ElementTree.SubElement(robot, "mujoco") if extension is None else extension
    compiler = extension.find("compiler")
    compiler = ElementTree.SubElement(extension, "compiler") if compiler is None else compiler
    compiler.attrib |= _COMPILER
    compiler.attrib.pop("meshdir", None)
    spec = source.spec()
    for mesh in spec.meshes:
        mesh.file = str(files[mesh.file])
    _set_looks(spec)
    limits = {name: joint.find("limit") for name, joint in joints.items()}
    speeds = {name: float(limit.get("velocity", 0.0)) for name, limit in limits.items() if limit is not None}
    return spec, {name: speed for name, speed in speeds.items() if speed > 0.0}


def _drop_places(robot: Element, notes: list[str]) -> None:
    """Drop root links, such as base_footprint, that only define a frame for other programs."""
    children = {_end(joint, "child") for joint in robot.findall("joint")}
    for link in [link for link in robot.findall("link") if link.get("name") not in children]:
        held = [joint for joint in robot.findall("joint") if _end(joint, "parent") == link.get("name")]
        if held and (link.get("name") == "world" or (len(held) == 1 and not len(link) and _leads_elsewhere(held[0]))):
            for thing in (link, *held):
                robot.remove(thing)
            names = ", ".join(f"'{joint.get('name')}'" for joint in held)
            notes.append(f"link '{link.get('name')}' and joint {names} dropped: the root is free")
            _drop_places(robot, notes)


def _end(joint: Element, which: str) -> str | None:
    end = joint.find(which)
    return None if end is None else end.get("link")


def _leads_elsewhere(joint: Element) -> bool:
    """Whether the joint offsets or frees the robot from an empty parent link, such as base_footprint."""
    origin = joint.find("origin")
    numbers = [] if origin is None else f"{origin.get('xyz', '')} {origin.get('rpy', '')}".split()
    return joint.get("type") == "floating" or (
        joint.get("type") == "fixed" and any(float(number) for number in numbers)
    )


def _drop_points(robot: Element, file: Path, notes: list[str]) -> None:
    """Drop visuals of size zero, which MuJoCo does not compile. Raises ModelError for a collider of size zero."""
    left_out: list[str] = []
    for link in robot.findall("link"):
        for part in [part for part in [*link.findall("visual"), *link.findall("collision")] if _has_no_size(part)]:
            if part.tag == "collision":
                raise ModelError(
                    f"{file.name}: link '{link.get('name')}' collides as a shape of size 0; give it a size, or leave it out"
                )
            link.remove(part)
            left_out.append(f"'{link.get('name')}'")
    if left_out:
        notes.append(f"looks left out (of size 0): those of link {', '.join(dict.fromkeys(left_out))}")


def _keep_one_material(robot: Element, notes: list[str]) -> None:
    """Keep the first material of each visual: MuJoCo refuses a second one, which B2's exporter writes."""
    with_more = [part for part in robot.iter("visual") if len(part.findall("material")) > 1]
    for part in with_more:
        for other in part.findall("material")[1:]:
            part.remove(other)
    if with_more:
        notes.append(f"materials dropped: all but the first of {len(with_more)} looks")


def _drop_specks(robot: Element, notes: list[str]) -> None:
    """Drop masses of empty links, such as B2's exporter writes (4e-15 kg): MuJoCo refuses moments below 1e-15."""
    specks: list[str] = []
    for link in robot.findall("link"):
        inertial, mass = link.find("inertial"), link.find("inertial/mass")
        with suppress(ValueError):  # MuJoCo reports text that is not a number
            if inertial is not None and mass is not None and 0.0 < float(mass.get("value", "0")) < _SPECK:
                link.remove(inertial)
                specks.append(f"'{link.get('name')}'")
    if specks:
        notes.append(f"masses below {_SPECK:g} kg dropped: those of link {', '.join(specks)}")


def _has_no_size(part: Element) -> bool:
    shape = part.find("geometry/*")
    with suppress(ValueError):  # MuJoCo reports text that is not a number
        if shape is not None and shape.tag != "mesh":
            return any(
                not float(number) for name in ("radius", "length", "size") for number in shape.get(name, "").split()
            )
    return False


def _find_meshes(robot: Element, file: Path, notes: list[str], lost: dict[str, str]) -> dict[str, Path]:
    """Give each mesh a unique name, and return name -> file. Remove parts without a readable file."""
    compiler, names = robot.find("mujoco/compiler"), dict[Path, str]()
    meshdir = "" if compiler is None else compiler.get("meshdir", "")
    left_out: dict[str, list[str]] = {}
    for link in robot.findall("link"):
        for part in [*link.findall("visual"), *link.findall("collision")]:
            mesh = part.find("geometry/mesh")
            if mesh is None:
                continue
            filename = mesh.get("filename", "")
            path = _resolve(filename, file, meshdir)
            reason = why_unreadable(path)
            if reason and part.tag == "collision":
                name = link.get("name", "")
                lost[name] = (
                    f"{file.name}: link '{name}' collides as the mesh {filename}, which cannot be read ({reason}; looked for it "
                    f"beside {file.name} and in the folders above); put it there as one of {', '.join(READABLE)}, or {SHAPES}"
                )
                notes.append(f"collider of '{name}' left out ({reason}): {filename}")
            elif reason:
                left_out.setdefault(reason, []).append(filename)
            if reason:
                link.remove(part)
                continue
            mesh.set("filename", names.setdefault(path, f"{path.stem}_{len(names)}{path.suffix}"))
    for reason, files in left_out.items():
        notes.append(f"looks left out ({reason}): {', '.join(dict.fromkeys(files))}")
    return {name: path for path, name in names.items()}


def _resolve(asked: str, file: Path, meshdir: str) -> Path:
    """The path of a mesh in a URDF. package:// is searched in the folders above it, by the package's name first."""
    here = file.resolve().parent
    scheme, _, rest = asked.rpartition("://")
    if scheme == "file":
        return Path(rest)
    package, _, inside = rest.partition("/") if scheme == "package" else ("", "", rest)
    name = Path(inside).name
    above = [here, *here.parents]
    places = [folder / inside for folder in above if folder.name == package] + [
        folder / package / inside for folder in above
    ]
    # the folder of the package may have another name
    places += [folder / inside for folder in above[:5]] + [here / meshdir / inside, here / name, here / "meshes" / name]
    return next((place for place in places if place.is_file()), here / inside)


def _set_looks(spec: mujoco.MjSpec) -> None:
    """Hide colliders of links with visuals. Links without <inertial> get no mass."""
    for body in spec.bodies:
        seen = any(not (geom.contype or geom.conaffinity) for geom in body.geoms)
        for geom in body.geoms:
            if seen and (geom.contype or geom.conaffinity):
                geom.group = 3
            if not body.explicitinertial:
                geom.mass = 0.0
