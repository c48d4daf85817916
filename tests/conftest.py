"""Shared by all tests: one torch thread; tests that need a GPU or a screen are left out where there is none."""

# ruff: noqa: E402
from legged_mw.programs import start_quickly
from legged_mw.utils.machine import settle

start_quickly()  # before torch, as train.py does

import gc
import shutil
import signal
from collections.abc import Callable, Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch
from onnxscript._framework_apis import torch_2_5 as onnxscript_for_torch
from program import trained

from legged_mw.sim.terrain import KINDS, LEVEL, MEASURES
from legged_mw.view.native import has_display

# The exporter looks at each of the 500 functions that it can write, at every export: once a process is enough.
onnxscript_for_torch.get_torchlib_ops = cache(onnxscript_for_torch.get_torchlib_ops)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--rewrite",
        action="store_true",
        help="write tests/golden/errors.txt anew; prints the raises that no case reaches",
    )
    parser.addoption("--all", action="store_true", help="run the files of LONGEST too")


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.getoption("--rewrite"):
        from golden.table import unreached

        terminalreporter.write_line("\n".join(["raises that no case reaches:", *unreached()]))


def pytest_collection_finish(session: pytest.Session) -> None:
    settle()  # what is imported by now stays
    gc.set_threshold(50_000, 20, 50)  # what tests leave is little, and to look for it took 5 % of their time


def pytest_configure(config: pytest.Config) -> None:
    torch.set_num_threads(1)  # hundreds of small operations a step stall on a second thread
    # `make test &` ignores it, and so would programs that tests end
    signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # likewise `nohup make test`


def has_browser() -> bool:
    """Whether Chromium is there, and what drives it."""
    return shutil.which("chromium") is not None and find_spec("playwright") is not None


LONG = ("test_suite", "test_error_lines", "test_tutorial", "test_unitree_guard", "test_your_own_robot", "test_ranks")
# over a third of the time, of whole programs and campaigns: run with --all, or by name
LONGEST = (
    *("campaign", "test_compare", "test_crossing", "test_error_lines", "test_estimator", "test_first_walk"),
    *("test_from_legged_gym", "test_gate", "test_memory", "test_ranks", "test_teacher", "test_tutorial"),
    *("test_unitree_faults", "test_unitree_guard", "test_unitree_robot", "test_user_scene", "test_without"),
    "test_your_own_robot",
)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Deselect, not skip: `pytest -m gpu` on a machine without a GPU then says that nothing ran.

    Files that take half a minute and more come first, or at the end one core waits for the other.
    """

    def leave_out(these: Callable[[pytest.Item], object]) -> None:
        without = [item for item in items if these(item)]
        config.hook.pytest_deselected(items=without)
        items[:] = [item for item in items if item not in without]

    items.sort(key=lambda item: item.path.stem not in LONG)
    if not config.getoption("--all"):
        here = Path(__file__).parent
        named = {Path(arg.partition("::")[0]).resolve() for arg in config.args} - {here}
        leave_out(
            lambda item: (
                {item.path.stem, item.path.parent.name} & {*LONGEST} and not {item.path, item.path.parent} & named
            )
        )
    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    for mark, present in (
        ("gpu", gpus > 0),
        ("two_gpus", gpus > 1),
        ("display", has_display()),
        ("browser", has_browser()),
    ):
        if not present:
            leave_out(lambda item, mark=mark: item.get_closest_marker(mark))


@pytest.fixture(params=["cpu", pytest.param("cuda:0", marks=pytest.mark.gpu)])
def device(request: pytest.FixtureRequest) -> str:
    """The test runs on a CPU, and again on a GPU where there is one."""
    return request.param


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The export of a finished training of two iterations, in its run's folder: to look at, not to change."""
    return trained(tmp_path_factory.mktemp("made"), "--max_iterations", "2", "--set", "runner.export=true") / "export"


@pytest.fixture(autouse=True)
def precision() -> Iterator[None]:
    """A runner sets the precision of matrix products for its whole process: the next test begins with torch's own."""
    yield
    torch.set_float32_matmul_precision("highest")


@pytest.fixture
def double() -> Iterator[None]:
    """New tensors are float64: what differs then is not the rounding of sums."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.fixture
def own_kinds() -> Iterator[None]:
    """Kinds of ground that a test adds are gone after it."""
    tables = (KINDS, MEASURES, LEVEL)
    before = [table.copy() for table in tables]
    yield
    for table, kept in zip(tables, before, strict=True):
        table.clear()
        table.update(kept)  # type: ignore[arg-type]
