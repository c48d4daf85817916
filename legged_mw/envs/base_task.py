"""The border between a recorded step and a learner: rsl-rl's VecEnv. Inside are fixed buffers, outside are copies."""

from __future__ import annotations

from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged_mw.sim.graph import StepGraph
from legged_mw.utils.opaque import fast


class BaseTask(VecEnv):
    """Holds the buffers that cross the border of the recorded step and runs it.

    Inside the step every tensor is fixed and written in place. The learner keeps references across steps, so
    all that ``step`` and ``reset`` hand out is a copy, and all that is handed in is copied.
    """

    device: str
    obs_buf: dict[str, Tensor]  # group -> (N, size)
    max_episode_length: int  # [control steps]

    def __init__(self, num_envs: int, num_actions: int, device: str, eager: bool = False) -> None:
        self.num_envs, self.num_actions, self.device, self.eager = num_envs, num_actions, device, eager
        self.actions = torch.zeros(num_envs, num_actions, device=device)
        self.rew_buf = torch.zeros(num_envs, device=device)
        self.reset_buf = torch.zeros(num_envs, dtype=torch.bool, device=device)  # the episode ended in this step
        # it ended by the clock, or off the terrain; no fall
        self.time_out_buf = torch.zeros(num_envs, dtype=torch.bool, device=device)
        self._episode_length_buf = torch.zeros(num_envs, dtype=torch.long, device=device)  # [control steps]
        self._graph = StepGraph(self._step, device, eager)

    @property
    def episode_length_buf(self) -> Tensor:
        """Age of each episode (N,) [control steps]."""
        return self._episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length_buf.copy_(value)  # rsl-rl assigns a new tensor; the recorded step knows only this one

    def get_observations(self) -> TensorDict:
        """Copies of the observation groups, each (N, size)."""
        return TensorDict(
            {name: obs.clone() for name, obs in self.obs_buf.items()}, batch_size=[self.num_envs], device=self.device
        )

    @torch.no_grad()  # actions that carry gradients must not make the fixed buffers carry them
    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step with ``actions`` (N, A); returns copies of observations, reward (N,), done (N,) and time outs.

        An environment whose episode ended is already reset: its observation is the first of the next episode.
        """
        if actions.shape != self.actions.shape:
            raise ValueError(
                f"actions must be {tuple(self.actions.shape)} (environments, joints); got {tuple(actions.shape)}"
            )
        with torch.inference_mode():  # the fixed buffers stay ordinary tensors; what lives for a moment is cheaper so
            self.actions.copy_(actions)
            self._graph()
        extras = {"time_outs": self.time_out_buf.clone()}
        return self.get_observations(), self.rew_buf.clone(), self.reset_buf.clone(), extras

    @torch.no_grad()
    def reset(self) -> TensorDict:
        """Begin a new episode everywhere; returns its first observations."""
        self._reset_all()
        return self.get_observations()

    def fuse(self, steps: int) -> None:
        """Make the step faster where legged_mw/fast is there and that pays over so many ``steps``; else it stays as it is."""
        if fusion := fast("fusion"):
            fusion.fuse(self, steps)

    def _step(self) -> None:
        """The recorded part: reads ``actions``; writes observations, reward, done and time out."""
        raise NotImplementedError

    def _reset_all(self) -> None:
        raise NotImplementedError
