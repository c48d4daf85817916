"""legged_gym's form - class configs, rewards by name, one readable environment - on MuJoCo-Warp, PyTorch and rsl-rl."""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent

# rsl-rl imports GitPython, which fails on a machine without git; MuJoCo draws without a screen only if told how.
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")
if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
    os.environ.setdefault("MUJOCO_GL", "egl")
