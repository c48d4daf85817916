"""What a step does, written down: torch's operations on memory, in order, and calls of the simulator between them.

A trace is taken of one real call. What it did is known by addresses, so views cost nothing and a write in place is just a write.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_flatten

from legged_mw.utils.opaque import traces


class View(NamedTuple):
    """Where a tensor lies: in a block of memory, with shape, strides and offset in elements."""

    block: int
    dtype: torch.dtype
    shape: tuple[int, ...]
    strides: tuple[int, ...]
    offset: int


class Node(NamedTuple):
    """An operation as it was called, what it read and what it wrote."""

    func: Any  # torch's OpOverload
    args: tuple[Any, ...]
    kwargs: dict[str, Any]
    outs: tuple[Tensor, ...]
    reads: tuple[View, ...]
    writes: tuple[View, ...]

    @property
    def name(self) -> str:
        """As torch calls it, without what says where the result goes: ``add`` for ``add_`` and ``add.out``."""
        return self.func._schema.name.removeprefix("aten::").strip("_") if hasattr(self.func, "_schema") else ""

    @property
    def random(self) -> bool:
        """It draws from the generator."""
        return torch.Tag.nondeterministic_seeded in self.func.tags


class Call(NamedTuple):
    """A call that is not looked into, and the blocks of memory that it is given."""

    run: Callable[[], object]
    given: tuple[int, ...]


class Trace(TorchDispatchMode):
    """Used with ``with``: notes every operation, and runs it."""

    def __init__(self, watched: Iterable[Tensor] = ()) -> None:
        """``watched``: memory whose writes others notice by torch's count of them, so that only torch may write to it."""
        super().__init__()
        self.steps: list[Node | Call] = []
        self.blocks: list[Tensor] = []  # a tensor of each block of memory, which keeps it where it is
        self.made: set[int] = set()  # blocks that were made meanwhile
        self._known: dict[int, int] = {}
        self.watched = {self.view(tensor).block for tensor in watched}
        self._paused = False

    def view(self, tensor: Tensor, made: bool = False) -> View:
        """Where ``tensor`` lies. Its memory is kept from now on."""
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
        written = [tensor for tensor in _written(func, args, kwargs) if tensor.numel()]
        if not written:
            blocks = {view.block for view in reads}
            fresh = [t for t in outs if t.numel() and self._known.get(t.untyped_storage().data_ptr(), -1) not in blocks]
            if not fresh:  # a view, or nothing at all
                return result
            outs = tuple(fresh)
        writes = tuple(self.view(tensor, made=not written) for tensor in written or outs)
        self.steps.append(Node(func, args, kwargs, outs, reads, writes))
        return result

    def call(self, run: Callable[[], object], given: Iterable[Tensor] = ()) -> Any:
        """Run what is not looked into; of what the trace made it reads what it is ``given``. A tensor that it returns is kept."""
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
        """Run a method that is marked with ``not_traced``."""
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


def _written(func: Any, args: Sequence[Any], kwargs: dict[str, Any]) -> Iterator[Tensor]:
    """The tensors among the arguments that ``func`` writes to."""
    for i, argument in enumerate(func._schema.arguments):
        if argument.alias_info is not None and argument.alias_info.is_write:
            yield from _tensors(args[i] if i < len(args) else kwargs.get(argument.name))


def alike(expected: Tensor, value: Tensor, close: float, strays: float) -> bool:
    """Equal to ``close``, relative and absolute, but for a share of ``strays``; fewer than 100 values each to a hundredth.

    Reads the device.
    """
    few = value.numel() < 100
    if few:
        close = max(close, 0.01)
    floats = value.is_floating_point()
    other = ~torch.isclose(expected, value, rtol=close, atol=close, equal_nan=True) if floats else expected != value
    return int(other.sum()) <= (0 if few else 1 + strays * value.numel())
