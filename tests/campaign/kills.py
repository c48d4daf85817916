"""Kills at random moments: nothing half written is taken for whole, and what ends after all the resumes is the run that nobody killed.

By hand: ``python tests/campaign/kills.py --kills 100`` and ``--kills 30 --polite`` (SIGTERM and SIGINT in turn). A child is a copy
(fork) of a process that has imported everything, so that a kill costs seconds.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1]), str(Path(__file__).parent)]
from program import SMALL, assert_equal, run  # noqa: E402
from test_resume import EXACTLY  # noqa: E402

from legged_mw.rl.run_folder import checkpoints, damage  # noqa: E402

FLAGS = ["--seed", "5", "--eager", "--set", "runner.save_interval=1", "--set", "cpu.update_threads=1"]


def train(root: Path, resume: bool, iterations: int, export: bool) -> int:
    """As a child of this process, which it returns: a new run, or the one there resumed."""
    child = os.fork()
    if child:
        return child
    os.setsid()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_DFL)
    go_on = ["--task", "go1_flat", "--device", "cpu", "--eager", "--resume"]
    try:
        new = [*SMALL, *FLAGS, "--max_iterations", str(iterations), "--set", f"runner.export={export}"]
        done = run("train", root, *(go_on if resume else new))
        (root / f"said_{os.getpid()}").write_text(done.out + done.err)
        os._exit(done.code)
    except BaseException as error:  # a traceback
        (root / f"raised_{os.getpid()}").write_text(repr(error))
        os._exit(99)


def waited(child: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def folder_of(root: Path) -> Path | None:
    """The run to resume, if there is a checkpoint; runs that were killed before their first one are swept by hand."""
    runs = [folder for folder in root.glob("logs/go1_flat/*") if checkpoints(folder)]
    assert len(runs) <= 1
    return runs[0] if runs else None


def check_whole(folder: Path) -> None:
    """Every checkpoint is whole, and the newest has its worlds."""
    for file in [*checkpoints(folder).values(), *folder.glob("worlds_*.pt")]:
        assert not damage(file.read_bytes()), file
    newest = max(checkpoints(folder))
    assert (folder / f"worlds_{newest}.pt").is_file(), sorted(path.name for path in folder.iterdir())
    assert not (folder / "export").exists() or {"policy.onnx", "policy.yaml"} <= {
        path.name for path in (folder / "export").iterdir()
    }


def _wait(child: int, home: Path, new: int, pause: float) -> None:
    """Until the child has written so many checkpoints or has ended, and then for ``pause``."""
    before = len(list(home.glob("logs/*/*/model_*.pt")))
    while len(list(home.glob("logs/*/*/model_*.pt"))) < before + new and not os.waitid(
        os.P_PID, child, os.WEXITED | os.WNOHANG | os.WNOWAIT
    ):
        time.sleep(0.01)
    time.sleep(pause)


def campaign(
    root: Path, kills: int, numbers: tuple[int, ...], seed: int = 0, iterations: int = 12, export: bool = True
) -> dict[str, int]:
    """``kills`` signals from ``numbers``, each up to 0.4 s after 0 to 4 new checkpoints; counts of what happened."""
    dice, counts = (
        random.Random(seed),
        dict[str, int](kills=0, compared=0, **{"resumed exactly": 0, "ended by itself": 0}),
    )
    assert waited(train(root / "whole", False, iterations, export)) == 0
    whole = folder_of(root / "whole")
    assert whole
    wanted: Any = torch.load(whole / f"model_{iterations}.pt", weights_only=True)
    while counts["kills"] < kills:
        home = root / f"run{counts['compared']}"
        home.mkdir(exist_ok=True)
        resume = folder_of(home) is not None
        if not resume:
            shutil.rmtree(home / "logs", ignore_errors=True)
        child = train(home, resume, iterations, export)
        _wait(child, home, dice.randrange(5), dice.uniform(0.0, 0.4))
        os.kill(child, number := dice.choice(numbers))
        code = waited(child)
        code = 99 if (home / f"raised_{child}").is_file() else code
        counts["kills" if code else "ended by itself"] += 1
        assert code in (0, 3, -number, 130), (code, [path.read_text() for path in home.glob("raised_*")])
        said = (home / f"said_{child}").read_text() if (home / f"said_{child}").is_file() else EXACTLY
        assert "Traceback" not in said and (not resume or code == -number or EXACTLY in said), said[-2000:]
        counts["resumed exactly"] += resume and code != -number
        if folder := folder_of(home):
            check_whole(folder)
            if code == 0 or iterations in checkpoints(folder):
                assert_equal(torch.load(folder / f"model_{iterations}.pt", weights_only=True), wanted)
                assert list(checkpoints(folder)) == list(range(1, iterations + 1))
                counts["compared"] += 1
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=100)
    parser.add_argument("--polite", action="store_true", help="SIGTERM and SIGINT instead of SIGKILL")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--iterations", type=int, default=12, help="of each run")
    parser.add_argument("--no_export", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        numbers = (signal.SIGTERM, signal.SIGINT) if args.polite else (signal.SIGKILL,)
        print(campaign(Path(folder), args.kills, numbers, args.seed, args.iterations, not args.no_export), flush=True)


if __name__ == "__main__":
    main()
