"""`play --follow`: reload the policy when its training run writes a newer one. Independent of torch."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from legged_mw.utils.config import ConfigError

PLAYING = "playing.pt"  # train --play writes this actor into its run for the viewer, more often than checkpoints
_SECONDS = 2.0  # between two checks of the folder


class Newest:
    """Reloads the newest policy of a run; call it at each step. ``load`` reads a file and returns its iteration.

    It ends the program if the parent process has ended: a viewer must not outlive a killed training run.
    """

    def __init__(self, folder: Path, load: Callable[[Path], int], shown: Path) -> None:
        """``shown``: the file of the current policy."""
        self.news = shown.stem.replace("model_", "iteration ")
        self._folder, self._load, self._parent = folder, load, os.getppid()
        self._stamp, self._next = _stamp(shown), 0.0

    def __call__(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + _SECONDS
        if os.getppid() != self._parent:
            raise KeyboardInterrupt  # ends the session as if the viewer were closed
        stamp, newest = max((_stamp(path), path) for path in (*self._folder.glob("model_*.pt"), self._folder / PLAYING))
        if stamp > self._stamp:
            self._stamp = stamp
            try:
                self.news = f"iteration {self._load(newest)}"
            except ConfigError:
                if newest.exists():  # else the training run has just deleted it
                    raise


def _stamp(path: Path) -> int:
    """The modification time of the file [ns]; 0 if it does not exist."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
