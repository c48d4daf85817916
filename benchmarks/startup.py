"""Where the time goes from the command to the first iterations: python benchmarks/startup.py --task go1_flat

A fresh process runs train.py, and each of its parts is timed; other flags are train.py's. Warm: the second of two runs, when kernels
and files are cached. --plain leaves out what legged_mw/fast/quick_start.py does.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

ITERATIONS = 5
FIRST = "iteration 1 (records the step)"
ROOT = Path(__file__).resolve().parent.parent


class Clock:
    """Prints `<seconds> <modules imported> <what>` a part."""

    def __init__(self, started: float) -> None:
        self._last, self._modules = started, 0

    def done(self, what: str) -> None:
        now, modules = time.time(), len(sys.modules)
        print(f"{now - self._last:.3f} {modules - self._modules} {what}", flush=True)
        self._last, self._modules = now, modules

    def after(self, owner: Any, name: str, what: str) -> None:
        """Time to the end of the first call of a function, which goes by ``name`` in a module or class."""
        call, left = getattr(owner, name), [what]

        def timed(*args: Any, **kwargs: Any) -> Any:
            value = call(*args, **kwargs)
            if left:
                synchronize()
                self.done(left.pop())
            return value

        setattr(owner, name, timed)


def child(flags: list[str], device: str | None, plain: bool, started: float) -> None:
    """train.py until a few iterations are done; its imports come one by one, in its own order."""
    clock = Clock(started)
    from legged_mw import programs
    from legged_mw.fast import quick_start

    clock.done("interpreter, flags")
    if not plain:
        quick_start.begin(device)
    import_libraries(clock, device)
    runner = look_into_training(clock)
    runner._update = count(clock, runner._update)
    sys.argv = ["train.py", *flags]
    programs.train()


def import_libraries(clock: Clock, device: str | None) -> None:
    """Time what train.py imports of others."""
    import torch

    clock.done("import torch")
    import_module("mujoco")
    clock.done("import mujoco")
    if torch.cuda.is_available() and device != "cpu":  # elsewhere MuJoCo's own engine steps
        import_module("warp")
        clock.done("import warp (for a GPU)")
        import_module("mujoco_warp")
        clock.done("import mujoco_warp (for a GPU)")
    import_module("rsl_rl.runners")
    clock.done("import rsl_rl, tensordict")


def look_into_training(clock: Clock) -> Any:
    """Import legged_mw, and time what a training does before its first step. Returns the class of its runner."""
    modules = {
        name: import_module(f"legged_mw.{name}")
        for name in ("rl.training", "check.guard", "check.describe", "eval.exams")
    }
    clock.done("import legged_mw")
    clock.after(modules["rl.training"], "configure", "task, config, open the device")
    clock.after(modules["check.guard"], "check_recordable", "check that the step can be recorded")
    clock.after(modules["rl.training"], "build", "environment: model, buffers, first kernels")
    clock.after(modules["eval.exams"], "make_exam", "the exam's environment")
    clock.after(modules["rl.training"], "make_runner", "networks, storage")
    clock.after(modules["rl.training"], "_open_run", "run folder")
    runner = import_module("legged_mw.rl.runner").Runner
    clock.after(runner, "_open_curves", "TensorBoard writer, git")
    return runner


def count(clock: Clock, update: Callable[..., Any]) -> Callable[..., Any]:
    """The update, with which an iteration is done; the process ends with the last."""
    done = 0

    def counted(*args: Any) -> Any:
        nonlocal done
        value = update(*args)
        synchronize()
        done += 1
        clock.done(FIRST if done == 1 else f"iteration {done}{' (records the update)' if done == 4 else ''}")
        if done == ITERATIONS:
            os._exit(0)
        return value

    return counted


def synchronize() -> None:
    import torch

    if torch.cuda.is_initialized():
        torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device")
    parser.add_argument("--plain", action="store_true")
    parser.add_argument("--started", type=float, help=argparse.SUPPRESS)
    args, flags = parser.parse_known_args()
    flags += ["--device", args.device] if args.device else []
    flags += [] if "--task" in flags else ["--task", "go1_flat"]
    sys.path.insert(0, str(ROOT))
    if args.started:
        child(flags, args.device, args.plain, args.started)
        return
    table: dict[str, list[float]] = {}
    modules = dict[str, int]()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    for _ in range(2):
        command = [sys.executable, __file__, *sys.argv[1:], "--started", str(time.time())]
        with tempfile.TemporaryDirectory() as folder:  # for logs/
            out = subprocess.run(
                command, cwd=folder, env=environment, check=True, stdout=subprocess.PIPE, text=True
            ).stdout
        for line in out.splitlines():
            if found := re.fullmatch(r"(\d+\.\d{3}) (\d+) (.+)", line):
                table.setdefault(found[3], []).append(float(found[1]))
                modules[found[3]] = int(found[2])
    print(f"{'':<48}{'first':>8}{'warm':>8}   [s]  modules")
    for what, values in table.items():
        print(f"{what:<48}" + "".join(f"{value:>8.2f}" for value in values) + f"{modules[what]:>14}")
    until_first = list(table)[: list(table).index(FIRST) + 1]
    total = "".join(f"{sum(table[what][i] for what in until_first):>8.2f}" for i in (0, 1))
    print(f"{'from the command to the end of iteration 1':<48}{total}{sum(modules[what] for what in until_first):>14}")


if __name__ == "__main__":
    main()
