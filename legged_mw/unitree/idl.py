"""The DDS types for cyclonedds, built from the tables in ``codec``.

Two things must match Unitree's exactly: a type's name, and the hash that DDS computes of its fields. Unitree's robots
run Cyclone 0.10.2, which has octet as its only 8-bit type. A field declared ``uint8`` under cyclonedds 11 gives another
hash; 0.10.2 then requests the type and crashes on the answer. So a byte is an octet here, and ``wrong_hash`` compares
the hashes with those of the robots.
"""

from __future__ import annotations

from typing import Any

from cyclonedds.idl import annotations, make_idl_struct, types

from legged_mw.unitree.codec import HEADER, LAYOUTS, STRUCTS, fields

# Complete XTypes hashes that Unitree's own C++ processes (Cyclone 0.10.2) announce.
HASHES = {
    ("unitree_go", "LowCmd_"): "52cc8eb0d427d692aa2b20a90540",
    ("unitree_go", "LowState_"): "08f239c471d3a27e67e7c7723184",
    ("unitree_hg", "LowCmd_"): "42b0283aa7e1bb592ec898a0dbed",
    ("unitree_hg", "LowState_"): "2be9706c9587e8d8afd8bfc6de7b",
    ("unitree_api", "Request_"): "c47a4429fcbf539486498753c48f",
    ("unitree_api", "Response_"): "d1c32cc02214901a464a6c51325d",
}
_PLAIN = {"str": str, "bool": bool, "sequence": types.sequence[types.byte]}


def _make(package: str, name: str, made: dict[str, Any]) -> Any:
    """Make one struct. ``made``: its inner structs."""
    members = {}
    for field in fields(package, name):
        kind = made.get(field.type) or _PLAIN.get(field.type) or getattr(types, field.type)
        members[field.name] = kind if field.count is None else types.array[kind, field.count]
    made_type = make_idl_struct(name, f"{package}.msg.dds_.{name}", members)
    return annotations.autoid("sequential")(annotations.final(made_type))


def _types() -> dict[tuple[str, str], Any]:
    types_by_name = {}
    for package, structs in STRUCTS.items():
        made: dict[str, Any] = {}
        for name in structs:
            made[name] = _make(package, name, made)
        types_by_name |= {(package, name): made[name] for name in structs}
    return types_by_name


TYPES: dict[tuple[str, str], Any] = _types()


def _raw(base: Any, size: int) -> Any:
    """``base`` with samples of raw bytes, since cyclonedds' own codec takes a millisecond per message."""

    def __init__(self: Any, body: bytes = bytes(size)) -> None:
        self.body = body

    def deserialize(cls: Any, data: bytes, has_header: bool = True, use_version_2: bool | None = None) -> Any:
        body = bytes(data[4 if has_header else 0 :])
        little = not has_header or data[:2] == HEADER[:2]
        return cls(body[:size] if little else b"")  # another encoding gives a message of a wrong size

    def deserialize_key(cls: Any, *_: Any, **__: Any) -> Any:
        return cls(b"")  # the writer has left

    methods: dict[str, Any] = {
        "__init__": __init__,
        "serialize": lambda self, *_, **__: HEADER + self.body,
        "deserialize": classmethod(deserialize),
        "deserialize_key": classmethod(deserialize_key),
    }
    for name, method in methods.items():
        setattr(base, name, method)
    return base


_copies: dict[tuple[str, str], Any] = _types()
RAW: dict[tuple[str, str], Any] = {key: _raw(_copies[key], layout.size) for key, layout in LAYOUTS.items()}


def hashes() -> dict[tuple[str, str], str]:
    """The complete XTypes hash of each type on the wire."""
    by_type = {}
    for key in HASHES:
        TYPES[key].__idl__.populate()
        by_type[key] = bytes(TYPES[key].__idl__.get_type_id().get()[1]).hex()
    return by_type


def wrong_hash() -> str:
    """Text on the first type whose hash differs from the robots'; "" if all match."""
    for (package, name), own in hashes().items():
        if own != (right := HASHES[package, name]):
            return f"{package} {name} as {own}, not {right}"
    return ""
