"""The errors that are the user's to mend: one class, so that a program can print them as one line and exit."""

from __future__ import annotations

import difflib
import inspect
import re
import sysconfig
import traceback
import unicodedata
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import CodeType
from typing import Any

from legged_mw.utils.renamed import LEGGED_GYM_TENSORS, MOVED

_LIBRARIES = {"torch", "numpy", "warp", "mujoco", "mujoco_warp", "tensordict", "rsl_rl", "legged_mw.check"}
# A terminal obeys these, and no file can hold the last.
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_STANDARD = sysconfig.get_paths()["stdlib"]


class UserError(Exception):
    """A mistake in what was asked, or something that the machine lacks; the text says what exists and what to do."""


class ConfigError(UserError, TypeError):
    """A field or file of a config: which one, where that was written, what exists, what to write."""


class ModelError(UserError, ValueError):
    """A name or number asked of a robot's model that does not fit its file; the message lists what exists."""

    wrong: tuple[tuple[str, str], ...] = ()  # parameters of the called function, and what is wrong with each

    @classmethod
    def of(cls, *wrong: tuple[str, str]) -> ModelError:
        """The error about parameters: ``parameter: what is wrong``, one after the other."""
        error = cls("; ".join(f"{parameter}: {what}" for parameter, what in wrong))
        error.wrong = wrong
        return error

    def renamed(self, names: Mapping[str, str]) -> ModelError:
        """The same error with the names that a caller has for the parameters."""
        if not self.wrong:
            return self
        return type(self).of(*((names.get(parameter, parameter), what) for parameter, what in self.wrong))


class EngineError(UserError, ValueError):
    """An engine that does not exist, or cannot step where it was asked to."""


class StepError(UserError):
    """A task's step goes wrong in the user's code: ``what`` is wrong and what to write instead, and ``where`` it stands."""

    def __init__(self, what: str, where: str = "") -> None:
        self.what, self.where = what, where
        super().__init__(" ".join(f"{where}: {what}".split()) if where else what)


class NotRecordable(StepError):
    """The step does what a CUDA graph cannot record."""


def out_of_memory(error: BaseException) -> bool:
    """Whether an error of torch, CUDA or warp says that memory ran out."""
    text = r"out of memory|failed to allocate|alloc_failed|can't allocate memory"
    return isinstance(error, MemoryError) or bool(re.search(text, str(error), re.IGNORECASE))


def line_of(code: CodeType, line: int) -> str:
    """``file:line, Class.method``, the file as the user would type it."""
    path = Path(code.co_filename)
    shown = path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path
    return f"{shown}:{line}, {code.co_qualname.rpartition('<locals>.')[2]}"


def place_of(method: Any) -> str:
    """Where a method is written."""
    method = getattr(method, "func", method)  # of a partial
    function = inspect.unwrap(getattr(method, "__func__", method))
    return line_of(function.__code__, function.__code__.co_firstlineno)


def is_library(module: str, file: str) -> bool:
    """Whether code is neither the user's nor legged_mw's, or is the guard that watches both."""
    parts = module.split(".")
    known = any(".".join(parts[:n]) in _LIBRARIES for n in range(1, len(parts) + 1))
    return known or file.startswith("<") or (file.startswith(_STANDARD) and "-packages" not in file)


def line_to_blame(error: BaseException) -> tuple[str, bool]:
    """The innermost line of the user's code that led to ``error``, and True; without one, of legged_mw's code, and False.

    It must be below the function that caught the error; where there is none, it is "".
    """
    every = [
        (frame.f_code, line, frame.f_globals.get("__name__", ""))
        for frame, line in traceback.walk_tb(error.__traceback__)
    ]
    ours = [entry for entry in every if not is_library(entry[2], entry[0].co_filename)]
    users = [entry for entry in ours if not entry[2].startswith("legged_mw.")]
    for code, line, _ in reversed(users or ours):
        return line_of(code, line), bool(users)
    return "", False


def users_fault(error: BaseException) -> str:
    """Where an error comes from in the user's code that legged_mw called: the line, then those that led to it; "" if from none of it."""
    lines, called = list[str](), False
    for frame, line in traceback.walk_tb(error.__traceback__):
        module, file = frame.f_globals.get("__name__", ""), frame.f_code.co_filename
        # which catches the error, around all others
        ours = module.startswith("legged_mw.") and module != "legged_mw.utils.cli"
        if called and not ours and not is_library(module, file):
            lines.append(line_of(frame.f_code, line).removesuffix(", <module>"))
        called = called or ours
    return ", called from ".join(reversed(lines[-5:]))


def in_short(error: BaseException) -> str:
    """An error in one line: its type and what it says, without end; of a name that does not exist what does."""
    text = " ".join(f"{error}".split())
    return f"{type(error).__name__}: {text[:400]}{_instead(error)}" if text else type(error).__name__


def _instead(error: BaseException) -> str:
    """Where an import of ours is now, what stands for an attribute of legged_gym's here, or the nearest name; ''."""
    if isinstance(error, ImportError):
        return next((f"; it is in {place} now" for name, place in MOVED.items() if f"'{name}'" in str(error)), "")
    if not isinstance(error, AttributeError) or not error.name or error.obj is None:
        return ""
    if hasattr(type(error.obj), "observation_rows") and (here := LEGGED_GYM_TENSORS.get(error.name)):
        return f"; here that is {here} (docs/from_legged_gym.md)"
    close = difflib.get_close_matches(error.name, dir(error.obj), n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def brief(value: object, most: int = 200) -> str:
    """A value for a message: what would fill the screen is cut, what cannot be written is described."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # Python writes no whole number of more than 4300 digits
        return f"an {type(value).__name__} too large to show"
    return text if len(text) <= most else f"{text[:most]}..."


def printable(text: str) -> str:
    """``text`` with what a terminal would obey, not print, written as \\x1b: names come from files, folders and the net."""
    return "".join(
        each if each.isprintable() or each == "\n" or unicodedata.category(each) == "Zs" else ascii(each)[1:-1]
        for each in text
    )


def shown(path: Path) -> str:
    """A path for a message: as the user would type it."""
    try:
        return printable(str(path.resolve().relative_to(Path.cwd())))
    except (ValueError, OSError, RuntimeError):  # not below it; or a link to itself
        return printable(str(path))


def unknown(what: str, name: str, known: Iterable[str], where: str) -> str:
    """One line: ``name`` does not exist, the nearest name that does, and all that do."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"no {what} '{name}' in {where}; {hint}there are: {', '.join(known) or 'none'}"
