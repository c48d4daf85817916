"""The command line of train.py and play.py; tests/golden/cli_train.py has the mistakes: each is one line, and leaves nothing behind."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from argparse import ArgumentTypeError
from ctypes import ArgumentError
from pathlib import Path

import pytest
import torch
from program import SMALL, Result, files, refused, run, trained

from legged_mw import ROOT
from legged_mw.export.exporter import FILES
from legged_mw.rl.learner_config import fit_cpu
from legged_mw.utils.cli import FEWER_WORLDS, duration, one_line_errors
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import load_task

TASK = ["--task", "go1_flat"]
DOG = '''"""A dog of one's own: lighter, and with its own learner."""

from configs.go1_flat import Go1FlatCfg, Go1FlatCfgPPO
from legged_mw.envs.legged_robot import LeggedRobot
from legged_mw.utils.task import Task


class Dog(LeggedRobot):
    def _reward_calm(self):
        return self.dof_vel.abs().sum(dim=1)


class DogCfg(Go1FlatCfg):
    class asset(Go1FlatCfg.asset):
        file = "robot/dog.xml"

    class rewards(Go1FlatCfg.rewards):
        class scales(Go1FlatCfg.rewards.scales):
            calm = -0.01


class DogCfgPPO(Go1FlatCfgPPO):
    class runner(Go1FlatCfgPPO.runner):
        num_steps_per_env = 4

    class actor(Go1FlatCfgPPO.actor):
        hidden_dims = [8]


TASK = Task(Dog, DogCfg, DogCfgPPO)
'''


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with one run of one iteration, logs/go1_flat/<time>_first."""
    folder = tmp_path_factory.mktemp("cli")
    kicks = ["--set", "perturbation.kick=True"]  # which playing switches off
    trained(folder, "--max_iterations", "1", "--run_name", "first", *kicks)
    return folder


@pytest.fixture(scope="module")
def first(root: Path) -> Path:
    [folder] = (root / "logs/go1_flat").glob("*_first")
    return folder


def test_an_actor_alone_plays(first: Path, tmp_path: Path) -> None:
    folder = tmp_path / "logs/go1_flat/run"
    shutil.copytree(first, folder)
    content = torch.load(folder / "model_1.pt", weights_only=True)
    torch.save({"actor_state_dict": content["actor_state_dict"], "infos": {}}, folder / "model_1.pt")
    result = run("play", tmp_path, *TASK, "--device", "cpu", "--export", str(tmp_path / "out"))
    assert result.code == 0 and (tmp_path / "out/policy.onnx").is_file()


# ---- durations and commands


def test_durations() -> None:
    assert [duration(text) for text in ("90", "90s", "5m", "1.5h", "0.5s")] == [90, 90, 300, 5400, 0.5]
    for text in ("soon", "0", "0s", "-5", "5d", "1h30", "5 m", "nan", ""):
        with pytest.raises(ArgumentTypeError):
            duration(text)


def test_a_wider_range_lets_a_command_pass(root: Path, tmp_path: Path) -> None:
    """And a script with no viewer ends by itself and says what its commands gave."""
    drive = tmp_path / "drive.yaml"
    drive.write_text("commands: [{time: 0, command: [9, 0, 0]}]")
    wide = ["--set", "commands.ranges.lin_vel_x=[-9,9]", "--viewer", "none", "--time", "0.1s"]
    result = run("play", root, *TASK, "--device", "cpu", "--commands", str(drive), *wide)
    assert result.code == 0, result.err
    assert "0.0 s   0.1 s   +9.00 +0.00 +0.00" in result.out


# ---- what is shown


def test_list(tmp_path: Path) -> None:
    result = run("train", tmp_path, "--list")
    assert result.code == 0 and not files(tmp_path)
    lines = {line.split()[0]: line for line in result.out.splitlines()}
    assert "Unitree Go1 follows a joystick on flat ground" in lines["go1_flat"]
    assert set(lines) == {path.stem for path in (ROOT / "configs").glob("*.py")} - {"__init__", "base"}


def test_check(tmp_path: Path) -> None:
    """What the task is made of, with overrides, and nothing is written."""
    scales = [
        *shlex.split("--set rewards.scales.pose=0 --set rewards.scales.lin_vel_z=-0.7"),
        *shlex.split("--set 'control.stiffness={joint: 20}'"),
    ]
    result = run("train", tmp_path, *SMALL, "--check", *scales, "--set", "noise.level=2")
    assert result.code == 0 and not files(tmp_path)
    lines = [" ".join(line.split()) for line in result.out.splitlines()]
    for line in (
        "go1_flat: 16 worlds on cpu, engine mujoco",
        "the step can be recorded as a CUDA graph",
        "observation state (48)",
        "9 dof_pos 12 noise +-0.06",
        "45 commands 3",
        "observation privileged_state (123)",
        "122 kick_active 1",
        "actions (12), clipped at +-2, 50 Hz",
        "lin_vel_z -0.7",
        "FR_calf_joint -1.800 [-2.818, -0.888] 35.55 +-1",
        "RL_calf_joint servo: kp 20 N m/rad",
    ):
        assert line in lines
    assert "pose 0" not in lines and "pose 0.5" not in lines


@pytest.mark.parametrize(
    "wrong",
    [
        ["actor.estimator.targets=[base_lin_vel]", "actor.class_name=RNNModel"],
        ["actor.concurrent.groups=[privileged]"],
        ["actor.class_name=RNNModel", "algorithm.num_mini_batches=64"],
    ],
)
def test_check_refuses_a_learner_that_training_refuses(wrong: list[str], tmp_path: Path) -> None:
    flags = [flag for value in wrong for flag in ("--set", value)]
    check, training = (
        refused(tmp_path, "train", *SMALL, *flags, *more) for more in (["--check"], ["--max_iterations", "1"])
    )
    assert check == training


def test_check_says_what_remembers_and_that_nothing_is_drawn(tmp_path: Path) -> None:
    result = run(
        "train", tmp_path, *SMALL, "--check", "--set", "actor.class_name=RNNModel", "--set", "actor.rnn_type=lstm"
    )
    assert (
        "the actor remembers: lstm, 64 units, layers: 1\n" in result.out
        and "domain_rand.enable is False: none" in result.out
    )


@pytest.mark.parametrize("more", [["--check"], ["--max_iterations", "1"]])
def test_a_reward_that_asks_the_host_is_named_before_training(tmp_path: Path, more: list[str]) -> None:
    """A CPU would run it, a recorded step cannot; --eager records nothing."""
    source = DOG.replace(
        "return self.dof_vel.abs().sum(dim=1)", "return self.dof_vel[:, 0] * self.dof_vel.max().item()"
    )
    (tmp_path / "dog.py").write_text(source.replace('"robot/dog.xml"', '"resources/robots/go1/go1.xml"'))
    line = refused(tmp_path, "train", "--task", str(tmp_path / "dog.py"), *SMALL[2:], *more)
    assert (
        "dog.py:10, Dog._reward_calm: item() reads a tensor to the host; keep it a tensor and compute with that" in line
    )
    if more == ["--check"]:
        assert run("train", tmp_path, "--task", str(tmp_path / "dog.py"), *SMALL[2:], *more, "--eager").code == 0


def test_help_lists_every_flag(tmp_path: Path) -> None:
    for program, flags in (
        ("train", ("--resume", "--max_time", "--list", "--check")),
        ("play", ("--command", "--commands", "--viewer", "--video", "--sheet", "--eval", "--export")),
    ):
        result = run(program, tmp_path, "--help")
        assert result.code == 0
        for flag in ("--task", "--num_envs", "--seed", "--load_run", "--checkpoint", "--set", "--override", *flags):
            assert flag in result.out


# ---- overrides: files, then fields, then flags


def test_the_more_specific_wins(tmp_path: Path) -> None:
    one, two = tmp_path / "one.yaml", tmp_path / "two.yaml"
    one.write_text(
        "env: {num_envs: 3, episode_length_s: 1e+0}\nrewards: {scales: {pose: 0.1, torques: -1e-3}}\nseed: 5\n"
    )
    two.write_text(
        "env: {num_envs: 4}\nrewards: {scales: {pose: 0.2}}\nrunner: {num_steps_per_env: 4, max_iterations: 9}\n"
    )
    overrides = [
        "--set",
        "rewards.scales.pose=0.3",
        "--override",
        str(one),
        "--override",
        str(two),
        "--set",
        "env.num_envs=6",
    ]
    overrides += shlex.split("--set env.num_envs=5 --set algorithm.num_mini_batches=1 --max_iterations 1 --seed 0")
    result = run("train", tmp_path, *TASK, "--device", "cpu", *overrides)
    assert result.code == 0, result.err
    [saved] = (tmp_path / "logs/go1_flat").glob("*/config.yaml")
    config = load_yaml(saved)
    assert config["env"] == {"num_envs": 5, "episode_length_s": 1.0}  # the last --set; the file that alone names it
    assert config["rewards"]["scales"]["pose"] == 0.3  # a field wins over files, wherever it stands
    assert config["rewards"]["scales"]["torques"] == -1e-3
    # a flag wins over all
    assert config["runner"]["num_steps_per_env"] == 4 and config["runner"]["max_iterations"] == 1
    assert config["seed"] == 0 and config["task"] == "go1_flat"
    assert "go1_flat: 5 worlds on cpu" in result.out


def test_a_cpu_takes_its_own_section_and_what_the_user_says_wins(tmp_path: Path) -> None:
    asked = [
        *shlex.split("--num_envs 5 --max_iterations 1 --set runner.num_steps_per_env=4"),
        *shlex.split("--set algorithm.num_mini_batches=1"),
    ]
    asked += ["--set", "algorithm.desired_kl=0.015"]
    result = run("train", tmp_path, *TASK, "--device", "cpu", *asked)
    assert result.code == 0, result.err
    assert "go1_flat: 5 worlds on cpu, engine mujoco\n" in result.out
    assert (
        "sets worlds, networks, learner, commands.keep_probability, " in result.out
        and "algorithm.entropy_coef; flags win" in result.out
    )
    assert re.search(r"^\d+ cores: 1 iterations, 0.0 M steps, about 0 min$", result.out, re.MULTILINE)
    [saved] = (tmp_path / "logs/go1_flat").glob("*/config.yaml")
    config, few = load_yaml(saved), load_task("go1_flat").train.cpu
    assert config["env"]["num_envs"] == 5 and config["algorithm"]["desired_kl"] == 0.015
    assert config["actor"]["hidden_dims"] == config["critic"]["hidden_dims"] == few.hidden_dims
    assert config["perturbation"]["growth"] == few.overrides["perturbation.growth"] == [0.15, 0.4]
    assert config["commands"]["keep_probability"] == few.overrides["commands.keep_probability"] == [0.6, 0.25, 0.75]
    assert config["algorithm"]["entropy_coef"] == few.overrides["algorithm.entropy_coef"] == 0.01
    result = run("train", tmp_path / "off", *TASK, "--device", "cpu", *asked, "--set", "cpu.enable=false")
    assert result.code == 0, result.err
    [saved] = (tmp_path / "off/logs/go1_flat").glob("*/config.yaml")
    assert load_yaml(saved)["actor"]["hidden_dims"] == load_task("go1_flat").train.actor.hidden_dims


def test_worlds_grow_with_the_cores_up_to_the_tasks_own_number() -> None:
    for cores, worlds in ((1, 256), (8, 2048), (64, 8192)):
        task = load_task("go1_flat")
        fit_cpu(task, cores)
        assert task.cfg.env.num_envs == worlds


def test_experiment_name_by_flag_and_by_field(tmp_path: Path) -> None:
    """Both name the folder below logs/, and what is printed finds the run again."""
    for name, flags in (("flag", ["--experiment_name", "flag"]), ("field", ["--set", "runner.experiment_name=field"])):
        folder = trained(tmp_path, "--max_iterations", "1", *flags)
        assert folder.parent == tmp_path / "logs" / name
    result = run("train", tmp_path, *SMALL, "--max_iterations", "2", "--experiment_name", "flag", "--resume")
    assert result.code == 0, result.err
    hint = shlex.split(result.out.splitlines()[-1])
    assert hint[:2] == ["python", "play.py"]
    again = run("play", tmp_path, *hint[2:], "--device", "cpu", "--export", str(tmp_path / "out"))
    assert again.code == 0 and "logs/flag/" in again.out.splitlines()[0] and "model_2.pt" in again.out.splitlines()[0]


def test_play_says_what_it_changes(root: Path, first: Path, tmp_path: Path) -> None:
    out, was = tmp_path / "out", load_yaml(first / "config.yaml")
    shown = ("--viewer", "none", "--time", "0.02s")
    result = run(
        "play", root, *TASK, "--device", "cpu", "--command=-0.5,0,0.25", "--set", "sim.ls_iterations=7", *shown
    )
    assert result.code == 0, result.err
    lines = [line.strip() for line in result.out.splitlines()]
    changes = {line.split(": ")[0]: line.split(": ")[1] for line in lines if " -> " in line}
    commands = was["commands"]
    assert changes == {
        "commands.curriculum": "True -> False",
        "commands.ranges.ang_vel_yaw": f"{commands['ranges']['ang_vel_yaw']} -> [0.25, 0.25]",
        "commands.ranges.lin_vel_x": f"{commands['ranges']['lin_vel_x']} -> [-0.5, -0.5]",
        "commands.ranges.lin_vel_y": f"{commands['ranges']['lin_vel_y']} -> [0.0, 0.0]",
        "commands.resampling_time": f"{commands['resampling_time']} -> 0.0",
        "env.episode_length_s": "0.4 -> 1000000.0",
        "env.num_envs": "16 -> 1",
        "gait.random_start": "True -> False",
        "noise.level": f"{was['noise']['level']} -> 0.0",
        "perturbation.kick": "True -> False",
        "sim.ls_iterations": f"{was['sim']['ls_iterations']} -> 7",
    }
    result = run("play", root, *TASK, "--device", "cpu", "--export", str(out))
    assert result.code == 0 and " -> " not in result.out, result.err  # as trained, not as played
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    assert load_yaml(out / "config.yaml") == was


# ---- real processes: what only the programs themselves can show


def start(program: str, folder: Path, *args: str) -> Result:
    """``program`` started in ``folder``, as a user away from the repository does."""
    done = subprocess.run(
        [sys.executable, str(ROOT / f"{program}.py"), *args], cwd=folder, capture_output=True, text=True, timeout=1200
    )
    return Result(done.returncode, done.stdout, done.stderr)


def test_a_mistake_in_a_real_process(tmp_path: Path) -> None:
    result = start("train", tmp_path, "--task", "go1_falt")
    assert (result.code, result.out) == (2, "") and not files(tmp_path)
    assert (
        result.err.startswith("train.py: no task 'go1_falt' in configs/; did you mean 'go1_flat'?")
        and result.err.count("\n") == 1
    )


def test_a_task_outside_the_repository_trains_and_plays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its MJCF is found beside it, from wherever it is started; the run plays from its saved config."""
    home = tmp_path / "my dog"
    (home / "robot").mkdir(parents=True)
    (home / "dog.py").write_text(DOG)
    mjcf = (ROOT / "resources/robots/go1/go1.xml").read_text()
    assert 'mass="5.204"' in mjcf
    (home / "robot/dog.xml").write_text(mjcf.replace('mass="5.204"', 'mass="4.5"'))
    common = ["--device", "cpu", "--experiment_name", "my dogs"]
    monkeypatch.chdir(tmp_path)
    small = ["--num_envs", "8", "--max_iterations", "1", "--verbose", "--set", "runner.export=false"]
    result = run("train", tmp_path, "--task", "my dog/dog.py", *common, *small)
    assert result.code == 0, result.err
    assert "Learning iteration 1/1" in result.out and "rew_calm" in result.out
    [folder] = (tmp_path / "logs/my dogs").iterdir()
    config = load_yaml(folder / "config.yaml")
    assert config["asset"]["file"] == "robot/dog.xml" and config["task"] == "my dog/dog.py"
    video = tmp_path / "dog.mp4"
    elsewhere = ["--video", str(video), "--time", "0.1s", "--set", "viewer.width=160", "--set", "viewer.height=120"]
    monkeypatch.chdir(ROOT)
    result = run("play", tmp_path, "--task", str(home / "dog.py"), *common, *elsewhere)
    assert result.code == 0, result.err
    assert result.out.startswith(f"task: {home}/dog.py\npolicy: {folder}/model_1.pt\n") and video.stat().st_size > 0


def test_export_is_the_policy_as_trained(root: Path, tmp_path: Path) -> None:
    """Twice the same."""
    files = []
    for out in (tmp_path / "one", tmp_path / "two"):
        assert run("play", root, *TASK, "--device", "cpu", "--export", str(out)).code == 0
        files.append([(out / name).read_bytes() for name in ("config.yaml", "policy.onnx", "policy.yaml", "scene.xml")])
    assert files[0] == files[1]


@pytest.mark.parametrize(
    "text", ["CUDA out of memory. Tried to allocate 2 GiB", "Failed to allocate 4096 bytes on device 'cuda:0'"]
)
def test_memory_that_runs_out_gives_advice(text: str, capsys: pytest.CaptureFixture[str]) -> None:
    def capture_ends() -> None:
        try:
            raise RuntimeError(text)
        finally:
            raise RuntimeError("capture invalidated")  # what a recording makes of it

    for fewer in (FEWER_WORLDS, ""):  # actuator_net has no --num_envs
        with pytest.raises(SystemExit) as end, one_line_errors("train.py", fewer):
            capture_ends()
        assert end.value.code == 2
        assert capsys.readouterr().err == f"train.py: out of memory ({text}){fewer}\n"
    with pytest.raises(RuntimeError, match="something else"), one_line_errors("train.py"):
        raise RuntimeError("something else")


def test_a_library_that_is_missing_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="2"), one_line_errors("train.py"):
        raise ModuleNotFoundError("No module named 'tensorboard'", name="tensorboard")
    said = capsys.readouterr().err
    assert said.startswith("train.py: No module named 'tensorboard'; ") and said.count("\n") == 1
    with pytest.raises(ModuleNotFoundError), one_line_errors("train.py"):  # ours
        raise ModuleNotFoundError("No module named 'legged_mw.nothing'", name="legged_mw.nothing")


def test_a_reader_that_left_ends_nothing() -> None:
    """As in ``legged-mw play ... | head``, which closes the pipe; the robot whose command is refused comes to its line all the same."""
    reader, writer = os.pipe()
    os.close(reader)
    try:
        said = ["-m", "legged_mw.programs", "deploy", "go1_flat", "--edited", "--command=9,0,0"]
        done = subprocess.run(
            [sys.executable, *said], cwd=ROOT, stdout=writer, stderr=subprocess.PIPE, text=True, check=False
        )
    finally:
        os.close(writer)
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "--command 9,0,0" in done.stderr


def test_ctrl_c_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for error in (KeyboardInterrupt(), ArgumentError("argument 1: KeyboardInterrupt: ")):
        with pytest.raises(SystemExit, match="130"), one_line_errors("play.py"):
            raise error
        assert capsys.readouterr().err == "\nplay.py: stopped\n"
    with pytest.raises(ArgumentError), one_line_errors("play.py"):
        raise ArgumentError("argument 1: TypeError: ")
