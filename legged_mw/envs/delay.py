"""A value of some steps ago."""

from __future__ import annotations

import torch
from torch import Tensor

from legged_mw.utils.math import assign


class Delay:
    """``delay(now)``, called once a step with a value (N, width), returns the value of d steps ago; each world has its own d."""

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
