"""The guard itself: each forbidden call is caught, and what a step is made of passes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from guard import NotRecordable, recordable
from torch import Tensor

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
    "slice by a tensor": lambda: X[:ONE],
    "full of a tensor": lambda: torch.full((2,), ONE, device="cpu"),  # pyright: ignore[reportArgumentType]
    "tensor as alpha": lambda: torch.add(X, X, alpha=ONE),  # pyright: ignore[reportArgumentType]
    "is_nonzero": lambda: torch.is_nonzero(ONE),
    "equal": lambda: torch.equal(X, X),
    "allclose": lambda: torch.allclose(X, X),
    "bincount": lambda: torch.bincount(PICK),
    "histc": lambda: torch.histc(X),
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
    "random": lambda: torch.rand(2, device="cpu").exponential_().add_(torch.empty_like(ONE, dtype=torch.float).uniform_(-1.0, 1.0)),
    "zeros_like": lambda: torch.zeros_like(X),
    "new_zeros": lambda: X.new_zeros(2),
    "zeros on a device": lambda: torch.zeros(2, device="cpu"),
    "dtype": lambda: (X.to(torch.float64), X.to(dtype=torch.int, copy=True), X.float(), X.bool(), X.type_as(ONE)),
    "copy": lambda: torch.empty_like(X).copy_(X).clone(),
    "out": lambda: torch.cat([X, MASK], dim=1, out=torch.empty(2, 6, device="cpu")),
    "scalar tensor arithmetic": lambda: (X * ONE).clamp_(max=ONE),
    "gather and scatter": lambda: (X.gather(1, ONE.expand(2, 3)), X.index_select(1, PICK), X.index_fill(1, PICK, 0.0)),
    "repeat_interleave by a number": lambda: X.repeat_interleave(2, dim=0),
    "reduce": lambda: (X.sum(dim=1), X.amax(), MASK.any(), torch.linalg.vector_norm(X, dim=1), torch.linalg.cross(X, X)),
}


@pytest.mark.parametrize("call", HOST_READS.values(), ids=HOST_READS)
def test_host_reads_are_caught(call: Callable[[], object]) -> None:
    with pytest.raises(NotRecordable, match="^host read: "), recordable():
        call()


@pytest.mark.parametrize("call", HOST_WRITES.values(), ids=HOST_WRITES)
def test_host_data_is_caught(call: Callable[[], object]) -> None:
    with pytest.raises(NotRecordable, match="^(host data made a tensor|copy between host and device|created on the host): "), recordable():
        call()


@pytest.mark.parametrize("call", DATA_DEPENDENT.values(), ids=DATA_DEPENDENT)
def test_data_dependent_shapes_are_caught(call: Callable[[], object]) -> None:
    with pytest.raises(NotRecordable, match="^(data-dependent shape|boolean mask as an index): aten"), recordable():
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
    with pytest.raises(NotRecordable, match="host read: item"), recordable():
        X[0, 0].item()
    assert X[0, 1].item() == 1.0
