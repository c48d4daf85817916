"""YAML that cannot be read, or would not mean what it seems to."""

from __future__ import annotations

from pathlib import Path

from attack import program

from golden.table import Table
from legged_mw.utils.yaml_file import MOST_BYTES

TEXTS: dict[str, str | bytes] = {
    "open list": "env:\n  num_envs: [1\nseed: 1\n",
    "tab": "env:\n\tnum_envs: 1\n",
    "open quote": "runner: {run_name: 'x}\n",
    "two documents": "seed: 1\n---\nseed: 2\n",
    "unknown directive version": "%YAML 7.0\n---\nseed: 1\n",
    "directive of 5000 digits": f"%YAML 1.{'9' * 5000}\n---\nseed: 1\n",
    "unknown anchor": "seed: *none\n",
    "bad escape": 'runner: {run_name: "\\q"}\n',
    "escape beyond Unicode": 'runner: {run_name: "\\UFFFFFFFF"}\n',
    "surrogate": 'runner:\n  run_name: "\\ud800"\n',
    "null character": 'runner: {run_name: "a\\0b"}\n',
    "terminal escape": 'runner: {run_name: "\\e[31mred"}\n',
    "not UTF-8": b"seed: \xff\xfe\n",
    "binary": bytes(range(256)),
    "control character": b"seed: 1\x07\n",
    "number key": "env:\n  3: 1\n",
    "null key": "~: 1\n",
    "empty key": "env: {: 1}\n",
    "true as a key": "env: {true: 1}\n",
    "Norway": "env: {no: 1}\n",
    "list as a key": "env:\n  ? [a]\n  : 1\n",
    "mapping as a key": "{{a: 1}: 2}\n",
    "key twice": "seed: 1\nseed: 2\n",
    "int of text": "seed: !!int x\n",
    "float of text": "sim: {dt: !!float x}\n",
    "bool of text": "env: !!bool maybe\n",
    "int of a list": "seed: !!int [1]\n",
    "python tag": "seed: !!python/object/apply:os.getpid []\n",
    "own tag": "seed: !mine 3\n",
    "set": "asset: {colliders: !!set {a, b}}\n",
    "binary tag": "runner: {run_name: !!binary aGk=}\n",
    "date tag": "seed: !!timestamp 2024-99-99\n",
    "date that is none": "seed: 2024-13-45\n",
    "date": "seed: 2024-01-01\n",
    "0x_": "seed: 0x_\n",
    "0o_": "seed: 0o_\n",
    "0b_": "seed: 0b_\n",
    "1:30 as an int": "seed: 1:30\n",
    "1:30.5 as a float": "sim: {dt: 1:30.5}\n",
    "tagged 1:30": "seed: !!int 1:30\n",
    "5000 digits": f"seed: {'9' * 5000}\n",
    "5000 hexadecimal digits": f"seed: 0x{'f' * 5000}\n",
    "a float of 5000 digits": f"sim: {{dt: {'9' * 5000}.0}}\n",
    "deep lists": "seed: " + "[" * 100_000,
    "deep mappings": "a: {" * 1000,
    "deep blocks": "".join("- " for _ in range(3000)) + "1\n",
    "anchors that blow up": "a0: &a0 [x, x, x, x, x, x, x, x, x]\n"
    + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12)),
    "an anchor in itself": "env: &a\n  num_envs: *a\n",
    "a merge of itself": "env: &a\n  <<: *a\n",
    "a merge of a number": "env: {<<: 3}\n",
    "large": "# " + "x" * MOST_BYTES + "\n",
    "empty": "",
    "a number": "3\n",
    "a list": "- env\n",
    "a text of 200 kB": f"seed: {'x' * 200_000}\n",
    "a section that is null": "env:\n",
    "a section that is a list": "env: [1]\n",
    "a value that is null": "env: {num_envs: }\n",
}


def write(root: Path, text: str | bytes, name: str = "x.yaml") -> None:
    (root / name).write_bytes(text if isinstance(text, bytes) else text.encode())


def table() -> Table:
    made = Table()
    for name, text in TEXTS.items():
        made.add(
            name, program("train", "--check", "--override", "ROOT/x.yaml"), lambda root, text=text: write(root, text)
        )
    given = {
        "a link to a device": lambda root: (root / "x.yaml").symlink_to("/dev/zero"),
        "a link to itself": lambda root: (root / "x.yaml").symlink_to(root / "x.yaml"),
        "a folder": lambda root: (root / "x.yaml").mkdir(),
        "no file": lambda root: None,
    }
    for name, make in given.items():
        made.add(name, program("train", "--override", "ROOT/x.yaml"), make)
    made.programs("train", [["--override", name] for name in ("", "/dev/zero", "x" * 5000)])
    sets = (
        "asset.colliders=[a",
        f"seed={'9' * 5000}",
        "runner.run_name=\udcff",
        "asset.colliders=&a [*a]",
        "seed=1:30",
    )
    made.programs(
        "train", [["--set", value] for value in (*sets, f"asset.colliders={'[' * 5000}", "sim.dt=2024-13-45")]
    )
    return made
