"""The walking exam on an export, in MuJoCo's C engine. Commands, kicks and marks are in ``legged_mw.eval.rules``.

The order of a step is that of ``legged_mw.eval.exam``, so that both give one result: sample, decide, kick, move, look for falls.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from legged_mw.deploy.contract import Ends, read_contract
from legged_mw.deploy.stage import DeployStage
from legged_mw.eval import rules


def run_exam(folder: Path, threads: int = 0) -> dict[str, Any]:
    """Grade the export in ``folder``; all tests run side by side. Raises ContractError."""
    asked = np.array(rules.commands())
    kicks = len(rules.KICK_SPEEDS) * rules.KICK_DIRECTIONS
    wanted = np.concatenate([asked, np.tile([rules.KICK_COMMAND, 0.0, 0.0], (kicks, 1))])
    ends = Ends(max_tilt=90.0, falls_on=read_contract(folder).ends.falls_on)  # what counts as a fall in legged_mw.eval.exam
    stage = DeployStage(folder, len(wanted), threads=threads, ends=ends)
    fell_at = np.full(len(wanted), math.inf)
    velocity, position, power, joint_speed = [], [], [], []
    for step in range(round(rules.SECONDS / stage.dt)):
        velocity.append(stage.velocity())
        position.append(stage.qpos()[:, :2])
        power.append(np.abs(stage.measured.joint_torque * stage.measured.joint_vel).sum(axis=1))
        joint_speed.append(np.abs(stage.measured.joint_vel).mean(axis=1))
        _kick(stage, len(asked), step)  # the policy decides on what was measured before
        stage.step(wanted)
        fell_at[stage.fell() & np.isinf(fell_at)] = step
    counted = slice(round(rules.SETTLING / stage.dt), None)
    return rules.grade(
        error=np.abs(np.stack(velocity)[counted] - wanted).mean(axis=0)[: len(asked)],
        fell_at=fell_at,
        distance=np.linalg.norm(stage.qpos()[:, :2] - np.stack(position)[counted][0], axis=1)[: len(asked)],
        energy=np.stack(power)[counted].sum(axis=0)[: len(asked)] * stage.dt,
        standing_joint_speed=float(np.stack(joint_speed[-round(1.0 / stage.dt) :])[:, 0].mean()),
        seconds=(len(velocity) - counted.start) * stage.dt,
        mass=stage.contract.mass,
        dt=stage.dt,
    )


def _kick(stage: DeployStage, first: int, step: int) -> None:
    """At its step, direction k of every kick speed: the base's horizontal velocity jumps, world frame."""
    k = step - round(rules.KICK_AT / stage.dt)
    if 0 <= k < rules.KICK_DIRECTIONS:
        angle = 2 * math.pi * k / rules.KICK_DIRECTIONS
        for i, speed in enumerate(rules.KICK_SPEEDS):
            stage.push(first + i * rules.KICK_DIRECTIONS + k, [speed * math.cos(angle), speed * math.sin(angle)])
