"""Bad inputs as tables: each ends in one line that says what is wrong, and changes nothing.

What a refusal says stands in tests/golden: add its case there. A test of more than the line calls `attack` itself:

    attack(Case("gamma above 1", program("train", "--check", "--set", "algorithm.gamma=5"), "algorithm.gamma is 5.0"), tmp_path)

``run`` is any function of the test's folder, or `program(...)`: train, play, deploy or robot with its flags, where "ROOT" stands for
that folder; a --task that is not named is go1_flat. It runs in that folder, with its logs below. ``given`` fills the folder before.
A traceback, a second line, a write elsewhere, a changed file, memory beyond 6 GiB, a minute without an end: each fails the test. What
gets past every check, so that training, playing, grading or exporting would begin, fails it too.
"""

from __future__ import annotations

import contextlib
import io
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from program import files, stopped_at_work

from legged_mw import programs
from legged_mw.deploy.controller import limited_memory
from legged_mw.rl import policies, run_folder
from legged_mw.utils.cli import one_line_errors

ROOM, SECONDS = 6 << 30, 60  # what an input may take before it counts as not refused: memory [byte], time [s]
_EVENTS = {  # of Python's audit hooks: which arguments are paths, and whether what stood there is gone afterwards
    **{event: [(0, False)] for event in ("open", "os.mkdir", "os.truncate")},
    **{event: [(0, True)] for event in ("os.remove", "os.rmdir")},
    **{event: [(1, False)] for event in ("os.symlink", "os.link")},
    "os.rename": [(0, True), (1, False)],
}
_watched: list[tuple[str, bool]] | None = None  # (path, gone), while somebody asks


class Case(NamedTuple):
    """One bad input."""

    id: str
    run: Callable[[Path], object]
    says: str | tuple[str, ...] = ""  # what the line holds; tests/golden/errors.txt has that of its cases whole
    code: int = 2
    given: Callable[[Path], object] = lambda root: None
    name: str = "train.py"  # how the line begins; `program` knows it


class Program:
    """A program and its flags; called with the test's folder it runs there."""

    def __init__(self, name: str, flags: tuple[str, ...]) -> None:
        self.name, self.flags = name, flags

    def __call__(self, root: Path) -> None:
        flags = [flag.replace("ROOT", str(root)) for flag in self.flags]
        if self.name in ("train", "play") and "--task" not in flags:
            flags += ["--task", "go1_flat"]
        if self.name in ("train", "play") and "--device" not in flags:
            flags += ["--device", "cpu"]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [f"{self.name}.py", *flags])
            patch.setattr(run_folder, "logs_folder", lambda: root / "logs")
            patch.setattr(policies, "ROOT", root)  # no policy ships there
            programs.PROGRAMS[self.name]()


def program(name: str, *flags: str) -> Callable[[Path], object]:
    """``name`` (train, play, deploy, robot) with its flags, as a user would start it."""
    return Program(name, flags)


def attack(case: Case, root: Path, allowed: tuple[Path, ...] = ()) -> str:
    """Run ``case`` in the folder ``root`` and return its line. ``allowed``: other folders that may be written to."""
    case.given(root)
    before, places = files(root), [root.resolve(), *(path.resolve() for path in allowed)]
    name = f"{case.run.name}.py" if isinstance(case.run, Program) else case.name
    with limits(), contextlib.chdir(root), stopped_at_work(), captured() as said, watched() as written:
        code = ended(case.run, root, name)
    assert code == case.code, f"exit code {code}: {said[0]}"
    assert said[0].endswith("\n") and said[0].count("\n") == 1, said[0]
    assert said[0].startswith(f"{name}: "), said[0]
    assert "out of memory" not in said[0], "it was tried, not refused"
    for text in (case.says,) if isinstance(case.says, str) else case.says:
        assert text in said[0], said[0]
    assert not (strange := [path for path in written if not any(path.is_relative_to(place) for place in places)]), (
        strange
    )
    assert files(root) == before
    return said[0]


def ended(run: Callable[[Path], object], root: Path, name: str) -> object:
    """The exit code of ``run``; errors of the user's are one line, as every program prints them."""
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        with one_line_errors(name):
            run(root)
    except SystemExit as end:
        return end.code
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    return 0


@contextlib.contextmanager
def captured() -> Iterator[list[str]]:
    """The list gets what was written to standard error, by Python or by a library's C code; standard output is dropped."""
    said: list[str] = []
    kept = os.dup(2)
    with tempfile.TemporaryFile("w+b") as file, contextlib.redirect_stdout(io.StringIO()):
        os.dup2(file.fileno(), 2)
        try:
            with (
                open(2, "w", encoding="utf-8", errors="backslashreplace", closefd=False) as stderr,
                contextlib.redirect_stderr(stderr),
            ):
                yield said
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            said.append(file.read().decode(errors="replace"))


@contextlib.contextmanager
def limits() -> Iterator[None]:
    """Memory and time that no refusal needs: what asks for more gets a MemoryError, what never ends a TimeoutError."""

    def late(*_: object) -> None:
        raise TimeoutError(f"not refused within {SECONDS} s")

    was = signal.signal(signal.SIGALRM, late)
    signal.alarm(SECONDS)
    try:
        with limited_memory(ROOM):
            yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, was)


@contextlib.contextmanager
def watched() -> Iterator[list[Path]]:
    """The list gets every path that Python wrote, made, renamed or removed meanwhile; not what came and went, as temporary files do."""
    global _watched
    seen: list[tuple[str, bool]] = []
    paths: list[Path] = []
    _watched = seen
    try:
        yield paths
    finally:
        _watched = None
        made = {path for path, gone in seen if not gone}
        paths += [Path(path).resolve() for path, gone in seen if (path not in made if gone else os.path.lexists(path))]


def _note(event: str, args: tuple[Any, ...]) -> None:
    """Python tells an audit hook of everything that it asks of the file system."""
    if _watched is None or event not in _EVENTS:
        return
    if event == "open" and not (isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
        return
    for i, gone in _EVENTS[event]:
        if not isinstance(args[i], str | bytes | os.PathLike) or (event == "open" and os.path.isdir(args[i])):
            continue  # a descriptor, or a temporary file without a name
        path = os.path.abspath(os.fsdecode(args[i]))
        if "__pycache__" not in path and not path.startswith(("/dev/", "/proc/")):
            _watched.append((path, gone))


sys.addaudithook(_note)  # for good: Python takes none back
