"""The interface between a recorded step and a learner: rsl-rl's VecEnv. Fixed buffers inside, copies outside."""

from __future__ import annotations

from typing import Any, TypeVar

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict
from torch import Tensor

from legged_mw.sim.graph import StepGraph
from legged_mw.utils.opaque import fast

Kept = TypeVar("Kept")


class BaseTask(VecEnv):
    """Holds the inputs and outputs of the recorded step, and runs it.

    In the step every tensor is fixed and written in place. The learner keeps references across steps, so ``step`` and
    ``reset`` return copies and copy their arguments.
    """

    device: str
    obs_buf: dict[str, Tensor]  # group -> (N, size)
    max_episode_length: int  # [control steps]
    not_remembered = ""  # why a resume cannot be exact: state that is in no buffer, found by check/'s guard

    def __init__(self, num_envs: int, num_actions: int, device: str, eager: bool = False) -> None:
        self.num_envs, self.num_actions, self.device, self.eager = num_envs, num_actions, device, eager
        self._remembered: list[Any] = []
        self.actions = self.buffer(num_actions)
        self.rew_buf = self.buffer()
        self.reset_buf = self.buffer(dtype=torch.bool)  # the episode ended in this step
        self.time_out_buf = self.buffer(dtype=torch.bool)  # it ended by the time limit or off the terrain
        self._episode_length_buf = self.buffer(dtype=torch.long)  # [control steps]
        self._graph = StepGraph(self._step, device, eager)

    def buffer(self, *shape: int, dtype: torch.dtype = torch.float) -> Tensor:
        """Make zeros (N, *shape) that the step writes in place and a resumed run restores."""
        return self.remember(torch.zeros(self.num_envs, *shape, dtype=dtype, device=self.device))

    def remember(self, kept: Kept) -> Kept:
        """Register a tensor, a list or dict of them, or an object with names in ``written``, for an exact resume."""
        self._remembered.append(kept)
        return kept

    def remembered(self) -> dict[str, Tensor]:
        """Name of the attribute -> tensor, for all registered tensors."""
        names = {id(value): name for name, value in reversed(vars(self).items())}
        tensors: dict[str, Tensor] = {}
        for place, kept in enumerate(self._remembered):
            tensors |= _tensors(names.get(id(kept), f"buffer {place}"), kept)
        return tensors

    @property
    def episode_length_buf(self) -> Tensor:
        """Age of each episode (N,) [control steps]."""
        return self._episode_length_buf

    @episode_length_buf.setter
    def episode_length_buf(self, value: Tensor) -> None:
        self._episode_length_buf.copy_(value)  # rsl-rl assigns a new tensor; the recorded step uses only this one

    def get_observations(self) -> TensorDict:
        """Copies of the observation groups, each (N, size)."""
        copies = {name: obs.clone() for name, obs in self.obs_buf.items()}
        return TensorDict(copies, batch_size=[self.num_envs], device=self.device)

    @torch.no_grad()  # actions with gradients must not give the fixed buffers gradients
    def step(self, actions: Tensor) -> tuple[TensorDict, Tensor, Tensor, dict[str, Any]]:
        """One control step with ``actions`` (N, A). Returns copies of observations, reward (N,), done (N,), time outs.

        Where done is true, the environment is already reset and its observation is the first of the next episode.
        """
        if actions.shape != self.actions.shape:
            expected, actual = tuple(self.actions.shape), tuple(actions.shape)
            raise ValueError(f"actions must be {expected} (environments, joints); got {actual}")
        with torch.inference_mode():  # faster temporary tensors; the fixed buffers stay normal tensors
            self.actions.copy_(actions)
            self._graph()
        extras = {"time_outs": self.time_out_buf.clone()}
        return self.get_observations(), self.rew_buf.clone(), self.reset_buf.clone(), extras

    @torch.no_grad()
    def reset(self) -> TensorDict:
        """Reset all environments. Returns the first observations."""
        self._reset_all()
        return self.get_observations()

    def fuse(self, steps: int) -> None:
        """Compile the step with legged_mw/fast, if the package exists and this saves time within ``steps``."""
        if fusion := fast("step_compiler"):
            fusion.fuse(self, steps)

    def _step(self) -> None:
        """The recorded part. It reads ``actions`` and writes observations, reward, done and time out."""
        raise NotImplementedError

    def _reset_all(self) -> None:
        raise NotImplementedError


def _tensors(name: str, kept: Any) -> dict[str, Tensor]:
    """Name -> tensor of the registered ``kept``, whose name is ``name``."""
    if isinstance(kept, Tensor):
        return {name: kept}
    if isinstance(kept, dict | list | tuple):
        parts = kept.items() if isinstance(kept, dict) else enumerate(kept)
    else:
        parts = ((each, getattr(kept, each)) for each in getattr(kept, "written", ()))
    return {path: tensor for part, value in parts for path, tensor in _tensors(f"{name}.{part}", value).items()}
