"""Adam that a CUDA graph can record, with all parameters in one tensor, and its state in rsl-rl's form.

A CPU runs its formulas as they stand here. On a GPU two kernels compute them (fast/kernels.py), and tests hold the
kernels to the formulas, and the formulas to torch's own Adam.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from legged_mw.rl.layers import kernels_for

_ALIGNED = 64  # values: fast matrix products want each parameter to begin at a multiple


def make_recordable(optimizer: torch.optim.Optimizer, rates: Sequence[Tensor | float], device: str) -> None:
    """Make an Adam, new or loaded, one that can be recorded, with a learning rate for each of its groups."""
    for group, rate in zip(optimizer.param_groups, rates, strict=True):
        group.update(lr=rate, fused=True, capturable=device.startswith("cuda"))
    for memory in optimizer.state.values():
        memory["step"] = memory["step"].to(device, torch.float32)


def plain_state(state: dict[str, Any], rates: Sequence[float]) -> dict[str, Any]:
    """The state of such an Adam in rsl-rl's form: a count of steps for each parameter."""
    plain = {"fused": None, "capturable": False}
    return {
        "state": {i: {**memory, "step": memory["step"].cpu().clone()} for i, memory in state["state"].items()},
        "param_groups": [
            {**group, "lr": rate, **plain} for group, rate in zip(state["param_groups"], rates, strict=True)
        ],
    }


class FlatAdam:
    """Clips and steps a ``part`` of the parameters of an Adam or AdamW, all of them in one tensor.

    Parameters and Adam's moments become views of flat tensors; the optimizer's state holds the views.
    """

    def __init__(
        self, optimizer: torch.optim.Optimizer, group: int, part: Sequence[nn.Parameter], limit: float
    ) -> None:
        """``group``: the part's group in the optimizer; ``limit`` on the norm of its gradient."""
        self._optimizer, self._group, self._limit = optimizer, optimizer.param_groups[group], limit
        self._part = [parameter for parameter in part if parameter.requires_grad]
        first = self._part[0].detach()
        self._gaps = [first.new_zeros(-parameter.numel() % _ALIGNED) for parameter in self._part]
        self._values = self._lay([parameter.detach() for parameter in self._part])
        self._memory = [torch.zeros_like(self._values) for _ in range(2)]
        self._step = torch.zeros((), dtype=torch.float32, device=first.device)
        self._factors = first.new_zeros(4)
        for parameter, value in zip(self._part, self._views(self._values), strict=True):
            parameter.data = value

    def _lay(self, tensors: Sequence[Tensor]) -> Tensor:
        return torch.cat(
            [piece for pair in zip(tensors, self._gaps, strict=True) for piece in (pair[0].flatten(), pair[1])]
        )

    def _views(self, flat: Tensor) -> list[Tensor]:
        sizes = [
            size for value, gap in zip(self._part, self._gaps, strict=True) for size in (value.numel(), gap.numel())
        ]
        return [piece.view_as(value) for piece, value in zip(flat.split(sizes)[::2], self._part, strict=True)]

    def gradient(self) -> Tensor | None:
        """The part's gradients in one tensor, or None."""
        if all(parameter.grad is None for parameter in self._part):
            return None
        return self._lay([torch.zeros_like(value) if value.grad is None else value.grad for value in self._part])

    def _take_over(self) -> None:
        """Copy the optimizer's state, new or loaded, into the flat tensors, and make it views of them."""
        states = [self._optimizer.state[parameter] for parameter in self._part]
        if states[0].get("step") is self._step:
            return
        for key, flat in zip(("exp_avg", "exp_avg_sq"), self._memory, strict=True):
            for state, view in zip(states, self._views(flat), strict=True):
                view.copy_(state[key]) if key in state else view.zero_()
                state[key] = view
        self._step.copy_(states[0]["step"]) if "step" in states[0] else self._step.zero_()
        for state in states:
            state["step"] = self._step

    @torch.no_grad()
    def step(self, gradient: Tensor) -> None:
        """One step along ``gradient``, at the group's rate."""
        self._take_over()
        group, (mean, square), norm = self._group, self._memory, torch.linalg.vector_norm(gradient)
        rate, (beta1, beta2), eps, decay = (group[name] for name in ("lr", "betas", "eps", "weight_decay"))
        if kernels := kernels_for(gradient):
            kernels.launch(
                kernels.begin_adam, 1, norm, self._limit, rate, beta1, beta2, decay, self._step, self._factors
            )
            kernels.launch(
                kernels.adam, len(gradient), gradient, self._factors, beta1, beta2, eps, self._values, mean, square
            )
            return
        self._step += 1
        count = self._step.double()
        gradient = gradient * (self._limit / (norm + 1e-6)).clamp(max=1.0)
        mean.lerp_(gradient, 1.0 - beta1)
        square.mul_(beta2).addcmul_(gradient, gradient, value=1.0 - beta2)
        divisor = (square / (1.0 - beta2**count)).sqrt_().add_(eps)
        self._values.mul_(1.0 - rate.double() * decay).sub_(mean / divisor * (rate / (1.0 - beta1**count)))
