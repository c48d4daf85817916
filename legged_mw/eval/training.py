"""The exam during training: few worlds, few seconds, in an environment of its own; training does not notice it."""

from __future__ import annotations

import math

import numpy as np
import torch

from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.eval import exam, rules
from legged_mw.eval.rollout import Policy, Record, holding, roll_out
from legged_mw.utils.task import LoadedTask, load_task

SECONDS, SETTLING = 4.0, 2.0  # [s] of a roll-out, and of its start in which no error is counted
KICK_SPEED, KICK_AT = 2.0, 1.0  # [m/s], [s] of the first of 16 directions; survived if it still stands at the end


class TrainingExam:
    """The 22 commands and the 16 kicks of 2 m/s, 4 s each; called with a policy it gives figures by name.

    The environment is made from a copy of the task, so what was overridden for training counts here too. Random numbers
    are drawn in it, and the generators are put back afterwards: training goes on as if nothing had been.
    """

    def __init__(self, task: LoadedTask, device: str, eager: bool = False) -> None:
        copy = load_task(str(task.path))
        copy.update(task.to_dict(), where="training")
        exam.prepare(copy, len(rules.commands()) + rules.KICK_DIRECTIONS)
        self._generators = [device] if device.startswith("cuda") else []
        with torch.random.fork_rng(self._generators):
            self.env = copy.env_class(copy.cfg, device, eager=eager)

    def __call__(self, policy: Policy) -> dict[str, float]:
        """``error_vx``, ``error_vy`` [m/s], ``error_yaw`` [rad/s]: NaN if all fell; ``falls`` of 22; ``kicks_survived``, a share."""
        dt = self.env.dt
        kicked = exam.kicks((rules.KICK_COMMAND, 0.0, 0.0), [KICK_SPEED], round(KICK_AT / dt))
        cases = [*map(holding, rules.commands()), *kicked]
        with torch.random.fork_rng(self._generators):
            record = roll_out(self.env, policy, cases, round(SECONDS / dt), {"velocity": exam.SIGNALS["velocity"]})
        return summary(record)


def make_exam(task: LoadedTask, env: LeggedRobot, eager: bool = False) -> TrainingExam | None:
    """The exam for a policy that trains in ``env``, or None, and a line that says why, where it could not read the nominal world."""
    examine = TrainingExam(task, env.device, eager)
    here, there = env.get_observations(), examine.env.get_observations()
    for group in task.train.obs_groups.actor:
        if group in here and here[group].shape[1] != there[group].shape[1]:  # a group that does not exist is the learner's to refuse
            sizes = f"{there[group].shape[1]} values in the exam's nominal world and {here[group].shape[1]} in training"
            print(f"no exam during training: the actor's observation group '{group}' has {sizes}")
            return None
    return examine


def summary(record: Record) -> dict[str, float]:
    """The figures of a record whose first worlds are the 22 commands and whose others were kicked."""
    count, settled = len(rules.commands()), round(SETTLING / record.dt)
    stood = np.isinf(record.fell_at)
    error = np.abs(record.signals["velocity"][settled:] - record.commands[settled:]).mean(axis=0)[:count][stood[:count]]
    means = error.mean(axis=0).tolist() if len(error) else [math.nan] * 3
    return {
        **dict(zip(("error_vx", "error_vy", "error_yaw"), means, strict=True)),
        "falls": float((~stood[:count]).sum()),
        "kicks_survived": float(stood[count:].mean()),
    }
