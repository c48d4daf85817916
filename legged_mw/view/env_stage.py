"""The training environment and a policy as a stage. The one file below `view/` that knows torch and the environment."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from numpy.typing import ArrayLike
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.sim.drawing import visual_model
from legged_mw.sim.terrain import describe
from legged_mw.view.stage import BoolArray, FloatArray


class EnvStage:
    """Robots of a `LeggedRobot` under `policy`; see `stage.Stage`.

    The environment's step may be a recorded graph, so what a pilot changes is written into its buffers between two
    steps. The policy sees a command in the step that it is given for: the observations' row "commands" is filled anew,
    and that row alone, for noise and delays of the others belong to the step.
    """

    def __init__(self, env: LeggedRobot, policy: Callable[[TensorDict], Tensor], limits: ArrayLike) -> None:
        self.env, self.policy = env, policy
        self.model, self.num_worlds, self.dt = visual_model(env.robot, env.cfg.viewer.camera), env.num_envs, env.dt
        self.limits: FloatArray = np.array(limits, dtype=np.float64)
        self._obs = env.get_observations()

    @torch.no_grad()
    def step(self, commands: FloatArray | None) -> None:
        env = self.env
        if commands is not None:
            env.commands.copy_(torch.as_tensor(commands, dtype=torch.float, device=env.device))
            self._tell()
        self._obs, *_ = env.step(self.policy(self._obs))

    def commands(self) -> FloatArray:
        return _array(self.env.commands)

    def velocity(self) -> FloatArray:
        return _array(torch.cat([self.env.base_lin_vel[:, :2], self.env.base_ang_vel[:, 2:]], dim=1))

    def qpos(self) -> FloatArray:
        return _array(self.env.sim.qpos)

    def contacts(self) -> BoolArray:
        return self.env.foot_contact.cpu().numpy().copy()

    def fell(self) -> BoolArray:
        return self.env.fell.cpu().numpy().copy()

    def ground(self, world: int) -> str:
        terrain = self.env.terrain
        if terrain is None:
            return ""
        tile = terrain.tile_at(*self.env.sim.qpos[world, :2].tolist())
        return describe(terrain.kinds[tile[1]], terrain.difficulties[tile[0]]) if tile else "border"

    @torch.no_grad()
    def push(self, world: int, velocity: FloatArray) -> None:
        self.env.sim.qvel[world, :2] += torch.as_tensor(velocity, dtype=torch.float, device=self.env.device)

    @torch.no_grad()
    def reset(self, world: int) -> None:
        mask = torch.zeros(self.num_worlds, dtype=torch.bool, device=self.env.device)
        mask[world] = True
        self.env.restart(mask)
        self._obs = self.env.get_observations()

    def _tell(self) -> None:
        """Put the command into the observations at hand."""
        for group, rows in self.env._observation_rows().items():
            start = 0
            for row in rows:
                span = slice(start, start + row.value.shape[1])
                if row.name == "commands":
                    scale = self.env.obs_scales[group][span] if group in self.env.obs_scales else 1.0
                    self._obs[group][:, span] = row.value * scale
                start = span.stop


def _array(tensor: Tensor) -> FloatArray:
    return tensor.cpu().numpy().astype(np.float64)
