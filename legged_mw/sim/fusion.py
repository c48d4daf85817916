"""From a step as it is written to the same step fused: trace a call, compile in a thread, verify on another call."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

from torch import Tensor

from legged_mw.utils.trace import Trace

if TYPE_CHECKING:  # it needs warp
    from legged_mw.sim.fused import Fused


class Fusion:
    """Of the step ``fn`` of ``worlds``. What cannot be fused stays as it is, and a line says so."""

    def __init__(self, fn: Callable[[], None], worlds: int, device: str) -> None:
        self._fn, self._worlds, self._device = fn, worlds, device
        self._fused: Fused | None = None
        self._error: Exception | None = None
        self._thread: threading.Thread | None = None

    def trace(self, watched: Iterable[Tensor] = ()) -> None:
        """A real call, which is written down; only torch may write to what is ``watched``."""
        with Trace(watched) as self._trace:
            self._fn()

    def compile(self, wait: float | None) -> None:
        """Begin to compile, and wait so long [s] for the end; None: as long as it takes."""
        self._thread = threading.Thread(target=self._compile, daemon=True)
        self._thread.start()
        self._thread.join(wait)

    def _compile(self) -> None:
        try:
            from legged_mw.sim.fused import Fused

            fused = Fused(self._trace, self._worlds, self._device)
            fused.compile()
            self._fused = fused
        except Exception as error:  # whatever a compiler may throw: the step goes on as it is
            self._error = error

    @property
    def ready(self) -> bool:
        """Whether ``verify`` may be called."""
        return self._thread is not None and not self._thread.is_alive()

    def verify(self) -> Callable[[], None]:
        """A real call, held against the step as it is. Returns what to call from now on."""
        fused, error = self._fused, self._error
        if fused:
            wrong = fused.verify()
            if wrong:
                print(f"{wrong} of {len(fused.parts)} parts of the step are not fused: they gave other values", flush=True)
            return fused
        print(f"the step is not fused: {' '.join(str(error).split())[:200] or type(error).__name__}", flush=True)
        self._fn()
        return self._fn
