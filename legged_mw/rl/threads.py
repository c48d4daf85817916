"""How many threads an update takes on a CPU: all cores, or one where other processes keep the cores busy.

An update is some thousand small parallel regions, and the end of each waits for its slowest thread. A thread whose core is
taken by another process makes all wait for the scheduler, again and again: measured up to 60 times slower than one thread.
"""

from __future__ import annotations

import time
from typing import Self

import torch

_SLOW = 3.0  # ours: times the one before, from which on an update on all cores is looked into; noise stays below 2
_GAIN = 1.2  # ours: times faster that the other number must be to change to it
_PATIENCE = 50  # ours: updates on one thread before all cores are tried again; doubled each time that does not help


class ThreadChoice:
    """Which number of threads the next update takes, from what those before took. No clock, no torch."""

    def __init__(self, few: int, many: int) -> None:
        self.few, self.many = few, many
        # what was chosen; what the next update takes: first the one that cannot be very slow
        self.settled, self.threads = many, few
        self._times: dict[int, float] = {}  # threads -> [s] of the last update on as many
        self._warm, self._since, self._patience = False, 0, _PATIENCE

    def took(self, seconds: float) -> str:
        """Take note of an update's time; returns what to say if the choice has changed, else ''."""
        if not self._warm:  # the first one allocates, too
            self._warm = True
            return ""
        before, self._times[self.threads] = self._times.get(self.threads), seconds
        if len(self._times) < 2:
            self.threads = self.many
            return ""
        if before is None or self.threads != self.settled:  # it was a trial
            return self._settle()
        self._since += 1
        if self.settled == self.many and seconds > _SLOW * before:
            self.threads = self.few
        elif self.settled == self.few and self._since >= self._patience:
            self.threads = self.many
        return ""

    def _settle(self) -> str:
        before, self.settled = self.settled, better(self._times, self.settled)
        self._patience = 2 * self._patience if self.settled == before == self.few else _PATIENCE
        self.threads, self._since = self.settled, 0
        if self.settled == before:
            return ""
        took = " and ".join(f"{self._times[threads]:.2g} s on {threads}" for threads in (before, self.settled))
        return f"threads of an update: {took}; going on with {self.settled} (cpu.update_threads = 0)"


def better(times: dict[int, float], settled: int) -> int:
    """The number of threads to go on with: ``settled``, unless another one gains enough."""
    quickest = min(times, key=lambda threads: times[threads])
    return quickest if _GAIN * times[quickest] < times[settled] else settled


class UpdateThreads:
    """Around each update: sets torch's threads, and puts them back, since a step's small operations want one.

    ``asked`` 0 means as many of ``cores`` as are fastest, tried again when an update takes far longer than usual.
    """

    def __init__(self, asked: int, cores: int) -> None:
        self._fixed = asked or cores
        self._choice = ThreadChoice(1, cores) if not asked and cores > 1 else None

    def __enter__(self) -> Self:
        self._before = torch.get_num_threads()
        torch.set_num_threads(self._choice.threads if self._choice else self._fixed)
        self._begun = time.perf_counter()
        return self

    def __exit__(self, *error: object) -> None:
        seconds = time.perf_counter() - self._begun
        torch.set_num_threads(self._before)
        if self._choice and error[0] is None and (text := self._choice.took(seconds)):
            print(text, flush=True)
