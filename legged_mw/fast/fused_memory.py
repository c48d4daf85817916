"""C code for memory: elements of a view, loops over elements, and the division of work among the lanes of a world."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from legged_mw.fast.trace import View

TYPES = {
    torch.float32: "float",
    torch.float64: "double",
    torch.int64: "long long",
    torch.int32: "int",
    torch.bool: "bool",
}
WORLD = "w"

HELPERS = """
#ifdef __CUDA_ARCH__
#define SYNC __syncwarp(lanes);
#define ADD(to, x) atomicAdd(&(to), x)
#define OWN(type, name, n) __shared__ type all_##name[BLOCK / LANES][n]; type* name = all_##name[threadIdx.x / LANES];
const unsigned lanes = (~0u >> (32 - LANES)) << (threadIdx.x % 32 / LANES * LANES);  // of this world
#else
#define SYNC
#define ADD(to, x) (to) += (x)
#define OWN(type, name, n) type name[n];
#endif
const int lane = thread % LANES, w = thread / LANES;
#define NAN_OR(a, b, x) ((a) != (a) ? (a) : (b) != (b) ? (b) : (x))
#define MAXIMUM(a, b) NAN_OR(a, b, (a) > (b) ? (a) : (b))
#define MINIMUM(a, b) NAN_OR(a, b, (a) < (b) ? (a) : (b))
#define FINITE(x) ((x) - (x) == 0)
"""


class Unfit(Exception):
    """Torch must run the operation."""


class Access(NamedTuple):
    """A world's part of a view: elements [low, high) of its row. ``pitch``: distance of rows; 0: one shared row."""

    view: View
    pitch: int
    low: int
    high: int


class Code(NamedTuple):
    """The code of an operation and its accesses: first the reads, then the write."""

    lines: list[str]
    reads: list[Access]
    write: Access


class Lines:
    """Generates C code for memory. ``place`` gives a block's name in C, and whether it is a temporary of one world."""

    _out: View  # output of the current operation
    _reads: list[Access]  # its reads
    _shared: bool  # the output is one value for all worlds

    def __init__(self, worlds: int, view: Callable[[Tensor], View], place: Callable[[int], tuple[str, bool]]) -> None:
        self._worlds, self._view, self._place = worlds, view, place

    def _access(self, view: View, shape: Sequence[int]) -> Access:
        """A world's part of ``view`` broadcast to ``shape``, with worlds along the first dimension."""
        strides = spread(view, shape)
        pitch = 0 if self._shared or not strides else strides[0]
        inner = strides if self._shared else strides[1:]
        sizes = shape if self._shared else shape[1:]
        span = sum((n - 1) * s for n, s in zip(sizes, inner, strict=True)) if all(sizes) else 0
        return Access(view, pitch, view.offset, view.offset + span + 1)

    def _at(self, view: View, strides: Sequence[int], index: Sequence[str], offset: int = 0) -> str:
        name, own = self._place(view.block)
        terms = [str(view.offset + offset)] if view.offset + offset else []
        for stride, i in zip(strides, index, strict=True):
            if stride and i != "0" and not (own and i == WORLD):
                terms.append(i if stride == 1 else f"{stride} * {i}")
        return f"{name}[{' + '.join(terms) or '0'}]"

    def _read(self, tensor: Tensor, shape: Sequence[int], index: Sequence[str]) -> str:
        """An element of ``tensor`` broadcast to ``shape``."""
        view = self._view(tensor)
        self._reads.append(self._access(view, shape))
        return self._at(view, spread(view, shape), index)

    def _write(self, index: Sequence[str]) -> str:
        return self._at(self._out, self._out.strides, index)

    def _index(self, shape: Sequence[int], letter: str = "i") -> list[str]:
        """Names of an element's indices."""
        names = ["0" if n == 1 else f"{letter}{d}" for d, n in enumerate(shape)]
        return names if self._shared else [WORLD, *names[1:]]

    def _loops(self, shape: Sequence[int], index: Sequence[str], body: Iterable[str], alone: bool = False) -> list[str]:
        """Loops of ``body`` over all elements. The lanes share the first loop; with ``alone`` one lane runs it."""
        loops = [(n, i) for n, i in zip(shape, index, strict=True) if i not in ("0", WORLD)]
        heads = [f"for (int {i} = 0; {i} < {n}; ++{i})" for n, i in loops]
        if not alone:
            first = (
                f"for (int {loops[0][1]} = lane; {loops[0][1]} < {loops[0][0]}; {loops[0][1]} += LANES)"
                if loops
                else "if (lane == 0)"
            )
            heads = [first, *heads[1:]]
        return [" ".join(heads) + " {", *body, "}"]

    def _store(self, shape: Sequence[int], index: Sequence[str], value: str, reads: Iterable[Tensor] = ()) -> list[str]:
        """Write ``value`` to every element. Use a copy if it reads other elements of the same memory."""
        kind = TYPES[self._out.dtype]
        views = [self._view(tensor) for tensor in reads]
        if all(view.block != self._out.block or view[2:] == self._out[2:] for view in views):
            return self._loops(shape, index, [f"{self._write(index)} = ({kind})({value});"])
        sizes = shape if self._shared else shape[1:]
        inner = index if self._shared else index[1:]
        at = " + ".join(f"{math.prod(sizes[d + 1 :])} * {i}" for d, i in enumerate(inner) if i != "0") or "0"
        copied = self._loops(shape, index, [f"copy[{at}] = ({kind})({value});"])
        return [
            f"{kind} copy[{math.prod(sizes)}];",
            *copied,
            "SYNC",
            *self._loops(shape, index, [f"{self._write(index)} = copy[{at}];"]),
        ]


def spread(view: View, shape: Sequence[int]) -> list[int]:
    """Strides of ``view`` broadcast to ``shape``: 0 in repeated dimensions."""
    strides = [s if n != 1 else 0 for n, s in zip(view.shape, view.strides, strict=True)]
    return [0] * (len(shape) - len(strides)) + strides


def span_of(view: View) -> int:
    return sum((n - 1) * s for n, s in zip(view.shape, view.strides, strict=True)) + 1
