"""A trained actor by itself: loaded to act, saved small."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from tensordict import TensorDict
from torch import Tensor

from legged_mw.envs.base_task import BaseTask
from legged_mw.envs.legged_robot_config import LeggedRobotCfgPPO
from legged_mw.rl.runs import check_fit, load_tensors, save_whole


def load_policy(path: Path, env: BaseTask, cfg: LeggedRobotCfgPPO, device: str) -> MLPModel:
    """The actor in a checkpoint, ready to act on ``env``'s observations: ``policy(obs)`` is its mean action (N, A).

    Raises ConfigError if the file cannot be read or its networks are not those of the config.
    """
    sections: dict[str, Any] = copy.deepcopy(cfg.to_dict())
    actor_class, actor_cfg = resolve_class(sections["actor"])
    actor = actor_class(env.get_observations(), sections["obs_groups"], "actor", env.num_actions, **actor_cfg).to(device)
    saved = load_tensors(path, device)["actor_state_dict"]
    check_fit(saved, actor.state_dict(), path, "actor")
    actor.load_state_dict(saved)
    return actor.eval()


def save_policy(policy: MLPModel, path: Path, infos: dict[str, Any]) -> None:
    """Write the actor alone: what playing needs, a fraction of a checkpoint."""
    save_whole({"actor_state_dict": {k: v.cpu() for k, v in policy.state_dict().items()}, "infos": infos}, path)


def act(policy: MLPModel, obs: TensorDict) -> Tensor:
    """The policy's mean action (N, A), without gradients."""
    with torch.inference_mode():
        return policy(obs)
