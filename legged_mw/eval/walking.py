"""The commands, measures, pass marks and verdicts of the walking exam. This module imports no torch and no warp.

``rollout`` runs the exam in the training environment, ``legged_mw.deploy`` runs it on an exported policy. A push adds
to the base's velocity at once.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from numpy.typing import NDArray

from legged_mw import ROOT
from legged_mw.utils.commands import LABELS, VELOCITY
from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

EXAM_SECONDS, SETTLING = 10.0, 2.0  # [s] duration of a command; settling time at its start, not measured
# [s] time of the first push; [s] time until which the robot must not fall; number of directions
PUSH_AT, PUSH_UNTIL, PUSH_DIRECTIONS = 3.0, 6.0, 16
GRAVITY = 9.81  # [m/s^2]
LEVELS = 10  # difficulty levels of each kind of rough terrain
SLOW = 0.1  # [m/s] lowest mean speed at which the cost of transport is computed
EQUAL_DRIFT = 0.005  # [m] smaller drifts count as equal
# Defaults: push speeds [m/s], the push speed that must be survived [m/s], the error that the marks limit.
# The base of a biped sways at each step, and its error at each time contains the sway. So its marks limit the offset.
BIPED: dict[str, Any] = {"push_speeds": (0.5, 1.0, 1.5, 2.0, 3.0), "push_mark": 1.0, "marks_of": "offset"}
OTHERS: dict[str, Any] = {
    "push_speeds": (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0),
    "push_mark": 2.0,
    "marks_of": "error",
}
OFFSET_MARKS = (0.06, 0.06, 0.12)  # [m/s, m/s, rad/s]
AXES = tuple(zip(LABELS.values(), ("m/s", "m/s", "rad/s"), strict=True))  # name and unit of vx, vy, yaw rate

Velocity = tuple[float, float, float]  # vx, vy [m/s], yaw rate [rad/s]: body frame, at the IMU
Ranges = tuple[tuple[float, float], ...]  # lowest and highest vx, vy [m/s], yaw rate [rad/s]


class Peer(NamedTuple):
    """A published policy with its figures and the exam rules of their measurement."""

    name: str
    asked: dict[str, Any]  # values of the ExamRules fields that affect its figures
    figures: dict[str, Any]  # the known keys of an exam's result
    own_speed: bool = False  # pushes and cost of transport were measured at half of its own highest vx
    hard: dict[str, Any] | None = None  # its figures in the hard exam, with the common command range

    def fits(self, rules: ExamRules) -> bool:
        """Whether it was measured with the commands and pushes of ``rules``."""
        ignored = ("push_vx", "transport_vx") if self.own_speed else ()
        return all(getattr(rules, name) == value for name, value in self.asked.items() if name not in ignored)


def _read_peers() -> tuple[dict[str, list[Peer]], dict[str, Ranges], dict[str, float]]:
    """Three tables by robot from ``resources/peers.yaml``: published policies, common command ranges, load [kg].

    A policy that was measured in its trained range and in the common range has two entries.
    """
    peers: dict[str, list[Peer]] = {}
    common: dict[str, Ranges] = {}
    loads: dict[str, float] = {}
    # libyaml reads this file nine times as fast as load_yaml; every training reads it at its start
    text = (ROOT / "resources/peers.yaml").read_text(encoding="utf-8")
    for robot, entry in yaml.load(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)).items():
        speeds = tuple(entry["push_speeds"])
        peers[robot] = []
        if "common" in entry:
            common[robot] = tuple((low, high) for low, high in entry["common"])
        if "load" in entry:
            loads[robot] = float(entry["load"])
        for each in entry["policies"]:
            half_vx = round(each["trained"][0] / 2, 4)
            asked = {"push_speeds": speeds, **{name: each.get(name, half_vx) for name in ("push_vx", "transport_vx")}}
            pushes = {f"{speed:g}": share for speed, share in zip(speeds, each["pushes"], strict=True)}
            rest = {"drift": each["drift"], "pushes": pushes, "cost_of_transport": each["cost_of_transport"]}
            rules = {"ranges": tuple((-highest, highest) for highest in each["trained"]), **asked}
            peers[robot].append(Peer(each["name"], rules, {"falls": 0, **each["own"], **rest}))
            if "common" in each:
                shared, figures = {"ranges": common[robot], **asked}, {"falls": 0, **each["common"], **rest}
                peers[robot].append(Peer(each["name"], shared, figures, own_speed=True, hard=each.get("hard")))
    return peers, common, loads


PEERS, COMMON, LOADS = _read_peers()
ALIASES = {"playground_go1": "go1"}  # exam.peer of older runs and exports names a policy


class Figure(NamedTuple):
    """One figure of the exam, its pass mark, and the peer's value, or the best value of several peers."""

    name: str
    value: float | None  # None: not measured
    digits: int
    mark: float | None = None  # limit for the verdict "walks"; None: no limit
    peer: float | None = None
    more_is_better: bool = False
    without: str = "fell"  # printed in place of None
    card: tuple[str, str] | None = None  # title and unit, if a card at the top of the page has the figure
    equal: float = 0.0  # values up to this one are equal
    peer_mark: str = ""  # footnote mark on the peer's value

    def text(self, value: float | None) -> str:
        return self.without if value is None else f"{value:.{self.digits}f}"

    def peer_text(self) -> str:
        return "" if self.peer is None else f"{self.text(self.peer)}{self.peer_mark}"

    def mark_text(self) -> str:
        if self.mark is None:
            return ""
        return f"{self.mark:.{min(self.digits, 2 if round(self.mark, 2) == self.mark else 3)}f}"

    def passes(self) -> bool | None:
        """Whether the value is within the mark; None without a mark."""
        if self.mark is None:
            return None
        return self.value is not None and (self.value >= self.mark if self.more_is_better else self.value <= self.mark)

    def reaches_peer(self) -> bool:
        """Whether the value is equal to the peer's value or better."""
        if self.value is None or self.peer is None:
            return False
        return self.value >= self.peer if self.more_is_better else self.value <= max(self.peer, self.equal)


@dataclass(frozen=True)
class ExamRules:
    """The commands, pushes and pass marks of one task: the config section ``exam`` with all defaults."""

    ranges: tuple[tuple[float, float], ...]  # lowest and highest vx, vy [m/s], yaw rate [rad/s]
    push_speeds: tuple[float, ...]  # [m/s] jumps of the base's horizontal velocity
    push_vx: float  # [m/s] commanded vx during the pushes
    transport_vx: float  # [m/s] commanded vx for the cost of transport
    marks: tuple[float, ...]  # largest mean error or offset for the verdict "walks" [m/s, m/s, rad/s]
    marks_of: str = "error"  # "error": mean of the error at each time; "offset": error of the mean velocity
    push_mark: float = 2.0  # [m/s] the robot must survive all pushes of this speed
    peer: str = ""  # the robot's key in PEERS

    @classmethod
    def from_config(cls, cfg: Any) -> ExamRules:
        """The rules of a task with velocity commands, from its config. Raises ConfigError."""
        if not hasattr(cfg, "exam"):
            raise ConfigError(
                "the walking exam needs a config with the sections commands and exam: a subclass of LeggedRobotCfg"
            )
        return cls.from_mapping(vars(cfg.exam), vars(cfg.commands.ranges), len(cfg.asset.foot_names))

    @classmethod
    def from_mapping(
        cls, given: Mapping[str, Any], trained: Mapping[str, Sequence[float]] | None = None, feet: int = 0
    ) -> ExamRules:
        """The rules from the config section ``exam`` or from ``to_mapping``. Missing fields get their defaults.

        ``trained``: command -> (lowest, highest), used for commands without a range in ``given``.
        ``feet``: number of feet; a robot with two feet gets the defaults of a biped. Raises ConfigError.
        """
        present = {name: value for name, value in given.items() if value or name not in OTHERS}
        given = {"ranges": {}, "peer": "", **(BIPED if feet == 2 else OTHERS), **present}
        ranges = {**(trained or {}), **given["ranges"]}
        given["peer"] = robot_of(given["peer"])
        _check(given, ranges)
        vx, vy, yaw = ((float(ranges[name][0]), float(ranges[name][1])) for name in VELOCITY)
        scaled = (round(max(0.06 * vx[1], 0.04), 4), 0.06, round(0.1 * yaw[1], 4) if yaw[1] > 0 else 0.12)
        marks = given.get("marks") or (scaled if given["marks_of"] == "error" else OFFSET_MARKS)
        push_vx, transport_vx = (float(given.get(name) or round(vx[1] / 2, 4)) for name in ("push_vx", "transport_vx"))
        speeds, others = (
            tuple(map(float, given["push_speeds"])),
            {name: given[name] for name in ("marks_of", "push_mark", "peer")},
        )
        return cls((vx, vy, yaw), speeds, push_vx, transport_vx, tuple(map(float, marks)), **others)

    def to_mapping(self) -> dict[str, Any]:
        """The rules as plain values for JSON or YAML, which ``from_mapping`` reads."""
        plain = {name: list(value) if isinstance(value, tuple) else value for name, value in vars(self).items()}
        return {**plain, "ranges": {name: list(ends) for name, ends in zip(VELOCITY, self.ranges, strict=True)}}

    @property
    def peers(self) -> list[Peer]:
        """The robot's published policies that were measured with the same commands and pushes."""
        return [peer for peer in PEERS.get(self.peer, []) if peer.fits(self)]

    @property
    def peer_label(self) -> str:
        """The heading of the column with the peers' figures; empty without peers."""
        return f"best of {len(self.peers)}" if len(self.peers) > 1 else "peer" * len(self.peers)

    def asked_words(self) -> str:
        """The command ranges as text."""
        spans = [
            f"{name} {low:g} to {high:g} {unit}" for (name, unit), (low, high) in zip(AXES, self.ranges, strict=True)
        ]
        common = (
            ", the common range of all published policies of this robot" if COMMON.get(self.peer) == self.ranges else ""
        )
        return f"asked: {', '.join(spans)}{common}"

    def peer_words(self) -> str:
        """A text about the peers and the figures that were measured differently. Empty without peers."""
        if not self.peers:
            return ""
        first = self.peers[0]
        if len(self.peers) == 1:
            return f"The peer is {first.name}'s policy for this robot, graded by the same rules in MuJoCo's C engine."
        note = (
            f"* Their pushes and cost of transport were measured at half of each policy's highest vx, not at {self.push_vx:g} m/s: "
            "compare them with care."
        )
        return (
            f"Best of {len(self.peers)}: for each figure, the best value of the published policies for this robot with these ranges, "
            f"each measured in its own scene in MuJoCo's C engine; no policy has all best values. {note if first.own_speed else ''}"
        ).strip()

    def commands(self) -> list[Velocity]:
        """The 22 commands; the first one is zero."""
        (x0, x1), (y0, y1), (w0, w1) = self.ranges
        along = [(v, 0.0, 0.0) for v in (x1 / 3, 2 * x1 / 3, x1, x0 / 3, 2 * x0 / 3)]
        across = [(0.0, v, 0.0) for v in (y1 / 2, y1, y0 / 2, y0)]
        turning = [(0.0, 0.0, w) for w in (w1 / 2, w1, w0 / 2, w0)]
        mixed = product((2 * x1 / 3, 2 * x0 / 3), (y1 / 2, y0 / 2), (w1 / 2, w0 / 2))
        every = [(0.0, 0.0, 0.0), *along, *across, *turning, *mixed]
        return [(round(vx, 4), round(vy, 4), round(yaw, 4)) for vx, vy, yaw in every]

    def held(self) -> list[Velocity]:
        """The constant commands, one per world: the 22, then the command of the cost of transport if it is another."""
        ahead = (self.transport_vx, 0.0, 0.0)
        return self.commands() if ahead in self.commands() else [*self.commands(), ahead]

    def worlds(self) -> int:
        """The number of worlds: one per constant command and per push (speed x direction)."""
        return len(self.held()) + len(self.push_speeds) * PUSH_DIRECTIONS

    def grade(
        self,
        signals: Mapping[str, NDArray[Any]],
        *,
        last_position: NDArray[Any],
        fell_at: NDArray[Any],
        mass: float,
        dt: float,
    ) -> dict[str, Any]:
        """The exam's result from samples of N worlds, taken before each of T control steps of ``dt`` [s].

        ``signals``: velocity (T, N, 3) [m/s, m/s, rad/s]; position (T, N, 2) [m]; power (T, N) [W], the sum of
        |torque * joint speed|; joint_speed (T, N) [rad/s], the mean over the joints; estimate (T, N, 2) [m/s], if the
        policy has a velocity estimator.
        ``last_position`` (N, 2) [m]: after the last step. ``fell_at`` (N,): control step of the first fall, or inf.
        ``mass``: of the robot [kg].
        """
        velocity, position, power, joint_speed = (
            signals[name] for name in ("velocity", "position", "power", "joint_speed")
        )
        commands, held, settled = self.commands(), self.held(), round(SETTLING / dt)
        forward, upright = held.index((self.transport_vx, 0.0, 0.0)), np.isinf(fell_at)
        distance = ((last_position - position[settled]) ** 2).sum(axis=1) ** 0.5  # straight-line distance [m]
        energy = power[settled:, forward].sum(dtype=float) * dt
        moved = upright[forward] and distance[forward] > SLOW * (len(velocity) - settled) * dt
        survived = (fell_at[len(held) :] > round(PUSH_UNTIL / dt)).reshape(-1, PUSH_DIRECTIONS).mean(axis=1)
        result = {
            **_tracking(velocity[settled:, : len(commands)], commands, upright[: len(commands)]),
            "drift": float(distance[0]) if upright[0] else None,
            "joint_speed": float(joint_speed[-round(1.0 / dt) :, 0].mean()) if upright[0] else None,
            "pushes": {
                f"{speed:g}": round(float(share), 4) for speed, share in zip(self.push_speeds, survived, strict=True)
            },
            "cost_of_transport": float(energy / (mass * GRAVITY * distance[forward])) if moved else None,
            "rules": self.to_mapping(),
        }
        if "estimate" in signals:
            error = (signals["estimate"] - velocity[..., :2])[settled:, : len(commands)][:, upright[: len(commands)]]
            result["estimate_rms"] = (
                _plain(np.sqrt((error.astype(float) ** 2).mean(axis=(0, 1)))) if error.size else None
            )
        peer = {"beats_peer": self.beats_peer(result)} if self.peers else {}
        return {"walks": self.walks(result), **peer, **result}

    def walks(self, result: Mapping[str, Any]) -> bool:
        """Whether the policy walks: no falls, errors or offsets within the marks, all ``push_mark`` pushes survived."""
        if result["falls"]:
            return False
        within = all(value <= mark for value, mark in zip(result[self.marks_of], self.marks, strict=True))
        return within and result["pushes"][f"{self.push_mark:g}"] == 1.0

    def advise(self, errors: Sequence[float], falls: float, survived: float) -> list[str]:
        """Three lines from the exam during training: what the policy can do, what it cannot do, what to try next.

        ``errors`` of vx, vy [m/s] and yaw rate [rad/s] contain the sway. So their limit is twice the mark if the marks
        limit the offset. ``falls``: of 22 commands; ``survived``: share of the pushes (0 to 1).
        """
        limits = [mark * (2.0 if self.marks_of == "offset" else 1.0) for mark in self.marks]
        able = {"stand at all 22 commands": not falls, f"survive pushes of {self.push_mark:g} m/s": survived == 1.0}
        for (axis, unit), error, limit in zip(AXES, errors, limits, strict=True):
            able[f"follow {axis} ({error:.2f} {unit} off; {limit:.2g} are allowed)"] = error <= limit
        can, cannot = ([text for text, value in able.items() if value is wanted] for wanted in (True, False))
        if not cannot:
            hint = "play.py --eval runs the whole exam and the hard exam"
        elif falls:
            hint = "train longer with --resume; if it still falls, weaken the kicks with --set perturbation.velocity"
        else:
            hint = "train longer with --resume; play.py --eval shows the error of each command and the survived pushes"
        return [
            f"it can: {'; '.join(can) or 'nothing yet'}",
            f"it cannot: {'; '.join(cannot) or '-'}",
            f"next: {hint}",
        ]

    def beats_peer(self, result: Mapping[str, Any]) -> bool:
        """Whether the result is no worse than each peer in all figures, and better in errors and cost of transport."""
        return all(_beats(result, peer.figures) for peer in self.peers)

    def reached(self, result: Mapping[str, Any]) -> tuple[int, int]:
        """The number of figures that are no worse than the peers' best, and the number of compared figures."""
        compared = [figure for figure in self.figures(result) if figure.peer is not None]
        return sum(figure.reaches_peer() for figure in compared), len(compared)

    def figures(self, result: Mapping[str, Any], others: Sequence[Mapping[str, Any]] = ()) -> list[Figure]:
        """The figures of the result in the table's order, including those that only ``others`` have."""
        peer, no_values = best_of(self.peers), (None, None, None)
        star = "*" if any(peer.own_speed for peer in self.peers) else ""
        rows = [Figure("falls in 22 commands", result["falls"], 0, 0, peer.get("falls"), card=("falls", "of 22"))]
        for i, (axis, unit) in enumerate(AXES):
            card = (f"{axis.removesuffix(' rate')} {self.marks_of}", unit)
            for measure, name in {
                "error": f"error {axis} [{unit}]",
                "worst": "  worst command",
                "offset": "  of the mean velocity",
            }.items():
                mark, on_card = (self.marks[i], card) if measure == self.marks_of else (None, None)
                peer_value = peer.get(measure, no_values)[i]
                if measure != "offset" or measure == self.marks_of or peer_value is not None:
                    rows.append(Figure(name, result[measure][i], 3, mark, peer_value, card=on_card))
        if any("estimate_rms" in each for each in (result, *others)):
            rms = result.get("estimate_rms") or (None, None)
            rows += [Figure(f"estimate of {AXES[i][0]}, rms [m/s]", rms[i], 3, without="none") for i in range(2)]
        rows.append(Figure("drift standing 8 s [m]", result["drift"], 4, None, peer.get("drift"), equal=EQUAL_DRIFT))
        rows.append(Figure("joint speed standing [rad/s]", result["joint_speed"], 3))
        for speed, share in result["pushes"].items():
            mark, card = (1.0, (f"{speed} m/s pushes", "survived")) if float(speed) == self.push_mark else (None, None)
            rows.append(
                Figure(
                    f"survives pushes of {speed} m/s",
                    share,
                    2,
                    mark,
                    peer.get("pushes", {}).get(speed),
                    True,
                    card=card,
                    peer_mark=star,
                )
            )
        name, speed_text = "cost_of_transport", f"at {self.transport_vx:g} m/s"
        card = ("cost of transport", speed_text)
        return [
            *rows,
            Figure(" ".join(card), result[name], 2, None, peer.get(name), without="none", card=card, peer_mark=star),
        ]


def _tracking(velocity: NDArray[Any], commands: list[Velocity], upright: NDArray[Any]) -> dict[str, Any]:
    """The tracking errors of C commands, from the velocities (T, C, 3) and the worlds that did not fall (C,).

    The error of a world that fell is its command, so that a fall at a hard command does not improve the mean.
    """
    commanded = np.array(commands)
    difference = velocity - commanded
    error = np.where(upright[:, None], abs(difference).mean(axis=0), abs(commanded))
    offset = np.where(upright[:, None], abs(difference.mean(axis=0)), abs(commanded))
    rows = zip(commands, error, offset, upright.tolist(), strict=True)
    return {
        "falls": int((~upright).sum()),
        "error": _plain(error.mean(axis=0)),
        "worst": _plain(error.max(axis=0)),
        "offset": _plain(offset.mean(axis=0)),
        "commands": [
            {"command": list(c), "error": _plain(e), "offset": _plain(o), "fell": not ok} for c, e, o, ok in rows
        ],
    }


def _beats(result: Mapping[str, Any], peer: Mapping[str, Any]) -> bool:
    """Whether the result is no worse than the peer in all figures, and better in errors and cost of transport."""
    if result["falls"] > peer["falls"]:
        return False
    better = all(a < b for a, b in zip(result["error"], peer["error"], strict=True))
    better = (
        better and result["cost_of_transport"] is not None and result["cost_of_transport"] < peer["cost_of_transport"]
    )
    pairs = [
        (a, b) for name in ("worst", "offset") if name in peer for a, b in zip(result[name], peer[name], strict=True)
    ]
    pushes = all(result["pushes"][speed] >= share for speed, share in peer["pushes"].items())
    return better and all(a <= b for a, b in pairs) and pushes and result["drift"] <= max(EQUAL_DRIFT, peer["drift"])


def _check(given: Mapping[str, Any], ranges: Mapping[str, Sequence[float]]) -> None:
    """Raise ConfigError if a rule is invalid."""
    for name in given["ranges"]:
        if name not in VELOCITY:
            raise ConfigError(
                f"exam.ranges: {unknown('command', name, VELOCITY, 'the walking exam')}; others stay at their default"
            )
    for name in VELOCITY:
        if len(ranges.get(name, ())) != 2 or ranges[name][0] > ranges[name][1]:
            raise ConfigError(f"exam.ranges: {name} is {ranges.get(name)}; it must be two numbers, the lower first")
    speeds, mark = list(given["push_speeds"]), given["push_mark"]
    if not speeds or min(speeds) <= 0:
        raise ConfigError(f"exam.push_speeds is {speeds}; it must be one or more numbers above zero")
    if mark not in speeds:
        raise ConfigError(f"exam.push_mark is {mark:g}; it must be one of exam.push_speeds, {speeds}")
    if len(given.get("marks") or "xyw") != 3:
        raise ConfigError(f"exam.marks is {list(given['marks'])}; it must be three numbers, or an empty list")


def robot_of(name: str) -> str:
    """The key in ``PEERS`` for the value of ``exam.peer``; empty for an empty value. Raises ConfigError if unknown."""
    name = ALIASES.get(name, name)
    if name and name not in PEERS:
        raise ConfigError(f"exam.peer: {unknown('robot', name, PEERS, 'resources/peers.yaml')}")
    return name


def best_of(peers: list[Peer]) -> dict[str, Any]:
    """The best value of each figure over all ``peers``; different peers may have them."""

    def best(values: list[Any]) -> Any:
        if isinstance(values[0], list):
            return [min(column) for column in zip(*values, strict=True)]
        if isinstance(values[0], dict):
            return {key: max(value[key] for value in values) for key in values[0]}  # shares of pushes
        return min(values)

    return {name: best([peer.figures[name] for peer in peers]) for name in (peers[0].figures if peers else ())}


def in_common(peer: str) -> dict[str, Any]:
    """Fields of the config section ``exam`` for the common command range of the published policies of ``peer``.

    Raises ConfigError if the robot has no common command range.
    """
    if (robot := robot_of(peer)) not in COMMON:
        raise ConfigError(
            f"--ranges common: exam.peer is '{robot}'; a common range of all published policies is known for: {', '.join(COMMON)}"
        )
    ranges = {name: list(ends) for name, ends in zip(VELOCITY, COMMON[robot], strict=True)}
    return {"ranges": ranges, "push_vx": 0.0, "transport_vx": 0.0}


def table(result: Mapping[str, Any]) -> str:
    """The result as a text table with the pass marks and the best values of the peers."""
    rules = ExamRules.from_mapping(result["rules"])
    label = rules.peer_label
    width = max(8, len(label) + 2) if label else 0
    lines = [rules.asked_words(), f"{'':<30}{'this policy':>12}{'walks at':>10}{label:>{width}}"]
    for figure in rules.figures(result):
        lines.append(
            f"{figure.name:<30}{figure.text(figure.value):>12}{figure.mark_text():>10}{figure.peer_text():>{width}}".rstrip()
        )
    if len(rules.peers) > 1:
        lines.append(rules.peer_words())
    return "\n".join(
        [*lines, "; ".join(f"{words}: {'yes' if yes else 'no'}" for words, yes in verdicts(rules, result))]
    )


def verdicts(rules: ExamRules, result: Mapping[str, Any]) -> list[tuple[str, bool]]:
    """The texts of a result's verdicts, each with its value."""
    several, (reached, count) = len(rules.peers) > 1, rules.reached(result)
    beats = f"beats all {len(rules.peers)} published policies (at or beyond their best in {reached} of {count} figures)"
    words = {"walks": "walks", "beats_peer": beats if several else "beats the peer"}
    return [(words[key], result[key]) for key in words if key in result]


def save(result: dict[str, Any], path: Path) -> None:
    """Write the result as JSON."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")


def _plain(row: NDArray[np.float64]) -> list[float]:
    return [round(float(value), 5) for value in row]
