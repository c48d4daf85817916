"""docs/your_own_robot.md: every command of it runs, on a quadruped's URDF; what it names exists."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest
from program import Result, run

from legged_mw import ROOT, programs
from legged_mw.eval import plots, rollout
from legged_mw.robot import __main__ as robot_program
from legged_mw.utils.task import load_task

PAGE = ROOT / "docs/your_own_robot.md"
DATA = ROOT / "tests/data"
TRAIN = ["--num_envs", "16", "--max_iterations", "2"]
WATCH = ["--viewer", "none", "--time", "0.5s"]
COMMANDS = [
    shlex.split(line, comments=True)
    for block in re.findall(r"```bash\n(.*?)```", PAGE.read_text(), re.DOTALL)
    for line in block.splitlines()
]


def start(words: list[str], folder: Path, capsys: pytest.CaptureFixture[str]) -> Result:
    """What ``words``, a command of the page, print; long ones with the flags that the page says the tests add."""
    python, *rest = words
    assert python == "python"
    if rest[:2] == ["-m", "legged_mw.robot"]:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", ["robot", *rest[2:]])
            robot_program.main()
        return Result(0, capsys.readouterr().out, "")
    if rest[:2] == ["-m", "legged_mw.deploy"]:
        return run("deploy", folder, *rest[2:], *WATCH)
    program, flags = rest[0].removesuffix(".py"), [*rest[1:], "--device", "cpu"]
    if program == "train" and not {"--check", "--max_iterations"} & {*flags}:
        flags += TRAIN
    if program == "play" and not {"--eval", "--export"} & {*flags}:
        flags += WATCH
    return run(program, folder, *flags)


def test_every_command_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robots = tmp_path / "robots"
    robots.mkdir()
    shutil.copyfile(DATA / "a1_style.urdf", robots / "robot.urdf")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rollout, "EXAM_SECONDS", 2.1)
    monkeypatch.setattr(
        programs, "grade_export", lambda *_: []
    )  # the exam on the other engine, in a process of its own
    draw = plots.sections  # one picture of the report is enough here
    monkeypatch.setattr(plots, "sections", lambda *args: [each for each in draw(*args) if each.name == "pushes"])
    said = []
    for words in COMMANDS:
        result = start([os.path.expanduser(word) for word in words], tmp_path, capsys)
        assert result.code == 0, (words, result.err)
        said.append(result.out)
    page, new, check, trial, training, watched, graded, exported, deployed = said
    assert (
        "health of robot." in page
        and "what to look at" in page
        and "picture: robot.png; the judged poses: robot_poses.png" in page
    )
    assert "written: " in new and (robots / "mine.xml").exists()
    assert "the step can be recorded as a CUDA graph" in check and "health of mine_flat" in check
    assert "Learning iteration 2/2" in trial and "Learning iteration 2/2" in training and "watch it with" in training
    assert "0.5 s, " in watched and "walks: no" in graded and "report.html" in graded
    assert "written to my_policy: " in exported and "0.5 s, " in deployed
    wrong = [
        path
        for path in (robots / "mine.xml", robots / "mine_flat.py", tmp_path / "my_policy/policy.yaml")
        if str(tmp_path) in path.read_text()
    ]
    assert wrong == []


@pytest.mark.parametrize("file", ["a1_style.urdf", "g1_12dof_style.xml"])
def test_for_a_real_robot(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A draft is for a real robot: it is not told its velocity, and worlds differ. With --sim the task is simple.

    A draft for a real robot has a gait clock, a biped's in both.
    """
    for name, flags in (("mine", []), ("simple", ["--sim"])):
        monkeypatch.setattr(sys, "argv", ["robot", str(DATA / file), "--new", name, "--out", str(tmp_path), *flags])
        robot_program.main()
    config = str(tmp_path / "simple_flat.py")  # the other one trains above
    result = run("train", tmp_path, "--task", config, "--device", "cpu", *TRAIN, "--set", "runner.export=false")
    assert result.code == 0 and "Learning iteration 2/2" in result.out, result.err
    cfg, simple = (load_task(str(tmp_path / f"{name}_flat.py")).cfg for name in ("mine", "simple"))
    assert cfg.domain_rand.enable and cfg.domain_rand.delay_ms and cfg.perturbation.push and cfg.perturbation.kick
    assert cfg.observations.leave_out == {"state": ["base_lin_vel"]} and simple.observations.leave_out == {}
    assert not simple.domain_rand.enable and not simple.perturbation.push
    assert cfg.gait.period and bool(simple.gait.period) == file.startswith("g1")
    assert cfg.perturbation.max_push_ang_vel and not simple.perturbation.max_push_ang_vel
    if file.startswith("a1"):
        check_rough(tmp_path)


def check_rough(folder: Path) -> None:
    """The class on the page for rough ground, beside the flat task: what rough ground changes, and what the robot states."""
    heads = "from configs.base import SimToRealRoughCfg, SimToRealRoughCfgPPO\nfrom mine_flat import MineFlatCfg\n"
    heads += "from legged_mw.envs.legged_robot import LeggedRobot\nfrom legged_mw.utils.task import Task\n\n"
    [body] = re.findall(r"```text\n(class MineRoughCfg.*?)```", PAGE.read_text(), re.DOTALL)
    (folder / "mine_rough.py").write_text(
        f"{heads}{body}\nTASK = Task(LeggedRobot, MineRoughCfg, SimToRealRoughCfgPPO)\n"
    )
    cfg, flat = load_task(str(folder / "mine_rough.py")).cfg, load_task(str(folder / "mine_flat.py")).cfg
    assert (cfg.terrain.mesh_type, cfg.termination.min_base_height, cfg.rewards.swing_height) == (
        "heightfield",
        0.15,
        0.15,
    )
    assert (cfg.asset.foot_names, cfg.commands.ranges.lin_vel_x) == (
        flat.asset.foot_names,
        flat.commands.ranges.lin_vel_x,
    )
    assert not cfg.commands.curriculum and flat.commands.curriculum


def test_the_page_names_fields_that_exist() -> None:
    config = load_task("go1_flat").cfg.to_dict()
    named = re.findall(
        r"`((?:asset|init_state|control|rewards|sim|termination|domain_rand|perturbation)\.[a-z_]+)", PAGE.read_text()
    )
    assert len({*named}) > 25
    assert [name for name in named if name.split(".")[1] not in config[name.split(".")[0]]] == []


def test_pictures_are_small() -> None:
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", PAGE.read_text())
    assert len(pictures) == 2 and all((PAGE.parent / picture).stat().st_size < 50_000 for picture in pictures)
