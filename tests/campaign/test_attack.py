"""The harness itself: what it must not let pass."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import attack as harness
import pytest
from attack import Case, attack, program

from legged_mw.utils.errors import UserError


def refuse(root: Path) -> None:
    raise UserError("no")


def test_a_refusal_passes(tmp_path: Path) -> None:
    assert attack(Case("plain", refuse, "no"), tmp_path) == "train.py: no\n"
    assert "unknown" not in attack(Case("flag", program("train", "--nosuch"), "--nosuch"), tmp_path)


def writes_elsewhere(root: Path) -> None:
    (root.parent / "elsewhere").write_text("x")
    refuse(root)


def removes_elsewhere(root: Path) -> None:
    (root.parent / "stood").unlink()
    refuse(root)


def writes_below(root: Path) -> None:
    (root / "left").mkdir()
    (root / "left/behind").write_text("x")
    refuse(root)


def speaks_twice(root: Path) -> None:
    print("a word before", file=sys.stderr)
    refuse(root)


def speaks_from_c(root: Path) -> None:
    os.write(2, b"a library's word\n")
    refuse(root)


def takes_memory(root: Path) -> None:
    bytearray(2 * harness.ROOM)


def never_ends(root: Path) -> None:
    while True:
        time.sleep(0.1)


@pytest.mark.parametrize(
    ("run", "error"),
    [
        (lambda root: None, AssertionError),  # accepted
        (lambda root: 1 // 0, ZeroDivisionError),
        (program("train", "--num_envs", "4"), AssertionError),  # would train
        (writes_elsewhere, AssertionError),
        (removes_elsewhere, AssertionError),
        (writes_below, AssertionError),
        (speaks_twice, AssertionError),
        (speaks_from_c, AssertionError),
        (takes_memory, AssertionError),
        (never_ends, TimeoutError),
    ],
)
def test_it_sees(
    run: Callable[[Path], object], error: type[Exception], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(harness, "SECONDS", 1 if run is never_ends else 60)
    (tmp_path.parent / "stood").write_text("")
    with pytest.raises(error):
        attack(Case("bad", run, ""), tmp_path)
