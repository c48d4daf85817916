"""The training environment with a policy as a stage. Only this file of `view/` imports torch and the environment."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torch import Tensor

from legged_mw.drawing.scene import visual_spec
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.students.estimator import believed_velocity
from legged_mw.rl.students.recurrent import forget
from legged_mw.sim.simulation import say_overflow
from legged_mw.sim.terrain import name_tile
from legged_mw.skills.motion_tracking import MotionTracking
from legged_mw.utils.commands import Command
from legged_mw.view.follow import Newest
from legged_mw.view.stage import BoolArray, FloatArray


class EnvStage:
    """The robots of a task under `policy`; see `stage.Stage`.

    `command_table`: the commands with their trained ranges; by default those of the task.

    The environment's step may be a recorded graph, so a pilot's changes are written into its buffers between two steps.
    The policy must see a new command in the same step, so the observation rows "commands" and "gait_clock" are updated.
    Other rows keep the noise and the delays of the last step. ``newest`` reloads a policy that is being trained.
    """

    def __init__(
        self,
        env: RobotTask,
        policy: Callable[[TensorDict], Tensor],
        command_table: Sequence[Command] | None = None,
        newest: Newest | None = None,
    ) -> None:
        self.env, self.policy, self._newest = env, policy, newest
        self.spec, self.num_worlds, self.dt = visual_spec(env.robot, env.cfg.viewer.camera), env.num_envs, env.dt
        self.command_table = env.command_table if command_table is None else tuple(command_table)
        # (N, C), the environment's buffer; a task without commands has none
        self._commands: Tensor = env.commands if env.command_table else env.actions[:, :0]
        self._gait = env.gait if isinstance(env, LeggedRobot) else None
        self._command_columns, self._clock_columns = _columns_of(env, "commands"), _columns_of(env, "gait_clock")
        geoms = (
            len({geom for geoms in env.foot_geoms.values() for geom in geoms}) if isinstance(env, LeggedRobot) else 0
        )
        self._foot_contacts = env.contact_count[:, :geoms]
        self._obs = env.get_observations()
        self._believed: Tensor | None = None  # estimated vx, vy (N, 2) at the last action
        self._overflowed = False  # and the user has been warned

    @torch.no_grad()
    def step(self, commands: FloatArray | None) -> None:
        env = self.env
        if self._newest:
            self._newest()
        if commands is not None:
            self._commands.copy_(torch.as_tensor(commands, dtype=torch.float, device=env.device))
            for group, columns, scales in self._command_columns:
                env.obs_buf[group][:, columns] = self._commands * scales
            if self._gait and isinstance(env, LeggedRobot):
                self._gait.observe(env.is_commanded())
                for group, columns, scales in self._clock_columns:
                    env.obs_buf[group][:, columns] = self._gait.row * scales
            self._obs = env.get_observations()
        self._believed = believed_velocity(self.policy, self._obs)
        self._obs, _, dones, _ = env.step(self.policy(self._obs))
        forget(self.policy, dones)
        self._overflowed = self._overflowed or say_overflow(env.sim, "what is shown")

    @property
    def news(self) -> str:
        """The loaded policy as text, for a stage that reloads it; else empty."""
        return self._newest.news if self._newest else ""

    def commands(self) -> FloatArray:
        return _array(self._commands)

    def velocity(self) -> FloatArray:
        return _array(torch.cat([self.env.base_lin_vel[:, :2], self.env.base_ang_vel[:, 2:]], dim=1))

    def believed_velocity(self) -> FloatArray | None:
        return None if self._believed is None else _array(self._believed)

    def qpos(self) -> FloatArray:
        return _array(self.env.sim.qpos)

    def ghost(self) -> FloatArray | None:
        return _array(self.env.reference.qpos) if isinstance(self.env, MotionTracking) else None

    def contacts(self) -> BoolArray:
        return (self._foot_contacts > 0.0).cpu().numpy()

    def fell(self) -> BoolArray:
        return self.env.fell.cpu().numpy().copy()

    def ground(self, world: int) -> str:
        terrain = self.env.terrain
        if terrain is None:
            return ""
        tile = terrain.tile_at(*self.env.root_pos[world, :2].tolist())
        return name_tile(terrain.kinds[tile[1]], terrain.difficulties[tile[0]]) if tile else "border"

    @torch.no_grad()
    def push(self, world: int, velocity: ArrayLike) -> None:
        self.env.root_lin_vel[world, :2] += torch.as_tensor(velocity, dtype=torch.float, device=self.env.device)

    @torch.no_grad()
    def reset(self, world: int) -> None:
        mask = torch.zeros(self.num_worlds, dtype=torch.bool, device=self.env.device)
        mask[world] = True
        self.env.restart(mask)
        forget(self.policy, mask)
        self._obs = self.env.get_observations()


def _columns_of(env: RobotTask, wanted: str) -> list[tuple[str, slice, Tensor]]:
    """The places of a row's newest values in the observations, also in nested groups: (group, columns, scales)."""
    found: list[tuple[str, slice, Tensor]] = []
    for group, rows in env.observations.groups.items():
        for row in rows:
            newest = env.observations.newest(group, row.name)
            if row.name == wanted:
                found.append((group, newest, torch.tensor(row.column_scales(), device=env.device)))
            elif row.group:
                inside = [(columns, scales) for name, columns, scales in found if name == row.group]
                found += [
                    (group, slice(newest.start + cols.start, newest.start + cols.stop), scales)
                    for cols, scales in inside
                ]
    return found


def _array(tensor: Tensor) -> FloatArray:
    return tensor.cpu().numpy().astype(np.float64)
