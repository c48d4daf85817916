"""Facts of a device for messages: CUDA version, memory in use, compiled kernels."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event, Thread
from typing import NamedTuple

import torch

GRAPHS_SINCE = (12, 4)  # CUDA version of the driver; mujoco-warp warns that recording with older ones is unreliable
_OTHERS = 1.0  # [GiB] on a GPU; a desktop uses less, a training uses more
# [s] between checks for newly compiled kernels; a start without compilation ends before the first check
_WAITS = (6.0, 6.0, 12.0)


class DeviceFacts(NamedTuple):
    """Facts of a device; memory in GiB."""

    name: str
    cuda: tuple[int, int] | None  # version that the driver supports
    pool: bool  # memory can be allocated while a graph is recorded
    cache: Path  # folder of compiled kernels
    compiled: int  # number of kernel modules in ``cache`` for this device
    memory: float = 0.0
    taken: float = 0.0  # memory in use by all processes
    binaries: str = ""  # pattern of the names of compiled files

    def slow(self) -> list[str]:
        """A message for each reason why the start or the training is slow on this device."""
        lines = []
        if not self.compiled:
            compiling = "some 50 modules of kernels are compiled at this first start, a minute or two"
            lines.append(f"{compiling}; `legged-mw warm` does it ahead")
        if self.memory and not self.pool:
            lines.append("this GPU has no memory pool: nothing can be recorded, and a step takes several times as long")
        if self.cuda and self.cuda < GRAPHS_SINCE:
            has, since = (".".join(map(str, version)) for version in (self.cuda, GRAPHS_SINCE))
            lines.append(f"the driver supports CUDA {has}, and recording is reliable from {since} on: update it")
        if self.taken > _OTHERS:
            held = f"{self.taken:.0f} of {self.memory:.0f} GiB"
            lines.append(f"another process holds {held} of this GPU: both run slower (nvidia-smi shows which)")
        return lines

    def compiled_since(self, begun: float) -> int:
        """Number of kernel modules of all packages compiled after ``begun`` [s, time.time()]."""
        files = self.cache.glob(f"wp_*/{self.binaries}")
        return len({file.parent for file in files if file.stat().st_mtime >= begun})

    @contextmanager
    def say_compiling(self, say: Callable[[str], object] = print, waits: Sequence[float] = _WAITS) -> Iterator[Thread]:
        """A context in which a thread prints once if kernels are compiled. ``slow`` reports an empty cache instead."""
        begun, over = time.time(), Event()

        def watch() -> None:
            for seconds in waits if self.compiled else ():
                if over.wait(seconds):
                    return
                if count := self.compiled_since(begun):
                    text = f"kernels that this task needs are being compiled, {count} modules so far"
                    say(f"{text}; the next start has them")
                    return

        thread = Thread(target=watch, daemon=True)
        thread.start()
        try:
            yield thread
        finally:
            over.set()


def device_facts(device: str) -> DeviceFacts:
    """The facts of ``device``. Call it before this process allocates memory there: ``taken`` would include it."""
    import warp as wp  # here, because importing warp takes about 1 s

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    here, cache = wp.get_device(device), Path(wp.config.kernel_cache_dir or "")
    kind = f"*.sm{here.get_cuda_compile_arch()}*" if here.is_cuda else "*.cpu*.o"
    compiled = len({file.parent for file in cache.glob(f"wp_mujoco_warp*/{kind}")})
    if not here.is_cuda:
        return DeviceFacts(here.name, None, True, cache, compiled, binaries=kind)
    free, memory = (size / 2**30 for size in torch.cuda.mem_get_info(device))
    driver, pool = wp.get_cuda_driver_version(), wp.is_mempool_supported(here)
    return DeviceFacts(here.name, driver, pool, cache, compiled, memory, memory - free, kind)
