"""Benchmarks that decide what is claimed: the physics they divide by is the step's own, and the memory they name is the least that fits."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from benchmarks import heights, memory, step
from legged_mw.envs.legged_robot import LeggedRobot


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


@pytest.mark.usefixtures("own_kinds")
def test_robots_stand_before_each_height_that_is_asked_for_both_ways(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Two robots a height on one row of tiles; each ground is as high as it says."""
    seen: list[Any] = []

    def run_crossing(env: LeggedRobot, policy: Any, speed: float) -> dict[str, Any]:
        seen.append((env, speed))
        return {"kinds": {kind: {"crossed": [i / 4]} for i, kind in enumerate(env.tiles.kinds)}} if env.tiles else {}

    monkeypatch.setattr(heights.rough, "run_crossing", run_crossing)
    ground = ["--ground", "stairs_up", "9", "25", "--ground", "smooth_slope", "57"]
    monkeypatch.setattr("sys.argv", ["heights.py", "go2_rough", *ground, "--backwards", "--robots", "2"])
    heights.main()
    (env, speed), (_, back) = seen
    names = ("stairs_up, step 9 cm", "stairs_up, step 25 cm", "smooth_slope, slope 57 %")
    assert (speed, back, env.num_envs) == (0.6, -0.6, 6) and env.tiles.kinds == names
    assert env.terrain.origins[0, :4, 2].tolist() == pytest.approx([-8 * 0.09] * 2 + [-8 * 0.25] * 2)
    assert sorted(env.terrain.origins[0, 4:, 2]) == pytest.approx([-0.57 * 2.5, 0.57 * 2.5]), "a pyramid and a pit"
    rows = capsys.readouterr().out.splitlines()
    assert rows[1].split() == ["friction,", "way", "0.6", "ahead", "0.6", "back"]
    assert [row.split()[-2:] for row in rows[2:]] == [["0.00"] * 2, ["0.25"] * 2, ["0.50"] * 2]


@pytest.mark.usefixtures("own_kinds")
def test_robots_that_walk_backwards_cross_low_stairs() -> None:
    (ground,) = heights.add_ground("stairs_up", "7")
    asked = {"friction": 1.0, "repeats": 1, "engine": "mujoco", "device": "cpu"}
    assert heights.crossed("go2_rough", [ground], speed=-0.6, **asked) == [1.0]
