"""Learning from a policy of another run: as a student from its teacher, or by going on from its actor."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import torch
from rsl_rl.models import MLPModel

from legged_mw.envs.observations import Observations, Row
from legged_mw.envs.other_task import class_in, differences, in_words, observe_as
from legged_mw.envs.robot_task import RobotTask
from legged_mw.rl.learner_config import RobotTaskCfgPPO
from legged_mw.rl.network import LEARNING_ONLY
from legged_mw.rl.policies import NETWORK_FILE, Trained, read_actor
from legged_mw.rl.runs import CONFIG_FILE, checkpoints
from legged_mw.utils.config import ConfigError, save_yaml
from legged_mw.utils.errors import shown
from legged_mw.utils.task import LoadedTask

TEACHER = "teacher"  # the observation group that it reads, and its folder in a student's run
# samples that an exported normalizer stands for, as the file does not say [ours: as most have seen]
_EXPORTED_COUNT = 10**8


def adapt(settings: dict[str, Any], cfg: RobotTaskCfgPPO, teacher: dict[str, Any] | None) -> dict[str, Any]:
    """rsl-rl's ``settings`` of the learner's config ``cfg``, for the student of a ``teacher``, its network's settings, or a warm start."""
    distillation, start = cfg.to_dict()["distillation"], cfg.warm_start
    settings["critic_warmup"] = start.critic_warmup if start.policy and not teacher else 0
    noise = settings["actor"].get("distribution_cfg", {})
    if "init_std" in noise and (teacher or start.policy):
        noise["init_std"] = distillation["init_std"] if teacher else start.init_std
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


def seat_teacher(env: RobotTask, teacher: Trained) -> None:
    """Give ``env`` the observation group that the teacher reads. Raises ConfigError if its actions mean something else here."""
    env.observations.attach(_observe(env, teacher, "the teacher"), TEACHER, TEACHER)
    env.first_observations()


def load_teacher(model: MLPModel, teacher: Trained, env: RobotTask) -> None:
    """Give ``model`` the teacher's parameters. Raises ConfigError if it reads another number of values than ``env`` shows it."""
    path = teacher.source.checkpoint
    try:
        model.load_state_dict(read_actor(path, model, TEACHER))
    except ConfigError as error:
        rows = env.observations.groups[TEACHER]
        raise ConfigError(f"{error}; it is shown {sum(row.size for row in rows)} values: {in_words(rows)}") from None


def check_start(env: RobotTask, task: LoadedTask, policy: Trained) -> None:
    """Raise ConfigError if ``policy`` reads other rows than the actor of ``task``, or its actions mean something else."""
    theirs = _observe(env, policy, "the policy to begin with").rows(TEACHER)
    ours = [row for group in task.train.obs_groups.actor for row in env.observations.rows(group)]
    if [*map(_layout, theirs)] != [*map(_layout, ours)]:
        raise ConfigError(
            f"{shown(policy.source.checkpoint)}: it reads {in_words(theirs)}; the actor of {task.name} reads {in_words(ours)}"
        )


def begin_with(model: MLPModel, policy: Trained) -> None:
    """Give ``model`` the actor's parameters; its noise stays its own."""
    path, own = policy.source.checkpoint, model.state_dict()
    if path.suffix == ".onnx" and any(name.startswith(LEARNING_ONLY) for name in own):
        raise ConfigError(
            f"{shown(path)} holds the student alone, not the teacher's encoder that it would learn from; name a checkpoint"
        )
    saved = read_actor(path, model)
    # of observations, of targets
    for name in [name for name in saved if name.endswith("_normalizer._std") and path.suffix == ".onnx"]:
        of = name.removesuffix("_std")
        saved |= {f"{of}_var": saved[name].square(), f"{of}count": torch.full_like(own[f"{of}count"], _EXPORTED_COUNT)}
    model.load_state_dict({**saved, **{name: value for name, value in own.items() if name.startswith("distribution.")}})


def keep_teacher(teacher: Trained, run: Path) -> None:
    """Copy the teacher into the student's run folder, so that the run can be resumed wherever the teacher's goes."""
    folder = run / TEACHER
    if not folder.exists():
        folder.mkdir()
        save_yaml(folder / CONFIG_FILE, teacher.task.to_dict())
        file = teacher.source.checkpoint  # of any name, if a flag named it; a resumed run finds it by one of these
        known = file.name if file in checkpoints(file.parent).values() else "model_0.pt"
        shutil.copy(file, folder / (NETWORK_FILE if file.suffix == ".onnx" else known))


def _observe(env: RobotTask, policy: Trained, who: str) -> Observations:
    """What the policy reads in ``env``, as the group TEACHER. Raises ConfigError if something means something else there."""
    task, kind = policy.task, class_in(env, policy.task.env_class)
    found = [f"its task is a {task.env_class.__name__}, whose rows a {type(env).__name__} does not have"]
    if kind:
        try:
            seen = observe_as(env, kind, task.cfg, task.train.obs_groups.actor, TEACHER)
            if not (found := differences(env, task.cfg, seen.rows(TEACHER))):
                return seen
        except ConfigError as error:  # a row of what is not sensed here
            found = [str(error)]
    raise ConfigError(f"{shown(policy.source.checkpoint)} cannot be {who} here: {'; '.join(found)}")


def _layout(row: Row) -> tuple[str, int, int, list[float]]:
    return row.name, row.value.shape[1], row.history, row.column_scales()
