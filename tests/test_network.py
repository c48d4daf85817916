"""A policy read back from policy.onnx, whole or at half precision: the very policy that was exported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
import torch
from onnx import numpy_helper
from program import run
from rsl_rl.models import MLPModel
from tensordict import TensorDict
from worlds import make_env

from legged_mw import ROOT
from legged_mw.deploy import contract
from legged_mw.deploy.stage import DeployStage
from legged_mw.export.exporter import Exported, export
from legged_mw.export.network import run_onnx, save_onnx
from legged_mw.rl import policies
from legged_mw.rl.policies import act, load_policy
from legged_mw.rl.run_folder import update_from_run
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.task import LoadedTask, load_task

SHIPPED = ROOT / "resources/policies/go1_flat"
OBS = torch.randn(500, 48, generator=torch.Generator().manual_seed(0)) * 2.0


def task_of(folder: Path) -> LoadedTask:
    task = load_task("go1_flat")
    update_from_run(task, load_yaml(folder / "config.yaml"), "config.yaml")
    return task


def loaded(file: Path, folder: Path) -> MLPModel:
    return load_policy(file, make_env(1), task_of(folder).train, "cpu")


def actions(policy: MLPModel) -> torch.Tensor:
    return act(policy, TensorDict({"state": OBS}, batch_size=[len(OBS)]))


@pytest.fixture(scope="module")
def exact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The network of a policy that walks, with weights that float16 does not hold."""
    policy, file = loaded(SHIPPED / "policy.onnx", SHIPPED), tmp_path_factory.mktemp("exact") / "policy.onnx"
    draw = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, value in policy.named_parameters():
            if name.endswith(".weight"):
                value.mul_(1.0 + 3e-4 * torch.randn(value.shape, generator=draw))
    save_onnx(policy, 2.0, file)
    return file


@pytest.fixture(scope="module")
def half(exact: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Exported]:
    folder = tmp_path_factory.mktemp("half") / "out"
    return folder, export(task_of(SHIPPED), exact, folder, half=True)


def test_the_policy_of_an_export_is_the_one_of_the_checkpoint(made: Path) -> None:
    """Bit for bit: weights, biases, mean, and every action, though the file holds std + eps and not std."""
    ours, theirs = loaded(made / "policy.onnx", made), loaded(made.parent / "model_2.pt", made)
    mine, other = ours.state_dict(), theirs.state_dict()
    same = [name for name in other if name.startswith("mlp.") or name == "obs_normalizer._mean"]
    assert (
        len(same) == 7
        and all(torch.equal(mine[name], other[name]) for name in same)
        and mine["obs_normalizer._mean"].any()
    )
    torch.testing.assert_close(mine["obs_normalizer._std"], other["obs_normalizer._std"], rtol=1e-6, atol=1e-8)
    assert torch.equal(actions(ours), actions(theirs)) and policies.NETWORK_FILE == contract.NETWORK_FILE


def test_an_export_is_played_by_its_path(made: Path, tmp_path: Path) -> None:
    """--task is read from it; what is exported again is the same file."""
    result = run("play", tmp_path, "--load_run", str(made), "--device", "cpu", "--export", str(tmp_path / "again"))
    assert result.code == 0 and result.out.startswith(f"policy: {made}/policy.onnx\n"), result.err
    assert (tmp_path / "again/policy.onnx").read_bytes() == (made / "policy.onnx").read_bytes()
    task = load_task("go1_flat")
    assert policies.find_rival(task, str(made)) == policies.PolicySource(made, made / "policy.onnx", shipped=False)


def test_half_precision_halves_the_file_and_acts_alike(exact: Path, half: tuple[Path, Exported]) -> None:
    folder, exported = half
    assert (folder / "policy.onnx").stat().st_size < 0.51 * exact.stat().st_size
    graph = onnx.load(folder / "policy.onnx").graph
    onnx.checker.check_model(str(folder / "policy.onnx"), full_check=True)
    types = {tensor.name: numpy_helper.to_array(tensor).dtype for tensor in graph.initializer}
    assert {name for name, dtype in types.items() if dtype == np.float16} == {
        f"policy.mlp.{layer}.weight" for layer in (0, 2, 4, 6)
    }
    whole, rounded = loaded(exact, SHIPPED), loaded(folder / "policy.onnx", folder)
    for name, value in whole.state_dict().items():
        expected = value.half().float() if name.endswith(".weight") else value
        assert name.startswith("distribution.") or torch.equal(rounded.state_dict()[name], expected), name
    wanted, got = actions(whole).clamp(-2.0, 2.0), actions(rounded).clamp(-2.0, 2.0)
    # float32 sums in another order
    np.testing.assert_allclose(run_onnx(folder / "policy.onnx", OBS.numpy()), got, atol=1e-5)
    assert 1e-4 < (got - wanted).abs().max() < 0.02  # of 2; float16 has 11 bits
    assert 1e-5 < exported.gap < 0.01
    text = exported.text(folder)
    assert (
        f"its weights rounded to half precision; actions differ from the trained policy's by {exported.gap:.0e} at most"
        in text
    )


def test_half_precision_is_deployed(half: tuple[Path, Exported]) -> None:
    stage = DeployStage(half[0], 2)
    for _ in range(5):
        stage.step(None)
    assert not stage.fell().any()


def renamed(model: Any) -> None:
    for tensor in model.graph.initializer:
        tensor.name = tensor.name.replace("policy.", "net.")


def undivided(model: Any) -> None:
    for node in model.graph.node:
        node.op_type = "Mul" if node.op_type == "Div" else node.op_type


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (
            renamed,
            r"is no network that this project exported: its weights are called net.mlp.0.weight, .*, not policy.mlp.0.weight \.\.\.",
        ),
        (undivided, r"is no network that this project exported: it does not begin with \(obs - mean\) / std"),
        (
            lambda model: model.graph.initializer.pop(0),
            r"does not fit this task: actor mlp.0.weight is missing there and \(512, 48\) here",
        ),
    ],
)
def test_another_network_is_refused(change: Any, text: str, tmp_path: Path) -> None:
    model = onnx.load(SHIPPED / "policy.onnx")
    change(model)
    onnx.save(model, tmp_path / "policy.onnx")
    with pytest.raises(ConfigError, match=f"policy.onnx {text}"):
        loaded(tmp_path / "policy.onnx", SHIPPED)


def test_a_file_that_is_missing_damaged_or_of_another_task(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no policy at .*policy.onnx"):
        loaded(tmp_path / "policy.onnx", SHIPPED)
    (tmp_path / "policy.onnx").write_bytes((SHIPPED / "policy.onnx").read_bytes()[:5000])
    with pytest.raises(ConfigError, match="policy.onnx cannot be read as an ONNX network: it is damaged"):
        loaded(tmp_path / "policy.onnx", SHIPPED)
    with pytest.raises(ConfigError, match=r"does not fit this task: actor .* is \(.*243\) there and \(.*48\) here"):
        loaded(ROOT / "resources/policies/go1_rough_scan/policy.onnx", SHIPPED)
