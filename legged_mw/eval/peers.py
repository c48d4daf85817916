"""What published policies score in the walking exam. A task names one in its config section ``exam`` to stand beside it.

A peer's figures are comparable at the commands and pushes that it was graded with, and are left out of any other exam.
"""

from __future__ import annotations

from typing import Any, NamedTuple


class Peer(NamedTuple):
    """A policy's figures and what it was asked."""

    about: str  # what it is, for the report
    asked: dict[str, Any]  # fields of ExamRules that its figures depend on
    figures: dict[str, Any]


PEERS = {
    "playground_go1": Peer(
        about="the policy that ships with MuJoCo Playground for this robot, graded by the same rules in MuJoCo's C engine",
        asked={
            "ranges": ((-1.5, 1.5), (-0.8, 0.8), (-1.2, 1.2)),
            "push_speeds": (1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
            "push_vx": 0.8,
            "transport_vx": 1.0,
        },
        figures={
            "falls": 0,
            "error": [0.024, 0.031, 0.084],
            "worst": [0.042, 0.063, 0.357],
            "drift": 0.0007,
            "pushes": {"1": 1.0, "2": 1.0, "3": 1.0, "4": 0.81, "5": 0.38, "6": 0.13},
            "cost_of_transport": 0.86,
        },
    ),
}
