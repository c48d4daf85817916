"""The walking exam's rules: what it asks, what is measured, what passes. Plain numbers: needs numpy, neither torch nor warp.

``exam`` applies them in the training environment, ``legged_mw.deploy`` to an exported policy. A push sets the velocity at once.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legged_mw.eval.peers import PEERS, Peer
from legged_mw.utils.commands import LABELS, VELOCITY
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

SECONDS, SETTLING = 10.0, 2.0  # [s] of a tracking command, and of its start that is not counted
PUSH_AT, PUSH_UNTIL, PUSH_DIRECTIONS = 3.0, 6.0, 16  # [s] of the first direction; [s] survived if it still stands then
GRAVITY = 9.81  # [m/s^2]
SLOW = 0.1  # [m/s] below which a cost of transport says nothing
EQUAL_DRIFT = 0.005  # [m], below which drifts count as equal
PUSH_SPEEDS, PUSH_MARK = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0), 2.0  # [m/s] where no config says others
AXES = tuple(zip(LABELS.values(), ("m/s", "m/s", "rad/s"), strict=True))  # vx, vy, yaw rate: name and unit

Velocity = tuple[float, float, float]  # vx, vy [m/s], yaw rate [rad/s]: body frame, at the IMU


class Figure(NamedTuple):
    """One figure of the exam beside what walking asks and what the peer has."""

    name: str
    value: float | None  # None: there is nothing to measure
    digits: int
    mark: float | None = None  # what walking needs; None: anything
    peer: float | None = None
    more_is_better: bool = False
    without: str = "fell"  # stands for no value
    card: tuple[str, str] | None = None  # title and unit among the figures that one looks for first

    def text(self, value: float | None) -> str:
        return self.without if value is None else f"{value:.{self.digits}f}"

    def mark_text(self) -> str:
        if self.mark is None:
            return ""
        return f"{self.mark:.{min(self.digits, 2 if round(self.mark, 2) == self.mark else 3)}f}"

    def passes(self) -> bool | None:
        """Whether the value is what walking needs; None where it needs nothing."""
        if self.mark is None:
            return None
        return self.value is not None and (self.value >= self.mark if self.more_is_better else self.value <= self.mark)


@dataclass(frozen=True)
class ExamRules:
    """What the walking exam asks of one task, and what counts as walking."""

    ranges: tuple[tuple[float, float], ...]  # lowest and highest vx, vy [m/s], yaw rate [rad/s]
    push_speeds: tuple[float, ...]  # [m/s] by which the base's horizontal velocity jumps
    push_vx: float  # [m/s] at which the robot walks when it is pushed
    transport_vx: float  # [m/s] at which the cost of transport is measured
    measure: str  # "error", or "offset": of the mean velocity, for a robot that sways
    most: tuple[float, ...]  # largest mean error, or offset, of a policy that walks [m/s, m/s, rad/s]
    push_mark: float  # [m/s]: a policy that walks survives all pushes of this speed
    peer_name: str = ""

    @classmethod
    def from_config(cls, cfg: Any) -> ExamRules:
        """The rules for a task: its config section ``exam``. Raises ConfigError."""
        return cls.from_mapping(cfg.to_dict()["exam"], vars(cfg.commands.ranges))

    @classmethod
    def from_mapping(cls, said: Mapping[str, Any], trained: Mapping[str, Sequence[float]] | None = None) -> ExamRules:
        """The rules from what the config section ``exam`` or ``to_mapping`` says; the defaults stand in that section's comments.

        ``trained``: command -> lowest and highest, for a range that is not said. Raises ConfigError.
        """
        asked = {**(trained or {}), **said.get("ranges", {})}
        _check(said, asked)
        vx, vy, yaw = ((float(asked[name][0]), float(asked[name][1])) for name in VELOCITY)
        marks = said.get("marks", {})
        default = (max(0.06 * vx[1], 0.04), 0.06, 0.1 * yaw[1] if yaw[1] > 0 else 0.12)
        return cls(
            ranges=(vx, vy, yaw),
            push_speeds=tuple(map(float, said.get("push_speeds", PUSH_SPEEDS))),
            push_vx=float(said.get("push_vx") or round(vx[1] / 2, 4)),
            transport_vx=float(said.get("transport_vx") or round(vx[1] / 2, 4)),
            measure=marks.get("measure", "error"),
            most=tuple(map(float, marks.get("most") or default)),
            push_mark=float(marks.get("push", PUSH_MARK)),
            peer_name=said.get("peer", ""),
        )

    def to_mapping(self) -> dict[str, Any]:
        """The rules in numbers, strings, lists and dicts: what ``from_mapping`` reads."""
        return {
            "ranges": {name: list(ends) for name, ends in zip(VELOCITY, self.ranges, strict=True)},
            "push_speeds": list(self.push_speeds),
            "push_vx": self.push_vx,
            "transport_vx": self.transport_vx,
            "peer": self.peer_name,
            "marks": {"measure": self.measure, "most": list(self.most), "push": self.push_mark},
        }

    @property
    def peer(self) -> Peer | None:
        """The peer that the task names, if it was asked the same."""
        peer = PEERS.get(self.peer_name)
        return peer if peer and all(getattr(self, name) == value for name, value in peer.asked.items()) else None

    def commands(self) -> list[Velocity]:
        """The 22 commands; the first is to stand."""
        (x0, x1), (y0, y1), (w0, w1) = self.ranges
        along = [(v, 0.0, 0.0) for v in (x1 / 3, 2 * x1 / 3, x1, x0 / 3, 2 * x0 / 3)]
        across = [(0.0, v, 0.0) for v in (y1 / 2, y1, y0 / 2, y0)]
        turning = [(0.0, 0.0, w) for w in (w1 / 2, w1, w0 / 2, w0)]
        mixed = product((2 * x1 / 3, 2 * x0 / 3), (y1 / 2, y0 / 2), (w1 / 2, w0 / 2))
        every = [(0.0, 0.0, 0.0), *along, *across, *turning, *mixed]
        return [(round(vx, 4), round(vy, 4), round(yaw, 4)) for vx, vy, yaw in every]

    def held(self) -> list[Velocity]:
        """The commands that a world each holds: the 22, and that of the cost of transport if it is none of them."""
        ahead = (self.transport_vx, 0.0, 0.0)
        return self.commands() if ahead in self.commands() else [*self.commands(), ahead]

    def worlds(self) -> int:
        """One a held command, then one a push: speeds x directions."""
        return len(self.held()) + len(self.push_speeds) * PUSH_DIRECTIONS

    def grade(
        self,
        *,
        velocity: NDArray[Any],
        position: NDArray[Any],
        last_position: NDArray[Any],
        power: NDArray[Any],
        joint_speed: NDArray[Any],
        fell_at: NDArray[Any],
        mass: float,
        dt: float,
    ) -> dict[str, Any]:
        """The exam's result from samples of its N worlds before each of T control steps of ``dt`` [s].

        ``velocity`` (T, N, 3) [m/s, m/s, rad/s]; ``position`` (T, N, 2) and after the last step ``last_position`` (N, 2) [m];
        ``power`` (T, N): sum of |torque * joint speed| [W]; ``joint_speed`` (T, N): mean over the joints [rad/s]; ``fell_at``
        (N,): control step of the first fall, or inf; ``mass`` [kg].
        """
        commands, held, settled = self.commands(), self.held(), round(SETTLING / dt)
        ahead, stood = held.index((self.transport_vx, 0.0, 0.0)), np.isinf(fell_at)
        distance = ((last_position - position[settled]) ** 2).sum(axis=1) ** 0.5  # a straight line
        energy = power[settled:, ahead].sum(dtype=float) * dt
        moved = stood[ahead] and distance[ahead] > SLOW * (len(velocity) - settled) * dt
        survived = (fell_at[len(held) :] > round(PUSH_UNTIL / dt)).reshape(-1, PUSH_DIRECTIONS).mean(axis=1)
        result = {
            **_tracking(velocity[settled:, : len(commands)] - np.array(commands), stood[: len(commands)]),
            "drift": float(distance[0]) if stood[0] else None,
            "joint_speed": float(joint_speed[-round(1.0 / dt) :, 0].mean()) if stood[0] else None,
            "pushes": {f"{speed:g}": round(float(share), 4) for speed, share in zip(self.push_speeds, survived, strict=True)},
            "cost_of_transport": float(energy / (mass * GRAVITY * distance[ahead])) if moved else None,
            "rules": self.to_mapping(),
        }
        for row, command in zip(result["commands"], commands, strict=True):
            row["command"] = list(command)
        beats = {"beats_peer": self.beats_peer(result)} if self.peer else {}
        return {"walks": self.walks(result), **beats, **result}

    def walks(self, result: Mapping[str, Any]) -> bool:
        """No falls, small errors (or offsets), every push of the mark's speed survived."""
        if result["falls"]:
            return False
        small = all(value <= most for value, most in zip(result[self.measure], self.most, strict=True))
        return small and result["pushes"][f"{self.push_mark:g}"] == 1.0

    def beats_peer(self, result: Mapping[str, Any]) -> bool:
        """At least as good on each of the peer's figures, better on the errors and the cost of transport."""
        assert self.peer
        peer = self.peer.figures
        if result["falls"] > peer["falls"]:
            return False
        better = all(a < b for a, b in zip(result["error"], peer["error"], strict=True))
        better = better and result["cost_of_transport"] is not None and result["cost_of_transport"] < peer["cost_of_transport"]
        worst = all(a <= b for a, b in zip(result["worst"], peer["worst"], strict=True))
        pushes = all(result["pushes"][speed] >= share for speed, share in peer["pushes"].items())
        return better and worst and pushes and result["drift"] <= max(EQUAL_DRIFT, peer["drift"])

    def figures(self, result: Mapping[str, Any]) -> list[Figure]:
        """The result's figures in the order of the table."""
        peer: dict[str, Any] = self.peer.figures if self.peer else {}
        listed = [Figure("falls in 22 commands", result["falls"], 0, 0, peer.get("falls"), card=("falls", "of 22"))]
        nothing = [None] * 3
        for i, (axis, unit) in enumerate(AXES):
            for measure in dict.fromkeys(("error", self.measure)):
                name, value = f"{'mean ' if measure == 'offset' else ''}{measure}", (result[measure] or nothing)[i]
                mark, card = (self.most[i], (f"{axis.removesuffix(' rate')} {measure}", unit)) if measure == self.measure else (None, None)
                listed.append(Figure(f"{name} {axis} [{unit}]", value, 3, mark, peer.get(measure, nothing)[i], card=card))
            listed.append(Figure("  worst command", (result["worst"] or nothing)[i], 3, None, peer.get("worst", nothing)[i]))
        listed.append(Figure("drift standing 8 s [m]", result["drift"], 4, None, peer.get("drift")))
        listed.append(Figure("joint speed standing [rad/s]", result["joint_speed"], 3))
        for speed, share in result["pushes"].items():
            mark, card = (1.0, (f"{speed} m/s pushes", "survived")) if float(speed) == self.push_mark else (None, None)
            listed.append(Figure(f"survives pushes of {speed} m/s", share, 2, mark, peer.get("pushes", {}).get(speed), True, card=card))
        ahead, cost = f"at {self.transport_vx:g} m/s", result["cost_of_transport"]
        card = ("cost of transport", ahead)
        return [*listed, Figure(f"cost of transport {ahead}", cost, 2, None, peer.get("cost_of_transport"), without="none", card=card)]


def _tracking(difference: NDArray[Any], stood: NDArray[Any]) -> dict[str, Any]:
    """How well C commands were followed, from velocity minus command (T, C, 3) and which did not fall (C,)."""
    error, offset = abs(difference).mean(axis=0), abs(difference.mean(axis=0))
    followed, swayed = error[stood], offset[stood]
    means = {"error": followed.mean(axis=0), "worst": followed.max(axis=0), "offset": swayed.mean(axis=0)} if stood.any() else {}
    return {
        "falls": int((~stood).sum()),
        **{name: _plain(means[name]) if means else None for name in ("error", "worst", "offset")},  # None: all fell
        "commands": [
            {"command": [], "error": _plain(e) if ok else None, "offset": _plain(o) if ok else None, "fell": not bool(ok)}
            for e, o, ok in zip(error, offset, stood, strict=True)
        ],
    }


def _check(said: Mapping[str, Any], asked: Mapping[str, Sequence[float]]) -> None:
    """Raises ConfigError for rules that cannot be applied."""
    for name in said.get("ranges", {}):
        if name not in VELOCITY:
            raise ConfigError(f"exam.ranges: {unknown('command', name, VELOCITY, 'the walking exam')}; others stay at their default")
    for name in VELOCITY:
        if name not in asked or len(asked[name]) != 2 or asked[name][0] > asked[name][1]:
            raise ConfigError(f"exam.ranges: {name} is {asked.get(name)}; it must be two numbers, the lower first")
    speeds, marks = said.get("push_speeds", PUSH_SPEEDS), said.get("marks", {})
    if not speeds or min(speeds) <= 0:
        raise ConfigError(f"exam.push_speeds is {list(speeds)}; it must be one or more numbers above zero")
    if marks.get("push", PUSH_MARK) not in speeds:
        raise ConfigError(f"exam.marks.push is {marks.get('push', PUSH_MARK):g}; it must be one of exam.push_speeds, {list(speeds)}")
    if len(marks.get("most") or "vyw") != 3:
        raise ConfigError(f"exam.marks.most is {marks['most']}; it must be three numbers, or an empty list")
    if said.get("peer") and said["peer"] not in PEERS:
        raise ConfigError(f"exam.peer: {unknown('peer', said['peer'], PEERS, 'legged_mw/eval/peers.py')}")


def table(result: Mapping[str, Any]) -> str:
    """The result as text, beside what walking asks and what the peer has if there is one."""
    rules = ExamRules.from_mapping(result["rules"])
    lines = [f"{'':<30}{'this policy':>12}{'walks at':>10}" + (f"{'peer':>8}" if rules.peer else "")]
    for figure in rules.figures(result):
        peer = "" if figure.peer is None else figure.text(figure.peer)
        peer = f"{peer:>8}" if rules.peer else ""
        lines.append(f"{figure.name:<30}{figure.text(figure.value):>12}{figure.mark_text():>10}{peer}")
    verdicts = {"walks": "walks", "beats_peer": "beats the peer"}
    said = [f"{words}: {'yes' if result[verdict] else 'no'}" for verdict, words in verdicts.items() if verdict in result]
    return "\n".join([*lines, "; ".join(said)])


def save(result: dict[str, Any], path: Path) -> None:
    """Write the result as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _plain(row: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 5) for value in row]
