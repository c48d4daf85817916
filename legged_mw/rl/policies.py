"""Trained policies on disk: finding one, and loading its actor from a checkpoint or an exported network."""

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
from legged_mw.rl.learner_config import actor_settings, check_classes, check_room, network_section
from legged_mw.rl.run_folder import (
    CONFIG_FILE,
    experiment_folder,
    find_checkpoint,
    find_run,
    runs,
    task_of,
    update_from_run,
)
from legged_mw.utils.config import Config, ConfigError, load_yaml
from legged_mw.utils.errors import printable, shown
from legged_mw.utils.files import check_folder, finish_moving, typed
from legged_mw.utils.task import LoadedTask, load_task, task_names

NETWORK_FILE = "policy.onnx"  # of an export: legged_mw.deploy, which imports nothing from here, calls it so too
MEMORY_INPUT, MEMORY_OUTPUT, ESTIMATE = "state_in", "state_out", "estimate"
PREFIX = "policy."  # of the weights' names in the file: the attribute of ExportedPolicy
MEAN, STD = "obs_normalizer._mean", "obs_normalizer._std"
LEARNING_ONLY = "teacher."  # parameters that are not needed to act
# not needed for a mean action or an estimate
UNWRITTEN = (
    "distribution.",
    LEARNING_ONLY,
    *(f"{of}_normalizer.{name}" for of in ("obs", "target") for name in ("_var", "count")),
)


class PolicySource(NamedTuple):
    """The files of a policy."""

    folder: Path  # holds its config
    checkpoint: Path  # of a run, or the network of an export
    shipped: bool  # it came with this package

    def results(self, task: LoadedTask) -> Path:
        """The folder for pictures and reports of the policy."""
        return experiment_folder(task, task.name) / "shipped" if self.shipped else self.folder


def find_policy(
    task: LoadedTask, run: str | None = None, checkpoint: int = -1, experiment: str | None = None
) -> PolicySource:
    """The named run or export, else the last run, else the policy that ships with the task."""
    folder = experiment_folder(task, experiment)
    if run == "shipped":
        return shipped_policy(task, "--load_run shipped: ")
    if run is not None or checkpoint != -1 or runs(folder):
        return _run_or_export(folder, run or "-1", checkpoint)
    return shipped_policy(task, f"nothing to play: no run in {shown(folder)}, so train first; ")


class Trained(NamedTuple):
    """A policy of another run, and its task as it was trained."""

    source: PolicySource
    task: LoadedTask


def find_trained(name: str, experiment: Path, flag: str, learner: LoadedTask | None = None) -> Trained:
    """The policy that a flag names: a file, a run of ``experiment`` or at a path, an export, a task, or TASK/RUN.

    Its task is one of the project, or in a file that the task of the ``learner`` is or extends.
    """
    path, (task, _, run) = typed(name), name.partition("/")
    try:
        if path.is_file():
            source = PolicySource(path.parent, path, shipped=False)
        elif task in task_names():
            source = find_policy(load_task(task), run or None)
        else:
            source = _run_or_export(experiment, name)
        return Trained(source, load_trained(task_of(source.folder, learner), source))
    except ConfigError as error:
        raise ConfigError(
            f"{flag} {name}: {error}; name a run by its path or as TASK/RUN, or a task for its last or shipped policy"
        ) from None


def find_rival(task: LoadedTask, run: str, experiment: str | None = None) -> PolicySource:
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


def _run_or_export(experiment: Path, name: str, checkpoint: int = -1) -> PolicySource:
    """A run by its name or path, or an export by its path."""
    folder = typed(name)
    finish_moving(folder)  # of an export that was killed
    if (folder / NETWORK_FILE).is_file():
        return PolicySource(check_folder(folder), folder / NETWORK_FILE, shipped=False)
    found = find_run(experiment, name)
    return PolicySource(found, find_checkpoint(found, checkpoint), shipped=False)


def shipped_policy(task: LoadedTask, flag: str) -> PolicySource:
    """The policy that ships with the task. The ConfigError begins with ``flag`` and lists the policies that ship."""
    folder = ROOT / "resources" / "policies" / task.name
    if not (folder / NETWORK_FILE).is_file():
        there = ", ".join(sorted(path.parent.name for path in folder.parent.glob(f"*/{NETWORK_FILE}")))
        raise ConfigError(f"{flag}no policy ships with {task.name}; those that ship: {there or 'none'}")
    return PolicySource(folder, folder / NETWORK_FILE, shipped=True)


def load_trained(name: str, source: PolicySource) -> LoadedTask:
    """The task called ``name`` with the config that the policy was trained with."""
    task, config = load_task(name), source.folder / CONFIG_FILE
    update_from_run(task, load_yaml(config), where=shown(config))
    return task


def introduce(source: PolicySource, changes: dict[str, tuple[Any, Any]]) -> None:
    """Print the policy, and changes of the config that it was trained with."""
    print(f"{'shipped policy' if source.shipped else 'policy'}: {shown(source.checkpoint)}")
    for path, (before, now) in sorted(changes.items()):
        print(printable(f"  {path}: {before} -> {now}"))


def load_policy(path: Path, env: RobotTask, cfg: Config, device: str) -> MLPModel:
    """The actor in a checkpoint or a ``policy.onnx``: ``policy(obs)`` is its mean action (N, A) in ``env``.

    ``cfg`` is the learner's config. Raises ConfigError if the file cannot be read, its networks are not those of the
    config, or the config names a class that it may not.
    """
    actor_class, actor_cfg = resolve_class(acting(cfg, env))
    actor = actor_class(env.get_observations(), cfg.to_dict()["obs_groups"], "actor", env.num_actions, **actor_cfg).to(
        device
    )
    actor.load_state_dict(read_actor(path, actor))
    return actor.eval()


def acting(cfg: Config, env: RobotTask, read: list[str] | None = None) -> dict[str, Any]:
    """Section ``actor`` as rsl-rl takes it, for an actor that only acts in ``env``. Raises ConfigError.

    ``cfg``: the learner's config. ``read``: the observation groups in ``env``, if they have other names than in the
    config.
    """
    check_classes(cfg)
    sections = copy.deepcopy(cfg.to_dict())
    if read:
        sections["obs_groups"]["actor"] = read
    check_room(sections, env, learns=False)
    return network_section(actor_settings(sections, env, learns=False))


def read_actor(path: Path, model: MLPModel, what: str = "actor") -> dict[str, Tensor]:
    """The parameters of ``model`` in a checkpoint, of PPO or a student, or in a ``policy.onnx``. Raises ConfigError."""
    if path.suffix != ".onnx":
        return actor_in(load_tensors(path, str(next(model.parameters()).device)), path, model, what)
    check_fit(saved := read_parameters(path, model), model.state_dict(), path, what)
    return saved


def actor_in(content: dict[str, Any], path: Path, model: MLPModel, what: str = "actor") -> dict[str, Tensor]:
    """The parameters of ``model`` in the ``content`` of the checkpoint at ``path``. Raises ConfigError."""
    own = model.state_dict()
    saved = content["student_state_dict" if "student_state_dict" in content else "actor_state_dict"]
    saved = {name: value for name, value in saved.items() if name in own or not name.startswith(LEARNING_ONLY)}
    check_fit(saved, own, path, what)
    return saved


def act(policy: MLPModel, obs: TensorDict) -> Tensor:
    """The policy's mean action (N, A), without gradients."""
    with torch.inference_mode():
        return policy(obs)


# ---- reading the network of an export -------------------------------------------------------------------------------


def read_parameters(path: Path, policy: MLPModel) -> dict[str, Tensor]:
    """The parameters of ``policy`` by name from the export at ``path``, bit for bit.

    The file holds no noise of exploration, count or variance of the normaliser: ``policy`` keeps its own.
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
    except Exception:  # protobuf's or onnx's
        raise ConfigError(f"{path} cannot be read as an ONNX network: it is damaged") from None
    found = {name.removeprefix(PREFIX): value for name, value in stored.items() if name.startswith(PREFIX)}
    if not found:
        names = ", ".join(list(stored)[:3]) or "none"
        raise ConfigError(
            f"{path} is no network that this project exported: "
            f"its weights are called {names}, not {PREFIX}mlp.0.weight ..."
        )
    if MEAN in found and STD not in found:
        found[STD] = _divisor(graph, stored, path) - getattr(policy.obs_normalizer, "eps", 0.0)
    return {name: value for name, value in policy.state_dict().items() if name.startswith(UNWRITTEN)} | found


def _divisor(graph: Any, stored: dict[str, Tensor], path: Path) -> Tensor:
    """std + eps of the normaliser, found by its place, as torch's exporter chooses its name: (obs - mean) / divisor.

    Subtracting eps and adding it again gives the same float32, as the value is such a rounded sum.
    """
    centred = [node.output[0] for node in graph.node if PREFIX + MEAN in node.input]
    for node in graph.node:
        if node.op_type == "Div" and node.input[0] in centred and node.input[1] in stored:
            return stored[node.input[1]]
    raise ConfigError(f"{path} is no network that this project exported: it does not begin with (obs - mean) / std")
