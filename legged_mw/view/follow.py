"""Watching a policy as it trains: `play --follow` reads it again whenever its run has a newer one. Knows files, no network."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from legged_mw.utils.config import ConfigError

PLAYING = "playing.pt"  # what train --play writes into its run for the viewer: an actor, more often than checkpoints
_SECONDS = 2.0  # between two looks at the folder


class Newest:
    """Called at each step. Loads the newest policy of a run by ``load``, which returns its iteration, and says which it is.

    Ends the program with the one that started it: a viewer must not outlive a training that was killed.
    """

    def __init__(self, folder: Path, load: Callable[[Path], int], shown: Path) -> None:
        """``shown``: the file that is loaded already."""
        self.news = shown.stem.replace("model_", "iteration ")
        self._folder, self._load, self._parent = folder, load, os.getppid()
        self._stamp, self._next = _stamp(shown), 0.0

    def __call__(self) -> None:
        if time.monotonic() < self._next:
            return
        self._next = time.monotonic() + _SECONDS
        if os.getppid() != self._parent:
            raise KeyboardInterrupt  # which ends a session as closing its viewer does
        stamp, newest = max((_stamp(path), path) for path in (*self._folder.glob("model_*.pt"), self._folder / PLAYING))
        if stamp > self._stamp:
            self._stamp = stamp
            try:
                self.news = f"iteration {self._load(newest)}"
            except ConfigError:
                if newest.exists():  # else it was thinned out meanwhile
                    raise


def _stamp(path: Path) -> int:
    """When the file was written [ns]; 0 if it is gone."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
