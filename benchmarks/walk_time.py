"""How long it takes from the command to a policy that walks, and to one that beats its peer: trainings side by side, graded afterwards.

    python benchmarks/walk_time.py --seeds 1,2,3 -- --max_time 60s
    python benchmarks/walk_time.py --variants variants.txt --gpus 2 -- --max_time 60s --seed 1
    python benchmarks/walk_time.py --seeds 1,2,3,4 --device cpu --by_exam -- --max_time 8m --set runner.exam_interval=50

What stands behind -- are train.py's flags, for all. A file of variants has a line each, NAME: FLAGS, # begins a comment. Each GPU, or
each pair of --cores on a CPU, is a lane that trains one after another. Checkpoints are graded on the CPU (MuJoCo's own engine) while the
next one trains; with --by_exam the small exams during training count, and nothing is graded.
"""

from __future__ import annotations

import argparse
import json
import os
import queue
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from legged_mw.utils.task import load_task

ROOT = Path(__file__).resolve().parent.parent
HEAD = (
    "name",
    "walks [s]",
    "at iteration",
    "walk of graded",
    "beats [s]",
    "at iteration",
    "beat",
    "ends [s]",
    "iterations",
    "steps/s",
    "last",
)


class Job:
    """One training: what it is called, its flags, and what is known of it afterwards."""

    def __init__(self, name: str, flags: list[str]) -> None:
        self.name, self.flags = name, flags
        self.folder, self.seconds, self.code, self.pace, self.begun = "", 0.0, 0, 0.0, 0.0
        self.results: list[dict[str, Any]] = []


def jobs(args: argparse.Namespace) -> list[Job]:
    """Every variant with every seed."""
    lines = Path(args.variants).read_text(encoding="utf-8").splitlines() if args.variants else [": "]
    parts = [line.partition("#")[0].partition(":") for line in lines if line.partition("#")[0].strip()]
    seeds = [seed for seed in args.seeds.split(",") if seed] or [""]
    named = [(name.strip(), shlex.split(more)) for name, _, more in parts]
    return [
        Job(
            f"{name}{' ' * bool(name and seed)}{'s' * bool(seed)}{seed}" or "default",
            [*flags, *(["--seed", seed] if seed else [])],
        )
        for name, flags in named
        for seed in seeds
    ]


def begin(command: list[str], env: dict[str, str], cores: set[int], errors: int) -> subprocess.Popen[str]:
    """A program that runs on those cores."""
    process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=subprocess.PIPE, stderr=errors, text=True)
    os.sched_setaffinity(process.pid, cores)
    return process


def train(job: Job, args: argparse.Namespace, env: dict[str, str], cores: set[int]) -> None:
    """Train; seconds count from here. Small exams are noted as they are printed."""
    name = re.sub(r"[^\w.=-]+", "_", job.name)
    command = [
        sys.executable,
        "train.py",
        "--task",
        args.task,
        "--set",
        "runner.export=false",
        "--set",
        f"runner.save_interval={args.save}",
    ]
    command += [
        *([] if args.by_exam else ["--set", "runner.exam_interval=0"]),
        "--experiment_name",
        args.experiment,
        "--run_name",
        name,
    ]
    command += [*(["--device", "cpu"] if args.device == "cpu" else []), *args.flags, *job.flags]
    job.begun, tail, paces = time.time(), [""] * 5, list[float]()
    with begin(command, env, cores, subprocess.STDOUT) as process:
        assert process.stdout is not None
        for line in process.stdout:
            tail = [*tail[1:], line.rstrip()]
            if line.startswith("writing to "):
                job.folder = line.removeprefix("writing to ").strip()
            if match := re.search(r"([\d,]+) steps/s", line):
                paces.append(float(match[1].replace(",", "")))
            if match := re.match(r"Exam after iteration (\d+)/\d+: (.*)", line):
                figures = {name: float(value) for name, value in (part.rsplit(" ", 1) for part in match[2].split(", "))}
                job.results.append({"iteration": int(match[1]), "seconds": time.time() - job.begun, **figures})
    job.seconds, job.code = time.time() - job.begun, process.returncode
    job.pace = sorted(paces)[len(paces) // 2] if paces else 0.0
    print(f"trained: {job.name}: code {job.code}, {job.seconds:.1f} s, {job.pace:,.0f} steps/s", flush=True)
    if job.code:
        print("\n".join(tail), flush=True)


def grade(job: Job, args: argparse.Namespace, env: dict[str, str], cores: set[int], out: Path) -> None:
    """Every checkpoint's exam, seconds from the command."""
    file = out / f"{Path(job.folder).name}.json"
    command = [
        sys.executable,
        "benchmarks/checkpoints.py",
        job.folder,
        "--every",
        str(args.every),
        "--device",
        "cpu",
        "--out",
        str(file),
    ]
    with begin(command, env, cores, subprocess.PIPE) as process:
        said, errors = process.communicate()
    if process.returncode:
        print(f"not graded: {job.name}: {errors.strip()[-300:]}", flush=True)
        return
    start = (ROOT / job.folder / "config.yaml").stat().st_mtime - job.begun
    job.results = [
        {**result, "seconds": result["seconds"] + start} for result in json.loads(file.read_text(encoding="utf-8"))
    ]
    file.write_text(json.dumps({"name": job.name, "flags": job.flags, "results": job.results}) + "\n", encoding="utf-8")
    print(f"graded: {' | '.join(row(job, args.task))}\n{said}", end="", flush=True)


def walks(result: dict[str, Any], marks: list[float]) -> bool:
    """By the exam, or by the small one of training."""
    if "walks" in result:
        return bool(result["walks"])
    errors = [result["error_vx"], result["error_vy"], result["error_yaw"]]
    return (
        not result["falls"]
        and result["pushes_survived"] == 1.0
        and all(a <= b for a, b in zip(errors, marks, strict=True))
    )


def row(job: Job, task: str) -> list[str]:
    """A line of the table."""
    marks = load_task(task).cfg.exam.marks
    cells = [job.name]
    for verdict in (lambda result: walks(result, marks), lambda result: result.get("beats_peer", False)):
        good = [result for result in job.results if verdict(result)]
        first = [f"{good[0]['seconds']:.1f}", str(good[0]["iteration"])] if good else ["-", "-"]
        cells += [*first, f"{len(good)} of {len(job.results)}"]
    last = job.results[-1] if job.results else {}
    error = last.get("error") or [last[name] for name in ("error_vx", "error_vy", "error_yaw") if name in last]
    more = (
        f"; drift {last['drift'] or 0:.4f}, cost {last['cost_of_transport']:.3f}"
        if last.get("cost_of_transport")
        else ""
    )
    told = f"{', '.join(f'{value:.3f}' for value in error)}; falls {last.get('falls', '-')}{more}"
    return [*cells, f"{job.seconds:.1f}", str(last.get("iteration", "-")), f"{job.pace:,.0f}", told]


def lane(waiting: queue.SimpleQueue[Job | None], work: Callable[[Job], None]) -> threading.Thread:
    """A thread that works on what waits until there is None."""

    def run() -> None:
        while (job := waiting.get()) is not None:
            work(job)
        waiting.put(None)

    thread = threading.Thread(target=run)
    thread.start()
    return thread


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_flat")
    parser.add_argument("--variants", help="a file of them")
    parser.add_argument("--seeds", default="", help="1,2,3: each variant with each")
    parser.add_argument("--gpus", type=int, default=1)
    parser.add_argument("--device", choices=["cpu"], help="train on the CPU")
    parser.add_argument("--cores", type=int, default=2, help="of each training on the CPU")
    parser.add_argument("--graders", type=int, default=2, help="programs that grade side by side")
    parser.add_argument("--by_exam", action="store_true", help="grade nothing; take the small exams of training")
    parser.add_argument("--save", type=int, default=25, help="iterations between checkpoints")
    parser.add_argument("--every", type=int, default=25, help="iterations between graded checkpoints")
    parser.add_argument("--experiment", default="walk_time", help="folder below logs/")
    parser.add_argument("--out", type=Path, default=Path("logs/walk_time"), help="folder for the results")
    parser.add_argument("flags", nargs="*", help="of train.py, after --")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    cores, todo, trained = sorted(os.sched_getaffinity(0)), jobs(args), queue.SimpleQueue[Job | None]()
    base = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])])}
    gpus = [each for each in os.environ.get("CUDA_VISIBLE_DEVICES", "").split(",") if each] or [
        str(i) for i in range(args.gpus)
    ]
    places: list[tuple[dict[str, str], set[int]]] = [
        ({**base, "CUDA_VISIBLE_DEVICES": gpu}, set(cores)) for gpu in gpus[: args.gpus]
    ]
    if args.device == "cpu":
        places = [(base, set(cores[i : i + args.cores])) for i in range(0, len(cores) - args.cores + 1, args.cores)]
    waiting = queue.SimpleQueue[Job | None]()
    for job in [*todo, None]:
        waiting.put(job)

    def train_at(env: dict[str, str], mine: set[int]) -> Callable[[Job], None]:
        def work(job: Job) -> None:
            train(job, args, env, mine)
            if job.folder and not args.by_exam:
                trained.put(job)

        return work

    share = max(1, (len(cores) - 2 * args.gpus) // args.graders)  # the last ones: the trainings keep two each
    free = [set(cores[-share * (i + 1) :][:share]) for i in range(args.graders)]
    graders = [lane(trained, lambda job, mine=mine: grade(job, args, base, mine, args.out)) for mine in free]
    for thread in [lane(waiting, train_at(env, mine)) for env, mine in places]:
        thread.join()
    trained.put(None)
    for thread in graders:
        thread.join()
    print(f"\n{' | '.join(HEAD)}")
    for job in todo:
        print(" | ".join(row(job, args.task)))


if __name__ == "__main__":
    main()
