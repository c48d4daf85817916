"""Adam as a CUDA graph can record it, and its state as rsl-rl's own learners write it to a checkpoint."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def make_recordable(optimizer: torch.optim.Optimizer, rates: Sequence[Tensor | float], device: str) -> None:
    """Make Adam, new or as a file had it, one that can be recorded, with a learning rate for each of its groups."""
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        group.update(lr=rate, fused=True, capturable=device.startswith("cuda"))
    for memory in optimizer.state.values():
        memory["step"] = memory["step"].to(device, torch.float32)


def plain_state(state: dict[str, Any], rates: Sequence[float]) -> dict[str, Any]:
    """The state of such an Adam in the form that rsl-rl's own learners write."""
    plain = {"fused": None, "capturable": False}
    return {
        "state": {i: {**memory, "step": memory["step"].cpu()} for i, memory in state["state"].items()},
        "param_groups": [{**group, "lr": rate, **plain} for group, rate in zip(state["param_groups"], rates, strict=True)],
    }
