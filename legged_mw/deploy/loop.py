"""The clock of a control loop: absolute deadlines, delays, and no garbage collection within a step.

Deadline k is start + k * period, independent of the durations of the steps, so the loop does not drift.
This module depends on no robot and no policy.
"""

from __future__ import annotations

import gc
import math
import os
import sys
import time
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

LATE = 0.5  # [periods] a step that begins later counts as late
KEPT = 1 << 16  # samples for median and p99: 22 minutes at 50 Hz; the worst value is of the whole run
_PRIORITY = 20  # ours, of 1 to 99: above all threads that are not real-time, below the kernel's threads
_YIELD = 5e-4  # [s] thread switch interval of the interpreter; Python's default of 5 ms would make a step late
# [s] shortest wait that allows a collection; it takes 0.1 ms, because frozen objects are skipped
_SPARE = 0.003


class Spread(NamedTuple):
    """Median, 99th percentile and largest value of a time [s]."""

    median: float
    p99: float
    worst: float

    @classmethod
    def of(cls, values: NDArray[Any] | Sequence[float]) -> Spread:
        """The spread of at least one value [s]."""
        return cls(*(float(value) for value in np.percentile(values, (50, 99, 100))))

    def __str__(self) -> str:
        return f"median {1e3 * self.median:.2f}, p99 {1e3 * self.p99:.2f}, worst {1e3 * self.worst:.2f} ms"


class Timing(NamedTuple):
    """The timing of a loop."""

    jitter: Spread  # delay of a step's begin
    work: Spread  # duration of a step
    steps: int
    late: int  # steps that began more than LATE periods late
    lost: int  # periods skipped because the previous step took too long

    def __str__(self) -> str:
        lost = f", {self.lost} periods left out" if self.lost else ""
        return f"{self.steps} steps, {self.late} late{lost}; begin late by {self.jitter}; work of a step {self.work}"


class _Samples:
    """The last KEPT values, and the largest of all values. The memory is fixed."""

    def __init__(self) -> None:
        # full() writes the memory now; zeros() would cause page faults during the run
        self.values = np.full(KEPT, 0.0, dtype=np.float32)
        self.count, self.worst = 0, 0.0

    def add(self, value: float) -> None:
        self.values[self.count % KEPT] = value
        self.count += 1
        self.worst = max(self.worst, value)

    def spread(self) -> Spread:
        if not self.count:
            return Spread(0.0, 0.0, 0.0)
        return Spread.of(self.values[: self.count])._replace(worst=self.worst)


def real_time(priority: int, heirs: bool = False) -> tuple[int, Any] | None:
    """Give this thread real-time scheduling: round robin at ``priority``, 1 to 99.

    ``heirs``: new threads of this thread inherit it.
    Returns the previous scheduling; None without permission or outside Linux.
    """
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_RR | (0 if heirs else os.SCHED_RESET_ON_FORK), os.sched_param(priority))
    except (OSError, AttributeError):
        return None
    return before


class Loop:
    """Yields the time of each step; see ``ticks``.

    ``live``: run in real time; otherwise it does not wait and does not change the garbage collector.
    As a context manager it collects garbage only while it waits, not within a step.
    It requests real-time priority, and runs without it if the system refuses.
    """

    def __init__(self, period: float, live: bool = True) -> None:
        self.period, self.live = period, live
        self.now = 0.0  # [s] from the first step to this step, a multiple of the period
        self.behind = 0.0  # [s] delay of this step's begin
        self.skipped = 0  # periods left out before this step
        self.work = 0.0  # [s] duration of the previous step
        self.steps = self.late = self.lost = 0
        self._tick, self._start, self._began = -1, 0.0, 0.0
        self._jitter, self._work = _Samples(), _Samples()
        self._before = False, 0.0  # previous settings: garbage collector enabled; [s] thread switch interval
        self._scheduled: tuple[int, Any] | None = None  # previous scheduling of this thread

    def __enter__(self) -> Loop:
        if self.live:
            self._before = gc.isenabled(), sys.getswitchinterval()
            gc.collect()
            gc.freeze()
            gc.disable()
            sys.setswitchinterval(_YIELD)
            self._scheduled = real_time(_PRIORITY)
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            gc.unfreeze()
            sys.setswitchinterval(self._before[1])
            if self._before[0]:
                gc.enable()
            if self._scheduled:
                policy, parameters = self._scheduled
                # only root can clear the flag that real_time set
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameters)

    def ticks(self, seconds: float = math.inf) -> Iterator[float]:
        """Yield the time [s] of each step for ``seconds``, at its deadline, or at once if it is late.

        A deadline that is missed by a whole period is skipped.
        """
        while self._wait() < seconds - 1e-9:
            self.steps += 1
            yield self.now

    def timing(self) -> Timing:
        """The timing until now."""
        return Timing(self._jitter.spread(), self._work.spread(), self.steps, self.late, self.lost)

    def _wait(self) -> float:
        """Wait for the next step and return its time."""
        self._tick += 1
        self.now = self._tick * self.period
        if not self.live:
            return self.now
        if self._tick:
            self._end_step()
        else:
            self._start = time.perf_counter()
        self._began = time.perf_counter()
        self.behind = max(0.0, self._began - self._start - self.now)
        if self._tick:
            self._jitter.add(self.behind)
        self.late += self.behind > LATE * self.period + 1e-9
        return self.now

    def _end_step(self) -> None:
        """Wait for the next deadline. Skip the deadlines that are a period or more ago."""
        ended = time.perf_counter()
        self.work = ended - self._began
        self._work.add(self.work)
        missed = max(0, int((ended - self._start - self._tick * self.period) / self.period))
        self._tick += missed
        self.skipped = missed
        self.lost += missed
        self.now = self._tick * self.period
        due = self._start + self.now
        if due - ended > _SPARE:
            gc.collect()
        time.sleep(min(self.period, max(0.0, due - time.perf_counter())))  # never longer than a period
