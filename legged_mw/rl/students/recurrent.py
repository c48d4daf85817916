"""GRU and LSTM networks in a recorded rollout and update, and the hidden state of a policy.

rsl-rl splits a rollout into episodes and pads them to one length, so shapes depend on data. Here the network runs over
the T steps of the rollout for all worlds in parallel, and the state of a world is set to 0 before the first step of an
episode. Values and gradients are the same. cuDNN cannot change a state between steps, so each step is a matrix product
and a few other kernels.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from rsl_rl.models import MLPModel, RNNModel
from torch import Tensor, nn

from legged_mw.rl.networks import Linear, RememberingModel, Sequenced, sum_rows
from legged_mw.rl.policies import MEMORY_INPUT, MEMORY_OUTPUT


class SequenceInput(NamedTuple):
    """Inputs of a recurrent network in an update: B worlds over T steps; S is 2 with mirror images, else 1."""

    inputs: Tensor  # (S, T, B, size), normalised
    state: Tensor  # (states, S, B, H), at the first step
    keep: Tensor  # (T, B, 1): 0 at the first step of an episode, else 1


class HiddenState:
    """The state of a recurrent network in each of N worlds, in fixed tensors.

    With ``images`` 2 there is a second state, updated with mirror images only, because the mirror image of a learned
    state is unknown.
    """

    def __init__(self, model: RNNModel, worlds: int, images: int, device: str) -> None:
        self._model = model
        self.now = torch.zeros(states_of(model)[0], images, worlds, states_of(model)[1], device=device)
        self.start = torch.zeros_like(self.now)  # at the start of the rollout

    def advance(self, obs: Any) -> Tensor:
        """Update with observations (N,), or (2N,) with mirror images. Returns the MLP's input (N, H)."""
        seen, after = step(self._model.rnn.rnn, self.normalised(obs), self.now.flatten(1, 2))
        self.now.copy_(after.view_as(self.now))
        return seen[: self.now.shape[2]]

    def normalised(self, obs: Any) -> Tensor:
        """The recurrent layers' input (B, size) for observations (B,)."""
        return MLPModel.get_latent(self._model, obs)

    def forget(self, ended: Tensor) -> None:
        """Set the state to 0 where ``ended`` (N,)."""
        self.now.masked_fill_(ended.bool()[:, None], 0.0)

    def for_rsl_rl(self) -> Any:
        """A copy of the state in rsl-rl's form: h, or (h, c), each (layers, N, H)."""
        parts = self.now[:, 0].clone().split(self._model.rnn.rnn.num_layers)
        return parts[0] if len(parts) == 1 else parts

    def sequence(self, inputs: Tensor, worlds: Tensor, dones: Tensor) -> SequenceInput:
        """The rollout of ``worlds`` (B,), from ``inputs`` (S * T * B, size) and ``dones`` (T, N, 1) after each step."""
        ended = dones.index_select(1, worlds).to(inputs.dtype)
        keep = torch.cat([torch.ones_like(ended[:1]), 1.0 - ended[:-1]])
        return SequenceInput(
            inputs.view(-1, len(keep), len(worlds), inputs.shape[1]), self.start.index_select(2, worlds), keep
        )

    def unroll(self, sequence: Sequenced) -> Tensor:
        """The outputs (S * T * B, H) over a sequence."""
        return unroll(self._model.rnn.rnn, SequenceInput(*sequence))


class RecurrentModel(RememberingModel):
    """rsl-rl's RNNModel with a memory for recorded learners. An export has the state as input and output."""

    def memory(self, worlds: int, images: int, device: str) -> HiddenState:
        return HiddenState(self, worlds, images, device)

    def as_onnx(self, verbose: bool) -> nn.Module:
        return _OnnxRecurrentModel(self)


class _OnnxRecurrentModel(nn.Module):
    """Observations (B, size) in their units and states (B, states, H) -> mean actions (B, A) and the next states."""

    outputs = [MEMORY_OUTPUT]  # additional to the actions

    def __init__(self, model: RecurrentModel) -> None:
        super().__init__()
        self.obs_normalizer, self.rnn, self.mlp, self.distribution = copy.deepcopy(
            (model.obs_normalizer, model.rnn, model.mlp, model.distribution)
        )
        self.inputs = {MEMORY_INPUT: torch.zeros(2, *states_of(model))}  # beside the observations: examples

    def forward(self, obs: Tensor, state_in: Tensor) -> tuple[Tensor, Tensor]:
        seen, state = step(self.rnn.rnn, self.obs_normalizer(obs), state_in.transpose(0, 1))
        return self.distribution.deterministic_output(self.mlp(seen)), state.transpose(0, 1)  # type: ignore[union-attr]


def memory_of(policy: MLPModel, worlds: int) -> Tensor:
    """Zero hidden states of an rsl-rl network (N, states, H); (N, 0, 0) without a memory."""
    held = policy.get_hidden_state()
    if held is None:
        return torch.zeros(worlds, *(states_of(policy) if isinstance(policy, RNNModel) else (0, 0)))
    return (torch.cat(held) if isinstance(held, tuple) else held).transpose(0, 1)


def states_of(model: RNNModel) -> tuple[int, int]:
    """Number of states (h of each layer, then c of each layer of an LSTM), and the size H of each."""
    rnn = model.rnn.rnn
    return rnn.num_layers * (2 if isinstance(rnn, nn.LSTM) else 1), rnn.hidden_size


def forget(policy: Any, ended: Tensor | None = None) -> None:
    """Clear the hidden state where ``ended`` (N,), or everywhere. No effect on a policy without a memory."""
    if getattr(policy, "is_recurrent", False):
        with torch.inference_mode():  # the state may be an inference tensor
            policy.reset(ended)


def with_own_state(policy: Any) -> Any:
    """A copy of the policy with a separate hidden state; the policy itself without a memory."""
    if not getattr(policy, "is_recurrent", False):
        return policy
    return copy.deepcopy(policy).apply(lambda part: part.flatten_parameters() if isinstance(part, nn.RNNBase) else None)


def step(rnn: nn.RNNBase, x: Tensor, state: Tensor) -> tuple[Tensor, Tensor]:
    """One step of a GRU or LSTM: output (N, H) and next state, from inputs (N, size) and state (states, N, H)."""
    hidden, cells = [], []
    for layer, weights in enumerate(rnn.all_weights):
        if isinstance(rnn, nn.LSTM):
            x, cell = torch.lstm_cell(x, [state[layer], state[rnn.num_layers + layer]], *weights)
            cells.append(cell)
        else:
            x = torch.gru_cell(x, state[layer], *weights)
        hidden.append(x)
    return x, torch.stack([*hidden, *cells])


def unroll(rnn: nn.RNNBase, sequence: SequenceInput) -> Tensor:
    """The outputs (S * T * B, H) of a GRU or LSTM over a sequence. Gradients stop at the start of each episode."""
    x, state, keep = sequence
    layer_of: Callable[..., Tensor] = LSTM.apply if isinstance(rnn, nn.LSTM) else GRU.apply  # type: ignore[assignment]
    for layer, (into, onward, bias, onward_bias) in enumerate(rnn.all_weights):
        gates = Linear.apply(x.flatten(0, 2), into, bias).unflatten(0, x.shape[:3])  # type: ignore[union-attr]
        x = layer_of(gates, state[layer :: rnn.num_layers], keep, onward, onward_bias)
    return x.flatten(0, 2)


# These layers take the inputs' part of the gates, (S, T, B, gates * H), as in torch, and compute the state's part
# step by step. In the backward pass the gradient of each gate is the gradient of h (or c) times a factor. All factors
# are computed at once.


class GRU(torch.autograd.Function):
    """r, z = sigmoid(gates + W h + b); n = tanh(gate + r (W h + b)); next h = (1 - z) n + z h."""

    @staticmethod
    def forward(ctx: Any, gates: Tensor, start: Tensor, keep: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        (images, steps, worlds, _), size = gates.shape, weight.shape[1]
        out = gates.new_empty(images, steps, worlds, size)
        before, new, rz, onward = (gates.new_empty(steps, images, worlds, k * size) for k in (1, 1, 2, 3))
        h = start[0]
        for t in range(steps):
            torch.mul(h, keep[t], out=before[t])
            torch.addmm(bias, before[t].flatten(0, 1), weight.t(), out=onward[t].flatten(0, 1))
            torch.add(gates[:, t, :, : 2 * size], onward[t, ..., : 2 * size], out=rz[t]).sigmoid_()
            torch.addcmul(gates[:, t, :, 2 * size :], rz[t, ..., :size], onward[t, ..., 2 * size :], out=new[t]).tanh_()
            h = torch.lerp(new[t], before[t], rz[t, ..., size:], out=out[:, t])
        ctx.save_for_backward(before, new, rz, onward, keep, weight)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), (before, new, rz, onward, keep, weight) = grads, ctx.saved_tensors
        size = weight.shape[1]
        r, z = rz.chunk(2, dim=-1)
        to_new = (1.0 - z) * (1.0 - new.square())
        into = torch.cat(
            [to_new * onward[..., 2 * size :] * r * (1.0 - r), (before - new) * z * (1.0 - z), to_new * r], dim=-1
        )
        of_h = torch.empty_like(before)
        of_h[-1] = grad[:, -1]
        for t in reversed(range(len(keep))):
            into[t].unflatten(-1, (3, size)).mul_(of_h[t].unsqueeze(-2))  # now the gradient
            if t:
                back = (into[t].flatten(0, 1) @ weight).view_as(of_h[t]).addcmul_(of_h[t], z[t])
                torch.addcmul(grad[:, t - 1], back, keep[t], out=of_h[t - 1])
        of_gates = torch.cat([into[..., : 2 * size], to_new * of_h], dim=-1).transpose(0, 1)
        rows = into.flatten(0, 2)
        return of_gates, None, None, rows.t() @ before.flatten(0, 2), sum_rows(rows)


class LSTM(torch.autograd.Function):
    """i, f, o = sigmoid(gates + W h + b), g = tanh(gate + W h + b); next c = f c + i g; next h = o tanh(c)."""

    @staticmethod
    def forward(ctx: Any, gates: Tensor, start: Tensor, keep: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
        (images, steps, worlds, _), size = gates.shape, weight.shape[1]
        out = gates.new_empty(images, steps, worlds, size)
        before, cell, squashed, ifgo = (gates.new_empty(steps, images, worlds, k * size) for k in (1, 1, 1, 4))
        h, c = start
        for t in range(steps):
            torch.mul(h, keep[t], out=before[t])
            torch.mul(c, keep[t], out=cell[t])
            torch.addmm(bias, before[t].flatten(0, 1), weight.t(), out=ifgo[t].flatten(0, 1))
            i, f, g, o = ifgo[t].add_(gates[:, t]).chunk(4, dim=-1)
            ifgo[t, ..., : 2 * size].sigmoid_()
            g.tanh_()
            o.sigmoid_()
            c = torch.mul(f, cell[t]).addcmul_(i, g)
            h = torch.mul(o, torch.tanh(c, out=squashed[t]), out=out[:, t])
        ctx.save_for_backward(before, cell, squashed, ifgo, keep, weight)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), (before, cell, squashed, ifgo, keep, weight) = grads, ctx.saved_tensors
        size = weight.shape[1]
        i, f, g, o = ifgo.chunk(4, dim=-1)
        to_cell, onward = o * (1.0 - squashed.square()), f * keep.unsqueeze(1)
        factors = [g * i * (1.0 - i), cell * f * (1.0 - f), i * (1.0 - g.square()), squashed * o * (1.0 - o)]
        into = torch.cat(factors, dim=-1)
        of_h, of_c = grad[:, -1], torch.zeros_like(cell[0])  # gradient of c from the next step only
        for t in reversed(range(len(keep))):
            of_c = torch.addcmul(of_c, of_h, to_cell[t])
            into[t, ..., : 3 * size].unflatten(-1, (3, size)).mul_(of_c.unsqueeze(-2))  # now the gradient
            into[t, ..., 3 * size :].mul_(of_h)
            if t:
                of_c = of_c * onward[t]
                of_h = torch.addcmul(grad[:, t - 1], (into[t].flatten(0, 1) @ weight).view_as(of_c), keep[t])
        rows = into.flatten(0, 2)
        return into.transpose(0, 1), None, None, rows.t() @ before.flatten(0, 2), sum_rows(rows)
