"""Records what a checkout's environments do, and compares two recordings bit for bit.

python tests/net/compare.py record --root CHECKOUT --out FILE.npz [--only go1_flat/mujoco] [--steps 20]
python tests/net/compare.py keep --root CHECKOUT --out tests/net/first_steps.npz     what tests/test_net.py compares with
python tests/net/compare.py diff A B [--tolerance 0] [--tolerance reward=1e-5]     A, B: a recording, or a checkout to record now

The same seed, actions and episode ages for both; what differs is the code. Only public names of the environment are used,
so that the recorder runs on older and newer checkouts alike.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

ENGINES = ("mujoco", "mujoco_warp")
TASKS = ("go1_flat", "go1_flat_dr", "go1_rough", "examples/go1_legged_gym.py")
# Episodes end, commands change, and robots are kicked and pushed many times within a recording. An entry with several paths: the
# first that this checkout has.
OFTEN: dict[str | tuple[str, ...], Any] = {
    "env.episode_length_s": 1.2,
    "commands.resampling_time": 0.5,
    ("perturbation.kick", "perturbation.enable"): True,
    "perturbation.interval": [0.05, 0.4],
    "perturbation.push": True,
    "perturbation.push_interval_s": 0.5,
    "sim.threads": 1,
}
EXTRA: dict[str, dict[str, Any]] = {
    "go1_flat": {"rewards.only_positive_rewards": False},  # random actions earn less than 0: the clip would hide most of it
    "go1_flat_dr": {"domain_rand.observation_delay": [0, 2], "commands.curriculum": True},
    "go1_rough": {
        **{"terrain.num_rows": 3, "terrain.num_cols": 8, "terrain.tile_size": 4.0},
        **{"terrain.border_size": 1.0, "terrain.horizontal_scale": 0.1},
        "init_state.pos_xy_range": 2.2,  # some begin beyond half a tile, go up a level, or leave the terrain
    },
}


# As built, after a reset, after each step: the file stays small, and a difference lasts. What the critic sees begins with `state`.
KEPT_STEPS = {"state": [0, 2, 5, 13, 21], "privileged_state": [1, 9, 17]}


def make_env(task: str, engine: str, worlds: int) -> Any:
    """The task's environment on a CPU, with all that may happen happening often."""
    import torch

    from legged_mw import ROOT
    from legged_mw.utils.config import ConfigError
    from legged_mw.utils.task import load_task

    loaded = load_task(str(ROOT / task) if task.endswith(".py") else task)
    for paths, value in {**OFTEN, **EXTRA.get(task, {}), "sim.engine": engine, "env.num_envs": worlds}.items():
        paths = (paths,) if isinstance(paths, str) else paths
        for path in paths:
            try:
                loaded.set(path, value)
                break
            except ConfigError:
                if path == paths[-1]:
                    raise
    torch.manual_seed(1)
    return loaded.env_class(loaded.cfg, "cpu")


def rollout(task: str, engine: str, worlds: int = 32, steps: int = 150) -> dict[str, np.ndarray]:
    """Seeded random actions: ``obs/<group>`` (steps + 2, N, C): as built, after a reset, after each step; and all else by name."""
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # the order of a sum depends on it
    env = make_env(task, engine, worlds)
    own = torch.Generator().manual_seed(2)
    observed, stepped = [env.get_observations(), env.reset()], []
    env.episode_length_buf = torch.randint(0, int(env.max_episode_length), (worlds,), generator=own)
    for _ in range(steps):
        obs, reward, done, extras = env.step(0.5 * torch.randn(worlds, env.num_actions, generator=own))
        observed.append(obs)
        stepped.append((reward, done, extras["time_outs"], env.episode_length_buf.clone()))
    taken = {f"obs/{group}": torch.stack([obs[group] for obs in observed]) for group in list(observed[0].keys())}
    for name, values in zip(("reward", "done", "time_out", "episode_length"), zip(*stepped, strict=True), strict=True):
        taken[name] = torch.stack(values)
    for name, value in env.name_statistics(env.take_statistics().tolist()).items():
        taken[f"statistic/{name}"] = torch.tensor(value, dtype=torch.double)
    taken |= {f"training_state/{name}": torch.as_tensor(value) for name, value in env.training_state().items()}
    torch.set_num_threads(threads)
    return {name: value.numpy() for name, value in taken.items()} | _columns(env)


def _columns(env: Any) -> dict[str, np.ndarray]:
    """``columns/<group>``: the row that each column is of, where the environment says so."""
    if hasattr(env, "observation_table"):  # group -> (name, size, noise)
        table = {group: [(name, size) for name, size, *_ in rows] for group, rows in env.observation_table.items()}
    elif hasattr(env, "observations"):
        groups = env.observations.groups
        table = {group: [(r.name, r.value.shape[1] * getattr(r, "history", 1)) for r in rows] for group, rows in groups.items()}
    else:
        table = {}
    return {f"columns/{group}": np.array([f"{name}[{i}]" for name, size in rows for i in range(size)]) for group, rows in table.items()}


def first_steps(task: str, engine: str) -> dict[str, np.ndarray]:
    """What ``tests/test_net.py`` compares: 20 steps of 8 worlds.

    Of observations a few steps, which a line about them counts, and every other world.
    """
    taken = rollout(task, engine, worlds=8, steps=20)
    kept = {name: value for name, value in taken.items() if not name.startswith(("statistic/", "training_state/"))}
    for group, steps in KEPT_STEPS.items():
        if f"obs/{group}" in kept:
            kept[f"obs/{group}"] = kept[f"obs/{group}"][steps, ::2]
    return kept


def record(only: Iterable[str] = (), steps: int = 150, keep: bool = False) -> dict[str, np.ndarray]:
    """All tasks on all engines, by ``<task>/<engine>/<quantity>``; a task that fails leaves its error."""
    recorded: dict[str, np.ndarray] = {}
    for engine in ENGINES:
        for task in TASKS:
            run = f"{Path(task).stem}/{engine}"
            if only and run not in only and engine not in only and Path(task).stem not in only:
                continue
            try:
                taken = first_steps(task, engine) if keep else rollout(task, engine, steps=steps)
            except Exception as error:  # the other tasks are worth comparing all the same
                taken = {"error": np.array(f"{type(error).__name__}: {error}")}
                print(f"{run}: {taken['error']}", file=sys.stderr, flush=True)
            recorded |= {f"{run}/{name}": value for name, value in taken.items()}
    return recorded


def in_checkout(root: Path, program: str, out: Path, *options: str) -> None:
    """Record the checkout at ``root`` in a process of its own, whose sources are that checkout's."""
    command = [sys.executable, str(Path(__file__).resolve()), program, "--inside", "--out", str(out.resolve()), *options]
    subprocess.run(command, cwd=root, env={**os.environ, "PYTHONPATH": str(root.resolve())}, check=True)


def differences(a: Mapping[str, np.ndarray], b: Mapping[str, np.ndarray], tolerances: Mapping[str, float]) -> tuple[list[str], bool]:
    """Lines that say what differs, and whether any of it is more than its tolerance. NaN equals NaN, and -0.0 equals 0.0."""
    lines, failed = [], False
    for run in dict.fromkeys("/".join(name.split("/")[:2]) for name in [*a, *b]):
        ours, theirs = ({n.removeprefix(f"{run}/"): v for n, v in part.items() if n.startswith(f"{run}/")} for part in (a, b))
        names = [name for name in dict.fromkeys([*ours, *theirs]) if not name.startswith("columns/")]
        equal = 0
        for name in names:
            if name not in ours or name not in theirs:
                lines.append(f"{run:24} {name:30} only in {'A' if name in ours else 'B'}")
                failed |= not name.startswith(("statistic/", "training_state/"))
                continue
            text, largest = _difference(ours[name], theirs[name], (theirs | ours).get(f"columns/{name.removeprefix('obs/')}"))
            allowed = tolerances.get(name, tolerances.get(name.split("/")[0], tolerances[""]))
            equal += largest == 0
            if largest != 0:
                lines.append(f"{run:24} {name:30} {text}{'' if largest <= allowed else '  <-- more than ' + format(allowed, 'g')}")
            failed |= not largest <= allowed
        lines.append(f"{run:24} {equal} of {len(names)} equal")
    return lines, failed


def _difference(a: np.ndarray, b: np.ndarray, columns: np.ndarray | None) -> tuple[str, float]:
    """What differs most, where first and in which columns; and by how much, infinity where the two cannot be compared."""
    if a.shape != b.shape:
        return f"shape {a.shape} and {b.shape}", np.inf
    if a.dtype.kind in "US" or b.dtype.kind in "US":
        return f"{a} and {b}", 0.0 if a == b and "error" not in str(a).lower() else np.inf
    if a.dtype != b.dtype:
        return f"dtype {a.dtype} and {b.dtype}", np.inf
    x, y = a.astype(np.float64), b.astype(np.float64)
    with np.errstate(invalid="ignore"):
        gap = np.where((x == y) | (np.isnan(x) & np.isnan(y)), 0.0, np.abs(x - y))
    gap = np.where(np.isnan(gap), np.inf, gap)
    where = np.argwhere(gap)
    if not len(where):
        return "equal", 0.0
    first = f" first at step {where[0, 0] - 2 if a.ndim == 3 else where[0, 0]}" if a.ndim > 1 else f" {x} and {y}" if a.ndim == 0 else ""
    if a.ndim == 3:  # observations: step -2 is as built, -1 after the reset
        which = sorted(set(where[where[:, 0] == where[0, 0]][:, 2].tolist()))
        names = [str(columns[i]) if columns is not None and i < len(columns) else str(i) for i in which]
        first += f" in {', '.join(names[:6])}{f' and {len(names) - 6} more' if len(names) > 6 else ''}"
    return f"{gap.max():.3g}{first}", float(gap.max())


def load(path: Path) -> dict[str, np.ndarray]:
    """A recording from its file; a folder is a checkout, which is recorded now."""
    if path.is_dir():
        with tempfile.TemporaryDirectory() as folder:
            in_checkout(path, "record", Path(folder) / "now.npz")
            return load(Path(folder) / "now.npz")
    with np.load(path) as file:
        return dict(file)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    programs = parser.add_subparsers(dest="program", required=True)
    for name in ("record", "keep"):
        program = programs.add_parser(name)
        program.add_argument("--root", type=Path, default=Path("."), help="the checkout")
        program.add_argument("--out", type=Path, required=True)
        program.add_argument("--only", action="append", default=[], help="a task, an engine or <task>/<engine>; may be repeated")
        program.add_argument("--steps", type=int, default=150)
        program.add_argument("--inside", action="store_true", help=argparse.SUPPRESS)
    program = programs.add_parser("diff")
    program.add_argument("a", type=Path)
    program.add_argument("b", type=Path)
    program.add_argument("--tolerance", action="append", default=[], help="a number, or <quantity>=<number>; may be repeated")
    args = parser.parse_args()
    if args.program == "diff":
        given = [text.rpartition("=") for text in args.tolerance]
        lines, failed = differences(load(args.a), load(args.b), {"": 0.0} | {name: float(number) for name, _, number in given})
        print("\n".join(lines))
        return int(failed)
    if args.inside:
        np.savez_compressed(args.out, **record(args.only, args.steps, keep=args.program == "keep"))  # pyright: ignore[reportArgumentType]
    else:
        in_checkout(args.root, args.program, args.out, f"--steps={args.steps}", *(f"--only={run}" for run in args.only))
    return 0


if __name__ == "__main__":
    sys.exit(main())
