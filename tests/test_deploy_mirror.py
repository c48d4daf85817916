"""A driven robot in a viewer: what is sent, what is shown, the button that damps, and the viewer's process."""

from __future__ import annotations

import argparse
import json
import socket
import time
import urllib.request
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from legged_mw import ROOT
from legged_mw.deploy import drive
from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.mirror import ACTIONS, MirroredStage, MirrorSession, RobotMonitor
from legged_mw.deploy.robot import Health, Measurement
from legged_mw.deploy.simulated import MujocoRobot
from legged_mw.view.drive import Pilot
from legged_mw.view.panel import Panel
from legged_mw.view.stage import Moment, ViewError
from legged_mw.view.stream import Stream
from legged_mw.view.web import listen, missing

GO2 = ROOT / "resources/policies/go2_flat"


@pytest.fixture(scope="module")
def contract() -> Contract:
    return read_contract(GO2)


class Ends:
    """A mirror without its viewer's process: both ends of the channel in this one."""

    def __init__(self, contract: Contract) -> None:
        mine, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        for end in (mine, theirs):
            end.setblocking(False)
        self.mirror = RobotMonitor.__new__(RobotMonitor)
        self.mirror.begin(contract, mine)
        self.stage = MirroredStage(GO2, theirs)
        self.shown: list[Moment] = []
        self.pilot = Pilot(self.stage.command_table, 1, only=ACTIONS)
        self.session = MirrorSession(self.stage, self, self.pilot, real_time=False)

    def show(self, moment: Moment) -> None:
        self.shown.append(moment)

    def is_running(self) -> bool:
        return True

    def close(self) -> None: ...

    def turn(self) -> dict[str, str]:
        """The lines of the next picture."""
        self.session.turn()
        self.session.turn()
        return dict(self.shown[-1].lines)


@pytest.fixture
def ends(contract: Contract) -> Iterator[Ends]:
    yield Ends(contract)


def state(name: str, note: str, command: Any = (0.5, 0.0, 0.2)) -> Any:
    return SimpleNamespace(state=name, note=note, command=np.array(command))


def measurement(contract: Contract, **changed: Any) -> Measurement:
    level = {
        "gravity": np.array([0.0, 0.0, -1.0]),
        "joint_pos": contract.default_pose + 0.1,
        "foot_contact": np.array([1.0, 0, 0, 1]),
    }
    return Measurement(**{**vars(MujocoRobot(GO2, contract).read()), **level, **changed})


def test_measured_joints_tilt_state_and_why_are_shown(ends: Ends, contract: Contract) -> None:
    assert ends.turn() == {"state": "", "": "nothing was measured yet", "command": "-", "measured": "+0.00 +0.00 +0.00"}
    gravity = np.array([np.sin(0.3), 0.0, -np.cos(0.3)])  # the nose is 0.3 rad down
    ends.mirror.poll(Health(voltage=31.2, temperatures=np.array([30.0, 41.0])))
    ends.mirror.show(0.0, measurement(contract, gravity=gravity), state("policy", "select: damping"))
    lines = ends.turn()
    assert (lines["state"], lines[""], lines["command"]) == ("policy", "select: damping", "+0.50 +0.00 +0.20")
    assert (lines["battery"], lines["hottest"], lines["time"]) == ("31.2 V", "41 deg C", "0.0 s")
    moment, model = ends.shown[-1], ends.stage.spec.compile()
    angles = moment.qpos[0, [int(model.joint(name).qposadr[0]) for name in contract.joints]]
    assert np.allclose(angles, contract.default_pose + 0.1)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, moment.qpos[0, 3:7])
    assert np.allclose(turn.reshape(3, 3) @ gravity, [0, 0, -1], atol=1e-6)
    feet = [foot for foot, touches in zip(contract.feet, moment.contacts[0], strict=True) if touches]
    assert feet == [name for i, name in enumerate(contract.feet) if i in (0, 3)] and moment.contacts.sum() == 2
    data = mujoco.MjData(model)
    data.qpos[:] = moment.qpos[0]
    mujoco.mj_kinematics(model, data)
    soles = [data.geom(name).xpos[2] - model.geom(name).size[0] for name in contract.feet]
    assert min(soles) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(("gravity", "height"), [((0.0, 0.0, 1.0), 0.057), ((0.0, 1.0, 0.0), 0.195)])
def test_a_robot_that_lies_is_shown_on_the_ground(ends: Ends, contract: Contract, gravity: Any, height: float) -> None:
    """On its back, on its side: the trunk's shapes and the legs' count, not the feet alone."""
    ends.mirror.show(
        0.0, measurement(contract, gravity=np.array(gravity), joint_pos=contract.default_pose), state("damping", "")
    )
    ends.turn()
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, ends.shown[-1].qpos[0, 3:7])
    assert np.allclose(turn.reshape(3, 3) @ gravity, [0, 0, -1], atol=1e-6)
    assert ends.shown[-1].qpos[0, 2] == pytest.approx(height, abs=0.002)


def test_it_walks_by_its_velocity_and_a_silent_robot_stays(ends: Ends, contract: Contract) -> None:
    moving = measurement(contract, lin_vel=np.array([1.0, 0.0, 0.0]), ang_vel=np.array([0.0, 0.0, 0.5]))
    for step in range(50):
        ends.mirror.show(step * contract.period, moving, state("policy", ""))
        ends.turn()
    x, y = ends.shown[-1].qpos[0, :2]
    assert (x, y) == pytest.approx((np.sin(0.5) / 0.5, (1 - np.cos(0.5)) / 0.5), abs=0.03)
    ends.mirror.show(1.0, None, state("damping", "the newest measurement is 120 ms old"))
    lines = ends.turn()
    assert (lines["state"], lines[""]) == ("damping", "the newest measurement is 120 ms old") and lines[
        "command"
    ] == "-"
    assert ends.shown[-1].qpos[0, :2] == pytest.approx((x, y))
    broken = measurement(contract, lin_vel=np.full(3, np.nan), joint_pos=np.full(12, np.nan))
    ends.mirror.show(1.1, broken, state("damping", ""))
    ends.turn()
    assert np.isfinite(ends.shown[-1].qpos).all()


def test_pictures_are_fewer_than_steps(ends: Ends, contract: Contract) -> None:
    for step in range(20):
        ends.mirror.show(step * 0.005, measurement(contract), state("policy", ""))
    sent = []
    while True:
        try:
            sent.append(json.loads(ends.stage._channel.recv(1 << 16))["time"])
        except BlockingIOError:
            break
    assert sent == pytest.approx([0.0, 0.04, 0.08])


def test_the_button_damps_and_nothing_else_is_asked(ends: Ends) -> None:
    assert ends.mirror.poll(Health()).stop == ""
    for key in ("up", "p", "enter", "r"):
        ends.pilot.press(key)
    ends.session.turn()
    wish = ends.mirror.poll(Health())
    assert wish.stop == "the viewer's button" and wish.command is None and not wish.pressed
    assert not ends.pilot.driving and not ends.pilot.paused and ends.mirror.poll(Health()).stop == ""


def test_any_page_of_a_real_robot_may_damp_it(ends: Ends) -> None:
    """Also one that came second: nobody drives there, so nobody drives alone."""
    stream = Stream(None, Panel(ends.pilot, "robot", None, None))  # type: ignore[arg-type]
    stream._watching[object()] = time.monotonic()  # the first page
    assert stream._obey(json.dumps(["click", "reset"]), stream._drives(object(), ""))
    ends.session.turn()
    assert ends.mirror.poll(Health()).stop == "the viewer's button"


def test_what_is_shown_is_called_old_if_nothing_is_measured(
    ends: Ends, contract: Contract, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends.mirror.show(0.0, measurement(contract), state("policy", ""))
    assert "old" not in ends.turn()
    later = time.monotonic() + 3.0
    monkeypatch.setattr(time, "monotonic", lambda: later)
    assert ends.turn()["old"].startswith("nothing was measured for 3.")
    ends.mirror.show(1.0, None, state("damping", "the robot is silent"))  # its program goes on, the robot does not
    lines = ends.turn()
    assert lines["state"] == "damping" and lines["old"].startswith("nothing was measured for 3.")
    ends.mirror.show(2.0, measurement(contract), state("policy", ""))
    assert "old" not in ends.turn()
    ends.mirror.poll(Health(age_s=0.7))
    ends.mirror.show(3.0, measurement(contract), state("policy", ""))
    assert ends.turn()["old"] == "nothing was measured for 0.7 s"


def test_the_viewer_is_a_process_of_its_own(contract: Contract) -> None:
    """It serves the page, reports what is wrong before anything moves, and ends with the robot's program."""
    if reason := missing():
        pytest.skip(reason)
    with listen("127.0.0.1") as free:
        port = free.getsockname()[1]
    args = argparse.Namespace(viewer="web", camera="follow", host="127.0.0.1", port=port)
    with closing(RobotMonitor(GO2, contract, args)) as mirror:
        mirror.show(0.0, measurement(contract), state("stand", ""))
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=60) as page:
            assert page.status == 200 and b"<html" in page.read().lower()
        with pytest.raises(ViewError, match=f"--port {port} is in use on 127.0.0.1"):
            RobotMonitor(GO2, contract, args)
        process = mirror._process
        assert process.poll() is None
    assert process.poll() is not None


# ---- who else may drive


def test_the_first_gamepad_that_is_there_drives(
    contract: Contract, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(drive, "GAMEPADS", tmp_path)
    assert drive._gamepad(contract, None) is None
    (tmp_path / "js0").symlink_to("nowhere")  # cannot be read
    (tmp_path / "js1").touch()
    pad = drive._gamepad(contract, None)
    assert pad and pad.path == tmp_path / "js1"
    pad.close()
    assert drive._gamepad(contract, "off") is None
