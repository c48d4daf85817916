"""A report on one policy or two: rolls out, gathers the figures, writes ``report.json``, ``report.html`` and a PNG a section."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import crossing, exam, figures, motors, page, rules
from legged_mw.eval.page import Column
from legged_mw.eval.peers import best_of
from legged_mw.eval.rollout import Policy, Record, Signal, roll_out
from legged_mw.eval.trials import NAMES, STEPS_AT, Plan, make_plan
from legged_mw.sim.joints import family
from legged_mw.sim.servos import CURVE
from legged_mw.utils.task import LoadedTask

GAIT_SECONDS = ESTIMATE_SECONDS = 2.0  # of each command, that the gait diagram and the estimate's picture show
BEFORE_STEP = 0.5  # [s] that a step response shows before the step

SIGNALS: dict[str, Signal] = {
    **exam.SIGNALS,
    "contact": lambda env: env.foot_contact,  # (N, F)
    "dof_pos": lambda env: env.dof_pos,  # (N, D) [rad]
    "dof_vel": lambda env: env.dof_vel,  # [rad/s]
    "torque": lambda env: env.torques,  # [N m], one simulation step old
    "motor_speed": lambda env: env.sim.actuator_velocity(),  # (N, D) [rad/s], of the same moment
    "reward": lambda env: env.episode_sums,  # (N, K), scale * term * dt since the start
}


def prepare(task: LoadedTask) -> None:
    """Turn ``task`` into the exam, with a world for all else that a report looks at."""
    exam.prepare(task)
    make_room(task)


def make_room(task: LoadedTask) -> None:
    """As many worlds as the report needs; their number depends on the ranges of commands."""
    task.cfg.env.num_envs = len(make_plan(task.cfg, task.cfg.sim.dt * task.cfg.control.decimation).cases)


def ask_alike(tasks: Sequence[LoadedTask]) -> None:
    """Grade prepared tasks by the rules of the first, whatever ranges the others were trained with."""
    first, *others = (rules.ExamRules.from_config(task.cfg) for task in tasks)
    for task, own in zip(tasks[1:], others, strict=True):
        if own != first:
            task.update({"exam": first.to_mapping()}, where="--compare")
            make_room(task)


def examine(
    env: LeggedRobot, policy: Policy, rough: LeggedRobot | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The exam's result and the report's figures, from one roll-out of an environment made from a prepared task.

    With ``rough``, made from a task that ``crossing`` prepared, its result is among the figures.
    """
    plan, asked = make_plan(env.cfg, env.dt), rules.ExamRules.from_config(env.cfg)
    record = roll_out(env, policy, plan.cases, round(exam.SECONDS / env.dt), SIGNALS, alone=asked.worlds())
    gathered = gather(env, asked, plan, record)
    if rough:
        gathered["crossing"] = crossing.run_crossing(rough, policy)
    return exam.grade(asked, record.part(slice(asked.worlds()))), gathered


def gather(env: LeggedRobot, asked: rules.ExamRules, plan: Plan, record: Record) -> dict[str, Any]:
    """Everything that the report shows besides the exam, as plain numbers."""
    parts = {name: record.part(worlds) for name, worlds in plan.parts.items()}
    settled, until = round(rules.SETTLING / env.dt), round(rules.PUSH_UNTIL / env.dt)
    held, axes, first = parts["commands"], plan.axes, round((STEPS_AT[0] - BEFORE_STEP) / env.dt)
    straight = int(np.argmin(np.abs(axes["vy"]))) * len(axes["vx"])  # the row of the grid that goes straight ahead
    ahead = parts["vx_vy"].part(slice(straight, straight + len(axes["vx"])))
    return {
        "joint_names": list(env.robot.joint_names),
        "foot_names": list(env.foot_names),
        "dt": env.dt,
        "tracking": {
            "axes": axes,
            "vx_yaw": figures.tracking_errors(parts["vx_yaw"], settled, len(axes["yaw"])),
            "vx_vy": figures.tracking_errors(parts["vx_vy"], settled, len(axes["vy"])),
        },
        "steps": {name: figures.responses(parts[f"step_{name}"], i, first) for i, name in enumerate(NAMES)},
        "gait": figures.gaits(held, settled, asked.commands(), GAIT_SECONDS),
        **(
            {"estimate": figures.estimates(held, asked.commands(), ESTIMATE_SECONDS)}
            if "estimate" in held.signals
            else {}
        ),
        "joints": figures.joints(held, settled, joint_limits(env)),
        "motors": motors.envelopes(held, settled, [family(name) for name in env.robot.joint_names], motor_limits(env)),
        "pushes": {
            "speeds": list(asked.push_speeds),
            "walking": figures.survival(parts["pushes"].fell_at, until),
            "standing": figures.survival(parts["standing_pushes"].fell_at, until),
        },
        "transport": {"vx": axes["vx"], **figures.transport(ahead, settled)},
        "reward": figures.reward_shares(held, settled, env.reward_names),
    }


def joint_limits(env: LeggedRobot) -> dict[str, tuple[NDArray[Any], NDArray[Any]]]:
    """Signal -> lowest and highest (D,): soft position limits, the motors' speed (infinite where not known) and torque."""
    speeds = np.array(env.robot.speed_limits)
    position = torch.stack([env.soft_lower, env.soft_upper]).cpu().numpy().astype(float)
    effort = env.robot.effort_range.T
    return {"dof_pos": (position[0], position[1]), "dof_vel": (-speeds, speeds), "torque": (effort[0], effort[1])}


def motor_limits(env: LeggedRobot) -> motors.MotorLimits:
    """Force limits and torque-speed curves; what is not known is infinite."""
    curve = (np.array(env.robot.tables.get(name, [np.inf] * env.num_actions)) for name in CURVE)
    return motors.MotorLimits(*env.robot.effort_range.T, *curve)


def write(
    folder: Path, task: str, columns: Sequence[Column], extras: Sequence[tuple[str, dict[str, Any]]] = ()
) -> None:
    """Write ``report.json``, a PNG a section and the self-contained ``report.html``.

    The other columns are compared with the first, by its rules; at most two have figures. ``extras`` are further results of
    the exam by name, such as the first policy's in another physics: the exam's table shows their gap to the first.
    """
    from legged_mw.eval import plots  # matplotlib takes a second to import

    columns = [columns[0], *(Column(name, {}, result) for name, result in extras), *columns[1:]]
    folder.mkdir(parents=True, exist_ok=True)
    asked = rules.ExamRules.from_mapping(columns[0].exam["rules"])
    content = {"task": task, "columns": [column._asdict() for column in columns]}
    if asked.peers:
        content |= {"peer": best_of(asked.peers), "peers": [peer._asdict() for peer in asked.peers]}
    _write_text(folder / "report.json", json.dumps(content, indent=1) + "\n")
    sections = plots.sections([(column.name, column.figures) for column in columns if column.figures], asked)
    for section in sections:
        plots.write_png(section, folder / f"{section.name}.png")
    _write_text(
        folder / "report.html",
        page.html(task, asked, columns, [(section, plots.svgs(section)) for section in sections]),
    )


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")
