"""Errors that the user can correct, which programs print as one line, and helpers for their text."""

from __future__ import annotations

import difflib
import inspect
import re
import sysconfig
import traceback
import unicodedata
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import CodeType
from typing import Any

LIBRARIES = {"torch", "numpy", "warp", "mujoco", "mujoco_warp", "tensordict", "rsl_rl", "legged_mw.check"}
# Control characters of a terminal, and surrogates, which no file can hold.
CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f\ud800-\udfff]")
_STANDARD = sysconfig.get_paths()["stdlib"]


class UserError(Exception):
    """A wrong request, or something missing on the machine. The text says what exists and what to do."""


class ConfigError(UserError, TypeError):
    """A wrong field or file of a config. The text says which and where, what exists and what to write."""


class ModelError(UserError, ValueError):
    """A name or number that does not fit the robot's file. The text lists what exists."""

    wrong: tuple[tuple[str, str], ...] = ()  # (parameter of the called function, fault)

    @classmethod
    def of(cls, *wrong: tuple[str, str]) -> ModelError:
        """An error with the text ``parameter: fault; parameter: fault``, from (parameter, fault) pairs."""
        error = cls("; ".join(f"{parameter}: {what}" for parameter, what in wrong))
        error.wrong = wrong
        return error

    def renamed(self, names: Mapping[str, str]) -> ModelError:
        """The same error with the caller's names for the parameters."""
        if not self.wrong:
            return self
        return type(self).of(*((names.get(parameter, parameter), what) for parameter, what in self.wrong))


class StepError(UserError):
    """A mistake in the user's code of a task. ``what``: the fault and the remedy; ``where``: file and line."""

    def __init__(self, what: str, where: str = "") -> None:
        self.what, self.where = what, where
        super().__init__(" ".join(f"{where}: {what}".split()) if where else what)


class NotRecordable(StepError):
    """The step has an operation that a CUDA graph cannot record."""


def out_of_memory(error: BaseException) -> bool:
    """Whether an error of torch, CUDA or warp is due to too little memory."""
    text = r"out of memory|failed to allocate|alloc_failed|can't allocate memory"
    return isinstance(error, MemoryError) or bool(re.search(text, str(error), re.IGNORECASE))


def line_of(code: CodeType, line: int) -> str:
    """``file:line, Class.method``, with the file as in ``shown``."""
    return f"{shown(Path(code.co_filename))}:{line}, {code.co_qualname.rpartition('<locals>.')[2]}"


def place_of(method: Any) -> str:
    """File, line and name of a method, as in ``line_of``."""
    method = getattr(method, "func", method)  # if it is a partial
    function = inspect.unwrap(getattr(method, "__func__", method))
    return line_of(function.__code__, function.__code__.co_firstlineno)


@cache
def is_library(module: str, file: str) -> bool:
    """Whether code belongs to a library or to legged_mw.check, and not to the user's or our own code."""
    parts = module.split(".")
    known = any(".".join(parts[:n]) in LIBRARIES for n in range(1, len(parts) + 1))
    return known or file.startswith("<") or (file.startswith(_STANDARD) and "-packages" not in file)


def line_to_blame(error: BaseException) -> tuple[str, bool]:
    """(innermost line of the user's code that led to ``error``, True); without one (line of our code or "", False).

    Only lines below the function that caught the error count.
    """
    users, ours = list[str](), list[str]()
    for frame, line in traceback.walk_tb(error.__traceback__):
        module = frame.f_globals.get("__name__", "")
        if not is_library(module, frame.f_code.co_filename):
            (ours if module.startswith("legged_mw.") else users).append(line_of(frame.f_code, line))
    return (users or ours or [""])[-1], bool(users)


def users_fault(error: BaseException) -> str:
    """The lines of the user's code, called by legged_mw, that led to ``error``, innermost first; or ""."""
    lines, called = list[str](), False
    for frame, line in traceback.walk_tb(error.__traceback__):
        module, file = frame.f_globals.get("__name__", ""), frame.f_code.co_filename
        ours = module.startswith("legged_mw.") and module != "legged_mw.utils.cli"  # cli only catches the error
        if called and not ours and not is_library(module, file):
            lines.append(line_of(frame.f_code, line).removesuffix(", <module>"))
        called = called or ours
    return ", called from ".join(reversed(lines[-5:]))


def in_short(error: BaseException) -> str:
    """An error in one line: its type, its text, cut to 400 characters, and for a wrong name the right name."""
    text = " ".join(f"{error}".split())
    return f"{type(error).__name__}: {text[:400]}{_instead(error)}" if text else type(error).__name__


# Old module, or class, in a task or the config of an old run -> its module now.
MOVED: dict[str, str] = {
    "legged_mw.rl.distillation": "legged_mw.rl.students.distillation",
    "RobotTaskCfgPPO": "legged_mw.rl.learner_config",
    "LeggedRobotCfgPPO": "legged_mw.rl.learner_config",
    "legged_mw.envs.sim_to_real_config": "configs.base",
    "legged_mw.envs.getup": "legged_mw.skills.getup",
    "legged_mw.envs.handstand": "legged_mw.skills.handstand",
    "legged_mw.envs.motion_tracking": "legged_mw.skills.motion_tracking",
    "legged_mw.envs.motion_tracking_config": "legged_mw.skills.motion_tracking_config",
    "legged_mw.envs.skill_config": "legged_mw.skills.skill_config",
}

# Tensor of legged_gym -> its name here (docs/from_legged_gym.md).
LEGGED_GYM_TENSORS: dict[str, str] = {
    "root_states": "root_pos, root_quat (w, x, y, z), root_lin_vel, base_ang_vel",
    "base_quat": "root_quat (w, x, y, z)",
    "measured_heights": "height_scan",
    "rigid_body_states": "foot_pos, foot_height, foot_vel",
    **dict.fromkeys(("foot_force", "foot_forces"), "contact_forces"),
    "feet_indices": "foot_contact, contact_forces, foot_vel: of the feet alone",
    "dof_pos_limits": "soft_lower, soft_upper",
    "torque_limits": "robot.effort_range",
    "last_contacts": "first_contact",
    "extras": "take_statistics()",
}


def _instead(error: BaseException) -> str:
    """For a moved import the new module, for an attribute of legged_gym the name here, else the nearest name; or ''."""
    if isinstance(error, ImportError):
        return next((f"; it is in {place} now" for name, place in MOVED.items() if f"'{name}'" in str(error)), "")
    if not isinstance(error, AttributeError) or not error.name or error.obj is None:
        return ""
    if hasattr(type(error.obj), "observation_rows") and (here := LEGGED_GYM_TENSORS.get(error.name)):
        return f"; here that is {here} (docs/from_legged_gym.md)"
    close = difflib.get_close_matches(error.name, dir(error.obj), n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def brief(value: object, most: int = 200) -> str:
    """``value`` as text for a message, cut to ``most`` characters."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):  # Python does not print integers with more than 4300 digits
        return f"an {type(value).__name__} too large to show"
    return text if len(text) <= most else f"{text[:most]}..."


def printable(text: str) -> str:
    """``text`` with control characters as \\x1b: names from files and the network must not control a terminal."""
    return "".join(
        each if each.isprintable() or each == "\n" or unicodedata.category(each) == "Zs" else ascii(each)[1:-1]
        for each in text
    )


def shown(path: Path) -> str:
    """A path as text for a message, relative to the current folder if it is inside."""
    try:
        return printable(str(path.resolve().relative_to(Path.cwd())))
    except (ValueError, OSError, RuntimeError):  # outside of the current folder, or a link to itself
        return printable(str(path))


def unknown(what: str, name: str, known: Iterable[str], where: str) -> str:
    """Text that ``name`` does not exist, with the nearest name and all names."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"no {what} '{name}' in {where}; {hint}there are: {', '.join(known) or 'none'}"
