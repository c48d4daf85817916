"""A table of bad inputs, and the line that each of them meets."""

from __future__ import annotations

import ast
import contextlib
import re
import shutil
import socket
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from attack import Case, Program, captured, ended, limits, program, watched
from program import files, stopped_at_work

import legged_mw
from legged_mw import ROOT
from legged_mw.utils.errors import UserError, printable

Run = Callable[[Path], object]
PACKAGE = Path(legged_mw.__file__).parent
made_run: list[Path] = []  # the folder of a finished training
VARIES = {  # in a line, by machine or moment
    r"0x[0-9a-f]{8,}": "<address>",
    r"\b[0-9a-f]{8}\.\.\.": "<digest>...",
    r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d": "<now>",
    r"is \S+ in the environment and \S+ by": "is <x> in the environment and <y> by",
    r"(up to|by|turns at|bodies are) -?\d+\.[\d.e-]+( apart|%| rad/s, more| m from)": r"\1 <x>\2",
}
reached: set[tuple[str, int]] = set()  # (file, line) of the package on the way to an error, of all cases so far


class Table:
    """The cases of an area by name. A case is a function of a folder of its own, which is where it runs."""

    def __init__(self, fill: Run = lambda root: None) -> None:
        self.cases: dict[str, Case] = {}
        self.fill = fill  # the folder before each case

    def add(self, name: str, run: Run, given: Run = lambda root: None) -> None:
        assert name not in self.cases, f"two cases are called {name!r}"
        self.cases[name] = Case(name, run, "", given=given)

    def __call__(self, function: Run) -> Run:
        """A decorator: the function's name, in words, is the case's."""
        self.add(function.__name__.replace("_", " ").strip(), function)
        return function

    def programs(
        self, program_name: str, flags: Iterable[str | list[str]], given: Run = lambda root: None, name: str = ""
    ) -> None:
        """A case for each line of flags; ROOT stands for the folder, and the task of train and play is go1_flat if none is named."""
        for line in flags:
            words = line.split() if isinstance(line, str) else line
            said = " ".join(words).replace(str(ROOT), "<root>")
            self.add(name or f"{program_name} {said[:120]}".strip(), program(program_name, *words), given)

    def calls(self, rows: Mapping[str, Callable[[], object]]) -> None:
        """A case for each function without arguments."""
        for name, call in rows.items():
            self.add(name, lambda root, call=call: call())

    def campaign(self, group: str, cases: Iterable[Case], given: Run = lambda root: None) -> None:
        """Cases of a table of tests/campaign."""
        for case in cases:
            name = f"{group}: {case.id}".removeprefix(": ")
            self.add(
                name if name not in self.cases else f"{name} ({len(self.cases)})",
                case.run,
                lambda root, case=case: (given(root), case.given(root)),
            )


def given_run(root: Path) -> Path:
    """A run of two iterations, logs/go1_flat/run, that the case may change."""
    return Path(shutil.copytree(made_run[0], root / "logs/go1_flat/run", ignore=shutil.ignore_patterns("export")))


def patched(run: Run, owner: Any, **values: Any) -> Run:
    """``run`` while attributes of ``owner`` have other values."""

    def with_them(root: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            for name, value in values.items():
                patch.setattr(owner, name, value)
            run(root)

    return with_them


def without(module: str, run: Run) -> Run:
    """``run`` where a module is not installed."""

    def bare(root: Path) -> None:
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(sys.modules, module, None)  # type: ignore[arg-type]
            run(root)

    return bare


class Met(NamedTuple):
    kind: str
    line: str


def meet(case: Case, root: Path, fill: Run) -> Met:
    """Run a case. It must end in one line, which paints no terminal, and change no file."""
    caught: list[BaseException] = []
    sayer = f"{case.run.name}.py" if isinstance(case.run, Program) else "golden"

    def run(root: Path) -> None:
        try:
            case.run(root)
        except BaseException as error:
            caught.append(error)
            raise

    with contextlib.chdir(root):
        fill(root)
        case.given(root)
        before = files(root)
        with (
            pytest.MonkeyPatch.context() as patch,
            limits(),
            stopped_at_work(),
            captured() as said,
            watched() as written,
        ):
            for name in ("DISPLAY", "WAYLAND_DISPLAY"):
                patch.delenv(name, raising=False)
            patch.setattr(torch.cuda, "device_count", lambda: 0)
            patch.setattr(socket, "if_nameindex", lambda: [(1, "lo"), (2, "eth0")])
            code = ended(run, root, sayer)
    assert code == 2, f"{case.id}: it was not refused: {said[0]}"
    assert said[0].endswith("\n") and said[0][:-1].isprintable(), f"{case.id}: {said[0]}"
    if sayer in ("train.py", "play.py"):
        assert said[0].startswith(f"{sayer}: "), f"{case.id}: {said[0]}"
    assert not (strange := [path for path in written if not path.is_relative_to(root.resolve())]), (
        f"{case.id}: wrote {strange}"
    )
    assert files(root) == before, f"{case.id}: a file was changed"
    assert "it was not refused" not in said[0], f"{case.id}: {said[0]}"
    every = list(chain(caught[0]))
    reached.update(place for error in every for place in places(error))
    users = [error for error in every if isinstance(error, UserError)]
    others = [
        error for error in every if not isinstance(error, SystemExit) and "argparse" not in type(error).__module__
    ]
    kind = type((users or others)[0]).__name__ if users or others else "usage"
    return Met(kind, plain(said[0], root).partition(": ")[2])


def chain(error: BaseException | None) -> Iterator[BaseException]:
    """An error, and what it came from."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def places(error: BaseException) -> Iterator[tuple[str, int]]:
    """Lines of the package that an error passed."""
    trace = error.__traceback__
    while trace is not None:
        file = Path(trace.tb_frame.f_code.co_filename)
        if file.is_relative_to(PACKAGE):
            yield str(file.relative_to(PACKAGE)), trace.tb_lineno
        trace = trace.tb_next


def plain(text: str, root: Path) -> str:
    """A line without what differs by machine or moment."""
    for place, name in ((root.resolve(), "<tmp>"), (root, "<tmp>"), (root.parent, "<tmp>/.."), (ROOT, "<root>")):
        text = text.replace(str(place), name)
    text = re.sub(r"'[^']*pytest-of-[^']*'", "'<tmp>...'", text)  # a path that an error cuts short
    for pattern, name in VARIES.items():
        text = re.sub(pattern, name, text)
    text = re.sub(r"(<root>/(?:legged_mw|tests)/[\w/]+\.py):\d+", r"\1:<line>", text)
    text = re.sub(r" \(choose from .*\)", " (choose from ...)", text)  # as Python's versions say otherwise
    return text.strip()


def lines(area: str, table: Table, folder: Path) -> Iterator[str]:
    """A line for each case, sorted as errors.txt is."""
    for number, (name, case) in enumerate(sorted(table.cases.items())):
        root = folder / str(number)
        root.mkdir()
        kind, line = meet(case, root, table.fill)
        yield printable(f"{area}/{name}  {kind}: {line}")


BEYOND = {  # raises that no case can come to, or none that is cheap: file -> why
    "unitree/codec.py": "a message of another size: the wire drops it before",
    "unitree/guard.py": "needs a guard process: tests/test_unitree_guard.py",
    "unitree/link.py": "needs a wire",
    "envs/base_task.py": "a mistake of a program's, not of a user's",
    "eval/rollout.py": "a mistake of a program's, not of a user's",
    "rl/training.py": "ends a training that has begun: tests/campaign/test_disk.py, tests/test_ranks.py",
    "fast/step_compiler.py": "is caught, and the step is recorded without",
    "sim/graph.py": "needs a GPU",
    "sim/warp_engine.py": "as of the other engine",
    "tools/completion.py": "a mistake of a program's, not of a user's",
    "utils/yaml_file.py": "is caught there, and said with file and line: area yaml_files",
    "view/drive.py": "a mistake of a program's, not of a user's",
    "view/overlay.py": "a mistake of a program's, not of a user's",
    "view/posed_robot.py": "a mistake of a program's, not of a user's",
    "view/recorder.py": "a mistake of a program's, not of a user's",
    "view/web.py": "needs a page that is served: tests/test_drive.py",
}


def unreached() -> Iterator[str]:
    """Raises of the package that no case came to, as ``file:line Error``, but for those of BEYOND; then how many there are in all."""
    count, found = 0, 0
    for file in sorted(PACKAGE.rglob("*.py")):
        name = str(file.relative_to(PACKAGE))
        for node in ast.walk(ast.parse(file.read_text())):
            if error := raised(node):
                span = range(node.lineno, (node.end_lineno or node.lineno) + 1)  # type: ignore[attr-defined]
                count += 1
                if any((name, line) in reached for line in span):
                    found += 1
                elif name not in BEYOND:
                    yield f"{name}:{node.lineno} {error}"  # type: ignore[attr-defined]
    yield f"{found} of {count} are reached"


def raised(node: Any) -> str:
    """The error that a statement raises for a user, by its name; "" for any other."""
    if isinstance(node, ast.Raise) and node.exc is not None:
        what = node.exc.func if isinstance(node.exc, ast.Call) else node.exc
        name = ast.unparse(what)
        return (
            ""
            if name in ("SystemExit", "NotImplementedError", "KeyboardInterrupt", "AttributeError", "Unfit", "_Caught")
            else name
        )
    if (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Call)
        and ast.unparse(node.value.func) in ("parser.error", "check.fail")
    ):
        return "usage"
    return ""
