"""The report on one or two policies: run the exam, gather the figures, write ``report.json``, ``report.html``, PNGs."""

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

GAIT_SECONDS = ESTIMATE_SECONDS = 2.0  # [s] of each command in the gait diagram and in the estimator's plot
BEFORE_STEP = 0.5  # [s] before the step in the plot of a step response

SIGNALS: dict[str, Signal] = {
    **exam.SIGNALS,
    "contact": lambda env: env.foot_contact,  # (N, F)
    "dof_pos": lambda env: env.dof_pos,  # (N, D) [rad]
    "dof_vel": lambda env: env.dof_vel,  # (N, D) [rad/s]
    "torque": lambda env: env.torques,  # (N, D) [N m], one simulation step old
    "motor_speed": lambda env: env.sim.actuator_velocity(),  # (N, D) [rad/s], of the same moment as the torque
    "reward": lambda env: env.episode_sums,  # (N, K), sum of scale * term * dt since the start
}


def prepare(task: LoadedTask) -> None:
    """Turn ``task`` into the exam with the extra worlds of the report."""
    exam.prepare(task)
    make_room(task)


def make_room(task: LoadedTask) -> None:
    """Set the number of worlds of the report. It depends on the command ranges."""
    task.cfg.env.num_envs = len(make_plan(task.cfg, task.cfg.sim.dt * task.cfg.control.decimation).cases)


def ask_alike(tasks: Sequence[LoadedTask]) -> None:
    """Grade all prepared tasks by the rules of the first, also those with other trained ranges."""
    first, *others = (rules.ExamRules.from_config(task.cfg) for task in tasks)
    for task, own in zip(tasks[1:], others, strict=True):
        if own != first:
            task.update({"exam": first.to_mapping()}, where="--compare")
            make_room(task)


def examine(
    env: LeggedRobot, policy: Policy, rough: LeggedRobot | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """The exam's result and the report's figures, from one roll-out in the environment of a prepared task.

    ``rough``: the environment of the rough part, prepared by ``crossing``; its result joins the figures.
    """
    plan, asked = make_plan(env.cfg, env.dt), rules.ExamRules.from_config(env.cfg)
    record = roll_out(env, policy, plan.cases, round(exam.SECONDS / env.dt), SIGNALS, alone=asked.worlds())
    gathered = gather(env, asked, plan, record)
    if rough:
        gathered["crossing"] = crossing.run_crossing(rough, policy)
    return exam.grade(asked, record.part(slice(asked.worlds()))), gathered


def gather(env: LeggedRobot, asked: rules.ExamRules, plan: Plan, record: Record) -> dict[str, Any]:
    """All figures of the report beside the exam's result, as plain numbers."""
    parts = {name: record.part(worlds) for name, worlds in plan.parts.items()}
    settled, until = round(rules.SETTLING / env.dt), round(rules.PUSH_UNTIL / env.dt)
    held, axes, first = parts["commands"], plan.axes, round((STEPS_AT[0] - BEFORE_STEP) / env.dt)
    # first index of the grid's row with vy nearest to 0
    straight = int(np.argmin(np.abs(axes["vy"]))) * len(axes["vx"])
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
    """Signal -> (low, high), each (D,): soft position limits, speed limits (infinite if unknown), torque limits."""
    speeds = np.array(env.robot.speed_limits)
    position = torch.stack([env.soft_lower, env.soft_upper]).cpu().numpy().astype(float)
    effort = env.robot.effort_range.T
    return {"dof_pos": (position[0], position[1]), "dof_vel": (-speeds, speeds), "torque": (effort[0], effort[1])}


def motor_limits(env: LeggedRobot) -> motors.MotorLimits:
    """Force limits and torque-speed curves; infinite if unknown."""
    curve = (np.array(env.robot.tables.get(name, [np.inf] * env.num_actions)) for name in CURVE)
    return motors.MotorLimits(*env.robot.effort_range.T, *curve)


def write(
    folder: Path, task: str, columns: Sequence[Column], extras: Sequence[tuple[str, dict[str, Any]]] = ()
) -> None:
    """Write ``report.json``, one PNG per section and the self-contained ``report.html``.

    Every column is compared with the first, by the rules of the first. At most two columns have figures.
    ``extras``: further exam results by name, such as the first policy's on another physics engine. The exam's table
    shows their gap to the first column.
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
