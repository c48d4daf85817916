"""Record a function once as a CUDA graph, and replay it."""

from __future__ import annotations

import gc
from collections.abc import Callable
from typing import Any

import torch

from legged_mw.utils.errors import NotRecordable, line_to_blame, out_of_memory


class StepGraph:
    """Calls ``fn``. On a GPU every call after the first three replays one CUDA graph of its torch and warp kernels.

    ``fn`` may only write in place to tensors that exist after the call, and may not copy values to the host. The first
    calls run ``fn`` without a graph, which compiles kernels and fills the allocators.
    """

    # called once before recording; returns a function with the same results and fewer kernels
    better: Callable[[], Callable[[], None]] | None = None

    def __init__(self, fn: Callable[[], None], device: str, eager: bool = False) -> None:
        self._fn, self._warmup = fn, 3
        self._graph: torch.cuda.CUDAGraph | None = None
        self._stream = torch.cuda.Stream(device) if device.startswith("cuda") and not eager else None

    @property
    def recorded(self) -> bool:
        """Whether calls replay the graph."""
        return self._graph is not None

    def improve(self, fn: Callable[[], None]) -> None:
        """Replace the function by ``fn``, which must have the same results."""
        self._fn = fn

    def __call__(self) -> None:
        if self._graph is not None:
            self._graph.replay()
        elif self._stream is None:
            self._fn()
        else:
            self._first_calls(self._stream)

    def _first_calls(self, stream: torch.cuda.Stream) -> None:
        """Run without a graph for warm-up, then record and replay; all on one side stream, as CUDA capture requires."""
        import warp as wp  # here, because the import takes about 1 s and only a GPU needs it

        wp.init()  # no effect if a simulation has called it
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        wp_stream = wp.stream_from_torch(stream)
        if self._warmup:
            self._warmup -= 1
            with torch.cuda.stream(stream), wp.ScopedStream(wp_stream, sync_enter=False):
                self._fn()
                if self.better and not self._warmup:
                    self.improve(self.better())
            current.wait_stream(stream)
            return
        torch.cuda.synchronize(stream.device)
        self._graph = self._record(stream, wp, wp_stream)
        current.wait_stream(stream)
        self._graph.replay()

    def _record(self, stream: torch.cuda.Stream, wp: Any, wp_stream: Any) -> torch.cuda.CUDAGraph:
        """Record one call. Raises NotRecordable with the line of ``fn`` that failed first."""
        graph, failed, collects = torch.cuda.CUDAGraph(), None, gc.isenabled()
        gc.disable()  # the deletion of another graph would abort the recording
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
        finally:
            if collects:
                gc.enable()
        return graph


def _refused(error: RuntimeError) -> NotRecordable:
    reason = str(error).splitlines()[0] if str(error) else type(error).__name__
    rule = "a recorded step asks the host for no value, copies none, and has fixed shapes"
    return NotRecordable(f"cannot be recorded for a GPU ({reason}); {rule}", line_to_blame(error)[0])
