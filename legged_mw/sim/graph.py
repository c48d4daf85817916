"""Recording a fixed sequence of work once and replaying it as a CUDA graph."""

from __future__ import annotations

from collections.abc import Callable

import torch


class StepGraph:
    """Calls ``fn``; on a GPU every call after the first three replays one CUDA graph of torch and warp work together.

    ``fn`` may touch only tensors that outlive it, in place, and may not ask the host for a value.
    The first calls are real ones: they compile kernels and warm the allocators, and no step is thrown away.
    """

    def __init__(self, fn: Callable[[], None], device: str, eager: bool = False, warmup: int = 3) -> None:
        self._fn, self._warmup = fn, warmup
        self._graph: torch.cuda.CUDAGraph | None = None
        self._stream = torch.cuda.Stream(device) if device.startswith("cuda") and not eager else None

    @property
    def recorded(self) -> bool:
        """Whether calls are replays by now."""
        return self._graph is not None

    def __call__(self) -> None:
        if self._graph is not None:
            self._graph.replay()
        elif self._stream is None:
            self._fn()
        else:
            self._first_calls(self._stream)

    def _first_calls(self, stream: torch.cuda.Stream) -> None:
        """Eager while warming up, then record and replay; all on one side stream, as capture demands."""
        import warp as wp  # a second to import, and only for a GPU

        wp.init()  # which is nothing where a simulation has done so
        current = torch.cuda.current_stream(stream.device)
        stream.wait_stream(current)
        wp_stream = wp.stream_from_torch(stream)
        if self._warmup:
            self._warmup -= 1
            with torch.cuda.stream(stream), wp.ScopedStream(wp_stream, sync_enter=False):
                self._fn()
            current.wait_stream(stream)
            return
        torch.cuda.synchronize(stream.device)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph, stream=stream), wp.ScopedStream(wp_stream, sync_enter=False):
            wp.capture_begin(stream=wp_stream, external=True)
            try:
                self._fn()
            finally:
                wp.capture_end(stream=wp_stream)
        self._graph = graph
        current.wait_stream(stream)
        graph.replay()
