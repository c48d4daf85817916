"""Unitree's robots as a ``Robot``, over their low-level DDS interface (the wire), and a simulated robot on the wire.

Only ``idl`` and ``link`` import cyclonedds. Import them only where the wire is used.
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

    On Linux it also runs while the computer sleeps. A change of the date does not change it.
    """
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)
