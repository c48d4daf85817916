"""A robot with a network link: an example of a ``Robot`` with its own server.

    python examples/udp_robot.py resources/policies/go1_flat --serve 127.0.0.1:9870                     # one terminal
    python examples/udp_robot.py resources/policies/go1_flat --drive 127.0.0.1:9870 --command 0.8,0,0   # another

Packets are little-endian: a header, then float64 values. Both ends read the same export; the header has its digest.
A packet that is malformed, late, not finite or from another sender is counted and dropped. Only new targets keep the
servos on. Use it on one machine or on a direct cable: nothing is encrypted, and anyone who can send to the port can
move the robot.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import socket
import struct
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.robot import QUANTITIES, Floats, Measurement, Robot, RobotError, layout
from legged_mw.deploy.runner import run
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.deploy.stage import idle_command
from legged_mw.utils.cli import Parser, duration, one_line_errors
from legged_mw.utils.commands import with_units
from legged_mw.utils.errors import UserError, printable
from legged_mw.view.drive import parse_command

VERSION = 1
HELLO, MEASURED, TARGETS, CLOSE, REFUSED = range(1, 6)  # types of packets
# "LMWR", version, type, digest of the contract, number of sent TARGETS
_HEADER = struct.Struct("<4sBB8sI")
_MAGIC, _MOST = b"LMWR", 65507  # magic bytes; [byte] largest packet
_FAR = 1e4  # [rad] or [N m] limit of a valid target


class Packet(NamedTuple):
    """The fields of a packet."""

    kind: int
    digest: bytes
    count: int
    body: bytes


def contract_digest(contract: Contract) -> bytes:
    """Eight bytes that depend on joints, their order, the measurement's layout and the period."""
    said = [list(contract.joints), list(contract.feet), layout(contract), contract.period]
    return hashlib.sha256(json.dumps(said).encode()).digest()[:8]


def pack(kind: int, digest: bytes, count: int, body: bytes = b"") -> bytes:
    """Encode a packet."""
    return _HEADER.pack(_MAGIC, VERSION, kind, digest, count) + body


def unpack(data: bytes) -> Packet | None:
    """Decode a packet; None if it is not a packet of this link. Raises RobotError for another version."""
    if len(data) < _HEADER.size or data[:4] != _MAGIC:
        return None
    _, version, kind, digest, count = _HEADER.unpack_from(data)
    if version != VERSION:
        raise RobotError(f"the other end uses version {version} of the link, this one {VERSION}: update one of them")
    return Packet(kind, digest, count, data[_HEADER.size :])


def numbers(body: bytes, count: int) -> Floats | None:
    """``count`` float64 values; None if the body has another size."""
    return np.frombuffer(body, dtype="<f8").astype(float) if len(body) == 8 * count else None


def counted(dropped: Counter[str]) -> str:
    """Text on the dropped packets, for the end of a line; empty if there are none."""
    return (
        f" ({sum(dropped.values())} packets dropped: {', '.join(f'{n} {why}' for why, n in dropped.items())})"
        if dropped
        else ""
    )


def parse_address(text: str) -> tuple[str, int]:
    """Parse "HOST:PORT" to a socket address."""
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or not 0 < int(port) < 65536:
        raise UserError(f"'{text}' is no address; write HOST:PORT, e.g. 127.0.0.1:9870")
    return host or "127.0.0.1", int(port)


class UdpRobot(Robot):
    """A robot that a server at ``address`` controls. The server answers each packet with a measurement."""

    def __init__(self, contract: Contract, address: tuple[str, int], timeout: float = 0.5) -> None:
        """Send a hello and receive the first measurement. Raises RobotError after ``timeout`` [s] without an answer."""
        self._layout, self._digest, self._name = (
            layout(contract),
            contract_digest(contract),
            f"{address[0]}:{address[1]}",
        )
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._count, self._timeout, self._open = 0, timeout, True
        self.dropped: Counter[str] = Counter()  # reason -> number of packets that were not an answer
        try:
            self._socket.connect(address)
        except OSError as error:
            raise self._lost(f"{error.strerror or error}") from None
        self._measured = self._exchange(HELLO)

    def read(self) -> Measurement:
        return self._measured

    def write(self, targets: Floats, **_: Floats | None) -> None:
        self._count += 1
        self._measured = self._exchange(TARGETS, np.asarray(targets, dtype="<f8").tobytes())

    def close(self) -> None:
        if self._open:
            self._open = False
            with contextlib.suppress(OSError):  # without packets the server switches the servos off
                self._socket.send(pack(CLOSE, self._digest, self._count))
            self._socket.close()

    def _exchange(self, kind: int, body: bytes = b"") -> Measurement:
        """Send a packet and receive its answer. Other packets are counted and do not extend the timeout."""
        end = time.monotonic() + self._timeout
        try:
            self._socket.send(pack(kind, self._digest, self._count, body))
            while (left := end - time.monotonic()) > 0:
                self._socket.settimeout(left)
                packet = unpack(self._socket.recv(_MOST))
                if packet and packet.kind == REFUSED:
                    raise self._lost(printable(" ".join(packet.body[:200].decode("utf-8", "replace").split())))
                if why := self._fault(packet):
                    self.dropped[why] += 1
                elif packet:
                    return self._measurement(packet.body)
            raise TimeoutError
        except TimeoutError:
            raise self._lost(f"no answer within {self._timeout:g} s{counted(self.dropped)}") from None
        except OSError as error:
            raise self._lost(f"{error.strerror or error}") from None

    def _fault(self, packet: Packet | None) -> str:
        """Why a packet is not the answer; empty if it is."""
        if packet is None or packet.kind != MEASURED:
            return "not of this link"
        if packet.digest != self._digest or len(packet.body) != 8 * sum(self._layout.values()):
            return "of another size or export"
        return "" if packet.count == self._count else "late"

    def _lost(self, why: str) -> RobotError:
        self.close()
        return RobotError(
            f"robot at {self._name}: {why}; stopped (start one with: python examples/udp_robot.py DIR --serve {self._name})"
        )

    def _measurement(self, body: bytes) -> Measurement:
        # the limits of ``safety`` check the values
        values = np.frombuffer(body, dtype="<f8").astype(float)
        parts = dict(zip(self._layout, np.split(values, np.cumsum(list(self._layout.values()))[:-1]), strict=True))
        return Measurement(
            **{n: parts[n] for n in QUANTITIES}, others={n: v for n, v in parts.items() if n not in QUANTITIES}
        )


class UdpServer:
    """Controls ``robot`` for one client. If the client closes or sends no new targets, the servos are switched off."""

    def __init__(self, robot: Robot, contract: Contract, address: tuple[str, int], timeout: float = 0.5) -> None:
        """Listen at ``address`` (port 0: any free port). ``timeout`` [s]: longest time between two targets."""
        self._robot, self._contract, self._timeout = robot, contract, timeout
        self._layout, self._digest, self._count = layout(contract), contract_digest(contract), 0
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(address)
        except OSError as error:
            self._socket.close()
            raise UserError(f"cannot listen at {address[0]}:{address[1]}: {error.strerror or error}") from None
        self.address: tuple[str, int] = self._socket.getsockname()
        self.dropped: Counter[str] = Counter()  # reason -> number of packets without effect

    def serve(self, say: Callable[[str], None] = print) -> str:
        """Serve one client from its hello until it closes or times out, then close the robot. Returns the reason."""
        why = "interrupted"
        try:
            client = self._wait_for_client(say)
            why = self._obey(client)
        finally:
            self._robot.close()
            self._socket.close()
            say(f"{why}{counted(self.dropped)}; the joints are damped, no longer servoed")
        return why

    def _wait_for_client(self, say: Callable[[str], None]) -> tuple[str, int]:
        """Wait for the first client that sends a hello with the same contract and can be answered."""
        while True:
            data, sender = self._hear(None)
            packet = self._packet(data, sender)
            if packet and packet.kind == TARGETS:
                self._drop("before a hello", sender, "send a hello first")
            if packet and packet.kind == HELLO and self._send(self._measured(), sender):
                say(f"{sender[0]}:{sender[1]} took the robot")
                return sender

    def _obey(self, client: tuple[str, int]) -> str:
        """Accept only ``client`` until it closes or sends no new targets. Returns the reason."""
        heard = time.monotonic()
        while (left := heard + self._timeout - time.monotonic()) > 0:
            try:
                data, sender = self._hear(left)
            except TimeoutError:
                break
            if sender != client:
                self.dropped["from somebody else"] += 1
            elif packet := self._packet(data, client):
                if packet.kind == CLOSE:
                    return f"{client[0]}:{client[1]} closed the link"
                if packet.kind == HELLO or self._move(packet, client):
                    heard = time.monotonic() if packet.kind == TARGETS else heard
                    self._send(self._measured(), client)
        return f"{client[0]}:{client[1]} sent nothing for {self._timeout:g} s"

    def _move(self, packet: Packet, client: tuple[str, int]) -> bool:
        """Whether these targets are new and were written."""
        targets = numbers(packet.body, len(self._contract.joints))
        if targets is None or not (np.abs(targets) < _FAR).all():
            self._drop(
                "without targets", client, f"targets must be {len(self._contract.joints)} finite numbers, one a joint"
            )
            return False
        if packet.count <= self._count:
            self.dropped["late or sent twice"] += 1
            return False
        self._count = packet.count
        self._robot.write(self._contract.action.held(targets))
        return True

    def _hear(self, seconds: float | None) -> tuple[bytes, tuple[str, int]]:
        """The next packet and its sender, within ``seconds``. Raises TimeoutError."""
        self._socket.settimeout(seconds)
        while True:
            with contextlib.suppress(ConnectionError):  # some systems report an undelivered answer here
                return self._socket.recvfrom(_MOST)

    def _packet(self, data: bytes, sender: tuple[str, int]) -> Packet | None:
        """A valid packet of a client with the same contract. Others are counted; those of this link are refused."""
        try:
            packet = unpack(data)
        except RobotError as error:
            return self._drop("of another version", sender, str(error))
        if packet is None or packet.kind not in (HELLO, TARGETS, CLOSE):
            return self._drop("not of this link")
        if packet.digest != self._digest:
            why = "its export has other joints, measurements or another period; use one export at both ends"
            return self._drop("of another export", sender, why)
        return packet

    def _drop(self, why: str, sender: tuple[str, int] | None = None, say: str = "") -> None:
        """Count a dropped packet, and send the reason to its sender."""
        self.dropped[why] += 1
        if sender:
            self._send(pack(REFUSED, self._digest, self._count, say.encode()), sender)

    def _send(self, answer: bytes, to: tuple[str, int]) -> bool:
        """Whether it was sent: port 0 cannot receive."""
        try:
            self._socket.sendto(answer, to)
        except OSError:
            self.dropped["that cannot be answered"] += 1
            return False
        return True

    def _measured(self) -> bytes:
        measured = self._robot.read()
        parts = [measured.others[name] if name in measured.others else getattr(measured, name) for name in self._layout]
        return pack(MEASURED, self._digest, self._count, np.concatenate(parts).astype("<f8").tobytes())


# ---- the program -----------------------------------------------------------------------------------------------------


def drive(folder: Path, contract: Contract, address: tuple[str, int], command: Floats, seconds: float) -> None:
    """Drive the robot at ``address`` with a constant command. Prints a line per second and one at the end."""
    period = contract.period

    def tell(now: float, measured: Measurement) -> None:
        if round(now / period) % round(1.0 / period) == 0:
            velocity = f"vx {measured.lin_vel[0]:6.2f} m/s  vy {measured.lin_vel[1]:6.2f} m/s  yaw rate {measured.ang_vel[2]:6.2f} rad/s"
            print(f"{now:6.1f} s  {velocity}", flush=True)

    controller = Controller(folder, contract)  # first: a connected robot waits 0.5 s for a target
    done = run(UdpRobot(contract, address), controller, lambda _: command, seconds, watch=tell)
    if done.fell is not None:
        print(f"it fell after {done.fell:.1f} s; its servos were switched off")
    if done.velocity is not None:
        wanted, got = (", ".join(f"{v:.2f}" for v in vector) for vector in (command, done.velocity))
        print(f"{done.steps} steps of {period:g} s, {done.late} of them late")
        print(
            f"commanded {wanted} ({with_units(contract.commands)}); vx, vy [m/s], yaw rate [rad/s] over the second half: {got}"
        )


def main() -> None:
    parser = Parser(
        prog="udp_robot.py",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    parser.add_argument("folder", metavar="DIR", type=Path, help="an export: the same at both ends")
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--serve", metavar="HOST:PORT", help="be a simulated robot that listens there")
    what.add_argument("--drive", metavar="HOST:PORT", help="drive the robot that listens there")
    parser.add_argument(
        "--command", metavar="C", help="of --drive: e.g. 0.8,0,0 in the order of the contract's commands"
    )
    parser.add_argument("--time", type=duration, default=10.0, metavar="T", help="of --drive: how long (default: 10s)")
    args = parser.parse_args()
    contract, address = read_contract(args.folder), parse_address(args.serve or args.drive)
    if args.drive:
        command = (
            idle_command(contract) if args.command is None else np.array(parse_command(args.command, contract.commands))
        )
        drive(args.folder, contract, address, command, args.time)
        return
    server = UdpServer(MujocoRobot(args.folder, contract), contract, address)
    print(
        f"a simulated robot for {contract.task} at {server.address[0]}:{server.address[1]}; Ctrl-C ends it", flush=True
    )
    with contextlib.suppress(KeyboardInterrupt):
        server.serve(lambda line: print(line, flush=True))


if __name__ == "__main__":
    with one_line_errors("udp_robot.py"):
        main()
