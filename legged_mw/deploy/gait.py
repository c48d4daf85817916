"""The gait clock of an exported policy, as ``legged_mw.envs.gait`` keeps it in training: still while told to stand, else running."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.contract import Contract
from legged_mw.utils.commands import VELOCITY

Floats = NDArray[np.floating[Any]]


class GaitPhase:
    """Clocks of ``count`` robots with F feet; it moves on by the contract's period with each ``keep``."""

    def __init__(self, contract: Contract, count: int) -> None:
        """``contract`` has a section ``gait``."""
        assert contract.gait
        self._gait, self._share = contract.gait, contract.period / contract.gait.period
        names = [command.name for command in contract.commands]
        self._velocity = [names.index(name) for name in VELOCITY]
        self.phase: Floats = np.zeros(count)  # share of the period, of the last step
        self.running: NDArray[np.bool_] = np.zeros(count, dtype=bool)  # likewise: told to move
        self.start: Floats = np.zeros(count)  # where a robot's clock is at its first step, if that is told to move

    def row(self, commands: Floats, fresh: NDArray[np.bool_]) -> Floats:
        """Sine of each foot's phase, then cosine (N, 2F); zeros at rest. ``fresh`` (N,) are robots at their first step."""
        phase, running = self._next(commands, fresh)
        angle = 2.0 * math.pi * (phase[:, None] + np.array(self._gait.offsets))
        return np.concatenate([np.sin(angle), np.cos(angle)], axis=1) * running[:, None]

    def keep(self, commands: Floats, fresh: NDArray[np.bool_]) -> None:
        """A step with these ``commands`` (N, C) was made."""
        self.phase, self.running = self._next(commands, fresh)

    def _next(self, commands: Floats, fresh: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
        """Phase and whether it runs (N,), in the step to come."""
        velocity = np.atleast_2d(commands)[:, self._velocity]
        running = np.broadcast_to((velocity**2).sum(axis=1) > self._gait.min_command**2, self.running.shape)
        phase = np.where(fresh, self.start, np.where(self.running, (self.phase + self._share) % 1.0, 0.0))
        return np.where(running, phase, 0.0), running.copy()
