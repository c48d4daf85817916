"""Compares what two commits or checkouts do, on one machine: make net A B

python tests/net/compare.py A B [--only recordings] [--tolerance reward=1e-5]     exit code 1: they differ
python tests/net/compare.py --keep tests/net/first_steps.npz                      what tests/test_net.py compares with, of this checkout

recordings  environments' steps on both engines, bit for bit (tests/net/recordings.py)
exams       exam.json of each policy that ships, value by value
exports     files of an export of each task, byte by byte
trainings   tensors of the checkpoint after two iterations of each task, and of each kind of learner

Each part is a process of its own with the sources of that checkout; what was found of a commit stays in logs/net/ and is not found again.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import platform
import resource
import runpy
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

sys.path[:0] = [str(Path(__file__).parent)]
from recordings import ENGINES, RECORDINGS, first_steps, rollout  # noqa: E402

# run -> quantity -> value; columns/QUANTITY and steps/QUANTITY name its last and first axis
Found = dict[str, dict[str, np.ndarray]]
NO_STEP, NAMES = -9, ("columns/", "steps/")
HERE = Path(__file__).resolve()
REPOSITORY = HERE.parents[2]
DECIDES = (
    "numpy",
    "torch",
    "mujoco",
    "mujoco-warp",
    "warp-lang",
    "rsl-rl-lib",
    "tensordict",
    "onnx",
    "onnxscript",
    "onnxruntime",
)

# ---- what is found of a checkout, in a process whose sources are that checkout's -----------------------------------------------------


def recordings(_: Path) -> Found:
    return {
        f"{name} {engine}": _or_error(lambda n=name, e=engine: rollout(n, e))
        for engine in ENGINES
        for name in RECORDINGS
    }


def kept(_: Path) -> Found:
    """Without names: they are known again."""
    found = {f"{name} {engine}": first_steps(name, engine) for engine in ENGINES for name in RECORDINGS}
    return {run: {name: v for name, v in values.items() if not name.startswith(NAMES)} for run, values in found.items()}


def exams(root: Path) -> Found:
    """As ``python -m legged_mw.deploy NAME --eval`` writes them."""
    found: Found = {}
    for policy in sorted(root.glob("resources/policies/*/policy.onnx")):
        found[policy.parent.name] = _or_error(lambda folder=policy.parent: _exam(folder))
    return found


def _exam(folder: Path) -> dict[str, np.ndarray]:
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "exam.json"
        _run(
            lambda: runpy.run_module("legged_mw.deploy", run_name="__main__", alter_sys=True),
            str(folder),
            "--eval",
            "--out",
            str(out),
        )
        return {path: np.array(value) for path, value in _leaves(json.loads(out.read_text()))}


# Few worlds, so that an iteration takes a second, and short episodes, so that some end in each; one thread, so that sums have one order.
SMALL = [
    *("--device", "cpu", "--num_envs", "16", "--max_iterations", "2", "--set", "runner.num_steps_per_env=8"),
    *(
        "--set",
        "env.episode_length_s=0.3",
        "--set",
        "domain_rand.redraw_iterations=1",
        "--set",
        "perturbation.push_interval_s=0.2",
    ),
    *(
        "--set",
        "sim.threads=1",
        "--set",
        "cpu.update_threads=1",
        "--set",
        "actor.hidden_dims=[32, 16]",
        "--set",
        "critic.hidden_dims=[32, 16]",
    ),
]
NO_EXPORT = ["--set", "runner.export=false"]
AS_SHIPPED = ["--set", "actor.hidden_dims=[512, 256, 128]"]
# run -> task and flags: the kinds of learners that no task has by itself
LEARNERS: dict[str, list[str]] = {
    "go1_legged_gym": ["examples/go1_legged_gym.py"],
    "g1_unitree_rl_gym": ["examples/g1_unitree_rl_gym.py"],  # an LSTM
    "a GRU": ["go1_flat_blind", "--set", "actor.class_name=RNNModel", "--set", "actor.rnn_hidden_dim=16"],
    "an estimator": ["go1_flat_blind", "--set", "actor.estimator.targets=[base_lin_vel]"],
    "a teacher beside": ["go1_rough_student", "--set", "actor.concurrent.groups=[privileged_state]"],
    "a student": ["go2_rough", "--teacher", "{root}/resources/policies/go2_rough_scan"],
    "a warm start": [
        "go2_flat",
        "--init",
        "{root}/resources/policies/go2_flat",
        "--set",
        "warm_start.critic_warmup=1",
        *AS_SHIPPED,
    ],
    "a mirror loss": ["go1_flat", "--set", "symmetry.use_mirror_loss=true", "--set", "symmetry.mirror_loss_coeff=1.0"],
    "bfloat16": ["go1_flat_fast"],
    "rsl-rl's PPO": ["go1_flat_dr", "--set", "algorithm.class_name=PPO"],
}


def trainings(root: Path) -> Found:
    """What train.py leaves behind after two iterations."""
    runs = {path.stem: [path.stem] for path in _tasks(root)} | LEARNERS
    return {name: _or_error(lambda flags=flags: _training(root, flags)) for name, flags in runs.items()}


def _training(root: Path, flags: Sequence[str]) -> dict[str, np.ndarray]:
    import torch

    with _trained(root, [*flags, *NO_EXPORT]) as run:
        [*_, last] = sorted(run.glob("model_*.pt"), key=lambda path: int(path.stem.partition("_")[2]))
        leaves = dict(_leaves(torch.load(last, weights_only=True)))
        leaves = {
            name: value.replace(str(root), "ROOT") if isinstance(value, str) else value
            for name, value in leaves.items()
        }
        found = {f"config.yaml/{name}": value for name, value in _text(run / "config.yaml", root).items()}
    for name, value in leaves.items():
        if isinstance(value, torch.Tensor):
            shape = f"{str(value.dtype).removeprefix('torch.')}{[*value.shape]}"
            value = f"{shape} {hashlib.sha256(value.contiguous().view(-1).view(torch.uint8).numpy().tobytes()).hexdigest()[:16]}"
        found[name] = np.array(value)
    return found


def exports(root: Path) -> Found:
    """Files that ``play.py --export`` writes of the policies that ship, and of the other tasks those that a training ends with."""
    found: Found = {}
    for path in _tasks(root):
        ships = (root / "resources/policies" / path.stem / "policy.onnx").exists()
        found[path.stem] = _or_error(
            lambda task=path.stem, ships=ships: _shipped_export(root, task) if ships else _new_export(root, task)
        )
    return found


def _shipped_export(root: Path, task: str) -> dict[str, np.ndarray]:
    with _empty_folder() as folder:
        _program(root, "play", "--task", task, "--device", "cpu", "--export", str(folder / "out"))
        return _files(folder / "out")


def _new_export(root: Path, task: str) -> dict[str, np.ndarray]:
    with _trained(root, [task]) as run:
        return _files(run / "export")


def _files(folder: Path) -> dict[str, np.ndarray]:
    found: dict[str, np.ndarray] = {}
    for file in sorted(path for path in folder.rglob("*") if path.is_file()):
        name, data = str(file.relative_to(folder)), file.read_bytes()
        if file.suffix in (".yaml", ".xml"):
            found |= {f"{name}/{part}": value for part, value in _text(file).items()}
        else:
            found[name] = np.array(f"{len(data)} bytes {hashlib.sha256(data).hexdigest()[:16]}")
    return found


def _text(file: Path, root: Path | None = None) -> dict[str, np.ndarray]:
    """Lines, and all bytes in short: lines hide how they end. Paths in the checkout ``root`` are compared from there on."""
    data = file.read_bytes()
    if root is not None:
        data = data.replace(str(root).encode(), b"ROOT")
    return {"lines": np.array(data.decode().splitlines()), "bytes": np.array(hashlib.sha256(data).hexdigest()[:16])}


def _tasks(root: Path) -> list[Path]:
    return [path for path in sorted((root / "configs").glob("*.py")) if "TASK = " in path.read_text()]


@contextlib.contextmanager
def _trained(root: Path, flags: Sequence[str]) -> Iterator[Path]:
    """The folder of a small run."""
    task, *more = [flag.format(root=root) for flag in flags]
    with _empty_folder() as folder:
        _program(root, "train", "--task", str(root / task) if task.endswith(".py") else task, *SMALL, *more)
        [run] = folder.glob("logs/*/*/config.yaml")
        yield run.parent


@contextlib.contextmanager
def _empty_folder() -> Iterator[Path]:
    """The current folder, meanwhile: a folder without logs/."""
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        yield Path(folder)


def _program(root: Path, name: str, *flags: str) -> None:
    _run(lambda: runpy.run_path(str(root / f"{name}.py"), run_name="__main__"), *flags)


def _run(work: Callable[[], object], *flags: str) -> None:
    """A program in this process, where torch is imported already. Raises what it says if it fails."""
    said, argv = io.StringIO(), sys.argv
    sys.argv = ["program", *flags]
    try:
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            work()
    except SystemExit as end:
        if end.code:
            raise RuntimeError(said.getvalue().strip().rpartition("\n")[2] or f"exit code {end.code}") from None
    finally:
        sys.argv = argv


def _or_error(work: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """What ``work`` finds; its error, if it fails: the others are worth comparing all the same."""
    try:
        return work()
    except Exception as error:
        print(traceback.format_exc(), file=sys.stderr, flush=True)
        return {"error": np.array(f"{type(error).__name__}: {error}")}


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    if isinstance(value, Mapping | list | tuple) and value:
        for key, inner in value.items() if isinstance(value, Mapping) else enumerate(value):
            yield from _leaves(inner, f"{path}.{key}" if path else str(key))
    else:
        yield path, str(value) if value is None or isinstance(value, Mapping | list | tuple) else value


PARTS: dict[str, Callable[[Path], Found]] = {
    "recordings": recordings,
    "exams": exams,
    "exports": exports,
    "trainings": trainings,
    "kept": kept,
}

# ---- the comparison ------------------------------------------------------------------------------------------------------------------


def differences(a: Found, b: Found, tolerances: Mapping[str, float], most: int = 8) -> tuple[list[str], bool]:
    """A line a run, below it what differs, the first step first; and whether any of it is more than its tolerance.

    NaN equals NaN, and -0.0 equals 0.0. ``tolerances``: by quantity, or the part of its name before a slash; "" is for all others.
    """
    lines, failed = [], False
    for run in dict.fromkeys([*a, *b]):
        if run not in a or run not in b:
            lines.append(f"{run:28} only in {'A' if run in a else 'B'}  <--")
            failed = True
            continue
        names = [name for name in dict.fromkeys([*a[run], *b[run]]) if not name.startswith(NAMES)]
        found = [(*_difference(name, a[run], b[run]), name) for name in names]
        more = [
            gap > tolerances.get(name, tolerances.get(name.split("/")[0], tolerances.get("", 0.0)))
            for _, gap, _, name in found
        ]
        broken = "error" in a[run] or "error" in b[run]
        failed |= any(more) or broken
        different = sorted(
            (step, not over, text, name) for (step, gap, text, name), over in zip(found, more, strict=True) if gap
        )
        lines.append(
            f"{run:28} {len(names) - len(different)} of {len(names)} equal{'  <--' if any(more) or broken else ''}"
        )
        lines += [
            f"    {name:30} {text}{'  (within its tolerance)' if within else ''}"
            for _, within, text, name in different[:most]
        ]
        lines += [f"    and {len(different) - most} more"] if len(different) > most else []
        lines += [f"    {a[run]['error']}"] if "error" in a[run] and not different else []
    return lines, failed


def _difference(name: str, ours: Mapping[str, np.ndarray], theirs: Mapping[str, np.ndarray]) -> tuple[int, float, str]:
    """At which step ``name`` differs first, by how much (infinity where the two cannot be compared), and both in words."""
    if name not in ours or name not in theirs:
        return NO_STEP, np.inf, f"only in {'A' if name in ours else 'B'}"
    a, b = ours[name], theirs[name]
    if a.dtype.kind in "US" and b.dtype.kind in "US":
        rows = [(x, y) for x, y in zip(np.atleast_1d(a), np.atleast_1d(b), strict=False) if x != y]
        if not rows and a.shape == b.shape:
            return NO_STEP, 0.0, "equal"
        x, y = rows[0] if rows else (f"{len(a)} lines", f"{len(b)} lines")
        return NO_STEP, np.inf, f"{str(x).strip()[:80]!r} and {str(y).strip()[:80]!r}"
    if a.shape != b.shape or a.dtype != b.dtype:
        return NO_STEP, np.inf, f"{a.dtype}{[*a.shape]} and {b.dtype}{[*b.shape]}"
    x, y = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore"):
        gap = np.where((x == y) | (np.isnan(x) & np.isnan(y)), 0.0, np.abs(x - y))
    where = np.argwhere(np.nan_to_num(gap, nan=np.inf))
    if not len(where):
        return NO_STEP, 0.0, "equal"
    largest = float(np.nan_to_num(gap, nan=np.inf).max())
    if a.ndim == 0:
        return NO_STEP, largest, f"{a} and {b}"
    columns, steps = ((theirs | ours).get(f"{of}/{name}") for of in ("columns", "steps"))
    step = NO_STEP if steps is None else int(steps[where[0, 0]])
    text = f"{largest:.3g}" if steps is None else f"{largest:.3g} first at step {step}"
    if columns is not None:
        first = where if steps is None else where[where[:, 0] == where[0, 0]]
        named = [str(columns[i]) for i in sorted({int(row[-1]) for row in first})]
        text += f" in {', '.join(named[:6])}" + (f" and {len(named) - 6} more" if len(named) > 6 else "")
    return step, largest, text


# ---- two sides -----------------------------------------------------------------------------------------------------------------------


def save(file: Path, found: Found, **more: Any) -> None:
    """Whole or not at all."""
    file.parent.mkdir(parents=True, exist_ok=True)
    arrays = {f"{run}|{name}": value for run, values in found.items() for name, value in values.items()}
    with tempfile.NamedTemporaryFile(dir=file.parent, suffix=".npz", delete=False) as part:
        np.savez_compressed(part, **arrays, **more)
    os.replace(part.name, file)


def load(file: Path) -> Found:
    found: Found = {}
    with np.load(file) as arrays:
        for key in arrays:
            run, bar, name = key.partition("|")
            if bar:
                found.setdefault(run, {})[name] = arrays[key]
    return found


class Side:
    """A commit or a checkout, and what was found of it."""

    def __init__(self, name: str, stack: contextlib.ExitStack) -> None:
        self.name, self._stack = name, stack
        self._folder = Path(name).resolve() if Path(name).is_dir() else None
        self.commit = "" if self._folder else _git("rev-parse", "--verify", f"{name}^{{commit}}")
        self.cpu_seconds = 0.0

    def find(self, part: str) -> Found:
        """Of a commit, what was found before with the same net, libraries and machine."""
        file = REPOSITORY / "logs" / "net" / f"{self.commit[:12]}-{_machine()}" / f"{part}.npz"
        if self.commit and file.exists():
            return load(file)
        print(f"{self.name}: {part} ...", file=sys.stderr, flush=True)
        scratch = Path(self._stack.enter_context(tempfile.TemporaryDirectory()))
        before = _cpu_of_children()
        in_checkout(self._root(), part, scratch / "found.npz", scratch)
        self.cpu_seconds += _cpu_of_children() - before
        found = load(scratch / "found.npz")
        if self.commit:
            save(file, found)
        return found

    def _root(self) -> Path:
        if self._folder is None:
            self._folder = Path(self._stack.enter_context(tempfile.TemporaryDirectory())) / "checkout"
            _git("worktree", "add", "--detach", str(self._folder), self.commit)
            self._stack.callback(_git, "worktree", "remove", "--force", str(self._folder))
        return self._folder


def in_checkout(root: Path, part: str, out: Path, folder: Path) -> None:
    """A part of the checkout at ``root``, in a process of its own that stands in ``folder``."""
    command = [sys.executable, str(HERE), "--part", part, "--root", str(root), "--out", str(out)]
    subprocess.run(command, cwd=folder, env={**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}, check=True)


def _machine() -> str:
    """What decides numbers beside the checkout, in short."""
    versions = [f"{name} {metadata.version(name)}" for name in DECIDES]
    sources = [(HERE.parent / name).read_text() for name in ("compare.py", "recordings.py")]
    cpu = (
        Path("/proc/cpuinfo").read_text().partition("model name")[2].partition("\n")[0]
        if Path("/proc/cpuinfo").exists()
        else ""
    )
    return hashlib.sha256("\n".join([*versions, *sources, cpu, platform.platform(), sys.version]).encode()).hexdigest()[
        :12
    ]


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", str(REPOSITORY), *words], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"git {' '.join(words)}: {done.stderr.strip()}")
    return done.stdout.strip()


def _cpu_of_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def compare(a: str, b: str, parts: Sequence[str], tolerances: Mapping[str, float]) -> bool:
    """Print one table; whether they differ."""
    differ = []
    with contextlib.ExitStack() as stack:
        sides = Side(a, stack), Side(b, stack)
        for part in parts:
            lines, failed = differences(*(side.find(part) for side in sides), tolerances)
            print(f"{part}\n" + "\n".join(f"  {line}" for line in lines), flush=True)
            differ += [part] if failed else []
        for letter, side in zip("AB", sides, strict=True):
            print(
                f"{letter}: {side.name}{f' ({side.commit[:12]})' if side.commit else ''}, {side.cpu_seconds / 60:.1f} minutes of CPU"
            )
    print(f"A and B differ: {', '.join(differ)}" if differ else "A and B are alike")
    return bool(differ)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sides", nargs="*", metavar="A B", help="a commit, a branch, or the folder of a checkout")
    named = [part for part in PARTS if part != "kept"]
    parser.add_argument("--only", action="append", choices=named, help="a part; may be repeated")
    parser.add_argument(
        "--tolerance", action="append", default=[], help="a number, or QUANTITY=NUMBER; may be repeated"
    )
    parser.add_argument("--keep", metavar="FILE", type=Path)
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--root", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--out", type=Path, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.part:
        save(args.out, PARTS[args.part](args.root))
        return 0
    if args.keep:
        in_checkout(REPOSITORY, "kept", args.keep.resolve(), Path.cwd())
        return 0
    if len(args.sides) != 2:
        parser.error("two sides: make net A B")
    given = [text.rpartition("=") for text in args.tolerance]
    return int(compare(*args.sides, args.only or named, {"": 0.0} | {name: float(number) for name, _, number in given}))


if __name__ == "__main__":
    sys.exit(main())
