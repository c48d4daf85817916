"""What comes in at our sockets: the web page's, the UDP example's, a Unitree robot's. Bad packets are refused or counted, and dropped."""

from __future__ import annotations

import importlib
import math
import socket
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.robot import QUANTITIES, Floats, Health, Measurement, Robot, RobotError
from legged_mw.deploy.safety import Limits, Safety
from legged_mw.unitree.client import UnitreeRobot
from legged_mw.unitree.codec import LAYOUTS, WireMessage, decode_remote
from legged_mw.unitree.link import Received, Wire
from legged_mw.unitree.serve import SimulatedUnitree
from legged_mw.view.web import Gate, is_local
from tests.wires import POLICIES, Owner

NAN, INF = math.nan, math.inf
udp: Any = importlib.import_module("examples.udp_robot")


def each(names: str, rows: Sequence[tuple[Any, ...]]) -> pytest.MarkDecorator:
    """A test a row, after its name."""
    return pytest.mark.parametrize(names, [pytest.param(*row[1:], id=row[0]) for row in rows])


# ---- the web page

HERE, PAGE = "localhost:8080", {"Origin": "http://localhost:8080"}
NAMES, SITE = "answers to localhost, to this machine's name and to addresses", "a page of another site may not"
REQUESTS = [  # name, path, headers beside Host, refusal
    ("the page", "/", {}, ""),
    ("a link of another site", "/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}, ""),
    ("a script of the page", "/web_client.js", {"Sec-Fetch-Site": "same-origin"}, ""),
    ("its socket", "/ui?sid=1", PAGE, ""),
    ("our own socket", "/stream", PAGE, ""),
    ("our own socket from another site", "/stream", {"Origin": "http://evil.test"}, SITE),
    ("our own socket without an origin", "/stream", {}, SITE),
    ("its socket behind https", "/state?sid=1", {"Origin": "https://localhost:8080"}, ""),
    ("by address", "/ui", {"Host": "127.0.0.1:8080", "Origin": "http://127.0.0.1:8080"}, ""),
    ("by address, IPv6", "/ui", {"Host": "[::1]:8080", "Origin": "http://[::1]:8080"}, ""),
    ("by another port of a tunnel", "/ui", {"Host": "localhost:9999", "Origin": "http://localhost:9999"}, ""),
    ("a rebound name", "/", {"Host": "evil.test:8080"}, NAMES),
    ("a rebound name, its own origin", "/ui", {"Host": "evil.test:8080", "Origin": "http://evil.test:8080"}, NAMES),
    ("a name that begins as ours", "/", {"Host": "localhost.evil.test"}, NAMES),
    ("an address as a name", "/", {"Host": "127.0.0.1.evil.test"}, NAMES),
    ("a user in the host", "/", {"Host": "localhost@evil.test"}, NAMES),
    ("no host", "/", {"Host": None}, NAMES),
    ("two hosts", "/", {"Host": ["localhost:8080", "evil.test"]}, NAMES),
    ("an empty host", "/", {"Host": ""}, NAMES),
    ("a port that is none", "/", {"Host": "localhost:99999999999"}, NAMES),
    ("half an address", "/", {"Host": "[::1"}, NAMES),
    ("numbers that are no address", "/", {"Host": "0x7f000001"}, NAMES),
    ("bytes", "/", {"Host": "\udcff\udcfe"}, NAMES),
    ("another origin", "/ui", {"Origin": "http://evil.test"}, SITE),
    ("another origin's read", "/model", {"Origin": "http://evil.test"}, SITE),
    ("another port of this machine", "/ui", {"Origin": "http://localhost:3000"}, SITE),
    ("our other name", "/state", {"Origin": "http://127.0.0.1:8080"}, SITE),
    ("a sandboxed page", "/ui", {"Origin": "null"}, SITE),
    ("an extension", "/ui", {"Origin": "chrome-extension://localhost:8080"}, SITE),
    ("a file", "/ui", {"Origin": "file://"}, SITE),
    ("no origin at a socket", "/ui", {}, SITE),
    ("two origins", "/state", {"Origin": ["http://localhost:8080", "http://evil.test"]}, SITE),
    ("an origin that begins as ours", "/ui", {"Origin": "http://localhost:8080.evil.test"}, SITE),
    ("an image of another site", "/model", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "no-cors", "Sec-Fetch-Dest": "image"}, SITE),
    ("a frame in another site", "/", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "iframe"}, SITE),
    ("a frame of another port", "/", {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "frame"}, SITE),
    ("a dropped model", "/drop?sid=1", PAGE, "models cannot be dropped on this page"),
]  # fmt: skip
TOKENS = [  # with a token: name, path, headers, refusal
    ("none", "/", {}, "this page has a token"),
    ("a wrong one", "/?token=abc", {}, "this page has a token"),
    ("an empty one", "/?token=", {}, "this page has a token"),
    ("half of it", "/?token=HALF", {}, "this page has a token"),
    ("in a path", "/TOKEN", {}, "this page has a token"),
    ("in a cookie of another name", "/ui", {**PAGE, "Cookie": "legged_mw_1=TOKEN"}, "this page has a token"),
    ("as text of another alphabet", "/?token=\udcff", {}, "this page has a token"),
    ("the right one at another origin", "/ui?token=TOKEN", {"Origin": "http://evil.test"}, SITE),
    ("none at our own socket", "/stream", PAGE, "this page has a token"),
    ("the right one", "/?token=TOKEN", {}, ""),
    ("at a socket", "/ui?sid=1&token=TOKEN", PAGE, ""),
    ("in its cookie", "/ui?sid=1", {**PAGE, "Cookie": "a=b; legged_mw_8080=TOKEN"}, ""),
]


def refusal(gate: Gate, path: str, headers: dict[str, Any]) -> str:
    """What ``gate`` says to a request. A token is named in it by its place."""
    path = path.replace("TOKEN", gate.token).replace("HALF", gate.token[:8])

    def header(name: str) -> list[str]:
        value = {"Host": HERE, **headers}.get(name)
        values = value if isinstance(value, list) else [] if value is None else [value]
        return [each.replace("TOKEN", gate.token) for each in values]

    return gate.refusal(path, header)


@each("path, headers, says", REQUESTS)
def test_who_reaches_the_page(path: str, headers: dict[str, Any], says: str) -> None:
    answer = refusal(Gate("127.0.0.1", 8080), path, headers)
    assert answer.startswith(says) if says == SITE else says in answer and bool(answer) == bool(says), answer


@each("path, headers, says", TOKENS)
def test_a_page_for_others_has_a_token(path: str, headers: dict[str, Any], says: str) -> None:
    gate = Gate("0.0.0.0", 8080)
    answer = refusal(gate, path, headers)
    assert says in answer and bool(answer) == bool(says), answer
    assert len(gate.token) > 20 and gate.token != Gate("0.0.0.0", 8080).token


def test_which_pages_have_a_token_and_what_is_opened() -> None:
    local = ("127.0.0.1", "127.5.5.5", "::1", "localhost")
    assert all(is_local(host) and not Gate(host, 1).token for host in local)
    assert all(not is_local(host) and Gate(host, 1).token for host in ("0.0.0.0", "::", "192.168.1.5", "robot.example"))
    assert Gate("127.0.0.1", 8080).url("127.0.0.1") == "http://localhost:8080/"
    gate = Gate("::", 8080)
    assert gate.url("::") == f"http://{socket.gethostname()}:8080/?token={gate.token}"
    assert gate.greeting(f"/?token={gate.token}") == {
        "Location": "/",
        "Set-Cookie": f"legged_mw_8080={gate.token}; Path=/; HttpOnly; SameSite=Lax",
    }
    assert gate.greeting(f"/drawn?token={gate.token}")["Location"] == "/drawn"
    assert not gate.greeting("/?token=abc") and not gate.greeting(f"/ui?token={gate.token}")


# ---- the example's UDP link


class FakeSocket:
    """Packets that wait, each after a time [s] that passes; what was sent."""

    def __init__(self, packets: list[tuple[float, bytes, Any]], monkeypatch: pytest.MonkeyPatch) -> None:
        self.packets, self.sent, self.now, self.left = deque(packets), list[bytes](), 0.0, INF
        monkeypatch.setattr(udp.time, "monotonic", lambda: self.now)
        monkeypatch.setattr(udp.socket, "socket", lambda *_: self)

    def settimeout(self, seconds: float | None) -> None:
        self.left = INF if seconds is None else seconds

    def recvfrom(self, _: int) -> tuple[bytes, Any]:
        after, data, sender = self.packets[0] if self.packets else (INF, b"", None)
        if after >= self.left:
            self.now += self.left
            raise TimeoutError
        self.packets.popleft()
        self.now += after
        return data, sender

    def recv(self, most: int) -> bytes:
        return self.recvfrom(most)[0]

    def sendto(self, data: bytes, to: Any) -> None:
        if to[1] == 0:
            raise OSError(22, "Invalid argument")
        self.sent.append(data)

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def connect(self, _: Any) -> None: ...

    def close(self) -> None: ...


class Standing(Robot):
    """It measures that it stands, and keeps its targets."""

    def __init__(self, contract: Contract) -> None:
        self.measured, self.targets, self.closed = standing(contract), list[Floats](), False

    def read(self) -> Measurement:
        return self.measured

    def write(self, targets: Floats, **_: Floats | None) -> None:
        self.targets.append(targets)

    def close(self) -> None:
        self.closed = True


def standing(contract: Contract, **changed: Any) -> Measurement:
    zeros = {name: np.zeros(3) for name in ("lin_vel", "ang_vel", "acceleration")}
    joints = {"joint_pos": np.array(contract.default_pose), "joint_vel": np.zeros(12), "joint_torque": np.zeros(12)}
    return Measurement(
        **{**zeros, **joints, "gravity": np.array([0.0, 0.0, -1.0]), "foot_contact": np.zeros(4), **changed}
    )


GO1 = read_contract(POLICIES / "go1_flat")
DIGEST, CLIENT, OTHER = udp.contract_digest(GO1), ("10.0.0.1", 5000), ("10.0.0.2", 5000)
HELLO = udp.pack(udp.HELLO, DIGEST, 0)


def targets(count: int, value: float = 0.1, more: bytes = b"", digest: bytes = DIGEST) -> bytes:
    return udp.pack(udp.TARGETS, digest, count, np.full(12, value).astype("<f8").tobytes() + more)


TO_SERVER = [  # what it is, bytes, why it was dropped
    ("nothing", b"", "not of this link"),
    ("a byte", b"L", "not of this link"),
    ("noise", b"\xff" * 100, "not of this link"),
    ("the largest packet", b"\x00" * 65507, "not of this link"),
    ("half a header", HELLO[:10], "not of this link"),
    ("another magic", b"XXXX" + HELLO[4:], "not of this link"),
    ("another version", HELLO[:4] + b"\x09" + HELLO[5:], "of another version"),
    ("another export", targets(5, digest=b"12345678"), "of another export"),
    ("a kind that is none", udp.pack(77, DIGEST, 9), "not of this link"),
    ("an answer", udp.pack(udp.MEASURED, DIGEST, 9, bytes(400)), "not of this link"),
    ("a refusal", udp.pack(udp.REFUSED, DIGEST, 9, b"stop"), "not of this link"),
    ("no targets", udp.pack(udp.TARGETS, DIGEST, 5), "without targets"),
    ("targets cut short", targets(5)[:-1], "without targets"),
    ("targets and five bytes", targets(5, more=b"12345"), "without targets"),
    ("13 targets", targets(5, more=bytes(8)), "without targets"),
    ("NaN", targets(5, NAN), "without targets"),
    ("infinity", targets(5, INF), "without targets"),
    ("10^30", targets(5, 1e30), "without targets"),
    ("the same again", targets(2), "late or sent twice"),
    ("an older one", targets(1), "late or sent twice"),
    ("a count of zero", targets(0), "late or sent twice"),
]


@each("data, why", TO_SERVER)
def test_the_udp_server_drops(data: bytes, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """It moves nothing, and the servos are off half a second after the last new targets."""
    robot, said = Standing(GO1), list[str]()
    server = udp.UdpServer(robot, GO1, ("127.0.0.1", 0), timeout=0.5)
    server._socket.close()
    good = [(0.0, HELLO, CLIENT), (0.1, targets(1), CLIENT), (0.1, targets(2), CLIENT)]
    bad = [(0.1, data, CLIENT)] * 20
    server._socket = FakeSocket([*good, *bad], monkeypatch)
    assert server.serve(said.append) == "10.0.0.1:5000 sent nothing for 0.5 s"
    assert server._socket.now == pytest.approx(0.7) and len(robot.targets) == 2 and robot.closed
    assert server.dropped[why] == sum(server.dropped.values()) == 4 and f"(4 packets dropped: 4 {why})" in said[-1]


def test_the_udp_server_obeys_one_client_that_it_can_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = Standing(GO1)
    server = udp.UdpServer(robot, GO1, ("127.0.0.1", 0), timeout=0.5)
    server._socket.close()
    nobody = ("10.0.0.3", 0)
    before = [(0.1, targets(1), OTHER), (0.1, HELLO, nobody), (0.1, b"\x00", nobody), (9.0, targets(3), nobody)]
    after = [
        (0.0, HELLO, CLIENT),
        (0.1, targets(1), OTHER),
        (0.1, targets(1), CLIENT),
        (0.1, udp.pack(udp.CLOSE, DIGEST, 1), OTHER),
    ]
    server._socket = FakeSocket([*before, *after, *[(0.2, HELLO, CLIENT)] * 9], monkeypatch)
    assert server.serve(lambda _: None) == "10.0.0.1:5000 sent nothing for 0.5 s" and len(robot.targets) == 1
    assert server.dropped == {
        "before a hello": 2,
        "that cannot be answered": 2,
        "not of this link": 1,
        "from somebody else": 2,
    }


VALUES = sum(len(np.ravel(getattr(standing(GO1), name))) for name in QUANTITIES)
MEASURED = udp.pack(udp.MEASURED, DIGEST, 0, bytes(8 * VALUES))
TO_CLIENT = [  # what it is, bytes, why it was dropped
    ("nothing", b"", "not of this link"),
    ("noise", b"\xfe" * 300, "not of this link"),
    ("five bytes of a measurement", udp.pack(udp.MEASURED, DIGEST, 0, b"12345"), "of another size or export"),
    ("an empty measurement", udp.pack(udp.MEASURED, DIGEST, 0), "of another size or export"),
    ("one value too many", MEASURED + bytes(8), "of another size or export"),
    ("one byte too few", MEASURED[:-1], "of another size or export"),
    ("the largest packet", udp.pack(udp.MEASURED, DIGEST, 0, bytes(65489)), "of another size or export"),
    ("another export's", udp.pack(udp.MEASURED, b"12345678", 0, bytes(8 * VALUES)), "of another size or export"),
    ("a late one", udp.pack(udp.MEASURED, DIGEST, 7, bytes(8 * VALUES)), "late"),
    ("a hello", HELLO, "not of this link"),
    ("targets", targets(0), "not of this link"),
]


@each("data, why", TO_CLIENT)
def test_the_udp_client_drops(data: bytes, why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """However many come, the client waits no longer than it would for silence."""
    fake = FakeSocket([(0.1, data, CLIENT)] * 50, monkeypatch)
    with pytest.raises(RobotError, match=rf"no answer within 0\.5 s \(4 packets dropped: 4 {why}\); stopped"):
        udp.UdpRobot(GO1, CLIENT, timeout=0.5)
    assert fake.now == pytest.approx(0.5)


def test_a_refusal_paints_no_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    FakeSocket([(0.1, udp.pack(udp.REFUSED, DIGEST, 0, b"\x1b[2J\nno\xff" + b"x" * 60000), CLIENT)], monkeypatch)
    with pytest.raises(RobotError, match=r"robot at 10\.0\.0\.1:5000: \\x1b\[2J no") as error:
        udp.UdpRobot(GO1, CLIENT)
    assert str(error.value).isprintable() and len(str(error.value)) < 400


# ---- what no robot measures

ABSURD = [
    ("no gravity", {"gravity": np.zeros(3)}, "a measured value is impossible: gravity of length 0.00, not 1"),
    ("twice gravity", {"gravity": np.array([0, 0, -2.0])}, "gravity of length 2.00, not 1"),
    ("gravity of 10^30", {"gravity": np.array([0, 0, -1e30])}, "gravity of length 1"),
    ("gravity is NaN", {"gravity": np.array([0, NAN, -1.0])}, "a measured value is not finite: gravity"),
    ("an angle of 10^30", {"joint_pos": np.full(12, 1e30)}, "joint_pos of 1e+30 rad"),
    ("an angle of infinity", {"joint_pos": np.full(12, -INF)}, "a measured value is not finite: joint_pos"),
    ("a speed of 10^30", {"joint_vel": np.full(12, -1e30)}, "joint_vel of 1e+30 rad/s"),
    ("a turn of 10^30", {"ang_vel": np.array([0, 1e30, 0])}, "ang_vel of 1e+30 rad/s"),
    ("a turn that is NaN", {"ang_vel": np.array([0, NAN, 0])}, "a measured value is not finite: ang_vel"),
]


@each("changed, says", ABSURD)
def test_impossible_measurements_end_the_walk(changed: dict[str, Floats], says: str) -> None:
    """Also where every limit that can be switched off is off."""
    limits = Limits.of(
        POLICIES / "go1_flat", GO1, asked=dict.fromkeys(("position", "speed", "tilt", "frozen", "age", "late"), "off")
    )
    safety = Safety(GO1, replace(limits, low=np.full(12, -INF), high=np.full(12, INF)))
    assert safety.sensed(standing(GO1), Health(), 0.0) is None
    trip = safety.sensed(standing(GO1, **changed), Health(), 0.02)
    assert trip is not None and says in trip.text and trip.limit == "finite"


# ---- a Unitree robot's wire

GO2 = read_contract(POLICIES / "go2_flat")


class FakeEnd:
    """The robot's end of a wire, in this process."""

    program = ""

    def __init__(self) -> None:
        self.sent, self.commands = list[bytes](), deque[bytes]()

    def send(self, body: bytes) -> None:
        self.sent.append(body)

    def receive(self) -> bytes | None:
        return self.commands.popleft() if self.commands else None

    def answer(self) -> None: ...


@pytest.fixture(scope="module")
def state() -> bytes:
    """A state of a Go2 that stands there for a second."""
    end: Any = FakeEnd()
    sim = SimulatedUnitree(POLICIES / "go2_flat", GO2, end)
    while sim.time < 1.0:
        sim.step()
    return end.sent[-1]


def changed(state: bytes, seal: bool = True, **parts: Any) -> bytes:
    message = WireMessage(LAYOUTS["unitree_go", "LowState_"], state)
    for name, value in parts.items():
        message[name.replace("__", ".")] = value
    return message.seal() if seal else message.body


def tick(state: bytes) -> int:
    return int(WireMessage(LAYOUTS["unitree_go", "LowState_"], state)["tick"])


STATES = [
    ("a flipped bit", lambda s: changed(s, False, motor_state__q=1.0), "with a wrong checksum"),
    ("NaN, not sealed", lambda s: changed(s, False, motor_state__q=NAN), "with a wrong checksum"),
    ("ones", lambda s: b"\xff" * len(s), "with a wrong checksum"),
    ("2 ms old", lambda s: changed(s, tick=tick(s) - 2), "late"),
    ("100 ms old", lambda s: changed(s, tick=tick(s) - 100), "late"),
]


@each("make, why", STATES)
def test_the_client_of_a_robot_drops_states(make: Callable[[bytes], bytes], why: str, state: bytes) -> None:
    """However many: they are no news, so the newest good one grows old and the run ends."""
    owner, now = Owner(), [10.0]
    robot = UnitreeRobot(GO2, owner, Received(state, 10.0), clock=lambda: now[0])
    for step in range(5):
        now[0] = 10.0 + 0.002 * step
        owner.states.append(Received(make(state), now[0]))
        assert np.isfinite(robot.read().joint_pos).all()
    assert robot.dropped == {why: 5} and robot.health().age_s == pytest.approx(0.008)
    now[0] = 10.2
    owner.states.append(Received(make(state), 10.2))
    with pytest.raises(RobotError, match=r"200 ms"):
        robot.read()
    robot.close()
    assert robot.report == f"states dropped: 6 {why}"


TRIPS = [
    ("no orientation", {"imu_state__quaternion": 0.0}, "gravity of length 0.00, not 1"),
    ("half an orientation", {"imu_state__quaternion": [0.5, 0, 0, 0]}, "gravity of length 0.25, not 1"),
    ("a huge one", {"imu_state__quaternion": [1e19, 0, 0, 0]}, "gravity of length"),
    ("NaN", {"imu_state__quaternion": NAN}, "a measured value is not finite: gravity"),
    ("angles of 10^30", {"motor_state__q": 1e30}, "joint_pos of 1e+30 rad"),
    ("speeds of infinity", {"motor_state__dq": INF}, "a measured value is not finite: joint_vel"),
    ("a gyro of 10^30", {"imu_state__gyroscope": 1e30}, "ang_vel of 1e+30 rad/s"),
    ("a battery that is NaN", {"power_v": NAN}, "the battery has nan V"),
]


@each("parts, says", TRIPS)
def test_a_whole_state_that_cannot_be_ends_the_walk(parts: dict[str, Any], says: str, state: bytes) -> None:
    owner = Owner()
    robot = UnitreeRobot(GO2, owner, Received(state, 1.0), clock=lambda: 1.0)
    owner.states.append(Received(changed(state, tick=tick(state) + 2, **parts), 1.0))
    limits = Limits.of(
        POLICIES / "go2_flat", GO2, robot.limits, {"frozen": "off", "position": "off", "tilt": "off", "speed": "off"}
    )
    trip = Safety(GO2, limits).sensed(robot.read(), robot.health(), 0.0)
    assert trip is not None and says in trip.text


def command(**parts: Any) -> WireMessage:
    message = WireMessage(LAYOUTS["unitree_go", "LowCmd_"])
    message["head"], message["level_flag"], message["motor_cmd.mode"] = (0xFE, 0xEF), 0xFF, 1
    for name, value in parts.items():
        message[f"motor_cmd.{name}"] = value
    return message


COMMANDS = [
    ("nothing", b""),
    ("a byte", b"\x00"),
    ("one byte short", command(kp=20.0).seal()[:-1]),
    ("twice", command(kp=20.0).seal() * 2),
    ("zeros", bytes(LAYOUTS["unitree_go", "LowCmd_"].size)),
    ("ones", b"\xff" * LAYOUTS["unitree_go", "LowCmd_"].size),
    ("not sealed", command(kp=20.0).body),
    *(
        (f"{name} is {value}", command(**{name: value}).seal())
        for name in ("q", "dq", "tau", "kp", "kd")
        for value in (NAN, INF, 1e30)
    ),
]


@each("body", COMMANDS)
def test_a_served_robot_refuses_commands(body: bytes, served: SimulatedUnitree) -> None:
    end: Any = served.end
    before = served.record.refused, served.record.commands
    end.commands.append(body)
    served.step()
    assert (served.record.refused, served.record.commands) == (before[0] + 1, before[1])
    assert not served.acted["kp"].any() and np.isfinite(served.data.qpos).all()


@pytest.fixture(scope="module")
def served() -> SimulatedUnitree:
    end: Any = FakeEnd()
    return SimulatedUnitree(POLICIES / "go2_flat", GO2, end)


@pytest.mark.parametrize("data", [b"\xff" * 40, b"\x55\x51" + b"\xff" * 38, b"\x00" * 39 + b"\x01"])
def test_noise_of_a_remote_walks_nowhere(data: bytes) -> None:
    held = decode_remote(data)
    assert held is not None and not any(abs(getattr(held, stick)) > 1e-6 for stick in ("lx", "ly", "rx", "ry"))


ANSWERS = [
    "[]",
    "{",
    '"x"',
    "{'name': 1}",
    '{"name": 5}',
    '{"name": ["\x1b[2J"]}',
    "[" * 100_000,
    "\ufffd",
    '{"name": {}}',
    "1e999",
]


@pytest.mark.parametrize("data", ANSWERS, ids=[each[:9].encode("unicode_escape").decode() for each in ANSWERS])
def test_a_motion_service_that_answers_anything(data: str, monkeypatch: pytest.MonkeyPatch) -> None:
    wire: Any = object.__new__(Wire)
    monkeypatch.setattr(Wire, "_ask", lambda *_: data)
    with pytest.raises(
        RobotError,
        match=r"the robot's motion service answers .*, which does not say which program runs: nothing was sent",
    ):
        wire._program()


class FakeReader:
    """A reader of cyclonedds with bytes that break its codec."""

    def __init__(self, *bodies: bytes) -> None:
        self.bodies = deque(bodies)

    def take(self, count: int) -> list[Any]:
        body = self.bodies.popleft()
        if body == b"broken":
            raise IndexError("bytes that end too early")
        return [
            SimpleNamespace(body=body, sample_info=SimpleNamespace(valid_data=body != b"gone", publication_handle=1))
        ]


def test_messages_of_another_size_are_counted() -> None:
    wire: Any = object.__new__(Wire)
    wire._size, wire.dropped, wire.clock, wire._heard = 64, 0, time.monotonic, {}
    wire._states = FakeReader(b"", b"gone", b"broken", bytes(63), bytes(65), bytes(64))
    assert [wire.receive() is None for _ in range(6)] == [True] * 5 + [False] and wire.dropped == 3
