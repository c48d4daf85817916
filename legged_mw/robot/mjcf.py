"""Read untrusted XML of robots and scenes: parse it once, check its attributes, pass the checked tree to MuJoCo.

MuJoCo gets the text of the parsed trees, not the file or its included and attached files. So an entity, a comment, an
encoding or malformed XML cannot have one meaning here and another in MuJoCo. An error is a ValueError of one line
without the file's name.
"""

from __future__ import annotations

import io
import math
import os
import re
import stat
import zipfile
import zlib
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, TreeBuilder, tostring
from xml.parsers import expat

import mujoco
import numpy as np

from legged_mw.sim.robot_file import SCALAR_JOINTS

ARCHIVE = ".mjz"  # MuJoCo's name for a zipped model
ON_JOINTS = (mujoco.mjtTrn.mjTRN_JOINT, mujoco.mjtTrn.mjTRN_JOINTINPARENT)  # transmissions of actuators
_INSIDE = "model.xml"
MOST_BYTES = 64 << 20  # of one file: ten times the largest known robots with inline meshes
# Largest mass of a body [kg]; length [m] or inertia [kg m^2]; gravity [m/s^2], which is 981 for a file in cm.
HEAVIEST, WIDEST, FASTEST = 1e5, 1e6, 1e3
# Most elements, with all copies; cells of height fields and textures; depth of nesting.
_ELEMENTS, _CELLS, _DEEPEST = 20_000, 1e8, 200
_TOO_MUCH = (
    f"makes more than {_ELEMENTS} elements, all copies counted, or {_CELLS:g} cells of height fields and pictures"
)
_PLACES = 100_000  # most named files times folders to search
_PIECE, _LONGEST = 1 << 20, 16 << 20  # [byte] fed to the parser at a time; largest element with attributes
# attribute -> largest accepted value
_MOST = {"count": 1e4, "nrow": 2e4, "ncol": 2e4, "width": 16384, "height": 16384, "nkey": 1e4}
_MOST |= {f"nuser_{kind}": 1e3 for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")} | {
    "nuserdata": 1e6
}
_MOST |= {"mass": HEAVIEST, "density": 1e6, "armature": WIDEST, "frictionloss": WIDEST, "diaginertia": WIDEST}
# arrays of the compiled model
_SIZES = ("mass", "inertia", "pos", "ipos", "size", "armature", "damping", "frictionloss", "stiffness")
_DIRS = ("meshdir", "texturedir", "assetdir")
_OF_URDF = ("mesh", "texture", "compiler")  # elements of a URDF that name files for MuJoCo
_NAMES = ("name", "class", "childclass", "model", "file", "dir", *_DIRS)


class XmlSource:
    """A robot's file with its included and attached files. Raises ValueError for content that no robot needs.

    ``alone``: refuse files outside the file's folder. Otherwise meshes and textures may lie elsewhere.
    """

    def __init__(self, file: Path, alone: bool = False) -> None:
        self.file, self.alone = file.absolute(), alone
        self.home = os.path.realpath(self.file.parent)
        self.named: dict[str, str] = {}  # named file -> line in which it is named
        self.folders: dict[str, None] = {}  # folders to search for these files, in order
        self._parts = {os.path.realpath(file): ""}  # included or attached file -> its name for MuJoCo; "": being read
        self._texts: dict[str, bytes] = {}  # name for MuJoCo, without folder -> text for MuJoCo
        self.elements, self._largest = 0, 0.0  # number of elements read; elements of the largest file, with its copies
        self.root = self._read(self.file, str(self.file.parent))
        if len(self.named) * len(self.folders) > _PLACES:
            raise ValueError(
                f"it names {len(self.named)} files, which may lie in {len(self.folders)} folders; no robot has so many"
            )
        for name, where in self.named.items():
            # MuJoCo may strip folders from names (strippath)
            for place in (
                os.path.join(folder, path) for folder in self.folders for path in (name, os.path.basename(name))
            ):
                _check_regular(place, where)

    @property
    def text(self) -> str:
        """The text for MuJoCo. Each element keeps its line number in the file."""
        return tostring(self.root, encoding="unicode")

    def spec(self) -> mujoco.MjSpec:
        """MuJoCo's spec of ``root``."""
        if self.file.suffix == ARCHIVE:  # an archive names no other file
            return mujoco.MjSpec.from_string(self.text)
        name = f"{self.file}.xml"  # MuJoCo warns about unknown suffixes
        return mujoco.MjSpec.from_file(name, include={os.path.basename(name): self.text.encode(), **self._texts})

    def take(self, name: str, path: str, folder: str) -> str:
        """Read an included or attached file. Return its path for MuJoCo: the same folder, a unique name."""
        real = os.path.realpath(path)
        if not Path(real).is_relative_to(self.home):
            raise ValueError(f"it includes {name[:200]}, which lies outside of its own folder; put that file beside it")
        if not os.path.isfile(real):
            raise ValueError(f"it includes {name[:200]}, which is no file here")
        if real not in self._parts:
            self._parts[real] = ""
            text = tostring(self._read(Path(path), folder), encoding="unicode")
            self._parts[real] = place = f"{path}.{len(self._texts)} of {self.file.name}.xml"
            self._texts[os.path.basename(place)] = text.encode()
        if not self._parts[real]:
            raise ValueError(f"it includes {name}, which is already included")
        return self._parts[real]

    def _read(self, path: Path, folder: str) -> Element:
        root = _Reader(self, path, folder).root
        self._largest = max(self._largest, self._size(root))
        if self._largest > _ELEMENTS:
            raise ValueError(f"{path.name} {_TOO_MUCH}")
        return root

    def _size(self, element: Element) -> float:
        """The number of elements that MuJoCo creates for this one. A cell of a height field or texture is a share."""
        size = 1.0 + (self._largest if element.tag in ("include", "attach") else 0.0)
        for sides in (("nrow", "ncol"), ("width", "height")):
            size += math.prod(max(_numbers(element.get(side, "")), default=0.0) for side in sides) * _ELEMENTS / _CELLS
        return math.prod(max(1.0, number) for number in _numbers(element.get("count", ""))) * (
            size + sum(map(self._size, element))
        )


class _Reader:
    """Builds the tree of one file, without comments and text. Raises ValueError with the line number."""

    def __init__(self, source: XmlSource, path: Path, folder: str) -> None:
        self.source, self.path, self.folder = source, path, folder  # folder: of the model to which the file belongs
        self.file = "" if path == source.file else f"{path.name}: "
        self.builder, self.parser = TreeBuilder(), expat.ParserCreate("utf-8")
        self.line, self.depth, self.urdf = 1, 0, False
        self.parser.StartElementHandler, self.parser.EndElementHandler = self._start, self._end
        self.parser.StartDoctypeDeclHandler = self._refuse_doctype
        source.folders |= dict.fromkeys((folder, str(path.parent)))
        content = _text(path).encode()
        try:
            for start in range(0, len(content), _PIECE):
                self.parser.Parse(content[start : start + _PIECE])
                # limit this length, because the parser scans an unfinished element again with each piece
                if start - self.parser.CurrentByteIndex > _LONGEST:
                    raise ValueError(f"{self.where}an element has more than {_LONGEST >> 20} MiB")
            self.parser.Parse(b"", True)
        except expat.ExpatError as error:
            raise ValueError(f"{self.file}it is no XML: {error}") from None
        self.root = self.builder.close()

    @property
    def where(self) -> str:
        return f"{self.file}line {self.parser.CurrentLineNumber}: "

    def _refuse_doctype(self, *_: object) -> None:
        raise ValueError(f"{self.where}it has a DOCTYPE, which may define entities; leave it out")

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self.depth, self.source.elements = self.depth + 1, self.source.elements + 1
        if self.depth > _DEEPEST or len(attributes) > _DEEPEST:  # MuJoCo's reader is quadratic in attributes
            raise ValueError(f"{self.where}it is nested too deeply, or has more than {_DEEPEST} attributes")
        if self.source.elements > _ELEMENTS:
            raise ValueError(f"{self.where}it {_TOO_MUCH}")
        self.urdf = self.urdf or (tag == "robot" and self.depth == 1)
        unread = self.urdf and tag not in _OF_URDF  # ignored, such as a simulator's plugins
        for name, value in attributes.items():
            if wrong := "" if name in _NAMES or tag == "flag" else _wrong(name, value):
                raise ValueError(f'{self.where}{name}="{value[:60]}" {wrong}')
            if value and not unread and (name.startswith("file") or name in _DIRS):
                self._note(name, value)
        if tag in ("include", "model") and (name := attributes.get("file")):
            here, home = (os.path.join(folder, name) for folder in (self.path.parent, self.folder))
            path = here if tag == "model" or not os.path.lexists(home) else home  # same rule as MuJoCo
            attributes["file"] = self.source.take(name, path, os.path.dirname(path) if tag == "model" else self.folder)
        self.builder.data("\n" * (self.parser.CurrentLineNumber - self.line))
        self.line = self.parser.CurrentLineNumber
        self.builder.start(tag, attributes)

    def _end(self, tag: str) -> None:
        self.depth -= 1
        self.builder.end(tag)

    def _note(self, attribute: str, name: str) -> None:
        """Record a file or folder that an attribute names."""
        if self.source.file.suffix == ARCHIVE:
            raise ValueError(f"{self.where}it names {name[:200]}; the model of an archive must need no other file")
        if self.source.alone and not Path(os.path.realpath(os.path.join(self.source.home, name))).is_relative_to(
            self.source.home
        ):
            raise ValueError(
                f"{self.where}it names {name[:200]}, which lies outside of its own folder; an export must need no other file"
            )
        if attribute in _DIRS:
            self.source.folders[os.path.join(self.folder, name)] = None
        else:
            self.source.named.setdefault(name, self.where)


def write_archive(file: Path, text: str) -> None:
    """Write an MJCF as MuJoCo's MJZ, a zip file with one model.xml. The same text makes the same bytes."""
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(_INSIDE), text, zipfile.ZIP_DEFLATED, compresslevel=9)


def _text(file: Path) -> str:
    """The text of an MJCF, URDF or MJZ. Raises ValueError for a large file, or an MJZ with other contents."""
    if (size := file.stat().st_size) > MOST_BYTES:
        raise ValueError(f"{file.name} has {size >> 20} MiB; a robot's file has {MOST_BYTES >> 20} at most")
    if file.suffix != ARCHIVE:
        return _without_comments(file.read_text(encoding="utf-8", errors="replace"))
    held = io.BytesIO(file.read_bytes())
    try:
        with zipfile.ZipFile(held) as archive:
            inside = archive.infolist()
            known = [(entry.filename, entry.compress_type) for entry in inside] == [(_INSIDE, zipfile.ZIP_DEFLATED)]
            if known and inside[0].file_size <= MOST_BYTES:
                return _without_comments(archive.read(_INSIDE).decode(errors="replace"))
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        raise ValueError(f"no zip file that can be read: {error}") from None  # RuntimeError: it is encrypted
    names = ", ".join(entry.filename for entry in inside)[:200] or "nothing"
    raise ValueError(
        f"it holds {names}; that of an export holds only {_INSIDE}, deflated, of {MOST_BYTES >> 20} MiB at most"
    )


def _without_comments(text: str) -> str:
    """``text`` without comments and <?xml ?>, with equal line numbers. MuJoCo accepts more forms of both than expat."""
    if text.count("<!--") + text.count("<?xml") > _ELEMENTS:
        raise ValueError(f"it has more than {_ELEMENTS} comments")
    found = r"<!--.*?(?:-->|\Z)|<\?xml\s[^<>]*>"
    return re.sub(found, lambda match: "<!--" + "\n" * match[0].count("\n") + "-->", text, flags=re.DOTALL)


def _check_regular(path: str, where: str) -> None:
    """Raise ValueError if ``path`` exists and is not a regular file, such as a device of infinite length."""
    try:
        regular = stat.S_ISREG(os.stat(path).st_mode)
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        raise ValueError(f"{where}{os.path.basename(path)[:60]} can be no file: {error.strerror}") from None
    if not regular:
        raise ValueError(f"{where}{path} is no file")


def _numbers(value: str) -> list[float]:
    """The numbers in an attribute; empty if it has anything else."""
    try:
        return [float(part) for part in value.split(None, 9)]  # the checked attributes have fewer numbers
    except ValueError:
        return []


def _wrong(name: str, value: str) -> str:
    """The error in an attribute's numbers as text; "" if there is none."""
    if "nan" in value.lower() and any(part.lower().strip("+-") == "nan" for part in value.split()):
        return "is not a number"
    if name.endswith("range") and len(numbers := _numbers(value)) == 2 and numbers[0] > numbers[1]:
        return "ends before it begins"
    if (
        name in _MOST
        and value.strip()
        and not all(0.0 <= number <= _MOST[name] for number in _numbers(value) or [-1.0])
    ):
        return f"must be from 0 to {_MOST[name]:g}"
    return ""


def add_rotors(spec: mujoco.MjSpec) -> list[str]:
    """Add the inertias of the actuators' rotors, reflected by their gears, to their joints' armatures. Returns notes."""
    notes = []
    for actuator in spec.actuators:
        joint = spec.joint(actuator.target) if actuator.trntype in ON_JOINTS else None
        if joint is not None and joint.type in SCALAR_JOINTS and actuator.armature:
            old, joint.armature = joint.armature, joint.armature + actuator.armature * actuator.gear[0] ** 2
            notes.append(f"{joint.name} armature: {old:g} -> {joint.armature:g} kg m^2, with its actuator's")
    return notes


def check_model(model: Any) -> None:
    """Raise ValueError for a compiled model with numbers that are not finite or too large."""
    gravity = model.opt.gravity
    if not np.linalg.norm(gravity) <= FASTEST:
        raise ValueError(f"gravity is {' '.join(f'{g:g}' for g in gravity)} m/s^2; it must be {FASTEST:g} at most")
    if not 0.0 < model.opt.timestep <= 1.0:
        raise ValueError(f"timestep is {model.opt.timestep:g} s; it must be above 0 and 1 at most")
    for kind, what in (
        ("body", "mass"),
        *((kind, what) for kind in ("body", "geom", "dof", "jnt", "site") for what in _SIZES),
    ):
        values = getattr(model, f"{kind}_{what}", None)
        most = HEAVIEST if what == "mass" else WIDEST
        if values is not None and (wrong := np.argwhere(~(np.abs(values) <= most))).size:
            value, index = values[tuple(wrong[0])], int(wrong[0][0])
            owner = (
                f"joint '{model.joint(model.dof_jntid[index]).name}'" if kind == "dof" else _name(model, kind, index)
            )
            raise ValueError(f"{what} of {owner} is {value:g}; it must be {most:g} at most")
    for kind in ("jnt", "actuator", "tendon"):
        for name in ("range", "ctrlrange", "forcerange", "actrange", "actfrcrange"):
            ranges: Any = getattr(model, f"{kind}_{name}", ())
            for index, (low, high) in enumerate(ranges):
                if not low <= high:
                    raise ValueError(f"{name} of {_name(model, kind, index)} is from {low:g} to {high:g}")
    for name in (
        "qpos0",
        "key_qpos",
        "key_qvel",
        "key_ctrl",
        "actuator_gainprm",
        "actuator_biasprm",
        "actuator_gear",
        "geom_friction",
    ):
        if not np.isfinite(getattr(model, name)).all():
            raise ValueError(f"{name} has values that are not finite")


def _name(model: Any, kind: str, index: int) -> str:
    word = {"jnt": "joint"}.get(kind, kind)
    return f"{word} '{getattr(model, word)(index).name}'"
