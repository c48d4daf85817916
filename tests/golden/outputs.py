"""Paths that cannot be written are refused before the work: before an exam, a film, an export, a training."""

from __future__ import annotations

import shutil
from pathlib import Path

from golden.table import Table
from legged_mw import ROOT
from legged_mw.robot import actuator_net

SHIPPED = ROOT / "resources/policies/go1_flat"
GO1 = ROOT / "resources/robots/go1/go1.xml"
FLAGS = {  # a program and its first words -> what follows; a list has an empty or an odd word
    f"deploy {SHIPPED}": [
        "--eval --out /proc/nosuch/x.json",
        "--eval --out file/x.json",
        "--eval --out folder.json",
        *(["--eval", "--out", name] for name in ("", "  ", "x" * 300, "a\0b")),
        "--video /proc/nosuch/x.gif",
        ["--video", ""],
        "--drive --log /proc/nosuch/x.npz",
        "--drive --log folder.npz",
        ["--drive", "--log", ""],
    ],
    f"play --load_run {SHIPPED}": [
        "--video /proc/nosuch/dir/x.mp4",
        "--video file/dir/x.mp4",
        "--video folder.mp4",
        ["--video", ""],
        "--sheet /proc/nosuch/x.png",
        "--sheet folder.png",
        ["--sheet", ""],
        "--export /proc/nosuch/out",
        "--export file",
        "--export file/out",
        ["--export", ""],
    ],
    "play --load_run theirs": ["--eval"],
    "train --check": ["--picture /proc/nosuch/x.png", ["--picture", ""]],
    f"robot {GO1}": [
        "--picture /proc/nosuch/x.png",
        "--new dog --out /proc/nosuch",
        "--new dog --out file/x",
        "--new dog --out file",
    ],
    "motion none.csv": [
        "--out /proc/nosuch/x.npz",
        "--out folder.npz",
        ["--out", ""],
        "--rate nan",
        "--rate 0",
        "--fps inf",
        "--lift nan",
        "--cut nan nan",
    ],
}


def fill(root: Path) -> None:
    (root / "file").touch()
    for ending in ("mp4", "png", "json", "npz"):
        (root / f"folder.{ending}").mkdir()
    shutil.copytree(SHIPPED, root / "theirs")
    (root / "theirs/eval").touch()


def table() -> Table:
    made = Table(fill)
    for start, lines in FLAGS.items():
        program, *words = start.split()
        for line in lines:
            more = line.split() if isinstance(line, str) else line
            said = " ".join(word if word.strip() else repr(word) for word in [program, *words, *more])
            made.programs(program, [[*words, *more]], name=said.replace(str(ROOT), "<root>")[:120])
    made.programs("train", ["--num_envs 4"], lambda root: (root / "logs").touch())
    made.add("actuator_net", lambda root: actuator_net.main(["none.pt", "/proc/nosuch/x.npz"]))
    return made
