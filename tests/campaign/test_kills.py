"""Three kills at random moments; a hundred are made by hand (kills.py)."""

from __future__ import annotations

import shlex
import subprocess
import sys
from pathlib import Path


def test_three_kills_lose_nothing() -> None:
    program = [
        sys.executable,
        str(Path(__file__).with_name("kills.py")),
        *shlex.split("--kills 3 --iterations 5 --no_export"),
    ]
    done = subprocess.run(program, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "'kills': 3" in done.stdout
