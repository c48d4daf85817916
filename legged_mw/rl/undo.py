"""Undoes an update after which something learned is not finite, or that learned from what no learner may see.

Recorded with the update: masks, and no question to the host. After an update that is as it should be no bit is another.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from legged_mw.envs.statistics import BOUND


class Undo:
    """What a learner has learned, as it was before an update and after it: call ``remember``, update, ``settle``."""

    def __init__(self, learner: Any, networks: Iterable[nn.Module]) -> None:
        """``learner`` has rsl-rl's ``storage`` and ``optimizer``; ``networks`` are those that learn."""
        self._learner, self._networks, stored = learner, list(networks), learner.storage.observations
        self.columns = [(group, i) for group in stored.keys() for i in range(stored[group][0, 0].numel())]  # noqa: SIM118 (a TensorDict)
        device = learner.storage.rewards.device
        self.undone = torch.zeros((), device=device)  # 1: the last update was
        # 1 where it had such a value: by columns, and last rewards
        self.wrong = torch.zeros(len(self.columns) + 1, device=device)

    def _learned(self) -> dict[str, Tensor]:
        """Parameters, normalisers, the optimizer's memory and the learning rates, by name: rsl-rl's own normaliser rebinds its std."""
        optimizer, values = self._learner.optimizer, dict[str, Any]()
        for i, network in enumerate(self._networks):
            values |= {f"{i}.{name}": value for name, value in (*network.named_parameters(), *network.named_buffers())}
        for i, memory in enumerate(optimizer.state.values()):
            values |= {f"memory {i}.{name}": value for name, value in memory.items()}
        values |= {f"rate {i}": group["lr"] for i, group in enumerate(optimizer.param_groups)}
        values["rate"] = getattr(self._learner, "_rate", None)
        return {name: value for name, value in values.items() if isinstance(value, Tensor) and value.numel()}

    @torch.no_grad()
    def remember(self) -> None:
        """What is learned now is good."""
        self._before = [(list(kind), _join(kind.values())) for kind in _kinds(self._learned())]

    @torch.no_grad()
    def settle(self, losses: Tensor | None = None) -> None:
        """After the update, whose ``losses`` are known: put everything back if it is not sound, and note that."""
        stored = self._learner.storage
        wrong = [_beyond(value.flatten(0, 1).flatten(1)) for value in (*stored.observations.values(), stored.rewards)]
        self.wrong.copy_(torch.cat([*wrong[:-1], wrong[-1].any()[None]]))
        sound = ~self.wrong.any() if losses is None else losses.isfinite().all() & ~self.wrong.any()
        new, states = self._learned(), list[tuple[list[Tensor], Tensor, Tensor]]()
        for names, before in self._before:
            kind = [new.pop(name) for name in names]
            states.append((kind, before, _join(kind)))
        # Adam's memory, of its first step: it begins with zeros
        for kind in [list(kind.values()) for kind in _kinds(new)]:
            states.append((kind, torch.zeros_like(after := _join(kind)), after))
        for _, _, after in states:
            sound = sound & _on(after.isfinite().all(), sound.device)
        if getattr(self._learner, "is_multi_gpu", False):
            shared = sound.float()
            torch.distributed.all_reduce(shared, op=torch.distributed.ReduceOp.MIN)
            sound = shared > 0.5
        self.undone.copy_(~sound)
        for kind, before, after in states:
            parts = torch.where(_on(sound, after.device), after, before).split([value.numel() for value in kind])
            shaped = [part.view_as(value) for part, value in zip(parts, kind, strict=True)]
            torch._foreach_copy_(kind, shaped)  # pyright: ignore[reportPrivateImportUsage]
        del self._before


def _kinds(tensors: Mapping[str, Tensor]) -> list[dict[str, Tensor]]:
    """The tensors by type and device: what can be joined."""
    kinds: dict[Any, dict[str, Tensor]] = {}
    for name, tensor in tensors.items():
        kinds.setdefault((tensor.dtype, tensor.device), {})[name] = tensor
    return list(kinds.values())


def _on(value: Tensor, device: torch.device) -> Tensor:
    """``value`` on ``device``: rsl-rl's own Adam counts its steps on the host."""
    return value if value.device == device else value.to(device)


def _join(tensors: Iterable[Tensor]) -> Tensor:
    return torch.cat([tensor.reshape(-1) for tensor in tensors])


def _beyond(values: Tensor) -> Tensor:
    """(C,) Columns of ``values`` (B, C) that hold what is not finite or beyond BOUND."""
    low, high = torch.aminmax(values, dim=0)
    return ~((low >= -BOUND) & (high <= BOUND))
