"""The table of exams, and the look-up of a task's exam. play.py and train.py use exams through this table only."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from types import ModuleType
from typing import Any, NamedTuple, Protocol

from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval import crossing, exam, perform, report, rules
from legged_mw.eval.rollout import Policy
from legged_mw.eval.rules import ExamRules
from legged_mw.eval.skill import Skill
from legged_mw.eval.skills import SKILLS
from legged_mw.eval.training import TrainingExam
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown
from legged_mw.utils.task import LoadedTask


class Examiner(Protocol):
    """The exam during training: a call with a policy returns figures by name."""

    env: RobotTask

    def __call__(self, policy: Policy) -> dict[str, float]: ...


class Exam(NamedTuple):
    """One kind of exam. Its result and its figures are dicts of JSON values."""

    sets: Callable[[LoadedTask], set[str]]  # config fields that the user may not override
    prepare: Callable[[LoadedTask], None]  # turns a task into the exam
    make_room: Callable[[LoadedTask], None]  # sets the number of worlds again, after the user's overrides
    ask_alike: Callable[[Sequence[LoadedTask]], None]  # grades all prepared tasks by the rules of the first
    # (environment, policy, environment of the rough part or None) -> result, figures
    examine: Callable[..., tuple[dict[str, Any], dict[str, Any]]]
    rules: Callable[[LoadedTask], ExamRules | Skill]  # of a prepared task, also for another physics engine
    table: Callable[[dict[str, Any]], str]  # the result as text
    write: Callable[..., None]  # the report: see report.write
    in_training: Callable[[LoadedTask, str, bool], Examiner]  # task, device, eager
    rough: ModuleType | None = None  # second part for rough terrain, with prepare, SETS, make_room and table


def _skill(kind: str) -> Exam:
    """The exam for one kind of ``SKILLS``."""
    return Exam(
        sets=lambda task: {*perform.overrides(task), "env.num_envs"} - {"domain_rand.enable"},
        prepare=perform.prepare,
        make_room=perform.make_room,
        ask_alike=perform.ask_alike,
        examine=partial(perform.examine, kind),
        rules=lambda task: perform.skill_of(task.cfg, task.exam),
        table=perform.table,
        write=perform.write,
        in_training=perform.InTraining,
    )


EXAMS = {
    "walking": Exam(
        sets=lambda task: exam.SETS,
        prepare=report.prepare,
        make_room=report.make_room,
        ask_alike=report.ask_alike,
        examine=report.examine,
        rules=lambda task: ExamRules.from_config(task.cfg),
        table=rules.table,
        write=report.write,
        in_training=TrainingExam,
        rough=crossing,
    ),
    **{kind: _skill(kind) for kind in SKILLS},
}


def find_exam(task: LoadedTask) -> Exam | None:
    """The exam of ``task``; None if the task names none. Raises ConfigError for an unknown name."""
    if task.exam and task.exam not in EXAMS:
        raise ConfigError(f"{task.path}: {unknown('exam', task.exam, EXAMS, 'legged_mw/eval/exams.py')}")
    return EXAMS.get(task.exam)


def require_exam(task: LoadedTask) -> Exam:
    """The exam of ``task``. Raises ConfigError if it has none."""
    if not (found := find_exam(task)):
        hint = "A task that walks by command has the walking exam, another one names its own: TASK = Task(Env, Cfg, CfgPPO, exam=...)"
        raise ConfigError(f"--eval: no exam grades task '{task.name}'; there are: {', '.join(EXAMS)}. {hint}")
    return found


def make_exam(task: LoadedTask, env: RobotTask, eager: bool = False) -> Examiner | None:
    """The exam during the training in ``env``; None if the task has none.

    Also None, with a printed reason, if the policy cannot read the observations of the exam's nominal world.
    """
    if not (kind := find_exam(task)):
        return None
    examine = kind.in_training(task, env.device, eager)
    here, there = env.get_observations(), examine.env.get_observations()
    for group in task.train.obs_groups.actor:
        # the learner reports an unknown group
        if group in here and here[group].shape[1] != there[group].shape[1]:
            sizes = f"{there[group].shape[1]} values in the exam's nominal world and {here[group].shape[1]} in training"
            print(f"no exam during training: the actor's observation group '{group}' has {sizes}")
            return None
    return examine
