"""What a training says: a line an iteration, a bar in a terminal, whole blocks in its log file."""

from __future__ import annotations

import io
import math
import re
import sys
from pathlib import Path

import pytest
from program import SMALL, run

from legged_mw.eval import rollout
from legged_mw.rl import iteration_log
from legged_mw.rl.iteration_log import LOG_FILE, Console

NUMBERS = {"reward": 1.234, "episode_length": math.nan, "fell": 2.0, "episodes": 7.0, "falls_a_minute": 0.8}


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


def shown(text: str) -> list[str]:
    """The lines that a terminal ends with."""
    lines = [""]
    for part in re.split(r"(\r\x1b\[K|\r|\n)", text):
        if part == "\r\x1b[K":
            lines[-1] = ""
        elif part == "\n":
            lines.append("")
        elif part and part != "\r":
            lines[-1] = part
    return lines


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, to be set [s]."""
    now = [1000.0]
    monkeypatch.setattr(iteration_log.time, "time", lambda: now[0])
    return now


def test_a_pipe_gets_a_line_an_iteration(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], clock: list[float]
) -> None:
    console = Console()
    console.open(tmp_path)
    with console:
        clock[0] += 60.0  # the first iteration compiles
        console.iteration(1, 100, 50, NUMBERS, {"rew_pose": "0.1"}, 1234.5)
        for done in range(2, 62):
            clock[0] += 2.0
            console.iteration(done, 100, 50 if done < 50 else None, NUMBERS, {}, 1234.5)
    first, *_, last = capsys.readouterr().out.splitlines()
    said = "reward 1.23, 0.80 falls a minute, length -, 1,234 steps/s"
    assert first == f"Learning iteration 1/100: {said}, 1:39:00 left, exam in 0:49:00"
    assert last == f"Learning iteration 61/100: {said}, 0:01:18 left"  # at the pace of the last ones, 2 s each
    blocks = (tmp_path / LOG_FILE).read_text()
    assert "# Learning iteration 1/100 #" in blocks and blocks.count("#\n") == 61
    assert "rew_pose: 0.1\n" in blocks and "Time elapsed, left: 0:03:00, 0:01:18\n" in blocks


def test_the_line_of_a_walk_says_what_grows(capsys: pytest.CaptureFixture[str]) -> None:
    """Its reward is clipped at 0 until it walks."""
    Console().iteration(1, 2, None, {**NUMBERS, "walked": 0.344, "terrain_level": 3.14}, {}, 1.0)
    line = capsys.readouterr().out
    assert "walks 34% of the command, 0.80 falls a minute, level 3.1, length -" in line and "reward" not in line


def test_the_time_that_is_left_ends_with_the_deadline(capsys: pytest.CaptureFixture[str], clock: list[float]) -> None:
    console = Console()
    console.deadline = clock[0] + 45.0
    for done in (1, 2):
        clock[0] += 10.0
        console.iteration(done, 3 if done == 2 else 1000, 3 if done == 2 else 20, NUMBERS, {}, 1.0)
    first, second = capsys.readouterr().out.splitlines()
    assert first.endswith(" 0:00:35 left, exam in 0:00:35"), "at the latest then: an exam is no later than the end"
    assert second.endswith(" 0:00:10 left, exam in 0:00:10"), "or when the iterations are done"


def test_verbose_prints_the_block(capsys: pytest.CaptureFixture[str]) -> None:
    Console(verbose=True).iteration(1, 2, None, NUMBERS, {"rew_pose": "0.1"}, 1.0)
    assert re.fullmatch(
        r"#+ Learning iteration 1/2 #+\n +rew_pose: 0.1\n +Time elapsed, left: .*\n", capsys.readouterr().out
    )


def test_a_terminal_keeps_a_bar_below_the_lines(monkeypatch: pytest.MonkeyPatch, clock: list[float]) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stdout", terminal)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    with Console() as console:
        for done in range(1, 11):
            clock[0] += 1.0
            console.iteration(done, 40, 20, NUMBERS, {}, 1.0)
        print("WARNING: above")
        print("", end="")
        *lines, warning, bar = shown(terminal.getvalue())
        assert [line.split(":")[0] for line in lines] == [f"Learning iteration {done}/40" for done in range(1, 11)]
        assert "left" not in lines[-1] and warning == "WARNING: above"
        assert bar == f"{'█' * 10}{'░' * 30}  25%  0:00:30 left  exam in 0:00:10"
    assert sys.stdout is terminal and shown(terminal.getvalue())[-1] == ""


def test_without_a_disk_the_training_goes_on(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    console = Console()
    console.open(tmp_path / "gone")
    console.iteration(1, 2, None, NUMBERS, {}, 1.0)
    warning, line = capsys.readouterr().out.splitlines()
    assert (
        warning == "WARNING: training.log cannot be written (No such file or directory); training continues without it"
    )
    assert line.startswith("Learning iteration 1/2: ")


def test_a_run_has_its_log_and_the_next_exam(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, seconds in (("TRAINING_SECONDS", 0.06), ("TRAINING_SETTLING", 0.02), ("TRAINING_PUSH_AT", 0.02)):
        monkeypatch.setattr(rollout, name, seconds)
    result = run("train", tmp_path, *SMALL, "--max_iterations", "3", "--set", "runner.exam_interval=2")
    assert result.code == 0, result.err
    until = [
        line.rpartition(", ")[2].partition(" in ")[0] for line in result.out.splitlines() if line.startswith("Learning")
    ]
    assert until == ["exam", "exam", "0:00:00 left"] and result.out.count("Exam after iteration ") == 2
    [log] = tmp_path.glob(f"logs/go1_flat/*/{LOG_FILE}")
    assert [line.strip("# ") for line in log.read_text().splitlines() if line.startswith("#")] == [
        *("Learning iteration 1/3", "Learning iteration 2/3", "Exam after iteration 2/3"),
        *("Learning iteration 3/3", "Exam after iteration 3/3"),
    ]
