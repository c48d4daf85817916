"""The checksum of a contract over all values that belong to the training, and the list of values changed since.

The contract carries a copy of those values as exported, since no other file of an export has all of them.
"""

from __future__ import annotations

import base64
import hashlib
import json
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

from legged_mw.utils.errors import brief

CHECKSUM = "checksum"  # of the values that must not change without the network
EXPORTED = "exported"  # those values at the export: base64 of zlib of JSON
FREE = ("task", "ends", "exam", "safety")  # sections that may change: how the policy is graded and supervised
_MOST_TEXT = 1 << 22  # [byte] limit of the unpacked `exported`; a G1's has a four-hundredth


def checksum(said: Mapping[str, Any]) -> str:
    """SHA-256 of the contract's values that belong to the training: joints, rows, scales and so on, in their order."""
    return hashlib.sha256(_bound(said).encode()).hexdigest()


def sealed(said: Mapping[str, Any]) -> dict[str, Any]:
    """The contract with both lines, `checksum` and `exported`."""
    text = _bound({**said, EXPORTED: ""}).encode()
    return {
        **said,
        EXPORTED: base64.b64encode(zlib.compress(text, 9)).decode(),
        CHECKSUM: hashlib.sha256(text).hexdigest(),
    }


def changes(said: Mapping[str, Any]) -> list[str]:
    """A line for each value that differs from the exported one, with both values."""
    if EXPORTED not in said and said.get(CHECKSUM) == checksum(said):  # formats before 5 have no copy
        return []
    try:
        packed = base64.b64decode(str(said[EXPORTED]), validate=True)
        text = zlib.decompressobj().decompress(packed, _MOST_TEXT)
        if hashlib.sha256(text).hexdigest() != said.get(CHECKSUM, hashlib.sha256(text).hexdigest()):
            raise ValueError("the copy was changed, too")
        was, now = dict(_values(json.loads(text))), dict(_values(json.loads(_bound(said))))
    except (KeyError, ValueError, zlib.error, RecursionError):
        return [f"what was exported is unknown: its line `{EXPORTED}` is missing, or was changed too"]
    both = [(place, *(brief(of[place]) if place in of else "nothing" for of in (now, was))) for place in {**was, **now}]
    return [f"{place}: {new}, exported {old}" for place, new, old in both if new != old]


def _bound(said: Mapping[str, Any]) -> str:
    # formats before 5 have no copy, and `format` was not part of the checksum
    free = (*FREE, EXPORTED, CHECKSUM, *([] if EXPORTED in said else ["format"]))
    return json.dumps({name: value for name, value in said.items() if name not in free}, default=str, skipkeys=True)


def _values(tree: Any, place: str = "") -> Iterator[tuple[str, Any]]:
    """Each value in nested mappings and lists, with its place, e.g. observation[3].scale."""
    if isinstance(tree, dict) and tree:
        for name, value in tree.items():
            yield from _values(value, f"{place}.{name}" if place else str(name))
    elif isinstance(tree, list) and tree:
        for i, value in enumerate(tree):
            yield from _values(value, f"{place}[{i}]")
    else:
        yield place, tree
