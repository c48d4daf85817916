"""The clock of a control loop: absolute deadlines, lateness, and no garbage collection within a step.

Deadline k is start + k * period, however long a step took, so the loop does not drift.
Nothing here knows a robot or a policy.
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

LATE = 0.5  # [periods]; a step that begins later counts as late
KEPT = 1 << 16  # samples for median and p99: 22 minutes at 50 Hz; the worst is that of the whole run
_PRIORITY = 20  # ours, of 1 to 99: above everything that is not real time, below a kernel's own threads
_YIELD = 5e-4  # [s] that another thread may hold the interpreter; Python's own 5 ms would make a step late
# [s] of waiting that a collection needs; it takes 0.1 ms, as frozen objects are skipped
_SPARE = 0.003


class Spread(NamedTuple):
    """Median, 99th percentile and worst of a time [s]."""

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
    """How well a loop kept its time."""

    jitter: Spread  # how late steps began
    work: Spread  # duration of a step
    steps: int
    late: int  # steps that began more than LATE periods late
    lost: int  # periods skipped because the step before took longer

    def __str__(self) -> str:
        lost = f", {self.lost} periods left out" if self.lost else ""
        return f"{self.steps} steps, {self.late} late{lost}; begin late by {self.jitter}; work of a step {self.work}"


class _Samples:
    """The last KEPT values and the worst value ever. Memory is fixed."""

    def __init__(self) -> None:
        # allocated now: zeros() would be paged in later, in the middle of a run
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
    """Run this thread before everything that is not real time: round robin at ``priority``, 1 to 99.

    ``heirs``: also the threads that it starts from now on.
    Returns the scheduling before; None without the permission, or on another system than Linux.
    """
    try:
        before = os.sched_getscheduler(0), os.sched_getparam(0)
        os.sched_setscheduler(0, os.SCHED_RR | (0 if heirs else os.SCHED_RESET_ON_FORK), os.sched_param(priority))
    except (OSError, AttributeError):
        return None
    return before


class Loop:
    """Keeps the time of each step, in ``ticks``.

    ``live``: in real time; else it never waits and leaves the garbage collector alone.
    As a context it collects garbage while it waits, never within a step.
    It requests real-time priority from the system, and goes on without it where that is not allowed.
    """

    def __init__(self, period: float, live: bool = True) -> None:
        self.period, self.live = period, live
        self.now = 0.0  # [s] from the first step to this one, a multiple of the period
        self.behind = 0.0  # [s] that this step began late
        self.work = 0.0  # [s] that the step before took
        self.steps = self.late = self.lost = 0
        self._tick, self._start, self._began = -1, 0.0, 0.0
        self._jitter, self._work = _Samples(), _Samples()
        self._before = False, 0.0  # garbage collector on; [s] that threads may hold the interpreter
        self._scheduled: tuple[int, Any] | None = None  # this thread's scheduling before

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
                # only root may clear that flag again
                os.sched_setscheduler(0, policy | os.SCHED_RESET_ON_FORK, parameters)

    def ticks(self, seconds: float = math.inf) -> Iterator[float]:
        """The time [s] of each step for ``seconds``: when it is due, or at once if it is late.

        A deadline missed by a whole period is skipped.
        """
        while self._wait() < seconds - 1e-9:
            self.steps += 1
            yield self.now

    def timing(self) -> Timing:
        """Timing up to now."""
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
        """Wait for the next deadline that is less than a period ago."""
        ended = time.perf_counter()
        self.work = ended - self._began
        self._work.add(self.work)
        missed = max(0, int((ended - self._start - self._tick * self.period) / self.period))
        self._tick += missed
        self.lost += missed
        self.now = self._tick * self.period
        due = self._start + self.now
        if due - ended > _SPARE:
            gc.collect()
        time.sleep(min(self.period, max(0.0, due - time.perf_counter())))  # a clock set back must not wait longer
