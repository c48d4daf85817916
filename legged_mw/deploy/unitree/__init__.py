"""Unitree's robots behind the seam ``Robot``, over their low-level DDS interface, and a simulated one at the other end of the wire.

cyclonedds is imported in ``idl`` and ``link`` alone, and these two only where the wire is used.
"""

from __future__ import annotations

from importlib.util import find_spec

from legged_mw.utils.errors import UserError

INSTALL = "pip install 'legged_mw[unitree]'"


def need_dds() -> None:
    """Raise UserError with the command that installs what is missing."""
    if find_spec("cyclonedds") is None:
        raise UserError(f"Unitree's robots speak DDS, which needs cyclonedds: {INSTALL}")
