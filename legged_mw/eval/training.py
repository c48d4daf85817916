"""A short walking exam during training, in a separate environment. It does not change the training run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from legged_mw.eval import exam
from legged_mw.eval.rollout import Policy, Record, roll_out
from legged_mw.eval.rules import ExamRules
from legged_mw.utils.task import LoadedTask, load_task

SECONDS, SETTLING = 4.0, 2.0  # [s] duration of the roll-out, and settling time at its start without error measurement
PUSH_AT = 1.0  # [s] time of the first of 16 pushes; a push is survived if the robot stands at the end


class TrainingExam:
    """The 22 commands and the 16 pushes at ``push_mark``, 4 s each. A call with a policy returns figures by name.

    The environment is made from a copy of the task, with the overrides of the training run. The random generators are
    restored after each exam, so training continues unchanged.
    """

    def __init__(self, task: LoadedTask, device: str, eager: bool = False) -> None:
        copy = load_task(str(task.path))
        copy.update(task.to_dict(), where="training")
        rules = ExamRules.from_config(copy.cfg)
        self.rules = replace(rules, push_speeds=(rules.push_mark,), transport_vx=rules.ranges[0][1])  # one of the 22
        exam.prepare(copy, self.rules.worlds())
        self._generators = [device] if device.startswith("cuda") else []
        with torch.random.fork_rng(self._generators):
            self.env = copy.env_class(copy.cfg, device, eager=eager)

    def __call__(self, policy: Policy) -> dict[str, float]:
        """``error_vx``, ``error_vy`` [m/s], ``error_yaw`` [rad/s]; ``falls`` of 22; ``pushes_survived``, a share.

        For a policy with a velocity estimator also its RMS errors ``estimate_vx``, ``estimate_vy`` [m/s].
        """
        dt = self.env.dt
        with torch.random.fork_rng(self._generators):
            cases = exam.cases(self.rules, dt, PUSH_AT)
            record = roll_out(self.env, policy, cases, round(SECONDS / dt), {"velocity": exam.SIGNALS["velocity"]})
        return training_figures(record, len(self.rules.commands()))


def training_figures(record: Record, count: int) -> dict[str, float]:
    """The figures of a record. Its first ``count`` worlds have constant commands, the others are pushed.

    A world that fell gets the error of standing still.
    """
    settled, stood = round(SETTLING / record.dt), np.isinf(record.fell_at)
    asked = record.commands[settled:, :count, :3]
    velocity = record.signals["velocity"][settled:, :count]
    missed = np.where(stood[:count, None], velocity - asked, asked)
    believed = record.signals["estimate"][settled:, :count] if "estimate" in record.signals else velocity[..., :0]
    rms = np.sqrt(((believed - velocity[..., : believed.shape[-1]]) ** 2).mean(axis=(0, 1)))
    return {
        **dict(zip(("error_vx", "error_vy", "error_yaw"), np.abs(missed).mean(axis=(0, 1)).tolist(), strict=True)),
        "falls": float((~stood[:count]).sum()),
        "pushes_survived": float(stood[count:].mean()),
        **dict(zip(("estimate_vx", "estimate_vy"), rms.tolist(), strict=False)),
    }
