"""Trained policies on disk: finding the one that is asked for, loading its actor."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from tensordict import TensorDict
from torch import Tensor

from legged_mw import ROOT
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.checkpoint import check_fit, load_tensors
from legged_mw.rl.rsl_rl_settings import actor_settings, check_classes, check_room, network_section
from legged_mw.rl.run_folder import CONFIG_FILE, experiment_folder, find_checkpoint, find_run, runs, task_of
from legged_mw.utils.config import Config, ConfigError, load_yaml
from legged_mw.utils.errors import printable, shown
from legged_mw.utils.files import check_folder, finish_moving, typed
from legged_mw.utils.task import LoadedTask, load_task, task_names

NETWORK_FILE = "policy.onnx"  # of an export: legged_mw.deploy, which imports nothing from here, calls it so too
MEMORY_INPUT, MEMORY_OUTPUT, ESTIMATE = "state_in", "state_out", "estimate"
PREFIX = "policy."  # of the weights' names in the file: the attribute of ExportedPolicy
MEAN, STD = "obs_normalizer._mean", "obs_normalizer._std"
LEARNING_ONLY = "teacher."  # parameters that nothing needs to act
# neither a mean action nor an estimate needs them
UNWRITTEN = (
    "distribution.",
    LEARNING_ONLY,
    *(f"{of}_normalizer.{name}" for of in ("obs", "target") for name in ("_var", "count")),
)


class Source(NamedTuple):
    """Where a policy comes from."""

    folder: Path  # holds its config
    checkpoint: Path  # of a run, or the network of an export
    shipped: bool  # it came with this package

    def results(self, task: LoadedTask) -> Path:
        """The folder for what is made of the policy: pictures, reports."""
        return experiment_folder(task, task.name) / "shipped" if self.shipped else self.folder


def find_policy(
    task: LoadedTask, run: str | None = None, checkpoint: int = -1, experiment: str | None = None
) -> Source:
    """The run or export asked for, else the last run, else the policy that ships with the task."""
    folder = experiment_folder(task, experiment)
    if run == "shipped":
        return shipped_policy(task, "--load_run shipped: ")
    if run is not None or checkpoint != -1 or runs(folder):
        return _run_or_export(folder, run or "-1", checkpoint)
    return shipped_policy(task, f"nothing to play: no run in {shown(folder)}, so train first; ")


class Trained(NamedTuple):
    """A policy of another run, and its task as it was trained."""

    source: Source
    task: LoadedTask


def find_trained(asked: str, experiment: Path, flag: str, learner: LoadedTask | None = None) -> Trained:
    """The policy that a flag names: a file, a run of this or any ``experiment``, an export, a task, or a run of it as TASK/RUN.

    Its task is the project's, or in a file that the task of the ``learner`` is or extends.
    """
    path, (task, _, run) = typed(asked), asked.partition("/")
    try:
        if path.is_file():
            source = Source(path.parent, path, shipped=False)
        elif task in task_names():
            source = find_policy(load_task(task), run or None)
        else:
            source = _run_or_export(experiment, asked)
        return Trained(source, load_trained(task_of(source.folder, learner), source))
    except ConfigError as error:
        raise ConfigError(
            f"{flag} {asked}: {error}; name a run by its path or as TASK/RUN, or a task for its last or shipped policy"
        ) from None


def find_rival(task: LoadedTask, run: str, experiment: str | None = None) -> Source:
    """The policy that ``--compare`` names; it must be of the same task."""
    if run == "shipped":
        return shipped_policy(task, "--compare shipped: ")
    rival = _run_or_export(experiment_folder(task, experiment), run)
    theirs = str(load_yaml(rival.folder / CONFIG_FILE).get("task", task.name))
    if Path(theirs).stem != task.name:
        raise ConfigError(
            f"--compare {run} is of task '{theirs}', not '{task.name}': two policies are graded on one task"
        )
    return rival


def _run_or_export(experiment: Path, name: str, checkpoint: int = -1) -> Source:
    """A run by its name or path, or an export by its path."""
    folder = typed(name)
    finish_moving(folder)  # of an export that was killed
    if (folder / NETWORK_FILE).is_file():
        return Source(check_folder(folder), folder / NETWORK_FILE, shipped=False)
    found = find_run(experiment, name)
    return Source(found, find_checkpoint(found, checkpoint), shipped=False)


def shipped_policy(task: LoadedTask, asked: str) -> Source:
    """The policy that ships with the task. Raises ConfigError that begins with what was ``asked`` and lists those that ship."""
    folder = ROOT / "resources" / "policies" / task.name
    if not (folder / NETWORK_FILE).is_file():
        there = ", ".join(sorted(path.parent.name for path in folder.parent.glob(f"*/{NETWORK_FILE}")))
        raise ConfigError(f"{asked}no policy ships with {task.name}; those that ship: {there or 'none'}")
    return Source(folder, folder / NETWORK_FILE, shipped=True)


def load_trained(name: str, source: Source) -> LoadedTask:
    """The task called ``name`` with the config that the policy was trained with."""
    task, config = load_task(name), source.folder / CONFIG_FILE
    task.update_from_run(load_yaml(config), where=shown(config))
    return task


def introduce(source: Source, changes: dict[str, tuple[Any, Any]]) -> None:
    """Say which policy it is, and what is changed in the config that it was trained with."""
    print(f"{'shipped policy' if source.shipped else 'policy'}: {shown(source.checkpoint)}")
    for path, (before, now) in sorted(changes.items()):
        print(printable(f"  {path}: {before} -> {now}"))


def load_policy(path: Path, env: RobotTask, cfg: Config, device: str) -> MLPModel:
    """The actor in a checkpoint or a ``policy.onnx``, ready to act on ``env``'s observations: ``policy(obs)`` is its mean action (N, A).

    ``cfg`` is the learner's config. Raises ConfigError if the file cannot be read, its networks are not those of the config,
    or the config names a class that it may not.
    """
    actor_class, actor_cfg = resolve_class(acting(cfg, env))
    actor = actor_class(env.get_observations(), cfg.to_dict()["obs_groups"], "actor", env.num_actions, **actor_cfg).to(
        device
    )
    actor.load_state_dict(read_actor(path, actor))
    return actor.eval()


def acting(cfg: Config, env: RobotTask, read: list[str] | None = None) -> dict[str, Any]:
    """Section ``actor`` of the learner's config as rsl-rl takes it, of an actor that only acts in ``env``. Raises ConfigError.

    ``read``: the observation groups of ``env`` that it reads, if they are not called as in the config.
    """
    check_classes(cfg)
    sections = copy.deepcopy(cfg.to_dict())
    if read:
        sections["obs_groups"]["actor"] = read
    check_room(sections, env, learns=False)
    return network_section(actor_settings(sections, env, learns=False))


def read_actor(path: Path, model: MLPModel, what: str = "actor") -> dict[str, Tensor]:
    """The parameters for ``model`` in a checkpoint, of PPO or of a student, or in a ``policy.onnx``. Raises ConfigError for others."""
    if path.suffix != ".onnx":
        return actor_in(load_tensors(path, str(next(model.parameters()).device)), path, model, what)
    check_fit(saved := read_parameters(path, model), model.state_dict(), path, what)
    return saved


def actor_in(content: dict[str, Any], path: Path, model: MLPModel, what: str = "actor") -> dict[str, Tensor]:
    """The parameters for ``model`` in the ``content`` of the checkpoint at ``path``. Raises ConfigError for others."""
    own = model.state_dict()
    saved = content["student_state_dict" if "student_state_dict" in content else "actor_state_dict"]
    saved = {name: value for name, value in saved.items() if name in own or not name.startswith(LEARNING_ONLY)}
    check_fit(saved, own, path, what)
    return saved


def act(policy: MLPModel, obs: TensorDict) -> Tensor:
    """The policy's mean action (N, A), without gradients."""
    with torch.inference_mode():
        return policy(obs)


# ---- reading the network of an export ---------------------------------------------------------------------------------


def read_parameters(path: Path, policy: MLPModel) -> dict[str, Tensor]:
    """The parameters of ``policy`` by name, as an export wrote them to ``path``: bit for bit, so that it acts as the exported one.

    The noise of exploration and the normalizer's count and variance are not in the file; ``policy`` keeps its own.
    """
    import onnx
    from onnx import numpy_helper

    try:
        graph = onnx.load(path, load_external_data=False).graph
        stored = {
            each.name: torch.from_numpy(numpy_helper.to_array(each).astype(np.float32)) for each in graph.initializer
        }
    except FileNotFoundError:
        raise ConfigError(f"no policy at {path}") from None
    except Exception:  # protobuf's or onnx's, by how the file is broken
        raise ConfigError(f"{path} cannot be read as an ONNX network: it is damaged") from None
    found = {name.removeprefix(PREFIX): value for name, value in stored.items() if name.startswith(PREFIX)}
    if not found:
        names = ", ".join(list(stored)[:3]) or "none"
        raise ConfigError(
            f"{path} is no network that this project exported: its weights are called {names}, not {PREFIX}mlp.0.weight ..."
        )
    if MEAN in found and STD not in found:
        found[STD] = _divisor(graph, stored, path) - getattr(policy.obs_normalizer, "eps", 0.0)
    return {name: value for name, value in policy.state_dict().items() if name.startswith(UNWRITTEN)} | found


def _divisor(graph: Any, stored: dict[str, Tensor], path: Path) -> Tensor:
    """std + eps of the normalizer, which the exporter adds up and names as it likes: the network begins with (obs - mean) / divisor.

    Less eps, rounded, plus eps, rounded, it is the same float32 again, as it was made by such a sum.
    """
    centred = [node.output[0] for node in graph.node if PREFIX + MEAN in node.input]
    for node in graph.node:
        if node.op_type == "Div" and node.input[0] in centred and node.input[1] in stored:
            return stored[node.input[1]]
    raise ConfigError(f"{path} is no network that this project exported: it does not begin with (obs - mean) / std")
