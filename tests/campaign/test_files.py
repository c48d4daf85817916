"""Files that are what they say, and exports that are killed; what is refused of files stands in tests/golden."""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from golden.contract import POLICIES, theirs
from golden.files import network, runner, strange_folders
from onnx import helper

from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Network
from legged_mw.rl.run_folder import checkpoints, find_run, load_tensors, runs
from legged_mw.utils.config import load_yaml, save_yaml


def test_a_checkpoint_goes_through_unharmed(tmp_path: Path) -> None:
    """Sealed, and as it was written before there were seals."""
    runner().save(str(tmp_path / "model_5.pt"))
    runner().load(str(tmp_path / "model_5.pt"))
    torch.save(torch.load(tmp_path / "model_5.pt", weights_only=True), tmp_path / "model_5.pt")
    assert b"sha256" not in (tmp_path / "model_5.pt").read_bytes()[-100:]
    runner().load(str(tmp_path / "model_5.pt"))


def test_every_flipped_bit_is_seen(tmp_path: Path) -> None:
    draw, file = random.Random(3), tmp_path / "model_5.pt"
    runner().save(str(file))
    whole = file.read_bytes()
    for place in [*(draw.randrange(8 * len(whole)) for _ in range(300)), *range(8 * len(whole) - 800, 8 * len(whole))]:
        flipped = bytearray(whole)
        flipped[place // 8] ^= 1 << place % 8
        file.write_bytes(flipped)
        with pytest.raises(Exception, match="damaged"):
            load_tensors(file, "cpu")


def test_links_in_the_logs(tmp_path: Path) -> None:
    logs = strange_folders(tmp_path)
    assert (
        runs(logs) == [logs / "good"]
        and list(checkpoints(logs / "good")) == [3]
        and find_run(logs, "-1") == logs / "good"
    )


def test_what_may_be_changed(tmp_path: Path) -> None:
    def change(said: Any) -> None:
        said |= {"task": "mine", "ends": {}, "safety": {"speed": 30}, "exam": {}}

    theirs("go1_flat", change, signed=False)(tmp_path)
    assert read_contract(tmp_path / "out").task == "mine"


def test_a_network_that_is_one(tmp_path: Path) -> None:
    network(helper.make_node("Neg", ["short"], ["actions"]))(tmp_path)
    acts = Network(tmp_path / "out", read_contract(tmp_path / "out"))
    np.testing.assert_array_equal(acts(np.ones((3, 48), dtype=np.float32)), -np.ones((3, 12)))


# ---- an export that is killed


class _Killed(BaseException):
    """Not an error that anything mends."""


def move_in(folder: Path, new: Path, last: int) -> int:
    """An export of the files in ``new`` to ``folder``, killed before the call ``last`` of the file system; returns how many it makes."""
    from legged_mw.export.exporter import _all_or_nothing

    calls, real = 0, {name: getattr(os, name) for name in ("replace", "unlink", "rmdir", "mkdir", "open", "fsync")}

    def counted(name: str) -> Callable[..., Any]:
        def call(*args: Any, **more: Any) -> Any:
            nonlocal calls
            calls += 1
            if calls >= last:
                raise _Killed  # and whatever follows, as finally does, has no effect either
            return real[name](*args, **more)

        return call

    with pytest.MonkeyPatch.context() as patch:
        if last < 10**6:
            patch.setattr(shutil, "rmtree", lambda *_, **__: None)
        for name in real:
            patch.setattr(os, name, counted(name))
        with pytest.raises(_Killed) if last < 10**6 else contextlib.nullcontext(), _all_or_nothing(folder) as made:
            for file in new.iterdir():
                (made / file.name).write_bytes(file.read_bytes())
    return calls


def _contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.is_file()}


def _made(root: Path, task: str, extra: bool) -> Path:
    """An export, as a policy that is called ``task``; with or without the file of a terrain."""
    folder = root / "out"
    folder.mkdir()
    for name in ("policy.yaml", "policy.onnx", "scene.xml"):
        shutil.copy(POLICIES / "go1_flat" / name, folder)
    said = load_yaml(folder / "policy.yaml")
    save_yaml(folder / "policy.yaml", said | {"task": task})
    (folder / "config.yaml").write_text(f"task: {task}\n")
    if extra:
        (folder / "terrain.mjz").write_text(task)
    return folder.rename(root / task)


@pytest.mark.parametrize("extra", [True, False])
def test_killed_exports(tmp_path: Path, extra: bool) -> None:
    """At every call: afterwards there is the old export or the new one, whole, and a next start leaves nothing of the kill behind."""
    old, new = _made(tmp_path, "old", not extra), _made(tmp_path, "new", extra)
    (old / "terrain.xml").write_text("of an older version")
    wanted = {"old": _contents(old), "new": _contents(new)}
    shutil.copytree(old, tmp_path / "count")
    count, seen = move_in(tmp_path / "count", new, 10**6), []
    assert _contents(tmp_path / "count") == wanted["new"] and count > 12
    for last in range(1, count + 1):
        folder = Path(shutil.copytree(old, tmp_path / f"out{last}"))
        (folder / "README.md").write_text("mine")
        move_in(folder, new, last)
        seen.append(read_contract(folder).task)
        held = _contents(folder)
        assert held.pop("README.md") == b"mine" and held == wanted[seen[-1]], last
        move_in(folder, new, 10**6)
        assert _contents(folder).keys() == {*wanted["new"], "README.md"}
        left = [path for path in folder.iterdir() if path.is_dir() and path.name != f".export.{os.getpid()}.tmp"]
        assert not left, last
    # first the old one, from one call on the new
    assert seen == sorted(seen, reverse=True) and {*seen} == {"old", "new"}


def test_what_a_killed_export_leaves_is_swept(tmp_path: Path) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    old, new = _made(tmp_path, "old", False), _made(tmp_path, "new", False)
    for name in (f".export.{gone.pid}.tmp", f".export.{os.getppid()}.tmp"):
        (old / name).mkdir()
        (old / name / "policy.yaml").write_text("half")
    (old / f".config.yaml.{gone.pid}.tmp").write_text("half")
    (old / ".mine.tmp").write_text("mine")
    move_in(old, new, 10**6)
    left = {path.name for path in old.iterdir() if path.name.startswith(".")} - {f".export.{os.getpid()}.tmp"}
    assert left == {f".export.{os.getppid()}.tmp", ".mine.tmp"}  # of a process that lives, and nobody's


def test_a_staged_export_that_is_a_link_moves_nothing(tmp_path: Path) -> None:
    old, mine = _made(tmp_path, "old", False), tmp_path / "mine"
    mine.mkdir()
    (mine / "letter").write_text("dear")
    (old / ".export.new").symlink_to(mine)
    assert read_contract(old).task == "old" and (mine / "letter").exists()
