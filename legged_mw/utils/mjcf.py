"""What an MJCF or URDF may hold, looked at before MuJoCo builds something of it, and once more in what it has built.

All that is refused is a ValueError in one line, without the file's name.
"""

from __future__ import annotations

import io
import math
import re
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

ARCHIVE = ".mjz"  # MuJoCo's name for a zipped model
_INSIDE = "model.xml"
MOST_BYTES = 64 << 20  # of one file: the largest known robots, meshes inside, have a tenth
HEAVIEST, WIDEST, FASTEST = 1e5, 1e6, 1e3  # of a body [kg]; of any length [m] or inertia [kg m^2]; gravity [m/s^2]: a file in cm has 981
_COPIES = 1e5  # of what a file repeats, all its counts multiplied
_MOST = {"count": 1e4, "nrow": 2e4, "ncol": 2e4, "width": 16384, "height": 16384, "nkey": 1e4}  # attribute -> the most that makes sense
_MOST |= {f"nuser_{kind}": 1e3 for kind in ("body", "jnt", "geom", "site", "cam", "tendon", "actuator", "sensor")} | {"nuserdata": 1e6}
_MOST |= {"mass": HEAVIEST, "density": 1e6, "armature": WIDEST, "frictionloss": WIDEST, "diaginertia": WIDEST}
_SIZES = ("mass", "inertia", "pos", "ipos", "size", "armature", "damping", "frictionloss", "stiffness")  # of the model's arrays
_NAMES = ("name", "class", "childclass", "model", "file", "dir", "meshdir", "texturedir", "assetdir")
_ATTRIBUTE = re.compile(r"""([\w.:]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")
_TAG = re.compile(r"""<(include|model)\b((?:[^>"']|"[^"]*"|'[^']*')*)>""")


def check_files(file: Path, alone: bool = False) -> str:
    """The text of ``file``, once it and what it includes hold no bomb, no NaN and no range that ends before it begins.

    ``alone``: it names no file outside of its own folder, meshes and textures too; a vendor's meshes may lie beside that folder.
    """
    folder, left, seen, first = file.resolve().parent, [file], set[Path](), ""
    while left:
        part = left.pop()
        text = _text(part)
        first, seen = first or text, seen | {part.resolve()}
        text = _checked(text, "" if part == file else f"{part.name}: ")
        if file.suffix == ARCHIVE and (named := list(_named(text))):
            raise ValueError(f"it names {named[0][:200]}; the model of an archive stands alone")
        if alone and (far := [name for name in _named(text) if not (folder / name).resolve().is_relative_to(folder)]):
            raise ValueError(f"it names {far[0][:200]}, which lies outside of its own folder; an export stands alone")
        for name in _included(text):
            path = (folder / name).resolve()
            if not path.is_relative_to(folder):
                raise ValueError(f"it includes {name}, which lies outside of its own folder; put that file beside it")
            if path.is_file() and path not in seen:
                left.append(path)
    return first


def write_archive(file: Path, text: str) -> None:
    """Write an MJCF as MuJoCo's MJZ, a zip file that holds it as model.xml. The same text makes the same file."""
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(_INSIDE), text, zipfile.ZIP_DEFLATED, compresslevel=9)


def _text(file: Path) -> str:
    """What an MJCF or URDF says, or the one in an MJZ. Raises ValueError for too large a file, and for an MJZ with more in it."""
    _check_size(file.name, file.stat().st_size)
    if file.suffix != ARCHIVE:
        return file.read_text(encoding="utf-8", errors="replace")
    held = io.BytesIO(file.read_bytes())
    try:
        with zipfile.ZipFile(held) as archive:
            inside = archive.infolist()
            known = [(entry.filename, entry.compress_type) for entry in inside] == [(_INSIDE, zipfile.ZIP_DEFLATED)]
            if known and inside[0].file_size <= MOST_BYTES:
                return archive.read(_INSIDE).decode(errors="replace")
    except (zipfile.BadZipFile, zlib.error, EOFError, ValueError, RuntimeError) as error:
        raise ValueError(f"no zip file that can be read: {error}") from None  # RuntimeError: it is encrypted
    names = ", ".join(entry.filename for entry in inside)[:200] or "nothing"
    raise ValueError(f"it holds {names}; an export's holds {_INSIDE} alone, deflated and of {MOST_BYTES >> 20} MiB at most")


def _check_size(name: str, size: int) -> None:
    if size > MOST_BYTES:
        raise ValueError(f"{name} has {size >> 20} MiB; a robot's file has {MOST_BYTES >> 20} at most")


def _checked(text: str, where: str) -> str:
    """``text`` with its comments blank. Raises ValueError with the line for what no robot needs and a reader may choke on."""
    if "<!ENTITY" in text:
        raise ValueError(f"{where}line {_line(text, text.index('<!ENTITY'))}: it defines entities; write out what they stand for")
    text = re.sub(r"<!--.*?-->", lambda match: re.sub(r"[^\n]", " ", match[0]), text, flags=re.DOTALL)
    copies = 1.0
    for match in _ATTRIBUTE.finditer(text):
        name, value = match[1], match[2] if match[2] is not None else match[3]
        wrong = "" if name in _NAMES else _wrong(name, value)
        if name == "count" and not wrong:
            copies *= math.prod(float(part) or 1.0 for part in value.split() if part.isdecimal())
            wrong = f"makes more than {_COPIES:g} copies, with the others" if copies > _COPIES else ""
        if wrong:
            raise ValueError(f'{where}line {_line(text, match.start())}: {name}="{value[:60]}" {wrong}')
    return text


def _wrong(name: str, value: str) -> str:
    """What is wrong with the numbers of an attribute; "" if nothing is, or if they are none."""
    if "nan" in value.lower() and any(part.lower().strip("+-") == "nan" for part in value.split()):
        return "is not a number"
    if name.endswith("range") or name in _MOST:
        try:
            numbers = [float(part) for part in value.split()]
        except ValueError:
            return ""
        if name in _MOST and not all(0.0 <= number <= _MOST[name] for number in numbers):
            return f"must be from 0 to {_MOST[name]:g}"
        if len(numbers) == 2 and name.endswith("range") and numbers[0] > numbers[1]:
            return "ends before it begins"
    return ""


def _line(text: str, place: int) -> int:
    return text.count("\n", 0, place) + 1


def _included(text: str) -> Iterator[str]:
    """Names of other MJCF files that the text takes in."""
    for tag in _TAG.finditer(text):
        yield from (match[2] or match[3] or "" for match in _ATTRIBUTE.finditer(tag[2]) if match[1] == "file")


def _named(text: str) -> Iterator[str]:
    """Files and folders that the text names, whatever for."""
    for match in _ATTRIBUTE.finditer(text):
        if match[1].startswith("file") or match[1] in ("meshdir", "texturedir", "assetdir"):
            yield match[2] or match[3] or ""


def check_model(model: Any) -> None:
    """Raises ValueError for a compiled model that no world can step: numbers that are none, or that no machine has."""
    gravity = model.opt.gravity
    if not np.linalg.norm(gravity) <= FASTEST:
        raise ValueError(f"gravity is {' '.join(f'{g:g}' for g in gravity)} m/s^2; it must be {FASTEST:g} at most")
    if not 0.0 < model.opt.timestep <= 1.0:
        raise ValueError(f"timestep is {model.opt.timestep:g} s; it must be above 0 and 1 at most")
    for kind, what in (("body", "mass"), *((kind, what) for kind in ("body", "geom", "dof", "jnt", "site") for what in _SIZES)):
        values = getattr(model, f"{kind}_{what}", None)
        most = HEAVIEST if what == "mass" else WIDEST
        if values is not None and (wrong := np.argwhere(~(np.abs(values) <= most))).size:
            value, index = values[tuple(wrong[0])], int(wrong[0][0])
            whose = f"joint '{model.joint(model.dof_jntid[index]).name}'" if kind == "dof" else _name(model, kind, index)
            raise ValueError(f"{what} of {whose} is {value:g}; it must be {most:g} at most")
    for kind in ("jnt", "actuator", "tendon"):
        for name in ("range", "ctrlrange", "forcerange", "actrange", "actfrcrange"):
            ranges: Any = getattr(model, f"{kind}_{name}", ())
            for index, (low, high) in enumerate(ranges):
                if not low <= high:
                    raise ValueError(f"{name} of {_name(model, kind, index)} is from {low:g} to {high:g}")
    for name in ("qpos0", "key_qpos", "key_qvel", "key_ctrl", "actuator_gainprm", "actuator_biasprm", "actuator_gear", "geom_friction"):
        if not np.isfinite(getattr(model, name)).all():
            raise ValueError(f"{name} has values that are not finite")


def _name(model: Any, kind: str, index: int) -> str:
    word = {"jnt": "joint"}.get(kind, kind)
    return f"{word} '{getattr(model, word)(index).name}'"
