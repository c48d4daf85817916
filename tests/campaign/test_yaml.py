"""YAML that cannot be read, or would not mean what it seems to: one line with file and place, whoever reads it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Any

import pytest
from attack import Case, attack, program

from legged_mw import ROOT
from legged_mw.deploy.unitree.handset import load_remote
from legged_mw.utils import yaml_file
from legged_mw.utils.yaml_file import MOST_BYTES, load_yaml

NOT_YAML = "x.yaml:{}: not valid YAML: ".format
TEXTS: dict[str, tuple[str | bytes, str]] = {  # name -> (the file, what the line says)
    "open list": ("env:\n  num_envs: [1\nseed: 1\n", NOT_YAML(3)),
    "tab": ("env:\n\tnum_envs: 1\n", NOT_YAML(2)),
    "open quote": ("runner: {run_name: 'x}\n", NOT_YAML(2)),
    "two documents": ("seed: 1\n---\nseed: 2\n", NOT_YAML(2)),
    "unknown directive version": ("%YAML 7.0\n---\nseed: 1\n", NOT_YAML(1)),
    "directive of 5000 digits": (f"%YAML 1.{'9' * 5000}\n---\nseed: 1\n", NOT_YAML(1)),
    "unknown anchor": ("seed: *none\n", NOT_YAML(1)),
    "bad escape": ('runner: {run_name: "\\q"}\n', NOT_YAML(1)),
    "escape beyond Unicode": ('runner: {run_name: "\\UFFFFFFFF"}\n', NOT_YAML(1)),
    "surrogate": ('runner:\n  run_name: "\\ud800"\n', NOT_YAML(2) + "the character '\\ud800' is not text"),
    "null character": ('runner: {run_name: "a\\0b"}\n', NOT_YAML(1) + "the character '\\x00' is not text"),
    "terminal escape": ('runner: {run_name: "\\e[31mred"}\n', NOT_YAML(1) + "the character '\\x1b' is not text"),
    "not UTF-8": (b"seed: \xff\xfe\n", "x.yaml: not valid YAML: "),
    "binary": (bytes(range(256)), "x.yaml"),
    "control character": (b"seed: 1\x07\n", "not valid YAML: "),
    "number key": ("env:\n  3: 1\n", NOT_YAML(2) + "the key '3' is no name"),
    "null key": ("~: 1\n", NOT_YAML(1) + "the key '~' is no name"),
    "empty key": ("env: {: 1}\n", NOT_YAML(1)),
    "true as a key": ("env: {true: 1}\n", NOT_YAML(1) + "the key 'true' is no name"),
    "Norway": ("env: {no: 1}\n", NOT_YAML(1) + "the key 'no' is no name"),
    "list as a key": ("env:\n  ? [a]\n  : 1\n", NOT_YAML(2) + "the key a seq is no name"),
    "mapping as a key": ("{{a: 1}: 2}\n", NOT_YAML(1) + "the key a map is no name"),
    "key twice": ("seed: 1\nseed: 2\n", NOT_YAML(2) + "'seed' is written twice"),
    "int of text": ("seed: !!int x\n", NOT_YAML(1) + "'x' is no int"),
    "float of text": ("sim: {dt: !!float x}\n", NOT_YAML(1) + "'x' is no float"),
    "bool of text": ("env: !!bool maybe\n", NOT_YAML(1) + "'maybe' is no bool"),
    "int of a list": ("seed: !!int [1]\n", NOT_YAML(1)),
    "python tag": ("seed: !!python/object/apply:os.getpid []\n", NOT_YAML(1) + "the tag !!python/object/apply:os.getpid is not read here"),
    "own tag": ("seed: !mine 3\n", NOT_YAML(1) + "the tag !mine is not read here"),
    "set": ("asset: {colliders: !!set {a, b}}\n", NOT_YAML(1) + "the tag !!set is not read here"),
    "binary tag": ("runner: {run_name: !!binary aGk=}\n", NOT_YAML(1) + "the tag !!binary is not read here"),
    "date tag": ("seed: !!timestamp 2024-99-99\n", NOT_YAML(1) + "the tag !!timestamp is not read here"),
    "date that is none": ("seed: 2024-13-45\n", "seed must be int, not '2024-13-45' (str)"),
    "date": ("seed: 2024-01-01\n", "seed must be int, not '2024-01-01' (str)"),
    "0x_": ("seed: 0x_\n", NOT_YAML(1) + "'0x_' is no int"),
    "0o_": ("seed: 0o_\n", NOT_YAML(1) + "'0o_' is no int"),
    "0b_": ("seed: 0b_\n", "seed must be int, not '0b_' (str)"),
    "1:30 as an int": ("seed: 1:30\n", "seed must be int, not '1:30' (str)"),
    "1:30.5 as a float": ("sim: {dt: 1:30.5}\n", "sim.dt must be float, not '1:30.5' (str)"),
    "tagged 1:30": ("seed: !!int 1:30\n", NOT_YAML(1) + "'1:30' is no int"),
    "5000 digits": (f"seed: {'9' * 5000}\n", NOT_YAML(1) + "a whole number of more than 40 digits"),
    "5000 hexadecimal digits": (f"seed: 0x{'f' * 5000}\n", NOT_YAML(1) + "a whole number of more than 40 digits"),
    "a float of 5000 digits": (f"sim: {{dt: {'9' * 5000}.0}}\n", "sim.dt is inf; it must be finite"),
    "deep lists": ("seed: " + "[" * 100_000, NOT_YAML(1) + "nested deeper than 50"),
    "deep mappings": ("a: {" * 1000, NOT_YAML(1) + "nested deeper than 50"),
    "deep blocks": ("".join("- " for _ in range(3000)) + "1\n", NOT_YAML(1) + "nested deeper than 50"),
    "anchors that blow up": (
        "a0: &a0 [x, x, x, x, x, x, x, x, x]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)),
        "more than 50,000 values, aliases written out",
    ),
    "an anchor in itself": ("env: &a\n  num_envs: *a\n", NOT_YAML(2) + "'*a' is a part of itself"),
    "a merge of itself": ("env: &a\n  <<: *a\n", NOT_YAML(2)),
    "a merge of a number": ("env: {<<: 3}\n", NOT_YAML(1)),
    "large": ("# " + "x" * MOST_BYTES + "\n", "x.yaml: larger than 1 MiB"),
    "empty": ("", "x.yaml: holds NoneType, not a mapping"),
    "a number": ("3\n", "x.yaml: holds int, not a mapping"),
    "a list": ("- env\n", "x.yaml: holds list, not a mapping"),
    "a text of 200 kB": (f"seed: {'x' * 200_000}\n", "seed must be int, not 'xxx"),
    "a section that is null": ("env:\n", "env is a section and needs a mapping of its fields, not None"),
    "a section that is a list": ("env: [1]\n", "env is a section and needs a mapping of its fields, not [1]"),
    "a value that is null": ("env: {num_envs: }\n", "env.num_envs must be int, not None"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_an_override_file(name: str, tmp_path: Path) -> None:
    text, says = TEXTS[name]
    (tmp_path / "x.yaml").write_bytes(text if isinstance(text, bytes) else text.encode())
    line = attack(Case(name, program("train", "--check", "--override", "ROOT/x.yaml"), says), tmp_path)
    assert len(line) < 1000 and ("x.yaml" in line)


def device(root: Path) -> None:
    (root / "x.yaml").symlink_to("/dev/zero")


def pipe(root: Path) -> None:
    os.mkfifo(root / "x.yaml")


def itself(root: Path) -> None:
    (root / "x.yaml").symlink_to(root / "x.yaml")


OTHERS = [
    Case("endless", program("train", "--override", "/dev/zero"), "/dev/zero: cannot read this config file: it is a device or a pipe"),
    Case("a link to it", program("train", "--override", "ROOT/x.yaml"), "x.yaml: cannot read this config file: it is a dev", given=device),
    Case("a pipe", program("train", "--override", "ROOT/x.yaml"), "cannot read this config file: it is a device or a pipe", given=pipe),
    Case("a link to itself", program("train", "--override", "ROOT/x.yaml"), "x.yaml: cannot read this config file: ", given=itself),
    Case("a folder", program("train", "--override", "ROOT"), "cannot read this config file: Is a directory"),
    Case("no file", program("train", "--override", "ROOT/none.yaml"), "none.yaml: cannot read this config file: No such file"),
    Case("no name", program("train", "--override", ""), "cannot read this config file: Is a directory"),
    Case("a long name", program("train", "--override", "x" * 5000), "cannot read this config file: File name too long"),
    Case("--set of bad YAML", program("train", "--set", "asset.colliders=[a"), "asset.colliders must be list[str], not '[a' (str)"),
    Case("--set of 5000 digits", program("train", "--set", f"seed={'9' * 5000}"), "seed must be int, not '9999"),
    Case("--set of a surrogate", program("train", "--set", "runner.run_name=\udcff"), "it must be text without control characters"),
    Case("--set of an anchor", program("train", "--set", "asset.colliders=&a [*a]"), "asset.colliders must be list[str], not '&a [*a]'"),
    Case("--set of a clock", program("train", "--set", "seed=1:30"), "seed must be int, not '1:30' (str)"),
    Case("--set of a depth", program("train", "--set", f"asset.colliders={'[' * 5000}"), "asset.colliders must be list[str], not '[[["),
    Case("--set of a date", program("train", "--set", "sim.dt=2024-13-45"), "sim.dt must be float, not '2024-13-45' (str)"),
]


@pytest.mark.parametrize("case", OTHERS, ids=lambda case: case.id)
def test_what_is_no_file(case: Case, tmp_path: Path) -> None:
    attack(case, tmp_path)


@pytest.mark.parametrize("name", ["deep lists", "anchors that blow up", "null key", "5000 digits", "surrogate", "int of text", "not UTF-8"])
@pytest.mark.parametrize("reader", ["config.yaml", "policy.yaml", "drive.yaml", "remote.yaml"])
def test_every_reader_is_the_same(reader: str, name: str, tmp_path: Path) -> None:
    """The config and the contract of a stranger's export, a script of commands and one of a remote."""
    folder, (text, _) = tmp_path / "theirs", TEXTS[name]
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
    attack(Case("", program("train", "--override", "ROOT/x.yaml"), "x.yaml:1: not valid YAML: more than 1,000 values"), tmp_path)


def test_numbers_and_words_as_they_are_written(tmp_path: Path) -> None:
    written = {"010": 10, "1:30": "1:30", "1_000": 1000, "0x1F": 31, "0o17": 15, "+3": 3, "-0": 0, "1e-4": 1e-4, ".5": 0.5, "1.": 1.0}
    written |= {"2024-01-01": "2024-01-01", "12:30:45": "12:30:45", "=": "=", "~": None, "true": True, "0b11": "0b11", "1e": "1e"}
    path = tmp_path / "x.yaml"
    path.write_text("".join(f"k{i}: {text}\n" for i, text in enumerate(written)))
    read = list(load_yaml(path).values())
    assert read == list(written.values()) and [type(value) for value in read] == [type(value) for value in written.values()]


def test_anchors_that_stay_small_are_read(tmp_path: Path) -> None:
    path = tmp_path / "x.yaml"
    path.write_text("a: &a {x: 1}\nb: {<<: *a, y: 2}\nc: *a\n")
    assert load_yaml(path) == {"a": {"x": 1}, "b": {"x": 1, "y": 2}, "c": {"x": 1}}
