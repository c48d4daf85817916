"""Fuse the many small operations of a step into a few warp kernels. One thread computes one world.

The operations of one real step are traced. Operations within a world are fused into kernels. Other operations, such as
random numbers and sums over worlds, still run in torch. The simulator's calls keep their order. Before a fused step is
used, the result of each part is compared with that of the original operations, on the data of a real step.
"""

# pyright: reportInvalidTypeForm=false
# (warp compiles this file as its own language)
from __future__ import annotations

import heapq
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from typing import Any

import torch
import warp as wp
from torch import Tensor

from legged_mw.check.held import whole
from legged_mw.fast.fused_code import ADD_ROWS, ASSIGN, HELPERS, TYPES, Access, Code, Unfit, Writer
from legged_mw.fast.trace import Call, Node, Trace, alike

if wp.config.log_level < wp.LOG_WARNING:  # MuJoCo's engine steps: keep warp from announcing its devices and modules
    wp.config.log_level = wp.LOG_ERROR

BLOCK, LANES = 32, 8  # threads per block, threads per world: 4096 worlds fill a large GPU
_WIDE, _RESIDENT = 64, 2**18  # with more values an operation gets 32 lanes, if a large GPU can run all at once
_ROOM = 5_500  # bytes of shared memory for the temporaries of one world
_CLOSE = 1e-4  # relative and absolute tolerance: float32 rounding over a few operations
_STRAYS = 0.002  # share of elements with a larger difference, such as after a comparison with rounding


class Kernel:
    """A kernel of several nodes: one thread per world on a CPU, several threads (lanes) per world on a GPU."""

    def __init__(self, nodes: Sequence[Node], worlds: int) -> None:
        self.nodes, self._worlds = nodes, worlds

    def write(self, trace: Trace, own: set[int]) -> None:
        """Generate the source. Blocks in ``own`` are temporaries of this kernel, in shared memory if they fit."""
        used = dict.fromkeys(view.block for node in self.nodes for view in (*node.reads, *node.writes))
        self._device = str(trace.blocks[next(iter(used))].device)
        self._lanes = 1 if self._device == "cpu" else self._lanes_of_gpu()
        sizes = {block: self._size(trace.blocks[block]) for block in used if block in own}
        room, kept = _ROOM, dict[int, int]()
        for block in sorted(sizes, key=sizes.__getitem__):
            room -= sizes[block] * trace.blocks[block].element_size()
            if self._lanes == 1 or room >= 0:
                kept[block] = sizes[block]
        names = {block: (f"t{i}" if block in kept else f"p{i}", block in kept) for i, block in enumerate(used)}
        writer = Writer(self._worlds, trace.view, names.__getitem__)
        lines, self._blocks = [f"#define LANES {self._lanes}\n#define BLOCK {BLOCK}", HELPERS], list[Tensor]()
        for block, (name, mine) in names.items():
            kind = TYPES[trace.blocks[block].dtype]
            if mine:
                lines.append(f"OWN({kind}, {name}, {kept[block]})")
            else:
                lines.append(f"{kind}* __restrict__ {name} = ({kind}*)table[{len(self._blocks)}];")
                self._blocks.append(trace.blocks[block])
        for node in self.nodes:
            lines += writer.emit(node).lines
        self._source = "\n".join(lines)
        self._kernel = _kernel_of(wp.func_native(self._source)(_body))

    def _lanes_of_gpu(self) -> int:
        """Threads per world: 8 for many short operations, 32 for wide operations."""
        widest = max(math.prod(view.shape[1:]) for node in self.nodes for view in node.writes)
        return BLOCK if widest > _WIDE and self._worlds * BLOCK <= _RESIDENT else LANES

    def _size(self, tensor: Tensor) -> int:
        """Number of elements of one world's part of a tensor, or of a tensor that all worlds share."""
        return tensor.numel() // (self._worlds if tensor.shape[:1] == (self._worlds,) else 1)

    def compile(self) -> None:
        """Compile into warp's cache without loading. On a CPU ``load`` compiles."""
        if self._device != "cpu":
            wp.compile_aot_module(self._kernel.module, device=self._device)

    def load(self) -> None:
        addresses = [tensor.untyped_storage().data_ptr() for tensor in self._blocks]
        self._table = wp.array(addresses, dtype=wp.uint64, device=self._device)
        wp.load_module(self._kernel.module, device=self._device, block_dim=BLOCK)

    def __call__(self) -> None:
        wp.launch(
            self._kernel, dim=self._worlds * self._lanes, inputs=[self._table], device=self._device, block_dim=BLOCK
        )


def _body(table: wp.array(dtype=wp.uint64), thread: int) -> None: ...


def _kernel_of(body: Any) -> Any:
    def fused(table: wp.array(dtype=wp.uint64)) -> None:
        body(table, wp.tid())

    return wp.kernel(fused, enable_backward=False, module="unique", module_options={"block_dim": BLOCK})


class Region:
    """The operations between two calls of the simulator, in original and fused form."""

    def __init__(self, nodes: Sequence[Node], worlds: int, trace: Trace, device: str, there: set[int]) -> None:
        """``there``: blocks of memory that exist before the step."""
        self.nodes = _join(nodes, trace.watched)
        self.steps = list[Kernel | Node](_schedule(self.nodes, worlds, trace, device))
        written = {view.block for node in self.nodes for view in node.writes} & there
        self._written = [whole(trace.blocks[block]) for block in sorted(written)]

    @property
    def kernels(self) -> list[Kernel]:
        return [step for step in self.steps if isinstance(step, Kernel)]

    def __call__(self) -> None:
        for step in self.steps:
            step() if isinstance(step, Kernel) else _replay(step)

    def verify(self, device: str) -> bool:
        """Run original and fused kernels from the same state. Returns whether they agree; else keeps the original."""
        before, random = [value.clone() for value in self._written], _generator(device).get_state()
        for node in self.nodes:
            _replay(node)
        after = [value.clone() for value in self._written]
        for value, old in zip(self._written, before, strict=True):
            value.copy_(old)
        _generator(device).set_state(random)
        self()
        if same := all(alike(a, b, _CLOSE, _STRAYS) for a, b in zip(after, self._written, strict=True)):
            return same
        for value, right in zip(self._written, after, strict=True):
            value.copy_(right)
        self.steps = list(self.nodes)
        return same


class Fused:
    """A fused step, made from its trace: ``compile`` it (in any thread), ``verify`` it on a real step, then call it."""

    def __init__(self, trace: Trace, worlds: int, device: str) -> None:
        self._device, self.parts = device, list[Region | Call]()
        nodes, there = list[Node](), {*range(len(trace.blocks))} - trace.made
        for step in [*trace.steps, None]:
            if isinstance(step, Node):
                nodes.append(step)
                continue
            if nodes:
                self.parts.append(Region(nodes, worlds, trace, device, there))
                there |= {view.block for node in nodes for view in node.writes}
                nodes = []
            if step:
                self.parts.append(step)
        used: dict[int, set[int]] = {}
        for number, blocks in enumerate(self._uses()):
            for block in blocks:
                used.setdefault(block, set()).add(number)
        for number, what in enumerate(self._steps()):
            if isinstance(what, Kernel):
                what.write(trace, {block for block in trace.made if used.get(block) == {number}})
        trace.steps.clear()

    def _steps(self) -> Iterator[Kernel | Node | Call]:
        for part in self.parts:
            yield from part.steps if isinstance(part, Region) else [part]

    def _uses(self) -> Iterator[set[int]]:
        for step in self._steps():
            if isinstance(step, Call):
                yield set(step.given)
            else:
                nodes = step.nodes if isinstance(step, Kernel) else [step]
                yield {view.block for node in nodes for view in (*node.reads, *node.writes)}

    @property
    def kernels(self) -> list[Kernel]:
        return [kernel for part in self.parts if isinstance(part, Region) for kernel in part.kernels]

    def compile(self) -> None:
        """Compile the kernels that are not in warp's cache. It may run during a graph capture on the same GPU."""
        for kernel in self.kernels:
            kernel.compile()

    def verify(self) -> int:
        """Load the kernels and run one real step with them. Returns how many regions keep their original operations."""
        for kernel in self.kernels:
            kernel.load()
        wrong = 0
        for part in self.parts:
            if isinstance(part, Region):
                wrong += not part.verify(self._device)
            else:
                part.run()
        return wrong

    def __call__(self) -> None:
        for part in self.parts:
            part() if isinstance(part, Region) else part.run()


# ---- scheduling -----------------------------------------------------------------------------------------


def _schedule(nodes: Sequence[Node], worlds: int, trace: Trace, device: str) -> Iterator[Kernel | Node]:
    """Sort the operations topologically and group them into as few kernels as possible."""
    codes = [_code(node, worlds, trace, device) for node in nodes]
    waits, wakes = _dependencies(nodes)
    ready: tuple[list[int], list[int]] = ([], [])  # nodes for torch, nodes for a kernel

    def wake(i: int) -> None:
        heapq.heappush(ready[codes[i] is not None], i)

    for i in (i for i, count in enumerate(waits) if not count):
        wake(i)

    def done(i: int) -> None:
        for j in wakes[i]:
            waits[j] -= 1
            if not waits[j]:
                wake(j)

    while ready[0] or ready[1]:
        while ready[0]:
            i = heapq.heappop(ready[0])
            yield nodes[i]
            done(i)
        together, rows, later = list[Node](), _Rows(worlds), list[int]()
        while ready[1]:
            i = heapq.heappop(ready[1])
            code = codes[i]
            assert code is not None
            if rows.take(code):
                together.append(nodes[i])
                done(i)
            elif together:
                later.append(i)
            else:  # it does not fit, even alone
                yield nodes[i]
                done(i)
        ready[1].extend(sorted(later))
        if together:
            yield Kernel(together, worlds)


def _join(nodes: Sequence[Node], watched: set[int]) -> list[Node]:
    """Join pairs of operations that have one common code, if no other node reads the intermediate result.

    Only torch may write blocks in ``watched``.
    """
    readers = Counter(view.block for node in nodes for view in node.reads)
    joined = list[Node]()
    for node in nodes:
        pair = None
        if joined and readers[joined[-1].writes[0].block] == 1 and node.writes[0].block not in watched:
            pair = _sum_over_worlds(joined[-1], node) or _assignment(joined[-1], node)
        if pair:
            joined.pop()
        joined.append(pair or node)
    return joined


def _sum_over_worlds(total: Node, node: Node) -> Node | None:
    """``to.add_(rows.sum(dim=0))``: a sum over worlds and its addition to a fixed tensor."""
    if (total.name, node.name) != ("sum", "add") or not node.func._schema.is_mutable or node.kwargs:
        return None
    rows, dims = total.args[0], [*total.args[1]] if len(total.args) > 1 and total.args[1] else []
    over_worlds = len(total.args) < 3 and (dims == [0] or (not dims and rows.dim() == 1))
    if len(node.args) != 2 or node.args[1] is not total.outs[0] or not over_worlds:
        return None
    if total.writes[0].shape != node.writes[0].shape:
        return None
    return Node(ADD_ROWS, (node.args[0], rows), {}, (), (total.reads[0], node.writes[0]), node.writes)


def _assignment(chosen: Node, node: Node) -> Node | None:
    """``to.copy_(torch.where(mask, value, to))``."""
    if (chosen.name, node.name) != ("where", "copy") or len(chosen.args) != 3 or len(node.args) != 2:
        return None
    (mask, value, kept), (to, source) = chosen.args, node.args
    if source is not chosen.outs[0] or not isinstance(kept, Tensor) or kept.dtype != source.dtype != to.dtype:
        return None
    if (kept.data_ptr(), kept.shape, kept.stride()) != (to.data_ptr(), to.shape, to.stride()):
        return None
    return Node(ASSIGN, (to, mask, value), {}, (), chosen.reads, node.writes)


def _code(node: Node, worlds: int, trace: Trace, device: str) -> Code | None:
    """C code of the node for one world; None if it has none."""
    out = node.writes[0]
    shared = worlds not in out.shape[:1] and node.func is not ADD_ROWS
    if node.random or out.block in trace.watched or (shared and out.block not in trace.made):
        return None
    for view in (*node.reads, *node.writes):
        if str(trace.blocks[view.block].device) != device or trace.blocks[view.block].dtype != view.dtype:
            return None
    with suppress(Unfit, TypeError, ValueError, IndexError):  # arguments of an unknown form
        return Writer(worlds, trace.view, lambda block: (f"p{block}", False)).emit(node)
    return None


def _dependencies(nodes: Sequence[Node]) -> tuple[list[int], list[set[int]]]:
    """Each node's number of dependencies, and its dependents: by blocks of memory; draws keep their order."""
    after: list[set[int]] = [set() for _ in nodes]
    wrote, read, drew = dict[int, int](), dict[int, set[int]](), -1
    for i, node in enumerate(nodes):
        for view in node.reads:
            if view.block in wrote:
                after[i].add(wrote[view.block])
            read.setdefault(view.block, set()).add(i)
        for view in node.writes:
            after[i] |= read.pop(view.block, set())
            if view.block in wrote:
                after[i].add(wrote[view.block])
            wrote[view.block] = i
        if node.random:
            after[i] |= {drew} if drew >= 0 else set()
            drew = i
        after[i].discard(i)
    wakes: list[set[int]] = [set() for _ in nodes]
    for i, before in enumerate(after):
        for j in before:
            wakes[j].add(i)
    return [len(before) for before in after], wakes


class _Rows:
    """The memory accesses of a kernel. In a block that one node writes, all nodes must access their world's row."""

    def __init__(self, worlds: int) -> None:
        self._worlds = worlds
        self._pitches: dict[int, set[int]] = {}
        self._written: set[int] = set()

    def take(self, code: Code) -> bool:
        """Add the node if it fits."""
        block = code.write.view.block
        if code.write.pitch < 0:  # a sum over worlds: complete only after all threads
            whole = {access.view.block for access in code.reads if self._row(access) <= 0}
            if block in self._pitches or whole & self._written:
                return False
            self._pitches[block] = {-1}
            self._written.add(block)
            return True
        if code.write.pitch == 0 and (
            block in self._pitches or any(access.view.block == block for access in code.reads)
        ):
            return False
        reached = {block: {self._row(code.write)}}
        for access in code.reads:
            reached.setdefault(access.view.block, set()).add(self._row(access))
        for name, pitches in reached.items():
            pitches = pitches | self._pitches.get(name, set())
            if (name == block or name in self._written) and (len(pitches) > 1 or -1 in pitches):
                return False
        for name, pitches in reached.items():
            self._pitches.setdefault(name, set()).update(pitches)
        self._written.add(block)
        return True

    def _row(self, access: Access) -> int:
        """Pitch of the row of the access; 0: a value that all worlds share; -1: it accesses other rows."""
        if access.pitch == 0:
            return 0
        low = access.low % (self._worlds * access.pitch)
        return access.pitch if low + access.high - access.low <= access.pitch else -1


# ---- operations left to torch ---------------------------------------------------------------------------------------


def _replay(node: Node) -> None:
    """Run the node again on the same memory."""
    if node.func in (ADD_ROWS, ASSIGN):
        node.func(*node.args)
    elif node.func.overloadpacket in (torch.ops.aten.rand, torch.ops.aten.rand_like) and not node.kwargs.get(
        "generator"
    ):
        node.outs[0].uniform_()
    elif node.name.startswith(("empty", "new_empty")):
        pass
    elif into := _INTO.get(str(node.func)):
        into(*node.args, **{**node.kwargs, "out": node.outs[0]})
    else:
        result = node.func(*node.args, **node.kwargs)
        if not node.func._schema.is_mutable:
            for kept, new in zip(node.outs, [result] if isinstance(result, Tensor) else result, strict=True):
                kept.copy_(new)


_INTO: dict[str, Callable[..., Any]] = {
    "aten.sum.dim_IntList": torch.ops.aten.sum.IntList_out,
    "aten.div.Tensor": torch.ops.aten.div.out,
    "aten.mul.Tensor": torch.ops.aten.mul.out,
    "aten.add.Tensor": torch.ops.aten.add.out,
}


def _generator(device: str) -> torch.Generator:
    if device == "cpu":
        return torch.default_generator
    index = torch.device(device).index
    return torch.cuda.default_generators[torch.cuda.current_device() if index is None else index]
