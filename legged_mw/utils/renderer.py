"""What MuJoCo may draw through on this machine. It is settled before mujoco is imported, which reads it then."""

from __future__ import annotations

import ctypes
import os
import sys

# name -> library, Debian's package
_WITHOUT_SCREEN = {"egl": ("libEGL.so.1", "libegl1"), "osmesa": ("libOSMesa.so.8", "libosmesa6")}
_ON_SCREEN = ("", "enable", "enabled", "on", "true", "1", "glfw", "glx", "cgl", "wgl")
_OFF = ("disable", "disabled", "off", "false", "0")


def has_display() -> bool:
    """Whether a window could open here. Linux needs an X or Wayland display; other systems have one."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def gl_fault(name: str) -> str:
    """Why MuJoCo cannot be imported with this MUJOCO_GL, and the remedy; "" if it can."""
    name = name.lower().strip()
    if name in _WITHOUT_SCREEN and sys.platform == "linux":
        library, package = _WITHOUT_SCREEN[name]
        try:
            ctypes.CDLL(library)
        except OSError:
            return f"{library} is missing (apt install {package})"
        platform = os.environ.get("PYOPENGL_PLATFORM", name).lower()
        return "" if platform == name else f"PYOPENGL_PLATFORM={platform} contradicts it (unset that)"
    return "" if name in _ON_SCREEN + _OFF else f"there are {', '.join(_WITHOUT_SCREEN)}, glfw and disable"


def choose_renderer() -> str:
    """Let MuJoCo draw without a screen where it can: sets MUJOCO_GL. Returns a line if what the user set does not work.

    MuJoCo fails at its import, in training too, where MUJOCO_GL names what is not there.
    """
    if sys.platform != "linux":
        return ""
    asked = os.environ.get("MUJOCO_GL")
    fault = gl_fault(asked) if asked else ""
    if not fault and (asked is not None or has_display()):
        return ""
    works = next((name for name in _WITHOUT_SCREEN if name != asked and not gl_fault(name)), None)
    if works:
        os.environ["MUJOCO_GL"] = works
    elif fault:
        os.environ["MUJOCO_GL"] = "glfw" if has_display() else "disable"
    return (
        f"MUJOCO_GL={asked} does not work here: {fault}; going on with MUJOCO_GL={os.environ['MUJOCO_GL']}"
        if fault
        else ""
    )
