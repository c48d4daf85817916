"""The cores and the memory that this process may use, and the OpenGL library of MuJoCo.

MuJoCo reads MUJOCO_GL when it is imported, so the library is chosen before the import.
"""

from __future__ import annotations

import ctypes
import gc
import math
import os
import re
import sys
from pathlib import Path

from legged_mw.utils.errors import UserError

# name -> library, Debian package
_WITHOUT_SCREEN = {"egl": ("libEGL.so.1", "libegl1"), "osmesa": ("libOSMesa.so.8", "libosmesa6")}
_ON_SCREEN = ("", "enable", "enabled", "on", "true", "1", "glfw", "glx", "cgl", "wgl")
_OFF = ("disable", "disabled", "off", "false", "0")


def usable_cores() -> int:
    """Number of cores that this process may use, divided by the number of torchrun's processes on this machine."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def settle() -> None:
    """Turn on garbage collection after the start. It ignores all objects that exist now, which saves time."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def free_memory(device: str = "cpu") -> float:
    """Free memory of ``device`` [byte]; infinite if unknown."""
    if device != "cpu":
        import torch  # here, because legged_mw.deploy runs without it

        return float(torch.cuda.mem_get_info(device)[0])
    lines = _read("/proc/meminfo").splitlines()
    free = [1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    limit, used = (_read(f"/sys/fs/cgroup/memory.{name}") for name in ("max", "current"))  # the container's
    # file cache of the container, which the system frees on demand
    cached = re.search(r"^inactive_file (\d+)$", _read("/sys/fs/cgroup/memory.stat"), re.MULTILINE)
    if limit.isdigit() and used.isdigit():
        free.append(float(limit) - float(used) + float(cached[1] if cached else 0))
    return min(free, default=math.inf)


def require_memory(need: float, device: str, what: str, instead: str) -> None:
    """Raise UserError if ``what`` needs more than the free memory. ``need`` [byte]; ``instead``: the advice."""
    free = free_memory(device)
    if need > free:
        where = "this machine" if device == "cpu" else device
        lacks = f"{what} needs {in_bytes(need)} of memory at least, and {where} has {in_bytes(free)} free"
        raise UserError(f"{lacks}: {instead}")


def in_bytes(count: float) -> str:
    """A number of bytes as text, such as 19.6 GB."""
    power = min(int(math.log10(max(count, 1.0))) // 3, 8)
    return f"{count / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB', 'TB', 'PB', 'EB', 'ZB', 'YB')[power]}"


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def has_display() -> bool:
    """Whether a window can open. Linux needs an X or Wayland display; other systems always have one."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def gl_fault(name: str) -> str:
    """Why MuJoCo cannot be imported with this value of MUJOCO_GL, and the remedy; "" if it can."""
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
    """Set MUJOCO_GL so that MuJoCo can draw without a screen. Returns a warning if the user's value does not work.

    With a wrong value the import of MuJoCo fails, also in a training.
    """
    if sys.platform != "linux":
        return ""
    given = os.environ.get("MUJOCO_GL")
    fault = gl_fault(given) if given else ""
    if not fault and (given is not None or has_display()):
        return ""
    works = next((name for name in _WITHOUT_SCREEN if name != given and not gl_fault(name)), None)
    if works:
        os.environ["MUJOCO_GL"] = works
    elif fault:
        os.environ["MUJOCO_GL"] = "glfw" if has_display() else "disable"
    if not fault:
        return ""
    return f"MUJOCO_GL={given} does not work here: {fault}; going on with MUJOCO_GL={os.environ['MUJOCO_GL']}"
