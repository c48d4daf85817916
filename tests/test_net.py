"""Every task acts as it did when tests/net/first_steps.npz was recorded: observations, rewards and ends of episodes.

A change that means to act differently says so, and keeps new arrays: python tests/net/compare.py --keep tests/net/first_steps.npz
"""

from __future__ import annotations

import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from net import compare
from net.compare import ENGINES, RECORDINGS, Found, differences, first_steps
from recordings import Change, make_env  # found by net.compare

from legged_mw.check.held import Lost
from legged_mw.envs.snapshot import put_snapshot, take_snapshot

KEPT = Path(__file__).parent / "net" / "first_steps.npz"
TOLERANCES = {"": 0.0, "obs": 1e-5, "reward": 1e-5, "statistics": 1e-4}
BY_NETWORK = {**TOLERANCES, "obs": 1e-4}  # torques of a network part by 5e-5 between two kinds of CPU


@cache
def kept() -> Found:
    return compare.load(KEPT)


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("name", RECORDINGS)
def test_first_steps_are_as_they_were(name: str, engine: str) -> None:
    run = f"{name} {engine}"
    lines, failed = differences(
        {run: kept()[run]}, {run: first_steps(name, engine)}, BY_NETWORK if name == "network" else TOLERANCES
    )
    assert not failed, "A: kept, B: now\n" + "\n".join(lines)


@pytest.mark.parametrize("name", RECORDINGS)
def test_a_snapshot_holds_all_that_a_step_writes(name: str, tmp_path: Path) -> None:
    """Another environment, which has gone elsewhere, goes on as the first one did; and nothing written is left out."""
    one, two = (make_env(name, "mujoco", tmp_path) for _ in range(2))
    lost, actions = Lost(one), torch.randn(8, one.num_envs, one.num_actions)
    for action in actions[:4]:
        one.step(action)
        two.step(-action)
        two.on_training_progress(0.3)
    state, draws = take_snapshot(one), torch.get_rng_state()
    wanted = [one.step(action)[:3] for action in actions[4:]]
    assert put_snapshot(two, state) == ""
    torch.set_rng_state(draws)
    for action, (obs, reward, done) in zip(actions[4:], wanted, strict=True):
        seen, earned, ended, _ = two.step(action)
        assert torch.equal(earned, reward) and torch.equal(ended, done)
        assert all(torch.equal(seen[group], value) for group, value in obs.items())
    assert lost.named() == ""


# ---- planted changes are found


def changed_class(loaded: Any, **methods: Any) -> None:
    loaded.env_class = type("Planted", (loaded.env_class,), methods)


def other_sign(loaded: Any) -> None:
    term = loaded.env_class._reward_action_rate
    changed_class(loaded, _reward_action_rate=lambda env: -term(env))


def other_order(loaded: Any) -> None:
    """Gyro and gravity, three columns each."""
    rows = loaded.env_class.observation_rows

    def swapped(env: Any) -> Any:
        table = rows(env)
        first, *rest = [i for i, row in enumerate(table["state"]) if row.name in ("base_ang_vel", "projected_gravity")]
        table["state"][first], table["state"][rest[0]] = table["state"][rest[0]], table["state"][first]
        return table

    changed_class(loaded, observation_rows=swapped)


def later_actions(loaded: Any) -> None:
    step = loaded.env_class.step

    def late(env: Any, actions: torch.Tensor) -> Any:
        before, env.planted = getattr(env, "planted", torch.zeros_like(actions)), actions
        return step(env, before)

    changed_class(loaded, step=late)


@pytest.mark.parametrize(
    ("name", "change", "found"),
    [
        ("go1_flat", other_sign, ["statistics", "reward"]),
        ("go2_flat", other_order, ["obs/state", "obs/privileged_state"]),
        ("go1_rough", later_actions, ["obs/privileged_state", "obs/state", "reward"]),
        (
            "g1_flat",
            lambda loaded: loaded.set("gait.offsets", [0.01, 0.51]),
            ["obs/state", "obs/privileged_state", "reward"],
        ),
        (
            "go1_getup",
            lambda loaded: loaded.set("perturbation.velocity", [0.0, 3.03]),
            ["obs/privileged_state", "obs/state", "reward"],
        ),
    ],
    ids=["a reward's sign", "the order of rows", "an action's delay", "the phase of a gait", "the force of a kick"],
)
def test_a_planted_change_is_found(name: str, change: Change, found: list[str]) -> None:
    run = f"{name} mujoco"
    lines, failed = differences({run: kept()[run]}, {run: first_steps(name, "mujoco", change)}, TOLERANCES)
    assert failed
    assert {*found} <= {line.split()[0] for line in lines if "within" not in line}, lines


def test_a_difference_is_found() -> None:
    a: Found = {
        "task engine": {
            **{
                "obs/state": np.zeros((4, 2, 3)),
                "steps/obs/state": np.arange(-2, 2),
                "columns/obs/state": np.array(list("xyz")),
            },
            **{"reward": np.zeros((2, 2)), "steps/reward": np.arange(2), "flags": np.array(["a", "b"])},
        }
    }
    b = {"task engine": {name: value.copy() for name, value in a["task engine"].items()}}
    values = b["task engine"]
    values["obs/state"][3, 1, 2], values["reward"][1, 0] = 2e-5, -0.0
    assert differences(a, a, {}) == (["task engine                  3 of 3 equal"], False)
    lines, failed = differences(a, b, TOLERANCES)
    assert failed
    assert lines == [
        "task engine                  2 of 3 equal  <--",
        "    obs/state                      2e-05 first at step 1 in z",
    ]
    values["reward"][0, 1] = 1e-6
    assert [line.split()[0] for line in differences(a, b, TOLERANCES)[0]] == ["task", "reward", "obs/state"], (
        "the first step first"
    )
    assert not differences(a, b, {"": 1e-4})[1]
    values["flags"][1] = "c"
    assert differences(a, b, {"": 1e-4})[1]
    values["flags"][1], values["obs/state"][3, 1, 2] = "b", np.nan
    assert differences(a, b, {"": 1.0})[1]
    assert not differences(b, b, {})[1]
    del values["reward"]
    assert any("only in A" in line for line in differences(a, b, TOLERANCES)[0])
    assert differences(a, {}, {"": 1.0})[1]
    broken = {"task engine": {"error": np.array("KeyError: x")}}
    assert differences(broken, broken, {})[1], "a run that fails on both sides shows nothing"


# ---- the program: two commits of a repository that is small


def git(root: Path, *words: str) -> str:
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    return subprocess.run(["git", *who, *words], cwd=root, check=True, capture_output=True, text=True).stdout.strip()


TRAIN = """
import pathlib, sys, torch
if "--task" in sys.argv and "breaks" in sys.argv:
    sys.exit("it broke")
run = pathlib.Path("logs/walk/one")
run.mkdir(parents=True)
(run / "config.yaml").write_text("task: walk\\n")
torch.save({"actor": {"0.weight": torch.full((3,), VALUE)}, "iter": 2}, run / "model_2.pt")
"""


def test_two_commits_are_compared_and_found_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    git(tmp_path, "init", "-q")
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "walk.py").write_text("TASK = 1")
    commits = []
    for value in ("1.0", "1.0", "2.0"):
        (tmp_path / "train.py").write_text(TRAIN.replace("VALUE", value))
        git(tmp_path, "add", "-A")
        git(tmp_path, "commit", "-q", "--allow-empty", "-m", value)
        commits.append(git(tmp_path, "rev-parse", "HEAD"))
    asked: list[str] = []

    def here(root: Path, part: str, out: Path, folder: Path) -> None:
        """In this process, which has torch; the checkout is at the commit."""
        asked.append(git(root, "rev-parse", "HEAD"))
        compare.save(out, compare.PARTS[part](root))

    monkeypatch.setattr(compare, "REPOSITORY", tmp_path)
    monkeypatch.setattr(compare, "LEARNERS", {})
    monkeypatch.setattr(compare, "in_checkout", here)
    assert not compare.compare(commits[0], commits[1], ["trainings"], {})
    assert "walk                         4 of 4 equal" in capsys.readouterr().out
    assert compare.compare(commits[0], commits[2], ["trainings"], {})
    said = capsys.readouterr().out
    assert "3 of 4 equal  <--" in said and "    actor.0.weight" in said and said.endswith("A and B differ: trainings\n")
    assert asked == commits, "the first was found before"
    assert git(tmp_path, "worktree", "list").count("\n") == 0, "checkouts are gone"
    assert compare.compare(str(tmp_path), commits[0], ["trainings"], {}), "a folder is a checkout too"


def test_what_is_no_commit_is_said() -> None:
    done = subprocess.run(
        [sys.executable, compare.__file__, "no-such-commit", "HEAD"], capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 1 and "no-such-commit" in done.stderr and done.stderr.count("\n") == 1
