"""``play.py --eval``: grade one policy, or two side by side, and write the report."""

from __future__ import annotations

import argparse
import copy
from collections.abc import Callable
from typing import Any, NamedTuple

from legged_mw.envs.robot_task import RobotTask
from legged_mw.eval.exams import Exam, require_exam
from legged_mw.eval.page import Column
from legged_mw.eval.rollout import Policy
from legged_mw.eval.rules import in_common
from legged_mw.rl.policies import PolicySource, introduce, load_policy
from legged_mw.rl.rsl_rl_settings import check_classes
from legged_mw.sim.simulation import overflow_note
from legged_mw.utils.cli import apply_overrides, pick_device, seed_everything
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import shown
from legged_mw.utils.files import writable
from legged_mw.utils.task import LoadedTask


class Graded(NamedTuple):
    """A policy and the tasks of its exam."""

    source: PolicySource
    trained: LoadedTask
    task: LoadedTask
    exam: Exam
    crossing: LoadedTask | None  # the rough part of the exam, if there is one


Elsewhere = Callable[[Graded], list[tuple[str, dict[str, Any]]]]  # results by name


def grade(policies: list[tuple[PolicySource, LoadedTask]], args: argparse.Namespace, elsewhere: Elsewhere) -> None:
    """Grade policies, each with its trained config. Print their tables and write a report next to the first.

    ``elsewhere`` grades the first policy again on another physics engine.
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
    graded[0].exam.write(folder, graded[0].task.name, columns, elsewhere(graded[0]))
    print(f"written to {shown(folder / 'report.html')}, with report.json and pictures beside it")


def prepare(source: PolicySource, trained: LoadedTask, args: argparse.Namespace, common: bool = False) -> Graded:
    """The trained task with the overrides of the exam, then those of the user.

    ``common``: use the one command range in which all published policies of the robot were measured.
    """
    task, exam = copy.deepcopy(trained), require_exam(trained)
    exam.prepare(task)
    override(task, args, exam.sets(task))
    if common:
        task.update({"exam": in_common(getattr(getattr(task.cfg, "exam", None), "peer", ""))}, where="--ranges common")
    exam.make_room(task)  # after the user's overrides: they may change the ranges
    return Graded(source, trained, task, exam, prepare_crossing(trained, args))


def prepare_crossing(trained: LoadedTask, args: argparse.Namespace) -> LoadedTask | None:
    """The rough part of the exam with the user's overrides; None if the policy trained on a plane."""
    crossing = require_exam(trained).rough
    if not crossing or trained.to_dict()["terrain"].get("mesh_type", "plane") == "plane":
        return None
    task = copy.deepcopy(trained)
    crossing.prepare(task)
    override(task, args, crossing.SETS)
    crossing.make_room(task)  # after the user's overrides: they may change the kinds of terrain
    return task


def override(task: LoadedTask, args: argparse.Namespace, sets: set[str]) -> None:
    """Apply the user's overrides. Refuse an override of a field that the exam ``sets``."""
    before = copy.deepcopy(task)
    apply_overrides(task, args)
    check_classes(task.train)
    if touched := sets & task.changes_since(before).keys():
        raise ConfigError(
            f"--eval sets {', '.join(sorted(touched))} itself; an exam with other values would be another exam"
        )


def build(graded: Graded, args: argparse.Namespace, device: str) -> tuple[Policy, RobotTask, RobotTask | None]:
    """Build the policy, the environment of the exam, and that of the rough part."""
    task, rough = graded.task, graded.crossing
    seed_everything(task.train.seed)
    env = task.env_class(task.cfg, device, eager=args.eager)
    ground = rough.env_class(rough.cfg, device, eager=args.eager) if rough else None
    return load_policy(graded.source.checkpoint, env, task.train, device), env, ground


def make_column(graded: Graded, policy: Policy, env: RobotTask, rough: RobotTask | None) -> Column:
    """Run the exam and, if there is one, its rough part. Print their tables and return the report's column."""
    source, exam = graded.source, graded.exam
    result, figures = exam.examine(env, policy, rough)
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
