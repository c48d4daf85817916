"""Which code is run, and which links are followed, of what a stranger gave us; tests/golden/strangers.py has what is refused."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from attack import Case, attack, program
from golden.strangers import RUN, given_run
from program import run

from legged_mw.utils.files import check_folder

CODE = "import pathlib\npathlib.Path('pwned').touch()\nfrom configs.go1_flat import TASK\nTASK = TASK\n"

# an archive without logs; one that lies in our own logs
BEST, UNPACKED = "walker/best", "logs/walker/logs/go1_flat/run"
# what a run's config may name -> (the run, where the code lies, what the config says; the program, if not play)
WAYS = {
    "beside the run": (BEST, "walker/code.py", "code.py"),
    "exported": (BEST, "walker/code.py", "code.py", "play", "--export", "ROOT/out", "--load_run"),
    "graded": (BEST, "walker/code.py", "code.py", "play", "--eval", "--load_run"),
    "resumed": (BEST, "walker/code.py", "code.py", "train", "--resume", "--load_run"),
    "a start of a task that is named": (BEST, "walker/code.py", "code.py", "train", "--check", "--task", "go1_flat", "--init"),
    "a teacher of a task that is named": (BEST, "walker/code.py", "code.py", "train", "--check", "--task", "go1_flat", "--teacher"),
    "an absolute path": (BEST, "walker/code.py", "ROOT/walker/code.py"),
    "upwards": (BEST, "walker/code.py", "../../../../../../../../../../../..ROOT/walker/code.py"),
    "beside the logs": (RUN, "gift/code.py", "code.py"),
    "in a sister folder": (RUN, "gift/tasks/code.py", "tasks/code.py"),
    "below our own logs": (UNPACKED, "logs/walker/code.py", "code.py"),
    "in the current folder": (RUN, "code.py", "code.py"),
    "in the run": (RUN, f"{RUN}/code.py", "run/code.py"),
    "in its logs": (RUN, "gift/logs/code.py", "code.py"),
    "in an export": (f"{RUN}/export", f"{RUN}/export/code.py", "export/code.py"),
    "a link": (RUN, f"{RUN}/code.txt", "code.py"),
    "a link that is called examples": (RUN, f"{RUN}/code.py", "examples/code.py"),
    "a module": (BEST, "walker/code.py", "walker.code"),
    "a path without .py": (BEST, "walker/code.py", "../walker/code"),
    "a shell's command": (BEST, "walker/code.py; touch pwned #.py", "code.py; touch pwned #.py"),
}  # fmt: skip


@pytest.mark.parametrize("way", WAYS)
def test_a_run_decides_no_code(way: str, tmp_path: Path) -> None:
    """Which Python is run is what --task names, or the project's own; the line to type is as a shell may be given it."""
    folder, place, stored, *flags = (each.replace("ROOT", str(tmp_path)) for each in WAYS[way])
    given_run(tmp_path, folder.removesuffix("/export"))
    (tmp_path / place).parent.mkdir(exist_ok=True)
    (tmp_path / place).write_text(CODE)
    (tmp_path / "examples").symlink_to(tmp_path / RUN)
    if way == "a link":
        (tmp_path / "gift/code.py").symlink_to(tmp_path / place)
    file = tmp_path / folder / "config.yaml"
    file.write_text(file.read_text().replace("task: go1_flat\n", f"task: '{stored}'\n"))
    name, *flags = flags or ["play", "--load_run"]
    task = [] if "--task" in flags else ["--task", ""]
    is_file = stored.endswith(".py")
    line = attack(
        Case(way, program(name, *task, *flags, folder), "somebody's code" if is_file else "no task"), tmp_path
    )
    assert not is_file or f"--task {shlex.quote(stored)}" in line
    assert not list(tmp_path.rglob("pwned"))


def test_a_file_that_is_named_runs_and_is_printed_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trap works: by --task the same file runs."""
    (tmp_path / "code.py").write_text("print('runs')\n" + CODE)
    monkeypatch.chdir(tmp_path)
    done = run("train", tmp_path, "--task", "code.py", "--check", "--eager", "--num_envs", "1", "--device", "cpu")
    assert (
        done.code == 0 and done.out.splitlines()[:2] == ["task: code.py", "runs"] and (tmp_path / "pwned").exists()
    ), done
    assert done.out.count("task: ") == 1


def test_links_that_stay_in_a_run_are_its_own(tmp_path: Path) -> None:
    """A run may hold links to its own files, be one itself, and lie behind one."""
    given_run(tmp_path)
    (tmp_path / RUN / "best.pt").symlink_to("model_2.pt")
    (tmp_path / RUN / "loop").symlink_to("loop")
    (tmp_path / "behind").symlink_to(RUN)
    assert check_folder(tmp_path / "behind") == tmp_path / "behind"
