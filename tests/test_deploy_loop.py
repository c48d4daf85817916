"""The loop that keeps a policy's time: deadlines that do not drift, what is reported of them, garbage and memory."""

from __future__ import annotations

import gc
import os
import tracemalloc
from typing import Any

import numpy as np
import pytest

from legged_mw.deploy import loop as loop_module
from legged_mw.deploy.loop import Loop, Spread


class Clock:
    """A made-up clock; sleeping is exact."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        monkeypatch.setattr("time.perf_counter", lambda: self.now)
        monkeypatch.setattr("time.sleep", self.pass_)

    def pass_(self, seconds: float) -> None:
        self.now += seconds


def test_deadlines_do_not_drift(monkeypatch: pytest.MonkeyPatch) -> None:
    """A thousand steps, each with work of another length, begin on the grid."""
    clock, began = Clock(monkeypatch), []
    with Loop(0.02) as loop:
        for now in loop.ticks(20.0):
            began.append(clock.now - 100.0)
            assert now == pytest.approx(began[-1], abs=1e-6)
            clock.pass_(0.001 + 0.018 * (len(began) % 7) / 7)
    np.testing.assert_allclose(began, 0.02 * np.arange(1000), atol=1e-6)
    timing = loop.timing()
    assert (timing.steps, timing.late, timing.lost) == (1000, 0, 0) and timing.jitter.worst < 1e-6
    assert timing.work.worst == pytest.approx(0.001 + 0.018 * 6 / 7)


def test_a_late_step_moves_no_deadline(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, began = Clock(monkeypatch), []
    with Loop(0.02) as loop:
        for _ in loop.ticks(0.2):
            began.append(round(clock.now - 100.0, 6))
            assert loop.skipped == (began[-1] == 0.115)
            clock.pass_({1: 0.031, 3: 0.055}.get(len(began) - 1, 0.002))
    assert began == [0.0, 0.02, 0.051, 0.06, 0.115, 0.12, 0.14, 0.16, 0.18]
    timing = loop.timing()
    assert (timing.late, timing.lost) == (2, 1) and timing.jitter.worst == pytest.approx(0.015)
    assert str(timing).startswith("9 steps, 2 late, 1 periods left out; begin late by median 0.00, p99 ")


def test_a_clock_that_goes_back_stops_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """A step follows a step within a period, though by that clock it has an hour."""
    clock, slept = Clock(monkeypatch), list[float]()
    monkeypatch.setattr("time.sleep", slept.append)
    with Loop(0.02) as loop:
        ticks = loop.ticks()
        next(ticks)
        clock.now -= 3600.0
        next(ticks)
    assert len(slept) == 1 and slept[0] <= 0.02


def test_real_time_priority_is_given_back_as_a_user_may(monkeypatch: pytest.MonkeyPatch) -> None:
    """Linux lets only root take back the flag that threads do not inherit the priority."""
    asked: list[int] = []

    def schedule(process: int, policy: int, parameters: Any) -> None:
        assert process == 0  # this thread
        if asked and not policy & os.SCHED_RESET_ON_FORK:
            raise PermissionError(1, "Operation not permitted")
        asked.append(policy)

    monkeypatch.setattr("os.sched_setscheduler", schedule)
    with Loop(0.02):
        assert asked == [os.SCHED_RR | os.SCHED_RESET_ON_FORK]
    assert asked[1:] == [os.sched_getscheduler(0) | os.SCHED_RESET_ON_FORK]


def test_a_loop_that_is_not_live_never_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    with Loop(0.02, live=False) as loop:
        assert gc.isenabled() and [round(now, 6) for now in loop.ticks(0.1)] == [0.0, 0.02, 0.04, 0.06, 0.08]
    assert clock.now == 100.0 and loop.timing().jitter == Spread(0.0, 0.0, 0.0)


def test_spread_of_the_last_times_and_the_worst_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the last three alone are median and 99th percentile; the worst is of all that came."""
    monkeypatch.setattr(loop_module, "KEPT", 3)
    samples = loop_module._Samples()
    assert samples.spread() == Spread(0.0, 0.0, 0.0)
    samples.add(7.0)
    assert samples.spread() == Spread(7.0, 7.0, 7.0)
    for value in (9.0, 1.0, 2.0, 3.0):
        samples.add(value)
    assert samples.spread() == pytest.approx((2.0, 2.98, 9.0))


def test_garbage_is_collected_between_steps_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cycles that a step leaves behind are gone at the next one, and no collection runs within it."""
    Clock(monkeypatch)  # on a busy machine a step is late, and then nothing is collected after it

    class Node:
        def __init__(self) -> None:
            self.me = self

    collections: list[str] = []
    inside = [False]
    gc.callbacks.append(lambda phase, _: collections.append(phase) if inside[0] else None)
    enabled = gc.isenabled()
    try:
        with Loop(0.01) as loop:
            left = []
            for _ in loop.ticks(0.05):
                inside[0] = True
                left.append(sum(isinstance(each, Node) for each in gc.get_objects()))
                for _ in range(2000):
                    Node()
                inside[0] = False
        assert not collections and left[1:] == [0] * (len(left) - 1)
    finally:
        gc.callbacks.pop()
    assert gc.isenabled() == enabled and gc.get_freeze_count() == 0


def test_memory_is_flat(monkeypatch: pytest.MonkeyPatch) -> None:
    """From step 2000 to step 29000 memory grows by less than a byte a step: one reference kept by each would be eight.

    What the rest of the process takes meanwhile is counted too: 2712 bytes were seen once.
    """
    clock = Clock(monkeypatch)
    sizes = []
    tracemalloc.start()
    try:
        with Loop(0.02) as loop:
            monkeypatch.setattr("gc.collect", lambda: None)  # for speed: there is nothing to collect
            for now in loop.ticks(600.0):
                clock.pass_(0.001)
                if round(now / 0.02) in (2000, 29_000):
                    sizes.append(tracemalloc.get_traced_memory()[0])
    finally:
        tracemalloc.stop()
    assert len(sizes) == 2 and sizes[1] - sizes[0] < 27_000
