"""Sums by name over worlds and steps: added up on the device, read once an iteration."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

# name -> () a sum, or (2,) a sum and what to divide it by, as they stand when they are taken
Live = Mapping[str, Tensor]


class Statistics:
    """Means over ended episodes, counts of episodes, and values as they stand. All travel as one vector, so that ranks can add theirs."""

    written = ("_sums",)

    def __init__(self, means: Sequence[str], counts: Sequence[str], device: str) -> None:
        """``means`` are divided by the first of ``counts``, the number of episodes that ended."""
        self.means, self.counts, self.live = list(means), list(counts), dict[str, int]()
        self._sums = torch.zeros(len(self.means) + len(self.counts), device=device)

    def add(self, ended: Tensor, means: Tensor, counts: Tensor) -> None:
        """Add the worlds where ``ended`` (N,) is true: their ``means`` (N, M); and all worlds' ``counts`` (N, C)."""
        self._sums.add_(torch.cat([torch.where(ended[:, None], means, 0.0), counts], dim=1).sum(dim=0))

    def take(self, live: Live) -> Tensor:
        """All sums as one vector (S,) on the device; the sums of episodes start from zero again."""
        self.live = {name: value.numel() for name, value in live.items()}
        taken = torch.cat([self._sums, *(value.reshape(-1) for value in live.values())])
        self._sums.zero_()
        return taken

    def name(self, taken: Sequence[float]) -> dict[str, float]:
        """Means, counts and live values by name, from what ``take`` returned. Means are NaN where no episode ended."""
        values = iter(taken)
        sums = {name: next(values) for name in [*self.means, *self.counts]}
        episodes = sums[self.counts[0]]
        named = {name: sums[name] / episodes if episodes else math.nan for name in self.means}
        named |= {name: sums[name] for name in self.counts}
        for name, size in self.live.items():
            total = next(values)
            if size == 1:
                named[name] = total
            elif count := next(values):  # a kind of ground that no world is on has no mean level
                named[name] = total / count
        return named
