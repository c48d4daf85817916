"""The exam of many checkpoints of a run, in one environment: when it first walks, or stands, or beats its peers, and how it goes on.

    python benchmarks/checkpoints.py logs/go2_flat/<time> --every 25 --until 500
    python benchmarks/checkpoints.py logs/go2_flat/<time> --ranges common --crossing

Seconds count from the run folder's config.yaml, which is written when the worlds stand and the training begins.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from legged_mw.eval import perform, rollout, rough
from legged_mw.eval.exams import require_exam
from legged_mw.eval.walking import in_common
from legged_mw.rl.policies import load_policy
from legged_mw.rl.run_folder import CONFIG_FILE, checkpoints, task_of, update_from_run
from legged_mw.utils.cli import pick_device, seed_everything
from legged_mw.utils.config import load_yaml
from legged_mw.utils.task import LoadedTask, load_task


def graded(
    run: Path, wanted: list[int], device: str, grade: Callable[[Any, Any], dict[str, Any]], task: LoadedTask
) -> list[dict[str, Any]]:
    """The result of each wanted checkpoint, with its iteration and seconds; printed as it comes."""
    seed_everything(1)
    env, begun, results = task.env_class(task.cfg, device), (run / CONFIG_FILE).stat().st_mtime, []
    for iteration, path in checkpoints(run).items():
        if iteration in wanted:
            policy = load_policy(path, env, task.train, device)
            result = grade(env, policy)
            results.append({"iteration": iteration, "seconds": round(path.stat().st_mtime - begun, 1), **result})
            print(line(results[-1]), flush=True)
    return results


def line(result: dict[str, Any]) -> str:
    """A result in a line, a crossing in its table."""
    start = f"{result['iteration']:>6} {result['seconds']:>7.1f} s"
    if "kinds" in result:
        return f"{start}\n{rough.table(result)}"
    if "walks" not in result:
        return f"{start}  " + "  ".join(
            f"{name} {value:.3f}" for name, value in result.items() if name not in ("iteration", "seconds")
        )
    figures = [f"{name} {', '.join(f'{value:.3f}' for value in result[name])}" for name in ("error", "offset", "worst")]
    drift, cost = (
        f"{result[name]:.3f}" if result[name] is not None else "-" for name in ("drift", "cost_of_transport")
    )
    pushes = ", ".join(f"{share:g}" for share in result["pushes"].values())
    walks = "beats" if result.get("beats_peer") and result["walks"] else "walks" if result["walks"] else "-----"
    return (
        f"{start}  {walks}  falls {result['falls']}  {'  '.join(figures)}  drift {drift}  pushes {pushes}  cost {cost}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument("--task", help="its task, where that is a file outside of the clone")
    parser.add_argument(
        "--every", type=int, default=1, help="iterations between graded checkpoints; the last one is always graded"
    )
    parser.add_argument(
        "--until", type=int, default=10**9, help="the last iteration to grade; then the newest checkpoint is not"
    )
    parser.add_argument("--ranges", choices=["trained", "common"], default="trained")
    parser.add_argument("--crossing", action="store_true", help="the exam's rough part instead")
    parser.add_argument("--device")
    parser.add_argument("--out", type=Path, help="write the results as JSON")
    args = parser.parse_args()
    device, task = pick_device(args.device), load_task(name := args.task or task_of(args.run))
    update_from_run(task, load_yaml(args.run / CONFIG_FILE), where=str(args.run))
    if args.ranges == "common":
        task.update({"exam": in_common(load_task(name).cfg.exam.peer)}, where="--ranges common")
    require_exam(task)
    if task.exam != "walking":
        perform.prepare(task)
        grade: Callable[[Any, Any], dict[str, Any]] = partial(
            perform.first_part, skill=perform.skill_of(task.cfg, task.exam)
        )
    else:
        (rough if args.crossing else rollout).prepare(task)
        grade = rough.run_crossing if args.crossing else rollout.run_exam
    found = [iteration for iteration in checkpoints(args.run) if iteration <= args.until]
    wanted = [iteration for iteration in found if iteration % args.every == 0 or iteration == found[-1]]
    results = graded(args.run, wanted, device, grade, task)
    if args.out:
        args.out.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
