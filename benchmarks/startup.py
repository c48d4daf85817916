"""Where the time goes from the command to the first iterations: python benchmarks/startup.py --task go1_flat

A fresh process does what train.py does, step by step. Warm: the second of two runs, when kernels and files are cached.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from importlib import import_module
from pathlib import Path

FIRST = "iteration 1 (records the step)"
ROOT = Path(__file__).resolve().parent.parent


def child(task_name: str, num_envs: int | None, device: str | None, started: float) -> None:
    """Every step, timed; printed as `<seconds> <what>`."""
    last = started

    def done(what: str) -> None:
        nonlocal last
        now = time.time()
        print(f"{now - last:.3f} {what}", flush=True)
        last = now

    done("interpreter")
    import torch

    done("import torch")
    import_module("mujoco")
    done("import mujoco")
    if torch.cuda.is_available() and device != "cpu":  # elsewhere MuJoCo's own engine steps
        import_module("mujoco_warp")
        import_module("warp").init()
    done("import warp, mujoco_warp (for a GPU)")
    import_module("rsl_rl.runners")
    done("import rsl_rl, tensordict")
    from legged_mw.rl.runner import make_runner
    from legged_mw.utils.cli import pick_device, seed_everything
    from legged_mw.utils.task import load_task

    task = load_task(task_name)
    done("import legged_mw, load the task")
    device = pick_device(device)
    seed_everything(1)
    if device == "cpu":
        torch.set_num_threads(1)  # as train.py does
    else:
        torch.cuda.set_device(device)
    torch.zeros(1, device=device)
    done("open the device")
    if num_envs:
        task.cfg.env.num_envs = num_envs
    env = task.env_class(task.cfg, device)
    synchronize(device)
    done("environment: model, buffers, first kernels")
    with tempfile.TemporaryDirectory() as folder:
        runner = make_runner(env, task.train, Path(folder), device)
        done("networks, storage")
        runner.logger.init_logging_writer()
        done("TensorBoard writer")
        runner.logger.init_logging_writer = lambda: None  # type: ignore[method-assign]
        for i in range(5):
            runner.learn(1, False)
            synchronize(device)
            done(FIRST if i == 0 else f"iteration {i + 1}{' (records the update)' if i == 3 else ''}")


def synchronize(device: str) -> None:
    import torch

    if device != "cpu":
        torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="go1_flat")
    parser.add_argument("--num_envs", type=int)
    parser.add_argument("--device")
    parser.add_argument("--started", type=float, help=argparse.SUPPRESS)
    args = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    if args.started:
        child(args.task, args.num_envs, args.device, args.started)
        return
    table: dict[str, list[float]] = {}
    for _ in range(2):
        command = [sys.executable, __file__, *sys.argv[1:], "--started", str(time.time())]
        out = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True).stdout
        for line in out.splitlines():
            seconds, _, what = line.partition(" ")
            if seconds.replace(".", "", 1).isdigit() and what:
                table.setdefault(what, []).append(float(seconds))
    print(f"{'':<48}{'first':>8}{'warm':>8}   [s]")
    for what, values in table.items():
        print(f"{what:<48}" + "".join(f"{value:>8.2f}" for value in values))
    until_first = list(table)[: list(table).index(FIRST) + 1]
    total = "".join(f"{sum(table[what][i] for what in until_first):>8.2f}" for i in (0, 1))
    print(f"{'from the command to the end of iteration 1':<48}{total}")


if __name__ == "__main__":
    main()
