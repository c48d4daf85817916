"""The remote's 40 bytes in a robot's state: two of head, 16 buttons, four sticks."""

from __future__ import annotations

import struct
from collections.abc import Iterable

from legged_mw.deploy.robot import BUTTONS, Remote

_PACKED = struct.Struct("<2sHfffff16x")  # head, buttons from bit 0, lx, rx, ry, L2, ly
_HEAD = b"\x55\x51"


def decode(data: bytes) -> Remote | None:
    """Buttons and sticks; None for 40 zeros, when no remote is on."""
    if not any(data):
        return None
    _, bits, lx, rx, ry, _, ly = _PACKED.unpack(data)
    return Remote(frozenset(name for i, name in enumerate(BUTTONS) if bits >> i & 1), lx=lx, ly=ly, rx=rx, ry=ry)


def encode(buttons: Iterable[str] = (), lx: float = 0.0, ly: float = 0.0, rx: float = 0.0, ry: float = 0.0) -> bytes:
    """The 40 bytes of a remote that is on."""
    return _PACKED.pack(_HEAD, sum(1 << BUTTONS.index(name) for name in buttons), lx, rx, ry, 0.0, ly)
