"""Every error line that a user can meet, as tests/golden/errors.txt has it; ``--rewrite`` writes it anew (see CONTRIBUTING.md)."""

from __future__ import annotations

import difflib
import fcntl
from importlib import import_module
from pathlib import Path

import pytest
import torch
from golden import table
from golden.areas import AREAS
from program import guarded_once

from legged_mw.check import guard

GOLDEN = Path(__file__).parent / "golden/errors.txt"


def stored(area: str) -> list[str]:
    return [line for line in GOLDEN.read_text().splitlines() if line.startswith(f"{area}/")]


@pytest.mark.parametrize("area", AREAS)
def test_every_line(
    area: str, made: Path, tmp_path: Path, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        guard, "check_recordable", guarded_once
    )  # the area own_code, which is about it, calls it itself
    table.made_run[:] = [made.parent]
    torch.manual_seed(0)
    found = sorted(table.lines(area, import_module(f"golden.{area}").table(), tmp_path))
    if request.config.getoption("--rewrite"):
        with GOLDEN.open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            others = [line for line in file.read().splitlines() if not line.startswith(f"{area}/")]
            file.seek(0)
            file.truncate()
            file.write("\n".join(sorted([*others, *found])) + "\n")
    diff = list(difflib.unified_diff(stored(area), found, "errors.txt", "found", lineterm="", n=0))
    assert not diff, "\n".join(["pytest tests/test_error_lines.py --rewrite takes these:", *diff])


def test_every_area_is_run() -> None:
    """No line stays that no case makes."""
    assert {line.partition("/")[0] for line in GOLDEN.read_text().splitlines()} == set(AREAS)
