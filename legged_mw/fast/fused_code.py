"""Generate C code for torch's operations: one thread, or a few lanes, compute one world.

An operation fits if a world's result depends only on its own values and on values that all worlds share. Torch runs
other and unknown operations: ``emit`` raises ``Unfit``.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from legged_mw.fast.trace import Node, View

SMALL = 64  # number of elements of a shared value up to which each thread computes it
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


class _Joined:
    """Represents two operations of torch that are written as one."""

    tags = ()
    overloadpacket = None


class _AddRows(_Joined):
    """``to.add_(rows.sum(dim=0))``."""

    def __call__(self, to: Tensor, rows: Tensor) -> Tensor:
        return to.add_(rows.sum(dim=0))


class _Assign(_Joined):
    """``to.copy_(torch.where(mask, value, to))``. Elements without ``mask`` are neither read nor written."""

    def __call__(self, to: Tensor, mask: Tensor, value: Tensor) -> Tensor:
        return to.copy_(torch.where(mask, value, to))


ADD_ROWS, ASSIGN = _AddRows(), _Assign()


_ONE = {  # name -> C of a unary operation on a
    "neg": "-{a}", "abs": "({a} < 0 ? -{a} : {a})", "sqrt": "sqrtf({a})", "rsqrt": "1.0f / sqrtf({a})",
    "exp": "expf({a})", "log": "logf({a})",
    "sin": "sinf({a})", "cos": "cosf({a})", "tan": "tanf({a})", "asin": "asinf({a})", "acos": "acosf({a})",
    "atan": "atanf({a})",
    "tanh": "tanhf({a})", "sigmoid": "1.0f / (1.0f + expf(-{a}))",
    "floor": "floorf({a})", "ceil": "ceilf({a})", "round": "rintf({a})",
    "trunc": "truncf({a})", "reciprocal": "1.0f / {a}", "sign": "({a} > 0) - ({a} < 0)", "logical_not": "!{a}",
    "copy": "{a}", "clone": "{a}", "to_copy": "{a}", "to": "{a}",
    "sinc": "({a} == 0.0f ? 1.0f : sinf(3.14159265358979f * {a}) / (3.14159265358979f * {a}))",
    "isnan": "{a} != {a}", "isfinite": "FINITE({a})", "square": "{a} * {a}",
}  # fmt: skip
_TWO = {  # name -> C of a binary operation on a and b
    "add": "{a} + {b}", "sub": "{a} - {b}", "rsub": "{b} - {a}", "mul": "{a} * {b}", "div": "{a} / {b}",
    "atan2": "atan2f({a}, {b})", "hypot": "sqrtf({a} * {a} + {b} * {b})", "maximum": "MAXIMUM({a}, {b})",
    "minimum": "MINIMUM({a}, {b})", "clamp_min": "MAXIMUM({a}, {b})", "clamp_max": "MINIMUM({a}, {b})",
    "remainder": "({a} - {b} * floorf({a} / {b}))",
    "eq": "{a} == {b}", "ne": "{a} != {b}", "lt": "{a} < {b}", "le": "{a} <= {b}",
    "gt": "{a} > {b}", "ge": "{a} >= {b}",
    "logical_and": "{a} && {b}", "logical_or": "{a} || {b}", "logical_xor": "!{a} != !{b}",
    "bitwise_and": "{a} & {b}", "bitwise_or": "{a} | {b}", "bitwise_xor": "{a} ^ {b}", "and": "{a} & {b}",
    "or": "{a} | {b}", "xor": "{a} ^ {b}", "iand": "{a} & {b}", "ior": "{a} | {b}",
}  # fmt: skip
_THREE = {
    "where": "({a} ? {b} : {c})",
    "addcmul": "{a} + {s} * {b} * {c}", "addcdiv": "{a} + {s} * {b} / {c}",
    "lerp": "({c} < 0.5f ? {a} + {c} * ({b} - {a}) : {b} - ({b} - {a}) * (1.0f - {c}))",
}  # fmt: skip
_COPIES = {"copy", "clone", "to_copy", "to"}
_COMPARING = {"eq", "ne", "lt", "le", "gt", "ge", "isnan", "isfinite"}
_COMPARING |= {"logical_and", "logical_or", "logical_not", "logical_xor"}
_FLOATS = {name for name, text in {**_ONE, **_TWO, **_THREE}.items() if "f(" in text or "." in text}  # for float32 only
_CONSTANTS = {"zeros_like": 0, "zeros": 0, "zero": 0, "new_zeros": 0, "ones_like": 1, "ones": 1, "new_ones": 1}
_REDUCTIONS = {  # name -> initial value, update of the accumulator s by a
    "sum": ("0", "{s} + {a}"), "mean": ("0", "{s} + {a}"), "linalg_vector_norm": ("0", "{s} + {a} * {a}"),
    "any": ("0", "{s} || {a}"), "all": ("1", "{s} && {a}"), "prod": ("1", "{s} * {a}"),
    "amax": ("", "MAXIMUM({s}, {a})"), "amin": ("", "MINIMUM({s}, {a})"),
}  # fmt: skip


class Writer:
    """Generates C code of operations. ``place`` gives a block's name in C, and if it is a temporary of one world."""

    _out: View  # output of the current operation
    _reads: list[Access]  # its reads
    _shared: bool  # the output is one value for all worlds

    def __init__(self, worlds: int, view: Callable[[Tensor], View], place: Callable[[int], tuple[str, bool]]) -> None:
        self._worlds, self._view, self._place = worlds, view, place

    def emit(self, node: Node) -> Code:
        """The code of ``node``. Raises Unfit."""
        if len(node.writes) != 1 or any(view.dtype not in TYPES for view in (*node.reads, *node.writes)):
            raise Unfit
        if node.func is ADD_ROWS:
            return self._add_rows(*node.args)
        out, name = node.writes[0], node.name
        self._shared = not out.shape or out.shape[0] != self._worlds
        if self._shared and math.prod(out.shape) > SMALL:
            raise Unfit
        self._out, self._reads = out, list[Access]()
        if name.startswith("empty") or name.startswith("new_empty"):
            lines = []
        elif node.func is ASSIGN:
            lines = self._assign(*node.args)
        elif name in _REDUCTIONS:
            lines = self._reduce(node, name)
        elif special := getattr(self, f"_emit_{name}", None):
            lines = special(*node.args, **node.kwargs)
        else:
            lines = self._elementwise(node, name)
        return Code(["{", *lines, "}", "SYNC"], self._reads, self._access(out, out.shape))

    def _add_rows(self, to: Tensor, rows: Tensor) -> Code:
        """Sum over worlds of values that are mostly 0, such as counts. A thread adds only nonzero values."""
        out, source = self._view(to), self._view(rows)
        if out.dtype != torch.float32 or rows.shape[0] != self._worlds or math.prod(rows.shape[1:]) != to.numel():
            raise Unfit
        self._shared, self._out, self._reads = False, out, []
        index = self._index(source.shape)
        self._reads.append(self._access(source, source.shape))
        value = f"float a = (float){self._at(source, source.strides, index)};"
        lines = self._loops(
            source.shape, index, [value, f"if (a != 0) ADD({self._at(out, out.strides, index[1:])}, a);"]
        )
        return Code(["{", *lines, "}", "SYNC"], self._reads, Access(out, -1, 0, 0))

    # ---- operations --------------------------------------------------------------------------------------------------

    def _elementwise(self, node: Node, name: str) -> list[str]:
        shape, args = self._out.shape, list(node.args)
        index = self._index(shape)
        if name in _CONSTANTS or name in ("fill", "full", "full_like", "scalar_tensor", "new_full"):
            value = _CONSTANTS.get(name, node.args[-1])
            return self._store(shape, index, self._value(value, shape, index, self._out.dtype))
        if node.kwargs.get("rounding_mode") or (name == "copy" and len(args) > 2 and args[2]):
            raise Unfit
        if name == "copy":
            args = args[1:2]
        if name in _COPIES or (name == "bitwise_not" and self._out.dtype == torch.bool):
            name, args = ("logical_not", args) if name == "bitwise_not" else (name, args[:1])
        text = _ONE.get(name) or _TWO.get(name) or _THREE.get(name)
        count = 1 if name in _ONE else 2 if name in _TWO else 3
        if text is None or len(args) < count:
            raise Unfit
        kinds = self._kinds(name, args)
        if name in _FLOATS and torch.float32 not in (kinds[0], self._out.dtype):
            raise Unfit
        values = [self._value(arg, shape, index, kind) for arg, kind in zip(args, kinds, strict=False)]
        scale = node.kwargs.get("alpha", args[2] if name in ("add", "sub", "rsub") and len(args) > 2 else 1)
        if scale != 1 and name in ("add", "sub", "rsub"):
            text = text.replace("{b}", "{s} * {b}") if name != "rsub" else "{b} - {s} * {a}"
        factor = self._value(node.kwargs.get("value", scale), shape, index, self._out.dtype)
        value = text.format(**dict(zip("abc", values, strict=False)), s=factor)
        return self._store(shape, index, value, [arg for arg in args if isinstance(arg, Tensor)])

    def _kinds(self, name: str, args: Sequence[Any]) -> list[torch.dtype]:
        """The types to which the operands are converted."""
        if name in _COPIES:
            return [args[0].dtype]
        if name in _COMPARING:
            both = args[0].dtype if len(args) == 1 else torch.result_type(args[0], args[1])
            return [both] * len(args)
        out = self._out.dtype
        return [torch.bool, out, out] if name == "where" else [out] * len(args)

    def _value(self, value: Any, shape: Sequence[int], index: Sequence[str], kind: torch.dtype) -> str:
        """An operand as C: an element of a tensor, or a number, in the type ``kind``."""
        if kind not in TYPES:
            raise Unfit
        if isinstance(value, Tensor):
            element = self._read(value, shape, index)
            return element if value.dtype == kind else f"(({TYPES[kind]}){element})"
        if value is None or isinstance(value, complex):
            raise Unfit
        if kind in (torch.float32, torch.float64):
            number = float(value)
            if not math.isfinite(number):
                return "(0.0f / 0.0f)" if math.isnan(number) else "(1.0f / 0.0f)" if number > 0 else "(-1.0f / 0.0f)"
            return f"({number!r}{'f' if kind == torch.float32 else ''})"
        return f"(({TYPES[kind]}){int(value)}LL)"

    def _emit_clamp(self, x: Tensor, low: Any = None, high: Any = None, **more: Any) -> list[str]:
        low, high, shape = more.get("min", low), more.get("max", high), self._out.shape
        index, kind = self._index(shape), self._out.dtype
        value = self._value(x, shape, index, kind)
        for bound, macro in ((low, "<"), (high, ">")):
            if bound is not None:
                limit = self._value(bound, shape, index, kind)
                value = f"({value} {macro} {limit} ? {limit} : {value})"
        return self._store(shape, index, value, [v for v in (x, low, high) if isinstance(v, Tensor)])

    def _assign(self, to: Tensor, mask: Tensor, value: Any) -> list[str]:
        """Write ``value`` into the elements of ``to`` where ``mask`` is true."""
        view, shape, index = self._view(to), self._out.shape, self._index(self._out.shape)
        if view != self._out or mask.dtype != torch.bool:
            raise Unfit
        others = [self._view(tensor) for tensor in (mask, value) if isinstance(tensor, Tensor)]
        if any(other.block == view.block for other in others):
            raise Unfit
        chosen, new = self._read(mask, shape, index), self._value(value, shape, index, view.dtype)
        store = f"{self._write(index)} = ({TYPES[view.dtype]})({new});"
        if math.prod(mask.shape) == self._worlds:  # one value per world needs no loop
            return [f"if ({chosen}) {{", *self._loops(shape, index, [store]), "}"]
        return self._loops(shape, index, [f"if ({chosen}) {store}"])

    def _emit_masked_fill(self, x: Tensor, mask: Tensor, value: Any) -> list[str]:
        if self._view(x) == self._out and not self._shared:
            return self._assign(x, mask, value)
        shape, index, kind = self._out.shape, self._index(self._out.shape), self._out.dtype
        kept, chosen = self._value(x, shape, index, kind), self._value(mask, shape, index, torch.bool)
        return self._store(shape, index, f"({chosen} ? {self._value(value, shape, index, kind)} : {kept})", [x, mask])

    def _emit_pow(self, x: Tensor, exponent: Any) -> list[str]:
        if isinstance(exponent, Tensor) or self._out.dtype != torch.float32 or not isinstance(x, Tensor):
            raise Unfit
        a = self._value(x, self._out.shape, index := self._index(self._out.shape), torch.float32)
        return self._store(
            self._out.shape, index, f"{a} * {a}" if exponent == 2 else f"powf({a}, {float(exponent)!r}f)", [x]
        )

    def _emit_nan_to_num(
        self, x: Tensor, nan: Any = None, posinf: Any = None, neginf: Any = None, **more: Any
    ) -> list[str]:
        shape, index = self._out.shape, self._index(self._out.shape)
        if self._out.dtype != torch.float32:
            raise Unfit
        a, top = self._value(x, shape, index, torch.float32), torch.finfo(torch.float32).max
        most, least = (
            self._value(v, shape, index, torch.float32)
            for v in (top if posinf is None else posinf, -top if neginf is None else neginf)
        )
        zero = self._value(nan or 0.0, shape, index, torch.float32)
        return self._store(shape, index, f"({a} != {a} ? {zero} : FINITE({a}) ? {a} : {a} > 0 ? {most} : {least})", [x])

    def _emit_constant_pad_nd(self, x: Tensor, pad: Sequence[int], value: Any = 0) -> list[str]:
        shape, index = self._out.shape, self._index(self._out.shape)
        before = [0] * x.dim()
        for d in range(len(pad) // 2):
            before[-1 - d] = pad[2 * d]
        if (
            min(pad) < 0
            or (not self._shared and (before[0] or x.shape[0] != self._worlds))
            or any(i == "0" and n != 1 for i, n in zip(index, x.shape, strict=True))
        ):
            raise Unfit
        view, inside = self._view(x), []
        self._reads.append(self._access(view, view.shape))
        for d, i in enumerate(index):
            if i not in (WORLD, "0"):
                inside.append(f"{i} >= {before[d]} && {i} < {before[d] + x.shape[d]}")
        shift = -sum(b * s for b, s in zip(before, view.strides, strict=True))
        element = self._at(view, view.strides, index, shift)
        return self._store(
            shape,
            index,
            f"(({' && '.join(inside)}) ? {element} : {self._value(value, shape, index, self._out.dtype)})",
            [x],
        )

    def _emit_pad(self, x: Tensor, pad: Sequence[int], mode: str = "constant", value: Any = None) -> list[str]:
        if mode != "constant":
            raise Unfit
        return self._emit_constant_pad_nd(x, pad, value or 0)

    def _emit_flatten(self, x: Tensor, *_: Any) -> list[str]:
        """Copy the elements to a new shape, if that needs a copy."""
        view, strides = self._view(x), [math.prod(x.shape[d + 1 :]) for d in range(x.dim())]
        if self._shared or x.shape[0] != self._worlds or self._out.dtype != x.dtype:
            raise Unfit
        index = self._index(view.shape)
        self._reads.append(self._access(view, view.shape))
        return self._loops(
            view.shape, index, [f"{self._at(self._out, strides, index)} = {self._at(view, view.strides, index)};"]
        )

    _emit_reshape = _emit_unsafe_view = _emit_flatten

    def _reduce(self, node: Node, name: str) -> list[str]:
        args: tuple[Any, ...] = (*node.args, None)
        x, view = args[0], self._view(args[0])
        dims = args[2 if name == "linalg_vector_norm" else 1]
        dims = range(x.dim()) if dims is None or dims == [] else [dims] if isinstance(dims, int) else dims
        dims = {d % max(x.dim(), 1) for d in dims}
        if (not self._shared and (0 in dims or x.shape[0] != self._worlds)) or (
            name == "linalg_vector_norm" and args[1] != 2
        ):
            raise Unfit
        if (self._shared and math.prod(x.shape) > SMALL) or node.kwargs.get("dtype") not in (None, self._out.dtype):
            raise Unfit
        index, kind = self._index(x.shape, "k"), TYPES[self._out.dtype]
        kept = ["0" if d in dims else i for d, i in enumerate(index)]
        out = kept if len(self._out.shape) == x.dim() else [i for d, i in enumerate(index) if d not in dims]
        self._reads.append(self._access(view, x.shape))
        start, step = _REDUCTIONS[name]
        element, first = (f"({kind})({self._at(view, view.strides, where)})" for where in (index, kept))
        summed = [n if d in dims else 1 for d, n in enumerate(x.shape)]
        along = [i if d in dims else "0" for d, i in enumerate(index)]
        update = [f"{kind} a = {element};", f"s = {step.format(s='s', a='a')};"]
        inner = self._loops(summed, along, update, alone=True)
        end = {"mean": f"s / {math.prod(x.shape[d] for d in dims)}", "linalg_vector_norm": "sqrtf(s)"}.get(name, "s")
        body = [f"{kind} s = {start or first};", *inner, f"{self._write(out)} = {end};"]
        return self._loops([1 if d in dims else n for d, n in enumerate(x.shape)], kept, body)

    def _join(self, tensors: Sequence[Tensor], dim: int, stacked: bool) -> list[str]:
        """cat and stack: copy each tensor to its position along ``dim``."""
        shape, lines, start = self._out.shape, list[str](), 0
        dim %= len(shape)
        if dim == 0 and not self._shared:
            raise Unfit
        for tensor in tensors:
            if not tensor.numel():
                continue
            part = tensor.unsqueeze(dim) if stacked else tensor
            view = self._view(part)
            self._reads.append(self._access(view, view.shape))
            index, offset = self._index(view.shape), start * self._out.strides[dim]
            to = self._at(self._out, self._out.strides, index, offset)
            lines += self._loops(
                view.shape, index, [f"{to} = ({TYPES[self._out.dtype]}){self._at(view, view.strides, index)};"]
            )
            start += view.shape[dim]
        if any(self._view(tensor).block == self._out.block for tensor in tensors if tensor.numel()):
            raise Unfit
        return lines

    def _emit_cat(self, tensors: Sequence[Tensor], dim: int = 0, **_: Any) -> list[str]:
        return self._join(tensors, dim, stacked=False)

    def _emit_stack(self, tensors: Sequence[Tensor], dim: int = 0, **_: Any) -> list[str]:
        return self._join(tensors, dim, stacked=True)

    def _picked(self, x: Tensor, place: Sequence[str]) -> str:
        """An element of ``x`` at indices of run time. In a tensor of worlds only the world's own row is allowed."""
        view = self._view(x)
        own = bool(place) and place[0] == WORLD and x.shape[0] == self._worlds
        access = self._access(view, view.shape) if own else Access(view, 0, view.offset, view.offset + span_of(view))
        self._reads.append(access)
        return self._at(view, view.strides, place)

    def _emit_index_select(self, x: Tensor, dim: int, index: Tensor, **_: Any) -> list[str]:
        shape, at = self._out.shape, self._index(self._out.shape)
        dim %= x.dim()
        where = self._view(index)
        self._reads.append(
            self._access(where, index.shape)
            if not self._shared and dim == 0
            else Access(where, 0, where.offset, where.offset + span_of(where))
        )
        at[dim] = f"(int){self._at(where, where.strides, [at[dim]])}"
        return self._store(shape, self._index(shape), self._picked(x, at), [x])

    def _emit_gather(self, x: Tensor, dim: int, index: Tensor, **_: Any) -> list[str]:
        shape = self._out.shape
        at = self._index(shape)
        dim %= x.dim()
        if dim == 0 and not self._shared:
            raise Unfit
        chosen = [*at]
        chosen[dim] = f"(int){self._read(index, shape, at)}"
        return self._store(shape, at, self._picked(x, chosen), [x, index])

    def _emit_index(self, x: Tensor, indices: Sequence[Tensor | None]) -> list[str]:
        shape = self._out.shape
        used = [d for d, i in enumerate(indices) if i is not None]
        if (
            not used
            or used != list(range(used[0], used[-1] + 1))
            or any(i is not None and i.dtype == torch.bool for i in indices)
        ):
            raise Unfit
        common = torch.broadcast_shapes(*(indices[d].shape for d in used))  # type: ignore[union-attr]
        at, first = self._index(shape), used[0]
        inner, place = at[first : first + len(common)], at[:first]
        for d in used:
            tensor = indices[d]
            assert tensor is not None
            view = self._view(tensor)
            world = not self._shared and first == 0
            self._reads.append(
                self._access(view, common) if world else Access(view, 0, view.offset, view.offset + span_of(view))
            )
            j = self._at(view, spread(view, common), inner)
            place.append(f"(int)({j} < 0 ? {j} + {x.shape[d]} : {j})")
        return self._store(shape, at, self._picked(x, [*place, *at[first + len(common) :]]), [x])

    def _emit_mm(self, a: Tensor, b: Tensor, **_: Any) -> list[str]:
        if self._shared or self._out.dtype != torch.float32:
            raise Unfit
        (columns,) = self._out.shape[1:]
        left, right = self._view(a), self._view(b)
        self._reads += [self._access(left, left.shape), Access(right, 0, right.offset, right.offset + span_of(right))]
        j = "0" if columns == 1 else "j"
        term = f"s += {self._at(left, left.strides, [WORLD, 'k'])} * {self._at(right, right.strides, ['k', j])};"
        body = [
            "float s = 0;",
            *self._loops([a.shape[1]], ["k"], [term], alone=True),
            f"{self._write([WORLD, j])} = s;",
        ]
        return self._loops([columns], [j], body)

    def _emit_linalg_cross(self, a: Tensor, b: Tensor, dim: int = -1, **_: Any) -> list[str]:
        shape = self._out.shape
        if dim % len(shape) != len(shape) - 1:
            raise Unfit
        at = self._index(shape)[:-1]
        x, y = (
            [self._read(v, shape, [*at, str(k)]) if k else self._read(v, shape, [*at, "0"]) for k in range(3)]
            for v in (a, b)
        )
        values = [
            f"float c{k} = {x[i]} * {y[j]} - {x[j]} * {y[i]};" for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1)))
        ]
        return self._loops(
            shape[:-1], at, [*values, *(f"{self._write([*at, str(k) if k else '0'])} = c{k};" for k in range(3))]
        )

    # ---- memory: elements, loops over them, and the division of work among the lanes of a world ----------------------

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
