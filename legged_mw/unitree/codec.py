"""Unitree's low-level messages as bytes: fields, their offsets, the checksum, the remote's part. It does not use DDS.

Names, order and widths of the fields follow Unitree's published unitree_sdk2: ``unitree_go`` (Go2, B2, H1),
``unitree_hg`` (G1, H1-2), ``unitree_api`` (the motion service). "byte" means IDL's octet; Unitree's Python says uint8.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.robot import BUTTONS, Remote

_IMU = "quaternion float32[4], gyroscope float32[3], accelerometer float32[3], rpy float32[3], temperature "
_MOTOR = "mode byte, q float32, dq float32, tau float32, kp float32, kd float32, reserve "
STRUCTS: dict[str, dict[str, str]] = {
    "unitree_go": {
        "MotorCmd_": f"{_MOTOR}uint32[3]",
        "BmsCmd_": "off byte, reserve byte[3]",
        "LowCmd_": "head byte[2], level_flag byte, frame_reserve byte, sn uint32[2], version uint32[2], bandwidth uint16, "
        "motor_cmd MotorCmd_[20], bms_cmd BmsCmd_, wireless_remote byte[40], led byte[12], fan byte[2], gpio byte, "
        "reserve uint32, crc uint32",
        "IMUState_": f"{_IMU}byte",
        "MotorState_": "mode byte, q float32, dq float32, ddq float32, tau_est float32, q_raw float32, dq_raw float32, "
        "ddq_raw float32, temperature byte, lost uint32, reserve uint32[2]",
        "BmsState_": "version_high byte, version_low byte, status byte, soc byte, current int32, cycle uint16, bq_ntc byte[2], "
        "mcu_ntc byte[2], cell_vol uint16[15]",
        "LowState_": "head byte[2], level_flag byte, frame_reserve byte, sn uint32[2], version uint32[2], bandwidth uint16, "
        "imu_state IMUState_, motor_state MotorState_[20], bms_state BmsState_, foot_force int16[4], foot_force_est int16[4], "
        "tick uint32, wireless_remote byte[40], bit_flag byte, adc_reel float32, temperature_ntc1 byte, temperature_ntc2 byte, "
        "power_v float32, power_a float32, fan_frequency uint16[4], reserve uint32, crc uint32",
    },
    "unitree_hg": {
        "MotorCmd_": f"{_MOTOR}uint32",
        "LowCmd_": "mode_pr byte, mode_machine byte, motor_cmd MotorCmd_[35], reserve uint32[4], crc uint32",
        "IMUState_": f"{_IMU}int16",
        "MotorState_": "mode byte, q float32, dq float32, ddq float32, tau_est float32, temperature int16[2], vol float32, "
        "sensor uint32[2], motorstate uint32, reserve uint32[4]",
        "LowState_": "version uint32[2], mode_pr byte, mode_machine byte, tick uint32, imu_state IMUState_, "
        "motor_state MotorState_[35], wireless_remote byte[40], reserve uint32[4], crc uint32",
    },
    "unitree_api": {
        "RequestIdentity_": "id int64, api_id int64",
        "RequestLease_": "id int64",
        "RequestPolicy_": "priority int32, noreply bool",
        "RequestHeader_": "identity RequestIdentity_, lease RequestLease_, policy RequestPolicy_",
        "Request_": "header RequestHeader_, parameter str, binary sequence",
        "ResponseStatus_": "code int32",
        "ResponseHeader_": "identity RequestIdentity_, status ResponseStatus_",
        "Response_": "header ResponseHeader_, data str, binary sequence",
    },
}
_DTYPES = {"byte": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4", "float32": "<f4"}
HEADER = b"\x00\x01\x00\x00"  # of every sample: plain CDR (XCDR1), little-endian
_REMOTE = struct.Struct("<2sHfffff16x")  # of wireless_remote: head, buttons from bit 0, lx, rx, ry, L2, ly
_REMOTE_HEAD = b"\x55\x51"
_MIRRORED = bytes(int(f"{i:08b}"[::-1], 2) for i in range(256))  # each byte with its bits reversed


class Field(NamedTuple):
    """One field of a struct: ``count`` values of a primitive type or of another struct."""

    name: str
    type: str
    count: int | None  # None: one value


def fields(package: str, struct: str) -> list[Field]:
    """The fields of a struct, in order."""
    matches = [re.fullmatch(r"(\w+) (\w+)(?:\[(\d+)\])?", text) for text in STRUCTS[package][struct].split(", ")]
    return [Field(m[1], m[2], int(m[3]) if m[3] else None) for m in matches if m]


class Layout:
    """Field offsets of a fixed-size message: on the wire, and in the C++ struct under the checksum."""

    def __init__(self, package: str, struct: str) -> None:
        self.package, self._offsets = package, dict[str, tuple[str, list[int]]]()
        self._image: list[int] = []  # wire byte -> its offset in the C++ struct
        self.size, self.image_size = self._add(package, struct, "", 0, 0)
        self.index = {n: (kind, np.array(o) // np.dtype(kind).itemsize) for n, (kind, o) in self._offsets.items()}
        self.single = {name for name, (_, where) in self.index.items() if len(where) == 1}
        spans = [(wire, place) for wire, place in enumerate(self._image) if place >= 0]
        self.on_wire, self.in_image = (np.array(each) for each in zip(*spans, strict=True))

    def _add(self, package: str, struct: str, prefix: str, wire: int, image: int) -> tuple[int, int]:
        """Place a struct at these two offsets. Returns both end offsets.

        On the wire each number is aligned to its own size and nothing else is padded. The compiler aligns structs to
        their widest number and pads their ends.
        """
        widest = _alignment(package, struct)
        image += -image % widest
        for name, kind, count in fields(package, struct):
            for _ in range(count or 1):
                if kind not in _DTYPES:
                    wire, image = self._add(package, kind, f"{prefix}{name}.", wire, image)
                    continue
                size = np.dtype(_DTYPES[kind]).itemsize
                wire, image = wire + -wire % size, image + -image % size
                self._offsets.setdefault(prefix + name, (_DTYPES[kind], []))[1].append(wire)
                self._image += [-1] * (wire - len(self._image)) + list(range(image, image + size))
                wire, image = wire + size, image + size
        return wire, image + -image % widest


def _alignment(package: str, struct: str) -> int:
    """Size [byte] of a struct's widest number."""
    return max(
        np.dtype(_DTYPES[f.type]).itemsize if f.type in _DTYPES else _alignment(package, f.type)
        for f in fields(package, struct)
    )


LAYOUTS = {
    (package, name): Layout(package, name)
    for package in ("unitree_go", "unitree_hg")
    for name in ("LowCmd_", "LowState_")
}


class WireMessage:
    """One message as its bytes on the wire. ``message["motor_state.q"]`` is the field of all motors, copied."""

    def __init__(self, layout: Layout, body: bytes | None = None) -> None:
        """A message of zeros, or with the bytes ``body``. Raises ValueError if ``body`` has a wrong size."""
        if body is not None and len(body) != layout.size:
            raise ValueError(f"a message of {len(body)} bytes, not {layout.size}")
        self.layout = layout
        self._bytes = np.frombuffer(bytearray(body or bytes(layout.size)), dtype=np.uint8)

    def __getitem__(self, name: str) -> Any:
        kind, index = self.layout.index[name]
        values = self._bytes.view(kind)[index]
        return values[0] if name in self.layout.single else values

    def __setitem__(self, name: str, value: Any) -> None:
        kind, index = self.layout.index[name]
        self._bytes.view(kind)[index] = value

    @property
    def body(self) -> bytes:
        return self._bytes.tobytes()

    def checksum(self) -> int:
        """The correct value of the field ``crc``."""
        image = np.zeros(self.layout.image_size, dtype=np.uint8)
        image[self.layout.in_image] = self._bytes[self.layout.on_wire]
        return crc32(image[:-4])

    def seal(self) -> bytes:
        """Set the checksum and return the bytes."""
        self["crc"] = self.checksum()
        return self.body

    def intact(self) -> bool:
        """True if the checksum is correct."""
        return self.checksum() == self["crc"]


def crc32(image: NDArray[np.uint8]) -> int:
    """Unitree's checksum of little-endian 32-bit words: polynomial 0x04C11DB7, all ones at first, highest bit first.

    It equals zlib's CRC over the words in reversed byte order, with the bits of each byte and of the result reversed.
    """
    words = image.view("<u4").byteswap().tobytes()
    result = zlib.crc32(words.translate(_MIRRORED)) ^ 0xFFFFFFFF
    return int.from_bytes(result.to_bytes(4, "little").translate(_MIRRORED), "big")


def decode_remote(data: bytes) -> Remote | None:
    """Buttons and sticks of ``wireless_remote``; None for 40 zeros, when no remote is on."""
    if not any(data):
        return None
    _, bits, lx, rx, ry, _, ly = _REMOTE.unpack(data)
    return Remote(frozenset(name for i, name in enumerate(BUTTONS) if bits >> i & 1), lx=lx, ly=ly, rx=rx, ry=ry)


def encode_remote(
    buttons: Iterable[str] = (), lx: float = 0.0, ly: float = 0.0, rx: float = 0.0, ry: float = 0.0
) -> bytes:
    """The 40 bytes of a remote that is on."""
    return _REMOTE.pack(_REMOTE_HEAD, sum(1 << BUTTONS.index(name) for name in buttons), lx, rx, ry, 0.0, ly)
