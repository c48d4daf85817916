"""The wire: a DDS domain on one network interface, and the topics of a Unitree robot. Messages are bytes."""

from __future__ import annotations

import json
import socket
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from typing import Any, NamedTuple
from weakref import finalize

from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.core import DDSException
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from legged_mw.deploy.robot import RobotError
from legged_mw.unitree import clock
from legged_mw.unitree.codec import LAYOUTS
from legged_mw.unitree.idl import RAW, TYPES, wrong_hash
from legged_mw.unitree.robots import known_motors
from legged_mw.utils.errors import printable, unknown

COMMANDS, STATES = "rt/lowcmd", "rt/lowstate"
MOTION = "rt/api/motion_switcher/request", "rt/api/motion_switcher/response"
SPORT = "rt/api/sport/request"
CHECK_MODE, RELEASE_MODE = 1001, 1003  # calls of the motion service
STAND_DOWN = 1005  # call of the sport service [unitree_sdk2]
LOOPBACK = ("lo", "lo0")
AGAIN = 0.1  # [s] ours: a restarted robot is silent for longer than this
LEASE = 11.0  # [s] time until DDS removes a killed program: 10 s and a margin
_INTERFACE = "<General><Interfaces><NetworkInterface name='{name}' {multicast}/></Interfaces>{more}</General>"
# Loopback interfaces have no multicast, so the processes search the ports of 127.0.0.1 for each other.
_LOCAL = "<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>"
_LOCAL += "<Peers><Peer Address='127.0.0.1'/></Peers></Discovery>"
# domain -> interface and its Domain object; a process may configure a domain only once
_joined: dict[int, tuple[str, Any]] = {}


def default_domain(interface: str) -> int:
    """The default domain: 0, as on a robot; on loopback 1, as in unitree_mujoco."""
    return 1 if interface in LOOPBACK else 0


def join(interface: str, domain: int) -> Any:
    """A participant of the domain.

    Raises RobotError if the interface is missing, or if joining could harm the robots on it.
    """
    names = [name for _, name in socket.if_nameindex()]
    if interface not in names:
        raise RobotError(f"--interface: {unknown('network interface', interface, names, 'this machine')}")
    if not 0 <= domain <= 232:
        raise RobotError(f"--domain {domain}: a domain is a number from 0 to 232")
    if interface not in LOOPBACK and (wrong := wrong_hash()):
        raise RobotError(
            f"cyclonedds {version('cyclonedds')} announces {wrong}, which crashes the robot's own programs: nothing was sent; "
            "install the version that was tried: pip install 'cyclonedds>=11.0.1,<12'"
        )
    if domain not in _joined:
        local = interface in LOOPBACK
        text = _INTERFACE.format(
            name=interface,
            multicast="multicast='false'" if local else "priority='default' multicast='default'",
            more="<AllowMulticast>false</AllowMulticast>" if local else "",
        )
        text = f"<CycloneDDS><Domain Id='any'>{text}{_LOCAL if local else ''}</Domain></CycloneDDS>"
        _joined[domain] = interface, Domain(domain, text)
    elif _joined[domain][0] != interface:
        raise RobotError(f"this process has joined domain {domain} on {_joined[domain][0]}, not on {interface}")
    try:
        return DomainParticipant(domain)
    except DDSException as error:
        raise RobotError(f"cannot join DDS domain {domain} on {interface}: {str(error).splitlines()[0]}") from None


def _joined_by(owner: object, interface: str, domain: int) -> Any:
    """A participant that leaves the domain when ``owner`` is freed.

    Otherwise a participant that the garbage collector finds in a cycle never leaves.
    """
    participant = join(interface, domain)
    finalize(owner, participant.__del__).atexit = False
    return participant


def claim(interface: str, domain: int, seconds: float) -> socket.socket | None:
    """Reserve the commands of the robot on this interface for this process of the computer, until it ends.

    Listening alone does not detect a program that has not sent yet or pauses. If another process has the claim, wait at
    most ``seconds`` for its end, then raise RobotError. Systems without abstract sockets have no claim.
    """
    if not sys.platform.startswith("linux"):
        return None
    lock, end = socket.socket(socket.AF_UNIX), clock() + seconds
    while True:
        try:
            lock.bind(f"\0legged_mw/{COMMANDS}/{interface}/{domain}")
            return lock
        except OSError:
            if clock() >= end:
                lock.close()
                raise RobotError(taken(f"domain {domain} on {interface}")) from None
            time.sleep(0.01)


def taken(where: str) -> str:
    return f"another program sends {COMMANDS} in {where}: end it first; nothing was sent"


def _reader(participant: Any, topic: str, kind: Any, depth: int = 1, foreign: bool = False) -> Any:
    """A reader of the newest ``depth`` samples. ``foreign``: without samples of this participant."""
    policies = [Policy.Reliability.BestEffort, Policy.History.KeepLast(depth)]
    policies += [Policy.IgnoreLocal.Participant] if foreign else []
    return DataReader(participant, Topic(participant, topic, kind), Qos(*policies))


def _writer(participant: Any, topic: str, kind: Any) -> Any:
    return DataWriter(participant, Topic(participant, topic, kind))


def _taken(reader: Any, count: int = 1) -> list[Any]:
    """Samples with data: a writer that leaves sends one without. If one cannot be decoded, all are dropped."""
    try:
        return [sample for sample in reader.take(count) if sample.sample_info.valid_data]
    except Exception as error:  # cyclonedds' codec may raise any type on invalid bytes
        if isinstance(error, DDSException):
            raise
        return []


def _request(call: int) -> Any:
    """A call of one of the robot's services."""
    kinds = {name: TYPES["unitree_api", f"Request{name}_"] for name in ("", "Header", "Identity", "Lease", "Policy")}
    identity = kinds["Identity"](id=time.monotonic_ns(), api_id=call)
    header = kinds["Header"](
        identity=identity, lease=kinds["Lease"](id=0), policy=kinds["Policy"](priority=0, noreply=False)
    )
    return kinds[""](header=header, parameter="{}", binary=[])


class Received(NamedTuple):
    """One message and its time of arrival."""

    body: bytes
    stamp: float  # [s] of `unitree.clock`


class Commander:
    """Sends commands only. A policy's process uses it if its guard has ended."""

    def __init__(self, package: str, interface: str, domain: int) -> None:
        self.package, self._where = package, f"domain {domain} on {interface}"
        self._wait, self.clock = lambda: time.sleep(0.001), clock
        self._participant = _joined_by(self, interface, domain)
        self._sample = RAW[package, "LowCmd_"]
        self._out = _writer(self._participant, COMMANDS, self._sample)

    def send(self, body: bytes) -> None:
        self._out.write(self._sample(body))

    def wait(self, readers: int, seconds: float) -> None:
        """Wait until commands have ``readers`` readers, so that none is lost. Raises RobotError after ``seconds``."""
        if not self._until(lambda: len(self._out.get_matched_subscriptions()) >= readers, seconds):
            raise RobotError(f"no robot reads {COMMANDS} in {self._where}: nothing was sent")

    def _until(self, found: Callable[[], Any], seconds: float) -> Any:
        """Call ``found`` until its result is true, at most for ``seconds``. Returns the last result."""
        end = self.clock() + seconds
        while not (result := found()) and self.clock() < end:
            self._wait()
        return result


class Wire(Commander):
    """The end of the policy's program: it receives states and sends commands, the first one in ``send``."""

    _sent = "nothing was sent"  # so far, for errors

    def __init__(
        self,
        package: str,
        interface: str,
        domain: int,
        wait: Callable[[], None] = lambda: time.sleep(0.001),
        clock: Callable[[], float] = clock,
    ) -> None:
        """``wait`` is called while no message arrives.

        With a simulated robot in the same process, ``wait`` steps it, and ``clock`` is its clock.
        """
        super().__init__(package, interface, domain)
        self._wait, self.clock = wait, clock
        self._size = LAYOUTS[package, "LowState_"].size
        self._others = _reader(self._participant, COMMANDS, self._sample, foreign=True)
        self._states = _reader(self._participant, STATES, RAW[package, "LowState_"])
        self._requests = _writer(self._participant, MOTION[0], TYPES["unitree_api", "Request_"])
        self._answers = _reader(self._participant, MOTION[1], TYPES["unitree_api", "Response_"], depth=10)
        self._sport = _writer(self._participant, SPORT, TYPES["unitree_api", "Request_"])
        self.dropped = 0  # states of another size or encoding
        # publisher of the robot's states; publisher -> [s] of its last state
        self._robot, self._heard = 0, dict[int, float]()

    def receive(self) -> Received | None:
        """The newest state since the last call, with the time of this call as its stamp, so call it often."""
        for sample in _taken(self._states):
            if len(sample.body) == self._size:
                now = self.clock()
                self._heard[sample.sample_info.publication_handle] = now
                return Received(sample.body, now)
            self.dropped += 1
        return None

    def other_commander(self) -> bool:
        """True if another program sent a command since the last call."""
        return bool(_taken(self._others))

    def another_robot(self) -> str:
        """Why states may come from another robot than the prepared one, or "".

        It counts publishers, because the states of two robots may be equal. A new publisher within AGAIN [s] of the
        prepared robot's last state is another robot. After that it may be the same robot, restarted.
        """
        others = self._publishers() - {self._robot}
        if not self._robot or not others:
            return ""
        if self.clock() - self._heard[self._robot] < AGAIN:
            return f"two robots answer: {len(others) + 1} programs publish {STATES} in {self._where}"
        return f"the robot was started again: another program publishes its {STATES}"

    def _publishers(self) -> set[int]:
        """Publishers of states, by the unsigned handle that samples carry."""
        return {handle % 2**64 for handle in self._states.get_matched_publications()}

    def _one_robot(self, seconds: float) -> None:
        """Raise RobotError if several robots publish states.

        A killed program counts until its lease ends, so wait at most ``seconds`` for that.
        """

        def known() -> bool:
            self.receive()
            return len(self._heard) > 1 or self._publishers() == set(self._heard)

        self._until(known, seconds)
        if (count := len(self._publishers() | set(self._heard))) != 1:
            raise RobotError(f"{count} programs publish {STATES} in {self._where}: end all but one robot; {self._sent}")
        self._robot = next(iter(self._heard))

    def prepare(self, seconds: float = 5.0, listen: float = 0.5, lies_down: bool = False) -> Received:
        """Wait for the robot, switch off its motion service and listen for other commanders. Returns its state.

        ``lies_down``: the robot first lies down, so that it does not fall when its own program releases the motors.
        Raises RobotError with the reason, before any command is sent.
        """
        if not (state := self._until(self.receive, seconds)):
            raise RobotError(self._nobody(seconds))
        self._release(lies_down)
        if self._until(self.other_commander, listen):
            raise RobotError(taken(self._where))
        self._one_robot(LEASE)
        return self._until(self.receive, 0.1) or state

    def _nobody(self, seconds: float) -> str:
        """Why no state came."""
        text = f"no robot: no {STATES} of {self.package} in {self._where} within {seconds:g} s"
        seen = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
        kinds = sorted(
            {s.type_name.partition("::")[0] for s in seen.take(100) if s and s.topic_name == STATES} - {self.package}
        )
        if kinds:
            there, here = "; ".join(known_motors(kind) for kind in kinds), known_motors(self.package)
            return f"{text}; the robot there speaks {', '.join(kinds)}: it is not the contract's. There: {there}. Here: {here}"
        return f"{text}; is it on, is this the right network interface, and can it be pinged (192.168.123.161)?"

    def _release(self, lies_down: bool, tries: int = 8) -> None:
        """Switch off the robot's own motion programs. A robot without the service has none."""
        if not self._until(self._requests.get_matched_subscriptions, 0.5):
            return
        name, moment = "", 0.2 if self._where.endswith(LOOPBACK) else 3.0  # [s] unitree_sdk2's examples wait 1 to 5 s
        for attempt in range(tries):
            if not (name := self._program()):
                return
            self._sent = "no motor command was sent, but its own program may have let go: hold the robot"
            if lies_down and attempt == 0 and self._sport.get_matched_subscriptions():
                self._sport.write(_request(STAND_DOWN))
                self._until(lambda: False, moment)
            self._ask(RELEASE_MODE)
            self._until(lambda: False, moment)
        raise RobotError(
            f"the robot's own program '{name}' does not release the motors: end it with the remote (L2+A, then L2+R2)"
        )

    def _program(self) -> str:
        """The name of the program that controls the motors, or "". Raises RobotError."""
        try:
            content = json.loads(answer := self._ask(CHECK_MODE) or "{}")
            name = content.get("name", "") if isinstance(content, dict) else None
        except (ValueError, RecursionError):
            name = None
        if not isinstance(name, str):
            raise RobotError(
                f"the robot's motion service answers {answer[:80]!r}, which does not say which program runs: {self._sent}"
            )
        return printable(name)

    def _ask(self, call: int, tries: int = 5) -> str:
        """Call the motion service and return its data. Raises RobotError without an answer.

        The call is repeated each second, because an answer is lost if the robot has not discovered this reader yet.
        """
        ids: set[int] = set()
        for _ in range(tries):
            request = _request(call)
            ids.add(request.header.identity.id)
            self._requests.write(request)
            if answers := self._until(
                lambda: [a for a in _taken(self._answers, 10) if a.header.identity.id in ids], 1.0
            ):
                return answers[0].data
        raise RobotError(f"the robot's motion service does not answer: {self._sent}; restart the robot")


class RobotEnd:
    """The end of a simulated robot: it sends states and receives commands and calls of its services."""

    def __init__(self, package: str, interface: str, domain: int) -> None:
        self._participant = _joined_by(self, interface, domain)
        self._sample = RAW[package, "LowState_"]
        self._out = _writer(self._participant, STATES, self._sample)
        self._commands = _reader(self._participant, COMMANDS, RAW[package, "LowCmd_"])
        self._requests = _reader(self._participant, MOTION[0], TYPES["unitree_api", "Request_"], depth=10)
        self._answers = _writer(self._participant, MOTION[1], TYPES["unitree_api", "Response_"])
        self._sport = _reader(self._participant, SPORT, TYPES["unitree_api", "Request_"], depth=10)
        self.program = "normal"  # the motion program that controls the motors; "" once released
        self.calls: list[int] = []  # calls of its services, in order

    def send(self, body: bytes) -> None:
        self._out.write(self._sample(body))

    def receive(self) -> bytes | None:
        """The newest command since the last call."""
        taken = _taken(self._commands)
        return taken[-1].body if taken else None

    def answer(self) -> None:
        """Answer calls of the motion service. Calls of the sport service need no answer."""
        self.calls += [request.header.identity.api_id for request in _taken(self._sport, 10)]
        header, status = TYPES["unitree_api", "ResponseHeader_"], TYPES["unitree_api", "ResponseStatus_"]
        for request in _taken(self._requests, 10):
            call, data = request.header.identity.api_id, ""
            self.calls.append(call)
            if call == CHECK_MODE:
                data = json.dumps({"form": "0", "name": self.program})
            elif call == RELEASE_MODE:
                self.program = ""
            head = header(identity=request.header.identity, status=status(code=0))
            self._answers.write(TYPES["unitree_api", "Response_"](header=head, data=data, binary=[]))
