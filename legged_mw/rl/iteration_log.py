"""Where a training speaks: a line an iteration, below it a bar where there is a terminal, and whole blocks in the run's log file."""

from __future__ import annotations

import math
import os
import shutil
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any, NamedTuple, TextIO

import torch
from torch import Tensor

from legged_mw.envs.statistics import BOUND, SHARE

_KNOWN = ("reward", "episode_length", "episodes", "fell", "broken", "overflowed", "learning_rate", "action_std")
_APART = ("rew_", "broken_by")  # shown by other lines, or where a training ends

Mark = torch.cuda.Event | float


class Clock:
    """Marks points in the device's queue of work; the seconds between two marks are known once both are reached."""

    def __init__(self, device: str) -> None:
        self._device = device if device.startswith("cuda") else None

    def mark(self) -> Mark:
        if self._device is None:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record(torch.cuda.current_stream(self._device))
        return event

    @staticmethod
    def seconds(start: Mark, end: Mark) -> float:
        if isinstance(start, torch.cuda.Event) and isinstance(end, torch.cuda.Event):
            end.synchronize()
            return start.elapsed_time(end) / 1e3
        assert isinstance(start, float) and isinstance(end, float)
        return end - start


class Message:
    """A vector that travels from the device to the host while both go on."""

    def __init__(self, values: Tensor, sizes: Sequence[int]) -> None:
        """``sizes`` of the parts of ``values``."""
        self._host, self._event, self._sizes = values, None, list(sizes)
        if values.is_cuda:
            self._host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(values.device))

    def read(self) -> list[list[float]]:
        """The numbers of each part; waits until the device has computed them."""
        if self._event is not None:
            self._event.synchronize()
        return [part.tolist() for part in self._host.split(self._sizes)]


class Report(NamedTuple):
    """An iteration: what the host knows at once, and what is on its way."""

    iteration: int
    total_steps: int  # since the beginning of training, over all ranks
    steps: int  # of this iteration, over all ranks
    losses: list[str]
    message: Message  # statistics of the episodes, nonfinite, stop, room; losses, learning rate, std of the actions, undone, wrong columns
    marks: tuple[Mark, Mark, Mark]  # begin, end of the rollout, end of the update

    def seconds(self) -> tuple[float, float]:
        """The rollout's and the update's."""
        begin, collected, end = self.marks
        return Clock.seconds(begin, collected), Clock.seconds(collected, end)


def quiet_writers() -> None:
    """TensorBoard's own thread hands its error to who writes the next curve: it need not print a traceback as well."""
    hook = threading.excepthook

    def show(died: threading.ExceptHookArgs) -> None:
        if type(died.thread).__name__ != "_AsyncWriterThread":
            hook(died)

    if hook.__module__ != __name__:
        threading.excepthook = show


def console_block(title: str, rows: dict[str, str]) -> str:
    """A headline and a line a row, as the console shows an iteration."""
    return "\n".join([f" {title} ".center(80, "#"), *(f"{name:>32}: {text}" for name, text in rows.items())])


def console_rows(
    numbers: dict[str, float], losses: dict[str, float], speed: float, collect: float, learn: float
) -> dict[str, str]:
    """What an iteration shows of its numbers: name -> text. A mean over episodes is "-" until one has ended."""

    def mean(name: str, digits: int) -> str:
        return "-" if math.isnan(numbers[name]) else f"{numbers[name]:.{digits}f}"

    return {
        "Computation": f"{speed:.0f} steps/s (collection {collect:.3f} s, learning {learn:.3f} s)",
        **{f"{name.capitalize()} loss": f"{value:.4f}" for name, value in losses.items()},
        "Learning rate": f"{numbers['learning_rate']:.1e}",
        "Action std": f"{numbers['action_std']:.2f}",
        "Mean reward": mean("reward", 2),
        "Mean episode length": mean("episode_length", 1),
        **{name: mean(name, 4) for name in numbers if name.startswith("rew_")},
        **{name.replace("_", " ").replace("/", ", ").capitalize(): mean(name, 2) for name in _of_the_task(numbers)},
        "Episodes ended": f"{numbers['episodes']:.0f} ({numbers['fell']:.0f} falls, {numbers['broken']:.0f} not finite)",
    }


def curves(
    numbers: dict[str, float], losses: dict[str, float], speed: float, collect: float, learn: float, total_steps: int
) -> dict[str, float]:
    """Curve -> value, under rsl-rl's names where it has them."""
    return {
        **{f"Loss/{name}": value for name, value in losses.items()},
        **{"Loss/learning_rate": numbers["learning_rate"], "Policy/mean_std": numbers["action_std"]},
        **{"Perf/total_fps": speed, "Perf/collection_time": collect, "Perf/learning_time": learn},
        **{"Train/mean_reward": numbers["reward"], "Train/mean_episode_length": numbers["episode_length"]},
        **{f"Episode/{name}": value for name, value in numbers.items() if name.startswith("rew_")},
        **{"Episode/fell": numbers["fell"], "Episode/broken": numbers["broken"], "Train/total_steps": total_steps},
        "Sim/overflowed_worlds": numbers["overflowed"],  # so far
        **{f"Curriculum/{name}": numbers[name] for name in _of_the_task(numbers)},
    }


def _of_the_task(numbers: dict[str, float]) -> list[str]:
    """Names of the task's own statistics of the moment: levels of curricula, and whatever its ``_live_statistics`` adds."""
    return [name for name in numbers if name not in _KNOWN and not name.startswith(_APART)]


# ---- what the user sees ---------------------------------------------------------------------------------------------


LOG_FILE = "training.log"  # in a run's folder: all blocks, also of what was resumed
_PACE_WINDOW = 50  # iterations over which the time that is left is estimated: the first ones record and compile


class Console:
    """What a user sees of a training. As a context it keeps the bar below what others print meanwhile.

    ``listeners`` are called after each iteration with its number; what they raise is theirs to catch.
    """

    def __init__(self, verbose: bool = False) -> None:
        self.verbose = verbose  # print whole blocks
        self.deadline: float | None = None  # the time at which the training ends at the latest [s]
        self.listeners: list[Callable[[int], None]] = []
        self._file: TextIO | None = None
        self._begun, self._times = time.time(), deque[tuple[int, float]](maxlen=_PACE_WINDOW)
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


# ---- is learning still alive ----------------------------------------------------------------------------------------


IN_A_ROW = 3  # ours: iterations; one bad value is an accident, and the next rollout is another


class FiniteCheck:
    """What the last iterations were like."""

    def __init__(self, names: Sequence[str], stored: Sequence[str]) -> None:
        """``names`` of the values that the step looks at, and of the ``stored`` columns that an update learns from; in words."""
        self._names, self._stored = names, stored
        self.undone = 0  # updates, in all
        self._row = 0  # updates undone, one after the other
        self._sick = 0  # iterations with too many values that are not finite, one after the other
        self._heard = 0  # iterations of this process
        self._said: dict[str, float] = {}  # name -> count when it was said last

    def judge(self, counts: Sequence[float], steps: int, undone: bool, wrong: Sequence[float]) -> tuple[list[str], str]:
        """Warnings, and why training must end, '' to go on; ``counts`` of bad values in ``steps`` steps of a world, ``wrong`` columns."""
        found = self._by_name(counts)
        warnings = [line for name, count in found.items() if (line := self._warning(name, count, steps))]
        worst = max(found, key=lambda name: found[name], default="")
        self._sick = self._sick + 1 if worst and found[worst] > SHARE * steps else 0
        self._row = self._row + 1 if undone else 0
        if undone:
            self.undone += 1
            brought = list(dict.fromkeys(name for name, bad in zip(self._stored, wrong, strict=True) if bad))
            cause = (
                f"{' and '.join(brought[:4])} held what is not finite or beyond {BOUND:g}"
                if brought
                else "loss or weights"
            )
            warnings.append(
                f"the update was not finite ({cause}) and is undone: {self._row} in a row, {self.undone} so far"
            )
            if self._row >= IN_A_ROW:
                advice = (
                    "look at how that is computed"
                    if brought
                    else "lower algorithm.learning_rate; look for rewards without a bound"
                )
                kept = "the networks are those of the last good one"
                return warnings, f"{IN_A_ROW} updates in a row were not finite ({cause}); {kept}; {advice}"
        if self._sick >= IN_A_ROW:
            share = f"{found[worst]:.0f} of {steps} steps of a world, for {IN_A_ROW} iterations"
            return warnings, f"{worst} is not finite, or beyond {BOUND:g}, in {share}; look at how it is computed"
        return warnings, ""

    def lengths(self, numbers: Mapping[str, float]) -> list[str]:
        """A line after the second iteration of this process, if episodes lasted a step: how they end."""
        self._heard += 1
        if self._heard != 2 or not numbers["episodes"] or numbers["episode_length"] > 1.5:
            return []
        fell, broken = numbers["fell"], numbers["broken"]
        ends = {
            "fell": fell,
            "had a state that is not finite": broken,
            "timed out": numbers["episodes"] - fell - broken,
        }
        said = ", ".join(f"{count:.0f} {end}" for end, count in ends.items() if count)
        lasted = f"episodes last {numbers['episode_length']:.1f} steps ({said})"
        return [f"{lasted}: unless that is meant, nothing can be learned; --check names the rule that ends them"]

    def _by_name(self, counts: Sequence[float]) -> dict[str, float]:
        """Those that were found: of a row with several columns the worst one's count."""
        found: dict[str, float] = {}
        for name, count in zip(self._names, counts, strict=True):
            if count:
                found[name] = max(found.get(name, 0.0), count)
        return found

    def _warning(self, name: str, count: float, steps: int) -> str:
        """A line when it is first found, and each time that ten times as much has been."""
        before = self._said.get(name, 0.0)
        total = self._said[name] = before + count
        if before and len(str(int(before))) == len(str(int(total))):
            return ""
        share = f"{count:.0f} of {steps} steps of a world"
        return f"{name} was not finite, or beyond {BOUND:g}, in {share}; 0 took its place ({total:.0f} so far)"
