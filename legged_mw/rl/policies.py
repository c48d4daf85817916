"""Trained policies on disk: finding the one that is asked for, loading its actor, saving it small."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, NamedTuple

import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from tensordict import TensorDict
from torch import Tensor

from legged_mw import ROOT
from legged_mw.envs.base_task import BaseTask
from legged_mw.rl.classes import check_classes
from legged_mw.rl.runs import (
    CONFIG_FILE,
    check_fit,
    experiment_folder,
    find_checkpoint,
    find_run,
    load_tensors,
    runs,
    save_whole,
)
from legged_mw.utils.config import Config, ConfigError, load_yaml
from legged_mw.utils.errors import shown
from legged_mw.utils.task import LoadedTask, load_task


class Source(NamedTuple):
    """Where a policy comes from."""

    folder: Path  # holds its config
    checkpoint: Path
    shipped: bool  # it came with this package

    def results(self, task: LoadedTask) -> Path:
        """The folder for what is made of the policy: pictures, reports."""
        return experiment_folder(task, task.name) / "shipped" if self.shipped else self.folder


def find_policy(task: LoadedTask, run: str | None = None, checkpoint: int = -1, experiment: str | None = None) -> Source:
    """The run asked for, else the last run, else the policy that ships with the task."""
    folder = experiment_folder(task, experiment)
    if run == "shipped":
        return shipped_policy(task, f"--load_run shipped: no policy ships with {task.name}")
    if run is not None or checkpoint != -1 or runs(folder):
        found = find_run(folder, run or "-1")
        return Source(found, find_checkpoint(found, checkpoint), shipped=False)
    return shipped_policy(task, f"nothing to play: no run in {shown(folder)} and no policy shipped for {task.name}; train first")


def find_rival(task: LoadedTask, run: str, experiment: str | None = None) -> Source:
    """The policy that ``--compare`` names; it must be of the same task."""
    if run == "shipped":
        return shipped_policy(task, f"--compare shipped: no policy ships with {task.name}")
    found = find_run(experiment_folder(task, experiment), run)
    theirs = str(load_yaml(found / CONFIG_FILE).get("task", task.name))
    if Path(theirs).stem != task.name:
        raise ConfigError(f"--compare {run} is of task '{theirs}', not '{task.name}': two policies are graded on one task")
    return Source(found, find_checkpoint(found, -1), shipped=False)


def shipped_policy(task: LoadedTask, otherwise: str) -> Source:
    """The policy that ships with the task; ``otherwise`` is the error where there is none."""
    folder = ROOT / "resources" / "policies" / task.name
    if not (folder / "model.pt").is_file():
        raise ConfigError(otherwise)
    return Source(folder, folder / "model.pt", shipped=True)


def load_trained(name: str, source: Source) -> LoadedTask:
    """The task called ``name`` with the config that the policy was trained with."""
    task, config = load_task(name), source.folder / CONFIG_FILE
    task.update_from_run(load_yaml(config), where=shown(config))
    return task


def introduce(source: Source, changes: dict[str, tuple[Any, Any]]) -> None:
    """Say which policy it is, and what is changed in the config that it was trained with."""
    print(f"{'shipped policy' if source.shipped else 'policy'}: {shown(source.checkpoint)}")
    for path, (before, now) in sorted(changes.items()):
        print(f"  {path}: {before} -> {now}")


def load_policy(path: Path, env: BaseTask, cfg: Config, device: str) -> MLPModel:
    """The actor in a checkpoint, ready to act on ``env``'s observations: ``policy(obs)`` is its mean action (N, A).

    ``cfg`` is the learner's config. Raises ConfigError if the file cannot be read, its networks are not those of the config,
    or the config names a class that it may not.
    """
    check_classes(cfg)
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
