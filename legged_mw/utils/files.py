"""Checks of files and folders: named in a config, written for a flag, or made by a stranger."""

from __future__ import annotations

import errno
import hashlib
import os
import stat
import sys
import tempfile
import zipfile
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

from legged_mw import ROOT
from legged_mw.utils.errors import UserError, shown

STAGED = ".export.new"  # folder in an export with the files of a newer export, before they are moved
MOST_LETTERS = 100  # [bytes] of a folder name: systems allow 255, and a time and a number are added
MOST_UNPACKED = 1 << 30  # [bytes] of all arrays in an .npz, enough for hours of motion
_FILES: WeakKeyDictionary[type, Path] = WeakKeyDictionary()  # class -> its Python file


def note_file(cls: type) -> type:
    """Store the file of ``cls`` and return ``cls``. Later another module may have the same name."""
    if file := getattr(sys.modules.get(cls.__module__), "__file__", None):
        _FILES.setdefault(cls, Path(file).resolve())
    return cls


def find_file(cfg: Any, path: str, one: str = "") -> Path:
    """The file named by the config field ``path`` ("asset.file"), or ``one`` of those that it lists. Raises UserError.

    A relative name in a class body is searched in the folder of that class's file. A name from a flag or a run is
    searched in the current folder, the task's folder, and the folders of the classes that the task extends. The
    repository is searched last.
    """
    section, _, name = path.rpartition(".")
    owner = getattr(cfg, section)
    written = Path(one or getattr(owner, name)).expanduser()
    author = next(cls for cls in type(owner).__mro__ if name in vars(cls))
    folders, classes = list[Path](), [author]
    if getattr(owner, name) != getattr(author, name):
        folders = [Path.cwd(), Path(getattr(cfg, "_folder", ""))]
        classes = [*type(owner).__mro__, *type(cfg).__mro__]
    folders += [_FILES[cls].parent for cls in classes if cls in _FILES]
    places = list(dict.fromkeys(folder for folder in (*folders, ROOT) if folder.is_absolute()))
    for file in (place / written for place in places):  # an absolute path does not change
        if file.is_file():
            return file
    if written.is_absolute():
        why = "an absolute path is valid on one machine only: name the file relative to the task's"
        raise UserError(f"{path}: no file at {written}; {why}")
    raise UserError(f"{path}: no file '{written}' in {', '.join(map(str, places))}")


def writable(name: str, flag: str, folder: bool = False, suffix: str = "") -> Path:
    """The file or folder that ``flag`` wants written. Raises UserError, before any work, if that is not possible.

    ``suffix``: the only one that the file may have. Folders on the way need not exist. The check leaves nothing behind.
    """
    path = Path(name)
    kind, other = ("folder", "file") if folder else ("file", "folder")
    if not name.strip():
        raise UserError(f"{flag} is empty: name the {kind} to write")
    try:
        with suppress(FileNotFoundError, NotADirectoryError):
            path.lstat()  # raises for a name that no file can have
        if path.exists() and path.is_dir() != folder:
            raise UserError(f"{flag} {name}: that is a {other}; name a {kind}")
        if suffix and path.suffix.lower() != suffix:
            raise UserError(f"{flag} {name}: this writes a {suffix}; end the name in {suffix}")
        there = next(place for place in (path.absolute(), *path.absolute().parents) if place.exists())
        if there.is_file() and there != path.absolute():
            raise UserError(f"{flag} {name}: {there} is a file, not a folder")
        with tempfile.TemporaryFile(dir=there if there.is_dir() else there.parent):
            pass
        if there.is_file() and not os.access(there, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except (OSError, ValueError) as error:  # a name too long, or with a null character
        why = getattr(error, "strerror", None) or error
        raise UserError(f"{flag} {name[:200]}: cannot be written: {why}") from None
    return path


def check_name(name: str, where: str) -> str:
    """``name``, if it is a valid name of a folder on all systems and not a path. Raises UserError."""
    if why := wrong_name(name):
        wrong = f"{where}: {name[:60]!r} cannot be the name of a folder below logs: {why}"
        raise UserError(f"{wrong}; write a plain name, e.g. go1_fast")
    return name


def wrong_name(name: str) -> str:
    """Why this name is not valid for a folder, or ''."""
    if (size := len(name.encode(errors="replace"))) > MOST_LETTERS:
        return f"it has {size} bytes, more than {MOST_LETTERS}"
    if name.startswith(("-", "~")) or (name and not name.strip(". ")):
        return "it begins with - or ~, or is made of dots"
    return next((f"{each!r} is in it" for each in name if each in '/\\:*?"<>|' or not each.isprintable()), "")


def typed(path: str) -> Path:
    """A path that a user typed, with ~ replaced; it need not exist. Raises UserError for an invalid path."""
    try:
        found = Path(path).expanduser()
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            found.stat()
    # too long or a link to itself; a null character; an unknown ~user
    except (OSError, ValueError, RuntimeError) as error:
        why = getattr(error, "strerror", None) or error
        raise UserError(f"'{path[:200]}' is no path here: {why}") from None
    return found


def check_folder(folder: Path) -> Path:
    """Raise UserError if a run or an export has anything but files, folders and links inside of it.

    It may come from a stranger. With a link to the outside, other files could be read or overwritten. Reading a pipe
    would never end.
    """
    home = folder.resolve()
    for place, folders, files in os.walk(home):
        for path in (Path(place, name) for name in (*folders, *files)):
            kind, why = path.lstat().st_mode, ""
            if stat.S_ISLNK(kind) and not Path(os.path.realpath(path)).is_relative_to(home):
                why = f"a link that leads out of it, to {os.readlink(path)}"
            elif not stat.S_ISLNK(kind) and not stat.S_ISREG(kind) and not stat.S_ISDIR(kind):
                why = "a pipe, a socket or a device"
            if why:
                wrong = f"{shown(folder)}: {path.relative_to(home)} is {why}"
                raise UserError(f"{wrong}: delete it; a run or an export has only files")
    return folder


def finish_moving(folder: Path) -> None:
    """Finish an interrupted export: move its staged files into ``folder``. An empty staged file deletes its target.

    Several programs may call this at the same time. Raises UserError if the folder cannot be written.
    """
    staged = folder / STAGED
    try:
        if not staged.is_dir() or staged.is_symlink():
            return
        for file in sorted(staged.iterdir(), key=lambda file: (file.suffix == ".yaml", file.name)):
            with suppress(FileNotFoundError):  # another program has moved it
                if file.stat().st_size:
                    os.replace(file, folder / file.name)
                else:
                    (folder / file.name).unlink(missing_ok=True)
                    file.unlink()
        with suppress(FileNotFoundError):
            staged.rmdir()
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"{folder}: a newer export is on its way into it and cannot be finished: {why}") from None


def read_arrays(file: Path) -> dict[str, Any]:
    """The arrays in the .npz ``file``, without running code from it. Raises ValueError if it is missing or damaged."""
    import numpy as np  # here, so that programs start without it

    try:
        with zipfile.ZipFile(file) if zipfile.is_zipfile(file) else nullcontext() as parts:
            if parts and (size := sum(part.file_size for part in parts.infolist())) > MOST_UNPACKED:
                raise ValueError(f"it unpacks to {size >> 20} MiB; {MOST_UNPACKED >> 20} are the most")
        with np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except TypeError:
        raise ValueError("it is one array, no archive of them") from None
    except Exception as error:  # numpy's, zipfile's or zlib's
        raise ValueError(" ".join(str(getattr(error, "strerror", None) or error).split())[:200]) from None


def digest(file: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def file_of(cls: type) -> Path | None:
    """The Python file of the config class ``cls``, or None if unknown."""
    return _FILES.get(cls)
