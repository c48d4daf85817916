"""The guard: each forbidden call is caught, what a step is made of passes, and a task's mistake is named by file, line and method."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from legged_mw.check.guard import check_recordable, not_remembered
from legged_mw.check.recordable import recordable
from legged_mw.sim.graph import StepGraph
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import NotRecordable, StepError
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

HEAD = """
import random
from collections import deque

import numpy as np
import torch
from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.observations import Row
from legged_mw.utils.task import Task

RNG, AT_IMPORT = np.random.default_rng(1), torch.ones(4)


class Slots:
    __slots__ = ("one",)

    def __init__(self, like):
        self.one = torch.zeros_like(like)


class Buffers:
    def __init__(self, like):
        self.kept = {"past": torch.zeros_like(like)}


class Mine(LeggedRobot):
    def _init_buffers(self):
        super()._init_buffers()
        self.foot, self.rows = (torch.tensor(i, device=self.device) for i in (1, [0, 2]))
        self.past, self.list, self.count = self.buffer(), [self.buffer()], 0
        self.parts, self.slots, self.view = Buffers(self.past), Slots(self.past), self.dof_pos[:, :3]
        self.frames = deque([self.past, self.parts.kept["past"]])
        self.moved, self.net = torch.zeros(self.num_envs).to(self.device), torch.nn.Linear(1, 1).to(self.device).requires_grad_(False)

"""
REWARD = """
    def _reward_pose(self):
        {}  # here
        return self.past * 0.0
"""
END_STEP = """
    def _end_step(self):
        super()._end_step()
        {}  # here
"""
ANNEAL = """
    def on_training_progress(self, share):
        super().on_training_progress(share)
        {}  # here
"""
LOAD = """
    def load_training_state(self, state):
        super().load_training_state(state)
        {}  # here
"""
REDRAW = """
    def _init_ranges(self):
        super()._init_ranges()
        redraw = self.domain_rand.redraw

        def drawn():
            redraw()
            {}  # here

        self.domain_rand.redraw = drawn
"""
INIT = """
    def _init_ranges(self):
        super()._init_ranges()
        {}  # here

    def _end_step(self):
        super()._end_step()
        self.past.add_(self.own.sum())
"""
TABLE = """
    def observation_rows(self):  # here
        rows = super().observation_rows()
        rows["state"].append({})
        return rows
"""
TAIL = """

TASK = Task(Mine, Go1FlatCfg, Go1FlatCfgPPO)
"""
CONDITION = "a tensor as a condition (if, and, not, in) is read to the host; write torch.where(condition, a, b)"
SCALAR = "a tensor without dimensions as an index is read to the host; write x.index_select(dim, index.view(1)), or use a Python int"
MASK_INDEX = (
    "a mask as an index has a shape that depends on data; write torch.where(mask, a, b), or assign(x, mask, value)"
)
MADE_ONCE = "becomes another tensor; make it once, in __init__, and write in place"
PAST = f"self.past {MADE_ONCE}: self.past.copy_(...)"
NUMBER = "self.count is a Python number and changes, but a replay repeats what was recorded; make it a tensor"
ON_HOST = "without a device makes a tensor on the host, which the step reads; add device=self.device"
DRAWS = "draws Python's or numpy's random numbers, but a replay repeats what was recorded; write torch.rand(..., device=self.device)"
BREACHES: dict[str, tuple[str, str, str]] = {
    "column by a scalar tensor": (REWARD, "self.foot_height[:, self.foot].clone()", f"Mine._reward_pose: {SCALAR}"),
    "item": (
        REWARD,
        "self.dt * self.foot.item()",
        "Mine._reward_pose: item() reads a tensor to the host; keep it a tensor and compute with that",
    ),
    "if": (REWARD, "1 if self.commands.sum() > 0 else 2", f"Mine._reward_pose: {CONDITION}"),
    "boolean index": (END_STEP, "self.past[self.fell] = 0.0", f"Mine._end_step: {MASK_INDEX}"),
    "torch.tensor": (
        REWARD,
        "torch.tensor([1.0])",
        "Mine._reward_pose: tensor() copies data from the host; make the tensor once, in __init__",
    ),
    "no device": (
        REWARD,
        "torch.zeros(2)",
        "Mine._reward_pose: zeros() without a device makes a tensor on the host; add device=self.device",
    ),
    "nonzero": (
        END_STEP,
        "self.fell.nonzero()",
        "Mine._end_step: nonzero has a shape that depends on data; keep every row, and write torch.where(mask, a, b)",
    ),
    "rebound": (
        END_STEP,
        "self.past = self.past + 1.0",
        f"Mine._end_step: self.past {MADE_ONCE}: self.past.copy_(...)",
    ),
    "rebound view": (
        END_STEP,
        "self.view = self.dof_vel[:, :3]",
        f"Mine._end_step: self.view {MADE_ONCE}: self.view.copy_(...)",
    ),
    "rebound in a part": (
        END_STEP,
        "self.parts.kept['past'] = self.past.abs()",
        f"Mine._end_step: self.parts.kept.past {MADE_ONCE}: self.parts.kept.past.copy_(...)",
    ),
    "rebound in the simulation": (
        END_STEP,
        "self.sim.qpos = self.sim.qpos.abs()",
        f"Mine._end_step: self.sim.qpos {MADE_ONCE}: self.sim.qpos.copy_(...)",
    ),
    "list that grows": (
        END_STEP,
        "self.list.append(self.past.clone())",
        f"Mine._end_step: self.list[2] {MADE_ONCE}: self.list[2].copy_(...)",
    ),
    "number": (END_STEP, "self.count += 1", f"Mine._end_step: {NUMBER}"),
    "number that a training changes": (ANNEAL, "self.count = 2.0 * share", f"Mine.on_training_progress: {NUMBER}"),
    "number of the config that a training changes": (
        ANNEAL,
        "self.cfg.rewards.base_height_target = 0.3 * share",
        f"Mine.on_training_progress: {NUMBER.replace('self.count', 'self.cfg.rewards.base_height_target')}",
    ),
    "rebound by a training": (ANNEAL, "self.past = self.past + share", f"Mine.on_training_progress: {PAST}"),
    "number that a redraw changes": (REDRAW, "self.count += 1", f"drawn: {NUMBER}"),
    "rebound by a checkpoint": (
        LOAD,
        "self.past = self.past.clone()",
        f"Mine.load_training_state: {PAST}",
    ),
    "rebound in a deque": (
        END_STEP,
        "self.frames.rotate()",
        f"Mine._end_step: self.frames[0] {MADE_ONCE}: self.frames[0].copy_(...)",
    ),
    "rebound in slots": (
        END_STEP,
        "self.slots.one = self.past * 2",
        f"Mine._end_step: self.slots.one {MADE_ONCE}: self.slots.one.copy_(...)",
    ),
    "Python's random numbers": (REWARD, "self.dt * random.random()", f"Mine._reward_pose: {DRAWS}"),
    "numpy's random numbers": (END_STEP, "self.past += np.random.rand()", f"Mine._end_step: {DRAWS}"),
    "a generator of numpy's": (END_STEP, "self.past += RNG.normal()", f"Mine._end_step: {DRAWS}"),
    "a buffer without a device": (
        INIT,
        "self.own = torch.zeros(self.num_envs)",
        f"Mine._init_ranges: zeros() {ON_HOST}",
    ),
    "computed from a number without a device": (
        INIT,
        "self.own = torch.tensor(0.5).expand(4)",
        f"Mine._init_ranges: tensor() {ON_HOST}",
    ),
    "computed without a device": (
        INIT,
        "self.own = {'a': torch.arange(3)[None] / 2.0 + 1.0}['a']",
        f"Mine._init_ranges: arange() {ON_HOST}",
    ),
    "a network without a device": (
        INIT,
        "self.own = torch.nn.Linear(1, 1).weight.detach()",
        f"Mine._init_ranges: empty() {ON_HOST}",
    ),
    "writes": (
        REWARD,
        "self.past += 1.0",
        "Mine._reward_pose: writes to self.past; a reward only reads: write to it in _update_state or _end_step",
    ),
    "writes to a view": (
        REWARD,
        "self.last_actions[:, 0].mul_(2.0)",
        "Mine._reward_pose: writes to self._episode; a reward only reads: write to it in _update_state or _end_step",
    ),
    "computed row": (
        TABLE,
        "Row('speed', self.base_lin_vel * 2.0)",
        "Mine.observation_rows: row 'speed' of 'state' is computed when the table is made, which is once; "
        "give it a buffer, which _update_state writes in place",
    ),
}
MISTAKES: dict[str, tuple[str, str, str]] = {
    "raises": (
        END_STEP,
        "self.past.add_(self.dof_pos)",
        "Mine._end_step: RuntimeError: The size of tensor a (4) must match the size of tensor b (12) at non-singleton dimension 1",
    ),
    "unknown name": (
        REWARD,
        "self.speed",
        "Mine._reward_pose: AttributeError: 'Mine' object has no attribute 'speed'; did you mean 'foot_speed'?",
    ),
    "shape": (
        "\n    def _reward_pose(self):  # here\n        return {}\n",
        "self.dof_pos.square()",
        "Mine._reward_pose: must return a tensor (4,), one value an environment; it returned (4, 12)",
    ),
    "NaN": (
        "\n    def _reward_pose(self):  # here\n        return {}\n",
        "(self.base_height - 100.0).sqrt()",
        "Mine._reward_pose: returned a value that is not finite; look for a division by 0 or a root of a negative number",
    ),
    "row of NaN": (
        TABLE,
        "Row('past', self.past.fill_(torch.nan)[:, None])",
        "Mine.observation_rows: row 'past' of 'state' is not finite, or beyond 1e+06",
    ),
}


def _task(folder: Path, body: str, line: str) -> tuple[Any, str]:
    """A task of one's own, and ``file:line`` of its line that is marked."""
    file = folder / "mine.py"
    file.write_text(HEAD + body.format(line) + TAIL)
    number = 1 + next(i for i, text in enumerate(file.read_text().splitlines()) if text.endswith("# here"))
    return load_task(str(file)), f"{file}:{number}"


@pytest.mark.parametrize(("body", "line", "text"), BREACHES.values(), ids=BREACHES)
def test_what_cannot_be_recorded_is_named_by_line(tmp_path: Path, body: str, line: str, text: str) -> None:
    task, where = _task(tmp_path, body, line)
    with pytest.raises(NotRecordable) as raised:
        check_recordable(task)
    assert str(raised.value) == f"mine: {where}, {text}"


@pytest.mark.parametrize(("body", "line", "text"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_named_by_line(tmp_path: Path, body: str, line: str, text: str) -> None:
    task, where = _task(tmp_path, body, line)
    with pytest.raises(StepError) as raised:
        check_recordable(task)
    assert str(raised.value) == f"mine: {where}, {text}"
    assert not isinstance(raised.value, NotRecordable)


def test_a_tensor_that_a_file_holds_is_named(tmp_path: Path) -> None:
    with pytest.raises(NotRecordable, match="^mine: Mine: AT_IMPORT is made where its file is read, on the host"):
        check_recordable(_task(tmp_path, REWARD, "self.past + AT_IMPORT")[0])
    check_recordable(_task(tmp_path, INIT, "self.own = AT_IMPORT.to(self.device)")[0])


ORDINARY = {
    "reads": (REWARD, "self.foot_height.index_select(1, self.rows).sum(dim=1) * self.foot"),
    "own tensors": (REWARD, "(self.past + 1.0).mul_(2.0).masked_fill_(self.fell, 0.0)"),
    "in place": (
        END_STEP,
        "self.past += 1.0; self.view = self.dof_pos[:, :3]; self.parts.kept['past'].copy_(self.past)",
    ),
    "made in the first step": (END_STEP, "self.half = getattr(self, 'half', None) or [torch.tensor(0.5)]"),
    "a number that stays": (END_STEP, "self.unknown = float('nan')"),
    "on the device": (END_STEP, "self.past.add_(self.moved + self.net(self.past[:, None])[:, 0])"),
    "in place by a training": (ANNEAL, "self.past.fill_(share); self.slots.one.copy_(self.past)"),
    "random numbers between steps": (ANNEAL, "self.past.fill_(random.random() + RNG.normal())"),
    "a number without a device": (INIT, "self.own = torch.tensor(0.5)"),
    "a file's, moved by a call": (INIT, "self.own = torch.as_tensor(AT_IMPORT, device=self.device)"),
    "fresh, moved by a call": (INIT, "self.own = torch.asarray(torch.tensor([1.0]), device=self.device)"),
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
