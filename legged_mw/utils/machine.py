"""What this process may use of the machine it runs on, and what a call in it may take."""

from __future__ import annotations

import gc
import math
import os
import re
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from legged_mw.utils.errors import UserError


def usable_cores() -> int:
    """CPU cores of this process: those it may run on, shared with the other processes that torchrun started here."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def settle() -> None:
    """All that stays is made: garbage that nobody collected while the program started is never looked through again."""
    if not gc.isenabled():
        gc.freeze()
        gc.enable()


def free_memory(device: str = "cpu") -> float:
    """Bytes that a process may still take on ``device``; infinite where nobody says."""
    if device != "cpu":
        import torch  # here alone: legged_mw.deploy runs where it is not installed

        return float(torch.cuda.mem_get_info(device)[0])
    lines = _read("/proc/meminfo").splitlines()
    free = [1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    limit, used = (_read(f"/sys/fs/cgroup/memory.{name}") for name in ("max", "current"))  # of a container
    # of files; given back when asked for
    cached = re.search(r"^inactive_file (\d+)$", _read("/sys/fs/cgroup/memory.stat"), re.MULTILINE)
    if limit.isdigit() and used.isdigit():
        free.append(float(limit) - float(used) + float(cached[1] if cached else 0))
    return min(free, default=math.inf)


def require_memory(need: float, device: str, what: str, instead: str) -> None:
    """Refuse ``what`` takes at least ``need`` bytes before it is allocated, if ``device`` has less. Raises UserError."""
    free = free_memory(device)
    if need > free:
        where = "this machine" if device == "cpu" else device
        raise UserError(
            f"{what} needs {in_bytes(need)} of memory at least, and {where} has {in_bytes(free)} free: {instead}"
        )


def in_bytes(count: float) -> str:
    """A number of bytes in words: 19.6 GB."""
    power = min(int(math.log10(max(count, 1.0))) // 3, 8)
    return f"{count / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB', 'TB', 'PB', 'EB', 'ZB', 'YB')[power]}"


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""


def contained(work: Callable[[], Any], seconds: float, room: int, stop: Callable[[], None] = lambda: None) -> Any:
    """What ``work`` returns, or raises, within that time and ``room`` [byte] of new memory; for a call that a stranger's file decides.

    Past its time it is asked to ``stop``, and a TimeoutError raised; if it does not, it is left behind. Memory is limited on Linux.
    """
    ended: Future[Any] = Future()

    def run() -> None:
        try:
            ended.set_result(work())
        except BaseException as error:
            ended.set_exception(error)

    thread = threading.Thread(target=run, daemon=True)
    with limited_memory(room):
        thread.start()
        thread.join(seconds)
        if late := thread.is_alive():
            stop()
            thread.join(1.0)
    if late:
        raise TimeoutError(f"it has not ended within {seconds:g} s")
    return ended.result()


@contextmanager
def limited_memory(size: int) -> Iterator[None]:
    """Meanwhile the process may take ``size`` [byte] more than it has."""
    if not Path("/proc/self/statm").exists():
        yield
        return
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + size
    resource.setrlimit(resource.RLIMIT_AS, (most if soft == resource.RLIM_INFINITY else min(most, soft), hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))
