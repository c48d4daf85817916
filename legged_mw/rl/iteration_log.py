"""The log of a training: numbers of an iteration, console, curves, and the check that ends a diverged training."""

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

Mark = torch.cuda.Event | float


class Clock:
    """Records marks in the device's queue. The time between two marks is known after the device has reached both."""

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


class Numbers(NamedTuple):
    """The numbers of an iteration on the host."""

    # sums over all ranks
    statistics: list[float]  # as ``RobotTask.take_statistics``
    nonfinite: list[float]  # counts of invalid values, by name
    stop: list[float]  # above 0 if a rank must stop
    iterations_left: list[float]  # before the deadline
    # values of this rank
    losses: list[float]
    learning_rate: list[float]
    action_std: list[float]
    undone: list[float]  # 1 if the update was rolled back
    wrong: list[float]  # 1 for each column with an invalid value in the update


class Message:
    """An asynchronous copy of an iteration's numbers from the device to the host."""

    def __init__(self, **parts: Tensor) -> None:
        """``parts``: a vector for each field of ``Numbers``."""
        self._sizes, values = {name: len(part) for name, part in parts.items()}, torch.cat([*parts.values()])
        self._host, self._event = values, None
        if values.is_cuda:
            self._host = torch.empty(values.shape, dtype=values.dtype, pin_memory=True).copy_(values, non_blocking=True)
            self._event = torch.cuda.Event()
            self._event.record(torch.cuda.current_stream(values.device))

    def read(self) -> Numbers:
        """The numbers. Waits until the device has computed them."""
        if self._event is not None:
            self._event.synchronize()
        parts = self._host.split([*self._sizes.values()])
        return Numbers(**{name: part.tolist() for name, part in zip(self._sizes, parts, strict=True)})


class Report(NamedTuple):
    """An iteration: numbers known on the host, and the message with the device's numbers."""

    iteration: int
    total_steps: int  # steps since the start of the training, over all ranks
    steps: int  # steps of this iteration, over all ranks
    losses: list[str]  # names
    message: Message
    marks: tuple[Mark, Mark, Mark]  # begin, end of the rollout, end of the update

    def seconds(self) -> tuple[float, float]:
        """Duration of the rollout and of the update [s]."""
        begin, collected, end = self.marks
        return Clock.seconds(begin, collected), Clock.seconds(collected, end)


# ---- rows of the console, and curves --------------------------------------------------------------------------------

_KNOWN = (
    *("reward", "episode_length", "episodes", "fell", "broken", "overflowed", "learning_rate", "action_std"),
    "walked",  # share of the commanded speed, over worlds with a walking command
    "falls_a_minute",  # per robot and minute of simulated time
)
_APART = ("rew_", "broken_by")  # prefixes of numbers with separate lines


def console_rows(
    numbers: dict[str, float], losses: dict[str, float], speed: float, collect: float, learn: float
) -> dict[str, str]:
    """Name -> text for the block of an iteration. A mean over episodes is "-" until an episode has ended."""

    def mean(name: str, digits: int) -> str:
        return _number(numbers[name], digits)

    ends = f"{numbers['fell']:.0f} falls, {numbers['broken']:.0f} not finite"
    return {
        "Computation": f"{speed:.0f} steps/s (collection {collect:.3f} s, learning {learn:.3f} s)",
        **{f"{name.capitalize()} loss": f"{value:.4f}" for name, value in losses.items()},
        "Learning rate": f"{numbers['learning_rate']:.1e}",
        "Action std": f"{numbers['action_std']:.2f}",
        "Mean reward": mean("reward", 2),
        "Mean episode length": mean("episode_length", 1),
        **({"Share of the command walked": mean("walked", 2)} if "walked" in numbers else {}),
        "Falls a minute of a robot": mean("falls_a_minute", 2),
        **{name: mean(name, 4) for name in numbers if name.startswith("rew_")},
        **{name.replace("_", " ").replace("/", ", ").capitalize(): mean(name, 2) for name in _of_the_task(numbers)},
        "Episodes ended": f"{numbers['episodes']:.0f} ({ends})",
    }


def curves(
    numbers: dict[str, float], losses: dict[str, float], speed: float, collect: float, learn: float, total_steps: int
) -> dict[str, float]:
    """Name of a curve -> value. The names are rsl-rl's where it has one."""
    return {
        **{f"Loss/{name}": value for name, value in losses.items()},
        "Loss/learning_rate": numbers["learning_rate"],
        "Policy/mean_std": numbers["action_std"],
        "Perf/total_fps": speed,
        "Perf/collection_time": collect,
        "Perf/learning_time": learn,
        "Train/mean_reward": numbers["reward"],
        "Train/mean_episode_length": numbers["episode_length"],
        **({"Train/walked": numbers["walked"]} if "walked" in numbers else {}),
        "Train/falls_a_minute": numbers["falls_a_minute"],
        **{f"Episode/{name}": value for name, value in numbers.items() if name.startswith("rew_")},
        "Episode/fell": numbers["fell"],
        "Episode/broken": numbers["broken"],
        "Train/total_steps": total_steps,
        "Sim/overflowed_worlds": numbers["overflowed"],  # total
        **{f"Curriculum/{name}": numbers[name] for name in _of_the_task(numbers)},
    }


def _of_the_task(numbers: dict[str, float]) -> list[str]:
    """Names of the task's own statistics: curriculum levels and those that ``_live_statistics`` adds."""
    return [name for name in numbers if name not in _KNOWN and not name.startswith(_APART)]


def _number(value: float, digits: int) -> str:
    return "-" if math.isnan(value) else f"{value:.{digits}f}"


def quiet_writers() -> None:
    """Stop TensorBoard's thread from printing its error. The next write of a curve raises the error."""
    hook = threading.excepthook

    def show(died: threading.ExceptHookArgs) -> None:
        if type(died.thread).__name__ != "_AsyncWriterThread":
            hook(died)

    if hook.__module__ != __name__:
        threading.excepthook = show


# ---- the console ----------------------------------------------------------------------------------------------------

LOG_FILE = "training.log"  # in the run folder: blocks of all iterations, including those before a resume
_WINDOW = 50  # last iterations, for the estimate of the remaining time; the first ones record and compile


class Console:
    """Prints one line per iteration, with a progress bar below it on a terminal, and writes blocks to the log file.

    As a context it keeps the bar below all other printed lines. ``listeners`` are called with the number of each
    finished iteration. They must not raise.
    """

    def __init__(self, verbose: bool = False) -> None:
        self.verbose = verbose  # print blocks instead of lines
        self.deadline: float | None = None  # of the training [s, time.time()]
        self.listeners: list[Callable[[int], None]] = []
        self._file: TextIO | None = None
        self._begun, self._times = time.time(), deque[tuple[int, float]](maxlen=_WINDOW)
        self._bar: tuple[int, int, int | None] | None = None  # done, last, next exam
        self._out: TextIO | None = None  # the terminal, while it has a bar
        self._drawn = False

    def open(self, folder: Path) -> None:
        """From now on, append blocks to the log file in ``folder``."""
        self._file = self._try(lambda: open(folder / LOG_FILE, "a", encoding="utf-8"))  # noqa: SIM115

    def iteration(
        self, done: int, last: int, exam: int | None, numbers: Mapping[str, float], rows: dict[str, str], speed: float
    ) -> None:
        """Show the iteration ``done``. ``exam``: the next iteration with an exam."""
        self._times.append((done, time.time()))
        if len(self._times) == 1:
            self._times.appendleft((done - 1, self._begun))
        left = _clock(self._left(done, last))
        rows["Time elapsed, left"] = f"{_clock(time.time() - self._begun)}, {left}"
        line = f"Learning iteration {done}/{last}: {_summary(numbers)}, {speed:,.0f} steps/s"
        if self._out is None:
            line += f", {left} left{self._until(', ', done, exam)}"
        self._bar = done, last, exam
        self._say(f"Learning iteration {done}/{last}", rows, line)
        for listener in self.listeners:
            listener(done)

    def exam(self, done: int, last: int, figures: Mapping[str, float]) -> None:
        """Show the figures of an exam."""
        rows, title = {name: f"{value:.3f}" for name, value in figures.items()}, f"Exam after iteration {done}/{last}"
        self._say(title, rows, f"{title}: {', '.join(f'{name} {text}' for name, text in rows.items())}")

    def _say(self, title: str, rows: Mapping[str, str], line: str) -> None:
        block = "\n".join([f" {title} ".center(80, "#"), *(f"{name:>32}: {text}" for name, text in rows.items())])
        if self._file:
            self._try(lambda: print(block, file=self._file, flush=True))
        print(block if self.verbose else line, flush=True)

    def _try(self, write: Callable[[], Any]) -> Any:
        """Write to the log file. If that fails, warn and use it no more."""
        try:
            return write()
        except OSError as error:
            self._file = None
            print(
                f"WARNING: {LOG_FILE} cannot be written ({error.strerror}); training continues without it", flush=True
            )
            return None

    def _seconds(self, iterations: int) -> float:
        """Estimated duration of ``iterations``, by the last ones [s]."""
        (first, then), (last, now) = self._times[0], self._times[-1]
        return iterations * (now - then) / max(last - first, 1)

    def _left(self, done: int, iteration: int) -> float:
        """Time until the end of ``iteration`` or the deadline, whichever is first [s]."""
        seconds = self._seconds(iteration - done)
        return min(seconds, max(0.0, self.deadline - time.time())) if self.deadline else seconds

    def _until(self, separator: str, done: int, exam: int | None) -> str:
        return "" if exam is None or exam <= done else f"{separator}exam in {_clock(self._left(done, exam))}"

    def __enter__(self) -> Console:
        """Start the time of the training, and keep the bar below all lines printed from now on."""
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
        """Erase the bar."""
        if self._out is not None and self._drawn:
            self._out.write("\r\x1b[K")
            self._drawn = False

    def draw(self) -> None:
        """Draw the bar and leave the cursor at its start, so that the next line overwrites it."""
        if self._bar is None or self._out is None:
            return
        done, last, exam = self._bar
        share = done / max(last, 1)
        text = f" {share:4.0%}  {_clock(self._left(done, last))} left{self._until('  ', done, exam)}"
        width = min(40, shutil.get_terminal_size().columns - len(text) - 2)
        full, empty = "█░" if "utf" in (self._out.encoding or "").lower() else "#."
        filled = round(width * done / max(last, 1))
        self._out.write(f"{full * filled}{empty * (width - filled)}{text}\r" if width > 5 else f"{text}\r")
        self._out.flush()
        self._drawn = True


class _Above:
    """stdout of a terminal with a bar: text is written above the bar."""

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


def _summary(numbers: Mapping[str, float]) -> str:
    """Figures of the learning progress, without the reward of walking: its sum is clipped, so it is long near 0."""
    parts = [f"reward {_number(numbers['reward'], 2)}"]
    if "walked" in numbers:
        parts = [f"walks {100.0 * numbers['walked']:.0f}% of the command"]
    parts += [f"{numbers['falls_a_minute']:.2f} falls a minute"]
    if "terrain_level" in numbers:
        parts += [f"level {_number(numbers['terrain_level'], 1)}"]
    return ", ".join([*parts, f"length {_number(numbers['episode_length'], 1)}"])


def _clock(seconds: float) -> str:
    return str(timedelta(seconds=round(seconds)))


# ---- values that are not finite -------------------------------------------------------------------------------------

IN_A_ROW = 3  # ours: iterations; a single invalid value is rare and does not repeat in the next rollout
# ours: share of the training; iterations; share of the command, which was 0.49 in 17 trainings of 88 to 228 M steps
QUARTER, BEGUN, WALKS = 0.25, 20, 0.25
OFTEN = 3.0  # ours: falls per minute; above it, falls are the reason that a robot does not walk


class FiniteCheck:
    """Warns of values that are not finite, short episodes and robots that stand. Decides when a training must end."""

    def __init__(self, names: Sequence[str], stored: Sequence[str]) -> None:
        """``names``: values that the step counts; ``stored``: columns that an update reads."""
        self._names, self._stored = names, stored
        self.undone = 0  # total of updates rolled back
        self._undone_in_a_row = 0
        self._bad_in_a_row = 0  # iterations with too many invalid values
        self._iterations = 0  # iterations of this process
        self._looked = False  # ``walking`` has made its check
        self._counts: dict[str, float] = {}  # name -> total of invalid values

    def judge(self, counts: Sequence[float], steps: int, undone: bool, wrong: Sequence[float]) -> tuple[list[str], str]:
        """Warnings, and the reason why the training must end, or ''.

        ``counts``: invalid values in ``steps`` steps of a world; ``wrong``: 1 for each stored column with one.
        """
        by_name = self._by_name(counts)
        warnings = [line for name, count in by_name.items() if (line := self._warning(name, count, steps))]
        worst = max(by_name, key=lambda name: by_name[name], default="")
        self._bad_in_a_row = self._bad_in_a_row + 1 if worst and by_name[worst] > SHARE * steps else 0
        self._undone_in_a_row = self._undone_in_a_row + 1 if undone else 0
        if undone:
            self.undone += 1
            columns = list(dict.fromkeys(name for name, bad in zip(self._stored, wrong, strict=True) if bad))
            cause, advice = "loss or weights", "lower algorithm.learning_rate; look for rewards without a bound"
            if columns:
                cause = f"{' and '.join(columns[:4])} had values that are not finite or beyond {BOUND:g}"
                advice = "look at how that is computed"
            count = f"{self._undone_in_a_row} in a row, {self.undone} so far"
            warnings.append(f"the update was not finite ({cause}) and is undone: {count}")
            if self._undone_in_a_row >= IN_A_ROW:
                networks = "the networks are those of the last good one"
                return warnings, f"{IN_A_ROW} updates in a row were not finite ({cause}); {networks}; {advice}"
        if self._bad_in_a_row >= IN_A_ROW:
            share = f"{by_name[worst]:.0f} of {steps} steps of a world, for {IN_A_ROW} iterations"
            return warnings, f"{worst} is not finite, or beyond {BOUND:g}, in {share}; look at how it is computed"
        return warnings, ""

    def lengths(self, numbers: Mapping[str, float]) -> list[str]:
        """A warning after the second iteration of this process if episodes last one step, with the causes."""
        self._iterations += 1
        if self._iterations != 2 or not numbers["episodes"] or numbers["episode_length"] > 1.5:
            return []
        fell, broken = numbers["fell"], numbers["broken"]
        timed_out = numbers["episodes"] - fell - broken
        ends = {"fell": fell, "had a state that is not finite": broken, "timed out": timed_out}
        causes = ", ".join(f"{count:.0f} {end}" for end, count in ends.items() if count)
        lasted = f"episodes last {numbers['episode_length']:.1f} steps ({causes})"
        return [f"{lasted}: unless that is meant, nothing can be learned; --check names the rule that ends them"]

    def walking(self, numbers: Mapping[str, float], done: float) -> list[str]:
        """A single warning after a quarter of the training if robots with a walking command stand. ``done``: 0 to 1."""
        walked = numbers.get("walked", math.nan)
        if self._looked or done < QUARTER or self._iterations < BEGUN or math.isnan(walked):
            return []
        self._looked = True
        if walked >= WALKS:
            return []
        negative = {name[4:]: value for name, value in numbers.items() if name.startswith("rew_") and value < 0.0}
        penalties = {name: value for name, value in negative.items() if name != "termination"}
        largest = min(penalties, key=lambda name: penalties[name], default="")
        advice = (
            f"raise rewards.scales.tracking_lin_vel{f', or weaken {largest}, the largest penalty' if largest else ''}"
        )
        if (falls := numbers["falls_a_minute"]) > OFTEN:
            advice = f"it falls {falls:.0f} times a minute: weaken perturbation and domain_rand"
        warning = f"after {done:.0%} of the training it walks {walked:.0%} of the command: it stands"
        slowly = "" if "command_share" in numbers else ", set commands.curriculum = True"
        return [f"{warning}; {advice}{slowly}, or train longer"]

    def _by_name(self, counts: Sequence[float]) -> dict[str, float]:
        """Name -> count, without zeros. For a row with several columns it is the largest count."""
        largest: dict[str, float] = {}
        for name, count in zip(self._names, counts, strict=True):
            if count:
                largest[name] = max(largest.get(name, 0.0), count)
        return largest

    def _warning(self, name: str, count: float, steps: int) -> str:
        """A warning for the first invalid value of a name, and again when the total gets one more digit."""
        before = self._counts.get(name, 0.0)
        total = self._counts[name] = before + count
        if before and len(str(int(before))) == len(str(int(total))):
            return ""
        share = f"{count:.0f} of {steps} steps of a world"
        return f"{name} was not finite, or beyond {BOUND:g}, in {share}; 0 took its place ({total:.0f} so far)"
