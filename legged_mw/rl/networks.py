"""The networks of a recorded learner: its layers, and what stands beside an MLP, a regression or a memory.

Layers have the same values and gradients as torch's own, in fewer and larger kernels.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, Protocol

import torch
from rsl_rl.models import MLPModel, RNNModel
from rsl_rl.modules import EmpiricalNormalization
from tensordict import TensorDict
from torch import Tensor, nn

from legged_mw.envs.robot_task import RobotTask
from legged_mw.utils.opaque import fast

Layers = list[tuple[Tensor, Tensor]]  # weight and bias of each
FUSED_ON = ["cuda"]  # devices on which updates use fast/kernels.py
_SUM_ROWS = 128  # rows that one thread sums; threads run side by side


class Linear(torch.autograd.Function):
    """``x W^T + b`` for many rows, faster than torch's own in two ways.

    Torch sums the bias gradient in one pass that leaves most of a GPU idle, this in two. ``x`` may have more columns
    than the weight, of zeros: a multiple of four of them is what TF32 products want.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        if x.shape[1] > weight.shape[1]:
            ctx.columns = weight.shape[1]
            weight = nn.functional.pad(weight, (0, x.shape[1] - weight.shape[1]))
        ctx.save_for_backward(x, weight)
        return torch.addmm(bias, x, weight.t())

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, Tensor, Tensor]:
        (grad,), (x, weight) = grads, ctx.saved_tensors
        columns = getattr(ctx, "columns", None)
        return grad @ weight if ctx.needs_input_grad[0] else None, (grad.t() @ x)[:, :columns], sum_rows(grad)


def kernels_for(x: Tensor) -> Any:
    """The module fast/kernels.py if it is there and ``x`` is on a device that uses it, else None."""
    if x.device.type not in FUSED_ON:
        return None
    return fast("kernels")  # imports warp, which takes a second


def sum_rows(x: Tensor) -> Tensor:
    """Sum over the rows of ``x`` (B, size), in two passes."""
    return x.view(-1, math.gcd(len(x), _SUM_ROWS), x.shape[1]).sum(dim=1).sum(dim=0)


class EluLayers(torch.autograd.Function):
    """Linear layers with an ELU after each but the last, whose input and output are float32.

    ``read``: weight and bias of each as the products read them: their own, or rounded to bfloat16, in which all before
    the last is then computed; sums and the gradients of weights are float32 all the same. ``x`` and the first weight
    may have more columns, of zeros.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, read: Layers, *parameters: Tensor) -> Tensor:
        ctx.read, ctx.columns = read, parameters[0].shape[1]
        outs = [x]
        for weight, bias in read[:-1]:
            outs.append(nn.functional.elu_(torch.addmm(bias, outs[-1], weight.t())))
        weight, bias = read[-1]
        last = outs[-1].to(weight.dtype)
        ctx.save_for_backward(*outs, last)
        return torch.addmm(bias, last, weight.t())

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), (*outs, last), read = grads, ctx.saved_tensors, ctx.read
        elu = EluBackward(outs[1:])
        biases, weights = [sum_rows(grad)], [grad.t() @ last]
        for i in reversed(range(1, len(read))):
            grad = elu(grad @ read[i][0], i - 1)
            weights.append(_float_product(grad.t(), outs[i - 1]))
        weights[-1] = weights[-1][:, : ctx.columns]
        pairs = zip(weights[::-1], [*elu.sums(), *biases], strict=True)
        return (
            grad @ read[0][0] if ctx.needs_input_grad[0] else None,
            None,
            *(value for pair in pairs for value in pair),
        )


class EluBackward:
    """Gradients before the ELUs of a network from those after them, and their sums over rows; on a GPU one kernel."""

    def __init__(self, outs: list[Tensor]) -> None:
        """``outs``: (B, size) of each ELU."""
        self._outs, sizes = outs, [out.shape[1] for out in outs]
        self._sums: list[Tensor] = [outs[0]] * len(outs) if outs else []
        self._table: Tensor | None = None
        self._kernels: Any = kernels_for(outs[0]) if outs else None
        if self._kernels and self._kernels.fits(rows := len(outs[0]), sizes):
            self._table = outs[0].new_empty(-(-rows // self._kernels.ROWS), sum(sizes), dtype=torch.float32)

    def __call__(self, grad: Tensor, i: int) -> Tensor:
        """The gradient (B, size) before ELU ``i``, of the type of its output."""
        if self._table is not None:
            return self._kernels.elu_backward(
                grad, self._outs[i], self._table, sum(out.shape[1] for out in self._outs[:i])
            )
        out = self._outs[i]
        grad = torch.ops.aten.elu_backward(grad.to(out.dtype), 1.0, 1.0, 1.0, True, out)
        self._sums[i] = sum_rows(grad.float() if out.dtype == torch.bfloat16 else grad)
        return grad

    def sums(self) -> list[Tensor]:
        """The sums (size,) by layer, float32 at least. Call it after all layers."""
        if self._table is None:
            return self._sums
        return list(self._table.sum(dim=0).split([out.shape[1] for out in self._outs]))


def _float_product(a: Tensor, b: Tensor) -> Tensor:
    """``a @ b``; for bfloat16 the result is float32, in which the product sums anyway."""
    if a.dtype != torch.bfloat16:
        return a @ b
    if a.is_cuda:
        return torch.mm(a, b, out_dtype=torch.float32)  # type: ignore[call-overload]
    return a.float() @ b.float()


def elu_layers(layers: nn.Module) -> list[nn.Linear]:
    """The linear layers of an rsl-rl MLP if ``EluLayers`` can compute them, else none.

    Layers without parameters may follow the last one.
    """
    every: list[nn.Module] = [*layers]  # type: ignore[misc]
    linear = [layer for layer in every if isinstance(layer, nn.Linear)]
    between = [layer for layer in every if not isinstance(layer, nn.Linear)][: len(linear) - 1]
    order = [layer for pair in zip(linear, between, strict=False) for layer in pair] + linear[-1:]
    fits = all(type(layer) is nn.ELU and layer.alpha == 1.0 for layer in between) and every[: len(order)] == order
    return linear if fits else []


def run_mlp(layers: nn.Module, x: Tensor, read: Layers | None = None) -> Tensor:
    """The output of an rsl-rl MLP for inputs (B, size); ``read``: the weights for ``EluLayers``, if not its own."""
    rest = [*layers]  # type: ignore[misc]
    if linear := elu_layers(layers):
        with torch.no_grad():
            read = read or [
                (_padded(layer.weight, x.shape[1] if layer is linear[0] else 0), layer.bias) for layer in linear
            ]
        parameters = (value for layer in linear for value in (layer.weight, layer.bias))
        x = EluLayers.apply(x, read, *parameters)  # type: ignore[assignment]
        rest = rest[2 * len(linear) - 1 :]
    for layer in rest:
        x = Linear.apply(x, layer.weight, layer.bias) if type(layer) is nn.Linear else layer(x)  # type: ignore[misc]
    return x


def _padded(weight: Tensor, columns: int) -> Tensor:
    return nn.functional.pad(weight, (0, columns - weight.shape[1])) if columns > weight.shape[1] else weight


class HalfWeights:
    """A network's weights in bfloat16 for ``EluLayers``: copies of all but the last layer's."""

    ALIGNED = 8  # products of bfloat16 want a multiple of so many columns

    def __init__(self, linear: list[nn.Linear]) -> None:
        hidden = linear[:-1]
        self._own = [value for layer in hidden for value in (layer.weight, layer.bias)]
        first = self._own[0]
        wide = first.new_zeros(len(first), -(-first.shape[1] // self.ALIGNED) * self.ALIGNED, dtype=torch.bfloat16)
        self._copies = [
            wide[:, : first.shape[1]],
            *(torch.empty_like(value, dtype=torch.bfloat16) for value in self._own[1:]),
        ]
        weights = [wide, *self._copies[2::2]]
        self._layers = [*zip(weights, self._copies[1::2], strict=True), (linear[-1].weight, linear[-1].bias)]

    @torch.no_grad()
    def read(self) -> Layers:
        """The layers, rounded from their present weights."""
        self._copies[0].copy_(self._own[0])
        torch._foreach_copy_(self._copies[1:], self._own[1:])  # pyright: ignore[reportPrivateImportUsage]
        return self._layers

    @torch.no_grad()
    def prepare(self, latent: Tensor) -> Tensor:
        """The network's input (B, size), in bfloat16 and padded with columns of zeros."""
        return nn.functional.pad(latent.bfloat16(), (0, -latent.shape[1] % self.ALIGNED))


def sample(model: MLPModel, output: Tensor) -> Tensor:
    """Actions (N, A) drawn from a Gaussian policy. torch.normal would read the std on the host."""
    assert model.distribution is not None
    model.distribution.update(output)  # the forward pass without its own sample
    mean = model.output_mean
    return mean + model.output_std * torch.randn_like(mean)


def update_normalizer(normalizer: EmpiricalNormalization, x: Tensor, world_size: int) -> None:
    """Update rsl-rl's running mean and variance with ``x`` (B, size), in place, without its copy from the host."""
    if not normalizer.training:
        return
    count = x.shape[0] * world_size
    var, mean = torch.var_mean(x, dim=0, unbiased=False, keepdim=True)
    if world_size > 1:  # all ranks have the same number of samples
        own_mean = mean.clone()
        torch.distributed.all_reduce(mean)
        mean /= world_size
        var += (own_mean - mean).square()
        torch.distributed.all_reduce(var)
        var /= world_size
    normalizer.count += count
    rate = count / normalizer.count
    delta = mean - normalizer._mean
    normalizer._mean += rate * delta
    normalizer._var += rate * (var - normalizer._var + delta * (mean - normalizer._mean))
    normalizer._std.copy_(normalizer._var.sqrt())


# ---- networks that are more than an MLP -----------------------------------------------------------------------------


# Inputs of a recurrent network in an update; only its memory knows the parts.
Sequenced = tuple[Tensor, ...]


class RegressingModel(MLPModel):
    """rsl-rl's MLPModel whose input is, in part, the output of an ``estimator``, which learns by regression.

    rl/students/ holds such networks. A learner knows none of them by name.
    """

    field: str  # the config field that selects the model
    regression: str  # the name of the regression loss
    estimator: nn.Module
    learning_rate: float  # of the estimator

    @staticmethod
    def settings(sections: dict[str, Any], env: RobotTask, learns: bool) -> dict[str, Any]:
        """Constructor arguments beyond MLPModel's, see ``actor_settings``. Raises ConfigError."""
        raise NotImplementedError

    def rollout_latent(self, obs: TensorDict) -> Tensor:
        """The MLP's input (N, size) during the rollout, of all worlds in order."""
        return self.get_latent(obs)

    def regression_batch(self, obs: TensorDict, worlds: Tensor) -> tuple[Tensor, ...]:
        """Inputs and targets of the regression, the same in all epochs of an update.

        ``obs`` (S * B,) come from ``worlds`` (B,); S is 2 if mirror images follow them, else 1.
        """
        raise NotImplementedError

    def learn(self, latent: Tensor, regression_batch: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """The network's output for ``latent``, which may be padded with zeros, and the regression loss ().

        The loss has no gradient for the parameters that the output depends on.
        """
        raise NotImplementedError

    def update_regression_normalizer(self, obs: TensorDict, ranks: int) -> None:
        """Update the normaliser of the regression."""
        raise NotImplementedError


def trained_parts(actor: MLPModel, critic: MLPModel) -> tuple[list[list[nn.Parameter]], list[Tensor]]:
    """Parameters by part, of policy, critic and estimator if there is one, and the estimator's learning rate ().

    The gradients of a part are clipped together.
    """
    if not isinstance(actor, RegressingModel):
        return [[*actor.parameters()], [*critic.parameters()]], []
    policy = [parameter for name, parameter in actor.named_parameters() if not name.startswith("estimator.")]
    rate = torch.tensor(actor.learning_rate, dtype=torch.float32, device=policy[0].device)
    return [policy, [*critic.parameters()], [*actor.estimator.parameters()]], [rate]


class Memory(Protocol):
    """The hidden state of a recurrent network in each of N worlds, in tensors that stay."""

    now: Tensor  # (states, S, N, H): S is 2 if mirror images have a state of their own, else 1
    start: Tensor  # the same at the start of the rollout

    def advance(self, obs: Any) -> Tensor:
        """Take in observations (N,), or (2N,) with their mirror images; returns the MLP's input (N, H)."""
        ...

    def normalised(self, obs: Any) -> Tensor:
        """The recurrent layers' input (B, size) for observations (B,)."""
        ...

    def forget(self, ended: Tensor) -> None:
        """Set the state to 0 where ``ended`` (N,)."""

    def for_rsl_rl(self) -> Any:
        """A copy of the state in rsl-rl's form."""

    def sequence(self, inputs: Tensor, worlds: Tensor, dones: Tensor) -> Sequenced:
        """The rollout of ``worlds`` (B,), from ``inputs`` (S * T * B, size) and ``dones`` (T, N, 1) after each step."""
        ...

    def unroll(self, sequence: Sequenced) -> Tensor:
        """The MLP's inputs (S * T * B, H) over a sequence, with gradients."""
        ...


class RememberingModel(RNNModel):
    """rsl-rl's recurrent network; a recorded learner keeps its hidden state."""

    def memory(self, worlds: int, images: int, device: str) -> Memory:
        """An empty memory; with ``images`` 2 it has a second state, which has seen mirror images only."""
        raise NotImplementedError


class Memories(dict[nn.Module, Memory]):
    """Network -> memory, of the recurrent networks among ``models``."""

    def __init__(self, models: Iterable[nn.Module], worlds: int, images: int, device: str) -> None:
        remembering = [model for model in models if isinstance(model, RememberingModel)]
        super().__init__({model: model.memory(worlds, images, device) for model in remembering})

    def begin_rollout(self) -> None:
        """Keep the present states as the start of the rollout."""
        for memory in self.values():
            memory.start.copy_(memory.now)

    def forget(self, ended: Tensor) -> None:
        """Set all states to 0 where ``ended`` (N,)."""
        for memory in self.values():
            memory.forget(ended)
