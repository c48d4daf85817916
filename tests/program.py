"""train.py and play.py run inside the test process, with logs/ in a folder of the test's: an import costs seconds, a run does not."""

from __future__ import annotations

import contextlib
import io
import signal
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch

from legged_mw import programs
from legged_mw.check import guard
from legged_mw.eval import exams
from legged_mw.rl import policies, run_folder
from legged_mw.rl.runner import Runner
from legged_mw.utils.task import LoadedTask
from legged_mw.view import launch

# A task small enough that an iteration takes milliseconds; episodes short enough that some end in each.
SMALL = [
    *("--task", "go1_flat", "--num_envs", "16", "--device", "cpu"),
    *("--set", "actor.hidden_dims=[16, 16]", "--set", "critic.hidden_dims=[16, 16]"),
    *("--set", "runner.num_steps_per_env=8", "--set", "env.episode_length_s=0.4"),
    *("--set", "runner.export=false"),  # takes as long as the training
]


def load(path: Path) -> dict[str, Any]:
    return torch.load(path, weights_only=True)


def assert_equal(a: Any, b: Any, where: str = "") -> None:
    """Nested dicts, lists and tensors, bit for bit; NaN is equal to NaN."""
    assert type(a) is type(b), where
    if isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_equal(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_equal(x, y, f"{where}[{i}]")
    elif isinstance(a, torch.Tensor):
        torch.testing.assert_close(a, b, rtol=0, atol=0, equal_nan=True, msg=where)
    else:
        assert a == b, where


class Result(NamedTuple):
    code: int
    out: str
    err: str


check_recordable, passed = guard.check_recordable, dict[tuple[type, str], str]()


def guarded_once(task: LoadedTask) -> str:
    """A step that has passed the guard is not stepped again: its class and the tiny config are all that the guard sees."""
    key = task.env_class, repr(guard.tiny_cfg(task.cfg).to_dict())
    if key not in passed:
        passed[key] = check_recordable(task)
    return passed[key]


def run(program: str, root: Path, *args: str) -> Result:
    """As ``python <program>.py <args>`` would, but below ``root``; a traceback is raised, as no user should see one."""
    out, err, code = io.StringIO(), io.StringIO(), 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.setattr(sys, "argv", [f"{program}.py", *args])
        patch.setattr(run_folder, "logs_folder", lambda: root / "logs")
        patch.setattr(policies, "ROOT", root)  # no policy ships there
        if guard.check_recordable is check_recordable:  # not a test's own
            patch.setattr(guard, "check_recordable", guarded_once)
        try:
            programs.PROGRAMS[program]()
        except SystemExit as end:
            assert isinstance(end.code, int)
            code = end.code
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)
    return Result(code, out.getvalue(), err.getvalue())


def trained(root: Path, *args: str, prints: tuple[str, ...] = ()) -> Path:
    """Train the small task below ``root`` and return its run folder. ``prints``: what the output must hold."""
    before = set(root.glob("logs/*/*"))
    result = run("train", root, *SMALL, *args)
    assert result.code == 0 and all(text in result.out for text in prints), result.err
    [folder] = set(root.glob("logs/*/*")) - before
    return folder


def files(root: Path) -> dict[str, bytes]:
    """All but what Python keeps of the modules that it has compiled."""
    found = [path for path in sorted(root.rglob("*")) if path.is_file() and "__pycache__" not in path.parts]
    return {str(path.relative_to(root)): path.read_bytes() for path in found}


@contextlib.contextmanager
def stopped_at_work() -> Iterator[None]:
    """What is refused never comes to train, play, grade or export, which would run for minutes: here that is an error."""

    def begin(*_: object, **__: object) -> None:
        raise AssertionError("it was not refused")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runner, "learn", begin)
        for owner, name in ((launch, "watch"), (exams, "make_column"), (programs, "export")):
            patch.setattr(owner, name, begin)
        yield


def refused(root: Path, program: str, *args: str) -> str:
    """The one line that ``program`` ends with; nothing may have been written."""
    before = files(root)
    with stopped_at_work():
        result = run(program, root, *args)
    assert result.code == 2, result
    assert files(root) == before
    assert result.err.endswith("\n") and result.err.count("\n") == 1, result.err
    assert result.err.startswith(f"{program}.py: ")
    return result.err
