"""What this process may use of the machine it runs on."""

from __future__ import annotations

import math
import os
from pathlib import Path

from legged_mw.utils.errors import UserError


def usable_cores() -> int:
    """CPU cores of this process: those it may run on, shared with the other processes that torchrun started here."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // int(os.environ.get("LOCAL_WORLD_SIZE", "1")))


def free_memory(device: str = "cpu") -> float:
    """Bytes that a process may still take on ``device``; infinite where nobody says."""
    if device != "cpu":
        import torch  # here alone: legged_mw.deploy runs where it is not installed

        return float(torch.cuda.mem_get_info(device)[0])
    lines = _read("/proc/meminfo").splitlines()
    free = [1024.0 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    limit, used = (_read(f"/sys/fs/cgroup/memory.{name}") for name in ("max", "current"))  # of a container
    return min([*free, float(limit) - float(used) if limit.isdigit() and used.isdigit() else math.inf])


def require_memory(need: float, device: str, what: str, instead: str) -> None:
    """Refuse ``what`` takes at least ``need`` bytes before it is allocated, if ``device`` has less. Raises UserError."""
    free = free_memory(device)
    if need > free:
        where = "this machine" if device == "cpu" else device
        raise UserError(f"{what} needs {in_bytes(need)} of memory at least, and {where} has {in_bytes(free)} free: {instead}")


def in_bytes(count: float) -> str:
    """A number of bytes in words: 19.6 GB."""
    power = min(int(math.log10(max(count, 1.0))) // 3, 8)
    return f"{count / 1000**power:.3g} {('bytes', 'kB', 'MB', 'GB', 'TB', 'PB', 'EB', 'ZB', 'YB')[power]}"


def _read(path: str) -> str:
    try:
        return Path(path).read_text().strip()
    except OSError:
        return ""
