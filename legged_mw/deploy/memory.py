"""What a recurrent network remembers of each robot from one step to the next, as an export states it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legged_mw.deploy.reader import MOST_VALUES, Reader

MEMORY = "memory"  # the contract's section, inside of `network`


class NetworkMemory(NamedTuple):
    """An input and an output of the network, (batch, *shape) each: what goes out goes in at the next step, at first zeros."""

    input: str
    output: str
    shape: tuple[int, ...]  # layers, values each; of an LSTM the layers' h, then their c

    def start(self, count: int) -> NDArray[np.float32]:
        """Of ``count`` robots that remember nothing."""
        return np.zeros((count, *self.shape), dtype=np.float32)

    def to_dict(self) -> dict[str, Any]:
        return {**self._asdict(), "shape": list(self.shape)}


def read_memory(section: Reader) -> NetworkMemory:
    """From the contract's reader of the section."""
    wanted = "two whole numbers from 1: states and the size of each"
    shape = section.take(
        "shape", wanted, lambda v: isinstance(v, list) and len(v) == 2 and all(type(n) is int and n >= 1 for n in v)
    )
    section.take("shape", f"{MOST_VALUES} values at most", lambda v: v[0] * v[1] <= MOST_VALUES)
    return NetworkMemory(section.text("input"), section.text("output"), tuple(shape))
