"""The walking exam's rules: commands, kicks, what is measured, what passes. Plain numbers: needs numpy, neither torch nor warp.

Who drives the robot through it: ``exam`` in the training environment, ``legged_mw.deploy`` on an exported policy.
"""

from __future__ import annotations

import json
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

SECONDS, SETTLING = 10.0, 2.0  # [s] of a tracking command, and of its start that is not counted
KICK_COMMAND, KICK_AT, KICK_UNTIL = 0.8, 3.0, 6.0  # vx [m/s]; [s]
KICK_SPEEDS, KICK_DIRECTIONS = (1.0, 2.0, 3.0, 4.0, 5.0, 6.0), 16  # [m/s]
GRAVITY = 9.81  # [m/s^2]
SLOW = 0.1  # [m/s] below which a cost of transport says nothing

# What the policy that ships with MuJoCo Playground for this robot scores in MuJoCo's C engine under these rules.
PEER: dict[str, Any] = {
    "falls": 0,
    "error": [0.024, 0.031, 0.084],
    "worst": [0.042, 0.063, 0.357],
    "drift": 0.0007,
    "kicks": {"1": 1.0, "2": 1.0, "3": 1.0, "4": 0.81, "5": 0.38, "6": 0.13},
    "cost_of_transport": 0.86,
}
ERROR_MARKS = (0.06, 0.06, 0.12)  # largest mean error of a policy that walks [m/s, m/s, rad/s]
EQUAL_DRIFT = 0.005  # [m], below which drifts count as equal


def commands() -> list[tuple[float, float, float]]:
    """The 22 commands (vx, vy [m/s], yaw rate [rad/s]); the first is to stand."""
    along = [(v, 0.0, 0.0) for v in (0.5, 1.0, 1.5, -0.5, -1.0)]
    across = [(0.0, v, 0.0) for v in (0.4, 0.8, -0.4, -0.8)]
    turning = [(0.0, 0.0, w) for w in (0.6, 1.2, -0.6, -1.2)]
    return [(0.0, 0.0, 0.0), *along, *across, *turning, *product((1.0, -1.0), (0.4, -0.4), (0.6, -0.6))]


def grade(
    *,
    error: NDArray[Any],
    fell_at: NDArray[Any],
    distance: NDArray[Any],
    energy: NDArray[Any],
    standing_joint_speed: float,
    seconds: float,
    mass: float,
    dt: float,
) -> dict[str, Any]:
    """The exam's result from what was measured; C commands, N = C + kick speeds * kick directions worlds, in that order.

    ``error`` (C, 3): mean absolute difference to the command after settling [m/s, m/s, rad/s]. ``fell_at`` (N,): control step
    of the first fall, or inf. ``distance`` (C,): straight line over the ``seconds`` since settling [m];
    ``energy`` (C,): sum of |torque * joint speed| dt over the same time [J]. ``standing_joint_speed``: mean of the last second
    at the command to stand [rad/s].
    ``mass`` [kg], ``dt`` a control step [s].
    """
    count = len(commands())
    stood = np.isinf(fell_at[:count])
    ahead = commands().index((1.0, 0.0, 0.0))
    moved = distance[ahead] > SLOW * seconds
    survived = (fell_at[count:] > round(KICK_UNTIL / dt)).reshape(len(KICK_SPEEDS), KICK_DIRECTIONS).mean(axis=1)
    result = {
        "falls": int((~stood).sum()),
        "error": _figures(error[stood].mean(axis=0)) if stood.any() else None,  # None: nothing left to measure, all fell
        "worst": _figures(error[stood].max(axis=0)) if stood.any() else None,
        "drift": float(distance[0]) if stood[0] else None,
        "joint_speed": standing_joint_speed if stood[0] else None,
        "kicks": {f"{speed:g}": round(float(share), 4) for speed, share in zip(KICK_SPEEDS, survived, strict=True)},
        "cost_of_transport": float(energy[ahead] / (mass * GRAVITY * distance[ahead])) if stood[ahead] and moved else None,
        "commands": [
            {"command": list(c), "error": _figures(e) if ok else None, "fell": not bool(ok)}
            for c, e, ok in zip(commands(), error, stood, strict=True)
        ],
    }
    return {"walks": walks(result), "beats_peer": beats_peer(result), **result}


def walks(result: dict[str, Any]) -> bool:
    """No falls, small errors, every kick of 2 m/s survived."""
    if result["falls"]:
        return False
    small = all(error <= most for error, most in zip(result["error"], ERROR_MARKS, strict=True))
    return small and result["kicks"]["2"] == 1.0


def beats_peer(result: dict[str, Any]) -> bool:
    """At least as good on each of the peer's figures, better on the errors and the cost of transport."""
    if result["falls"] > PEER["falls"]:
        return False
    better = all(a < b for a, b in zip(result["error"], PEER["error"], strict=True))
    better = better and result["cost_of_transport"] is not None and result["cost_of_transport"] < PEER["cost_of_transport"]
    worst = all(a <= b for a, b in zip(result["worst"], PEER["worst"], strict=True))
    kicks = all(result["kicks"][speed] >= share for speed, share in PEER["kicks"].items())
    return better and worst and kicks and result["drift"] <= max(EQUAL_DRIFT, PEER["drift"])


class Row(NamedTuple):
    """One figure of the exam beside what walking asks and what the peer has."""

    name: str
    value: float | None  # None: there is nothing to measure
    digits: int
    mark: float | None = None  # what walking needs; None: anything
    peer: float | None = None
    more_is_better: bool = False
    without: str = "fell"  # what stands for no value

    def shown(self, value: float | None) -> str:
        return self.without if value is None else f"{value:.{self.digits}f}"

    def shown_mark(self) -> str:
        return "" if self.mark is None else f"{self.mark:.{min(self.digits, 2)}f}"

    def passes(self) -> bool | None:
        """Whether the value is what walking needs; None where it needs nothing."""
        if self.mark is None:
            return None
        return self.value is not None and (self.value >= self.mark if self.more_is_better else self.value <= self.mark)


def rows(result: dict[str, Any]) -> list[Row]:
    """The result's figures in the order of the table."""
    listed = [Row("falls in 22 commands", result["falls"], 0, 0, PEER["falls"])]
    error, worst = result["error"] or [None] * 3, result["worst"] or [None] * 3
    for i, name in enumerate(("vx [m/s]", "vy [m/s]", "yaw rate [rad/s]")):
        listed.append(Row(f"error {name}", error[i], 3, ERROR_MARKS[i], PEER["error"][i]))
        listed.append(Row("  worst command", worst[i], 3, None, PEER["worst"][i]))
    listed.append(Row("drift standing 8 s [m]", result["drift"], 4, None, PEER["drift"]))
    listed.append(Row("joint speed standing [rad/s]", result["joint_speed"], 3))
    for speed, share in result["kicks"].items():
        listed.append(Row(f"survives kicks of {speed} m/s", share, 2, 1.0 if speed == "2" else None, PEER["kicks"][speed], True))
    listed.append(Row("cost of transport at 1 m/s", result["cost_of_transport"], 2, None, PEER["cost_of_transport"], without="none"))
    return listed


def table(result: dict[str, Any]) -> str:
    """The result beside the peer's, as text."""
    lines = [f"{'':<30}{'this policy':>12}{'walks at':>10}{'peer':>8}"]
    for row in rows(result):
        peer = "" if row.peer is None else row.shown(row.peer)
        lines.append(f"{row.name:<30}{row.shown(row.value):>12}{row.shown_mark():>10}{peer:>8}")
    verdict = f"walks: {'yes' if result['walks'] else 'no'}; beats the peer: {'yes' if result['beats_peer'] else 'no'}"
    return "\n".join([*lines, verdict])


def save(result: dict[str, Any], path: Path) -> None:
    """Write the result as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _figures(row: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 5) for value in row]
