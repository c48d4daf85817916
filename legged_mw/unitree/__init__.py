"""Unitree's robots behind the seam ``Robot``, over their low-level DDS interface, and a simulated one at the other end of the wire.

cyclonedds is imported in ``idl`` and ``link`` alone, and these two only where the wire is used.
"""

from __future__ import annotations

import time
from importlib.util import find_spec

from legged_mw.utils.errors import UserError

_CLOCK = getattr(time, "CLOCK_BOOTTIME", None)
INSTALL = "pip install 'legged_mw[unitree]'"


def need_dds() -> None:
    """Raise UserError with the command that installs what is missing."""
    if find_spec("cyclonedds") is None:
        raise UserError(f"Unitree's robots speak DDS, which needs cyclonedds: {INSTALL}")


def clock() -> float:
    """[s] since some moment, the same for all processes of a machine. On Linux it goes on while the computer sleeps.

    Setting the date does not move it.
    """
    return time.monotonic() if _CLOCK is None else time.clock_gettime(_CLOCK)
