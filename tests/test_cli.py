"""The command line of train.py and play.py: every mistake is one line, exit code 2, and leaves nothing behind."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import subprocess
import sys
from ctypes import ArgumentError
from pathlib import Path

import pytest
import torch
from program import SMALL, Result, files, refused, run, trained

from legged_mw import ROOT
from legged_mw.rl.export import FILES
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


# ---- mistakes that both programs know


@pytest.mark.parametrize("program", ["train", "play"])
@pytest.mark.parametrize(
    ("args", "parts"),
    [
        ([], ("--task is missing", "go1_flat, go1_flat_blind")),
        (
            ["--task", "go1_falt"],
            ("no task 'go1_falt' in configs/; did you mean 'go1_flat'?", "go1_flat, go1_flat_blind", "or give the path of a config file"),
        ),
        (["--task", "dog.urdf"], ("dog.urdf is a robot, not a task; make a task for it: python -m legged_mw.robot dog.urdf --new NAME",)),
        (["--task", "dog/dog.py"], ("no config file at ", "dog/dog.py")),
        (
            [*TASK, "--num_env", "4"],
            ("unrecognized arguments: --num_env 4; did you mean --num_envs?", "--help"),
        ),  # no abbreviations: they would change meaning one day
        ([*TASK, "--num_envs", "0"], ("argument --num_envs: 0 is not a positive number",)),
        ([*TASK, "--num_envs", "many"], ("argument --num_envs: invalid positive value: 'many'",)),
        ([*TASK, "--seed", "x"], ("argument --seed: invalid int value: 'x'",)),
        ([*TASK, "--set", "env.num_envs"], ("--set env.num_envs: write it as path=value, e.g. rewards.scales.torques=-1e-4",)),
        ([*TASK, "--set", "env.num_env=4"], ("--set env.num_env=4: env.num_env does not exist; did you mean 'num_envs'?",)),
        ([*TASK, "--set", "env.num_envs=many"], ("--set env.num_envs=many: env.num_envs must be int, not 'many'",)),
        (
            [*TASK, "--set", "reward.scales.pose=1"],
            ("no config section 'reward' in this task; did you mean 'rewards'?", "there are: env, asset, "),
        ),
        ([*TASK, "--set", "env=4"], ("--set env=4: env is a section, not a field; set one of its fields: num_envs",)),
        ([*TASK, "--set", "env.num_envs.x=4"], ("env.num_envs is a field (int), not a section",)),
        ([*TASK, "--set", "terrain.mesh_type=plain"], ("terrain.mesh_type must be", "did you mean 'plane'?")),
        ([*TASK, "--override", "none.yaml"], ("none.yaml: cannot read this config file: No such file",)),
        ([*TASK, "--device", "gpu"], ("--device gpu: say cpu, cuda, or cuda:<index>",)),
        ([*TASK, "--device", "cuda:99"], ("--device cuda:99: this machine has ", " CUDA devices; use --device cpu")),
        ([*TASK, "--checkpoint", "last"], ("argument --checkpoint: invalid int value: 'last'",)),
    ],
)
def test_mistakes(root: Path, program: str, args: list[str], parts: tuple[str, ...]) -> None:
    line = refused(root, program, *args)
    for part in parts:
        assert part in line


@pytest.mark.parametrize("program", ["train", "play"])
@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("env: {num_env: 4}", ("env.num_env does not exist; did you mean 'num_envs'?",)),
        ("envs: {num_envs: 4}", ("no config section 'envs' in this task; did you mean 'env'?",)),
        ("runner: {max_iterations: soon}", ("runner.max_iterations must be int, not 'soon'",)),
        ("env: 4", ("env is a section and needs a mapping of its fields, not 4",)),
        ("- env", ("holds list, not a mapping of sections and fields",)),
        ("env: {num_envs: 4", ("not valid YAML",)),
        ("seed: 1\nseed: 2", ("'seed' is written twice",)),
    ],
)
def test_override_file_mistakes(root: Path, tmp_path: Path, program: str, text: str, parts: tuple[str, ...]) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text(text)
    line = refused(root, program, *TASK, "--override", str(file))
    assert "mine.yaml" in line
    for part in parts:
        assert part in line


def test_no_gpu(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    for program in ("train", "play"):
        assert "--device cuda:0: this machine has 0 CUDA devices; use --device cpu" in refused(root, program, *TASK, "--device", "cuda:0")


@pytest.mark.parametrize("program", ["train", "play"])
def test_config_file_without_a_task(root: Path, tmp_path: Path, program: str) -> None:
    file = tmp_path / "empty.py"
    file.write_text("TASKS = 1\n")
    assert "empty.py must end with TASK = Task(Env, Cfg, CfgPPO); its TASK is None" in refused(root, program, "--task", str(file))


def test_config_file_with_a_mistake(root: Path, tmp_path: Path) -> None:
    file = tmp_path / "wrong.py"
    file.write_text(DOG.replace('file = "robot/dog.xml"', 'fiel = "robot/dog.xml"'))
    line = refused(root, "train", "--task", str(file))
    assert "wrong.py:15: DogCfg.asset.fiel overrides nothing; did you mean 'file'?" in line


# ---- mistakes that show only when the robot is built


@pytest.mark.parametrize(
    ("item", "parts"),
    [
        ("asset.file=dog.xml", ("asset.file: no file 'dog.xml' in ", "configs, ")),
        ("asset.file=", ("asset.file is empty; name the robot's MJCF or URDF",)),
        ("asset.foot_names=[FR, FL, RR, RLL]", ("no geom or body 'RLL' in go1.xml; did you mean 'RL'?",)),
        ("control.stiffness={hip: 30}", ("control.stiffness: no value for FR_thigh_joint, ",)),
        ("init_state.default_joint_angles={joint: 0, wheel: 1}", ("init_state.default_joint_angles: no joint 'wheel'",)),
        ("rewards.scales.torqes=-1", ("rewards.scales.torqes = -1: no reward term 'torqes'", "did you mean 'torques'?")),
        ("algorithm.optimizer=adom", ("the learner's config does not fit rsl-rl: ", "'adom'", "'adam'")),
        ("obs_groups.actor=[stat]", ("the learner's config does not fit rsl-rl: ", "'stat'", "'state'")),
    ],
)
def test_config_that_does_not_fit_the_robot_or_the_learner(root: Path, item: str, parts: tuple[str, ...]) -> None:
    line = refused(root, "train", *SMALL, "--set", item)
    for part in parts:
        assert part in line


# ---- finding a run


@pytest.mark.parametrize("program", ["train", "play"])
def test_unknown_run_and_checkpoint(root: Path, first: Path, program: str) -> None:
    more = ["--resume"] if program == "train" else []
    line = refused(root, program, *TASK, *more, "--load_run", first.name.replace("first", "frist"))
    assert f"did you mean '{first.name}'? there are: {first.name}" in line and "no run with a checkpoint '" in line
    line = refused(root, program, *TASK, *more, "--checkpoint", "7")
    assert f"no checkpoint 7 in {first}; there are: 1" in line
    line = refused(root, program, *TASK, *more, "--experiment_name", "elsewhere", "--load_run", "-1")
    assert "no run with a checkpoint in " in line and "elsewhere; train first" in line


def test_load_run_without_resume(root: Path, first: Path) -> None:
    for flag in (["--load_run", first.name], ["--checkpoint", "1"]):
        assert "--load_run and --checkpoint say what to go on with: add --resume" in refused(root, "train", *TASK, *flag)


def test_nothing_to_play(tmp_path: Path) -> None:
    line = refused(tmp_path, "play", *TASK)
    assert "nothing to play: no run in " in line and "so train first; no policy ships with go1_flat; those that ship: none" in line


def test_run_without_its_config(root: Path, first: Path, tmp_path: Path) -> None:
    folder = tmp_path / "logs/go1_flat/bare"
    folder.mkdir(parents=True)
    shutil.copy(first / "model_1.pt", folder)
    assert "config.yaml: cannot read this config file: No such file" in refused(tmp_path, "play", *TASK)
    assert "config.yaml: cannot read this config file: No such file" in refused(tmp_path, "train", *TASK, "--resume")


# ---- checkpoints that do not fit


@pytest.mark.parametrize("program", ["train", "play"])
def test_checkpoint_of_other_networks(root: Path, program: str) -> None:
    more = ["--resume", "--max_iterations", "2"] if program == "train" else []
    line = refused(root, program, *TASK, "--device", "cpu", *more, "--set", "actor.hidden_dims=[8, 16]")
    assert "model_1.pt does not fit this task: actor mlp.0.weight is (16, 48) there and (8, 48) here" in line


def test_critic_of_other_networks(root: Path) -> None:
    line = refused(root, "train", *TASK, "--device", "cpu", "--resume", "--max_iterations", "2", "--set", "critic.hidden_dims=[16]")
    assert "model_1.pt does not fit this task: critic mlp.2.weight is (16, 16) there and (1, 16) here" in line


class Evil:
    """Unpickling it runs code: it makes a folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def __reduce__(self) -> tuple:
        return (os.mkdir, (str(self.folder),))


@pytest.mark.parametrize("program", ["train", "play"])
@pytest.mark.parametrize("damage", ["cut", "empty", "text", "code", "keyless", "other"])
def test_damaged_checkpoint(first: Path, tmp_path: Path, program: str, damage: str) -> None:
    folder = tmp_path / "logs/go1_flat/run"
    shutil.copytree(first, folder)
    file, whole = folder / "model_1.pt", (first / "model_1.pt").read_bytes()
    contents = {"code": {"actor_state_dict": Evil(tmp_path / "evil")}, "keyless": {"actor_state_dict": {}}, "other": {"weights": 3}}
    if damage in contents:
        torch.save(contents[damage], file)
    else:
        file.write_bytes({"cut": whole[: len(whole) // 2], "empty": b"", "text": b"not a model\n"}[damage])
    more = ["--resume", "--max_iterations", "2"] if program == "train" else []
    line = refused(tmp_path, program, *TASK, "--device", "cpu", *more)
    said = {"other": "is not a checkpoint of this project: it has no actor_state_dict", "keyless": "does not fit this task: actor "}
    said["code"] = "cannot be read as a checkpoint: it is damaged, or holds more than tensors and numbers"
    assert f"model_1.pt {said.get(damage, 'cannot be read as a checkpoint: it is damaged: File is not a zip file')}" in line
    assert ("is missing there and " in line) == (damage == "keyless")
    assert not (tmp_path / "evil").exists()


def test_actor_alone_plays_but_does_not_resume(first: Path, tmp_path: Path) -> None:
    folder = tmp_path / "logs/go1_flat/run"
    shutil.copytree(first, folder)
    content = torch.load(folder / "model_1.pt", weights_only=True)
    torch.save({"actor_state_dict": content["actor_state_dict"], "infos": {}}, folder / "model_1.pt")
    line = refused(tmp_path, "train", *TASK, "--device", "cpu", "--resume", "--max_iterations", "2")
    assert "model_1.pt holds an actor only; it can be played, but not resumed" in line
    result = run("play", tmp_path, *TASK, "--device", "cpu", "--export", str(tmp_path / "out"))
    assert result.code == 0 and (tmp_path / "out/policy.onnx").is_file()


# ---- durations and commands


@pytest.mark.parametrize(("program", "flag"), [("train", "--max_time"), ("play", "--time")])
@pytest.mark.parametrize("text", ["soon", "0", "0s", "-5", "5d", "1h30", "5 m", "nan", ""])
def test_no_duration(root: Path, program: str, flag: str, text: str) -> None:
    assert f"argument {flag}: '{text}' is no duration; write 90s, 5m or 1.5h" in refused(root, program, *TASK, f"{flag}={text}")


def test_durations() -> None:
    assert [duration(text) for text in ("90", "90s", "5m", "1.5h", "0.5s")] == [90, 90, 300, 5400, 0.5]


@pytest.mark.parametrize("text", ["", "fast", "1;2;3", "0.5,,0", "nan,0,0", "0,inf,0", "1,x"])
def test_no_command(root: Path, text: str) -> None:
    line = refused(root, "play", *TASK, f"--command={text}")
    assert f"--command {text}: '" in line and "' is no number; write --command=0,0,0 (vx [m/s], vy [m/s], yaw rate [rad/s])" in line


def test_a_command_too_many_or_of_no_such_name(root: Path) -> None:
    line = refused(root, "play", *TASK, "--command=1,0,0,0")
    assert "--command 1,0,0,0: 4 numbers, but this task has 3 commands: vx [m/s], vy [m/s], yaw rate [rad/s]" in line
    line = refused(root, "play", *TASK, "--command=ang_vel_jaw=1")
    assert "--command ang_vel_jaw=1: no command 'ang_vel_jaw' in this task; did you mean 'ang_vel_yaw'?" in line


@pytest.mark.parametrize(
    ("args", "part"),
    [
        (["--command=9,0,0"], "--command 9,0,0: vx = 9 m/s is outside of what was trained, [-1.5, 1.5] m/s"),
        (["--commands", "none.yaml"], "none.yaml: cannot read this config file: No such file"),
        (["--commands", "a.yaml", "--command=0,0,0"], "it goes with neither --command nor --eval nor --export"),
        (["--viewer", "wbe"], "argument --viewer: invalid choice: 'wbe'"),
        (["--viewer", "web", "--video", "a.mp4"], "--video records and --viewer web does not: leave one of them out"),
        (["--video", "a.avi"], "Cannot write 'a.avi': the supported extensions are .mp4 (H.264) and .gif."),
    ],
)
def test_what_cannot_be_watched_is_refused_before_anything_runs(root: Path, args: list[str], part: str) -> None:
    assert part in refused(root, "play", *TASK, "--device", "cpu", *args)


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
    assert set(lines) == {path.stem for path in (ROOT / "configs").glob("*.py")} - {"__init__"}


def test_check(tmp_path: Path) -> None:
    """What the task is made of, with overrides, and nothing is written."""
    scales = ["--set", "rewards.scales.pose=0", "--set", "rewards.scales.lin_vel_z=-0.7", "--set", "control.stiffness={joint: 20}"]
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
        "FR_calf_joint -1.800 [-2.818, -0.888] 35.55",
        "RL_calf_joint servo: kp 20 N m/rad",
    ):
        assert line in lines
    assert "pose 0" not in lines and "pose 0.5" not in lines


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (["actor.estimator.targets=[base_lin_vel]", "actor.class_name=RNNModel"], "actor.estimator"),
        (["actor.concurrent.groups=[privileged]"], "privileged_state"),
        (["actor.class_name=RNNModel", "algorithm.num_mini_batches=64"], "num_mini_batches"),
    ],
)
def test_check_refuses_a_learner_that_training_refuses(wrong: list[str], said: str, tmp_path: Path) -> None:
    flags = [flag for value in wrong for flag in ("--set", value)]
    lines = [refused(tmp_path, "train", *SMALL, *flags, *more) for more in (["--check"], ["--max_iterations", "1"])]
    assert lines[0] == lines[1] and said in lines[0]


def test_check_says_what_remembers_and_that_nothing_is_drawn(tmp_path: Path) -> None:
    result = run("train", tmp_path, *SMALL, "--check", "--set", "actor.class_name=RNNModel", "--set", "actor.rnn_type=lstm")
    assert "the actor remembers: lstm, 64 units, layers: 1\n" in result.out and "domain_rand.enable is False: none" in result.out


@pytest.mark.parametrize("more", [["--check"], ["--max_iterations", "1"]])
def test_a_reward_that_asks_the_host_is_named_before_training(tmp_path: Path, more: list[str]) -> None:
    """A CPU would run it, a recorded step cannot; --eager records nothing."""
    source = DOG.replace("return self.dof_vel.abs().sum(dim=1)", "return self.dof_vel[:, 0] * self.dof_vel.max().item()")
    (tmp_path / "dog.py").write_text(source.replace('"robot/dog.xml"', '"resources/robots/go1/go1.xml"'))
    line = refused(tmp_path, "train", "--task", str(tmp_path / "dog.py"), *SMALL[2:], *more)
    assert "dog.py:10, Dog._reward_calm: item() reads a tensor to the host; keep it a tensor and compute with that" in line
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
    one.write_text("env: {num_envs: 3, episode_length_s: 1e+0}\nrewards: {scales: {pose: 0.1, torques: -1e-3}}\nseed: 5\n")
    two.write_text("env: {num_envs: 4}\nrewards: {scales: {pose: 0.2}}\nrunner: {num_steps_per_env: 4, max_iterations: 9}\n")
    overrides = ["--set", "rewards.scales.pose=0.3", "--override", str(one), "--override", str(two), "--set", "env.num_envs=6"]
    overrides += ["--set", "env.num_envs=5", "--set", "algorithm.num_mini_batches=1", "--max_iterations", "1", "--seed", "7"]
    result = run("train", tmp_path, *TASK, "--device", "cpu", *overrides)
    assert result.code == 0, result.err
    [saved] = (tmp_path / "logs/go1_flat").glob("*/config.yaml")
    config = load_yaml(saved)
    assert config["env"] == {"num_envs": 5, "episode_length_s": 1.0}  # the last --set; the file that alone names it
    assert config["rewards"]["scales"]["pose"] == 0.3  # a field wins over files, wherever it stands
    assert config["rewards"]["scales"]["torques"] == -1e-3
    assert config["runner"]["num_steps_per_env"] == 4 and config["runner"]["max_iterations"] == 1  # a flag wins over all
    assert config["seed"] == 7 and config["task"] == "go1_flat"
    assert "go1_flat: 5 worlds on cpu" in result.out


def test_a_cpu_takes_its_own_section_and_what_the_user_says_wins(tmp_path: Path) -> None:
    asked = ["--num_envs", "5", "--max_iterations", "1", "--set", "runner.num_steps_per_env=4", "--set", "algorithm.num_mini_batches=1"]
    asked += ["--set", "algorithm.desired_kl=0.015"]
    result = run("train", tmp_path, *TASK, "--device", "cpu", *asked)
    assert result.code == 0, result.err
    assert "go1_flat: 5 worlds on cpu, engine mujoco\n" in result.out
    assert "sets worlds, networks, learner, commands.keep_probability, " in result.out and "algorithm.entropy_coef; flags win" in result.out
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
        task.fit_cpu(cores)
        assert task.cfg.env.num_envs == worlds


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (["--engine", "physx"], "--engine: sim.engine must be Literal['auto', 'mujoco_warp', 'mujoco'], not 'physx' (str)"),
        (["--set", "sim.threads=-1"], "sim.threads is -1; it must be from 0 to 1024"),
    ],
)
def test_engine_that_cannot_be(tmp_path: Path, words: list[str], line: str) -> None:
    assert line in refused(tmp_path, "train", *TASK, "--device", "cpu", *words)


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
    result = run("play", root, *TASK, "--device", "cpu", "--command=-0.5,0,0.25", "--set", "sim.ls_iterations=7", *shown)
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
    done = subprocess.run([sys.executable, str(ROOT / f"{program}.py"), *args], cwd=folder, capture_output=True, text=True, timeout=300)
    return Result(done.returncode, done.stdout, done.stderr)


def test_a_mistake_in_a_real_process(tmp_path: Path) -> None:
    result = start("train", tmp_path, "--task", "go1_falt")
    assert (result.code, result.out) == (2, "") and not files(tmp_path)
    assert result.err.startswith("train.py: no task 'go1_falt' in configs/; did you mean 'go1_flat'?") and result.err.count("\n") == 1


def test_a_task_outside_the_repository_trains_and_plays(tmp_path: Path) -> None:
    """Its MJCF is found beside it, from wherever it is started; the run plays from its saved config."""
    home = tmp_path / "my dog"
    (home / "robot").mkdir(parents=True)
    (home / "dog.py").write_text(DOG)
    mjcf = (ROOT / "resources/robots/go1/go1.xml").read_text()
    assert 'mass="5.204"' in mjcf
    (home / "robot/dog.xml").write_text(mjcf.replace('mass="5.204"', 'mass="4.5"'))
    common = ["--device", "cpu", "--experiment_name", "my dogs"]
    result = start("train", tmp_path, "--task", "my dog/dog.py", *common, "--num_envs", "8", "--max_iterations", "1", "--verbose")
    assert result.code == 0, result.err
    assert "Learning iteration 1/1" in result.out and "rew_calm" in result.out
    [folder] = (tmp_path / "logs/my dogs").iterdir()
    config = load_yaml(folder / "config.yaml")
    assert config["asset"]["file"] == "robot/dog.xml" and config["task"] == "my dog/dog.py"
    video = tmp_path / "dog.mp4"
    elsewhere = ["--video", str(video), "--time", "0.1s", "--set", "viewer.width=160", "--set", "viewer.height=120"]
    result = run("play", tmp_path, "--task", str(home / "dog.py"), *common, *elsewhere)
    assert result.code == 0, result.err
    assert result.out.startswith(f"task: {home}/dog.py\npolicy: {folder}/model_1.pt\n") and video.stat().st_size > 0


def test_export_is_the_policy_as_trained(root: Path, tmp_path: Path) -> None:
    """Twice the same; what would play it otherwise is refused, since it would reach neither the config nor the network's clamp."""
    files = []
    for out in (tmp_path / "one", tmp_path / "two"):
        assert run("play", root, *TASK, "--device", "cpu", "--export", str(out)).code == 0
        files.append([(out / name).read_bytes() for name in ("config.yaml", "policy.onnx", "policy.yaml", "scene.xml")])
    assert files[0] == files[1]
    line = refused(root, "play", *TASK, "--export", str(tmp_path / "three"), "--set", "normalization.clip_actions=0.001")
    assert "--export writes the policy as it was trained: leave --set, --override and --command out" in line


def test_a_run_of_another_task_is_refused(first: Path, tmp_path: Path) -> None:
    copy = tmp_path / "logs/go1_flat/other"
    copy.mkdir(parents=True)
    for name in ("config.yaml", "model_1.pt"):
        (copy / name).write_bytes((first / name).read_bytes())
    text = (copy / "config.yaml").read_text()
    assert "task: go1_flat" in text
    (copy / "config.yaml").write_text(text.replace("task: go1_flat", "task: /far/away/dog.py"))
    for program, more in (("play", []), ("train", ["--resume", "--max_iterations", "2"])):
        line = refused(tmp_path, program, *TASK, "--device", "cpu", "--load_run", "other", *more)
        assert "is of task '/far/away/dog.py', not 'go1_flat'; that is somebody's code" in line and "--task /far/away/dog.py" in line


@pytest.mark.parametrize("text", ["CUDA out of memory. Tried to allocate 2 GiB", "Failed to allocate 4096 bytes on device 'cuda:0'"])
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


def test_ctrl_c_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    for error in (KeyboardInterrupt(), ArgumentError("argument 1: KeyboardInterrupt: ")):
        with pytest.raises(SystemExit, match="130"), one_line_errors("play.py"):
            raise error
        assert capsys.readouterr().err == "\nplay.py: stopped\n"
    with pytest.raises(ArgumentError), one_line_errors("play.py"):
        raise ArgumentError("argument 1: TypeError: ")
