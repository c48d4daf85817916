"""The guard: each forbidden call is caught, what a step is made of passes, and a task's mistake is named by file, line and method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from golden.own_code import ANNEAL, END_STEP, INIT, REWARD, TABLE, watched_task
from torch import Tensor

from legged_mw.check.guard import check_recordable, not_remembered
from legged_mw.check.recordable import recordable
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import NotRecordable
from legged_mw.utils.task import load_task

X = torch.arange(6.0).view(2, 3)
MASK = X > 2.0
ROWS = torch.tensor([True, False])
ONE, PICK = torch.tensor(1), torch.tensor([0, 2])
ARRAY = np.ones(3, dtype=np.float32)


def _set(key: object, value: Tensor | float) -> Callable[[], None]:
    return lambda: X.clone().__setitem__(key, value)


HOST_READS: dict[str, Callable[[], object]] = {
    "item": lambda: X[0, 0].item(),
    "tolist": lambda: X.tolist(),
    "cpu": lambda: X.cpu(),
    "numpy": lambda: X.numpy(),
    "np.asarray": lambda: np.asarray(X),
    "np.from_dlpack": lambda: np.from_dlpack(X),  # pyright: ignore[reportArgumentType]
    "bool": lambda: bool(ONE),
    "if": lambda: 1 if ONE else 2,
    "not": lambda: not ONE,
    "int": lambda: int(ONE),
    "float": lambda: float(ONE),
    "complex": lambda: complex(ONE),
    "range": lambda: range(ONE),  # pyright: ignore[reportArgumentType]
    "max": lambda: max(ONE, ONE),
    "in": lambda: 1.0 in X,
    "repr": lambda: repr(X),
    "str": lambda: str(X),
    "f-string": lambda: f"{X}",
    "index by a scalar tensor": lambda: X[ONE],
    "column by a scalar tensor": lambda: X[:, ONE],
    "assign to a column by a scalar tensor": _set((slice(None), ONE), 0.0),
    "slice by a tensor": lambda: X[:ONE],
    "full of a tensor": lambda: torch.full((2,), ONE, device="cpu"),  # pyright: ignore[reportArgumentType]
    "tensor as alpha": lambda: torch.add(X, X, alpha=ONE),  # pyright: ignore[reportArgumentType]
    "is_nonzero": lambda: torch.is_nonzero(ONE),
    "equal": lambda: torch.equal(X, X),
    "allclose": lambda: torch.allclose(X, X),
    "bincount": lambda: torch.bincount(PICK),
    "histc": lambda: torch.histc(X),
    "multinomial": lambda: torch.multinomial(X + 1.0, 1),
    "eigh": lambda: torch.linalg.eigh(X[:, :2]),
    "svd": lambda: torch.linalg.svd(X),
    "lstsq": lambda: torch.linalg.lstsq(X[:, :2], X),
    "inv": lambda: torch.linalg.inv(X[:, :2] + 1.0),
    "normal": lambda: torch.normal(X, X + 1.0),
    "masked_fill by a tensor": lambda: X.masked_fill(MASK, X.amax()),
    "masked_fill_ by a tensor": lambda: X.clone().masked_fill_(MASK, X.amax()),
}
HOST_WRITES: dict[str, Callable[[], object]] = {
    "tensor": lambda: torch.tensor([1.0]),
    "scalar": lambda: torch.tensor(1.0),
    "as_tensor": lambda: torch.as_tensor([1.0]),
    "asarray": lambda: torch.asarray(ARRAY),
    "from_numpy": lambda: torch.from_numpy(ARRAY),
    "Tensor": lambda: torch.Tensor([1.0]),
    "FloatTensor": lambda: torch.FloatTensor([1.0]),
    "new_tensor": lambda: X.new_tensor([1.0]),
    "scalar_tensor": lambda: torch.scalar_tensor(1.0),
    "to device name": lambda: X.to("cpu"),
    "to device": lambda: X.to(torch.device("cpu")),
    "to device by keyword": lambda: X.to(device="cpu"),
    "to another tensor": lambda: X.to(X.double()),
    "zeros": lambda: torch.zeros(2),
    "rand": lambda: torch.rand(2),
    "arange": lambda: torch.arange(2),
    "index by a list": lambda: X[:, [0, 2]],
    "index by an array": lambda: X[:, np.array([0, 2])],
    "assign to a list": _set((slice(None), [0, 2]), 0.0),
}
DATA_DEPENDENT: dict[str, Callable[[], object]] = {
    "nonzero": lambda: X.nonzero(),
    "argwhere": lambda: torch.argwhere(X),
    "where of one argument": lambda: torch.where(MASK),
    "masked_select": lambda: X.masked_select(MASK),
    "unique": lambda: X.unique(),
    "unique of a dimension": lambda: X.unique(dim=0),
    "unique_consecutive": lambda: X.unique_consecutive(),
    "repeat_interleave by a tensor": lambda: X.repeat_interleave(PICK, dim=0),
    "mask as index": lambda: X[MASK],
    "row mask as index": lambda: X[ROWS],
    "row mask and column": lambda: X[ROWS, 0],
    "byte mask as index": lambda: X[ROWS.byte()],
    "assign to a mask": _set(MASK, 0.0),
    "assign to a row mask": _set(ROWS, torch.zeros(3)),
    "index_put": lambda: X.index_put((ROWS,), X[:1]),
    "index_put_": lambda: X.clone().index_put_((ROWS,), X[:1]),
}
ALLOWED: dict[str, Callable[[], object]] = {
    "where": lambda: torch.where(MASK, X, 0.0),
    "masked_fill": lambda: X.masked_fill(MASK, 0.0),
    "mask arithmetic": lambda: X * MASK,
    "fixed columns": lambda: X[:, PICK],
    "assign to fixed columns": _set((slice(None), PICK), 0.0),
    "assign a number": _set((slice(None), 0), 1.0),
    "assign a tensor": _set((slice(None), 0), torch.ones(2)),
    "slice and None": lambda: X[:, None, :2],
    "len and shape": lambda: (len(X), X.shape, X.dim(), X.numel(), X.data_ptr()),
    "unpack": lambda: [row.sum() for row in X],
    "random": lambda: (
        torch.rand(2, device="cpu").exponential_().add_(torch.empty_like(ONE, dtype=torch.float).uniform_(-1.0, 1.0))
    ),
    "zeros_like": lambda: torch.zeros_like(X),
    "new_zeros": lambda: X.new_zeros(2),
    "zeros on a device": lambda: torch.zeros(2, device="cpu"),
    "dtype": lambda: (X.to(torch.float64), X.to(dtype=torch.int, copy=True), X.float(), X.bool(), X.type_as(ONE)),
    "copy": lambda: torch.empty_like(X).copy_(X).clone(),
    "out": lambda: torch.cat([X, MASK], dim=1, out=torch.empty(2, 6, device="cpu")),
    "scalar tensor arithmetic": lambda: (X * ONE).clamp_(max=ONE),
    "gather and scatter": lambda: (X.gather(1, ONE.expand(2, 3)), X.index_select(1, PICK), X.index_fill(1, PICK, 0.0)),
    "repeat_interleave by a number": lambda: X.repeat_interleave(2, dim=0),
    "reduce": lambda: (
        X.sum(dim=1),
        X.amax(),
        MASK.any(),
        torch.linalg.vector_norm(X, dim=1),
        torch.linalg.cross(X, X),
    ),
}


@pytest.mark.parametrize("call", HOST_READS.values(), ids=HOST_READS)
def test_host_reads_are_caught(call: Callable[[], object]) -> None:
    with pytest.raises(NotRecordable, match=" (reads .*|is read )to the host; "), recordable():
        call()


@pytest.mark.parametrize("call", HOST_WRITES.values(), ids=HOST_WRITES)
def test_host_data_is_caught(call: Callable[[], object]) -> None:
    with (
        pytest.raises(
            NotRecordable,
            match="copies data from the host|copies from the host|copies between host and device|makes a tensor on the host",
        ),
        recordable(),
    ):
        call()


@pytest.mark.parametrize("call", DATA_DEPENDENT.values(), ids=DATA_DEPENDENT)
def test_data_dependent_shapes_are_caught(call: Callable[[], object]) -> None:
    with pytest.raises(NotRecordable, match="has a shape that depends on data"), recordable():
        call()


@pytest.mark.filterwarnings("ignore:indexing with dtype torch.uint8")
@pytest.mark.parametrize("call", [*HOST_READS.values(), *HOST_WRITES.values(), *DATA_DEPENDENT.values()])
def test_forbidden_calls_work_outside(call: Callable[[], object]) -> None:
    """So that what is caught above is the call and not a mistake in the test."""
    call()


@pytest.mark.parametrize("call", ALLOWED.values(), ids=ALLOWED)
def test_ordinary_operations_pass(call: Callable[[], object]) -> None:
    with recordable():
        call()


def test_guard_ends_with_its_block() -> None:
    with (
        pytest.raises(
            NotRecordable, match="^item.. reads a tensor to the host; keep it a tensor and compute with that$"
        ),
        recordable(),
    ):
        X[0, 0].item()
    assert X[0, 1].item() == 1.0


# ---- a task of one's own: each mistake is one line of text ------------------------------------------------------------------


def _task(folder: Path, body: str, line: str) -> tuple[Any, str]:
    """A task of one's own, and ``file:line`` of its line that is marked."""
    file = folder / "mine.py"
    file.write_text(watched_task(body, line))
    number = 1 + next(i for i, text in enumerate(file.read_text().splitlines()) if text.endswith("# here"))
    return load_task(str(file)), f"{file}:{number}"


def test_a_tensor_that_a_file_holds_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotRecordable, match="^mine: Mine: AT_IMPORT is made where its file is read, on the host"):
        check_recordable(_task(tmp_path, REWARD, "self.past + AT_IMPORT")[0])
    check_recordable(_task(tmp_path, INIT, "self.own = AT_IMPORT.to(self.device)")[0])


ORDINARY = {
    "reads and own tensors": (
        REWARD,
        "self.foot_height.index_select(1, self.rows).sum(dim=1) * self.foot"
        " + (self.past + 1.0).mul_(2.0).masked_fill_(self.fell, 0.0)",
    ),
    "in place, made in the first step, a number that stays, on the device": (
        END_STEP,
        "self.past += 1.0; self.view = self.dof_pos[:, :3]; self.parts.kept['past'].copy_(self.past);"
        " self.half = getattr(self, 'half', None) or [torch.tensor(0.5)]; self.unknown = float('nan');"
        " self.past.add_(self.moved + self.net(self.past[:, None])[:, 0])",
    ),
    "in place by a training, random numbers between steps": (
        ANNEAL,
        "self.past.fill_(share); self.slots.one.copy_(self.past); self.past.fill_(random.random() + RNG.normal())",
    ),
    "a number without a device, a file's and a fresh one moved by a call": (
        INIT,
        "self.own = torch.tensor(0.5); self.other = torch.as_tensor(AT_IMPORT, device=self.device);"
        " self.third = torch.asarray(torch.tensor([1.0]), device=self.device)",
    ),
    "row of a buffer": (TABLE, "Row('past', self.past[:, None])"),
}


@pytest.mark.parametrize(("body", "line"), ORDINARY.values(), ids=ORDINARY)
def test_what_can_be_recorded_passes(tmp_path: Path, body: str, line: str) -> None:
    check_recordable(_task(tmp_path, body, line)[0])


@pytest.mark.parametrize(("line", "lost"), [("moved.add_(1.0)", "moved"), ("past.add_(1.0)", "")])
def test_what_a_resumed_run_would_not_have_is_named(tmp_path: Path, line: str, lost: str) -> None:
    task, _ = _task(tmp_path, END_STEP, f"self.{line}")
    text = f"self.{lost} is written by the step and not made by self.buffer()" if lost else ""
    assert check_recordable(task) == not_remembered(task) == text


def test_a_mistake_in_the_config_stays_what_it_is() -> None:
    task = load_task("go1_flat")
    task.set("rewards.scales.pos", 1.0)
    with pytest.raises(ConfigError, match="no reward term 'pos'"):
        check_recordable(task)


# ---- a capture that fails on a GPU all the same --------------------------------------------------------------------------


class _Fake:
    """What recording asks of torch.cuda and of warp; both fail to end a capture that has failed."""

    def __init__(self) -> None:
        self.capturing = self.ended = False

    @contextmanager
    def graph(self, *_: object, **__: object) -> Iterator[None]:
        try:
            yield
        finally:
            self.ended = True
            if self.capturing:
                raise RuntimeError("CUDA error: operation failed due to a previous error during capture")

    @contextmanager
    def ScopedStream(self, *_: object, **__: object) -> Iterator[None]:
        yield

    def capture_begin(self, **_: object) -> None:
        self.capturing = True

    def capture_end(self, **_: object) -> None:
        raise RuntimeError("Warp CUDA error 901: operation failed due to a previous error during capture")


def _record(fn: Callable[[], None], monkeypatch: pytest.MonkeyPatch) -> _Fake:
    fake: Any = _Fake()
    monkeypatch.setattr(torch.cuda, "graph", fake.graph)
    monkeypatch.setattr(torch.cuda, "CUDAGraph", lambda: None)
    StepGraph(fn, "cpu")._record(fake, fake, fake)
    return fake


def test_a_capture_that_fails_names_the_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a CPU it fails for another reason than on a GPU."""
    task, where = _task(tmp_path, REWARD, "self.past.view(-1, 2 + self.count)")
    task.set("env.num_envs", 2)
    env = task.env_class(task.cfg, "cpu")
    _, env.count = env.step(env.actions), 1
    with pytest.raises(NotRecordable) as raised:
        _record(env._step, monkeypatch)
    assert str(raised.value) == (
        f"{where}, Mine._reward_pose: cannot be recorded for a GPU (shape '[-1, 3]' is invalid for input of size 2); "
        "a recorded step asks the host for no value, copies none, and has fixed shapes"
    )
    assert raised.value.__suppress_context__  # one traceback, not three


@pytest.mark.parametrize(
    "error", [RuntimeError("CUDA out of memory. Tried to allocate 2 GiB"), KeyError("state"), ConfigError("no")]
)
def test_other_failures_stay_what_they_are(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def fn() -> None:
        raise error

    with pytest.raises(type(error)) as raised:
        _record(fn, monkeypatch)
    assert raised.value is error and error.__suppress_context__
