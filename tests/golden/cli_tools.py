"""The command lines of the other programs: robot, motion, compare, sweep, completion, and legged-mw itself."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from golden.table import Table
from legged_mw import ROOT, programs
from legged_mw.robot import new

GO1, WAVE = ROOT / "resources/robots/go1/go1.xml", ROOT / "resources/motions/g1_wave.npz"
ROBOT = [
    "",
    "dog.xml",
    "dog.urdf",
    "go1_falt",
    f"{GO1} --new 9",
    f"{GO1} --new a-b",
    "go1_flat --new a",
    f"{GO1} --new there",
    f"{GO1} --picture a.gif",
]
ROBOT += [f"{GO1} --new a --out folder/there.xml", f"{GO1} --picture folder"]
MOTION = [
    "",
    "walk.bvh",
    "none.csv",
    "none.npz",
    f"{WAVE} --out a.csv",
    f"{WAVE} --cut 0 99",
    f"{WAVE} --rate 0",
    f"{WAVE} --rate 0.01",
    f"{WAVE} --rate 1e6",
]
MOTION += [f"{WAVE} --task go1_flat", f"{WAVE} --lift nan", f"{WAVE} --task nosuch", "words.csv", "narrow.csv"]
COMPARE = ["", "nosuch", "~nosuch", "nosuch --over days", "nosuch --out a.html", "a/../b"]
SWEEP = ["", "--task go1_flat --resume", "--task go1_flat --seeds 1,x", "--task go1_flat --run_name a"]
SWEEP += ["--task go1_flat --rounds 2", "--task go1_flat --jobs 0", "--task go1_flat --halve --init a"]
SWEEP += ["--task go1_flat --halve --seeds 1,2 --max_time 60s"]
SWEEP += ["--task go1_flat --seeds 1,2 --seed 3", "--task go1_flat --seeds 1,2 --set seed=3"]
GAMMAS = "--task go1_flat --halve --set algorithm.gamma=0.9,0.97"
SWEEP += [GAMMAS, f"{GAMMAS} --max_time 60s", f"{GAMMAS} --max_time 60s --set runner.exam_interval=0"]
SWEEP += [f"{GAMMAS} --max_time 60s --experiment_name file"]


def fill(root: Path) -> None:
    for name in ("folder", "logs/go1_flat_halving"):
        (root / name).mkdir(parents=True)
    for name, text in {
        "there.xml": "",
        "folder/there.xml": "",
        "logs/file": "",
        "words.csv": "a,b\nc,d\n",
        "narrow.csv": "1,2,3\n4,5,6\n",
        "logs/go1_flat_halving/sweep.txt": "--task go1_flat --seeds 1,2",
    }.items():
        (root / name).write_text(text)


def legged_mw(*words: str) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["legged-mw", *words])
        programs.main()


def table() -> Table:
    made = Table(fill)
    for name, lines in {
        "robot": ROBOT,
        "motion": MOTION,
        "compare": COMPARE,
        "sweep": SWEEP,
        "completion": ["", "fish"],
        "warm": ["--x"],
        "fit": ["", "nosuch.lmwlog"],
    }.items():
        made.programs(name, lines)
    made.programs("doctor", ["--x"])
    made.calls({"no program": legged_mw, "no such program": lambda: legged_mw("trian")})
    made.add("robot to a folder that is a file", lambda root: new.write(None, GO1, "a", root / "there.xml", force=True))  # type: ignore[arg-type]
    return made
