"""A value of some steps ago."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from legged_mw.utils.math import assign


class Delay:
    """``delay(now)``, called once a step with a value (N, width), returns the value of d steps ago; each world has its own d."""

    written = ("past", "_new")

    def __init__(self, steps: Tensor, longest: int, width: int, start: float | None = None) -> None:
        """``steps`` (N, 1) is read at each call. Before an episode the value was ``start``; None: the episode's first value."""
        self.steps, self.start = steps, start
        self.past = torch.zeros(len(steps), longest + 1, width, device=steps.device)  # newest first
        self._new = torch.ones(len(steps), dtype=torch.bool, device=steps.device)

    def restart(self, mask: Tensor) -> None:
        """An episode begins where ``mask`` (N,) is true."""
        if self.start is None:
            self._new.logical_or_(mask)
        else:
            assign(self.past, mask, self.start)

    def __call__(self, now: Tensor) -> Tensor:
        self.past[:, 1:] = self.past[:, :-1].clone()
        self.past[:, 0] = now
        if self.start is None:
            self.past.copy_(torch.where(self._new[:, None, None], now[:, None], self.past))
            self._new.fill_(False)
        index = self.steps.long()[:, :, None].expand(-1, 1, now.shape[1])
        return self.past.gather(1, index)[:, 0]


class SubstepDelay:
    """Motor commands, sent once a control step, arrive late by whole simulation steps; each world has its own delay.

    A command with a delay of d steps arrives before substep d of those that follow. 7 ms in steps of 4 ms, the nearest being
    d = 2: physics from t + 8 ms on uses what is sent at t.
    """

    written = ("_past", "arriving")

    def __init__(self, delay: Tensor, step_ms: float, longest: float, substeps: int, width: int) -> None:
        """``delay`` (N, 1) [ms], whole steps of ``step_ms`` and at most ``longest``, is read at each call."""
        self._delay, self._step_ms = delay, step_ms
        # newest first
        self._past = torch.zeros(
            math.ceil(round(longest / step_ms) / substeps) + 1, len(delay), width, device=delay.device
        )
        self._substep = torch.arange(substeps, device=delay.device)[:, None, None]
        self.arriving = torch.zeros(substeps, len(delay), width, device=delay.device)  # in each substep

    def restart(self, mask: Tensor, sent: Tensor) -> None:
        """Where ``mask`` (N,) is true ``sent`` (N, width) is all that was ever sent."""
        self._past.copy_(torch.where(mask[:, None], sent, self._past))

    def __call__(self, sent: Tensor) -> None:
        """Fill ``arriving`` for the control step that begins with ``sent`` (N, width)."""
        self._past[1:] = self._past[:-1].clone()
        self._past[0] = sent
        steps, count = torch.round(self._delay / self._step_ms).long(), len(self._substep)
        # control steps since it was sent, (substeps, N, 1)
        age = (steps - self._substep + count - 1).clamp_(min=0) // count
        torch.gather(self._past, 0, age.expand_as(self.arriving), out=self.arriving)
