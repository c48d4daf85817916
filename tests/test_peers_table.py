"""docs/published_policies.md's tables hold the figures of resources/peers.yaml, and of the policies that ship."""

from __future__ import annotations

import re

import pytest

from legged_mw import ROOT
from legged_mw.eval.walking import PEERS, Peer

PAGE = (ROOT / "docs/published_policies.md").read_text()
PUSHES = {"go2": "123456", "g1": ("0.5", "1", "1.5", "2", "3")}  # [m/s] those that the exam of the shipped policy asks


def row(robot: str, peer: Peer) -> str:
    """A policy's line in the table of ``robot``, up to what is known of it."""
    figures = peer.figures
    trained = next(other for other in PEERS[robot] if other.name == peer.name and not other.own_speed).asked["ranges"]
    errors = [f"{error:.3f} ({worst:.2f})" for error, worst in zip(figures["error"], figures["worst"], strict=True)]
    offsets = [", ".join(f"{offset:.3f}" for offset in figures["offset"])] if robot == "g1" else []
    shares = [figures["pushes"][speed] for speed in PUSHES[robot]]
    pushes = ", ".join(f"{share:.0f}" if share in (0, 1) else f"{share:.2f}" for share in shares)
    ends = ", ".join(f"{high:g}" for _, high in trained)
    cells = [
        peer.name,
        ends,
        *errors,
        *offsets,
        f"{figures['drift']:.4f}",
        pushes,
        f"{figures['cost_of_transport']:.2f}",
    ]
    return f"| {' | '.join(cells)} |"


@pytest.mark.parametrize("robot", PUSHES)
def test_a_line_a_published_policy(robot: str) -> None:
    rows = [row(robot, peer) for peer in PEERS[robot] if peer.own_speed]
    assert len(rows) == {"go2": 10, "g1": 12}[robot]
    assert [line for line in rows if line not in PAGE] == []


@pytest.mark.parametrize("robot", PUSHES)
def test_the_last_line_is_the_policy_that_ships(robot: str) -> None:
    """Its figures are those of the exam that its own page shows."""
    [ours] = re.findall(rf"^\| \*\*`{robot}_flat`.*$", PAGE, re.MULTILINE)
    shown = (ROOT / f"resources/policies/{robot}_flat/README.md").read_text()
    numbers = re.findall(r"\d+\.\d+", ours)
    assert len(numbers) >= 8 and [number for number in numbers if number not in shown] == [], (
        "of docs/published_policies.md, not of the policy's page"
    )
