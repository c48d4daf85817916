"""Files and folders by their names: those that a config names, found by where the name was written, and those of strangers."""

from __future__ import annotations

import errno
import hashlib
import os
import re
import shutil
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

STAGED = ".export.new"  # in an export's folder: the files of a newer one, all of them, on the way to their places
MOST_LETTERS = 100  # of a folder's name, in bytes: systems allow 255, and ours is put before or behind it
MOST_UNPACKED = 1 << 30  # of all arrays in an .npz: hours of a robot's motion
_FILES: WeakKeyDictionary[type, Path] = WeakKeyDictionary()  # class -> the Python file with its body


def note_file(cls: type) -> type:
    """Remember which file ``cls`` is written in; returns it. Called as its statement runs: later its module's name may be another's."""
    if file := getattr(sys.modules.get(cls.__module__), "__file__", None):
        _FILES.setdefault(cls, Path(file).resolve())
    return cls


def find_file(cfg: Any, path: str, one: str = "") -> Path:
    """The file that the config field ``path`` ("asset.file") names, or ``one`` of those that it lists. Raises UserError.

    A relative name that a class body wrote is looked for beside that body's file. One that came later, by a flag or from a
    run, is looked for in the current folder, beside the task and beside the classes that it extends. Last comes the repository.
    """
    section, _, name = path.rpartition(".")
    owner = getattr(cfg, section)
    written = Path(one or getattr(owner, name)).expanduser()
    author = next(cls for cls in type(owner).__mro__ if name in vars(cls))
    folders = [_folder(author)]
    if getattr(owner, name) != getattr(author, name):
        folders = [
            Path.cwd(),
            Path(getattr(cfg, "_folder", "")),
            *map(_folder, [*type(owner).__mro__, *type(cfg).__mro__]),
        ]
    places = list(dict.fromkeys(folder for folder in (*folders, ROOT) if folder and folder.is_absolute()))
    for file in (place / written for place in places):  # an absolute path stays itself
        if file.is_file():
            return file
    if written.is_absolute():
        raise UserError(
            f"{path}: no file at {written}; an absolute path is of one machine: name the file relative to the task's"
        )
    raise UserError(f"{path}: no file '{written}' in {', '.join(map(str, places))}")


def writable(name: str, flag: str, folder: bool = False) -> Path:
    """The file, or folder, that ``flag`` says to write, if it can be: asked before the work. Raises UserError.

    Folders on the way need not be there. A file without a name is tried beside it, which leaves nothing.
    """
    path = Path(name)
    try:
        if not name.strip():
            raise UserError(f"{flag} is empty: name the {'folder' if folder else 'file'} to write")
        with suppress(FileNotFoundError, NotADirectoryError):
            path.lstat()  # raises for a name that no file can have
        if path.exists() and path.is_dir() != folder:
            raise UserError(
                f"{flag} {name}: that is a {'file' if folder else 'folder'}; name a {'folder' if folder else 'file'}"
            )
        there = next(place for place in (path.absolute(), *path.absolute().parents) if place.is_dir())
        if blocks := [place for place in path.absolute().parents if place.exists() and not place.is_dir()]:
            raise UserError(f"{flag} {name}: {blocks[0]} is a file, not a folder")
        with tempfile.TemporaryFile(dir=there):
            pass
        if path.is_file() and not os.access(path, os.W_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    except (OSError, ValueError) as error:  # a name too long, or with a null character
        raise UserError(
            f"{flag} {name[:200]}: cannot be written: {getattr(error, 'strerror', None) or error}"
        ) from None
    return path


def check_name(name: str, where: str) -> str:
    """``name`` if a folder may be called so, in any system and terminal, and it leads nowhere else. Raises UserError."""
    if why := wrong_name(name):
        raise UserError(
            f"{where}: {name[:60]!r} cannot be the name of a folder below logs: {why}; write a plain name, e.g. go1_fast"
        )
    return name


def wrong_name(name: str) -> str:
    """Why no folder may be called so, or ''."""
    why = next((f"{each!r} is in it" for each in name if each in '/\\:*?"<>|' or not each.isprintable()), "")
    if name.startswith(("-", "~")) or (name and not name.strip(". ")):
        why = "it begins with - or ~, or is made of dots"
    if (size := len(name.encode(errors="replace"))) > MOST_LETTERS:
        why = f"it has {size} bytes, more than {MOST_LETTERS}"
    return why


def typed(path: str) -> Path:
    """A path as a user typed it, with ~ replaced; it need not be there. Raises UserError for one that no file can have."""
    try:
        found = Path(path).expanduser()
        with suppress(FileNotFoundError, NotADirectoryError, PermissionError):
            found.stat()
    # too long, a link to itself; a null character; ~ of an unknown user
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(f"'{path[:60]}' is no path here: {getattr(error, 'strerror', None) or error}") from None
    return found


def check_folder(folder: Path) -> Path:
    """A run or an export, which may be a stranger's, if it holds files and folders, and links that stay in it. Raises UserError.

    What a link leads to would be read, or written over, in place of a file; a pipe would be waited for.
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
                raise UserError(
                    f"{shown(folder)}: {path.relative_to(home)} is {why}: delete it; a run or an export holds files alone"
                )
    return folder


def finish_moving(folder: Path) -> None:
    """Move the files of an export that is whole to their places, where a kill came in between; an empty one leaves none there.

    Raises UserError where the folder cannot be written to. Any number of programs may do it at once.
    """
    staged = folder / STAGED
    try:
        if not staged.is_dir() or staged.is_symlink():
            return
        for file in sorted(staged.iterdir(), key=lambda file: (file.suffix == ".yaml", file.name)):
            with suppress(FileNotFoundError):  # somebody else has just moved it
                if file.stat().st_size:
                    os.replace(file, folder / file.name)
                else:
                    (folder / file.name).unlink(missing_ok=True)
                    file.unlink()
        with suppress(FileNotFoundError):
            staged.rmdir()
    except OSError as error:
        raise UserError(
            f"{folder}: a newer export is on its way into it and cannot be finished: {error.strerror or error}"
        ) from None


def flush(path: Path) -> None:
    """Have a file, or a folder's list of files, on the disk itself, where a power cut does not reach it."""
    opened = os.open(path, os.O_RDONLY)
    try:
        os.fsync(opened)
    finally:
        os.close(opened)


def sweep(folder: Path) -> None:
    """Remove what programs that were killed left half written in ``folder``: ``.NAME.PID.tmp`` of a process that is gone."""
    for path in folder.glob(".*.tmp"):
        name = re.fullmatch(r"\.(export|.+\.(?:pt|yaml))\.(\d{1,9})\.tmp", path.name)
        if name and not _lives(int(name[2])):
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() and not path.is_symlink() else path.unlink(
                missing_ok=True
            )


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is another user's
        return True
    return True


def read_arrays(file: Path) -> dict[str, Any]:
    """What the .npz ``file`` holds. Raises ValueError for a file that is missing, damaged or something else. No code runs."""
    import numpy as np  # here alone: the command line shares this file

    try:
        with zipfile.ZipFile(file) if zipfile.is_zipfile(file) else nullcontext() as parts:
            if parts and (size := sum(part.file_size for part in parts.infolist())) > MOST_UNPACKED:
                raise ValueError(f"it unpacks to {size >> 20} MiB; {MOST_UNPACKED >> 20} are the most")
        with np.load(file, allow_pickle=False) as archive:
            return dict(archive)
    except TypeError:
        raise ValueError("it is one array, no archive of them") from None
    except Exception as error:  # numpy's, zipfile's and zlib's, by how it is broken
        raise ValueError(" ".join(str(error).split())[:200]) from None


def digest(file: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(file.read_bytes()).hexdigest()


def file_of(cls: type) -> Path | None:
    """The file with the body of ``cls``, if it is a config's."""
    return _FILES.get(cls)


def _folder(cls: type) -> Path | None:
    return _FILES[cls].parent if cls in _FILES else None
