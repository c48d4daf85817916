"""YAML that cannot be read, or would not mean what it seems to, whoever reads it; tests/golden/yaml_files.py has what each says."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from attack import Case, attack, program
from golden.yaml_files import TEXTS

from legged_mw import ROOT
from legged_mw.unitree.handset import load_remote
from legged_mw.utils import yaml_file
from legged_mw.utils.yaml_file import load_yaml


@pytest.mark.parametrize(
    "name", ["deep lists", "anchors that blow up", "null key", "5000 digits", "surrogate", "int of text", "not UTF-8"]
)
@pytest.mark.parametrize("reader", ["config.yaml", "policy.yaml", "drive.yaml", "remote.yaml"])
def test_every_reader_is_the_same(reader: str, name: str, tmp_path: Path) -> None:
    """The config and the contract of a stranger's export, a script of commands and one of a remote."""
    folder, text = tmp_path / "theirs", TEXTS[name]
    shutil.copytree(ROOT / "resources/policies/go1_flat", folder)
    (folder / reader).write_bytes(text if isinstance(text, bytes) else text.encode())
    run: Any = {
        "config.yaml": program("play", "--load_run", "ROOT/theirs", "--viewer", "none"),
        "policy.yaml": program("deploy", "ROOT/theirs"),
        "drive.yaml": program("deploy", "ROOT/theirs", "--commands", "ROOT/theirs/drive.yaml"),
        "remote.yaml": lambda root: load_remote(root / "theirs/remote.yaml"),
    }[reader]
    attack(Case(name, run, (reader, "not valid YAML: ")), tmp_path)


def test_values_are_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yaml_file, "MOST_NODES", 1000)
    (tmp_path / "x.yaml").write_text("a: [" + "1," * 1000 + "]\n")
    attack(
        Case("", program("train", "--override", "ROOT/x.yaml"), "x.yaml:1: not valid YAML: more than 1,000 values"),
        tmp_path,
    )


def test_numbers_and_words_as_they_are_written(tmp_path: Path) -> None:
    written = {
        "010": 10,
        "1:30": "1:30",
        "1_000": 1000,
        "0x1F": 31,
        "0o17": 15,
        "+3": 3,
        "-0": 0,
        "1e-4": 1e-4,
        ".5": 0.5,
        "1.": 1.0,
    }
    written |= {
        "2024-01-01": "2024-01-01",
        "12:30:45": "12:30:45",
        "=": "=",
        "~": None,
        "true": True,
        "0b11": "0b11",
        "1e": "1e",
    }
    path = tmp_path / "x.yaml"
    path.write_text("".join(f"k{i}: {text}\n" for i, text in enumerate(written)))
    read = list(load_yaml(path).values())
    assert read == list(written.values()) and [type(value) for value in read] == [
        type(value) for value in written.values()
    ]


def test_anchors_that_stay_small_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: *a\n")
    assert load_yaml(path) == {"a": {"x": 1}, "b": {"x": 1, "y": 2}, "c": {"x": 1}}
