"""Benchmarks that decide what is claimed: the physics they divide by is the step's own, and the memory they name is the least that fits."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from benchmarks import heights, memory, step


@pytest.mark.parametrize("engine", ["mujoco", "mujoco_warp"])
def test_the_step_is_timed_beside_its_own_physics(engine: str) -> None:
    times = step.measure("go1_flat", engine, 4, "cpu", calls=2, rounds=2, eager=False)
    assert min(times) > 0
    assert (times.bare == times.own) == (engine == "mujoco")


@pytest.mark.parametrize(
    ("need", "said"),
    [
        (1.5, "fits 2 GiB"),
        (3.5, "fits 4 GiB; out of memory with 3"),
        (9.0, "fits none of 2, 3, 4, 8 GiB; out of memory with 4, 8"),
    ],
)
def test_the_smallest_memory_is_found(need: float, said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    class Gpu:
        def leave(self, size: float) -> None:
            self.free = size

    def train(args: argparse.Namespace, task: str, worlds: Sequence[int], device: str) -> Iterator[dict[str, Any]]:
        yield {"task": task, **({} if gpu.free >= need else {"error": "out of memory"})}

    gpu: Any = Gpu()
    monkeypatch.setattr(memory, "rows", train)
    assert memory.smallest(argparse.Namespace(sizes=[8.0, 2.0, 3.0, 4.0]), "go1_flat", 1024, "cuda:0", gpu) == said


def test_another_failure_is_not_taken_for_want_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "rows", lambda *_: iter([{"error": "no task 'go9' in configs/"}]))
    gpu: Any = argparse.Namespace(leave=lambda size: None)
    assert (
        memory.smallest(argparse.Namespace(sizes=[2.0, 4.0]), "go9", 1024, "cuda:0", gpu) == "no task 'go9' in configs/"
    )


def test_as_many_robots_as_asked_stand_before_each_height() -> None:
    low, high = 6.0, 19.5
    asked, crossed = heights.shares("go2_rough", "stairs_up", low, high, repeats=1, engine="mujoco", device="cpu")
    assert (asked[0], asked[-1], len(asked), len(crossed)) == (low, high, 10, 10)
    assert crossed[:3] == [1.0] * 3  # steps of 9 cm and less; it ships with 1.0 up to 15 cm
