"""examples/cpp: the same observations, actions and targets as Python's controller, and what it refuses.

Where onnxruntime's headers are missing the network's actions are the record's own; everything around it is compared all the same.
`ORT_INCLUDE=DIR` names a folder with the headers.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
from onnx import TensorProto, helper, numpy_helper

from legged_mw import ROOT
from legged_mw.deploy.contract import checksum
from legged_mw.utils.config import load_yaml, save_yaml

FOLDER, POLICIES = ROOT / "examples/cpp", ROOT / "resources/policies"
COMPILER = os.environ.get("CXX", "g++")
HEADERS = Path(os.environ.get("ORT_INCLUDE", "/usr/include/onnxruntime"))
LIBRARY = next((Path(onnxruntime.__file__).parent / "capi").glob("libonnxruntime.so.*"), None)
NETWORK = (HEADERS / "onnxruntime_cxx_api.h").is_file() and LIBRARY is not None

pytestmark = pytest.mark.skipif(
    not (shutil.which(COMPILER) and shutil.which("make")), reason=f"needs a C++ compiler ({COMPILER}) and make"
)

_spec = importlib.util.spec_from_file_location("cpp_record", FOLDER / "record.py")
assert _spec and _spec.loader
recorder: Any = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(recorder)

Check = Callable[[Path, Path], "subprocess.CompletedProcess[str]"]


@pytest.fixture(scope="module")
def check(tmp_path_factory: pytest.TempPathFactory) -> Check:
    """The compiled program."""
    out = tmp_path_factory.mktemp("cpp")
    library = [f"ORT_INCLUDE={HEADERS}", f"ORT_LIB={LIBRARY}"] if NETWORK else []
    built = subprocess.run(
        ["make", "-C", FOLDER, f"OUT={out}", "CXXFLAGS=-O0 -Wall -Wextra", *library], capture_output=True, text=True
    )
    assert built.returncode == 0 and not built.stderr, built.stderr
    return lambda export, record: subprocess.run(
        [out / "check", export, record], capture_output=True, text=True, timeout=1200
    )


@pytest.fixture(scope="module")
def remembers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """g1_flat with a network of another kind: history, a memory, an estimate, a scale a value, targets that go on from the last."""
    folder = tmp_path_factory.mktemp("export")
    shutil.copy(POLICIES / "g1_flat/scene.xml", folder)
    said = load_yaml(POLICIES / "g1_flat/policy.yaml")
    rows = {row["name"]: row for row in said["observation"]}
    rows["dof_pos"]["history"], rows["gait_clock"]["history"], rows["base_ang_vel"]["scale"] = 3, 2, [0.25, 0.5, 1.0]
    said["action"] |= {"origin": "targets", "scale": [0.01 * (i % 5) for i in range(29)], "clip": 0.5}
    size, rng = sum(row["size"] * row.get("history", 1) for row in said["observation"]), np.random.default_rng(0)
    draw = {"a": (size, 8), "b": (8, 29), "c": (8, 3)}
    weights = [
        numpy_helper.from_array(rng.normal(0.0, 0.3, shape).astype(np.float32), name) for name, shape in draw.items()
    ]
    weights.append(numpy_helper.from_array(np.array([1, 8]), "flat"))
    nodes = [
        helper.make_node("MatMul", ["obs", "a"], ["mixed"]),
        helper.make_node("Add", ["state_in", "mixed"], ["sum"]),
        helper.make_node("Tanh", ["sum"], ["state_out"]),
        helper.make_node("Reshape", ["state_out", "flat"], ["state"]),
        helper.make_node("MatMul", ["state", "b"], ["actions"]),
        helper.make_node("MatMul", ["state", "c"], ["estimate"]),
    ]
    ports = {"obs": [1, size], "state_in": [1, 1, 8], "actions": [1, 29], "state_out": [1, 1, 8], "estimate": [1, 3]}
    values = [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in ports.items()]
    graph = helper.make_graph(nodes, "network", values[:2], values[2:], weights)
    onnx.save(
        helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10), folder / "policy.onnx"
    )
    said["network"]["sha256"] = hashlib.sha256((folder / "policy.onnx").read_bytes()).hexdigest()
    said["network"]["memory"] = {"input": "state_in", "output": "state_out", "shape": [1, 8]}
    said["estimate"] = [{"name": "base_lin_vel", "size": 3, "unit": "m/s", "frame": "body"}]
    save_yaml(folder / "policy.yaml", said | {"checksum": checksum(said)})
    return folder


@pytest.mark.parametrize("name", ["go2_flat", "g1_flat", "go2_rough", "go1_rough_scan", "remembers"])
def test_it_does_what_pythons_controller_does(
    name: str, check: Check, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    folder, record = request.getfixturevalue(name) if name == "remembers" else POLICIES / name, tmp_path / "walk.txt"
    recorder.record(folder, record, steps=130)
    done = check(folder, record)
    assert done.returncode == 0 and ": 130 steps; a step takes median " in done.stdout, done.stdout + done.stderr
    assert done.stdout.endswith("as Python's controller\n") and ("was not found" in done.stdout) != NETWORK
    lines = record.read_text().splitlines()
    head = lines[0].split()
    wanted, targets = np.split(np.loadtxt(record, skiprows=1)[:, -2 * int(head[-1]) :], 2, axis=1)
    assert name != "go2_flat" or (wanted != targets).any(), "it asks for more than its joints' range"
    at = sum(map(int, head[1 : head.index("observation") : 2]))  # the first value of the observation
    row = lines[101].split(" ")
    for value in (f"{float(row[at]) + 1e-3}", "nan"):
        record.write_text("\n".join([*lines[:101], " ".join([*row[:at], value, *row[at + 1 :]]), *lines[102:]]))
        done = check(folder, record)
        assert done.returncode == 1 and done.stdout.endswith("NOT as Python's controller: off by more than 1e-5\n")


@pytest.mark.skipif(not NETWORK, reason="needs onnxruntime's C++ headers: libonnxruntime-dev, or ORT_INCLUDE=DIR")
def test_it_runs_the_network_itself(check: Check, tmp_path: Path) -> None:
    """Another network of the same shape acts in another way; one of another shape is refused."""
    record = tmp_path / "walk.txt"
    recorder.record(POLICIES / "go2_flat", record, steps=10)
    shutil.copytree(POLICIES / "go2_flat", tmp_path / "export")
    for other, code, said in (
        ("go2_rough", 1, "NOT as Python's controller"),
        ("g1_flat", 2, "Got invalid dimensions for input: obs"),
    ):
        shutil.copy(POLICIES / other / "policy.onnx", tmp_path / "export")
        done = check(tmp_path / "export", record)
        assert done.returncode == code and said in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("format: 5", "format: 6", "policy.yaml, line 1: format 6 is not one that this program reads (5)"),
        (
            "format: 5",
            "format: 3",
            "policy.yaml, line 1: format 3 does not say within which range targets are held: export the policy again",
        ),
        ("  lowest:\n", "  least:\n", "'lowest' is missing"),
        ("exam:", "motion:", "the policy follows a motion, which this program cannot"),
        ("period: 0.02\n", "", "'period' is missing"),
        ("period: 0.02", "period: fast", "policy.yaml, line 8: 'fast' is no number"),
        ("origin: default", "origin: pose", "no origin 'pose'; there are: default, joints, targets, torque"),
        ("measured: joint_vel", "measured: ''", "nothing says how row 'dof_vel' is measured, so it cannot be deployed"),
        ("measured: joint_vel", "measured: odometer", "the robot does not measure 'odometer' of row 'dof_vel'"),
        ("- 0.8\n", "", "policy.yaml, line 23: 'default_pose' must have one number a joint"),
        (
            "damping:\n",
            "damping: [1, 2]\nmore:\n",
            "'[1, 2]' is no list; write one as --export does: '- ' and one value a line",
        ),
        ("period: 0.02", "period: 0.02\n  -?", "policy.yaml, line 8: '0.02 -?' is no number"),
        ("joints:\n", "joints:\n?\n", "policy.yaml, line 10: '?' is not understood here"),
    ],
)
def test_what_it_refuses(old: str, new: str, error: str, check: Check, walk: Path, tmp_path: Path) -> None:
    text = (POLICIES / "go2_flat/policy.yaml").read_text()
    (tmp_path / "policy.yaml").write_text(text.replace(old, new, 1))
    (tmp_path / "policy.onnx").write_bytes((POLICIES / "go2_flat/policy.onnx").read_bytes())
    done = check(tmp_path, walk)
    assert done.returncode == 2 and done.stderr.startswith("check: ") and error in done.stderr, done.stderr


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("walk") / "walk.txt"
    recorder.record(POLICIES / "go2_flat", path, steps=2)
    return path


def test_records_that_do_not_fit(check: Check, walk: Path, tmp_path: Path) -> None:
    for content, error in (
        (None, "cannot read .*; record.py writes one"),
        (walk.read_text()[:-40], "a row is cut off"),
        (walk.read_text().splitlines()[0], "holds no step"),
    ):
        record = tmp_path / "record.txt"
        if content is not None:
            record.write_text(content)
        done = check(POLICIES / "go2_flat", record)
        assert done.returncode == 2 and re.search(error, done.stderr), done.stderr
