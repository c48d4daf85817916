"""The report's plot of a velocity estimator: true and estimated velocity, command by command."""

from __future__ import annotations

from typing import Any

import numpy as np

from legged_mw.eval.rules import AXES

WIDTH, HEIGHT = 7.2, 2.1  # [inch]


def draw(estimate: dict[str, Any], k: int, colours: tuple[str, str, str], title: str, ax: Any) -> None:
    """Plot axis ``k`` of ``figures.estimates``, with the commands side by side.

    ``colours``: of the true velocity, of the estimate, of the borders between commands.
    """
    ink, colour, faint = colours
    commands, seconds = estimate["commands"], estimate["seconds"]
    for key, tone, label in (("truth", ink, "true"), ("estimate", colour, "estimated")):
        values = np.array(estimate[key][k], dtype=float).reshape(len(commands), -1)
        time = np.linspace(0.0, seconds, values.shape[1]) + seconds * np.arange(len(commands))[:, None]
        apart = ((0, 0), (0, 1))  # NaN: no line from one command to the next
        lines = (np.pad(rows, apart, constant_values=np.nan).ravel() for rows in (time, values))
        ax.plot(*lines, color=tone, linewidth=1.0, label=label)
    for i in range(1, len(commands)):
        ax.axvline(i * seconds, color=faint, linewidth=0.8)
    places = (np.arange(len(commands)) + 0.5) * seconds
    ax.set_xticks(
        places, [", ".join(f"{value:.2g}" for value in command) for command in commands], rotation=90, fontsize=5.5
    )
    name, unit = AXES[k]
    ax.set(title=f"{name} [{unit}]{title}", xlabel="command: vx, vy, yaw rate", xlim=(0.0, seconds * len(commands)))
    ax.grid(False, axis="x")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, ncols=2, handlelength=1.6)
