"""Unitree's robots over their low-level DDS interface, each as a ``Robot``, and a simulated robot on the same wire.

Only ``idl`` and ``link`` import cyclonedds. Import these two only where the wire is used.
"""

from __future__ import annotations

import time
from importlib.util import find_spec

from legged_mw.utils.errors import UserError

_CLOCK = getattr(time, "CLOCK_BOOTTIME", None)
INSTALL = "pip install 'legged_mw[unitree]'"


def need_dds() -> None:
    """Raise UserError with the install command if cyclonedds is missing."""
    if find_spec("cyclonedds") is None:
        raise UserError(f"Unitree's robots speak DDS, which needs cyclonedds: {INSTALL}")


def clock() -> float:
    """Time [s] from a fixed moment, the same for all processes of a machine.

    On Linux it runs on while the computer sleeps. Setting the date does not change it.
    """
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)
