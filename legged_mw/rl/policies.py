"""Trained policies on disk: find one, load its actor from a checkpoint or an export, distil it or start from it."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Iterable, Sequence
from inspect import getfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from rsl_rl.models import MLPModel
from rsl_rl.utils import resolve_class
from tensordict import TensorDict
from torch import Tensor

from legged_mw import ROOT
from legged_mw.envs.observations import Observations, Row
from legged_mw.envs.robot_task import RobotTask
from legged_mw.envs.robot_task_config import RobotTaskCfg
from legged_mw.rl.learner_config import RobotTaskCfgPPO, actor_settings, check_classes, check_room, network_section
from legged_mw.rl.run_folder import (
    CONFIG_FILE,
    check_fit,
    checkpoints,
    experiment_folder,
    find_checkpoint,
    find_run,
    load_tensors,
    logs_folder,
    runs,
    task_of,
    update_from_run,
)
from legged_mw.utils.commands import command_table
from legged_mw.utils.config import Config, ConfigError, load_yaml, save_yaml
from legged_mw.utils.errors import printable, shown, unknown
from legged_mw.utils.files import check_folder, finish_moving, typed, wrong_name
from legged_mw.utils.task import LoadedTask, load_task, task_names

NETWORK_FILE = "policy.onnx"  # in an export; legged_mw.deploy defines the same name, since it does not import rl
MEMORY_INPUT, MEMORY_OUTPUT, ESTIMATE = "state_in", "state_out", "estimate"
PREFIX = "policy."  # prefix of the weights' names in the file: the attribute of ExportedPolicy
MEAN, STD = "obs_normalizer._mean", "obs_normalizer._std"
LEARNING_ONLY = "teacher."  # prefix of parameters that acting does not need
# prefixes of parameters that a mean action and an estimate do not need
UNWRITTEN = (
    "distribution.",
    LEARNING_ONLY,
    *(f"{of}_normalizer.{name}" for of in ("obs", "target") for name in ("_var", "count")),
)


class PolicySource(NamedTuple):
    """The files of a policy."""

    folder: Path  # with its config
    checkpoint: Path  # checkpoint of a run, or network of an export
    shipped: bool  # part of this package

    def results(self, task: LoadedTask) -> Path:
        """The folder for pictures and reports of the policy."""
        return experiment_folder(task, task.name) / "shipped" if self.shipped else self.folder


def find_policy(
    task: LoadedTask, run: str | None = None, checkpoint: int = -1, experiment: str | None = None
) -> PolicySource:
    """The named run or export, else the latest run, else the policy that ships with the task."""
    folder = experiment_folder(task, experiment)
    if run == "shipped":
        _refuse_checkpoint("the policy that ships", checkpoint)
        return shipped_policy(task, "--load_run shipped: ")
    if run is not None or checkpoint != -1 or runs(folder):
        return _run_or_export(folder, run or "-1", checkpoint)
    return shipped_policy(task, f"nothing to play: no run in {shown(folder)}, so train first; ")


class Trained(NamedTuple):
    """A policy of another run, and its task with the config of its training."""

    source: PolicySource
    task: LoadedTask


def find_trained(
    name: str, experiment: Path, flag: str, learner: LoadedTask | None = None, checkpoint: int = -1
) -> Trained:
    """The policy that a flag names: a file, a run of ``experiment`` or at a path, an export, a task, or TASK/RUN.

    Its task must be one of the project, or the file of the ``learner``'s task or of one that it extends. A task of
    one's own is named by its file or by its folder of runs.
    """
    path, (task, _, run) = typed(name), name.partition("/")
    try:
        if path.suffix == ".py" and path.is_file():
            source = find_policy(load_task(name), checkpoint=checkpoint)
        elif path.is_file():
            _refuse_checkpoint("a file", checkpoint)
            source = PolicySource(path.parent, path, shipped=False)
        elif task in task_names():
            source = find_policy(load_task(task), run or None, checkpoint)
        elif task and not path.is_dir() and not wrong_name(task) and runs(logs_folder() / task):
            source = _run_or_export(logs_folder() / task, run or "-1", checkpoint)
        else:
            source = _run_or_export(experiment, name, checkpoint)
        return Trained(source, load_trained(task_of(source.folder, learner), source))
    except ConfigError as error:
        raise ConfigError(
            f"{flag} {name}: {error}; name a run by its path or as TASK/RUN, or a task for its last or shipped policy"
        ) from None


def find_rival(task: LoadedTask, run: str, experiment: str | None = None) -> PolicySource:
    """The policy that ``--compare`` names. Raises ConfigError if it is of another task."""
    if run == "shipped":
        return shipped_policy(task, "--compare shipped: ")
    rival = _run_or_export(experiment_folder(task, experiment), run)
    rival_task = str(load_yaml(rival.folder / CONFIG_FILE).get("task", task.name))
    if Path(rival_task).stem != task.name:
        raise ConfigError(
            f"--compare {run} is of task '{rival_task}', not '{task.name}': both policies must have the same task"
        )
    return rival


def _run_or_export(experiment: Path, name: str, checkpoint: int = -1) -> PolicySource:
    """A run by its name or path, or an export by its path."""
    folder = typed(name)
    finish_moving(folder)  # of an export whose process was killed
    if (folder / NETWORK_FILE).is_file() and (checkpoint == -1 or not checkpoints(folder)):
        _refuse_checkpoint(f"the export {name}", checkpoint)
        return PolicySource(check_folder(folder), folder / NETWORK_FILE, shipped=False)
    run = find_run(experiment, name)
    return PolicySource(run, find_checkpoint(run, checkpoint), shipped=False)


def _refuse_checkpoint(policy: str, checkpoint: int) -> None:
    if checkpoint != -1:
        raise ConfigError(f"--checkpoint {checkpoint}: {policy} has no checkpoints; name a run, or leave it out")


def shipped_policy(task: LoadedTask, flag: str) -> PolicySource:
    """The policy that ships with the task. Raises ConfigError, whose text starts with ``flag``, if there is none."""
    folder = ROOT / "resources" / "policies" / task.name
    if not (folder / NETWORK_FILE).is_file():
        there = ", ".join(sorted(path.parent.name for path in folder.parent.glob(f"*/{NETWORK_FILE}")))
        raise ConfigError(f"{flag}no policy ships with {task.name}; those that ship: {there or 'none'}")
    return PolicySource(folder, folder / NETWORK_FILE, shipped=True)


def load_trained(name: str, source: PolicySource) -> LoadedTask:
    """The task ``name`` with the config of the policy's training."""
    task, config = load_task(name), source.folder / CONFIG_FILE
    update_from_run(task, load_yaml(config), where=shown(config))
    return task


def introduce(source: PolicySource, changes: dict[str, tuple[Any, Any]]) -> None:
    """Print the policy and the changes to the config of its training."""
    print(f"{'shipped policy' if source.shipped else 'policy'}: {shown(source.checkpoint)}")
    for path, (before, now) in sorted(changes.items()):
        print(printable(f"  {path}: {before} -> {now}"))


def load_policy(path: Path, env: RobotTask, cfg: Config, device: str) -> MLPModel:
    """The actor in a checkpoint or a ``policy.onnx``: ``policy(obs)`` is its mean action (N, A) in ``env``.

    ``cfg``: the learner's config. Raises ConfigError if the file cannot be read, its networks do not fit the config, or
    the config names a class that is not allowed.
    """
    actor_class, actor_cfg = resolve_class(acting(cfg, env))
    actor = actor_class(env.get_observations(), cfg.to_dict()["obs_groups"], "actor", env.num_actions, **actor_cfg).to(
        device
    )
    actor.load_state_dict(read_actor(path, actor))
    return actor.eval()


def acting(cfg: Config, env: RobotTask, read: list[str] | None = None) -> dict[str, Any]:
    """Section ``actor`` in rsl-rl's form, for an actor that does not learn. Raises ConfigError.

    ``cfg``: the learner's config. ``read``: the actor's observation groups in ``env``, if not those of the config.
    """
    check_classes(cfg)
    sections = copy.deepcopy(cfg.to_dict())
    if read:
        sections["obs_groups"]["actor"] = read
    check_room(sections, env, learns=False)
    return network_section(actor_settings(sections, env, learns=False))


def read_actor(path: Path, model: MLPModel, what: str = "actor") -> dict[str, Tensor]:
    """The parameters of ``model`` in a checkpoint of PPO or distillation, or a ``policy.onnx``. Raises ConfigError."""
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
    """Name -> parameter of ``policy`` in the export at ``path``, bit for bit, on its device.

    Exploration noise and the normaliser's count and variance are not in the file, so they come from ``policy``.
    """
    import onnx
    from onnx import numpy_helper

    device = next(policy.parameters()).device
    try:
        graph = onnx.load(path, load_external_data=False).graph
        arrays = {each.name: numpy_helper.to_array(each).astype(np.float32) for each in graph.initializer}
        stored = {name: torch.from_numpy(array).to(device) for name, array in arrays.items()}
    except FileNotFoundError:
        raise ConfigError(f"no policy at {path}") from None
    except Exception:  # errors of protobuf and onnx
        raise ConfigError(f"{path} cannot be read as an ONNX network: it is damaged") from None
    parameters = {name.removeprefix(PREFIX): value for name, value in stored.items() if name.startswith(PREFIX)}
    if not parameters:
        names = ", ".join(list(stored)[:3]) or "none"
        raise ConfigError(
            f"{path} is no network that this project exported: "
            f"its weights are called {names}, not {PREFIX}mlp.0.weight ..."
        )
    if MEAN in parameters and STD not in parameters:
        parameters[STD] = _divisor(graph, stored, path) - getattr(policy.obs_normalizer, "eps", 0.0)
    return {name: value for name, value in policy.state_dict().items() if name.startswith(UNWRITTEN)} | parameters


def _divisor(graph: Any, stored: dict[str, Tensor], path: Path) -> Tensor:
    """std + eps of the normaliser: the divisor in (obs - mean) / divisor. torch's exporter does not keep its name.

    The value is a rounded sum, so subtracting eps and adding it again gives the same float32.
    """
    centred = [node.output[0] for node in graph.node if PREFIX + MEAN in node.input]
    for node in graph.node:
        if node.op_type == "Div" and node.input[0] in centred and node.input[1] in stored:
            return stored[node.input[1]]
    raise ConfigError(f"{path} is no network that this project exported: it does not begin with (obs - mean) / std")


# ---- learning from a policy of another run: as a student of a teacher, or as a warm start ---------------------------


TEACHER = "teacher"  # the teacher's observation group, and its folder in a student's run
# sample count of an exported normaliser, which the file does not hold [ours: typical of a training]
_EXPORTED_COUNT = 10**8

# Fields that must be equal, because they define the meaning of an action or a row. Not every task has them.
_SAME = ("control.action_origin", "normalization.clip_actions", "gait.period", "gait.offsets")
_SAME_SCAN = ("terrain.measured_points_x", "terrain.measured_points_y")


def adapt(settings: dict[str, Any], cfg: RobotTaskCfgPPO, teacher: dict[str, Any] | None) -> dict[str, Any]:
    """Change rsl-rl's ``settings`` for a warm start, or for distillation from the network ``teacher``."""
    distillation, start = cfg.to_dict()["distillation"], cfg.warm_start
    settings["critic_warmup"] = start.critic_warmup if start.policy and not teacher else 0
    noise = settings["actor"].get("distribution_cfg", {})
    if "init_std" in noise and (teacher or start.policy):
        wanted, (low, high) = distillation["init_std"] if teacher else start.init_std, noise["std_range"]
        # within its range: the std is clamped, so at or beyond a bound it has no gradient and would stay
        noise["init_std"] = min(max(wanted, 1.01 * low), 0.99 * high)
    if teacher:
        groups = {"student": settings["obs_groups"]["actor"], "teacher": [TEACHER]}
        algorithm = {name: value for name, value in distillation.items() if name not in ("teacher", "init_std")}
        settings |= {
            "student": settings["actor"],
            "teacher": teacher,
            "obs_groups": groups,
            "algorithm": algorithm,
            "anneal": {},
        }
    return settings


def attach_teacher_observations(env: RobotTask, teacher: Trained) -> None:
    """Add the teacher's observation group to ``env``. Raises ConfigError if its actions have another meaning here."""
    env.observations.attach(_observe(env, teacher, "the teacher"), TEACHER, TEACHER)
    env.first_observations()


def load_teacher(model: MLPModel, teacher: Trained, env: RobotTask) -> None:
    """Load the teacher's parameters into ``model``. Raises ConfigError if the number of inputs differs in ``env``."""
    path = teacher.source.checkpoint
    try:
        model.load_state_dict(read_actor(path, model, TEACHER))
    except ConfigError as error:
        rows = env.observations.groups[TEACHER]
        raise ConfigError(f"{error}; it gets {sum(row.size for row in rows)} values: {_in_words(rows)}") from None


def check_start(env: RobotTask, task: LoadedTask, policy: Trained) -> None:
    """Raise ConfigError unless rows and actions of ``policy`` have the same meaning as those of ``task``'s actor.

    A row may have more frames here than there, if it has one there.
    """
    theirs, ours = _rows_of(env, policy, task.train.obs_groups.actor)
    same = [*map(_layout, theirs)] == [*map(_layout, ours)]
    if not (same and all(row.history in (1, mine.history) for row, mine in zip(theirs, ours, strict=True))):
        raise ConfigError(
            f"{shown(policy.source.checkpoint)}: it reads {_in_words(theirs)}; "
            f"the actor of {task.name} reads {_in_words(ours)}"
        )


def begin_with(model: MLPModel, policy: Trained, env: RobotTask | None = None) -> None:
    """Load the actor's parameters into ``model``, except its exploration noise. Raises ConfigError.

    ``env``: where ``check_start`` was called. Weights of frames that ``policy`` does not read are 0.
    """
    path, own = policy.source.checkpoint, model.state_dict()
    if path.suffix == ".onnx" and any(name.startswith(LEARNING_ONLY) for name in own):
        raise ConfigError(f"{shown(path)} has only the student, not the teacher's encoder; name a checkpoint")
    theirs, ours = _rows_of(env, policy, model.obs_groups) if env else ([], [])
    if [row.history for row in theirs] == [row.history for row in ours]:
        saved = read_actor(path, model)
    else:
        saved = _read_newest(path, model, theirs, ours)
    # the normalisers of observations and of targets
    for name in [name for name in saved if name.endswith("_normalizer._std") and path.suffix == ".onnx"]:
        of = name.removesuffix("_std")
        saved |= {f"{of}_var": saved[name].square(), f"{of}count": torch.full_like(own[f"{of}count"], _EXPORTED_COUNT)}
    model.load_state_dict({**saved, **{name: value for name, value in own.items() if name.startswith("distribution.")}})


def _rows_of(env: RobotTask, policy: Trained, groups: Sequence[str]) -> tuple[list[Row], list[Row]]:
    """The rows that ``policy`` reads in ``env``, and those of the observation ``groups``."""
    theirs = _observe(env, policy, "the policy to begin with").rows(TEACHER)
    return theirs, [row for group in groups for row in env.observations.rows(group)]


def _read_newest(path: Path, model: MLPModel, theirs: list[Row], ours: list[Row]) -> dict[str, Tensor]:
    """The parameters at ``path`` as those of ``model``, whose rows ``ours`` have more frames than ``theirs``."""
    newest, frames, read, start = [], [], 0, 0
    for row, mine in zip(theirs, ours, strict=True):
        start += mine.size
        newest += range(start - row.size, start)
        frames += [*range(read, read + row.size)] * (mine.history // row.history)
        read += row.size
    narrow, first = copy.deepcopy(model), model.mlp[0]
    if not isinstance(first, torch.nn.Linear) or first.in_features != start:
        raise ConfigError(
            f"{shown(path)} has one frame of each row; this actor cannot begin with it; name a policy with its history"
        )
    narrow.mlp[0] = torch.nn.Linear(read, first.out_features, device=first.weight.device)
    for name, value in narrow.obs_normalizer.named_buffers():
        if value.dim() == 2:
            setattr(narrow.obs_normalizer, name, value[:, newest])
    saved, weight = read_actor(path, narrow), torch.zeros_like(first.weight)
    weight[:, newest] = saved["mlp.0.weight"]
    wide = {name: value[:, frames] for name, value in saved.items() if name.startswith("obs_n") and value.dim() == 2}
    return saved | wide | {"mlp.0.weight": weight}


def keep_teacher(teacher: Trained, run: Path) -> None:
    """Copy the teacher into the student's run folder, so that a resume does not need the teacher's run."""
    folder = run / TEACHER
    if not folder.exists():
        folder.mkdir()
        save_yaml(folder / CONFIG_FILE, teacher.task.to_dict())
        file = teacher.source.checkpoint  # with any name; a resumed run expects one of the names below
        known = file.name if file in checkpoints(file.parent).values() else "model_0.pt"
        shutil.copy(file, folder / (NETWORK_FILE if file.suffix == ".onnx" else known))


def _observe(env: RobotTask, policy: Trained, who: str) -> Observations:
    """The policy's observations in ``env``, as group TEACHER. Raises ConfigError if a meaning differs."""
    task, kind = policy.task, _class_in(env, policy.task.env_class)
    differences = [f"its task is a {task.env_class.__name__}, whose rows a {type(env).__name__} does not have"]
    if kind:
        try:
            observations = _observe_as(env, kind, task.cfg, task.train.obs_groups.actor, TEACHER)
            if not (differences := _differences(env, task.cfg, observations.rows(TEACHER))):
                return observations
        except ConfigError as error:  # a row needs a sensor that is missing here
            differences = [str(error)]
    raise ConfigError(f"{shown(policy.source.checkpoint)} cannot be {who} here: {'; '.join(differences)}")


def _layout(row: Row) -> tuple[str, int, list[float]]:
    """What a frame of ``row`` means: its name, width and scales."""
    return row.name, row.value.shape[1], row.column_scales()


# ---- a policy of another task in this one: its observations, and differences in the meaning of its actions ----------


def _class_in(env: RobotTask, kind: type[RobotTask]) -> type[RobotTask] | None:
    """The class ``kind`` among those of ``env``, by name and file, because a task's file may be imported twice."""
    return next(
        (
            each
            for each in type(env).__mro__
            if each.__qualname__ == kind.__qualname__ and getfile(each) == getfile(kind)
        ),
        None,
    )


def _observe_as(
    env: RobotTask, kind: type[RobotTask], cfg: RobotTaskCfg, groups: Sequence[str], name: str
) -> Observations:
    """The observations of a ``kind`` with config ``cfg``, computed in ``env``. Group ``name`` concatenates ``groups``.

    They have no noise and no delay, so the policy's actions are not noisy either. Raises ConfigError for a group that
    the table does not have.
    """
    table = kind.observation_rows(_as_on_a_plane(env, cfg))  # the rows depend on section noise and others
    for group in groups:
        if group not in table:
            raise ConfigError(unknown("observation group", group, table, kind.__name__))
    exact = {
        group: [row if isinstance(row, str) else row._replace(noise=0.0) for row in rows]
        for group, rows in table.items()
    }
    return Observations({**exact, name: [*groups]}, cfg.observations, 0.0, env.num_envs, env.device)


def _in_words(rows: Iterable[Row]) -> str:
    """``base_ang_vel 3, dof_pos 12 x 5 frames``"""
    return ", ".join(
        f"{row.name} {row.value.shape[1]}" + (f" x {row.history} frames" if row.history > 1 else "") for row in rows
    )


def _differences(env: RobotTask, cfg: RobotTaskCfg, rows: Iterable[Row]) -> list[str]:
    """Texts of the differences that give actions or ``rows`` of a policy of ``cfg`` another meaning in ``env``."""
    kinds = [_field(each, "control.actuator") for each in (cfg, env.cfg)]
    differences = [_differ("control.actuator", *kinds)] if "torque" in kinds else []
    there, here = (
        ", ".join(command.name for command in table) or "none" for table in (command_table(cfg), env.command_table)
    )
    differences.append(_differ("the list of commands", there, here))
    if any(differences):
        return [text for text in differences if text]
    theirs, ours = _as_on_a_plane(env, cfg)._load_robot("mujoco"), env.robot
    if theirs.joint_names != ours.joint_names:
        return [
            f"its robot is another one, with the joints {_few(theirs.joint_names)}; "
            f"here they are {_few(ours.joint_names)}"
        ]
    differences = [_joint("default angle", ours.joint_names, theirs.pose, ours.pose, " rad")]
    there, here = (robot.tables["control.action_scale"] for robot in (theirs, ours))
    differences.append(_joint("control.action_scale", ours.joint_names, there, here, ""))
    there, here = (f"{1.0 / (each.sim.dt * each.control.decimation):g} Hz" for each in (cfg, env.cfg))
    differences.append(_differ("the control rate", there, here))
    differences.append(_differ("asset.imu_site", theirs.imu, ours.imu))
    scan = [row for row in rows if row.name == "height_scan"]
    if scan and not scan[0].value.shape[1]:
        differences.append(
            "it reads the height scan, which is off here: name a group in terrain.height_scan, such as privileged_state"
        )
    differences += [
        _differ(path, _field(cfg, path), _field(env.cfg, path)) for path in (*_SAME, *(_SAME_SCAN if scan else ()))
    ]
    return [text for text in differences if text]


def _as_on_a_plane(env: RobotTask, cfg: RobotTaskCfg) -> RobotTask:
    """A shallow, read-only copy of ``env`` with another config and no terrain. It shares the tensors."""
    other = copy.copy(env)
    other.cfg, other.terrain = cfg, None
    return other


def _field(cfg: RobotTaskCfg, path: str) -> Any:
    """The config field at a dotted path, or None if the task does not have it."""
    value: Any = cfg
    for name in path.split("."):
        value = getattr(value, name, None)
    return value


def _differ(what: str, there: Any, here: Any) -> str:
    return "" if there == here else f"{what} is {there} there and {here} here"


def _joint(what: str, names: Sequence[str], there: Sequence[float], here: Sequence[float], unit: str) -> str:
    """Text on the first joint whose values differ, or ''."""
    for name, theirs, ours in zip(names, there, here, strict=True):
        if abs(theirs - ours) > 1e-6:
            return f"{what} of joint {name} is {theirs:g}{unit} there and {ours:g}{unit} here"
    return ""


def _few(names: Sequence[str]) -> str:
    """Up to three names, then the number of names if there are more."""
    return f"{', '.join(names[:3])} ... ({len(names)})" if len(names) > 3 else ", ".join(names)
