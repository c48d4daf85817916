"""The walking exam on an export, in MuJoCo's C engine. Commands, pushes and marks are in ``legged_mw.eval.rules``.

The order of a step is that of ``legged_mw.eval.exam``, so that both give one result: sample, decide, push, move, look for falls.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import CONTRACT_FILE, Contract, ContractError, Ends, read_contract
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import rules
from legged_mw.eval.rules import ExamRules, in_common
from legged_mw.utils.commands import VELOCITY


def run_exam(
    folder: Path, exam: ExamRules | None = None, threads: int = 0, common: bool = False, contact: str | None = None
) -> dict[str, Any]:
    """Grade the export in ``folder`` by the rules ``exam``, else by those of its contract. Raises ContractError, ConfigError.

    ``common``: the contract's, but in the one range that all published policies of the robot were asked. ``contact``: see DeployStage.
    """
    contract = read_contract(folder)
    exam, names = exam or contract_rules(contract, common), [command.name for command in contract.commands]
    wanted = np.tile([command.default for command in contract.commands], (exam.worlds(), 1))
    pushed = [(exam.push_vx, 0.0, 0.0)] * (exam.worlds() - len(exam.held()))
    wanted[:, [names.index(name) for name in VELOCITY]] = [*exam.held(), *pushed]
    ends = Ends(max_tilt=90.0, falls_on=contract.ends.falls_on)  # what counts as a fall in legged_mw.eval.exam
    stage = DeployStage(folder, len(wanted), threads=threads, ends=ends, contact=contact)
    fell_at = np.full(len(wanted), math.inf)
    sampled: dict[str, list[Any]] = {"velocity": [], "position": [], "power": [], "joint_speed": [], "estimate": []}
    for step in range(round(rules.SECONDS / stage.dt)):
        sampled["velocity"].append(stage.velocity())
        sampled["position"].append(stage.qpos()[:, :2])
        sampled["power"].append(np.abs(stage.measured.joint_torque * stage.measured.joint_vel).sum(axis=1))
        sampled["joint_speed"].append(np.abs(stage.measured.joint_vel).mean(axis=1))
        _push(stage, exam, step)  # the policy decides on what was measured before
        stage.step(wanted)
        estimate = stage.believed_velocity()  # from that measurement
        sampled["estimate"] += [] if estimate is None else [estimate]
        fell_at[stage.fell() & np.isinf(fell_at)] = step
    signals = {name: np.stack(values) for name, values in sampled.items() if values}
    return exam.grade(signals, last_position=stage.qpos()[:, :2], fell_at=fell_at, mass=stage.contract.mass, dt=stage.dt)


def contract_rules(contract: Contract, common: bool = False) -> ExamRules:
    """The rules for an export: the section ``exam`` of its contract, if it has one, the trained ranges, and how many feet it has."""
    trained = {command.name: (command.low, command.high) for command in contract.commands}
    if missing := [name for name in VELOCITY if name not in trained]:
        raise ContractError(f"{CONTRACT_FILE}: the walking exam needs the commands {', '.join(VELOCITY)}; missing: {', '.join(missing)}")
    try:
        section = dict(contract.exam or {})
        return ExamRules.from_mapping(section | (in_common(section.get("peer", "")) if common else {}), trained, len(contract.feet))
    except (AttributeError, TypeError, ValueError) as error:
        raise ContractError(f"{CONTRACT_FILE}: exam: {error}") from error


def _push(stage: DeployStage, exam: ExamRules, step: int) -> None:
    """At its step, direction k of every speed: the base's horizontal velocity jumps, world frame."""
    k = step - round(rules.PUSH_AT / stage.dt)
    if 0 <= k < rules.PUSH_DIRECTIONS:
        angle = 2 * math.pi * k / rules.PUSH_DIRECTIONS
        for i, speed in enumerate(exam.push_speeds):
            world = len(exam.held()) + i * rules.PUSH_DIRECTIONS + k
            stage.push(world, [speed * math.cos(angle), speed * math.sin(angle)])
