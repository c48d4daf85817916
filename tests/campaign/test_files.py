"""Files taken at their word: checkpoints, contracts, scenes, networks and folders that are not what they say."""

from __future__ import annotations

import contextlib
import copy
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from attack import Case, attack, program
from onnx import TensorProto, helper
from program import SMALL

from legged_mw import ROOT
from legged_mw.deploy import controller as policy
from legged_mw.deploy.contract import checksum, read_contract
from legged_mw.deploy.controller import Network
from legged_mw.deploy.simulated import read_scene
from legged_mw.rl import runner as running
from legged_mw.rl.run_folder import checkpoints, find_run, load_tensors, runs, save_whole, sealed
from legged_mw.rl.runner import make_runner
from legged_mw.skills.clip import read_clip
from legged_mw.utils import files
from legged_mw.utils.config import load_yaml, save_yaml
from legged_mw.utils.files import digest
from legged_mw.utils.motor_network import read_network
from legged_mw.utils.task import load_task

SHIPPED = ROOT / "resources/policies/go1_flat"
Change = Callable[[Any], Any]
DAMAGED = "cannot be read as a checkpoint: it is damaged: "


# ---- checkpoints


@pytest.fixture(scope="module")
def runner() -> running.Runner:
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


def set_at(path: str, value: Any) -> Change:
    """Put ``value``, or what it makes of what is there, at a dotted path of the content; numbers are keys too."""

    def change(content: Any) -> None:
        *places, last = (int(part) if part.isdecimal() else part for part in path.split("|"))
        for place in places:
            content = content[place]
        content[last] = value(content[last]) if callable(value) else value

    return change


def drop(path: str) -> Change:
    """Remove what is at a dotted path."""
    *places, last = path.split("|")
    return lambda content: reduce(
        lambda at, place: at[int(place) if place.isdecimal() else place], places, content
    ).pop(last)


def poisoned(tensor: torch.Tensor, value: float = torch.nan) -> torch.Tensor:
    tensor = tensor.clone()
    tensor.view(-1)[0] = value
    return tensor


ACTOR, ADAM, ENV = "actor_state_dict", "optimizer_state_dict", "infos|env"
OTHER, VERSION, INFINITE, BELOW = "does not fit this task: ", "is of another version: its ", "not finite", "below 0"
WEIGHT, MOMENTS, GROUP = f"{ACTOR}|mlp.0.weight", f"{ADAM}|state|0", f"{ADAM}|param_groups|0"
CONTENTS: list[tuple[str, Change, str]] = [
    ("no critic", drop("critic_state_dict"), "holds no critic_state_dict"),
    ("no counter", drop("iter"), "holds no iter"),
    ("counter below 0", set_at("iter", -1), VERSION),
    ("counter is NaN", set_at("iter", float("nan")), VERSION),
    ("counter is true", set_at("iter", True), VERSION),
    ("counter is text", set_at("iter", "5"), VERSION),
    ("another counter than the name", set_at("iter", 6), "call it model_6.pt"),
    ("steps below 0", set_at("infos|total_steps", -3), VERSION),
    ("seconds are NaN", set_at("infos|seconds", float("nan")), VERSION),
    ("infos is a list", set_at("infos", [1]), VERSION),
    ("NaN in a weight", set_at(WEIGHT, poisoned), INFINITE),
    ("infinite bias", set_at(f"{ACTOR}|mlp.0.bias", partial(poisoned, value=torch.inf)), INFINITE),
    ("NaN in the critic", set_at("critic_state_dict|mlp.0.weight", poisoned), INFINITE),
    ("weight of another shape", set_at(WEIGHT, torch.zeros(2, 2)), f"{OTHER}actor mlp.0.weight"),
    ("weight of whole numbers", set_at(WEIGHT, lambda w: w.long()), f"{OTHER}actor mlp.0.weight"),
    ("weight is a list", set_at(WEIGHT, [1.0]), VERSION),
    ("weight is shown wider", set_at(WEIGHT, torch.zeros(1).expand(10**9)), VERSION),
    ("sparse weight", set_at(WEIGHT, lambda w: w.to_sparse()), VERSION),
    ("a number as a name", lambda content: content[ACTOR].update({3: torch.zeros(1)}), VERSION),
    ("a weight too many", lambda content: content[ACTOR].update(more=torch.zeros(1)), f"{OTHER}actor more"),
    ("negative variance", set_at(f"{ACTOR}|obs_normalizer._var", lambda v: -v), BELOW),
    ("negative count", set_at(f"{ACTOR}|obs_normalizer.count", lambda c: c - 9), BELOW),
    ("networks are a list", set_at(ACTOR, []), VERSION),
    ("moments of another shape", set_at(f"{MOMENTS}|exp_avg", torch.zeros(3)), f"{OTHER}{ADAM} 0.exp_avg"),
    ("moments of one number", set_at(f"{MOMENTS}|exp_avg_sq", torch.zeros(())), f"{OTHER}{ADAM} 0.exp_avg_sq"),
    ("moments are NaN", set_at(f"{MOMENTS}|exp_avg", poisoned), INFINITE),
    ("negative second moment", set_at(f"{MOMENTS}|exp_avg_sq", partial(poisoned, value=-1.0)), BELOW),
    ("steps of Adam below 0", set_at(f"{MOMENTS}|step", torch.tensor(-1.0)), BELOW),
    ("moments of complex numbers", set_at(f"{MOMENTS}|exp_avg_sq", lambda m: m.to(torch.complex64)), OTHER),
    ("no second moments", drop(f"{MOMENTS}|exp_avg_sq"), f"{OTHER}{ADAM} 0.exp_avg_sq is missing"),
    ("a rate of many numbers", set_at(f"{GROUP}|lr", torch.ones(3)), VERSION),
    ("Adam backwards", set_at(f"{GROUP}|maximize", True), VERSION),
    ("no state", set_at(f"{ADAM}|state", {}), VERSION),
    ("state of no parameter", set_at(f"{ADAM}|state|99", {}), VERSION),
    ("state of a parameter from the end", set_at(f"{ADAM}|state", lambda state: {-1: state[0]}), VERSION),
    ("rate below 0", set_at(f"{GROUP}|lr", -1e-3), VERSION),
    ("rate of 0", set_at(f"{GROUP}|lr", 0.0), VERSION),
    ("rate is NaN", set_at(f"{GROUP}|lr", float("nan")), VERSION),
    ("rate is text", set_at(f"{GROUP}|lr", "fast"), VERSION),
    ("rate beyond any float", set_at(f"{GROUP}|lr", 10**400), VERSION),
    ("no betas", drop(f"{GROUP}|betas"), VERSION),
    ("no parameters", drop(f"{GROUP}|params"), VERSION),
    ("betas above 1", set_at(f"{GROUP}|betas", (5.0, 5.0)), VERSION),
    ("no groups", set_at(f"{ADAM}|param_groups", []), VERSION),
    ("groups of other parameters", set_at(f"{GROUP}|params", lambda p: p[::-1]), VERSION),
    ("random state of floats", set_at("infos|random_state|cpu", torch.zeros(9)), VERSION),
    ("random state cut", set_at("infos|random_state|cpu", lambda state: state[:7]), VERSION),
    ("level below 0", set_at(f"{ENV}|kick_level", lambda level: level - 3), BELOW),
    ("level of two axes", set_at(f"{ENV}|kick_level", lambda level: level[:, None]), f"{OTHER}infos.env kick_level"),
    ("no levels", set_at(f"{ENV}|kick_level", lambda level: level[:0]), f"{OTHER}infos.env kick_level"),
]


@pytest.mark.parametrize(("change", "says"), [entry[1:] for entry in CONTENTS], ids=[entry[0] for entry in CONTENTS])
def test_checkpoints(runner: running.Runner, change: Change, says: str, tmp_path: Path) -> None:
    """Of what is refused nothing is loaded."""

    def spoil(root: Path) -> None:
        runner.save(str(root / "model_5.pt"))
        content = torch.load(root / "model_5.pt", weights_only=True)
        change(content)
        save_whole(content, root / "model_5.pt")

    before = copy.deepcopy(runner.alg.save())
    attack(Case("", lambda root: runner.load(str(root / "model_5.pt")), ("model_5.pt", says), given=spoil), tmp_path)
    after = runner.alg.save()
    assert all(torch.equal(value, after[ACTOR][name]) for name, value in before[ACTOR].items())
    assert runner.current_learning_iteration == 5


def test_a_checkpoint_goes_through_unharmed(runner: running.Runner, tmp_path: Path) -> None:
    """Sealed, and as it was written before there were seals."""
    runner.save(str(tmp_path / "model_5.pt"))
    runner.load(str(tmp_path / "model_5.pt"))
    torch.save(torch.load(tmp_path / "model_5.pt", weights_only=True), tmp_path / "model_5.pt")
    assert b"sha256" not in (tmp_path / "model_5.pt").read_bytes()[-100:]
    runner.load(str(tmp_path / "model_5.pt"))


def test_every_flipped_bit_is_seen(runner: running.Runner, tmp_path: Path) -> None:
    draw, file = random.Random(3), tmp_path / "model_5.pt"
    runner.save(str(file))
    whole = file.read_bytes()
    for place in [*(draw.randrange(8 * len(whole)) for _ in range(300)), *range(8 * len(whole) - 800, 8 * len(whole))]:
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        file.write_bytes(flipped)
        with pytest.raises(Exception, match="damaged"):
            load_tensors(file, "cpu")


BYTES: list[tuple[str, Callable[[bytes], bytes], str]] = [
    ("cut", lambda whole: whole[:-100], DAMAGED),
    ("empty", lambda whole: b"", DAMAGED),
    ("more behind", lambda whole: whole + b"more", DAMAGED),
    ("more in front", lambda whole: b"more" + whole, DAMAGED),
    ("seal of another", lambda whole: whole[:-64] + b"0" * 64, "its SHA-256 is another than the one in it"),
    ("twice", lambda whole: whole + whole, DAMAGED),
    ("text", lambda whole: b"not a checkpoint", DAMAGED),
    ("seal on text", lambda whole: sealed(b"PK\x05\x06" + b"\0" * 18), "cannot be read as a checkpoint"),
]


@pytest.mark.parametrize(("change", "says"), [entry[1:] for entry in BYTES], ids=[entry[0] for entry in BYTES])
def test_bytes(runner: running.Runner, change: Callable[[bytes], bytes], says: str, tmp_path: Path) -> None:
    runner.save(str(tmp_path / "model_5.pt"))
    (tmp_path / "model_5.pt").write_bytes(change((tmp_path / "model_5.pt").read_bytes()))
    attack(Case("", lambda root: load_tensors(root / "model_5.pt", "cpu"), ("model_5.pt", says)), tmp_path)


# ---- folders


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


def test_links_in_the_logs(tmp_path: Path) -> None:
    logs = strange_folders(tmp_path)
    assert (
        runs(logs) == [logs / "good"]
        and list(checkpoints(logs / "good")) == [3]
        and find_run(logs, "-1") == logs / "good"
    )


FOLDERS = [
    Case(
        "a run that links to itself",
        program("play", "--load_run", "itself"),
        "no run with a checkpoint 'itself'",
        given=strange_folders,
    ),
    Case("a dangling run", program("train", "--resume", "--load_run", "dangling"), "'dangling'", given=strange_folders),
    Case("a dangling checkpoint", program("play", "--checkpoint", "9"), "no checkpoint 9 in ", given=strange_folders),
    Case(
        "a run without config", program("play", "--load_run", "good"), "config.yaml: cannot read", given=strange_folders
    ),
]


@pytest.mark.parametrize("case", FOLDERS, ids=lambda case: case.id)
def test_folders(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)


# ---- contracts


def export(root: Path) -> Path:
    folder = root / "out"
    folder.mkdir()
    for name in ("policy.yaml", "policy.onnx", "scene.xml", "config.yaml"):
        shutil.copy(SHIPPED / name, folder)
    return folder


def says_else(change: Change, stamped: bool = True) -> Callable[[Path], None]:
    """An export whose contract was changed, with a checksum of the whole, so that the value alone can be what is refused."""

    def given(root: Path) -> None:
        said = load_yaml(export(root) / "policy.yaml")
        said["checksum"] = checksum(said)
        change(said)
        save_yaml(root / "out/policy.yaml", said | ({"checksum": checksum(said)} if stamped else {}))

    return given


def swap(*path: str) -> Change:
    """Exchange the first two of a list."""

    def change(said: Any) -> None:
        for place in path:
            said = said[place]
        said[0], said[1] = said[1], said[0]

    return change


CHANGED = "policy.yaml was changed in what the network was trained with"
CONTRACTS: list[tuple[str, Change, str, bool]] = [
    ("default pose of 10^9", set_at("default_pose|0", 1e9), "'default_pose' is [1000000000.0, ", True),
    ("default pose is NaN", set_at("default_pose|0", float("nan")), "'default_pose' is [nan, ", True),
    ("default pose of 38 digits", set_at("default_pose|0", 10**38), "'default_pose' is ", True),
    ("clip of 10^9", set_at("action|clip", 1e9), "action: 'clip' is 1000000000.0; it must be a number", True),
    ("clip of 0", set_at("action|clip", 0), "action: 'clip' is 0; it must be above zero", True),
    ("scale of 0", set_at("action|scale", 0.0), "action: 'scale' is 0.0; it must be other than 0", True),
    (
        "scale of 10^12",
        set_at("action|scale", 1e12),
        "action: 'scale' is 1000000000000.0; it must be of 1e+06 at most",
        True,
    ),
    ("scale of a row", set_at("observation|0|scale", 1e30), "observation[0]: 'scale' is 1e+30", True),
    (
        "highest below lowest",
        set_at("commands|0|highest", -9.0),
        "commands[0]: 'highest' is -9.0; it must be a number from -1.5",
        True,
    ),
    ("stiffness below 0", set_at("stiffness|3", -35.0), "'stiffness' is [35.0", True),
    ("damping of 10^9", set_at("damping|3", 1e9), "it must be numbers from 0 to 1e+06", True),
    (
        "period of a day",
        lambda said: said.update(period=86400.0, physics={"timestep": 8640.0, "decimation": 10}),
        "'period' is",
        True,
    ),
    (
        "decimation of 10^9",
        set_at("physics|decimation", 10**9),
        "'decimation' is 1000000000; it must be 10000 at most",
        True,
    ),
    ("timestep of 0", set_at("physics|timestep", 0), "'timestep' is 0; it must be above zero", True),
    (
        "a scene elsewhere",
        set_at("physics|file", "../../etc/passwd"),
        "physics: 'file' is '../../etc/passwd'; it must be scene.xml",
        True,
    ),
    (
        "a network elsewhere",
        set_at("network|file", "/tmp/policy.onnx"),
        "network: 'file' is '/tmp/policy.onnx'; it must be",
        True,
    ),
    (
        "a row of 10^12 values",
        set_at("observation|0|size", 10**12),
        "'size' is 1000000000000; it must be 10000000 at most",
        True,
    ),
    ("a history of 10^9", set_at("observation|0|history", 10**9), "'history' is 1000000000; it must be ", True),
    ("mass of 10^300", set_at("robot|mass", 1e300), "'mass' is 1e+300; it must be a number", True),
    ("noise below 0", set_at("observation|0|noise", -1.0), "'noise' is -1.0; it must be a number from 0", True),
    ("no joints", set_at("joints", []), "'joints' is []; it must be a list of names", True),
    ("joints are numbers", set_at("joints", [1, 2]), "'joints' is [1, 2]; it must be a list of names", True),
    ("a joint twice", set_at("joints|0", "FL_hip_joint"), "it must be names, each once", True),
    ("no rows", set_at("observation", []), "'observation' is []", True),
    ("a mapping of rows", set_at("observation", {"a": 1}), "'observation' is {'a': 1}", True),
    ("of another format", set_at("format", 99), "'format' is 99", True),
    (
        "memory of 10^18",
        set_at("network|memory", {"input": "a", "output": "b", "shape": [10**9, 10**9]}),
        "it must be 10000000 values",
        True,
    ),
    ("a row of another size", set_at("observation|0|size", 4), "has size 4; ", True),
    ("joints in another order", swap("joints"), CHANGED, False),
    ("rows in another order", swap("observation"), CHANGED, False),
    ("another default pose", swap("default_pose"), CHANGED, False),
    ("another scale", set_at("action|scale", 0.25), CHANGED, False),
    ("another scale of a row", set_at("observation|0|scale", 2.0), CHANGED, False),
    ("another clip", set_at("action|clip", 3.0), CHANGED, False),
    ("commands in another order", swap("commands"), CHANGED, False),
    ("a checksum of text", set_at("checksum", "none"), CHANGED, False),
    ("no checksum", lambda said: said.pop("checksum"), "policy.yaml has no line `checksum`", False),
    ("today's format as an older one", set_at("format", 4), CHANGED, False),
    ("targets without an end", set_at("action|highest|0", 1e9), "action: 'highest' is [1000000000.0, ", True),
    ("targets that end before they begin", set_at("action|highest|0", -9.0), "it must be at least `lowest`", True),
    (
        "a terrain elsewhere",
        set_at("physics|terrain", {"file": "../x.mjz", "sha256": ""}),
        "it must be terrain.mjz, which lies",
        True,
    ),
]


@pytest.mark.parametrize(
    ("change", "says", "stamped"), [entry[1:] for entry in CONTRACTS], ids=[entry[0] for entry in CONTRACTS]
)
def test_contracts(change: Change, says: str, stamped: bool, tmp_path: Path) -> None:
    attack(
        Case("", lambda root: read_contract(root / "out"), ("policy.yaml", says), given=says_else(change, stamped)),
        tmp_path,
    )


def test_joints_of_an_export_without_checksum(tmp_path: Path) -> None:
    """That the user edited: the scene beside it tells."""
    said = load_yaml(export(tmp_path) / "policy.yaml")
    said.pop("checksum", None)
    swap("joints")(said)
    save_yaml(tmp_path / "out/policy.yaml", said)
    says = "joints are in another order than sensors"
    attack(Case("", lambda root: read_scene(root / "out", read_contract(root / "out", edited=True)), says), tmp_path)


def test_what_may_be_changed(tmp_path: Path) -> None:
    def change(said: Any) -> None:
        said |= {"task": "mine", "ends": {}, "safety": {"speed": 30}, "exam": {}}

    says_else(change, stamped=False)(tmp_path)
    assert read_contract(tmp_path / "out").task == "mine"


# ---- motions and motors

CLIP = {
    "fps": 50.0,
    "joint_names": ["a"],
    "root_pos": np.zeros((3, 3)),
    "root_quat": np.eye(4)[[0, 0, 0]],
    "joint_pos": np.zeros((3, 1)),
}
MOTOR = {"weight0": np.zeros((1, 2)), "bias0": np.zeros(1)}
ARRAYS: list[tuple[str, Callable[[Path], Any], dict[str, Any], str]] = [
    ("no rate", read_clip, {"fps": np.nan}, "or no frame rate"),
    ("a rate of 10^30", read_clip, {"fps": 1e30}, "1e+30 frames a second; there must be from 0.1 to 1e+05"),
    ("two rates", read_clip, {"fps": [50.0, 50.0]}, "fps is float64 along 1 axes; it must be numbers along 0 axes"),
    (
        "joints are numbers",
        read_clip,
        {"joint_names": [1]},
        "joint_names is int64 along 1 axes; it must be text along 1 axes",
    ),
    ("complex places", read_clip, {"root_pos": np.zeros((3, 3)) * 1j}, "root_pos is complex128 along 2 axes"),
    ("far away", read_clip, {"root_pos": np.full((3, 3), 1e30)}, "a place or an angle beyond 10000 m or rad"),
    ("a joint twice", read_clip, {"joint_names": ["a", "a"], "joint_pos": np.zeros((3, 2))}, "or a joint twice"),
    (
        "more than there may be",
        read_clip,
        {"more": np.zeros(70_000, dtype=np.uint8)},
        "it unpacks to 0 MiB; 0 are the most",
    ),
    ("frames of 10^9", read_network, {"frames": [0, 10**9]}, "the newest first, 10000 at most"),
    ("infinite frames", read_network, {"frames": [np.inf]}, "file.npz: cannot convert float infinity"),
]


@pytest.mark.parametrize(
    ("read", "change", "says"), [entry[1:] for entry in ARRAYS], ids=[entry[0] for entry in ARRAYS]
)
def test_arrays(
    read: Callable[[Path], Any], change: dict[str, Any], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "MOST_UNPACKED", 1 << 16)
    content = (CLIP if read is read_clip else MOTOR) | {name: np.asarray(value) for name, value in change.items()}
    attack(
        Case(
            "",
            lambda root: read(root / "file.npz"),
            says,
            given=lambda root: np.savez(root / "file.npz", allow_pickle=False, **content),
        ),
        tmp_path,
    )


# ---- scenes


def in_scene(old: str, new: str) -> Callable[[Path], None]:
    def given(root: Path) -> None:
        file = export(root) / "scene.xml"
        assert old in file.read_text()
        file.write_text(file.read_text().replace(old, new, 1))

    return given


KEY = 'qpos="0 0 0.278'
SCENES: list[tuple[str, str, str, str]] = [
    ("NaN gravity", "<option", '<option gravity="0 0 nan"', 'gravity="0 0 nan" is not a number'),
    ("gravity of 10^9", "<option", '<option gravity="0 0 -1e9"', "gravity is 0 0 -1e+09 m/s^2"),
    ("infinite gravity", "<option", '<option gravity="0 0 inf"', "gravity is 0 0 inf"),
    ("no gravity", "<option", '<option gravity="0 0 0"', "it has no gravity, so no direction is down"),
    ("keyframe under the ground", KEY, 'qpos="0 0 -3', "its first keyframe is 3.3 m under the ground"),
    ("keyframe is NaN", KEY, 'qpos="nan 0 0.278', "is not a number"),
    ("keyframe is infinite", KEY, 'qpos="inf 0 0.278', "key_qpos has values that are not finite"),
    ("keyframe far away", KEY, 'qpos="1e9 0 0.278', "its first keyframe is no pose"),
    ("negative timestep", 'timestep="0.004"', 'timestep="-0.004"', "timestep is -0.004 s"),
    ("entities", "<mujoco", '<!DOCTYPE m [<!ENTITY a "b">]><mujoco', "it has a DOCTYPE"),
    (
        "include",
        "</worldbody>",
        '</worldbody><include file="../../etc/passwd"/>',
        "it names ../../etc/passwd, which lies outside",
    ),
    (
        "a mesh",
        "</worldbody>",
        '</worldbody><asset><mesh file="../x.stl"/></asset>',
        "it names ../x.stl, which lies outside of its own folder",
    ),
    (
        "folder of meshes",
        "<compiler",
        '<compiler meshdir="/home"',
        "it names /home, which lies outside of its own folder; an export stands alone",
    ),
    ("mass of 10^30", 'mass="5.204"', 'mass="1e30"', 'mass="1e30" must be from 0 to 100000'),
    ("a range that ends before it begins", ' range="-0.863 0.863"', ' range="0.863 -0.863"', "ends before it begins"),
    ("no keyframe", "<key name", "<!-- <key name", "scene.xml is not a valid MJCF"),
]


@pytest.mark.parametrize(("old", "new", "says"), [entry[1:] for entry in SCENES], ids=[entry[0] for entry in SCENES])
def test_scenes(old: str, new: str, says: str, tmp_path: Path) -> None:
    run = lambda root: read_scene(root / "out", read_contract(root / "out", edited=True))  # noqa: E731
    attack(Case("", run, ("scene.xml", says), given=in_scene(old, new)), tmp_path)


# ---- networks


def network(*nodes: Any, constants: Sequence[Any] = ()) -> Callable[[Path], None]:
    """An export whose network is these nodes, from "obs" (batch, 48) to "actions" (batch, 12); "short" is obs without its end."""

    def given(root: Path) -> None:
        folder = export(root)
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
        onnx.save(
            helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), folder / "policy.onnx"
        )
        said = load_yaml(folder / "policy.yaml")
        said["network"]["sha256"] = digest(folder / "policy.onnx")
        save_yaml(folder / "policy.yaml", said | {"checksum": checksum(said)})

    return given


def endless() -> Callable[[Path], None]:
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


def vast(count: int) -> Callable[[Path], None]:
    """Adds up ``count`` zeros."""
    nodes = [
        helper.make_node(
            "ConstantOfShape", ["size"], ["zeros"], value=helper.make_tensor("v", TensorProto.FLOAT, [1], [0.0])
        ),
        helper.make_node("ReduceSum", ["zeros"], ["sum"], keepdims=0),
        helper.make_node("Add", ["short", "sum"], ["actions"]),
    ]
    return network(*nodes, constants=[helper.make_tensor("size", TensorProto.INT64, [1], [count])])


NETWORKS: list[tuple[str, Callable[[Path], None], str]] = [
    (
        "NaN",
        network(helper.make_node("Div", ["short", "short"], ["actions"])),
        "for an observation of zeros is what is not",
    ),
    ("infinity", network(helper.make_node("Reciprocal", ["short"], ["actions"])), "is what is not finite"),
    ("never ends", endless(), "policy.onnx cannot be run: its first call takes longer than 0.5 s"),
    ("400 GB", vast(10**11), "policy.onnx cannot be run: it asks for more than 2 GiB"),
    ("4 GB", vast(10**9), "policy.onnx cannot be run: it asks for more than 2 GiB"),
    ("10^18 numbers", vast(10**18), "policy.onnx cannot be "),
    ("another width", network(helper.make_node("Concat", ["short", "short"], ["actions"], axis=1)), "policy.onnx"),
    (
        "another input",
        network(helper.make_node("Add", ["short", "nosuch"], ["actions"])),
        "cannot be read as an ONNX network",
    ),
]


@pytest.mark.parametrize(("given", "says"), [entry[1:] for entry in NETWORKS], ids=[entry[0] for entry in NETWORKS])
def test_networks(given: Callable[[Path], None], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy, "_FIRST_SECONDS", 0.5)
    attack(Case("", lambda root: Network(root / "out", read_contract(root / "out")), says, given=given), tmp_path)


def test_a_network_that_is_one(tmp_path: Path) -> None:
    network(helper.make_node("Neg", ["short"], ["actions"]))(tmp_path)
    acts = Network(tmp_path / "out", read_contract(tmp_path / "out"))
    np.testing.assert_array_equal(acts(np.ones((3, 48), dtype=np.float32)), -np.ones((3, 12)))


# ---- an export that is killed


class _Killed(BaseException):
    """Not an error that anything mends."""


def move_in(folder: Path, new: Path, last: int) -> int:
    """An export of the files in ``new`` to ``folder``, killed before the call ``last`` of the file system; returns how many it makes."""
    from legged_mw.export.exporter import _all_or_nothing

    calls, real = 0, {name: getattr(os, name) for name in ("replace", "unlink", "rmdir", "mkdir", "open", "fsync")}

    def counted(name: str) -> Callable[..., Any]:
        def call(*args: Any, **more: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls >= last:
                raise _Killed  # and whatever follows, as finally does, has no effect either
            return real[name](*args, **more)

        return call

    with pytest.MonkeyPatch.context() as patch:
        if last < 10**6:
            patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        for name in real:
            patch.setattr(os, name, counted(name))
        with pytest.raises(_Killed) if last < 10**6 else contextlib.nullcontext(), _all_or_nothing(folder) as made:
            for file in new.iterdir():
                (made / file.name).write_bytes(file.read_bytes())
    return calls


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def _made(root: Path, task: str, extra: bool) -> Path:
    """An export, as a policy that is called ``task``; with or without the file of a terrain."""
    folder = export(root)
    said = load_yaml(folder / "policy.yaml")
    save_yaml(folder / "policy.yaml", said | {"task": task})
    (folder / "config.yaml").write_text(f"task: {task}\n")
    if extra:
        (folder / "terrain.mjz").write_text(task)
    return folder.rename(root / task)


@pytest.mark.parametrize("extra", [True, False])
def test_killed_exports(tmp_path: Path, extra: bool) -> None:
    """At every call: afterwards there is the old export or the new one, whole, and a next start leaves nothing of the kill behind."""
    old, new = _made(tmp_path, "old", not extra), _made(tmp_path, "new", extra)
    (old / "terrain.xml").write_text("of an older version")
    wanted = {"old": _contents(old), "new": _contents(new)}
    shutil.copytree(old, tmp_path / "count")
    count, seen = move_in(tmp_path / "count", new, 10**6), []
    assert _contents(tmp_path / "count") == wanted["new"] and count > 12
    for last in range(1, count + 1):
        folder = Path(shutil.copytree(old, tmp_path / f"out{last}"))
        (folder / "README.md").write_text("mine")
        move_in(folder, new, last)
        seen.append(read_contract(folder).task)
        held = _contents(folder)
        assert held.pop("README.md") == b"mine" and held == wanted[seen[-1]], last
        move_in(folder, new, 10**6)
        assert _contents(folder).keys() == {*wanted["new"], "README.md"}
        left = [path for path in folder.iterdir() if path.is_dir() and path.name != f".export.{os.getpid()}.tmp"]
        assert not left, last
    # first the old one, from one call on the new
    assert seen == sorted(seen, reverse=True) and {*seen} == {"old", "new"}


def test_what_a_killed_export_leaves_is_swept(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    old, new = _made(tmp_path, "old", False), _made(tmp_path, "new", False)
    for name in (f".export.{gone.pid}.tmp", f".export.{os.getppid()}.tmp"):
        (old / name).mkdir()
        (old / name / "policy.yaml").write_text("half")
    (old / f".config.yaml.{gone.pid}.tmp").write_text("half")
    (old / ".mine.tmp").write_text("mine")
    move_in(old, new, 10**6)
    left = {path.name for path in old.iterdir() if path.name.startswith(".")} - {f".export.{os.getpid()}.tmp"}
    assert left == {f".export.{os.getppid()}.tmp", ".mine.tmp"}  # of a process that lives, and nobody's


def test_a_staged_export_that_is_a_link_moves_nothing(tmp_path: Path) -> None:
    old, mine = _made(tmp_path, "old", False), tmp_path / "mine"
    mine.mkdir()
    (mine / "letter").write_text("dear")
    (old / ".export.new").symlink_to(mine)
    assert read_contract(old).task == "old" and (mine / "letter").exists()
