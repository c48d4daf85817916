"""The learning curve of a run as curve.csv and curve.webp: python benchmarks/curve.py logs/go2_flat/<time> resources/policies/go2_flat

Seconds are of training: from the end of its first iteration, which records the step and compiles kernels that are not cached. Pauses are
left out: where a run was resumed, or an iteration took over 5 s and over three times the median for another reason.
"""

from __future__ import annotations

import argparse
import csv
import io
from itertools import accumulate, pairwise
from pathlib import Path
from statistics import median

import matplotlib
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

matplotlib.use("agg")
from matplotlib import pyplot as plt

PAUSE = 5.0  # [s]
COLUMNS = {
    "steps": "Train/total_steps",
    "reward": "Train/mean_reward",
    "action_std": "Policy/mean_std",
    "terrain_level": "Curriculum/terrain_level",
    "stairs_up": "Curriculum/terrain_level/stairs_up",
    "error_vx": "Exam/error_vx",
    "error_vy": "Exam/error_vy",
    "error_yaw": "Exam/error_yaw",
    "falls": "Exam/falls",
    "pushes_survived": "Exam/pushes_survived",
}


def read(run: Path) -> dict[str, dict[int, float]]:
    """Column -> iteration -> value, and the seconds."""
    events = EventAccumulator(str(run), size_guidance={"scalars": 0})
    events.Reload()
    tags = events.Tags()["scalars"]
    curve = {
        column: {event.step: event.value for event in events.Scalars(tag)}
        for column, tag in COLUMNS.items()
        if tag in tags
    }
    rewards = events.Scalars(COLUMNS["reward"])
    took = [0.0, *(after.wall_time - before.wall_time for before, after in pairwise(rewards))]
    pause = max(PAUSE, 3.0 * median(took))
    seconds = accumulate(spent if spent < pause else 0.0 for spent in took)
    return {"seconds": dict(zip((event.step for event in rewards), seconds, strict=True)), **curve}


def write_csv(curve: dict[str, dict[int, float]], path: Path, every: int) -> None:
    """Every so many iterations, and each with an exam; a column is empty where nothing was measured."""
    exams = set(curve.get("falls", {}))
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file, lineterminator="\n")
        rows.writerow(["iteration", *curve])
        for step in curve["seconds"]:
            if step % every == 0 or step in exams:
                rows.writerow([step, *(f"{values[step]:.4g}" if step in values else "" for values in curve.values())])


def draw(curve: dict[str, dict[int, float]], path: Path) -> None:
    """Reward, and levels of rough ground and the exams' errors where there are some, against seconds of training.

    256 colours, for a small file.
    """
    levels, exams = "terrain_level" in curve, "error_vx" in curve
    panels = 1 + levels + exams
    figure, axes = plt.subplots(1, panels, figsize=(4.5 * panels, 3.2), layout="constrained", squeeze=False)
    left, right = axes[0, 0], axes[0, -1]
    seconds = curve["seconds"]
    left.plot([*seconds.values()], [curve["reward"][step] for step in seconds], lw=1)
    left.set(ylabel="return of an episode")
    if levels:
        middle = axes[0, 1]
        for column, label in (("terrain_level", "all kinds"), ("stairs_up", "stairs up")):
            values = curve.get(column, {})
            middle.plot([seconds[step] for step in values], [*values.values()], lw=1, label=label)
        middle.set(ylabel="mean level of the ground")
        middle.legend(frameon=False)
    if exams:
        for column, unit in (("error_vx", "m/s"), ("error_vy", "m/s"), ("error_yaw", "rad/s")):
            values = curve[column]
            right.plot(
                [seconds[step] for step in values],
                [*values.values()],
                marker="o",
                ms=3,
                lw=1,
                label=f"{column} [{unit}]",
            )
        right.set(ylabel="small exam, mean error", ylim=(0, 0.5))
        right.legend(frameon=False)
    for panel in axes[0]:
        panel.set(xlabel="seconds of training")
        panel.grid(alpha=0.3)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=100)
    small = (
        Image.open(buffer)
        .convert("RGB")
        .quantize(256, method=Image.Quantize.MAXCOVERAGE, kmeans=3, dither=Image.Dither.NONE)
    )
    small.convert("RGB").save(path, lossless=True, quality=100, method=6)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="a run folder")
    parser.add_argument("out", type=Path, help="the folder to write to")
    parser.add_argument("--every", type=int, default=20, help="iterations between two rows of curve.csv")
    args = parser.parse_args()
    curve = read(args.run)
    write_csv(curve, args.out / "curve.csv", args.every)
    draw(curve, args.out / "curve.webp")
    last = max(curve["seconds"])
    print(
        f"{args.run}: {last} iterations, {curve['steps'][last] / 1e6:.0f} M steps, {curve['seconds'][last]:.0f} s of training"
    )


if __name__ == "__main__":
    main()
