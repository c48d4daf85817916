"""A policy's network as an ONNX file: writing it, halving it, running it, and reading its weights back.

onnx is imported where a file is written or read: a training begins without.
"""

from __future__ import annotations

import copy
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rsl_rl.models import MLPModel
from torch import Tensor, nn

from legged_mw.utils.config import ConfigError

INPUT, OUTPUT, MEMORY_INPUT, MEMORY_OUTPUT, ESTIMATE = "obs", "actions", "state_in", "state_out", "estimate"
PREFIX = "policy."  # of the weights' names in the file: the attribute of ExportedPolicy
MEAN, STD = "obs_normalizer._mean", "obs_normalizer._std"
LEARNING_ONLY = "teacher."  # parameters that nothing needs to act
# neither a mean action nor an estimate needs them
UNWRITTEN = (
    "distribution.",
    LEARNING_ONLY,
    *(f"{of}_normalizer.{name}" for of in ("obs", "target") for name in ("_var", "count")),
)


class ExportedPolicy(nn.Module):
    """Observations (N, size) in their plain units -> clipped mean actions (N, A); the normaliser is inside.

    Of a recurrent policy the state (N, states, H) goes in beside the observations and comes out beside the actions. Of one that
    estimates, the estimate (N, E) comes out beside them.
    """

    policy: Any

    def __init__(self, policy: MLPModel, clip_actions: float) -> None:
        super().__init__()
        self.policy, self.clip_actions = copy.deepcopy(policy).cpu().as_onnx(verbose=False), clip_actions
        more: dict[str, Tensor] = getattr(self.policy, "inputs", {})
        self.inputs, self.examples = [INPUT, *more], [torch.zeros(2, policy.obs_dim), *more.values()]
        self.outputs = [OUTPUT, *getattr(self.policy, "outputs", [])]

    def forward(self, obs: Tensor, state_in: Tensor | None = None) -> Any:
        clip = self.clip_actions
        if len(self.outputs) == 1:
            return self.policy(obs).clamp(-clip, clip)
        actions, beside = self.policy(obs) if state_in is None else self.policy(obs, state_in)
        return actions.clamp(-clip, clip), beside


def run_onnx(
    path: Path, observations: np.ndarray, output: str = OUTPUT, memory: np.ndarray | None = None
) -> np.ndarray:
    """Actions (B, A), or another output, of the network in an ONNX file, by onnxruntime or where it is not installed onnx's evaluator."""
    inputs = {INPUT: observations} | ({} if memory is None else {MEMORY_INPUT: memory})
    try:
        import onnxruntime
    except ImportError:
        import onnx
        from onnx.reference import ReferenceEvaluator

        [found] = ReferenceEvaluator(onnx.load(path)).run([output], inputs)
        return np.asarray(found)
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return np.asarray(session.run([output], inputs)[0])


def save_onnx(policy: MLPModel, clip_actions: float, path: Path) -> None:
    """Write one self-contained ONNX file: input ``obs`` (batch, size), output ``actions`` (batch, A); see ``ExportedPolicy``."""
    exported = ExportedPolicy(policy, clip_actions).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of its own internals, and logs that torchvision is missing
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            exported,
            tuple(exported.examples),
            path,
            input_names=exported.inputs,
            output_names=exported.outputs,
            opset_version=18,
            dynamic_shapes={name: {0: torch.export.Dim("batch", min=1)} for name in exported.inputs},
            external_data=False,
            dynamo=True,
            verbose=False,
        )
    _strip(path)


def _strip(path: Path) -> None:
    """Drop what the exporter notes for debugging: stack traces, with the folders of the machine that it ran on."""
    import onnx

    model = onnx.load(path)
    graph = model.graph
    for part in (model, graph, *graph.node, *graph.input, *graph.output, *graph.value_info, *graph.initializer):
        part.doc_string = ""
        if hasattr(part, "metadata_props"):
            del part.metadata_props[:]
    for value in (*graph.input, *graph.output, *graph.value_info):
        for dim in value.type.tensor_type.shape.dim:
            if dim.dim_param:
                dim.dim_param = "batch"  # the one free dimension, which the exporter names as it likes
    onnx.save(model, path)


# ---- half precision ------------------------------------------------------------------------------------------------


def _weights(policy: MLPModel) -> dict[str, nn.Parameter]:
    """What is stored at half precision. Biases and the normalizer stay float32: they are few, and rounding them costs more."""
    return {name: parameter for name, parameter in policy.named_parameters() if parameter.dim() > 1}


def round_weights(policy: MLPModel) -> None:
    """Round the weights to float16; they stay float32 tensors."""
    for weight in _weights(policy).values():
        weight.data = weight.data.half().float()


def halve(policy: MLPModel, path: Path) -> None:
    """Store the weights of the rounded ``policy`` in ``path`` as float16, each with a Cast, so that all is computed in float32."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load(path)
    graph, names, casts = model.graph, {PREFIX + name for name in _weights(policy)}, []
    for each in graph.initializer:
        if each.name in names:
            each.CopyFrom(numpy_helper.from_array(numpy_helper.to_array(each).astype(np.float16), each.name))
            casts.append(
                onnx.helper.make_node("Cast", [each.name], [f"{each.name}.float32"], to=onnx.TensorProto.FLOAT)
            )
    whole = {cast.input[0]: cast.output[0] for cast in casts}
    for value in graph.value_info:
        if value.name in whole:
            value.type.tensor_type.elem_type = onnx.TensorProto.FLOAT16
    for node in graph.node:
        node.input[:] = [whole.get(name, name) for name in node.input]
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    onnx.save(model, path)


# ---- reading -------------------------------------------------------------------------------------------------------


def read_parameters(path: Path, policy: MLPModel) -> dict[str, Tensor]:
    """The parameters of ``policy`` by name, as an export wrote them to ``path``: bit for bit, so that it acts as the exported one.

    The noise of exploration and the normalizer's count and variance are not in the file; ``policy`` keeps its own.
    """
    import onnx
    from onnx import numpy_helper

    try:
        graph = onnx.load(path, load_external_data=False).graph
        stored = {
            each.name: torch.from_numpy(numpy_helper.to_array(each).astype(np.float32)) for each in graph.initializer
        }
    except FileNotFoundError:
        raise ConfigError(f"no policy at {path}") from None
    except Exception:  # protobuf's or onnx's, by how the file is broken
        raise ConfigError(f"{path} cannot be read as an ONNX network: it is damaged") from None
    found = {name.removeprefix(PREFIX): value for name, value in stored.items() if name.startswith(PREFIX)}
    if not found:
        names = ", ".join(list(stored)[:3]) or "none"
        raise ConfigError(
            f"{path} is no network that this project exported: its weights are called {names}, not {PREFIX}mlp.0.weight ..."
        )
    if MEAN in found and STD not in found:
        found[STD] = _divisor(graph, stored, path) - getattr(policy.obs_normalizer, "eps", 0.0)
    return {name: value for name, value in policy.state_dict().items() if name.startswith(UNWRITTEN)} | found


def _divisor(graph: Any, stored: dict[str, Tensor], path: Path) -> Tensor:
    """std + eps of the normalizer, which the exporter adds up and names as it likes: the network begins with (obs - mean) / divisor.

    Less eps, rounded, plus eps, rounded, it is the same float32 again, as it was made by such a sum.
    """
    centred = [node.output[0] for node in graph.node if PREFIX + MEAN in node.input]
    for node in graph.node:
        if node.op_type == "Div" and node.input[0] in centred and node.input[1] in stored:
            return stored[node.input[1]]
    raise ConfigError(f"{path} is no network that this project exported: it does not begin with (obs - mean) / std")
