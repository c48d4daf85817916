"""A live view of a driven robot, in a window or on a web page: its joints, its state and reason, and a damp button.

A separate process draws, so the view delays no step. Closing the view does not stop the robot. The view cannot drive,
because a browser can close without notice. The position in the view is integrated from the velocity, if known.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import socket
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from legged_mw.deploy.contract import Contract, read_contract
from legged_mw.deploy.inputs import DriveInput, InputSource
from legged_mw.deploy.robot import Floats, Health, Measurement
from legged_mw.deploy.simulated import place, read_scene
from legged_mw.deploy.states import POLICY, States
from legged_mw.utils.errors import UserError
from legged_mw.view import launch
from legged_mw.view.drive import Pilot
from legged_mw.view.session import Session, signed
from legged_mw.view.stage import Stage, ViewError

RATE = 25.0  # [Hz] of frames
START = 30.0  # [s] time limit for a viewer to open
# the only actions and their labels; "": the label of BINDINGS
ACTIONS = {"reset": "Damp", "camera": "", "help": ""}
DAMP = b"damp"
SILENT = 0.5  # [s] without a measurement: the page says that what it shows is old
_PARTS = ("joint_pos", "gravity", "ang_vel", "lin_vel", "foot_contact")  # fields of a measurement
FLAGS = ("viewer", "camera", "host", "port")
LIVE = ("native", "web")  # live values of --viewer


class RobotMonitor(InputSource):
    """The robot program's side of the view. As an input source it can only damp."""

    def __init__(self, folder: Path, contract: Contract, args: argparse.Namespace) -> None:
        """Open the viewer in ``args`` (see ``launch.add_flags``). Raises ViewError."""
        settings = {"folder": str(folder.resolve()), **{name: getattr(args, name) for name in FLAGS}}
        program = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
        channel, viewer_channel = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self.begin(contract, channel)
        with viewer_channel:
            settings["channel"] = viewer_channel.fileno()
            command = [sys.executable, "-c", program, json.dumps(settings)]
            # Ctrl-C must not end the viewer
            self._process = subprocess.Popen(command, pass_fds=(viewer_channel.fileno(),), start_new_session=True)
        problem = self._problem()
        self._channel.setblocking(False)
        if problem:
            self.close()
            raise ViewError(problem)

    def _problem(self) -> str:
        """Wait for the viewer. Returns the reason if it did not open, else an empty string."""
        deadline, alive = time.monotonic() + START, True
        self._channel.settimeout(0.1)
        while alive:
            alive = self._process.poll() is None and time.monotonic() < deadline
            with suppress(OSError):
                return self._channel.recv(4096).decode()
        return f"the viewer did not start: it ended, or took longer than {START:g} s; leave --viewer out"

    def begin(self, contract: Contract, channel: socket.socket) -> None:
        """Initialise the messages, which ``show`` sends through ``channel``."""
        self._period, self._channel, self._due, self._health = contract.period, channel, 0.0, Health()
        self._x = self._y = self._heading = 0.0  # [m], [m], [rad] since the start

    def show(self, now: float, measured: Measurement | None, states: States) -> None:
        """Send the robot's state RATE times per second. Call it once per step."""
        if measured is not None:
            vx, vy, rate = (float(value) for value in (*measured.lin_vel[:2], -measured.gravity @ measured.ang_vel))
            if math.isfinite(vx + vy + rate):
                cos, sin = math.cos(self._heading), math.sin(self._heading)
                self._x += self._period * (cos * vx - sin * vy)
                self._y += self._period * (sin * vx + cos * vy)
                self._heading += self._period * rate
        if now < self._due:
            return
        self._due, health = now + 1.0 / RATE - 1e-9, self._health
        message = {
            "time": now,
            "state": states.state,
            "note": states.note,
            "command": states.command.tolist() if states.state == POLICY else None,
        }
        message |= {"place": [self._x, self._y, self._heading], "voltage": health.voltage, "age": health.age_s}
        message["hottest"] = None if health.temperatures is None else float(health.temperatures.max())
        if measured is not None:
            message |= {name: getattr(measured, name).tolist() for name in _PARTS}
        with suppress(OSError):  # the viewer is closed or busy
            self._channel.send(json.dumps(message).encode())

    def poll(self, health: Health) -> DriveInput:
        self._health = health
        try:
            return DriveInput(stop="the viewer's button" if self._channel.recv(64) == DAMP else "")
        except OSError:
            return DriveInput()

    def close(self) -> None:
        self._channel.close()
        self._process.terminate()
        self._process.wait()


# ---- the viewer's process


class MirroredStage(Stage):
    """The robot's latest state as a stage. It steps no physics."""

    num_worlds, dt = 1, 1.0 / RATE

    def __init__(self, folder: Path, channel: socket.socket) -> None:
        self.contract = read_contract(folder, edited=True)  # the robot's program has checked it
        scene = read_scene(folder, self.contract, whole=True)  # the robot may lie on the ground
        self.spec, self._model, self._data, self._channel = scene.spec, scene.model, mujoco.MjData(scene.model), channel
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)
        self.command_table, self._parent = self.contract.commands, os.getppid()
        # foot index of each foot geom, in the order of the sensors
        self._foot = [
            foot
            for _, foot in sorted(
                (at, foot) for foot, places in enumerate(scene.contacts) for at in set(places.tolist())
            )
        ]
        self.latest: dict[str, Any] = {"command": None, "state": "", "note": "nothing was measured yet"}
        self._heard = time.monotonic()  # [s] time of the newest measurement

    def step(self, commands: Floats | None) -> None:
        """Read the newest message. Exit if the robot's program has ended."""
        newest = None
        with suppress(BlockingIOError):
            while data := self._channel.recv(1 << 16):
                newest = json.loads(data)
        if os.getppid() != self._parent:
            raise SystemExit
        if newest is None:
            return
        self.latest |= newest
        if "joint_pos" not in newest:
            return
        self._heard = time.monotonic()
        if np.isfinite([*newest["joint_pos"], *newest["gravity"]]).all():
            self._data.qpos[:2] = newest["place"][:2]
            angles, gravity = np.array(newest["joint_pos"]), np.array(newest["gravity"])
            place(self._model, self._data, self.contract.joints, angles, gravity, newest["place"][2])

    def silent(self) -> float:
        """Age [s] of the measurement that is shown: of the robot's own message, and of its program's."""
        return time.monotonic() - self._heard + (self.latest.get("age") or 0.0)

    def commands(self) -> Floats:
        return np.array([self.latest["command"] or [each.default for each in self.command_table]])

    def velocity(self) -> Floats:
        return np.nan_to_num(
            np.array([[*self.latest.get("lin_vel", [0.0, 0.0])[:2], self.latest.get("ang_vel", [0.0])[-1]]])
        )

    def qpos(self) -> Floats:
        return self._data.qpos[None].copy()

    def contacts(self) -> Any:
        touches = self.latest.get("foot_contact", [0.0] * len(self.contract.feet))
        return np.array([[touches[foot] > 0.0 for foot in self._foot]])

    def fell(self) -> Any:
        return self.contract.ends.tilted(np.array([self.latest.get("gravity", [0.0, 0.0, -1.0])]))

    def reset(self, world: int) -> None:
        """Damp the robot. The viewer calls this for its button."""
        with suppress(OSError):
            self._channel.send(DAMP)


class MirrorSession(Session):
    """Shows the robot's latest state."""

    stage: MirroredStage

    def _lines(self, command: Floats, velocity: Floats) -> tuple[tuple[str, str], ...]:
        latest = self.stage.latest
        followed = signed(command) if latest["command"] else "-"
        lines = [
            ("state", latest["state"]),
            ("", latest["note"]),
            ("command", followed),
            ("measured", signed(velocity)),
        ]
        for name, key, form in (
            ("battery", "voltage", "{:.1f} V"),
            ("hottest", "hottest", "{:.0f} deg C"),
            ("time", "time", "{:.1f} s"),
        ):
            lines += [(name, form.format(latest[key]))] if latest.get(key) is not None else []
        if (silent := self.stage.silent()) > SILENT:
            lines.insert(0, ("old", f"nothing was measured for {silent:.1f} s"))
        return tuple(lines)


def main() -> None:
    settings = json.loads(sys.argv[1])
    channel = socket.socket(fileno=settings["channel"])
    channel.setblocking(False)
    os.nice(5)  # the robot's program has priority
    args = argparse.Namespace(**{name: settings[name] for name in FLAGS})
    try:
        stage = MirroredStage(Path(settings["folder"]), channel)
        pilot = Pilot(stage.command_table, 1, args.camera, only=ACTIONS)
        if args.viewer == "native":
            viewer = launch.window(stage, pilot, "as asked", fall_back=False)
        else:
            viewer = launch.web_page(stage, pilot, "as asked", args, stage.contract.task)
    except UserError as error:
        channel.send(str(error).encode())
        return
    channel.send(b"")
    assert viewer
    with closing(viewer):
        MirrorSession(stage, viewer, pilot).run()
