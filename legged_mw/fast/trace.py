"""Trace a step: torch's operations on memory, in order, and the simulator's calls between them.

The trace records one real call. It identifies memory by address, so a view needs no operation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from legged_mw.check.recordable import written
from legged_mw.utils.opaque import traces


class View(NamedTuple):
    """The memory of a tensor: block, shape, strides, and offset in elements."""

    block: int
    dtype: torch.dtype
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int


class Node(NamedTuple):
    """An operation with its arguments, the memory that it reads and the memory that it writes."""

    func: Any  # torch's OpOverload
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    outs: tuple[Tensor, ...]
    reads: tuple[View, ...]
    writes: tuple[View, ...]

    @property
    def name(self) -> str:
        """torch's name without the variant: ``add`` for ``add_`` and ``add.out``."""
        return self.func._schema.name.removeprefix("aten::").strip("_") if hasattr(self.func, "_schema") else ""

    @property
    def random(self) -> bool:
        """Whether it uses the random generator."""
        return torch.Tag.nondeterministic_seeded in self.func.tags


class Call(NamedTuple):
    """An opaque call, and the blocks of memory that it may read."""

    run: Callable[[], object]
    given: tuple[int, ...]


class Trace(TorchDispatchMode):
    """A context manager that runs and records every operation."""

    def __init__(self, watched: Iterable[Tensor] = ()) -> None:
        """``watched``: only torch may write this memory, because others detect writes by torch's version counter."""
        super().__init__()
        self.steps: list[Node | Call] = []
        self.blocks: list[Tensor] = []  # one tensor of each block of memory, so that it stays allocated
        self.made: set[int] = set()  # blocks that were allocated during the trace
        self._known: dict[int, int] = {}
        self.watched = {self.view(tensor).block for tensor in watched}
        self._paused = False

    def view(self, tensor: Tensor, made: bool = False) -> View:
        """The memory of ``tensor``, which stays allocated."""
        address = tensor.untyped_storage().data_ptr()
        if address not in self._known:
            self._known[address] = len(self.blocks)
            self.blocks.append(tensor)
            if made:
                self.made.add(self._known[address])
        return View(
            self._known[address], tensor.dtype, tuple(tensor.shape), tensor.stride(), int(tensor.storage_offset())
        )

    def __torch_dispatch__(
        self, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        result = func(*args, **kwargs)
        if self._paused:
            return result
        outs = tuple(_tensors(result))
        reads = tuple(self.view(tensor) for tensor in _tensors((args, kwargs)) if tensor.numel())
        changed = [tensor for tensor in written(func, args, kwargs) if tensor.numel()]
        if not changed:
            blocks = {view.block for view in reads}
            fresh = [t for t in outs if t.numel() and self._known.get(t.untyped_storage().data_ptr(), -1) not in blocks]
            if not fresh:  # a view, or no output
                return result
            outs = tuple(fresh)
        writes = tuple(self.view(tensor, made=not changed) for tensor in changed or outs)
        self.steps.append(Node(func, args, kwargs, outs, reads, writes))
        return result

    def call(self, run: Callable[[], object], given: Iterable[Tensor] = ()) -> Any:
        """Run an opaque call. Of the trace's own memory it may read only ``given``. A returned tensor is stored."""
        self._paused = True
        try:
            result = run()
        finally:
            self._paused = False
        blocks = [self.view(tensor).block for tensor in given]
        if isinstance(result, Tensor):
            blocks.append(self.view(result).block)
            self.steps.append(Call(lambda: result.copy_(run()), tuple(blocks)))  # type: ignore[arg-type]
        else:
            self.steps.append(Call(run, tuple(blocks)))
        return result

    def call_whole(self, method: Callable[..., Any], args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run a method with the mark ``not_traced``."""
        if self._paused:
            return method(*args, **kwargs)
        return self.call(lambda: method(*args, **kwargs), _tensors((args, kwargs)))

    def __enter__(self) -> Trace:
        traces.append(self)
        super().__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        traces.remove(self)


def _tensors(nested: Any) -> Iterator[Tensor]:
    return (value for value in tree_flatten(nested)[0] if isinstance(value, Tensor))


def alike(expected: Tensor, value: Tensor, close: float, strays: float) -> bool:
    """Whether the values are equal within ``close`` (relative and absolute), except for a share of ``strays``.

    With fewer than 100 values, each must be equal within 0.01. Reads the device.
    """
    few = value.numel() < 100
    if few:
        close = max(close, 0.01)
    floats = value.is_floating_point()
    other = ~torch.isclose(expected, value, rtol=close, atol=close, equal_nan=True) if floats else expected != value
    return int(other.sum()) <= (0 if few else 1 + strays * value.numel())
