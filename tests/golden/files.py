"""Checkpoints, archives of arrays, folders and networks that are not what they say."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from attack import program
from onnx import TensorProto, helper
from program import SMALL

from golden.contract import Change, damaged, drop, set_at
from golden.table import Run, Table, patched
from legged_mw.deploy import controller as policy
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Network
from legged_mw.rl import policies
from legged_mw.rl.run_folder import find_checkpoint, find_run, load_tensors, new_run, save_whole, sealed
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.skills.clip import read_clip
from legged_mw.utils import files
from legged_mw.utils.motor_network import read_network
from legged_mw.utils.task import load_task

ACTOR, ADAM, ENV = "actor_state_dict", "optimizer_state_dict", "infos|env"
WEIGHT, MOMENTS, GROUP = f"{ACTOR}|mlp.0.weight", f"{ADAM}|state|0", f"{ADAM}|param_groups|0"


def poisoned(tensor: torch.Tensor, value: float = torch.nan) -> torch.Tensor:
    tensor = tensor.clone()
    tensor.view(-1)[0] = value
    return tensor


CONTENTS: dict[str, Change] = {
    "no critic": drop("critic_state_dict"),
    "no counter": drop("iter"),
    "counter below 0": set_at("iter", -1),
    "counter is NaN": set_at("iter", float("nan")),
    "counter is true": set_at("iter", True),
    "counter is text": set_at("iter", "5"),
    "another counter than the name": set_at("iter", 6),
    "steps below 0": set_at("infos|total_steps", -3),
    "seconds are NaN": set_at("infos|seconds", float("nan")),
    "infos is a list": set_at("infos", [1]),
    "NaN in a weight": set_at(WEIGHT, poisoned),
    "infinite bias": set_at(f"{ACTOR}|mlp.0.bias", partial(poisoned, value=torch.inf)),
    "NaN in the critic": set_at("critic_state_dict|mlp.0.weight", poisoned),
    "weight of another shape": set_at(WEIGHT, torch.zeros(2, 2)),
    "weight of whole numbers": set_at(WEIGHT, lambda w: w.long()),
    "weight is a list": set_at(WEIGHT, [1.0]),
    "weight is shown wider": set_at(WEIGHT, torch.zeros(1).expand(10**9)),
    "sparse weight": set_at(WEIGHT, lambda w: w.to_sparse()),
    "a number as a name": lambda content: content[ACTOR].update({3: torch.zeros(1)}),
    "a weight too many": lambda content: content[ACTOR].update(more=torch.zeros(1)),
    "negative variance": set_at(f"{ACTOR}|obs_normalizer._var", lambda v: -v),
    "negative count": set_at(f"{ACTOR}|obs_normalizer.count", lambda c: c - 9),
    "networks are a list": set_at(ACTOR, []),
    "moments of another shape": set_at(f"{MOMENTS}|exp_avg", torch.zeros(3)),
    "moments of one number": set_at(f"{MOMENTS}|exp_avg_sq", torch.zeros(())),
    "moments are NaN": set_at(f"{MOMENTS}|exp_avg", poisoned),
    "negative second moment": set_at(f"{MOMENTS}|exp_avg_sq", partial(poisoned, value=-1.0)),
    "steps of Adam below 0": set_at(f"{MOMENTS}|step", torch.tensor(-1.0)),
    "moments of complex numbers": set_at(f"{MOMENTS}|exp_avg_sq", lambda m: m.to(torch.complex64)),
    "no second moments": drop(f"{MOMENTS}|exp_avg_sq"),
    "a rate of many numbers": set_at(f"{GROUP}|lr", torch.ones(3)),
    "Adam backwards": set_at(f"{GROUP}|maximize", True),
    "no state": set_at(f"{ADAM}|state", {}),
    "state of no parameter": set_at(f"{ADAM}|state|99", {}),
    "state of a parameter from the end": set_at(f"{ADAM}|state", lambda state: {-1: state[0]}),
    "rate below 0": set_at(f"{GROUP}|lr", -1e-3),
    "rate of 0": set_at(f"{GROUP}|lr", 0.0),
    "rate is NaN": set_at(f"{GROUP}|lr", float("nan")),
    "rate is text": set_at(f"{GROUP}|lr", "fast"),
    "rate beyond any float": set_at(f"{GROUP}|lr", 10**400),
    "no betas": drop(f"{GROUP}|betas"),
    "no parameters": drop(f"{GROUP}|params"),
    "betas above 1": set_at(f"{GROUP}|betas", (5.0, 5.0)),
    "no groups": set_at(f"{ADAM}|param_groups", []),
    "groups of other parameters": set_at(f"{GROUP}|params", lambda p: p[::-1]),
    "random state of floats": set_at("infos|random_state|cpu", torch.zeros(9)),
    "random state cut": set_at("infos|random_state|cpu", lambda state: state[:7]),
    "level below 0": set_at(f"{ENV}|kick_level", lambda level: level - 3),
    "level of two axes": set_at(f"{ENV}|kick_level", lambda level: level[:, None]),
    "no levels": set_at(f"{ENV}|kick_level", lambda level: level[:0]),
    "networks without weights": set_at(ACTOR, {}),
    "counter of Adam": drop("optimizer_state_dict"),
    "state is a list": set_at(f"{ADAM}|state", [1]),
    "group is a number": set_at(f"{ADAM}|param_groups|0", 3),
    "group without a rate": lambda content: content[ADAM]["param_groups"][0].pop("lr"),
    "step of Adam of text": set_at(f"{ADAM}|state|0|step", "one"),
    "env is a list": set_at("infos|env", [1]),
    "a level of text": set_at("infos|env|kick_level", "high"),
    "no actor": drop("actor_state_dict"),
}
BYTES: dict[str, Callable[[bytes], bytes]] = {
    "cut": lambda whole: whole[:-100],
    "empty": lambda whole: b"",
    "more behind": lambda whole: whole + b"more",
    "more in front": lambda whole: b"more" + whole,
    "seal of another": lambda whole: whole[:-64] + b"0" * 64,
    "twice": lambda whole: whole + whole,
    "text": lambda whole: b"not a checkpoint",
    "seal on text": lambda whole: sealed(b"PK\x05\x06" + b"\0" * 18),
}


@cache
def runner() -> Runner:
    """One that has never learned, of a task with levels and counts of its own."""
    task = load_task("go1_flat")
    for item in [*SMALL[SMALL.index("--set") + 1 :: 2], "env.num_envs=4", "perturbation.curriculum=true"]:
        task.set(*item.split("=", 1))
    made = make_runner(task.env_class(task.cfg, "cpu"), task.train, None, "cpu")
    for parameter in [p for group in made.alg.optimizer.param_groups for p in group["params"]]:
        parameter.grad = torch.zeros_like(parameter)
    made.alg.optimizer.step()  # so that it has a state
    made.current_learning_iteration = 5
    return made


def spoilt(change: Change) -> Run:
    def given(root: Path) -> None:
        runner().save(str(root / "model_5.pt"))
        content = torch.load(root / "model_5.pt", weights_only=True)
        change(content)
        save_whole(content, root / "model_5.pt")

    return given


def loads(root: Path) -> None:
    """Of what is refused nothing is loaded."""
    made, before = runner(), copy.deepcopy(runner().alg.save()[ACTOR])
    try:
        made.load(str(root / "model_5.pt"))
    finally:
        after = made.alg.save()[ACTOR]
        assert all(torch.equal(value, after[name]) for name, value in before.items())
        assert made.current_learning_iteration == 5


def rewritten(change: Any) -> Run:
    def given(root: Path) -> None:
        runner().save(str(root / "model_5.pt"))
        (root / "model_5.pt").write_bytes(change((root / "model_5.pt").read_bytes()))

    return given


CLIP = {
    "fps": 50.0,
    "joint_names": ["a"],
    "root_pos": np.zeros((3, 3)),
    "root_quat": np.eye(4)[[0, 0, 0]],
    "joint_pos": np.zeros((3, 1)),
}
MOTOR = {"weight0": np.zeros((1, 2)), "bias0": np.zeros(1)}
ARRAYS: dict[str, tuple[Callable[[Path], Any], dict[str, Any]]] = {
    "no rate": (read_clip, {"fps": np.nan}),
    "a rate of 10^30": (read_clip, {"fps": 1e30}),
    "two rates": (read_clip, {"fps": [50.0, 50.0]}),
    "joints are numbers": (read_clip, {"joint_names": [1]}),
    "complex places": (read_clip, {"root_pos": np.zeros((3, 3)) * 1j}),
    "far away": (read_clip, {"root_pos": np.full((3, 3), 1e30)}),
    "a joint twice": (read_clip, {"joint_names": ["a", "a"], "joint_pos": np.zeros((3, 2))}),
    "more than there may be": (read_clip, {"more": np.zeros(70_000, dtype=np.uint8)}),
    "frames of 10^9": (read_network, {"frames": [0, 10**9]}),
    "infinite frames": (read_network, {"frames": [np.inf]}),
}


def archive(read: Any, change: dict[str, Any]) -> Run:
    content = (CLIP if read is read_clip else MOTOR) | {name: np.asarray(value) for name, value in change.items()}
    return lambda root: np.savez(root / "file.npz", allow_pickle=False, **content)


def strange_folders(root: Path) -> Path:
    logs = root / "logs/go1_flat"
    (logs / "good").mkdir(parents=True)
    (logs / "good/model_3.pt").write_bytes(b"x")
    (logs / "good/model_9.pt").symlink_to("nowhere")
    (logs / "good/model_8.pt").symlink_to("model_8.pt")
    (logs / "good/model_7.pt").mkdir()
    (logs / "itself").symlink_to("itself")
    (logs / "dangling").symlink_to("nowhere")
    (logs / "above").symlink_to("..")
    (logs / "file").write_text("")
    return logs


FOLDERS = {
    "a run that links to itself": ("play", "--load_run", "itself"),
    "a dangling run": ("train", "--resume", "--load_run", "dangling"),
    "a dangling checkpoint": ("play", "--checkpoint", "9"),
    "a run without config": ("play", "--load_run", "good"),
}


def network(*nodes: Any, constants: Sequence[Any] = ()) -> Run:
    """An export whose network is these nodes, from "obs" (batch, 48) to "actions" (batch, 12); "short" is obs without its end."""

    def given(root: Path) -> None:
        begin = [
            helper.make_tensor("from", TensorProto.INT64, [1], [0]),
            helper.make_tensor("to", TensorProto.INT64, [1], [12]),
        ]
        ones = [helper.make_tensor("axis", TensorProto.INT64, [1], [1])]
        graph = helper.make_graph(
            [helper.make_node("Slice", ["obs", "from", "to", "axis"], ["short"]), *nodes],
            "network",
            [helper.make_tensor_value_info("obs", TensorProto.FLOAT, ["batch", 48])],
            [helper.make_tensor_value_info("actions", TensorProto.FLOAT, ["batch", 12])],
            [*begin, *ones, *constants],
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
        damaged(root, model.SerializeToString())

    return given


def endless() -> Run:
    """A loop of 10^15 turns."""
    infos = [
        helper.make_tensor_value_info(name, kind, [])
        for name, kind in (("turn", TensorProto.INT64), ("go", TensorProto.BOOL))
    ]
    held, more = (
        helper.make_tensor_value_info("x", TensorProto.FLOAT, None),
        helper.make_tensor_value_info("y", TensorProto.FLOAT, None),
    )
    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["on"]), helper.make_node("Neg", ["x"], ["y"])],
        "body",
        [*infos, held],
        [helper.make_tensor_value_info("on", TensorProto.BOOL, []), more],
    )
    constants = [
        helper.make_tensor("turns", TensorProto.INT64, [], [10**15]),
        helper.make_tensor("true", TensorProto.BOOL, [], [True]),
    ]
    return network(helper.make_node("Loop", ["turns", "true", "short"], ["actions"], body=body), constants=constants)


def vast(count: int) -> Run:
    """Adds up ``count`` zeros."""
    nodes = [
        helper.make_node(
            "ConstantOfShape", ["size"], ["zeros"], value=helper.make_tensor("v", TensorProto.FLOAT, [1], [0.0])
        ),
        helper.make_node("ReduceSum", ["zeros"], ["sum"], keepdims=0),
        helper.make_node("Add", ["short", "sum"], ["actions"]),
    ]
    return network(*nodes, constants=[helper.make_tensor("size", TensorProto.INT64, [1], [count])])


NETWORKS: dict[str, Run] = {
    "NaN": network(helper.make_node("Div", ["short", "short"], ["actions"])),
    "infinity": network(helper.make_node("Reciprocal", ["short"], ["actions"])),
    "never ends": endless(),
    "400 GB": vast(10**11),
    "4 GB": vast(10**9),
    "10^18 numbers": vast(10**18),
    "another width": network(helper.make_node("Concat", ["short", "short"], ["actions"], axis=1)),
    "another input": network(helper.make_node("Add", ["short", "nosuch"], ["actions"])),
}


def actor() -> Any:
    return runner().alg.get_policy()


def gone_on(root: Path) -> None:
    def there(*_: object, **__: object) -> None:
        raise FileExistsError

    patched(lambda root: new_run(root, "x"), Path, mkdir=there)(root)


def refuse(*_: object, **__: object) -> None:
    raise PermissionError(13, "Permission denied")


def on_its_way(root: Path) -> None:
    (root / "out" / files.STAGED).mkdir(parents=True)
    (root / "out" / files.STAGED / "policy.yaml").write_text("a: 1")


def table() -> Table:
    made = Table()
    for name, change in CONTENTS.items():
        made.add(f"checkpoint, {name}", loads, spoilt(change))
    for name, change in BYTES.items():
        made.add(
            f"checkpoint of bytes, {name}", lambda root: load_tensors(root / "model_5.pt", "cpu"), rewritten(change)
        )
    for name, words in FOLDERS.items():
        made.add(f"folder: {name}", program(*words), strange_folders)
    for name, (read, change) in ARRAYS.items():
        run = patched(lambda root, read=read: read(root / "file.npz"), files, MOST_UNPACKED=1 << 16)
        made.add(f"arrays, {name}", run, archive(read, change))
    for name, given in NETWORKS.items():
        seconds = 0.5 if name == "never ends" else 60.0
        run = patched(lambda root: Network(root / "out", read_contract(root / "out")), policy, _FIRST_SECONDS=seconds)
        made.add(f"network, {name}", run, given)
    made.add("a run whose name is gone", lambda root: find_run(root / "logs", "x"))
    made.add("no checkpoint in a run", lambda root: find_checkpoint(root, -1))
    made.add("no checkpoint at", lambda root: load_tensors(root / "model_5.pt", "cpu"))
    made.add("a checkpoint that is a folder", lambda root: load_tensors(root, "cpu"))
    made.add("parameters of no file", lambda root: policies.read_parameters(root / "policy.onnx", actor()))
    made.add(
        "parameters of text",
        lambda root: policies.read_parameters(root / "policy.onnx", actor()),
        lambda root: (root / "policy.onnx").write_bytes(b"no"),
    )
    made.add(
        "parameters of another network",
        lambda root: policies.read_parameters(root / "out/policy.onnx", actor()),
        NETWORKS["NaN"],
    )
    made.add(
        "an export that is a folder's file",
        lambda root: files.writable("a", "--export", folder=True),
        lambda root: (root / "a").touch(),
    )
    for name in ("", "a\0b", "x" * 300, "folder", "there/a"):
        made.add(
            f"to write {name[:9]!r}",
            lambda root, name=name: files.writable(name, "--out"),
            lambda root: ((root / "folder").mkdir(), (root / "there").touch()),
        )
    made.add(
        "not to be written",
        patched(lambda root: files.writable("a", "--out"), files.os, access=lambda *_: False),
        lambda root: (root / "a").touch(),
    )
    for name in ("~nobody_here/a", "a\0b"):
        made.add(f"a path {name!r}", lambda root, name=name: files.typed(name))
    for name in ("..", "a/b"):
        made.add(f"an experiment {name!r}", lambda root, name=name: files.check_name(name, "the experiment's name"))
    made.add("a thousand runs", gone_on)
    made.add(
        "an export on its way",
        patched(lambda root: files.finish_moving(root / "out"), files.os, replace=refuse),
        on_its_way,
    )
    return made
