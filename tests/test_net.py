"""Every task acts as it did when tests/net/first_steps.npz was recorded: observations, rewards and ends of episodes.

A change that means to act differently says so, and keeps new arrays: python tests/net/compare.py keep --out tests/net/first_steps.npz
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from net.compare import ENGINES, TASKS, differences, first_steps

KEPT = Path(__file__).parent / "net" / "first_steps.npz"
TOLERANCES = {"": 0.0, "obs": 1e-5, "reward": 1e-5}


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("task", TASKS)
def test_first_steps_are_as_they_were(task: str, engine: str) -> None:
    run = f"{Path(task).stem}/{engine}"
    with np.load(KEPT) as file:
        kept = {name: file[name] for name in file if name.startswith(f"{run}/")}
    assert kept
    now = {f"{run}/{name}": value for name, value in first_steps(task, engine).items()}
    lines, failed = differences(kept, now, TOLERANCES)
    assert not failed, "A: kept, B: now\n" + "\n".join(lines)


def test_a_difference_is_found() -> None:
    a = {
        "task/engine/obs/state": np.zeros((4, 2, 3)),
        "task/engine/reward": np.zeros((2, 2)),
        "task/engine/columns/state": np.array(list("xyz")),
    }
    b = {name: value.copy() for name, value in a.items()}
    b["task/engine/obs/state"][3, 1, 2], b["task/engine/reward"][1, 0] = 2e-5, -0.0
    assert differences(a, a, {"": 0.0}) == (["task/engine              2 of 2 equal"], False)
    lines, failed = differences(a, b, TOLERANCES)
    assert failed
    assert lines == [
        "task/engine              obs/state                      2e-05 first at step 1 in z  <-- more than 1e-05",
        "task/engine              1 of 2 equal",
    ]
    b["task/engine/obs/state"][3, 1, 2] = np.nan
    assert differences(a, b, {"": 1.0})[1]
    del b["task/engine/reward"]
    assert "task/engine              reward                         only in A" in differences(a, b, TOLERANCES)[0]
