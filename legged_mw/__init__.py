"""legged_gym's form - class configs, rewards by name, one readable environment - on MuJoCo-Warp, PyTorch and rsl-rl."""

import os
import sys
from pathlib import Path

from legged_mw.utils.machine import choose_renderer

_HERE = Path(__file__).resolve().parent
# What holds configs/ and resources/: the clone, or the installed package, which has them inside.
ROOT = _HERE if (_HERE / "configs").is_dir() else _HERE.parent

# rsl-rl imports GitPython, which fails on a machine without git
os.environ.setdefault("GIT_PYTHON_REFRESH", "quiet")

if _line := choose_renderer():
    print(f"legged_mw: {_line}", file=sys.stderr)
