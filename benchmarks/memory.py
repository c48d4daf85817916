"""What memory a task's training takes, by number of worlds, and the smallest GPU that it fits.

    python benchmarks/memory.py --tasks go1_flat go1_rough g1_flat
    python benchmarks/memory.py --tasks go1_flat --worlds 1024 2048 4096 8192 --fit

Each task trains in a process of its own, some iterations with each number of worlds, fewest first. Then in GiB:

- whole: the most that the process held as the driver counts it: the CUDA context, kernels, torch's and warp's pools, recorded
  graphs with memory of their own. It is read every few milliseconds from the free memory of the GPU, on which nothing else may run;
- torch, at most in use and at most held; warp: at most in use. What graphs allocate is in neither.

With --fit the task trains again in new processes, with the last number of worlds, beside a ballast that leaves only some of the
GPU's memory free: ``fits`` is the smallest of --sizes that does, its CUDA context included. A size needs some 10 s.
On a CPU: the most memory that the process held, and no more.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import json
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw import ROOT
from legged_mw.tools.doctor import GIB, Peak
from legged_mw.utils.cli import make_parser, one_line_errors, pick_device, seed_everything
from legged_mw.utils.errors import out_of_memory

ITERATIONS = 4  # by then everything is recorded


def train(task_name: str, worlds: int, device: str, iterations: int) -> None:
    """Build a task's environment and learner, and train for some iterations."""
    from legged_mw.rl.runner import make_runner
    from legged_mw.utils.task import load_task

    task = load_task(task_name)
    task.cfg.env.num_envs = worlds
    task.train.runner.exam_interval = 0
    seed_everything(task.train.seed)
    with contextlib.redirect_stdout(io.StringIO()):
        env = task.env_class(task.cfg, device)
        make_runner(env, task.train, None, device).learn(iterations)


def child(task: str, worlds: Sequence[int], device: str, iterations: int, others: int) -> None:
    """Train with each number of worlds; a line of JSON each. ``others``: what was in use before this process [byte]."""
    for count in worlds:
        row: dict[str, Any] = {"task": task, "worlds": count}
        try:
            row |= (
                cpu_row(task, count, iterations)
                if device == "cpu"
                else gpu_row(task, count, device, iterations, others)
            )
        except Exception as error:
            if not out_of_memory(error) and "of memory" not in str(error):
                raise
            row["error"] = "out of memory"
        print(json.dumps(row), flush=True)
        if "error" in row:
            break


def cpu_row(task: str, worlds: int, iterations: int) -> dict[str, float]:
    torch.set_num_threads(1)  # as train.py does
    train(task, worlds, "cpu", iterations)
    return {"whole": 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / GIB}


def gpu_row(task: str, worlds: int, device: str, iterations: int, others: int) -> dict[str, float]:
    import warp as wp

    torch.cuda.set_device(device)
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    peak = Peak(device)
    with peak.watched():
        train(task, worlds, device, iterations)
        torch.cuda.synchronize(device)
    return {
        "whole": (peak.most - others) / GIB,
        "torch": torch.cuda.max_memory_allocated(device) / GIB,
        "held": torch.cuda.max_memory_reserved(device) / GIB,
        "warp": wp.get_mempool_used_mem_high(device) / GIB,
    }


def rows(args: argparse.Namespace, task: str, worlds: Sequence[int], device: str) -> Iterator[dict[str, Any]]:
    """What a process of its own says of a task, row by row."""
    others = 0 if device == "cpu" else Peak(device).read()
    options = [
        "--child",
        task,
        "--device",
        device,
        "--iterations",
        args.iterations,
        "--others",
        others,
        "--worlds",
        *worlds,
    ]
    command = [sys.executable, __file__, *map(str, options)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    assert process.stdout and process.stderr
    said: list[str] = []  # what goes wrong, read beside: a full pipe would stop the child
    reader = threading.Thread(target=lambda: said.extend(process.stderr or ()), daemon=True)
    reader.start()
    for line in process.stdout:
        if line.startswith("{"):
            yield json.loads(line)
    reader.join(5)
    if process.wait():
        text = "".join(said)
        last = (text.strip().splitlines() or ["it was killed"])[-1][:200]
        yield {
            "task": task,
            "worlds": worlds[-1],
            "error": "out of memory" if out_of_memory(RuntimeError(text)) else last,
        }


class Ballast:
    """Holds memory of a GPU, so that a given amount stays free for others."""

    def __init__(self, device: str) -> None:
        self.device, self.held = device, torch.zeros(0)

    def leave(self, size: float) -> float:
        """Leave ``size`` [GiB] free; what is free in truth."""
        self.held = torch.zeros(0)
        torch.cuda.empty_cache()
        spare = torch.cuda.mem_get_info(self.device)[0] - int(size * GIB)
        if spare > 0:
            self.held = torch.empty(spare, dtype=torch.uint8, device=self.device)
        return torch.cuda.mem_get_info(self.device)[0] / GIB


def smallest(args: argparse.Namespace, task: str, worlds: int, device: str, ballast: Ballast) -> str:
    """The least of the sizes that the task fits, by halving; and what did not."""
    sizes, failed = sorted(args.sizes), []
    low, high = 0, len(sizes)  # everything below low fails, everything from high on fits
    while low < high:
        middle = (low + high) // 2
        ballast.leave(sizes[middle])
        row = list(rows(args, task, [worlds], device))[-1]
        if "error" not in row:
            high = middle
        elif row["error"] == "out of memory":
            low = middle + 1
            failed.append(sizes[middle])
        else:
            return row["error"]
    ballast.leave(1e9)
    fits = (
        f"fits {sizes[high]:g} GiB"
        if high < len(sizes)
        else f"fits none of {', '.join(f'{size:g}' for size in sizes)} GiB"
    )
    return fits + (f"; out of memory with {', '.join(f'{size:g}' for size in sorted(failed))}" if failed else "")


def main() -> None:
    parser = make_parser(__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--tasks", nargs="+", default=["go1_flat", "go1_rough", "g1_flat"])
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 2048, 4096, 8192])
    parser.add_argument("--iterations", type=int, default=ITERATIONS)
    parser.add_argument("--fit", action="store_true", help="find the smallest of --sizes instead")
    parser.add_argument(
        "--sizes", type=float, nargs="+", default=[2, 3, 4, 6, 8, 12, 16, 24], help="of a GPU's memory [GiB]"
    )
    parser.add_argument("--child", help=argparse.SUPPRESS)
    parser.add_argument("--others", type=int, default=0, help=argparse.SUPPRESS)
    args = parser.parse_args()
    device = pick_device(args.device)
    if args.child:
        child(args.child, args.worlds, device, args.iterations, args.others)
        return
    name = torch.cuda.get_device_name(device) if device != "cpu" else "CPU"
    print(f"{name}; torch {torch.__version__}; [GiB]")
    ballast = Ballast(device) if args.fit and device != "cpu" else None
    print(
        f"{'task':>12}{'worlds':>8}"
        + ("" if ballast else f"{'whole':>8}{'torch':>8}{'held':>8}{'warp':>8}{'seconds':>9}")
    )
    for task in args.tasks:
        began = time.perf_counter()
        if ballast:
            print(
                f"{task:>12}{args.worlds[-1]:>8}  {smallest(args, task, args.worlds[-1], device, ballast)}", flush=True
            )
            continue
        for row in rows(args, task, args.worlds, device):
            figures = "".join(
                f"{row[key]:>8.2f}" if key in row else f"{'-':>8}" for key in ("whole", "torch", "held", "warp")
            )
            print(
                f"{task:>12}{row['worlds']:>8}{figures}{time.perf_counter() - began:>9.1f}  {row.get('error', '')}",
                flush=True,
            )


if __name__ == "__main__":
    with one_line_errors():
        main()
