"""The exam's rough part: who stands where, who counts as across, what is printed and written, and who may change what."""

from __future__ import annotations

import json
import math
import shlex
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from program import refused, run, trained
from tensordict import TensorDict
from torch import Tensor

from legged_mw import programs
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exams, plots, rollout, rough
from legged_mw.eval.rough import TILES
from legged_mw.eval.walking import LEVELS
from legged_mw.utils.task import LoadedTask, load_task

COMMANDS = slice(53, 56)  # of the group "state"


def rough_task(kinds: dict[str, float]) -> LoadedTask:
    task = load_task("go1_rough")
    task.set("terrain.terrain_proportions", kinds)
    return task


def make_env(kinds: dict[str, float], repeats: int) -> LeggedRobot:
    task = rough_task(kinds)
    rough.prepare(task, repeats)
    return task.env_class(task.cfg, "cpu")


def stand(obs: TensorDict) -> Tensor:
    return torch.zeros(len(obs), 12)


def test_prepare_is_the_exam_but_for_ground_place_and_heading() -> None:
    task = rough_task({"stairs_up": 0.9, "gap": 0.0, "flat": 0.1})
    task.set("terrain.tile_size", 12.0)  # whatever it was trained on
    rough.prepare(task)
    ground = task.cfg.terrain
    assert (ground.mesh_type, ground.curriculum, ground.tile_size, ground.horizontal_scale) == (
        "heightfield",
        False,
        8.0,
        0.05,
    )
    assert ground.terrain_proportions == {"stairs_up": 1.0, "flat": 1.0} and (ground.num_rows, ground.num_cols) == (
        LEVELS,
        2 * TILES,
    )
    assert task.cfg.env.num_envs == 2 * LEVELS * 10
    differs = {path for path, value in rollout.OVERRIDES.items() if rough.OVERRIDES.get(path) != value}
    assert differs == {
        "terrain.mesh_type",
        "init_state.pos_xy_range",
        "init_state.yaw_range",
        "termination.min_base_height",
    }


def test_robots_begin_in_the_middle_of_their_tile_and_walk_ahead(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same number on each tile, each in a direction of its own; on stairs from the pit up, and from the top down."""
    monkeypatch.setattr(rough, "SECONDS", 0.06)
    env = make_env({"stairs_up": 0.5, "stairs_down": 0.1}, 3)
    places, asked = [], []

    def policy(obs: TensorDict) -> Tensor:
        places.append(env.sim.qpos[:, :7].clone())
        asked.append(obs["state"][:, COMMANDS].clone())
        return stand(obs)

    result = rough.run_crossing(env, policy)
    assert result["robots"] == 3 * TILES and list(result["kinds"]) == ["stairs_up", "stairs_down"]
    assert env.terrain is not None and env.tiles is not None
    # columns, levels, robots
    middles = torch.tensor(env.terrain.origins, dtype=torch.float).transpose(0, 1)[:, :, None]
    assert env.terrain.kinds == ("stairs_up",) * TILES + ("stairs_down",) * TILES
    away = places[0][:, :3].view(2 * TILES, LEVELS, 3, 3) - middles
    assert away[..., :2].abs().max() <= 0.3 and away[..., :2].std() > 0.1
    torch.testing.assert_close(away[..., 2], env.init_pos[2].expand(2 * TILES, LEVELS, 3))
    steps = torch.tensor(result["kinds"]["stairs_up"]["values"]) / 100
    torch.testing.assert_close(middles[:TILES, :, 0, 2], -8 * steps.expand(TILES, LEVELS))
    yaw = 2.0 * torch.atan2(places[0][:, 6], places[0][:, 3])
    assert len(yaw.unique()) == env.num_envs == 60 * TILES and yaw.min() < -2.5 and yaw.max() > 2.5
    assert all((seen == torch.tensor([rough.SPEED, 0.0, 0.0])).all() for seen in asked) and len(asked) == 3
    assert rough.run_crossing(env, policy, -0.4)["speed"] == -0.4
    assert (asked[-1] == torch.tensor([-0.4, 0.0, 0.0])).all()


def test_the_same_whatever_the_seed_and_nothing_drawn_outside(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rough, "SECONDS", 0.3)
    mix = torch.randn(56, 12, generator=torch.Generator().manual_seed(0))
    ends = []
    for seed in (1, 2):
        torch.manual_seed(seed)
        env = make_env({"waves": 1.0}, 1)  # a robot a tile
        before = torch.get_rng_state()
        rough.run_crossing(env, lambda obs: 0.3 * torch.sin(obs["state"] @ mix))
        assert torch.equal(before, torch.get_rng_state())
        ends.append(env.sim.qpos.clone())
    assert torch.equal(*ends)


# ---- who crossed: robots that are carried, on flat ground


def carry(env: LeggedRobot, script: dict[int, list[tuple[int, Callable[[LeggedRobot, int], None]]]]) -> dict[str, Any]:
    """The result where, before step k, something happens to world w."""
    step = 0

    def policy(obs: TensorDict) -> Tensor:
        nonlocal step
        for world, happens in script.get(step, []):
            happens(env, world)
        step += 1
        return stand(obs)

    return rough.run_crossing(env, policy)


def move(distance: float, axis: int = 0) -> Callable[[LeggedRobot, int], None]:
    """Put it ``distance`` [m] away from the middle of its tile."""

    def happens(env: LeggedRobot, world: int) -> None:
        assert env.tiles is not None
        env.root_pos[world, axis] = env.tiles.origins[world, axis] + distance

    return happens


def upset(env: LeggedRobot, world: int) -> None:
    """Turn it on its back."""
    env.root_quat[world] = torch.tensor([0.0, 1.0, 0.0, 0.0])


def lose(env: LeggedRobot, world: int) -> None:
    """Break its state."""
    env.sim.qpos[world, 7] = math.nan


def test_who_crossed_and_who_fell(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot a level; each counts once, by what came first."""
    monkeypatch.setattr(rough, "TILES", 1)
    monkeypatch.setattr(rough, "SECONDS", 0.4)
    script = {
        3: [
            (1, move(4.1)),
            (2, move(-4.1, axis=1)),
            (3, upset),
            (4, move(4.1)),
            (5, move(4.1)),
            (5, upset),
            (6, move(3.9)),
            (7, lose),
        ],
        9: [(3, move(4.1)), (4, upset), (8, move(500.0)), (7, move(-4.1))],
        15: [(3, upset), (8, move(4.1))],
    }
    result = carry(make_env({"flat": 1.0}, 1), script)["kinds"]["flat"]
    #                            stands  both edges  fell, then moved  across, then fell  at once  not yet  broke  off the ground
    assert result["crossed"] == [0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert result["fell"] == [0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0]


def test_shares_are_by_kind_and_level(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rough, "SECONDS", 0.1)
    monkeypatch.setattr(rough, "TILES", 2)

    def world(column: int, level: int, robot: int) -> int:
        return (column * LEVELS + level) * 2 + robot

    across = [world(0, 0, 0), world(0, 0, 1), world(1, 0, 0), world(3, 9, 1)]
    happens = [*((w, move(4.1)) for w in across), (world(1, 5, 0), upset)]
    kinds = carry(make_env({"flat": 1.0, "low_random": 1.0}, 2), {1: happens})["kinds"]
    assert kinds["flat"]["crossed"] == [0.75] + [0.0] * 9 and kinds["low_random"]["crossed"] == [0.0] * 9 + [0.25]
    assert kinds["flat"]["fell"] == [0.0] * 5 + [0.25] + [0.0] * 4 and kinds["low_random"]["fell"] == [0.0] * 10
    assert kinds["flat"]["measure"] is None and kinds["flat"]["values"] is None
    assert kinds["low_random"]["measure"] == "height [cm]" and kinds["low_random"]["values"][::3] == [
        0.0,
        1.67,
        3.33,
        5.0,
    ]


def test_table() -> None:
    stairs = {
        "measure": "step [cm]",
        "values": [6.0 + 1.5 * i for i in range(10)],
        "crossed": [1.0] * 5 + [0.0] * 5,
        "fell": [0.2] * 10,
    }
    flat = {"measure": None, "values": None, "crossed": [1.0] * 10, "fell": [0.0] * 10}
    text = rough.table({"speed": 0.6, "seconds": 15.0, "robots": 20, "kinds": {"flat": flat, "stairs_up": stairs}})
    assert text.splitlines() == [
        "share of 20 robots that crossed a tile at 0.6 m/s within 15 s",
        "level                 0      1      2      3      4      5      6      7      8      9     mean   fell",
        "flat               1.00   1.00   1.00   1.00   1.00   1.00   1.00   1.00   1.00   1.00     1.00   0.00",
        "stairs_up          1.00   1.00   1.00   1.00   1.00   0.00   0.00   0.00   0.00   0.00     0.50   0.20",
        "  step [cm]           6    7.5      9   10.5     12   13.5     15   16.5     18   19.5",
        "all                                                                                        0.75   0.10",
    ]


# ---- as part of grading

ROUGH = ["--task", "go1_rough"]
KINDS = "terrain.terrain_proportions={stairs_up: 2, flat: 1}"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A root with a run of an iteration on rough ground."""
    root = tmp_path_factory.mktemp("rough")
    return root, trained(
        root,
        *ROUGH,
        *shlex.split("--max_iterations 1 --set terrain.num_rows=2 --set terrain.max_init_terrain_level=1"),
    )


def test_eval_of_two_rough_policies(runs: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch) -> None:
    """Both cross the ground that the user chose; tables, figures, picture and chapter are there."""
    root, folder = runs
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 2.1)
    monkeypatch.setattr(rollout, "GRID", (3, 3, 3))
    monkeypatch.setattr(rough, "SECONDS", 0.1)
    monkeypatch.setattr(programs, "grade_export", lambda *_: [])
    draw = plots.sections
    monkeypatch.setattr(plots, "sections", lambda *args: draw(*args)[:2])  # the others are drawn in test_report
    result = run(
        "play",
        root,
        *ROUGH,
        "--device",
        "cpu",
        "--eval",
        "--no_hard",
        "--compare",
        folder.name,
        "--set",
        KINDS,
        "--set",
        "exam.push_speeds=[2]",
    )
    assert result.code == 0, result.err
    walked, crossed = "falls in 22 commands", "share of 10 robots that crossed a tile"
    assert [line for line in result.out.splitlines() if walked in line or crossed in line][
        1
    ] == f"{crossed} at 0.6 m/s within 0.1 s"
    assert result.out.count(walked) == result.out.count(crossed) == 2
    columns = json.loads((folder / "eval/report.json").read_text())["columns"]
    for column in columns:
        assert column["figures"]["crossing"]["robots"] == 10
        assert list(column["figures"]["crossing"]["kinds"]) == ["stairs_up", "flat"]
        assert column["about"]["overrides"]["terrain.terrain_proportions"] == {"stairs_up": 2.0, "flat": 1.0}
    html = (folder / "eval/report.html").read_text(encoding="utf-8")
    assert (
        html.index("<h2>Exam</h2>") < html.index("<h2>Rough ground</h2>") < html.index("<h2>Following the command</h2>")
    )
    chapter = html[html.index("<h2>Rough ground</h2>") : html.index("<h2>Following the command</h2>")]
    assert chapter.count("<svg") == 2 and chapter.count("step [cm]") == 2 and ">19.5<" in chapter
    assert f"<th>stairs up, fell, {folder.name}, 1</th>" in chapter


@pytest.mark.parametrize(
    ("more", "field"),
    [
        (["--set", "terrain.num_rows=5"], "terrain.num_rows"),
        (["--set", "terrain.num_cols=7"], "terrain.num_cols"),
        (["--set", "terrain.tile_size=4"], "terrain.tile_size"),
        (["--set", "terrain.mesh_type=heightfield"], "terrain.mesh_type"),
        (["--num_envs", "4"], "env.num_envs"),
    ],
)
def test_what_it_decides_cannot_be_overridden(runs: tuple[Path, Path], more: list[str], field: str) -> None:
    line = refused(runs[0], "play", *ROUGH, "--device", "cpu", "--eval", *more)
    assert f"--eval sets {field} itself; an exam with other values would be another exam" in line


def test_only_what_was_trained_on_rough_ground_crosses_it() -> None:
    args = Namespace(eval=True, override=[], set=["terrain.friction=0.4"])
    assert exams.prepare_crossing(load_task("go1_flat"), args) is None
    task = exams.prepare_crossing(load_task("go1_rough"), args)
    assert task is not None and task.cfg.terrain.friction == 0.4 and task.cfg.env.num_envs == 8 * LEVELS * 10


def test_kinds_that_do_not_exist_are_refused_before_anything_is_graded(runs: tuple[Path, Path]) -> None:
    line = refused(
        runs[0], "play", *ROUGH, "--device", "cpu", "--eval", "--set", "terrain.terrain_proportions={stair_up: 1}"
    )
    assert (
        "terrain.terrain_proportions: no kind of terrain 'stair_up' in the table of kinds; did you mean 'stairs_up'"
        in line
    )
