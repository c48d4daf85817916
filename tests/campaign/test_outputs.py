"""Paths that cannot be written are refused before the work: before an exam, a film, an export, a training."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from attack import Case, attack, program

from legged_mw import ROOT
from legged_mw.motion import __main__ as motion
from legged_mw.robot import actuator_net

SHIPPED = str(ROOT / "resources/policies/go1_flat")
GO1 = str(ROOT / "resources/robots/go1/go1.xml")
PLAY, DEPLOY, CHECK = ("play", "--load_run", SHIPPED), ("deploy", SHIPPED), ("train", "--check")


def a_file(root: Path) -> None:
    (root / "file").write_text("")


def some_folders(root: Path) -> None:
    for name in ("folder.mp4", "folder.png", "folder.json", "folder.npz"):
        (root / name).mkdir()


def logs_is_a_file(root: Path) -> None:
    (root / "logs").write_text("")


def report_is_a_file(root: Path) -> None:
    shutil.copytree(SHIPPED, root / "theirs")
    (root / "theirs/eval").write_text("")


CASES = [
    Case(
        "exam into nowhere",
        program(*DEPLOY, "--eval", "--out", "/proc/nosuch/x.json"),
        "--out /proc/nosuch/x.json: cannot be written: ",
    ),
    Case(
        "exam below a file",
        program(*DEPLOY, "--eval", "--out", "file/x.json"),
        "file is a file, not a folder",
        given=a_file,
    ),
    Case(
        "exam onto a folder",
        program(*DEPLOY, "--eval", "--out", "folder.json"),
        "that is a folder; name a file",
        given=some_folders,
    ),
    Case("exam to no name", program(*DEPLOY, "--eval", "--out", ""), "--out is empty: name the file to write"),
    Case("exam to a blank", program(*DEPLOY, "--eval", "--out", "  "), "--out is empty: name the file to write"),
    Case("exam to a long name", program(*DEPLOY, "--eval", "--out", "x" * 300), "--out xxx"),
    Case("exam to a null", program(*DEPLOY, "--eval", "--out", "a\0b"), "--out a"),
    Case(
        "film into nowhere",
        program(*PLAY, "--video", "/proc/nosuch/dir/x.mp4"),
        "--video /proc/nosuch/dir/x.mp4: cannot be written",
    ),
    Case(
        "film below a file", program(*PLAY, "--video", "file/dir/x.mp4"), "file is a file, not a folder", given=a_file
    ),
    Case("film to no name", program(*PLAY, "--video", ""), "--video is empty: name the file to write"),
    Case(
        "film onto a folder",
        program(*PLAY, "--video", "folder.mp4"),
        "that is a folder; name a file",
        given=some_folders,
    ),
    Case("film of deploy to no name", program(*DEPLOY, "--video", ""), "--video is empty", name="deploy.py"),
    Case(
        "film of deploy",
        program(*DEPLOY, "--video", "/proc/nosuch/x.gif"),
        "--video /proc/nosuch/x.gif: cannot be written",
    ),
    Case(
        "sheet into nowhere",
        program(*PLAY, "--sheet", "/proc/nosuch/x.png"),
        "--sheet /proc/nosuch/x.png: cannot be written",
    ),
    Case("sheet to no name", program(*PLAY, "--sheet", ""), "--sheet is empty: name the file to write"),
    Case(
        "sheet onto a folder",
        program(*PLAY, "--sheet", "folder.png"),
        "that is a folder; name a file",
        given=some_folders,
    ),
    Case("export to no name", program(*PLAY, "--export", ""), "--export is empty: name the folder to write"),
    Case(
        "export onto a file",
        program(*PLAY, "--export", "file"),
        "--export file: that is a file; name a folder",
        given=a_file,
    ),
    Case("export below a file", program(*PLAY, "--export", "file/out"), "file is a file, not a folder", given=a_file),
    Case(
        "export into nowhere",
        program(*PLAY, "--export", "/proc/nosuch/out"),
        "--export /proc/nosuch/out: cannot be written",
    ),
    Case(
        "report onto a file",
        program("play", "--load_run", "ROOT/theirs", "--eval"),
        "eval: that is a file; name a folder",
        given=report_is_a_file,
    ),
    Case("picture to no name", program(*CHECK, "--picture", ""), "--picture is empty: name the file to write"),
    Case(
        "picture into nowhere",
        program(*CHECK, "--picture", "/proc/nosuch/x.png"),
        "--picture /proc/nosuch/x.png: cannot be written",
    ),
    Case(
        "picture of a robot",
        program("robot", GO1, "--picture", "/proc/nosuch/x.png"),
        "--picture /proc/nosuch/x.png: cannot be written",
    ),
    Case(
        "a new task into nowhere",
        program("robot", GO1, "--new", "dog", "--out", "/proc/nosuch"),
        "--out /proc/nosuch: cannot be written",
    ),
    Case(
        "a new task below a file",
        program("robot", GO1, "--new", "dog", "--out", "file/x"),
        "file is a file",
        given=a_file,
    ),
    Case(
        "a new task onto a file",
        program("robot", GO1, "--new", "dog", "--out", "file"),
        "that is a file; name a folder",
        given=a_file,
    ),
    Case(
        "training below a file",
        program("train", "--num_envs", "4"),
        "logs is a file, not a folder",
        given=logs_is_a_file,
    ),
    Case("a log into nowhere", program(*DEPLOY, "--drive", "--log", "/proc/nosuch/x.npz"), "cannot be written"),
    Case(
        "a log onto a folder",
        program(*DEPLOY, "--drive", "--log", "folder.npz"),
        "that is a folder; name a file",
        given=some_folders,
    ),
    Case("a log to no name", program(*DEPLOY, "--drive", "--log", ""), "--log is empty: name the file to write"),
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.id)
def test_outputs(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)


@pytest.mark.parametrize(
    ("flags", "says"),
    [
        (["--out", "/proc/nosuch/x.npz"], "--out /proc/nosuch/x.npz: cannot be written"),
        (["--out", ""], "--out is empty: name the file to write"),
        (["--out", "folder.npz"], "that is a folder; name a file"),
        (["--rate", "nan"], "argument --rate: the value is nan; it must be above 0"),
        (["--rate", "0"], "argument --rate: the value is 0.0; it must be above 0"),
        (["--fps", "inf"], "argument --fps: the value is inf; it must be finite"),
        (["--lift", "nan"], "argument --lift: the value is nan; it must be finite"),
        (["--cut", "nan", "nan"], "argument --cut: the value is nan; it must be finite"),
    ],
)
def test_a_clip(flags: list[str], says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["legged_mw.motion", "none.csv", *flags])
    attack(Case("", lambda root: motion.main(), says, given=some_folders, name="python -m legged_mw.motion"), tmp_path)


def test_a_motor_network(tmp_path: Path) -> None:
    def run(root: Path) -> None:
        actuator_net.main(["none.pt", "/proc/nosuch/x.npz"])

    attack(Case("", run, "OUT /proc/nosuch/x.npz: cannot be written"), tmp_path)
