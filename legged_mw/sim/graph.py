"""Recording a fixed sequence of work once and replaying it as a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from legged_mw.sim.fusion import Fusion
from legged_mw.utils.errors import NotRecordable, line_to_blame, out_of_memory


class StepGraph:
    """Calls ``fn``; on a GPU every call after the first three replays one CUDA graph of torch and warp work together.

    ``fn`` may touch only tensors that outlive it, in place, and may not ask the host for a value.
    The first calls are real ones: they compile kernels and warm the allocators, and no step is thrown away.
    A step of many ``worlds`` is fused meanwhile (``fused.py``); its kernels are compiled beside it, and recorded when they are there.
    """

    def __init__(self, fn: Callable[[], None], device: str, eager: bool = False, warmup: int = 3, worlds: int = 0) -> None:
        self._fn, self._device, self._warmup = fn, device, warmup
        self._graph: torch.cuda.CUDAGraph | None = None
        self._stream = torch.cuda.Stream(device) if device.startswith("cuda") and not eager else None
        self._fusion = Fusion(fn, worlds, device) if worlds and self._stream else None

    @property
    def recorded(self) -> bool:
        """Whether calls are replays by now."""
        return self._graph is not None

    @property
    def fusing(self) -> bool:
        """Whether kernels of the fused step are still compiled, or not yet in use."""
        return self._fusion is not None

    def fuse(self, worlds: int, keep: Callable[[], Callable[[], None]], watched: Iterable[Tensor]) -> None:
        """On a CPU: fuse now. ``keep`` remembers all that ``fn`` writes, and returns what puts it back; ``watched`` as in ``Trace``."""
        put_back = keep()
        fusion = Fusion(self._fn, worlds, self._device)
        fusion.trace(watched)
        put_back()
        fusion.compile(wait=None)
        self._fn = fusion.verify()
        put_back()

    def __call__(self) -> None:
        if self._fusion and self._fusion.ready and self._stream:
            fusion, self._fusion, self._graph = self._fusion, None, None
            self._aside(self._stream, lambda: setattr(self, "_fn", fusion.verify()))
        elif self._graph is not None:
            self._graph.replay()
        elif self._stream is None:
            self._fn()
        else:
            self._first_calls(self._stream)

    def _aside(self, stream: torch.cuda.Stream, fn: Callable[[], None]) -> None:
        """Run ``fn`` on the side stream that capture demands."""
        import warp as wp  # a second to import, and only for a GPU

        wp.init()  # which is nothing where a simulation has done so
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        with torch.cuda.stream(stream), wp.ScopedStream(wp.stream_from_torch(stream), sync_enter=False):
            fn()
        current.wait_stream(stream)

    def _first_calls(self, stream: torch.cuda.Stream) -> None:
        """Eager while warming up, then record and replay."""
        if self._warmup:
            self._warmup -= 1
            fusion = self._fusion
            self._aside(stream, fusion.trace if fusion and self._warmup == 1 else self._fn)
            if fusion and not self._warmup:
                fusion.compile(wait=0.0)
            return
        import warp as wp

        torch.cuda.synchronize(stream.device)
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        self._graph = self._record(stream, wp, wp.stream_from_torch(stream))
        current.wait_stream(stream)
        self._graph.replay()

    def _record(self, stream: torch.cuda.Stream, wp: Any, wp_stream: Any) -> torch.cuda.CUDAGraph:
        """The graph of one call. Raises NotRecordable with the line of ``fn`` that failed, not with what then failed to end."""
        graph, failed = torch.cuda.CUDAGraph(), None
        try:
            with torch.cuda.graph(graph, stream=stream), wp.ScopedStream(wp_stream, sync_enter=False):
                wp.capture_begin(stream=wp_stream, external=True)
                try:
                    self._fn()
                except Exception as error:
                    failed = error
                    raise
                finally:
                    wp.capture_end(stream=wp_stream)
        except Exception as error:
            first = failed or error
            if isinstance(first, RuntimeError) and not out_of_memory(first):
                raise _refused(first) from None
            raise first from None
        return graph


def _refused(error: RuntimeError) -> NotRecordable:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    what = f"cannot be recorded for a GPU ({reason}); a recorded step asks the host for no value, copies none, and has fixed shapes"
    return NotRecordable(what, line_to_blame(error)[0])
