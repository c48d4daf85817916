"""The table of exams, the exam of a task, and ``play.py --eval``, which grades policies and writes a report."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Protocol

from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval import hard, heat, perform, report, rollout, rough, walking
from legged_mw.eval.report import Column
from legged_mw.eval.rollout import Policy, TrainingExam
from legged_mw.eval.skills import SKILLS, Skill
from legged_mw.eval.walking import ExamRules, in_common
from legged_mw.rl.learner_config import check_classes
from legged_mw.rl.policies import PolicySource, introduce, load_policy
from legged_mw.sim.simulation import overflow_note
from legged_mw.utils.cli import apply_overrides, pick_device, seed_everything
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import shown, unknown
from legged_mw.utils.files import writable
from legged_mw.utils.task import LoadedTask


class Examiner(Protocol):
    """The exam during training. A call with a policy returns figures by name."""

    env: RobotTask
    advice: list[str]  # lines on the policy that was graded last

    def __call__(self, policy: Policy) -> dict[str, float]: ...


class Exam(NamedTuple):
    """One kind of exam. Its result and its figures are dicts of JSON values."""

    sets: Callable[[LoadedTask], set[str]]  # config fields that the user may not override
    prepare: Callable[[LoadedTask], None]  # changes a task's config to that of the exam
    make_room: Callable[[LoadedTask], None]  # sets the number of worlds again, after the user's overrides
    ask_alike: Callable[[Sequence[LoadedTask]], None]  # gives all prepared tasks the rules of the first
    # environment of the prepared task, policy -> result, figures
    examine: Callable[[Any, Policy], tuple[dict[str, Any], dict[str, Any]]]
    rules: Callable[[LoadedTask], ExamRules | Skill]  # of a prepared task, also for another physics engine
    table: Callable[[dict[str, Any]], str]  # the result as text
    write: Callable[[Path, str, Sequence[Column]], None]  # the report on a task's policies, into a folder
    in_training: Callable[[LoadedTask, str, bool], Examiner]  # task, device, eager
    rough: ModuleType | None = (
        None  # second part for rough terrain, with SETS, prepare, make_room, run_crossing and table
    )


def _skill(kind: str) -> Exam:
    """The exam of one kind of ``SKILLS``."""
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
        sets=lambda task: rollout.SETS,
        prepare=rollout.prepare,
        make_room=rollout.make_room,
        ask_alike=rollout.ask_alike,
        examine=rollout.examine,
        rules=lambda task: ExamRules.from_config(task.cfg),
        table=walking.table,
        write=report.write,
        in_training=TrainingExam,
        rough=rough,
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
    if not (exam := find_exam(task)):
        hint = "A task that walks by command has the walking exam, another one names its own: TASK = Task(Env, Cfg, CfgPPO, exam=...)"
        raise ConfigError(f"--eval: no exam grades task '{task.name}'; there are: {', '.join(EXAMS)}. {hint}")
    return exam


def make_exam(task: LoadedTask, env: RobotTask, eager: bool = False) -> Examiner | None:
    """The exam during training in ``env``; None if the task has none.

    Also None, with a printed reason, if the observations of the exam's nominal world have another size.
    """
    if not (kind := find_exam(task)):
        return None
    examine = kind.in_training(task, env.device, eager)
    trained, nominal = env.get_observations(), examine.env.get_observations()
    for group in task.train.obs_groups.actor:
        # the learner reports an unknown group
        if group in trained and trained[group].shape[1] != nominal[group].shape[1]:
            sizes = f"{nominal[group].shape[1]} values in the exam's nominal world and {trained[group].shape[1]} in training"
            print(f"no exam during training: the actor's observation group '{group}' has {sizes}")
            return None
    return examine


# ---- ``play.py --eval``


class Graded(NamedTuple):
    """A policy and the tasks of its exam."""

    source: PolicySource
    trained: LoadedTask
    task: LoadedTask
    exam: Exam
    crossing: LoadedTask | None  # the rough part of the exam, if there is one


Elsewhere = Callable[[Graded], list[Column]]


def grade(policies: list[tuple[PolicySource, LoadedTask]], args: argparse.Namespace, elsewhere: Elsewhere) -> None:
    """Grade policies, each with its trained config. Print their tables and write a report next to the first policy.

    ``elsewhere`` grades the first policy on another physics engine, also with the hard exam.
    """
    device = pick_device(args.device)
    first, *rivals = policies
    graded = [prepare(*first, args, common=args.ranges == "common"), *(prepare(*rival, args) for rival in rivals)]
    graded[0].exam.ask_alike([each.task for each in graded])
    introduce(graded[0].source, graded[0].task.changes_since(graded[0].trained))
    folder = graded[0].source.results(graded[0].task) / "eval"
    writable(str(folder), "the report goes to", folder=True)
    built = [(each, *build(each, args, device)) for each in graded]  # an error must come before a long exam
    columns = [make_column(*each) for each in built]
    columns[1:1] = elsewhere(graded[0])
    for column in columns[1:]:
        for name, text in (("hard", hard.table), ("heat", heat.table)):
            if name in column.exam:
                print(f"{column.name}\n{text(column.exam[name])}\n")
    graded[0].exam.write(folder, graded[0].task.name, columns)
    print(f"written to {shown(folder / 'report.html')}, with report.json and pictures beside it")


def prepare(source: PolicySource, trained: LoadedTask, args: argparse.Namespace, common: bool = False) -> Graded:
    """The trained task with the exam's overrides, then the user's.

    ``common``: use the command range in which all published policies of the robot were measured.
    """
    task, exam = copy.deepcopy(trained), require_exam(trained)
    exam.prepare(task)
    override(task, args, exam.sets(task))
    if common:
        task.update({"exam": in_common(getattr(getattr(task.cfg, "exam", None), "peer", ""))}, where="--ranges common")
    exam.make_room(task)  # the user's overrides can change the ranges
    return Graded(source, trained, task, exam, prepare_crossing(trained, args))


def prepare_crossing(trained: LoadedTask, args: argparse.Namespace) -> LoadedTask | None:
    """The task of the exam's rough part with the user's overrides; None if the policy was trained on a plane."""
    crossing = require_exam(trained).rough
    if not crossing or trained.to_dict()["terrain"].get("mesh_type", "plane") == "plane":
        return None
    task = copy.deepcopy(trained)
    crossing.prepare(task)
    override(task, args, crossing.SETS)
    crossing.make_room(task)  # the user's overrides can change the kinds of terrain
    return task


def override(task: LoadedTask, args: argparse.Namespace, sets: set[str]) -> None:
    """Apply the user's overrides. Raises ConfigError for a field that the exam ``sets``."""
    before = copy.deepcopy(task)
    apply_overrides(task, args)
    check_classes(task.train)
    if touched := sets & task.changes_since(before).keys():
        raise ConfigError(
            f"--eval sets {', '.join(sorted(touched))} itself; an exam with other values would be another exam"
        )


def build(graded: Graded, args: argparse.Namespace, device: str) -> tuple[Policy, RobotTask, RobotTask | None]:
    """Build the policy, the exam's environment, and the environment of its rough part, if there is one."""
    task, rough = graded.task, graded.crossing
    seed_everything(task.train.seed)
    env = task.env_class(task.cfg, device, eager=args.eager)
    ground = rough.env_class(rough.cfg, device, eager=args.eager) if rough else None
    return load_policy(graded.source.checkpoint, env, task.train, device), env, ground


def make_column(graded: Graded, policy: Policy, env: RobotTask, rough: RobotTask | None) -> Column:
    """Run the exam and, if there is one, its rough part. Print their tables and return the report's column."""
    source, exam = graded.source, graded.exam
    result, figures = exam.examine(env, policy)
    if rough and exam.rough:
        figures["crossing"] = exam.rough.run_crossing(rough, policy)
    name = "shipped" if source.shipped else f"{source.folder.name}, {source.checkpoint.stem.removeprefix('model_')}"
    print(f"\n{name}, {env.sim.engine} on {env.device}\n{exam.table(result)}\n")
    if rough and exam.rough:
        print(f"{exam.rough.table(figures['crossing'])}\n")
    overrides = {path: now for path, (_, now) in graded.task.changes_since(graded.trained).items()}
    about = {
        "policy": "/".join(source.checkpoint.parts[-3:]),
        "engine": env.sim.engine,
        "device": env.device,
        "overrides": overrides,
    }
    about |= (
        {"warning": note}
        if (note := " ".join(overflow_note(each.sim, "this exam") for each in (env, rough) if each).strip())
        else {}
    )
    return Column(name, about, result, figures)
