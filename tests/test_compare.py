"""benchmarks/compare.py on a CPU: a table with our figure, and a peer that is missing or broken costs a line, not the run."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
from program import Result

from legged_mw import ROOT

PROGRAM = ROOT / "benchmarks" / "compare.py"


def compare(*args: str) -> Result:
    """The program in this process, since an import costs seconds; what it starts are processes."""
    out, code = io.StringIO(), 0
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out):
        patch.setattr(sys, "argv", [str(PROGRAM), "--device", "cpu", "--num_envs", "8", "--iterations", "1", *args])
        try:
            runpy.run_path(str(PROGRAM), run_name="__main__")
        except SystemExit as end:
            code = end.code
    assert code is None or isinstance(code, int)
    return Result(code or 0, out.getvalue(), "")


def interpreter(path: Path, script: str) -> str:
    """An executable file that stands in for the interpreter of a peer's environment."""
    path.write_text(f"#!/bin/sh\n{script}\n")
    path.chmod(0o755)
    return str(path)


@pytest.fixture(scope="module")
def broken(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An environment in which mjlab is installed, but cannot be imported."""
    folder = tmp_path_factory.mktemp("broken")
    (folder / "mjlab").mkdir()
    (folder / "mjlab" / "__init__.py").write_text(
        "print('mjlab says hello')\nraise RuntimeError('no driver\\nsee the manual')\n"
    )
    return interpreter(folder / "python", f"PYTHONPATH='{folder}' exec '{sys.executable}' \"$@\"")


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> str:
    """An environment without any package."""
    return interpreter(tmp_path_factory.mktemp("bare") / "python", f"exec '{sys.executable}' -I -S \"$@\"")


def test_our_figure_beside_a_broken_and_a_missing_peer(broken: str, bare: str) -> None:
    result = compare("--python-mjlab", broken, "--python-playground", bare)
    assert result.code == 0, result.out
    row = re.search(r"^ +8  legged_mw +([\d,]+) +[\d.]+% +1\.00 +([\d.]+) +128 +32$", result.out, re.MULTILINE)
    assert row, result.out
    speed, seconds = float(row[1].replace(",", "")), float(row[2])
    assert speed == pytest.approx(8 * 16 / seconds, rel=0.01)
    assert "       8  mjlab         failed: RuntimeError: no driver\n" in result.out
    assert '       8  playground    not installed: pip install playground "jax[cuda12]' in result.out
    for condition in (
        "16 steps a world",
        "5 epochs x 4 minibatches",
        "48 512 256 128",
        "123 512 256 128",
        "5 x 4 ms",
        "mujoco-warp 4.",
    ):
        assert condition in result.out
    assert "hello" not in result.out


def test_only_what_was_asked_for_and_status_0_when_a_peer_alone_is_missing(bare: str) -> None:
    result = compare("--only", "playground", "--python-playground", bare)
    assert result.code == 0, result.out
    assert "not installed" in result.out
    assert not re.search(r"^ +8  (legged_mw|mjlab)", result.out, re.MULTILINE)


@pytest.mark.parametrize(
    ("script", "timeout", "reason"),
    [
        ("echo some warning >&2; echo 'Error: it broke' >&2; exit 3", "60", "failed: Error: it broke (exit status 3)"),
        ("kill -9 $$", "60", "failed: no word (SIGKILL)"),
        ("exec sleep 60", "0.5", "failed: not done after 0.5 s (--timeout)"),
    ],
)
def test_how_a_child_ends_is_reported(tmp_path: Path, script: str, timeout: str, reason: str) -> None:
    result = compare(
        "--only", "mjlab", "--timeout", timeout, "--python-mjlab", interpreter(tmp_path / "python", script)
    )
    assert result.code == 0, result.out
    assert reason in result.out


def test_an_interpreter_that_is_not_there(tmp_path: Path) -> None:
    result = compare("--only", "mjlab", "--python-mjlab", str(tmp_path / "nothing"))
    assert result.code == 0 and f"failed: no interpreter {tmp_path / 'nothing'} (" in result.out


def test_our_own_failure_is_status_1() -> None:
    result = compare("--only", "legged_mw", "--timeout", "0.01")
    assert result.code == 1
    assert "legged_mw     failed: not done after 0.01 s" in result.out


def test_a_child_needs_no_package_to_say_what_is_missing(bare: str) -> None:
    order = json.dumps(["mjlab", 8, 1, "cpu", "jax"])
    result = subprocess.run(
        [bare, str(PROGRAM), "--child", order], capture_output=True, text=True, check=True, env=dict(os.environ)
    )
    assert json.loads(result.stdout) == {"missing": True}
