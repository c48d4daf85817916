"""A robot that is driven: its wire, its log, and who else may stop it; nothing here opens a network."""

from __future__ import annotations

import io
import json
import shutil
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from drivers import Script, Watched, driven

from golden.table import Run, Table, patched, without
from legged_mw import ROOT
from legged_mw.deploy import __main__, replay
from legged_mw.deploy.contract import ContractRow, read_contract
from legged_mw.deploy.controller import Controller, Network
from legged_mw.deploy.fit import fit_log
from legged_mw.deploy.inputs import Gamepad, StopFile
from legged_mw.deploy.joint_check import JointCheck
from legged_mw.deploy.log import Log, read_log
from legged_mw.deploy.mirror import RobotMonitor
from legged_mw.deploy.robot import Robot
from legged_mw.deploy.runner import run
from legged_mw.deploy.safety import Limits
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.unitree import link, need_dds
from legged_mw.unitree.client import UnitreeRobot, check_rows
from legged_mw.unitree.codec import LAYOUTS, WireMessage
from legged_mw.unitree.link import Received, Wire
from legged_mw.unitree.robots import G1, GO2, check_body, machine_of
from tests.wires import Owner

GO2_FLAT = ROOT / "resources/policies/go2_flat"
CONTRACT = read_contract(GO2_FLAT)
STATE = LAYOUTS["unitree_go", "LowState_"]


# ---- the wire


def state(**parts: Any) -> WireMessage:
    message = WireMessage(STATE)
    for name, value in {"tick": 5000, **parts}.items():
        message[name] = value
    return message


def robot(contract: Any = CONTRACT, clock: Callable[[], float] = lambda: 0.0, **parts: Any) -> UnitreeRobot:
    made = state()
    for name, value in parts.items():
        made[name.replace("__", ".")] = value
    return UnitreeRobot(contract, Owner(), Received(made.seal(), 0.0), clock=clock)


def after(*bodies: bytes, late: float = 0.0) -> None:
    """Read after these states came, the last of them ``late`` s ago."""
    now = [0.0]
    made = robot(clock=lambda: now[0])
    made._owner.states.extend(Received(body, 0.0) for body in bodies)  # type: ignore[attr-defined]
    now[0] = late
    for _ in bodies or [b""]:
        made.read()


def another_body() -> None:
    contract = read_contract(ROOT / "resources/policies/g1_flat")
    bodies = []
    for number in (5, 4):
        message = WireMessage(LAYOUTS["unitree_hg", "LowState_"])
        message["mode_machine"] = number
        bodies.append(message.seal())
    UnitreeRobot(contract, Owner(bodies[1]), Received(bodies[0], 0.0), clock=lambda: 0.0).read()


def other_rows(machine: Any, *rows: str) -> None:
    check_rows(
        replace(CONTRACT, rows=(*CONTRACT.rows, *(ContractRow(name, 3, "", "", 0.0, name) for name in rows))), machine
    )


def broken() -> bytes:
    return bytes([*state(tick=5001).seal()[:-1], 1])


def wired(**parts: Any) -> Wire:
    """A wire without a network, whose parts are given."""
    made = Wire.__new__(Wire)
    made.package, made._where, made._sent, made.clock = "unitree_go", "domain 1 on lo", "nothing was sent", lambda: 0.0
    made._wait = lambda: None  # type: ignore[method-assign]
    ticks = iter(range(10**6))
    made.clock = lambda: float(next(ticks))
    for name, value in parts.items():
        setattr(made, name, value)
    return made


ANSWERS = {"text": "no", "a list": "[1]", "a number": '{"name": 3}'}


def lost(*_: object) -> list[Any]:
    return []


def join(interface: str, domain: int, **values: Any) -> None:
    names = {"socket": SimpleNamespace(if_nameindex=lambda: [(1, "lo"), (2, "eth0")]), **values}
    patched(lambda root: link.join(interface, domain), link, **names)(Path())


def busy() -> None:
    def refuse(*_: object) -> None:
        raise link.DDSException(-1)

    join("lo", 3, Domain=lambda *_: None, DomainParticipant=refuse, _joined={})


# ---- the run


class Plain(MujocoRobot):
    limp = Robot.limp


def walk(changed: Any) -> None:
    made = Watched(GO2_FLAT, CONTRACT)
    made.changed = changed
    run(made, Controller(GO2_FLAT, CONTRACT), lambda _: np.zeros(3), 1.0, live=False)


def stiff(root: Path) -> None:
    made = Watched(GO2_FLAT, CONTRACT)
    made.can_change_gains = False
    JointCheck(Controller(GO2_FLAT, CONTRACT), [], print, made, Limits.of(GO2_FLAT, CONTRACT))


def with_log(root: Path) -> Path:
    """A log of no step."""
    Log(root / "walk.lmwlog", CONTRACT, GO2_FLAT, "").close()
    return root / "walk.lmwlog"


def log(root: Path, seconds: float) -> Path:
    path = root / "walk.lmwlog"
    made, controller = Watched(GO2_FLAT, CONTRACT, hoisted=True), Controller(GO2_FLAT, CONTRACT)
    from legged_mw.deploy.safety import Safety
    from legged_mw.deploy.states import States

    kept = Log(path, CONTRACT, GO2_FLAT, "")
    states = States(controller, [Script({})], lambda _: np.zeros(3), lambda _: None)
    run(
        made,
        controller,
        lambda _: np.zeros(3),
        seconds,
        live=False,
        safety=Safety(CONTRACT, Limits.of(GO2_FLAT, CONTRACT)),
        states=states,
        log=kept,
    )
    kept.close()
    return path


def other_format(root: Path) -> None:
    with (root / "a").open("wb") as file:
        np.savez(block := io.BytesIO(), header=json.dumps({"format": 99}))
        file.write(len(block.getvalue()).to_bytes(8, "little") + block.getvalue())


def given_log(seconds: float) -> Run:
    return lambda root: log(root, seconds)


def mirror(root: Path) -> None:
    args = SimpleNamespace(viewer="web", camera="follow", host="127.0.0.1", port=0)
    patched(lambda root: RobotMonitor(GO2_FLAT, CONTRACT, args), sys, executable=shutil.which("false"))(root)  # type: ignore[arg-type]


def measured_feet() -> None:
    args = SimpleNamespace(velocity="odometry", robot="unitree", contact="measured")
    __main__.contact_source(args, read_contract(ROOT / "resources/policies/g1_flat"))  # type: ignore[arg-type]


def table() -> Table:
    made = Table()
    q = np.zeros(20)
    q[[1, 15]] = 0.1
    made.calls(
        {
            "robot: another": lambda: machine_of([*list(GO2.motors)[:11], "RL_foot_joint"]),
            "robot: a G1 of 23 joints": lambda: check_body(G1, 4),
            "robot: an unknown G1": lambda: check_body(G1, 77),
            "robot: more motors": lambda: robot(motor_state__q=q, motor_state__mode=np.ones(20)),
            "robot: feet that are not measured": measured_feet,
            "rows: velocity": lambda: other_rows(GO2, "lin_vel"),
            "rows: velocity and feet of a G1": lambda: other_rows(G1, "lin_vel", "foot_contact"),
            **{
                f"rows: {origin}s": lambda origin=origin: check_rows(
                    replace(CONTRACT, action=CONTRACT.action._replace(origin=origin)), GO2
                )
                for origin in ("torque", "speed")
            },
            "wire: silent": lambda: after(late=0.5),
            "wire: checksums": lambda: after(broken(), broken(), late=0.11),
            "wire: a clock that goes back": lambda: after(state(tick=1000).seal()),
            "wire: another body": another_body,
            "wire: targets of NaN": lambda: robot().write(np.full(12, np.nan)),
            "wire: no robot": lambda: wired(receive=lambda: None, _nobody=lambda seconds: "no robot").prepare(),
            "wire: taken": lambda: wired(
                receive=lambda: 1, _release=lambda _: None, other_commander=lambda: True
            ).prepare(),
            "wire: no program lets go": lambda: wired(
                _requests=SimpleNamespace(get_matched_subscriptions=lambda: True),
                _program=lambda: "ai",
                _ask=lambda _: "",
            )._release(False),
            **{
                f"wire: the motion service answers {name}": lambda answer=answer: wired(
                    _ask=lambda _: answer
                )._program()
                for name, answer in ANSWERS.items()
            },
            "wire: the motion service is silent": lambda: patched(
                lambda root: wired(_requests=SimpleNamespace(write=lambda _: None), _answers=None)._ask(1),
                link,
                _taken=lost,
            )(Path()),
            "join: another interface": lambda: join("eth1", 0),
            "join: another domain": lambda: join("lo", 233),
            "join: another interface before": lambda: join("lo", 1, _joined={1: ("eth0", None)}),
            "join: wrong types": lambda: join(
                "eth0", 0, wrong_hash=lambda: "unitree_go LowCmd_ as 00, not 52", version=lambda _: "0.0"
            ),
            "join: DDS says no": busy,
            "no cyclonedds": lambda: patched(
                lambda root: need_dds(), sys.modules[need_dds.__module__], find_spec=lambda _: None
            )(Path()),
            "no onnxruntime": lambda: without("onnxruntime", lambda root: Network(GO2_FLAT, CONTRACT))(Path()),
            "no gamepad": lambda: Gamepad(Path("js9"), CONTRACT.commands),
            "no file descriptor": lambda: StopFile(999_999),
            "states without damp": lambda: driven(
                Plain(GO2_FLAT, CONTRACT), Controller(GO2_FLAT, CONTRACT), Script({}), 0.1
            ),  # type: ignore[arg-type]
            "states of torques": lambda: driven(
                Watched(GO2_FLAT, CONTRACT),
                Controller(GO2_FLAT, replace(CONTRACT, action=CONTRACT.action._replace(origin="torque"))),
                Script({}),
                0.1,
            ),
            "a joint too fast": lambda: walk(
                lambda step, m: replace(m, joint_vel=m.joint_vel + (99.0 if step == 2 else 0.0))
            ),
            "a measurement of NaN": lambda: walk(lambda step, m: replace(m, ang_vel=np.full(3, np.nan))),
        }
    )
    made.add("joint check of fixed gains", stiff)
    made.add("a viewer that ends", mirror)
    made.add("log: no file", lambda root: read_log(Path("none.lmwlog")))
    made.add("log: text", lambda root: read_log(Path("a")), lambda root: (root / "a").write_bytes(b"no log"))
    made.add("log: no step", lambda root: read_log(Path("walk.lmwlog")), with_log)
    made.add("log: it is there", with_log, with_log)
    made.add(
        "log: no folder", lambda root: Log(root / "no/a", CONTRACT, GO2_FLAT, ""), lambda root: (root / "no").touch()
    )
    made.add("replay: too short", lambda root: replay.replay(Path("walk.lmwlog"), None), given_log(3.0))
    made.add("fit: no chirp", lambda root: fit_log(Path("walk.lmwlog")), given_log(3.0))
    made.add(
        "replay: another network",
        lambda root: replay.replay(Path("walk.lmwlog"), ROOT / "resources/policies/go1_flat"),
        given_log(3.0),
    )
    made.add("log: another format", lambda root: read_log(Path("a")), other_format)
    return made
