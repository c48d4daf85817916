"""The robots of an export as a stage: a viewer can show them and step them by one control period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import SCENE_FILE, Contract, Ends, read_contract
from legged_mw.deploy.controller import Controller
from legged_mw.deploy.odometry import Odometry
from legged_mw.deploy.robot import Floats, Measurement
from legged_mw.deploy.simulated import Change, Fleet
from legged_mw.view.stage import Stage

SCATTER = 0.05  # [rad] largest random change of a joint's start angle [ours]
STROLL = {"lin_vel_x": 0.5}  # [m/s] default command, because a walking robot shows more than a standing robot


def idle_command(contract: Contract) -> Floats:
    """The command (C,) without a user: STROLL if the policy is trained to walk, else the defaults."""
    return contract.held([STROLL.get(command.name, command.default) for command in contract.commands])


class DeployStage(Stage):
    """``num_worlds`` robots with an exported policy in MuJoCo's C engine."""

    def __init__(
        self,
        folder: Path,
        num_worlds: int = 1,
        command: Sequence[float] | None = None,
        threads: int = 0,
        scene_file: str | Path = SCENE_FILE,
        ends: Ends | None = None,
        contact: str | None = None,
        change: Change | None = None,
        whole: bool = False,
        edited: bool = False,
        each: Callable[[], None] | None = None,
    ) -> None:
        """Load the export in ``folder``.

        ``scene_file``, ``change``, ``whole``, ``each``: see Fleet. ``edited``: see read_contract.
        ``command`` (C,) applies if ``step`` gets none. ``ends`` replaces the contract's rules for a fall.
        ``contact``: the source of foot contact for leg odometry, whose velocity the policy gets; None: true velocity.
        """
        contract = read_contract(folder, edited)
        self.fleet = Fleet(
            folder, replace(contract, ends=ends or contract.ends), num_worlds, threads, scene_file, whole, change, each
        )
        self.contract = self.fleet.contract
        self.controller = Controller(folder, self.contract, num_worlds)
        self.odometry = Odometry(folder, self.contract, num_worlds, contact) if contact else None
        self.spec, self.num_worlds, self.dt = self.fleet.spec, num_worlds, self.contract.period
        self.command_table = self.contract.commands
        own = idle_command(self.contract) if command is None else np.array(command, dtype=float)
        self._own = np.tile(own, (num_worlds, 1))
        self._commands = self._own.copy()
        self._fell = np.zeros(num_worlds, dtype=bool)
        self.disturb: Callable[[Measurement], Measurement] | None = None  # applied to what policy and odometry measure
        self.measured = self._seen = self.fleet.read()  # after the last step; input of the policy in the last step

    def step(self, commands: Floats | None = None) -> None:
        """Run one period with ``commands`` (N, C); None: the default commands. A robot that falls is reset."""
        self._take(commands)
        seen = self.disturb(self.measured) if self.disturb else self.measured
        self._seen = self.odometry(seen) if self.odometry else seen
        self.fleet.write(self.controller.act(self._seen, self._commands))
        self._fell = self.fleet.fell()
        if self._fell.any():
            self.fleet.reset(np.flatnonzero(self._fell))
            self._forget(self._fell)
        self.measured = self.fleet.read()

    def _take(self, commands: Floats | None) -> None:
        self._commands = np.array(self._own if commands is None else commands, dtype=float).reshape(self._own.shape)

    def commands(self) -> Floats:
        """Commands (N, C) of the last step, in the order of ``command_table``."""
        return self._commands.copy()

    def velocity(self) -> Floats:
        """(N, 3) vx and vy of the IMU [m/s], yaw rate [rad/s], body frame."""
        return np.concatenate([self.measured.lin_vel[:, :2], self.measured.ang_vel[:, 2:]], axis=1)

    def believed_velocity(self) -> Floats | None:
        """(N, 2) vx, vy [m/s] of leg odometry, else of the policy's last estimate; None without an estimate."""
        estimate = self._seen.lin_vel if self.odometry else self.controller.estimate("base_lin_vel")
        return None if estimate is None else estimate[:, :2]

    def qpos(self) -> Floats:
        """Positions (N, nq)."""
        return self.fleet.qpos.copy()

    def ghost(self) -> Floats | None:
        """The reference frame (N, nq) of each robot; None without a reference motion."""
        return self.controller.follower.ghost() if self.controller.follower else None

    def contacts(self) -> NDArray[np.bool_]:
        """(N, G) true for a foot geom on the ground."""
        return self.fleet.touching()

    def fell(self) -> NDArray[np.bool_]:
        """(N,) true for a fall in the last step."""
        return self._fell.copy()

    def push(self, world: int, velocity: Any) -> None:
        """Add ``velocity`` (2,) [m/s, world frame] to the base velocity. The policy measures it one step later."""
        self.fleet.qvel[world, :2] += velocity

    def put(self, qpos: Floats, qvel: Floats) -> None:
        """Set all robots to ``qpos`` (N, nq) and ``qvel`` (N, nv), and reset their policies."""
        self.fleet.qpos[:], self.fleet.qvel[:] = qpos, qvel
        self.fleet.refresh()
        self._forget(slice(None))
        self.measured = self.fleet.read()

    def scatter(self, seed: int) -> None:
        """Change each joint angle by up to SCATTER, drawn from ``seed``, and reset the policies. Seed 0: no change."""
        if seed:
            joints = self.fleet.qpos.shape[1] - 7
            turned = np.random.default_rng(seed).uniform(-SCATTER, SCATTER, (self.num_worlds, joints))
            self.put(self.qpos() + np.pad(turned, ((0, 0), (7, 0))), self.fleet.qvel.copy())

    def reset(self, world: int) -> None:
        """Reset the robot to its start pose, at rest."""
        self.fleet.reset([world])
        self._forget([world])
        self.measured = self.fleet.read()

    def _forget(self, which: Any) -> None:
        self.controller.reset(which)
        if self.odometry:
            self.odometry.reset(which)
