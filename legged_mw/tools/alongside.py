"""train --play: a viewer in a process of its own, which shows the policy as it trains and costs the training little."""

from __future__ import annotations

import atexit
import os
import subprocess
import sys
import time
from pathlib import Path

from legged_mw.rl.checkpoint import save_whole
from legged_mw.rl.run_folder import checkpoints, reason_of
from legged_mw.rl.runner import Runner
from legged_mw.utils.machine import has_display
from legged_mw.utils.task import LoadedTask
from legged_mw.view.follow import PLAYING

_SECONDS = 15.0  # between two saves of the policy for the viewer


def watch(task: LoadedTask, runner: Runner, folder: Path) -> None:
    """Open the viewer of a starting run: a window, or without a screen a web page. It closes with the training."""
    if not checkpoints(folder):
        try:
            runner.save(str(folder / "model_0.pt"))  # the viewer's first policy
        except (OSError, MemoryError) as error:
            print(f"WARNING: no viewer opens: cannot write model_0.pt ({reason_of(error)})", flush=True)
            return
    flags = [
        "--task",
        task.name if task.ships else str(task.path),
        "--load_run",
        str(folder),
        "--follow",
        "--device",
        "cpu",
    ]
    command = [
        sys.executable,
        "-m",
        "legged_mw.programs",
        "play",
        *flags,
        "--viewer",
        "native" if has_display() else "web",
    ]
    if hasattr(os, "nice"):
        command = ["nice", "-n", "10", *command]
    # in a separate session, so that Ctrl-C reaches only the training, which then ends the viewer
    viewer = subprocess.Popen(command, stdin=subprocess.DEVNULL, start_new_session=True)
    atexit.register(_end, viewer, folder / PLAYING)
    shown = time.monotonic()

    def show(iteration: int) -> None:
        nonlocal shown
        if time.monotonic() - shown < _SECONDS or viewer.poll() is not None:
            return
        shown = time.monotonic()
        try:
            save_whole({"actor_state_dict": runner.alg.get_policy().state_dict(), "iter": iteration}, folder / PLAYING)
        except (OSError, MemoryError) as error:
            print(f"WARNING: the viewer keeps its policy: cannot write {PLAYING} ({reason_of(error)})", flush=True)
            runner.console.listeners.remove(show)

    runner.console.listeners.append(show)


def _end(viewer: subprocess.Popen[bytes], file: Path) -> None:
    viewer.terminate()
    file.unlink(missing_ok=True)
