"""Where a training speaks: a line an iteration, below it a bar where there is a terminal, and whole blocks in the run's log file."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import timedelta
from pathlib import Path
from typing import Any, TextIO

from legged_mw.rl.report import console_block

LOG_FILE = "training.log"  # in a run's folder: all blocks, also of what was resumed
_WINDOW = 50  # iterations over which the time that is left is estimated: the first ones record and compile


class Console:
    """What a user sees of a training. As a context it keeps the bar below what others print meanwhile.

    ``listeners`` are called after each iteration with its number; what they raise is theirs to catch.
    """

    def __init__(self, verbose: bool = False) -> None:
        self.verbose = verbose  # print whole blocks
        self.deadline: float | None = None  # the time at which the training ends at the latest [s]
        self.listeners: list[Callable[[int], None]] = []
        self._file: TextIO | None = None
        self._begun, self._times = time.time(), deque[tuple[int, float]](maxlen=_WINDOW)
        self._bar: tuple[int, int, int | None] | None = None  # done, last, next exam
        self._out: TextIO | None = None  # the terminal, while the bar is kept
        self._drawn = False

    def open(self, folder: Path) -> None:
        """Write blocks to the log file of this run from now on."""
        self._file = self._try(lambda: open(folder / LOG_FILE, "a", encoding="utf-8"))  # noqa: SIM115 (open until the training ends)

    def iteration(
        self, done: int, last: int, exam: int | None, numbers: Mapping[str, float], rows: dict[str, str], speed: float
    ) -> None:
        """An iteration is done. ``exam``: the next iteration that ends with one."""
        self._times.append((done, time.time()))
        if len(self._times) == 1:
            self._times.appendleft((done - 1, self._begun))
        rows["Time elapsed, left"] = f"{_clock(time.time() - self._begun)}, {_clock(self._left(done, last))}"
        line = f"Learning iteration {done}/{last}: {summary(numbers)}, {speed:,.0f} steps/s"
        if self._out is None:
            until = f", exam in {_clock(self._seconds(exam - done))}" if exam is not None and exam > done else ""
            line += f", {_clock(self._left(done, last))} left{until}"
        self._bar = done, last, exam
        self._say(console_block(f"Learning iteration {done}/{last}", rows), line)
        for listener in self.listeners:
            listener(done)

    def exam(self, done: int, last: int, figures: Mapping[str, float]) -> None:
        """An exam is done."""
        texts = {name: f"{value:.3f}" for name, value in figures.items()}
        line = f"Exam after iteration {done}/{last}: {', '.join(f'{name} {text}' for name, text in texts.items())}"
        self._say(console_block(f"Exam after iteration {done}/{last}", texts), line)

    def _say(self, block: str, line: str) -> None:
        if self._file:
            self._try(lambda: print(block, file=self._file, flush=True))
        print(block if self.verbose else line, flush=True)

    def _try(self, write: Callable[[], Any]) -> Any:
        """A log that cannot be written is no reason to end a training."""
        try:
            return write()
        except OSError as error:
            self._file = None
            print(f"WARNING: {LOG_FILE} cannot be written ({error.strerror}); training goes on without", flush=True)
            return None

    def _seconds(self, iterations: int) -> float:
        """How long so many iterations take, at the pace of the last ones [s]."""
        (first, then), (last, now) = self._times[0], self._times[-1]
        return iterations * (now - then) / max(last - first, 1)

    def _left(self, done: int, last: int) -> float:
        """How long the training still takes [s]."""
        seconds = self._seconds(last - done)
        return min(seconds, max(0.0, self.deadline - time.time())) if self.deadline else seconds

    # ---- the bar

    def __enter__(self) -> Console:
        """Begin to train. Lines that are printed from here on push the bar down."""
        self._begun = time.time()
        if sys.stdout.isatty() and not self.verbose and os.environ.get("TERM") != "dumb":
            self._out = sys.stdout
            sys.stdout = _Above(self)
        return self

    def __exit__(self, *_: object) -> None:
        if self._out is not None:
            self.clear()
            self._out, sys.stdout = None, self._out
        if self._file:
            self._file.close()
            self._file = None

    def clear(self) -> None:
        if self._out is not None and self._drawn:
            self._out.write("\r\x1b[K")
            self._drawn = False

    def draw(self) -> None:
        """The bar, as wide as the terminal allows; the cursor stays in front of it, so that a line printed past us replaces it."""
        if self._bar is None or self._out is None:
            return
        done, last, exam = self._bar
        until = f"  exam in {_clock(self._seconds(exam - done))}" if exam is not None and exam > done else ""
        text = f" {done / max(last, 1):4.0%}  {_clock(self._left(done, last))} left{until}"
        width = min(40, shutil.get_terminal_size().columns - len(text) - 2)
        full, empty = "█░" if "utf" in (self._out.encoding or "").lower() else "#."
        filled = round(width * done / max(last, 1))
        self._out.write(f"{full * filled}{empty * (width - filled)}{text}\r" if width > 5 else f"{text}\r")
        self._out.flush()
        self._drawn = True


class _Above:
    """The terminal's stdout while there is a bar: text goes above it."""

    def __init__(self, console: Console) -> None:
        assert console._out is not None
        self._console, self._terminal = console, console._out

    def write(self, text: str) -> int:
        if not text:
            return 0
        self._console.clear()
        self._terminal.write(text)
        if text.endswith("\n"):
            self._console.draw()
        return len(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._terminal, name)


def summary(numbers: Mapping[str, float]) -> str:
    """What one looks at first, in words; "-" until an episode has ended."""
    shares = {"reward": ".2f", "episode_length": ".1f"}
    said = [
        f"{name.replace('_', ' ').removeprefix('episode ')} {_number(numbers[name], digits)}"
        for name, digits in shares.items()
    ]
    return ", ".join([*said, f"episodes {numbers['episodes']:.0f}, falls {numbers['fell']:.0f}"])


def _number(value: float, digits: str) -> str:
    return "-" if value != value else f"{value:{digits}}"


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))
