"""Numbers that no field may have, and sizes that no machine has."""

from __future__ import annotations

from pathlib import Path

import pytest
from attack import Case, attack, program

CASES = [
    Case("not a number", program("train", "--check", "--set", "sim.dt=fast"), "--set sim.dt=fast: sim.dt must be"),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_numbers(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)
