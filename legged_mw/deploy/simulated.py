"""Robots in MuJoCo's C engine, from an export's ``scene.xml``: one behind the seam, or many side by side.

Measurements come from MuJoCo's sensors by their names. Physics computes sensors before it moves on, so after each period
the sensors of position, velocity and contact are computed again, in the new state; what needs forces (torque, acceleration)
is one physics step old, as it was in training. There, contact was as old, too.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch, SimulationError
from numpy.typing import NDArray

from legged_mw.deploy.contract import FALL, SCAN, SCENE_FILE, Contract, read_scene
from legged_mw.deploy.robot import QUANTITIES, Floats, Measurement, Robot, layout
from legged_mw.utils.machine import usable_cores

_NOW = int(mujoco.mjtStage.mjSTAGE_VEL.value)  # sensors of position and velocity describe the new state

_GROUND_GROUP = [1, 0, 0, 0, 0, 0]  # geom groups that a height scan sees: a robot's own are others
_ABOVE = 2.0  # [m] over the root, where its rays begin


class Fleet:
    """``count`` robots, each in a world of its own, stepped together on ``threads`` threads (0: one a core)."""

    def __init__(self, folder: Path, contract: Contract, count: int = 1, threads: int = 0, scene_file: str = SCENE_FILE) -> None:
        """Load the scene and put every robot into its first keyframe. Raises ContractError."""
        scene = read_scene(folder, contract, scene_file)
        self.contract, self.count, self.model = contract, count, scene.model
        self.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET  # a broken world counts as fallen, in silence
        _keep_quiet()
        self._batch = Batch(self.model, count, threads or min(usable_cores(), count))
        self._sensors, self._layout = self._batch.bind("sensordata"), layout(contract)
        self.qpos: Floats = self._batch.bind("qpos")  # (N, nq), a view: position [m], quaternion, joints in MuJoCo's order
        self.qvel: Floats = self._batch.bind("qvel")  # (N, nv), a view: what is written is in force in the next step
        self._ctrl, self._where, self._actuators = self._batch.bind("ctrl"), scene.sensordata, scene.actuators
        self.broken: NDArray[np.bool_] = np.zeros(count, dtype=bool)  # robots that MuJoCo could not step since their reset
        self.reset()

    def read(self) -> Measurement:
        """Measurement of every robot, (N, ...) each, in copies."""
        values = {name: self._value(name) for name in self._layout}
        return Measurement(**{n: values[n] for n in QUANTITIES}, others={n: v for n, v in values.items() if n not in QUANTITIES})

    def write(self, targets: Floats) -> None:
        """Step every robot by one period with servo targets (N, D) [rad]."""
        self._ctrl[:, self._actuators] = targets
        try:
            self._batch.step(nstep=self.contract.decimation, stage=_NOW)
        except SimulationError as error:  # the others are stepped all the same
            self.broken[error.ids] = True

    def fell(self) -> NDArray[np.bool_]:
        """Robots (N,) whose z axis points below the horizon, that touch the ground with what must not, or whose state is not finite."""
        w, x, y, z = self.qpos[:, 3:7].T
        upright = w**2 - x**2 - y**2 + z**2 >= 0.0  # NaN compares false
        fell = ~upright | ~np.isfinite(self.qvel).all(axis=1) | self.broken
        return fell | (self._sensors[:, self._where[FALL]] > 0.0).any(axis=1) if FALL in self._where else fell

    def reset(self, which: Any = None) -> None:
        """Put the robots ``which`` (indices; None: all) into the first keyframe, at rest."""
        which = np.arange(self.count) if which is None else np.asarray(which)
        self._batch.reset(which, keyframe=0, stage=_NOW)
        self.broken[which] = False

    def limp(self) -> None:
        """Servos off: the joints' own damping is all that is left."""
        for name in ("actuator_gainprm", "actuator_biasprm"):
            self._batch.expand(name)[:] = 0.0

    def _value(self, name: str) -> Floats:
        if name == "gravity":
            return -self._sensors[:, self._where["up"]]
        if any(row.name == name and row.measured == SCAN for row in self.contract.rows):
            return self._scan()
        value = self._sensors[:, self._where[name]]
        return (value > 0.0).astype(float) if name == "foot_contact" else value

    def _scan(self) -> Floats:
        """Heights of the ground around each robot (N, points), by rays from above that see nothing of group 1 and up."""
        assert self.contract.scan
        xs, ys, standing = self.contract.scan
        px, py = (grid.ravel() for grid in np.meshgrid(xs, ys, indexing="ij"))
        root, (w, x, y, z) = self.qpos[:, :3], self.qpos[:, 3:7].T
        yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))[:, None]
        start = np.empty((self.count, len(px), 3))
        start[..., 0] = root[:, :1] + np.cos(yaw) * px - np.sin(yaw) * py
        start[..., 1] = root[:, 1:2] + np.sin(yaw) * px + np.cos(yaw) * py
        start[..., 2] = root[:, 2:] + _ABOVE
        distance, _ = self._batch.ray(start, [0.0, 0.0, -1.0], geomgroup=_GROUND_GROUP)
        below = np.where(distance < 0.0, np.inf, distance - _ABOVE)  # of the root; nothing there: as deep as it gets
        return np.clip(below - standing, -1.0, 1.0)


class MujocoRobot(Robot):
    """One simulated robot behind the seam. Simulated time moves on in ``write``, by one period."""

    def __init__(self, folder: Path, contract: Contract, scene_file: str = SCENE_FILE) -> None:
        self.fleet = Fleet(folder, contract, 1, threads=1, scene_file=scene_file)

    def read(self) -> Measurement:
        many = self.fleet.read()
        return Measurement(**{n: getattr(many, n)[0] for n in QUANTITIES}, others={n: v[0] for n, v in many.others.items()})

    def write(self, targets: Floats) -> None:
        self.fleet.write(np.asarray(targets).reshape(1, -1))

    def close(self) -> None:
        self.fleet.limp()


def _keep_quiet() -> None:
    """A world that breaks is counted; MuJoCo would print a line and write a file of its own."""
    config = mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    config.set()
