"""What memory a machine has left; tests/golden/numbers.py has the numbers and sizes that are refused."""

from __future__ import annotations

import pytest

from legged_mw.utils import machine


def test_what_a_container_keeps_of_files_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    files = {"/proc/meminfo": "MemTotal: 64000000 kB\nMemAvailable: 32000000 kB"}
    monkeypatch.setattr(machine, "_read", lambda path: files.get(path, ""))
    assert machine.free_memory() == 32e6 * 1024
    files |= {f"/sys/fs/cgroup/memory.{name}": text for name, text in {"max": "8000", "current": "7900"}.items()}
    assert machine.free_memory() == 100.0
    files["/sys/fs/cgroup/memory.stat"] = "file 6000\ninactive_file 5000\nactive_file 1000"
    assert machine.free_memory() == 5100.0
