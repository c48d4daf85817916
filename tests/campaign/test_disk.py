"""Disks that fill up, folders that go, writers that fail, consoles that close, hang-ups: training goes on and keeps what it can."""

from __future__ import annotations

import errno
import io
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from program import SMALL, Result, refused, run
from tensorboard.summary.writer.record_writer import RecordWriter
from test_resume import EXACTLY
from torch.utils.tensorboard import SummaryWriter

from legged_mw import ROOT
from legged_mw.rl import run_folder, training
from legged_mw.rl.ranks import Rank
from legged_mw.rl.run_folder import LOCK_FILE, CheckpointWriter, RunLock, checkpoints
from legged_mw.rl.runner import Runner
from legged_mw.utils.cli import SafeStream
from legged_mw.utils.config import ConfigError

RUN = ["--seed", "1", "--eager", "--set", "runner.save_interval=1", "--set", "cpu.update_threads=1"]
GO_ON = ["--task", "go1_flat", "--device", "cpu", "--resume"]


def train(root: Path, iterations: int, *flags: str) -> Result:
    return run("train", root, *SMALL, *RUN, "--max_iterations", str(iterations), *flags)


def only_run(root: Path) -> Path:
    [folder] = root.glob("logs/go1_flat/*")
    return folder


def before_iteration(patch: pytest.MonkeyPatch, do: Callable[[Runner, int], object]) -> None:
    """Call ``do`` with the number of each iteration, before it begins."""
    update = Runner._update

    def then_update(self: Runner) -> Any:
        do(self, self.current_learning_iteration + 1)
        return update(self)

    patch.setattr(Runner, "_update", then_update)


def sound(folder: Path) -> list[int]:
    """Iterations of the run's checkpoints, each of them whole."""
    for iteration, path in checkpoints(folder).items():
        assert torch.load(path, weights_only=True)["iter"] == iteration
    return list(checkpoints(folder))


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EROFS])
def test_a_checkpoint_that_cannot_be_written_is_said_and_the_next_one_tried(
    code: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    replace, fails = os.replace, {"model_2.pt", "worlds_3.pt"}

    def fail(source: Path, target: Path) -> None:
        if Path(target).name in fails:
            raise OSError(code, os.strerror(code))
        replace(source, target)

    monkeypatch.setattr(run_folder.os, "replace", fail)
    worlds = list[list[str]]()
    before_iteration(monkeypatch, lambda *_: worlds.append([path.name for path in only_run(tmp_path).glob("worlds_*")]))
    result = train(tmp_path, 4)
    assert result.code == 0, result
    assert worlds == [[], ["worlds_1.pt"], ["worlds_1.pt"], []], "those of a checkpoint that could not be written go"
    assert f"WARNING: checkpoint model_2.pt cannot be written: {os.strerror(code)}; the newest is " in result.out
    assert (
        f"WARNING: worlds_3.pt cannot be written: {os.strerror(code)}; from model_3.pt worlds begin anew" in result.out
    )
    assert sound(only_run(tmp_path)) == [1, 3, 4]
    assert sorted(path.name for path in only_run(tmp_path).glob("[.w]*.*")) == ["worlds_4.pt"]  # nothing half written


def test_a_full_disk_keeps_the_newest_that_could_be_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of checkpoints end after 4 kB; curves cannot be written either."""

    class Full(io.FileIO):
        def write(self, content: Any) -> int:
            super().write(content[:4096])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fill(_: Runner, iteration: int) -> None:
        if iteration == 3:
            monkeypatch.setattr(run_folder, "open", lambda path, mode: Full(path, mode), raising=False)
            monkeypatch.setattr(RecordWriter, "write", lambda *_: Full(tmp_path / "curve", "wb").write(b""))

    before_iteration(monkeypatch, fill)
    result = train(tmp_path, 4)
    assert result.code == 2 and "done: " not in result.out and "stopped: " not in result.out
    folder = only_run(tmp_path)
    said = "the last checkpoint, of iteration 4, cannot be written to"
    assert (
        said in result.err
        and "No space left on device; the newest that is written is " in result.err
        and "model_2.pt" in result.err
    )
    assert result.err.count("\n") == 1, result.err
    assert sound(folder) == [1, 2] and not list(folder.glob(".*.tmp"))
    monkeypatch.undo()
    resumed = run("train", tmp_path, *GO_ON)
    assert resumed.code == 0 and EXACTLY in resumed.out and sound(folder) == [1, 2, 3, 4]


def test_a_folder_that_is_deleted_is_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before_iteration(monkeypatch, lambda self, i: i == 3 and shutil.rmtree(self.writer.folder))  # type: ignore[union-attr]
    result = train(tmp_path, 4)
    folder = only_run(tmp_path)
    assert result.code == 0 and sound(folder) == [3, 4] and (folder / "config.yaml").is_file()
    assert list(folder.glob("events*"))  # curves go on there
    monkeypatch.undo()
    resumed = run("train", tmp_path, *GO_ON, "--max_iterations", "5")
    assert resumed.code == 0 and EXACTLY in resumed.out


def test_curves_that_cannot_be_written_end_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    add, failing = SummaryWriter.add_scalar, []

    def fail(self: SummaryWriter, name: str, value: float, step: int) -> None:
        if step == 2:
            failing.append(name)
            raise RuntimeError("the service says no")
        add(self, name, value, step)

    monkeypatch.setattr(SummaryWriter, "add_scalar", fail)
    result = train(tmp_path, 3)
    assert result.code == 0 and len(failing) == 1, result
    assert "WARNING: no curves until the next checkpoint, they cannot be written: the service says no" in result.out
    assert len(list(only_run(tmp_path).glob("events*"))) == 2  # opened again


def test_a_logger_that_does_not_start_ends_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise ConnectionError("no route")

    monkeypatch.setattr(SummaryWriter, "__init__", refuse)
    result = train(tmp_path, 2)
    assert (
        result.code == 0
        and result.out.count("they cannot be written: no route") == 3
        and sound(only_run(tmp_path)) == [1, 2]
    )


def test_what_nobody_reads_is_lost(tmp_path: Path) -> None:
    """The pipe to a pager that was closed; then even the end of the program finds nothing wrong."""
    program = "import sys\nfrom legged_mw.utils.cli import patient_console\nwith patient_console():\n"
    program += (
        "    for i in range(20000):\n        print('a line', i)\n    open(sys.argv[1], 'w').write('got to its end')"
    )
    command = [sys.executable, "-c", program, str(tmp_path / "end")]
    child = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert child.stdout and child.stderr and child.stdout.readline() == "a line 0\n"
    child.stdout.close()
    assert child.wait(60) == 0 and not child.stderr.read()
    assert (tmp_path / "end").read_text() == "got to its end"


def test_a_line_that_does_not_fit_is_lost_and_the_next_one_is_not() -> None:
    class Full:
        text = ""

        def write(self, text: str) -> int:
            if "full" in text:
                raise OSError(errno.ENOSPC, "No space left on device")
            self.text += text
            return len(text)

        def flush(self) -> None:
            raise ValueError("I/O operation on closed file")

    stream = Full()
    for text in ("one\n", "full\n", "two\n"):
        print(text, end="", file=SafeStream(stream), flush=True)  # type: ignore[arg-type]
    assert stream.text == "one\ntwo\n"


def test_a_signal_ends_the_run_after_the_iteration_and_resumes_exactly(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hang-up comes twice: from the shell, and from the system."""
    before_iteration(monkeypatch, lambda _, i: i == 2 and [os.kill(os.getpid(), signal.SIGHUP) for _ in range(2)])
    result = train(tmp_path, 4)
    assert result.code == 3 and "stopped: SIGHUP; go on with" in result.out, result
    assert sound(only_run(tmp_path)) == [1, 2]
    monkeypatch.undo()
    resumed = run("train", tmp_path, *GO_ON)
    assert resumed.code == 0 and EXACTLY in resumed.out and sound(only_run(tmp_path)) == [1, 2, 3, 4]


def test_a_hang_up_that_is_ignored_stays_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As under nohup."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        before_iteration(monkeypatch, lambda _, i: i == 1 and os.kill(os.getpid(), signal.SIGHUP))
        assert train(tmp_path, 2).code == 0
    finally:
        signal.signal(signal.SIGHUP, before)


def test_old_checkpoints_are_thinned(tmp_path: Path) -> None:
    assert train(tmp_path, 5, "--set", "runner.keep_checkpoints=2").code == 0
    assert sound(only_run(tmp_path)) == [4, 5]
    refused(tmp_path, "train", *SMALL, "--set", "runner.keep_checkpoints=-1")


def test_worlds_of_a_rank_stay_until_the_first_one_has_written_the_checkpoint(tmp_path: Path) -> None:
    """Else a kill in between would leave the newest checkpoint without them."""
    follower, first = (CheckpointWriter(tmp_path, 0, Rank(index, index, 2)) for index in (1, 0))

    def write(writer: CheckpointWriter, iteration: int) -> set[str]:
        assert writer.write(iteration, dict, dict)
        return {path.name for path in tmp_path.glob("worlds_*.pt")}

    assert write(first, 1) | write(follower, 1) == {"worlds_1_0of2.pt", "worlds_1_1of2.pt"}
    assert write(follower, 2) == {"worlds_1_0of2.pt", "worlds_1_1of2.pt", "worlds_2_1of2.pt"}
    assert write(first, 2) == {"worlds_1_1of2.pt", "worlds_2_0of2.pt", "worlds_2_1of2.pt"}
    assert write(follower, 3) == {"worlds_2_0of2.pt", "worlds_2_1of2.pt", "worlds_3_1of2.pt"}


def test_worlds_of_another_number_of_processes_go(tmp_path: Path) -> None:
    """Once a checkpoint after them is whole, which the first process alone knows."""
    for name in ("worlds_1.pt", "worlds_2_0of3.pt", "worlds_2_11of12.pt", "worlds_9_0of3.pt", "worlds_of_mine.pt"):
        (tmp_path / name).touch()
    follower, first, alone = (CheckpointWriter(tmp_path, 0, Rank(*rank)) for rank in ((1, 1, 2), (0, 0, 2), (0, 0, 1)))
    for writer, iteration, stay in (
        (follower, 3, {"worlds_1.pt", "worlds_2_0of3.pt", "worlds_2_11of12.pt", "worlds_3_1of2.pt"}),
        (first, 3, {"worlds_3_0of2.pt", "worlds_3_1of2.pt"}),
        (alone, 4, {"worlds_4.pt"}),
    ):
        assert writer.write(iteration, dict, dict)
        assert {path.name for path in tmp_path.glob("worlds_*")} == {*stay, "worlds_9_0of3.pt", "worlds_of_mine.pt"}


def test_logs_that_cannot_be_written_are_refused_before_training(tmp_path: Path) -> None:
    (tmp_path / "logs").write_text("a file")
    result = train(tmp_path, 2)
    assert result.code == 2 and result.err.count("\n") == 1 and "logs" in result.err, result.err


# ---- one process a run


def test_a_run_that_is_being_trained_is_not_resumed(tmp_path: Path) -> None:
    assert train(tmp_path, 2).code == 0
    folder = only_run(tmp_path)
    (folder / ".model_9.pt.999999999.tmp").write_text("half")
    go_on = [*GO_ON, "--max_iterations", "4"]
    with RunLock(folder) as lock:
        lock.begin()
        line = refused(tmp_path, "train", *go_on)
        assert (
            f" is being trained by process {os.getpid()} since 20" in line
            and "; wait for its end, stop it, or name another run" in line
        )
        other = run("train", tmp_path, *go_on, "--checkpoint", "1")  # begins a run of its own
        assert other.code == 0, other.err
    assert run("train", tmp_path, *go_on, "--load_run", folder.name).code == 0
    assert sound(folder) == [1, 2, 3, 4] and not list(folder.glob(".*.tmp"))  # what a kill left is swept


def test_a_lock_ends_with_its_process(tmp_path: Path) -> None:
    program = "import sys, time\nfrom pathlib import Path\nfrom legged_mw.rl.run_folder import RunLock\n"
    program += "lock = RunLock(Path(sys.argv[1]))\nlock.begin()\nprint(1, flush=True)\ntime.sleep(60)"
    child = subprocess.Popen(
        [sys.executable, "-c", program, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert child.stdout and child.stdout.readline() == "1\n"
    with pytest.raises(ConfigError, match=f"is being trained by process {child.pid} since"):
        RunLock(tmp_path)
    child.kill()
    child.wait()
    RunLock(tmp_path).release()
    assert (tmp_path / LOCK_FILE).is_file()


def test_a_resume_whose_checkpoint_is_not_the_newest_any_more_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process went on and ended while this one made its worlds."""
    assert train(tmp_path, 2).code == 0
    folder = only_run(tmp_path)

    def never(*_: object) -> bool:
        raise AssertionError

    monkeypatch.setattr(CheckpointWriter, "write", never)
    build = training.build

    def slow_build(*args: Any) -> Any:
        shutil.copy(folder / "model_2.pt", folder / "model_3.pt")
        return build(*args)

    monkeypatch.setattr(training, "build", slow_build)
    result = run("train", tmp_path, *GO_ON, "--max_iterations", "4")
    assert result.code == 2 and "has gone on since this began" in result.err, result
