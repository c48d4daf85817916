"""Write a policy's network as an ONNX file, store it at half precision, and run it."""

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

from legged_mw.rl.policies import MEMORY_INPUT, PREFIX

INPUT, OUTPUT = "obs", "actions"


class ExportedPolicy(nn.Module):
    """Observations (N, size) in their units -> clipped mean actions (N, A). It contains the normaliser.

    A recurrent policy also has its state (N, states, H) as input and output. A policy with an estimator also has the
    estimate (N, E) as output.
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
    """Actions (B, A), or another output, of an ONNX file, computed by onnxruntime, else by onnx's evaluator."""
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
    """Write one ONNX file without external data. Input ``obs`` (batch, size), output ``actions`` (batch, A)."""
    exported = ExportedPolicy(policy, clip_actions).eval()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch's exporter warns about its own code and missing torchvision
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
    """Remove the exporter's debug data: stack traces with folders of this machine."""
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
                dim.dim_param = "batch"  # the only free dimension
    onnx.save(model, path)


# ---- half precision ------------------------------------------------------------------------------------------------


def _weights(policy: MLPModel) -> dict[str, nn.Parameter]:
    """The parameters to store at half precision. Biases and the normaliser stay float32: their rounding costs more."""
    return {name: parameter for name, parameter in policy.named_parameters() if parameter.dim() > 1}


def round_weights(policy: MLPModel) -> None:
    """Round the weights to float16; they stay float32 tensors."""
    for weight in _weights(policy).values():
        weight.data = weight.data.half().float()


def halve(policy: MLPModel, path: Path) -> None:
    """Store the rounded weights of ``policy`` in ``path`` as float16, each with a Cast to float32."""
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
