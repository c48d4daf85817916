"""Training as a user meets it: run folders, checkpoints, stopping, resuming, seeds, and what other programs read of it."""

from __future__ import annotations

import copy
import dataclasses
import logging
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from program import SMALL, Result, assert_equal, load, refused, run, trained
from rsl_rl.runners import OnPolicyRunner
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensordict import TensorDict
from worlds import make_env

from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.export.network import save_onnx
from legged_mw.rl.iteration_log import console_rows, curves
from legged_mw.rl.learner_config import rsl_rl_config
from legged_mw.rl.policies import act, find_policy, find_trained, load_policy
from legged_mw.rl.run_folder import checkpoints, find_checkpoint, find_run, new_run, runs, update_from_run
from legged_mw.rl.runner import Runner, make_runner
from legged_mw.utils.config import ConfigError, load_yaml
from legged_mw.utils.task import LoadedTask, load_task

STEPS = 8 * 16  # env steps in an iteration of the small task


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("train")


@pytest.fixture(scope="module")
def seen_at_start() -> dict[str, bool]:
    return {}


@pytest.fixture(scope="module")
def three(root: Path, seen_at_start: dict[str, bool]) -> Path:
    """A run of three iterations that saved after two as well; read-only for the tests."""
    learn = Runner.learn

    def look_and_learn(self: Runner, *args: Any) -> None:
        assert self.logger.log_dir is not None
        seen_at_start["config"] = (Path(self.logger.log_dir) / "config.yaml").is_file()
        learn(self, *args)
        self.logger.writer.flush()  # type: ignore[union-attr]  (a thread writes the curves)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Runner, "learn", look_and_learn)
        adaptive = ["--set", "algorithm.schedule=adaptive", "--set", "algorithm.learning_rate=1e-3"]
        often = ["--max_iterations", "3", "--set", "runner.save_interval=2"]
        folder = trained(root, *often, *adaptive, "--run_name", "three", "--seed", "4")
    assert not (folder / "export").exists()  # the tests' small task switches it off
    return folder


@pytest.fixture
def copied(three: Path, tmp_path: Path) -> Path:
    """A copy of that run in a tree of its own, tmp_path/logs/go1_flat/run."""
    return Path(shutil.copytree(three, tmp_path / "logs/go1_flat/run"))


def small_task() -> LoadedTask:
    task = load_task("go1_flat")
    for item in SMALL[SMALL.index("--set") + 1 :: 2]:
        task.set(*item.split("=", 1))
    task.set("env.num_envs", 16)
    return task


@pytest.fixture(scope="module")
def env() -> LeggedRobot:
    return LeggedRobot(small_task().cfg, "cpu")


def scalars(folder: Path) -> dict[str, dict[int, list[float]]]:
    """Curve -> iteration -> all values written for it."""
    events = EventAccumulator(str(folder))
    events.Reload()
    curves: dict[str, dict[int, list[float]]] = {}
    for name in events.Tags()["scalars"]:
        for point in events.Scalars(name):
            curves.setdefault(name, {}).setdefault(point.step, []).append(point.value)
    return curves


# ---- what a run leaves behind


def test_run_folder(three: Path, seen_at_start: dict[str, bool]) -> None:
    assert re.fullmatch(r"\d{4}-\d\d-\d\d_\d\d-\d\d-\d\d_three", three.name)
    assert list(checkpoints(three)) == [2, 3]
    assert not [path for path in three.rglob("*") if path.name.endswith(".tmp")]
    assert seen_at_start == {"config": True}  # so that a killed run can be played and resumed


def test_saved_config_is_the_one_that_was_trained(three: Path) -> None:
    saved = load_yaml(three / "config.yaml")
    task = load_task("go1_flat")
    task.update(saved, where="config.yaml")
    assert task.to_dict() == saved
    assert (
        saved["env"]["num_envs"] == 16
        and saved["env"]["episode_length_s"] == 0.4
        and saved["actor"]["hidden_dims"] == [16, 16]
    )
    assert saved["runner"]["max_iterations"] == 3 and saved["runner"]["run_name"] == "three" and saved["seed"] == 4


def test_curves(three: Path) -> None:
    curves = scalars(three)
    terms = [name for name, scale in load_yaml(three / "config.yaml")["rewards"]["scales"].items() if scale]
    assert {f"Episode/rew_{name}" for name in terms} == {name for name in curves if name.startswith("Episode/rew_")}
    for name in (
        "Train/mean_reward",
        "Train/mean_episode_length",
        "Loss/value",
        "Loss/learning_rate",
        "Policy/mean_std",
        "Perf/total_fps",
    ):
        assert list(curves[name]) == [1, 2, 3], name
    assert curves["Train/total_steps"] == {i: [i * STEPS] for i in (1, 2, 3)}
    assert all(0 < value[0] <= 20 for value in curves["Train/mean_episode_length"].values())  # 0.4 s are 20 steps


def test_checkpoint_holds_tensors_and_numbers_only(three: Path) -> None:
    content = load(three / "model_3.pt")  # weights_only refuses anything else
    assert {"actor_state_dict", "critic_state_dict", "optimizer_state_dict", "iter", "infos"} == content.keys()
    assert content["iter"] == 3 and content["infos"]["total_steps"] == 3 * STEPS
    assert content["actor_state_dict"]["obs_normalizer.count"] == 3 * STEPS
    assert not torch.equal(
        content["actor_state_dict"]["mlp.0.weight"], load(three / "model_2.pt")["actor_state_dict"]["mlp.0.weight"]
    )


# ---- resuming


@dataclasses.dataclass
class Start:
    """What a runner holds at the moment it begins to learn."""

    alg: dict[str, Any]
    learning_rate: float
    iteration: int
    total_steps: int
    random_state: torch.Tensor


@pytest.fixture
def starts(monkeypatch: pytest.MonkeyPatch) -> list[Start]:
    """One for every time that a runner begins to learn in this test."""
    learn, seen = Runner.learn, []

    def note_and_learn(self: Runner, *args: Any) -> None:
        alg = copy.deepcopy(self.alg.save())
        seen.append(
            Start(alg, self.alg.learning_rate, self.current_learning_iteration, self.total_steps, torch.get_rng_state())
        )
        learn(self, *args)
        self.logger.writer.flush()  # type: ignore[union-attr]  (a thread writes the curves)

    monkeypatch.setattr(Runner, "learn", note_and_learn)
    return seen


def test_resumed_run_goes_on_where_the_checkpoint_is(copied: Path, tmp_path: Path, starts: list[Start]) -> None:
    result = run("train", tmp_path, "--task", "go1_flat", "--device", "cpu", "--resume", "--max_iterations", "5")
    assert result.code == 0, result.err
    assert f"resuming {copied}/model_3.pt" in result.out
    assert re.findall(r"Learning iteration (\d+/\d+)", result.out) == ["4/5", "5/5"]
    saved, [start] = load(copied / "model_3.pt"), starts
    # the normalisers are in the first two
    for name in ("actor_state_dict", "critic_state_dict", "optimizer_state_dict"):
        assert_equal(start.alg[name], saved[name], name)
    # adapted, not the config's
    assert start.learning_rate == saved["optimizer_state_dict"]["param_groups"][0]["lr"] != 1e-3
    assert torch.equal(start.random_state, saved["infos"]["random_state"]["cpu"])
    assert (start.iteration, start.total_steps) == (3, 3 * STEPS)
    last = load(copied / "model_5.pt")
    assert last["iter"] == 5 and last["infos"]["total_steps"] == 5 * STEPS
    assert last["actor_state_dict"]["obs_normalizer.count"] == 5 * STEPS
    assert list(checkpoints(copied)) == [2, 3, 4, 5]
    assert load_yaml(copied / "config.yaml")["runner"]["max_iterations"] == 5
    curves = scalars(copied)  # of both processes' files: each iteration once, the count of steps unbroken
    assert curves["Train/total_steps"] == {i: [i * STEPS] for i in range(1, 6)}
    assert all(len(values) == 1 for values in curves["Train/mean_reward"].values())


def resumed(folder: Path, checkpoint: str, iterations: str) -> Result:
    """The run in ``folder``, from a checkpoint up to so many iterations."""
    task = ("--task", "go1_flat", "--device", "cpu")
    return run("train", folder, *task, "--resume", "--checkpoint", checkpoint, "--max_iterations", iterations)


def test_an_earlier_checkpoint_can_be_resumed(copied: Path, tmp_path: Path, starts: list[Start]) -> None:
    result = resumed(tmp_path, "2", "3")
    assert result.code == 0, result.err
    assert re.findall(r"Learning iteration (\d+/\d+)", result.out) == ["3/3"]
    assert_equal(starts[0].alg["actor_state_dict"], load(copied / "model_2.pt")["actor_state_dict"])


def test_an_earlier_checkpoint_begins_a_run_of_its_own(copied: Path, tmp_path: Path) -> None:
    """In the old folder its later checkpoints would stand, of another branch, and -1 would pick them."""
    (copied / "model_7.pt").write_bytes((copied / "model_3.pt").read_bytes())
    before = sorted(path.name for path in copied.iterdir())
    result = resumed(tmp_path, "3", "4")
    assert result.code == 0, result.err
    assert sorted(path.name for path in copied.iterdir()) == before
    (branch,) = set(copied.parent.iterdir()) - {copied}
    assert {"model_4.pt", "config.yaml"} <= {path.name for path in branch.iterdir()}


def test_a_stop_in_the_last_iteration_is_the_end(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else the line that resumes would be refused: nothing is left to do."""
    update = Runner._log

    def stop_after(self: Runner, *args: Any) -> None:
        update(self, *args)
        self.stop = "SIGTERM"

    monkeypatch.setattr(Runner, "_log", stop_after)
    result = run("train", tmp_path, *SMALL, "--max_iterations", "1")
    assert result.code == 0, result.err
    assert "\ndone: " in result.out and "go on with" not in result.out


@pytest.mark.parametrize(("schedule", "expected"), [("fixed", 0.25), ("adaptive", 0.001)])
def test_a_fixed_learning_rate_is_the_configs_an_adaptive_one_the_checkpoints(
    schedule: str, expected: float, env: LeggedRobot, tmp_path: Path
) -> None:
    task = small_task()
    task.set("algorithm.learning_rate", 0.001)
    make_runner(env, task.train, None, "cpu").save(str(tmp_path / "model_0.pt"))
    task.set("algorithm.schedule", schedule)
    task.set("algorithm.learning_rate", 0.25)
    resumed = make_runner(env, task.train, None, "cpu")
    resumed.load(str(tmp_path / "model_0.pt"))
    assert resumed.alg.learning_rate == resumed.alg.optimizer.param_groups[0]["lr"] == expected


def copy_world(source: LeggedRobot, target: LeggedRobot) -> None:
    """All that an environment remembers, the simulator's memory included."""
    for name, value in vars(source).items():
        # others are constants, or views of what is copied anyway
        if isinstance(value, torch.Tensor) and value.is_contiguous():
            getattr(target, name).copy_(value)
    for group, obs in source.obs_buf.items():
        target.obs_buf[group].copy_(obs)
    for name in ("qpos", "qvel", "ctrl", "xfrc_applied", "sensordata", "actuator_force", "site_xpos"):
        getattr(target.sim, name).copy_(getattr(source.sim, name))
    target.sim._batch.state[:] = source.sim._batch.state  # type: ignore[attr-defined]


def assert_resumes_exactly(task: LoadedTask, checkpoint: Path) -> tuple[Runner, Runner]:
    """With the worlds' state copied too, which no checkpoint holds, a resumed run is the uninterrupted one, bit for bit: both."""
    torch.manual_seed(0)
    one, two = (LeggedRobot(task.cfg, "cpu") for _ in range(2))
    uninterrupted, resumed = (make_runner(env, task.train, None, "cpu") for env in (one, two))
    uninterrupted.learn(2)
    uninterrupted.save(str(checkpoint))
    copy_world(one, two)
    assert not torch.equal(uninterrupted.alg.get_policy().mlp[0].weight, resumed.alg.get_policy().mlp[0].weight)
    uninterrupted.learn(2, False)
    resumed.load(str(checkpoint))
    resumed.learn(2, False)
    assert_equal(resumed.alg.save(), uninterrupted.alg.save())
    return resumed, uninterrupted


def test_checkpoint_is_all_that_learning_needs(tmp_path: Path) -> None:
    resumed, uninterrupted = assert_resumes_exactly(small_task(), tmp_path / "model_2.pt")
    assert (resumed.total_steps, resumed.current_learning_iteration) == (uninterrupted.total_steps, 4) == (4 * STEPS, 4)


def test_nothing_left_to_do(copied: Path, tmp_path: Path) -> None:
    for more in ([], ["--max_iterations", "2"]):
        line = refused(tmp_path, "train", "--task", "go1_flat", "--device", "cpu", "--resume", *more)
        assert f"model_3.pt has done 3 iterations of {more[-1] if more else 3}; raise --max_iterations to go on" in line


def test_the_last_run_is_the_one_last_trained(three: Path, tmp_path: Path) -> None:
    """By the time of its newest checkpoint, not by the alphabet; a name or a path picks another."""
    experiment = tmp_path / "logs/go1_flat"
    for age, name in enumerate(("b", "c", "a")):
        shutil.copytree(three, experiment / name)
        for number in (2, 3):
            os.utime(experiment / name / f"model_{number}.pt", (1e9 + age, 1e9 + age))
    (experiment / "z_empty").mkdir()  # a run killed before its first checkpoint
    assert [folder.name for folder in runs(experiment)] == ["b", "c", "a"] and find_run(experiment, "-1").name == "a"
    os.utime(experiment / "b/model_2.pt", (2e9, 2e9))  # b went on from an early checkpoint
    assert [folder.name for folder in runs(experiment)] == ["c", "a", "b"] and find_run(experiment, "-1").name == "b"
    assert find_run(experiment, "c") == find_run(experiment, str(experiment / "c")) == experiment / "c"
    os.utime(experiment / "b/model_2.pt", (1e9, 1e9))
    common = ["--task", "go1_flat", "--device", "cpu", "--resume", "--max_iterations"]
    for pick, resumed in (
        (["4", "--load_run", "c"], "c/model_3.pt"),
        (["5"], "c/model_4.pt"),
        (["6", "--load_run", "-1"], "c/model_5.pt"),
    ):
        result = run("train", tmp_path, *common, *pick)
        assert result.code == 0, result.err
        assert f"resuming {experiment / resumed}\n" in result.out


def test_the_newest_checkpoint_is_the_highest_number(tmp_path: Path) -> None:
    for name in ("model_9.pt", "model_10.pt", "model_x.pt", ".model_11.pt.1.tmp", "model_100.pt.bak"):
        (tmp_path / name).touch()
    assert list(checkpoints(tmp_path)) == [9, 10]
    assert find_checkpoint(tmp_path, -1).name == "model_10.pt" and find_checkpoint(tmp_path, 9).name == "model_9.pt"
    with pytest.raises(ConfigError, match="no checkpoint 3 in .*; there are: 9, 10"):
        find_checkpoint(tmp_path, 3)


def test_an_export_has_no_checkpoints(tmp_path: Path) -> None:
    task, shipped = load_task("go1_flat"), ROOT / "resources/policies/go1_flat"
    for name in ("shipped", str(shipped)):
        with pytest.raises(ConfigError, match="--checkpoint 77: the .* has no checkpoints; name a run"):
            find_policy(task, name, 77)
    with pytest.raises(ConfigError, match="--checkpoint 77: a file has no checkpoints; name a run"):
        find_trained(str(shipped / "policy.onnx"), tmp_path, "exam", checkpoint=77)


def test_checkpoints_beside_an_export_can_be_named(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "resources/policies/go1_flat", run := tmp_path / "run")
    (run / "model_9.pt").touch()
    assert find_policy(load_task("go1_flat"), str(run), 9).checkpoint.name == "model_9.pt"
    assert find_policy(load_task("go1_flat"), str(run)).checkpoint.name == "policy.onnx"


def test_runs_of_the_same_second_do_not_share_a_folder(tmp_path: Path) -> None:
    folders = [new_run(tmp_path, "x") for _ in range(5)]
    assert len(set(folders)) == 5 and all(folder.is_dir() and "_x" in folder.name for folder in folders)
    with pytest.raises(ConfigError, match="no run with a checkpoint in .*; train first"):
        find_run(tmp_path, "-1")


# ---- stopping


def test_sigterm_saves_and_says_how_to_go_on(tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(ROOT / "train.py"),
        *SMALL,
        *shlex.split("--max_iterations 1000000 --experiment_name 'my runs'"),
    ]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    out = []
    for line in process.stdout:
        out.append(line)
        if "Learning iteration 2/" in line:
            process.send_signal(signal.SIGTERM)
            break
    rest, err = process.communicate(timeout=1200)
    text = "".join(out) + rest
    assert process.returncode == 3 and "Traceback" not in err, err
    [folder] = (tmp_path / "logs/my runs").iterdir()
    last = max(int(number) for number in re.findall(r"Learning iteration (\d+)/", text))
    [(iteration, file)] = checkpoints(folder).items()
    assert iteration == last == load(file)["iter"] >= 2
    *_, stopped, hint = text.splitlines()
    assert stopped == "stopped: SIGTERM; go on with"
    python, program, *args = shlex.split(hint)
    assert (python, program) == ("python", "train.py")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(tmp_path)  # where it was started: the hint's path may be relative to it
        result = run("train", tmp_path, *args, "--device", "cpu", "--max_iterations", str(last + 1))
    assert result.code == 0, result.err
    assert re.findall(r"Learning iteration (\d+)/", result.out) == [str(last + 1)]


def test_the_time_that_is_asked_for_is_a_training(tmp_path: Path) -> None:
    """It ends as one that has done all its iterations does; the next one's plan counts its time."""
    result = run(
        "train", tmp_path, *SMALL, "--max_iterations", "1000", "--max_time", "1s", "--set", "runner.exam_interval=0"
    )
    assert result.code == 0, result.err
    *_, told, ended, watch = result.out.splitlines()
    done = [int(number) for number in re.findall(r"Learning iteration (\d+)/", result.out)]
    [folder] = (tmp_path / "logs/go1_flat").iterdir()
    assert list(checkpoints(folder)) == [len(done)] and done == list(range(1, len(done) + 1))
    assert told == f"{len(done)} iterations within --max_time; --resume goes on towards 1000" and ended.startswith(
        "done: "
    )
    assert shlex.split(watch) == ["python", "play.py", "--task", "go1_flat", "--load_run", folder.name]
    assert 0.0 < load(folder / f"model_{len(done)}.pt")["infos"]["seconds"] < 60.0
    assert re.search(
        r"^\d+ cores: 1000 iterations, .* min; --max_time ends it after 0\.0167 min$", result.out, re.MULTILINE
    )


def test_who_is_stopped_is_told_how_much_time_is_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    update = Runner._log

    def stop_after(self: Runner, *args: Any) -> None:
        update(self, *args)
        self.stop = "SIGTERM"

    monkeypatch.setattr(Runner, "_log", stop_after)
    result = run(
        "train", tmp_path, *SMALL, "--max_iterations", "1000", "--max_time", "10h", "--set", "runner.exam_interval=0"
    )
    assert result.code == 3, result.err
    *_, stopped, hint = result.out.splitlines()
    left = re.fullmatch(r" +python train.py --resume --task go1_flat --load_run \S+ --max_time (\d+)s", hint)
    assert stopped == "stopped: SIGTERM; go on with" and left and 35_000 < int(left[1]) <= 36_000


KILLED = """
import os, random, signal, sys, time
from pathlib import Path
import torch
from legged_mw.rl.run_folder import save_whole

torch.set_num_threads(1)
folder, dice = Path(sys.argv[1]), random.Random(0)
for attempt in range(12):
    child = os.fork()
    if child == 0:
        for i in range(10**6):
            save_whole({"actor_state_dict": {"w": torch.full((500_000,), float(i))}, "iter": i}, folder / f"model_{i % 3}.pt")
    while attempt == 0 and len(list(folder.glob("model_*.pt"))) < 3:
        assert os.waitpid(child, os.WNOHANG) == (0, 0)  # it still runs
        time.sleep(0.01)
    time.sleep(0.05 * dice.random())
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    for file in folder.glob("model_*.pt"):
        content = torch.load(file, weights_only=True)
        assert (content["actor_state_dict"]["w"] == content["iter"]).all(), file
    print(len(list(folder.glob("model_*.pt"))), len(list(folder.glob(".model_*.tmp"))))
"""


def test_kill_while_saving_leaves_whole_checkpoints_only(tmp_path: Path) -> None:
    """SIGKILL at twelve random moments of a process that does nothing but save."""
    done = subprocess.run(
        [sys.executable, "-c", KILLED, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, done.stderr
    whole, torn = (int(number) for number in done.stdout.split()[-2:])
    assert whole == 3  # it did save
    # and was killed in the middle of it, at least once: such files are left, under a name that nothing reads
    assert torn > 0
    assert list(checkpoints(tmp_path)) == [0, 1, 2]


# ---- checkpoints and rsl-rl's own runner


def test_stock_runner_reads_ours(three: Path, env: LeggedRobot) -> None:
    stock = OnPolicyRunner(env, rsl_rl_config(small_task().train), None, "cpu")
    infos = stock.load(str(three / "model_3.pt"))
    ours = load(three / "model_3.pt")
    assert_equal(dict(stock.alg.get_policy().state_dict()), dict(ours["actor_state_dict"]))
    assert_equal(dict(stock.alg.critic.state_dict()), dict(ours["critic_state_dict"]))
    assert stock.current_learning_iteration == 3 and infos["total_steps"] == 3 * STEPS


def test_ours_reads_the_stock_runners(env: LeggedRobot, tmp_path: Path) -> None:
    stock = OnPolicyRunner(env, rsl_rl_config(small_task().train), None, "cpu")
    stock.learn(1)
    stock.current_learning_iteration = 7
    stock.save(str(tmp_path / "model_7.pt"))
    ours = make_runner(env, small_task().train, None, "cpu")
    ours.load(str(tmp_path / "model_7.pt"))
    assert_equal(ours.alg.save(), stock.alg.save())
    assert (ours.current_learning_iteration, ours.total_steps, ours.alg.learning_rate) == (
        7,
        0,
        stock.alg.learning_rate,
    )


# ---- the exported policy


@pytest.fixture(scope="module")
def policy(three: Path, env: LeggedRobot) -> Any:
    return load_policy(three / "model_3.pt", env, small_task().train, "cpu")


def test_onnx_equals_torch(policy: Any, env: LeggedRobot, tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The normaliser and the clamp are inside: it takes raw observations and its output can go to the servos."""
    clip = env.cfg.normalization.clip_actions
    save_onnx(policy, clip, tmp_path / "policy.onnx")
    assert not [record for record in caplog.records if record.levelno >= logging.WARNING]  # the exporter's own affairs
    assert [path.name for path in tmp_path.iterdir()] == ["policy.onnx"]
    model = onnx.load(str(tmp_path / "policy.onnx"), load_external_data=False)
    assert not any(tensor.data_location == onnx.TensorProto.EXTERNAL for tensor in model.graph.initializer)
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx", providers=["CPUExecutionProvider"])
    [taken], [given] = session.get_inputs(), session.get_outputs()
    assert (taken.name, taken.shape, given.name, given.shape) == ("obs", ["batch", 48], "actions", ["batch", 12])
    size = torch.logspace(-1, 3, 50)[:, None]  # small ones as in life, large ones to reach the clamp
    observations = torch.randn(50, 48, generator=torch.Generator().manual_seed(0)) * size
    expected = act(policy, TensorDict({"state": observations}, batch_size=[50])).clamp(-clip, clip)
    got = np.concatenate([session.run(["actions"], {"obs": row[None].numpy()})[0] for row in observations])
    clipped = np.abs(got) == clip
    assert clipped.sum() > 10 and (~clipped).sum() > 100
    np.testing.assert_allclose(got, expected, atol=1e-5)
    np.testing.assert_allclose(session.run(["actions"], {"obs": observations.numpy()})[0], expected, atol=1e-5)
    assert (policy.obs_normalizer._mean != 0).any()  # else the normaliser would not have been tried


def test_onnx_leaves_the_policy_alone(policy: Any, env: LeggedRobot, tmp_path: Path) -> None:
    before, obs = copy.deepcopy(policy.state_dict()), env.get_observations()
    acted = act(policy, obs)
    save_onnx(policy, 0.01, tmp_path / "policy.onnx")
    assert_equal(dict(policy.state_dict()), dict(before))
    assert torch.equal(act(policy, obs), acted) and acted.abs().max() > 0.01


# ---- seeds


@pytest.fixture(scope="module")
def seeded(root: Path) -> Iterator[dict[str, Path]]:
    """Runs of two iterations by what was asked of the seed."""
    asked = {
        "11": ["--seed", "11"],
        "11 again": ["--seed", "11"],
        "12": ["--seed", "12"],
        "-1": ["--seed", "-1"],
        "-1 again": ["--seed=-1"],
    }
    return {name: trained(root, "--max_iterations", "2", *flags) for name, flags in asked.items()}


def test_same_seed_same_parameters(seeded: dict[str, Path]) -> None:
    one, same, other = (load(seeded[name] / "model_2.pt") for name in ("11", "11 again", "12"))
    assert_equal(one, same)
    for name in ("actor_state_dict", "critic_state_dict"):
        assert not torch.equal(one[name]["mlp.0.weight"], other[name]["mlp.0.weight"])


def test_drawn_seed_is_saved(seeded: dict[str, Path]) -> None:
    seeds = [load_yaml(seeded[name] / "config.yaml")["seed"] for name in ("-1", "-1 again")]
    assert all(isinstance(seed, int) and seed >= 0 for seed in seeds) and seeds[0] != seeds[1]
    assert load_yaml(seeded["11"] / "config.yaml")["seed"] == 11


# ---- annealing


def test_numbers_go_to_their_end_in_a_straight_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Over the iterations of `learn`; one whose end is 0 stays."""
    task, seen = small_task(), []
    task.set("algorithm.desired_kl", 0.01)
    task.set("algorithm.entropy_coef", 0.005)
    task.set("anneal.desired_kl", 0.002)
    task.set("anneal.entropy_coef", 0.0)
    task.set("rewards.tracking_sigma", 0.25)
    task.set("rewards.tracking_sigma_end", 0.05)
    task.set("perturbation.growth", [0.25, 0.75])
    env = LeggedRobot(task.cfg, "cpu")
    runner = make_runner(env, task.train, None, "cpu")
    alg, update = runner.alg, runner.alg.update
    kicks = env.perturbation
    now = lambda: (alg.desired_kl, alg.entropy_coef, float(env.tracking_sigma), float(kicks.growth))  # noqa: E731
    monkeypatch.setattr(alg, "update", lambda: (seen.append(now()), update())[1])
    rolled, step = [], env.step
    monkeypatch.setattr(env, "step", lambda actions: (rolled.append(float(env.tracking_sigma)), step(actions))[1])
    runner.learn(5)
    kl, entropy, sigma, growth = zip(*seen, strict=True)
    assert kl == pytest.approx([0.01, 0.008, 0.006, 0.004, 0.002])
    assert entropy == (0.005,) * 5
    assert growth == (0.0, 0.0, 0.5, 1.0, 1.0)
    assert sigma == pytest.approx([0.25, 0.2, 0.15, 0.1, 0.05]) == list(dict.fromkeys(rolled))
    env.on_training_progress(0.0)  # as a new environment has it
    runner.current_learning_iteration, first = 3, len(rolled)
    runner.learn(2, False)
    assert rolled[first] == pytest.approx(0.1), "a resumed training goes on where it was, from its first step"


def test_before_an_episode_has_ended_its_means_are_dashes() -> None:
    """They are not known, which is not the same as not finite: a loss that is not finite is shown."""
    numbers = dict.fromkeys(("learning_rate", "action_std", "episodes", "fell", "broken", "falls_a_minute"), 0.0)
    unknown = dict.fromkeys(("reward", "episode_length", "rew_pose", "terrain_level"), math.nan)
    means = ("Mean reward", "Mean episode length", "rew_pose", "Terrain level")
    rows = console_rows({**numbers, **unknown}, {"value": math.nan}, 9.0, 1.0, 1.0)
    assert [rows[name] for name in means] == ["-"] * 4 and rows["Value loss"] == "nan"
    rows = console_rows({**numbers, **dict.fromkeys(unknown, 2.0)}, {}, 9.0, 1.0, 1.0)
    assert [rows[name] for name in means] == ["2.00", "2.0", "2.0000", "2.00"]


def test_what_a_task_counts_is_shown_and_drawn() -> None:
    """Its own live statistics, and how far the kicks' curriculum has come; what has a line of its own is there once."""

    class Counts(LeggedRobot):
        def _live_statistics(self) -> dict[str, torch.Tensor]:
            return super()._live_statistics() | {"my_figure": torch.tensor([14.0, 2.0])}

    env = make_env(2, {"perturbation.kick": True, "perturbation.curriculum": True}, env_class=Counts)
    env.perturbation.kick_level.copy_(torch.tensor([0.25, 0.5]))
    numbers = {**env.read_statistics(), "learning_rate": 1e-3, "action_std": 0.5, "falls_a_minute": 0.0}
    rows, drawn = console_rows(numbers, {}, 9.0, 1.0, 1.0), curves(numbers, {}, 9.0, 1.0, 1.0, 1)
    assert (rows["My figure"], rows["Kick level"]) == ("7.00", "0.38")
    assert {name: value for name, value in drawn.items() if name.startswith("Curriculum/")} == {
        "Curriculum/my_figure": 7.0,
        "Curriculum/kick_level": 0.375,
    }


def test_rewards_that_a_run_did_not_have_stay_off() -> None:
    saved = load_task("go1_flat_fast").to_dict()
    saved["rewards"]["scales"] = {"tracking_lin_vel": 3.0, "stand_still": 0.0}
    update_from_run(task := load_task("go1_flat_fast"), saved, "config.yaml")
    on = {name: scale for name, scale in task.to_dict()["rewards"]["scales"].items() if scale}
    assert on == {"tracking_lin_vel": 3.0}
