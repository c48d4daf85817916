"""The report's picture of an estimator: the velocity that the simulator knows and the one that the policy believes, command by command."""

from __future__ import annotations

from typing import Any

import numpy as np

from legged_mw.eval.rules import AXES

WIDTH, HEIGHT = 7.2, 2.1  # [inch]


def draw(estimate: dict[str, Any], k: int, colours: tuple[str, str, str], title: str, ax: Any) -> None:
    """Axis ``k`` of ``figures.estimates``: the commands side by side; ``colours`` of truth, estimate and the borders between commands."""
    ink, colour, faint = colours
    commands, seconds = estimate["commands"], estimate["seconds"]
    truth, believed = (np.array(estimate[key][k], dtype=float) for key in ("truth", "estimate"))
    time = np.linspace(0.0, seconds * len(commands), len(truth), endpoint=False)
    ax.plot(time, truth, color=ink, linewidth=1.0, label="true")
    ax.plot(time, believed, color=colour, linewidth=1.0, label="estimated")
    for i in range(1, len(commands)):
        ax.axvline(i * seconds, color=faint, linewidth=0.8)
    places = (np.arange(len(commands)) + 0.5) * seconds
    ax.set_xticks(places, [", ".join(f"{value:.2g}" for value in command) for command in commands], rotation=90, fontsize=5.5)
    name, unit = AXES[k]
    ax.set(title=f"{name} [{unit}]{title}", xlabel="command: vx, vy, yaw rate", xlim=(0.0, seconds * len(commands)))
    ax.grid(False, axis="x")
    ax.legend(loc="upper right", ncols=2, handlelength=1.6)
