"""The networks of a recorded learner: layers, and the interfaces of networks with a regression or a hidden state.

Layers compute the same values and gradients as torch's, with fewer and larger kernels.
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

Layers = list[tuple[Tensor, Tensor]]  # weight and bias of each layer
FUSED_ON = ["cuda"]  # devices on which updates use fast/kernels.py
_SUM_ROWS = 128  # rows that one thread sums, in parallel with others


class Linear(torch.autograd.Function):
    """``x W^T + b`` for many rows, faster than torch's layer for two reasons.

    The bias gradient is summed in two passes; torch's single pass uses only a small part of a GPU. ``x`` may have more
    columns than the weight, with zeros, because TF32 products are faster with a multiple of four columns.
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
    """The module fast/kernels.py if it exists and the device of ``x`` uses it, else None."""
    if x.device.type not in FUSED_ON:
        return None
    return fast("kernels")  # imports warp, in about 1 s


def sum_rows(x: Tensor) -> Tensor:
    """Sum over the rows of ``x`` (B, size), computed in two passes."""
    return x.view(-1, math.gcd(len(x), _SUM_ROWS), x.shape[1]).sum(dim=1).sum(dim=0)


class EluLayers(torch.autograd.Function):
    """Linear layers with an ELU after each but the last. Input and output are float32.

    ``read``: weight and bias of each layer for the products, either the parameters or copies in bfloat16. With copies,
    all layers but the last compute in bfloat16; sums and the weights' gradients are float32 in both cases. ``x`` and
    the first weight may have additional columns of zeros.
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
    """Backward pass of the ELUs of a network, with sums of the gradients over rows; on a GPU one kernel per ELU."""

    def __init__(self, outs: list[Tensor]) -> None:
        """``outs``: output (B, size) of each ELU."""
        self._outs, sizes = outs, [out.shape[1] for out in outs]
        self._sums: list[Tensor] = [outs[0]] * len(outs) if outs else []
        self._table: Tensor | None = None
        self._kernels: Any = kernels_for(outs[0]) if outs else None
        if self._kernels and self._kernels.fits(rows := len(outs[0]), sizes):
            self._table = outs[0].new_empty(-(-rows // self._kernels.ROWS), sum(sizes), dtype=torch.float32)

    def __call__(self, grad: Tensor, i: int) -> Tensor:
        """The gradient (B, size) with respect to the input of ELU ``i``, in the dtype of its output."""
        if self._table is not None:
            return self._kernels.elu_backward(
                grad, self._outs[i], self._table, sum(out.shape[1] for out in self._outs[:i])
            )
        out = self._outs[i]
        grad = torch.ops.aten.elu_backward(grad.to(out.dtype), 1.0, 1.0, 1.0, True, out)
        self._sums[i] = sum_rows(grad.float() if out.dtype == torch.bfloat16 else grad)
        return grad

    def sums(self) -> list[Tensor]:
        """The sums (size,) of each layer, at least float32. Call it after all layers."""
        if self._table is None:
            return self._sums
        return list(self._table.sum(dim=0).split([out.shape[1] for out in self._outs]))


def _float_product(a: Tensor, b: Tensor) -> Tensor:
    """``a @ b``; for bfloat16 the result is float32, the dtype in which the product sums."""
    if a.dtype != torch.bfloat16:
        return a @ b
    if a.is_cuda:
        return torch.mm(a, b, out_dtype=torch.float32)  # type: ignore[call-overload]
    return a.float() @ b.float()


def elu_layers(layers: nn.Module) -> list[nn.Linear]:
    """The linear layers of an rsl-rl MLP if ``EluLayers`` can compute them, else [].

    Layers without parameters may follow the last linear layer.
    """
    every: list[nn.Module] = [*layers]  # type: ignore[misc]
    linear = [layer for layer in every if isinstance(layer, nn.Linear)]
    between = [layer for layer in every if not isinstance(layer, nn.Linear)][: len(linear) - 1]
    order = [layer for pair in zip(linear, between, strict=False) for layer in pair] + linear[-1:]
    fits = all(type(layer) is nn.ELU and layer.alpha == 1.0 for layer in between) and every[: len(order)] == order
    return linear if fits else []


def run_mlp(layers: nn.Module, x: Tensor, read: Layers | None = None) -> Tensor:
    """The output of an rsl-rl MLP for inputs (B, size). ``read``: weights for ``EluLayers``; None: the parameters."""
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
    """Copies of a network's weights in bfloat16 for ``EluLayers``, except the last layer's."""

    ALIGNED = 8  # bfloat16 products are faster with a multiple of this number of columns

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
        """The layers, rounded from the current weights."""
        self._copies[0].copy_(self._own[0])
        torch._foreach_copy_(self._copies[1:], self._own[1:])  # pyright: ignore[reportPrivateImportUsage]
        return self._layers

    @torch.no_grad()
    def prepare(self, latent: Tensor) -> Tensor:
        """The network's input (B, size) in bfloat16, padded with zero columns."""
        return nn.functional.pad(latent.bfloat16(), (0, -latent.shape[1] % self.ALIGNED))


def sample(model: MLPModel, output: Tensor) -> Tensor:
    """Sample actions (N, A) of a Gaussian policy without torch.normal, which reads the std on the host."""
    assert model.distribution is not None
    model.distribution.update(output)  # the forward pass without its sample
    mean = model.output_mean
    return mean + model.output_std * torch.randn_like(mean)


def update_normalizer(normalizer: EmpiricalNormalization, x: Tensor, world_size: int) -> None:
    """Update rsl-rl's running mean and variance with ``x`` (B, size) in place, without a copy from the host."""
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


# ---- networks with a regression or a hidden state -------------------------------------------------------------------


# Inputs of a recurrent network in an update; only its Memory reads the parts.
Sequenced = tuple[Tensor, ...]


class RegressingModel(MLPModel):
    """rsl-rl's MLPModel with an ``estimator``, which learns by regression and gives a part of the MLP's input.

    The subclasses are in rl/students/. A learner does not import them.
    """

    field: str  # the config field that selects the model
    regression: str  # the name of the regression loss
    estimator: nn.Module
    learning_rate: float  # learning rate of the estimator

    @staticmethod
    def settings(sections: dict[str, Any], env: RobotTask, learns: bool) -> dict[str, Any]:
        """Additional constructor arguments for the learner's ``sections``. Raises ConfigError.

        ``learns``: False for an actor that only acts; ``env`` may then lack rows that only learning needs.
        """
        raise NotImplementedError

    def rollout_latent(self, obs: TensorDict) -> Tensor:
        """The MLP's input (N, size) in the rollout, one row per world in order."""
        return self.get_latent(obs)

    def regression_batch(self, obs: TensorDict, worlds: Tensor) -> tuple[Tensor, ...]:
        """Inputs and targets of the regression, for all epochs of an update.

        ``obs`` (S * B,): observations of ``worlds`` (B,), followed by their mirror images if S is 2.
        """
        raise NotImplementedError

    def learn(self, latent: Tensor, regression_batch: tuple[Tensor, ...]) -> tuple[Tensor, Tensor]:
        """The network's output for ``latent``, which may be padded with zeros, and the regression loss ().

        The loss has no gradient with respect to parameters that the output depends on.
        """
        raise NotImplementedError

    def update_regression_normalizer(self, obs: TensorDict, ranks: int) -> None:
        """Update the normaliser of the regression."""
        raise NotImplementedError


def trained_parts(actor: MLPModel, critic: MLPModel) -> tuple[list[list[nn.Parameter]], list[Tensor]]:
    """Parameters of the parts policy, critic and, if it exists, estimator; and the estimator's learning rate ().

    Gradients are clipped by the norm of each part.
    """
    if not isinstance(actor, RegressingModel):
        return [[*actor.parameters()], [*critic.parameters()]], []
    policy = [parameter for name, parameter in actor.named_parameters() if not name.startswith("estimator.")]
    rate = torch.tensor(actor.learning_rate, dtype=torch.float32, device=policy[0].device)
    return [policy, [*critic.parameters()], [*actor.estimator.parameters()]], [rate]


class Memory(Protocol):
    """The hidden states of a recurrent network in N worlds, in fixed tensors."""

    now: Tensor  # (states, S, N, H): S is 2 if mirror images have separate states, else 1
    start: Tensor  # ``now`` at the start of the rollout

    def advance(self, obs: Any) -> Tensor:
        """Update with observations (N,), or (2N,) with mirror images. Returns the MLP's input (N, H)."""
        ...

    def normalised(self, obs: Any) -> Tensor:
        """The recurrent layers' input (B, size) for observations (B,)."""
        ...

    def forget(self, ended: Tensor) -> None:
        """Set the state to 0 where ``ended`` (N,)."""

    def for_rsl_rl(self) -> Any:
        """A copy of the hidden state in rsl-rl's form."""

    def sequence(self, inputs: Tensor, worlds: Tensor, dones: Tensor) -> Sequenced:
        """The rollout of ``worlds`` (B,): ``inputs`` (S * T * B, size), and ``dones`` (T, N, 1) after each step."""
        ...

    def unroll(self, sequence: Sequenced) -> Tensor:
        """The MLP's inputs (S * T * B, H) for a sequence, with gradients."""
        ...


class RememberingModel(RNNModel):
    """rsl-rl's recurrent network. A recorded learner stores its hidden state."""

    def memory(self, worlds: int, images: int, device: str) -> Memory:
        """A memory of zeros. With ``images`` 2 it has a second state, updated with mirror images only."""
        raise NotImplementedError


class Memories(dict[nn.Module, Memory]):
    """Network -> memory, for the recurrent networks among ``models``."""

    def __init__(self, models: Iterable[nn.Module], worlds: int, images: int, device: str) -> None:
        remembering = [model for model in models if isinstance(model, RememberingModel)]
        super().__init__({model: model.memory(worlds, images, device) for model in remembering})

    def begin_rollout(self) -> None:
        """Store the current states as the start of the rollout."""
        for memory in self.values():
            memory.start.copy_(memory.now)

    def forget(self, ended: Tensor) -> None:
        """Set all states to 0 where ``ended`` (N,)."""
        for memory in self.values():
            memory.forget(ended)
