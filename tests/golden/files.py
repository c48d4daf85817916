"""Checkpoints, archives of arrays, folders and networks that are not what they say: those of tests/campaign/test_files.py, and more."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import test_files as campaign
import torch
from attack import Case
from test_files import ACTOR, ADAM, drop, set_at

from golden.table import Run, Table, patched
from legged_mw.deploy import controller as policy
from legged_mw.deploy.contract import read_contract
from legged_mw.deploy.controller import Network
from legged_mw.rl import policies
from legged_mw.rl.run_folder import find_checkpoint, find_run, load_tensors, new_run, save_whole
from legged_mw.rl.runner import Runner
from legged_mw.skills.clip import read_clip
from legged_mw.utils import files

MORE: dict[str, Any] = {
    "networks without weights": set_at(ACTOR, {}),
    "counter of Adam": drop("optimizer_state_dict"),
    "state is a list": set_at(f"{ADAM}|state", [1]),
    "group is a number": set_at(f"{ADAM}|param_groups|0", 3),
    "group without a rate": lambda content: content[ADAM]["param_groups"][0].pop("lr"),
    "step of Adam of text": set_at(f"{ADAM}|state|0|step", "one"),
    "env is a list": set_at("infos|env", [1]),
    "a level of text": set_at("infos|env|kick_level", "high"),
    "no actor": drop("actor_state_dict"),
}


@cache
def runner() -> Runner:
    return (
        campaign.runner.__wrapped__()
        if hasattr(campaign.runner, "__wrapped__")
        else campaign.runner.__pytest_wrapped__.obj()
    )  # type: ignore[attr-defined]


def spoilt(change: Any) -> Run:
    def given(root: Path) -> None:
        runner().save(str(root / "model_5.pt"))
        content = torch.load(root / "model_5.pt", weights_only=True)
        change(content)
        save_whole(content, root / "model_5.pt")

    return given


def rewritten(change: Any) -> Run:
    def given(root: Path) -> None:
        runner().save(str(root / "model_5.pt"))
        (root / "model_5.pt").write_bytes(change((root / "model_5.pt").read_bytes()))

    return given


def archive(read: Any, change: dict[str, Any]) -> Run:
    content = (campaign.CLIP if read is read_clip else campaign.MOTOR) | {
        name: np.asarray(value) for name, value in change.items()
    }
    return lambda root: np.savez(root / "file.npz", allow_pickle=False, **content)


def actor() -> Any:
    return runner().alg.get_policy()


def gone_on(root: Path) -> None:
    def there(*_: object, **__: object) -> None:
        raise FileExistsError

    patched(lambda root: new_run(root, "x"), Path, mkdir=there)(root)


def refuse(*_: object, **__: object) -> None:
    raise PermissionError(13, "Permission denied")


def on_its_way(root: Path) -> None:
    (root / "out" / files.STAGED).mkdir(parents=True)
    (root / "out" / files.STAGED / "policy.yaml").write_text("a: 1")


def table() -> Table:
    made = Table()
    for name, change, *_ in [*campaign.CONTENTS, *MORE.items()]:
        made.add(f"checkpoint, {name}", lambda root: runner().load(str(root / "model_5.pt")), spoilt(change))
    for name, change, *_ in campaign.BYTES:
        made.add(
            f"checkpoint of bytes, {name}", lambda root: load_tensors(root / "model_5.pt", "cpu"), rewritten(change)
        )
    made.campaign("folder", campaign.FOLDERS)
    for name, read, change, *_ in campaign.ARRAYS:
        run = patched(lambda root, read=read: read(root / "file.npz"), files, MOST_UNPACKED=1 << 16)
        made.add(f"arrays, {name}", run, archive(read, change))
    for name, given, *_ in campaign.NETWORKS:
        seconds = 0.5 if name == "never ends" else 60.0
        run = patched(lambda root: Network(root / "out", read_contract(root / "out")), policy, _FIRST_SECONDS=seconds)
        made.add(f"network, {name}", run, given)
    made.campaign("", [Case("a run whose name is gone", lambda root: find_run(root / "logs", "x"), "")])
    made.add("no checkpoint in a run", lambda root: find_checkpoint(root, -1))
    made.add("no checkpoint at", lambda root: load_tensors(root / "model_5.pt", "cpu"))
    made.add("a checkpoint that is a folder", lambda root: load_tensors(root, "cpu"))
    made.add("parameters of no file", lambda root: policies.read_parameters(root / "policy.onnx", actor()))
    made.add(
        "parameters of text",
        lambda root: policies.read_parameters(root / "policy.onnx", actor()),
        lambda root: (root / "policy.onnx").write_bytes(b"no"),
    )
    made.add(
        "parameters of another network",
        lambda root: policies.read_parameters(root / "out/policy.onnx", actor()),
        campaign.NETWORKS[0][1],
    )
    made.add(
        "an export that is a folder's file",
        lambda root: files.writable("a", "--export", folder=True),
        lambda root: (root / "a").touch(),
    )
    for name in ("", "a\0b", "x" * 300, "folder", "there/a"):
        made.add(
            f"to write {name[:9]!r}",
            lambda root, name=name: files.writable(name, "--out"),
            lambda root: ((root / "folder").mkdir(), (root / "there").touch()),
        )
    made.add(
        "not to be written",
        patched(lambda root: files.writable("a", "--out"), files.os, access=lambda *_: False),
        lambda root: (root / "a").touch(),
    )
    for name in ("~nobody_here/a", "a\0b"):
        made.add(f"a path {name!r}", lambda root, name=name: files.typed(name))
    for name in ("..", "a/b"):
        made.add(f"an experiment {name!r}", lambda root, name=name: files.check_name(name, "the experiment's name"))
    made.add("a thousand runs", gone_on)
    made.add(
        "an export on its way",
        patched(lambda root: files.finish_moving(root / "out"), files.os, replace=refuse),
        on_its_way,
    )
    return made
