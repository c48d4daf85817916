"""legged_gym's form - class configs, rewards by name, one readable environment - on MuJoCo-Warp, PyTorch and rsl-rl."""

import ctypes
import os
import sys
from pathlib import Path

_HERE = Path(__file__).resolve().parent
# What holds configs/ and resources/: the clone, or the installed package, which has them inside.
ROOT = _HERE if (_HERE / "configs").is_dir() else _HERE.parent

# rsl-rl imports GitPython, which fails on a machine without git
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")


def _choose_offscreen_renderer() -> None:
    """Without a screen MuJoCo draws through EGL or OSMesa if MUJOCO_GL names it, but fails at import if the library is missing."""
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY") or "MUJOCO_GL" in os.environ:
        return
    for name, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8")):
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        os.environ["MUJOCO_GL"] = name
        return


_choose_offscreen_renderer()
