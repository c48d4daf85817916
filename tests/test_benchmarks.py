"""Benchmarks that decide what is claimed: the physics they divide by is the step's own, and the memory they name is the least that fits."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch

from benchmarks import heights, mean_policy, memory, step
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


def test_a_policy_between_two_trainings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights lie at the share of the way, counts and the config are the second's; other networks are refused, and nothing is written."""
    for name, weight, count in (("first", 1.0, 5), ("second", 3.0, 9), ("wider", 0.0, 9)):
        size = 2 + (name == "wider")
        models = {
            part: {"weight": torch.full((size,), weight), "count": torch.tensor(count)}
            for part in ("actor_state_dict", "critic_state_dict")
        }
        (tmp_path / name).mkdir()
        torch.save({"iter": count, "infos": None, **models}, tmp_path / name / f"model_{count}.pt")
        (tmp_path / name / "config.yaml").write_text(f"task: {name}\n")

    def mean(second: str) -> None:
        files = [tmp_path / "first/model_5.pt", tmp_path / second / "model_9.pt"]
        monkeypatch.setattr("sys.argv", ["mean_policy.py", *map(str, files), "0.25", str(tmp_path / f"from_{second}")])
        mean_policy.main()

    mean("second")
    mixed = torch.load(tmp_path / "from_second/model_9.pt", weights_only=True)
    assert mixed["actor_state_dict"]["weight"].tolist() == [1.5, 1.5] and mixed["actor_state_dict"]["count"] == 9
    assert (tmp_path / "from_second/config.yaml").read_text() == "task: second\n" and mixed["iter"] == 9
    with pytest.raises(SystemExit, match="different sizes"):
        mean("wider")
    assert not (tmp_path / "from_wider").exists()
