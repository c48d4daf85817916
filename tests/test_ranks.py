"""Several processes that learn together, as torchrun starts them; on a CPU they talk through gloo."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from learner import difference

from legged_mw import ROOT
from legged_mw.rl.ranks import Rank, rank_device, this_rank
from legged_mw.rl.run_folder import checkpoints
from legged_mw.utils.cli import command
from legged_mw.utils.config import load_yaml

LAUNCH = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node=2"]
_PATHS = [str(ROOT), str(ROOT / "tests"), *filter(None, [os.environ.get("PYTHONPATH")])]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(_PATHS), "OMP_NUM_THREADS": "1"}


def launch(*words: str, cwd: Path = ROOT) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*LAUNCH, *words], cwd=cwd, env=ENVIRONMENT, capture_output=True, text=True, timeout=1200)


def learn(place: Path, *parts: str, on: str = "cpu") -> subprocess.CompletedProcess[str]:
    """Do parts of ranks_program.py, one after the other; each writes into a folder of its name in ``place``."""
    for part in parts:
        (place / part).mkdir()
    return launch(str(ROOT / "tests/ranks_program.py"), str(place), on, *parts)


def ends(folder: Path) -> list[dict[str, Any]]:
    return [torch.load(folder / f"rank{i}.pt", weights_only=False) for i in (0, 1)]


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of parts that all ranks survive: two processes do them all, since a start costs more than they do."""
    folder = tmp_path_factory.mktemp("ranks")
    result = learn(folder, "learns", "asked", "updates")
    assert result.returncode == 0, result.stderr
    return folder


@pytest.fixture(scope="module")
def ours(parts: Path) -> Path:
    # the other rank has no folder here
    written = ["model_1.pt", "model_2.pt", "model_3.pt", "rank0.pt", "rank1.pt", "worlds_3_0of2.pt"]
    assert sorted(path.name for path in (parts / "learns").glob("*.pt")) == written
    return parts / "learns"


def test_ranks_learn_one_policy_from_worlds_of_their_own(ours: Path) -> None:
    one, other = ends(ours)
    assert difference(one["parameters"], other["parameters"]) == 0.0 and one["rate"] == other["rate"]
    assert not torch.equal(one["obs"], other["obs"])
    assert one["iteration"] == other["iteration"] == 3 and one["steps"] == other["steps"] == 2 * 3 * 12 * 8


def test_ranks_anneal_by_the_first_ones_clock(ours: Path) -> None:
    one, other = ends(ours)
    assert one["done"] == other["done"] == pytest.approx([0.0, 0.5, 1.0])


def test_statistics_are_of_all_ranks(ours: Path) -> None:
    one, other = ends(ours)
    assert one["means"] == other["means"] and one["means"]["episodes"] > 0


def check_updates(folder: Path) -> None:
    """On each of two ranks, from equal states and experience of its own: averaged gradients, KL divergence, rate and normalisers."""
    one, other = ends(folder)
    assert difference(one["parameters"], other["parameters"]) == 0.0 and not torch.equal(one["obs"], other["obs"])
    for end in (one, other):
        for update in end["updates"]:
            assert update["difference"] < 1e-4
            assert update["rates"][0] == pytest.approx(update["rates"][1], rel=1e-6)


def test_same_update_as_rsl_rls_own_on_two_ranks(parts: Path) -> None:
    check_updates(parts / "updates")


def test_one_asked_to_stop_stops_all(parts: Path) -> None:
    """Until then they learned one policy, with the estimator that these have."""
    one, other = ends(parts / "asked")
    assert (one["stop"], other["stop"]) == ("another rank was asked to", "asked")
    assert one["iteration"] == other["iteration"] == 1
    assert difference(one["parameters"], other["parameters"]) == 0.0
    assert (
        one["parameters"]["actor.target_normalizer.count"] == 2 * 12 * 8
        and "actor.estimator.0.weight" in one["parameters"]
    )


def test_train_writes_one_run_folder(tmp_path: Path) -> None:
    small = ["--num_envs", "8", "--set", "actor.hidden_dims=[16]", "--set", "critic.hidden_dims=[16]"]
    small += ["--experiment_name", "runs", "--max_iterations", "2", "--seed", "4"]
    result = launch(str(ROOT / "train.py"), "--task", "go1_flat", "--device", "cpu", *small, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    [folder] = (tmp_path / "logs/runs").iterdir()
    assert {"config.yaml", "model_2.pt"} <= {path.name for path in folder.iterdir()}
    assert sorted(path.name for path in folder.glob("worlds_*")) == ["worlds_2_0of2.pt", "worlds_2_1of2.pt"]
    assert load_yaml(folder / "config.yaml")["seed"] == 4
    assert result.stdout.count("Learning iteration 2/2") == result.stdout.count("policy.onnx") == 1
    assert (folder / "export/policy.yaml").is_file()
    assert "8 worlds on each of 2 processes" in result.stdout
    assert (
        torch.load(folder / "model_2.pt", weights_only=True)["infos"]["total_steps"]
        == 2 * 2 * 8 * load_yaml(folder / "config.yaml")["runner"]["num_steps_per_env"]
    )
    (folder / "worlds_2_1of2.pt").unlink()  # of one rank: then all begin anew
    again = ["--experiment_name", "runs", "--max_iterations", "3", "--resume", "--set", "runner.export=false"]
    result = launch(str(ROOT / "train.py"), "--task", "go1_flat", "--device", "cpu", *again, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "worlds begin anew (rank 1: there is no worlds_2_1of2.pt beside it); networks, " in result.stdout


def test_a_rank_that_dies_ends_the_run(tmp_path: Path) -> None:
    """The other does not wait for ever, and what was saved can be loaded."""
    folder = tmp_path / "dies-2"
    result = learn(tmp_path, "dies-2")
    assert result.returncode != 0
    newest = max(checkpoints(folder))
    assert newest in (1, 2)  # the second is on its way to the disk while the other rank dies
    saved, beside = (
        torch.load(folder / f"{name}.pt", weights_only=True) for name in (f"model_{newest}", f"worlds_{newest}_0of2")
    )
    assert saved["iter"] == newest and torch.equal(saved["infos"]["random_state"]["cpu"], beside["random_state"]["cpu"])


def test_a_rank_that_waits_for_a_lost_one_leaves_after_sigterm() -> None:
    """Its own handler only notes the signal, and it would sleep for a minute; alone, nothing of that happens."""
    program = """
import signal, sys, time
from legged_mw.rl.ranks import Rank, leave_when_stuck
signal.signal(signal.SIGTERM, lambda *_: None)
leave_when_stuck(Rank(1, 1, int(sys.argv[1])), patience=0.3)
print("ready", flush=True)
time.sleep(60.0 if sys.argv[1] == "2" else 3.0)
"""
    for count, code, said in (
        ("2", 143, "rank 1: still waiting for another rank 0.3 s after SIGTERM; leaving."),
        ("1", 0, ""),
    ):
        child = subprocess.Popen(
            [sys.executable, "-c", program, count], env=ENVIRONMENT, stdout=-1, stderr=-1, text=True
        )
        assert child.stdout is not None and child.stdout.readline() == "ready\n"
        child.send_signal(signal.SIGTERM)
        _, errors = child.communicate(timeout=1200)
        assert child.returncode == code and said in errors


def test_rank_is_read_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("RANK", "LOCAL_RANK", "WORLD_SIZE"):
        monkeypatch.delenv(name, raising=False)
    assert this_rank() == Rank(0, 0, 1) and this_rank().leads
    for name, value in (("RANK", "9"), ("LOCAL_RANK", "1"), ("WORLD_SIZE", "16")):
        monkeypatch.setenv(name, value)
    assert this_rank() == Rank(9, 1, 16) and not this_rank().leads
    monkeypatch.delenv("WORLD_SIZE")
    assert this_rank() == Rank(0, 0, 1)  # a RANK left over from elsewhere is no run of several


def test_the_line_that_resumes_starts_as_many_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["train.py"])
    assert command("train") == "python train.py" and command("train", 2) == "torchrun --nproc_per_node=2 train.py"
    for name, value in (("GROUP_WORLD_SIZE", "2"), ("MASTER_ADDR", "10.0.0.1")):
        monkeypatch.setenv(name, value)
    nodes = "--nnodes=2 --node_rank=N --master_addr=10.0.0.1 --nproc_per_node=8"
    assert command("train", 16) == f"torchrun {nodes} train.py"


def test_each_rank_gets_its_own_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert rank_device(Rank(0, 0, 1), None) is None and rank_device(Rank(0, 0, 1), "cuda:1") == "cuda:1"
    assert rank_device(Rank(3, 1, 4), None) == "cuda:1" and rank_device(Rank(3, 1, 4), "cpu") == "cpu"


@pytest.mark.two_gpus
def test_two_gpus_learn_one_policy(tmp_path: Path) -> None:
    """Through NCCL inside the recorded update: equal on both ranks after eight iterations."""
    result = learn(tmp_path, "learns", on="gpus")
    assert result.returncode == 0, result.stderr
    assert "does not close" not in result.stderr
    one, other = ends(tmp_path / "learns")
    assert difference(one["parameters"], other["parameters"]) == 0.0 and one["rate"] == other["rate"]
    assert not torch.equal(one["obs"], other["obs"]) and one["means"] == other["means"]


@pytest.mark.two_gpus
def test_same_update_as_rsl_rls_own_on_two_gpus(tmp_path: Path) -> None:
    result = learn(tmp_path, "updates", on="gpus")
    assert result.returncode == 0, result.stderr
    check_updates(tmp_path / "updates")


@pytest.mark.two_gpus
def test_on_two_gpus_a_rank_that_dies_ends_the_run(tmp_path: Path) -> None:
    result = learn(tmp_path, "dies-6", on="gpus")
    assert result.returncode != 0
    newest = max(int(file.stem.partition("_")[2]) for file in (tmp_path / "dies-6").glob("model_*.pt"))
    assert newest >= 5  # of the sixth update, the dying rank's share may still have been on its way
    assert torch.load(tmp_path / f"dies-6/model_{newest}.pt", weights_only=True)["iter"] == newest
