"""Values that no learner may see: NaN, infinite, or absurdly large. The step puts 0 in their place and counts whose they were.

Recorded in the step: fixed buffers and masks. What is as it should be keeps its bits.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

# [ours: rewards are about 1 and rows, in their units, below 1e5; a mean or variance over 1e5 samples survives it]
BOUND = 1e6


class Suspects:
    """Looks at K values of N worlds, each of something that has a name."""

    written = ("counts",)

    def __init__(self, names: Sequence[str], device: str) -> None:
        """``names`` of the K columns, in words that a user knows."""
        self.names = list(names)
        self.counts = torch.zeros(len(self.names), device=device)  # (K,) worlds and steps, since they were taken

    def clear(self, values: Tensor) -> None:
        """Put 0 in place of each of ``values`` (N, K) that is not finite or beyond BOUND, and count it."""
        wrong = ~(values.abs() <= BOUND)  # NaN too
        self.counts.add_(wrong.sum(dim=0))
        values.masked_fill_(wrong, 0.0)

    def take(self) -> Tensor:
        """The counts (K,), which begin from zero again."""
        counts = self.counts.clone()
        self.counts.zero_()
        return counts
