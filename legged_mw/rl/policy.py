"""A trained actor by itself: loaded to act, saved small, exported to ONNX."""

from __future__ import annotations

import copy
import logging
import warnings
from pathlib import Path
from typing import Any

import onnx
import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from tensordict import TensorDict
from torch import Tensor, nn

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


class ExportedPolicy(nn.Module):
    """Observation (1, size) in its plain units -> clipped mean action (1, A); the normaliser is inside."""

    def __init__(self, policy: MLPModel, clip_actions: float) -> None:
        super().__init__()
        self.policy, self.clip_actions = copy.deepcopy(policy).cpu().as_onnx(verbose=False), clip_actions

    def forward(self, obs: Tensor) -> Tensor:
        return self.policy(obs).clamp(-self.clip_actions, self.clip_actions)


def export_onnx(policy: MLPModel, clip_actions: float, path: Path) -> None:
    """Write one self-contained ONNX file: input ``obs`` (1, size), output ``actions`` (1, A)."""
    model = ExportedPolicy(policy, clip_actions).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of its own internals, and logs that torchvision is missing
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            model,
            (torch.zeros(1, policy.obs_dim),),
            path,
            input_names=["obs"],
            output_names=["actions"],
            opset_version=18,
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    _strip(path)


def _strip(path: Path) -> None:
    """Drop what the exporter notes for debugging: stack traces, with the folders of the machine that it ran on."""
    model = onnx.load(path)
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.doc_string = ""
        if hasattr(part, "metadata_props"):
            del part.metadata_props[:]
    onnx.save(model, path)


def act(policy: MLPModel, obs: TensorDict) -> Tensor:
    """The policy's mean action (N, A), without gradients."""
    with torch.inference_mode():
        return policy(obs)
