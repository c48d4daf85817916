"""Results of published policies in the walking exam. A task names its robot in ``exam.peer`` to be compared with them.

Figures compare only at equal commands, so a peer appears only beside an exam with the commands of its measurement.
Measured in MuJoCo's C engine on 2026-11-21. Each policy ran in its own or its vendor's scene, with its own
observations, gains, rate and clock. None of them fell in any of its 22 commands.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

Ranges = tuple[tuple[float, float], ...]  # lowest and highest vx, vy [m/s], yaw rate [rad/s]


class Peer(NamedTuple):
    """A published policy: its figures, and the rules of its measurement."""

    name: str
    asked: dict[str, Any]  # values of the ExamRules fields that affect its figures
    figures: dict[str, Any]  # the known keys of an exam's result
    own_speed: bool = False  # pushes and cost of transport at half its own top speed, whatever the ranges

    def fits(self, rules: Any) -> bool:
        """Whether it was measured by the same commands and pushes as ``rules``, an ExamRules."""
        apart = ("push_vx", "transport_vx") if self.own_speed else ()
        return all(getattr(rules, name) == value for name, value in self.asked.items() if name not in apart)


# One line per policy: name | highest trained vx [m/s], vy [m/s], yaw rate [rad/s]; commands from minus to plus these |
# mean error | error at the worst command | offset of the mean velocity, each (vx, vy, yaw rate) in these units.
_GO2 = """
DLS basic-locomotion              | 0.5 0.25 0.3 | 0.022 0.024 0.033 | 0.05 0.04 0.05 | 0.014 0.007 0.008
go2_rl_gym, CTS (rough)           | 2 1 2        | 0.059 0.057 0.042 | 0.14 0.15 0.07 | 0.054 0.050 0.023
Newton example (MJWarp)           | 1 1 1        | 0.056 0.046 0.148 | 0.12 0.14 0.45 | 0.042 0.032 0.106
Newton example (PhysX)            | 1 1 1        | 0.058 0.050 0.240 | 0.17 0.11 0.50 | 0.040 0.032 0.127
unitree_rl_gym, PR 62             | 1 1 1        | 0.034 0.041 0.103 | 0.10 0.10 0.50 | 0.020 0.031 0.072
unitree_rl_lab, a user's          | 1 0.4 1      | 0.083 0.060 0.114 | 0.16 0.20 0.32 | 0.083 0.053 0.105
HIMLoco (rough)                   | 1 1 1.57     | 0.053 0.121 0.362 | 0.11 0.44 1.57 | 0.046 0.118 0.281
robot_lab (rough)                 | 1 1 1        | 0.055 0.063 0.155 | 0.10 0.22 0.31 | 0.045 0.054 0.095
CTS (rough), later                | 2 1 2        | 0.078 0.062 0.059 | 0.17 0.13 0.11 | 0.074 0.052 0.030
MoE-CTS (rough, days of training) | 2 1 2        | 0.079 0.060 0.043 | 0.24 0.15 0.07 | 0.075 0.054 0.027
"""
_G1 = """
ASAP, decoupled locomotion       | 1 1 1        | 0.112 0.209 0.192 | 0.31 0.60 0.46 | 0.100 0.156 0.152
FALCON                           | 1 1 1        | 0.064 0.098 0.191 | 0.12 0.19 0.25 | 0.061 0.054 0.061
FALCON, decoupled                | 1 1 1        | 0.093 0.219 0.109 | 0.23 0.61 0.20 | 0.083 0.153 0.046
holosoma FastSAC                 | 1 1 1        | 0.120 0.260 0.080 | 0.27 0.74 0.14 | 0.116 0.203 0.048
holosoma PPO                     | 1 1 1        | 0.189 0.306 0.060 | 0.44 0.79 0.08 | 0.182 0.244 0.026
OpenHomie                        | 1.2 0.5 0.8  | 0.054 0.057 0.281 | 0.12 0.12 0.51 | 0.053 0.032 0.163
MuJoCo Playground                | 1 0.5 1      | 0.193 0.152 0.297 | 0.46 0.35 0.57 | 0.191 0.121 0.153
unitree_rl_gym (12 joints, LSTM) | 1 1 1        | 0.051 0.096 0.083 | 0.10 0.30 0.17 | 0.049 0.066 0.037
unitree_rl_lab                   | 1 0.3 0.2    | 0.032 0.051 0.059 | 0.17 0.15 0.19 | 0.030 0.039 0.044
unitree_rl_mjlab, Jan 2026       | 1 0.5 1      | 0.065 0.076 0.125 | 0.23 0.25 0.68 | 0.062 0.055 0.112
unitree_rl_mjlab, Mar 2026       | 1 0.5 1      | 0.037 0.079 0.084 | 0.10 0.14 0.15 | 0.029 0.051 0.064
RoboMimic deploy                 | 0.7 0.4 1.57 | 0.036 0.085 0.045 | 0.21 0.12 0.08 | 0.030 0.025 0.025
"""
# The same policies, all in one common range: name | mean error | error at the worst command | offset |
# and valid for both ranges: drift [cm] | cost of transport | pushes survived [%].
# The last two are measured at half of the policy's own highest vx.
_GO2_COMMON = """
DLS basic-locomotion              | 0.046 0.037 0.058 | 0.16 0.06 0.12 | 0.032 0.019 0.015 | 0.2  | 0.63 | 100 69 12 6 0 0 0 0
go2_rl_gym, CTS (rough)           | 0.053 0.039 0.034 | 0.11 0.09 0.06 | 0.050 0.031 0.021 | 1.0  | 0.47 | 100 100 100 100 100 88 75 44
Newton example (MJWarp)           | 0.045 0.048 0.140 | 0.17 0.20 0.45 | 0.036 0.034 0.086 | 0.1  | 1.57 | 100 100 94 88 56 31 31 31
Newton example (PhysX)            | 0.048 0.046 0.178 | 0.17 0.09 0.50 | 0.027 0.028 0.128 | 0.6  | 2.09 | 100 100 100 94 69 44 25 31
unitree_rl_gym, PR 62             | 0.034 0.034 0.090 | 0.10 0.09 0.50 | 0.021 0.022 0.072 | 2.2  | 0.43 | 100 100 100 100 62 19 0 0
unitree_rl_lab, a user's          | 0.073 0.057 0.119 | 0.17 0.20 0.32 | 0.072 0.052 0.111 | 0.2  | 0.30 | 100 100 88 88 44 19 6 0
HIMLoco (rough)                   | 0.048 0.075 0.265 | 0.11 0.28 1.00 | 0.044 0.070 0.213 | 0.8  | 0.56 | 100 100 100 69 56 50 31 31
robot_lab (rough)                 | 0.058 0.063 0.141 | 0.10 0.19 0.22 | 0.052 0.056 0.079 | 4.3  | 0.85 | 100 100 100 100 100 100 94 100
CTS (rough), later                | 0.051 0.039 0.048 | 0.10 0.11 0.11 | 0.047 0.030 0.030 | 12.1 | 0.45 | 100 100 100 100 100 94 81 25
MoE-CTS (rough, days of training) | 0.044 0.034 0.035 | 0.13 0.09 0.06 | 0.041 0.029 0.018 | 0.2  | 0.43 | 100 100 100 100 94 81 62 25
"""
_G1_COMMON = """
ASAP, decoupled locomotion       | 0.085 0.124 0.121 | 0.31 0.17 0.26 | 0.077 0.040 0.081 | 0.5   | 0.32 | 100 100 94 81 56
FALCON                           | 0.066 0.083 0.174 | 0.09 0.12 0.24 | 0.063 0.028 0.050 | 0.4   | 0.67 | 100 100 100 100 81
FALCON, decoupled                | 0.058 0.136 0.090 | 0.23 0.21 0.20 | 0.048 0.040 0.024 | 0.5   | 0.32 | 100 69 50 38 6
holosoma FastSAC                 | 0.069 0.128 0.070 | 0.27 0.19 0.10 | 0.065 0.048 0.025 | 0.0   | 0.40 | 100 100 100 94 44
holosoma PPO                     | 0.100 0.162 0.058 | 0.44 0.23 0.07 | 0.093 0.062 0.014 | 0.8   | 0.44 | 100 100 94 94 44
OpenHomie                        | 0.045 0.047 0.215 | 0.16 0.15 0.49 | 0.044 0.028 0.121 | 0.4   | 0.60 | 100 100 100 100 38
MuJoCo Playground                | 0.149 0.122 0.216 | 0.27 0.23 0.32 | 0.146 0.083 0.086 | 108.7 | 0.60 | 100 100 88 69 0
unitree_rl_gym (12 joints, LSTM) | 0.034 0.065 0.051 | 0.08 0.10 0.12 | 0.032 0.026 0.017 | 19.2  | 0.26 | 100 100 88 62 0
unitree_rl_lab                   | 0.032 0.052 0.111 | 0.17 0.15 0.47 | 0.030 0.039 0.102 | 1.0   | 0.35 | 100 100 56 19 6
unitree_rl_mjlab, Jan 2026       | 0.065 0.078 0.097 | 0.23 0.30 0.47 | 0.065 0.059 0.082 | 0.3   | 0.35 | 100 100 100 100 81
unitree_rl_mjlab, Mar 2026       | 0.034 0.068 0.067 | 0.07 0.11 0.11 | 0.026 0.035 0.045 | 0.3   | 0.42 | 100 100 100 94 19
RoboMimic deploy                 | 0.025 0.086 0.047 | 0.07 0.15 0.11 | 0.022 0.031 0.021 | 0.4   | 0.57 | 100 100 100 100 88
"""
_SPEEDS = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0)  # of pushes [m/s]; a biped gets the first five

# robot -> the common command range of its published policies
COMMON: dict[str, Ranges] = {
    "go2": ((-0.5, 1.0), (-0.4, 0.4), (-1.0, 1.0)),
    "g1": ((-0.5, 1.0), (-0.3, 0.3), (-0.5, 0.5)),
}


def _read(trained: str, common: str, ranges: Ranges, speeds: tuple[float, ...]) -> list[Peer]:
    """Each policy of the tables twice: measured in its trained ranges, and in the common ``ranges``."""
    found, shared = [], {name: rest for name, *rest in map(_cells, common.strip().splitlines())}
    for name, top, *own in map(_cells, trained.strip().splitlines()):
        *alike, drift, cost, survived = shared[name]
        half = round(_numbers(top)[0] / 2, 4)
        asked = {"push_speeds": speeds, "push_vx": half, "transport_vx": half}
        shares = [round(percent * 0.16) / 16 for percent in _numbers(survived)]  # share of the 16 directions
        rest = {
            "drift": round(float(drift) / 100, 5),
            "pushes": {f"{speed:g}": share for speed, share in zip(speeds, shares, strict=True)},
            "cost_of_transport": float(cost),
        }
        limits = tuple((-highest, highest) for highest in _numbers(top))
        for span, cells, own_speed in ((limits, own, False), (ranges, alike, True)):
            measured = dict(zip(("error", "worst", "offset"), map(_numbers, cells), strict=True))
            found.append(Peer(name, {"ranges": span, **asked}, {"falls": 0, **measured, **rest}, own_speed))
    return found


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.split("|")]


def _numbers(text: str) -> list[float]:
    return [float(number) for number in text.split()]


# robot -> its published policies; the one for Go1 ships with MuJoCo Playground
PEERS: dict[str, list[Peer]] = {
    "go1": [
        Peer(
            name="MuJoCo Playground",
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
    ],
    "go2": _read(_GO2, _GO2_COMMON, COMMON["go2"], _SPEEDS),
    "g1": _read(_G1, _G1_COMMON, COMMON["g1"], _SPEEDS[:5]),
}
ALIASES = {"playground_go1": "go1"}  # older runs and exports name a policy


def robot_of(name: str) -> str:
    """The key in ``PEERS`` for the value of ``exam.peer``; empty for an empty value. Raises ConfigError if unknown."""
    name = ALIASES.get(name, name)
    if name and name not in PEERS:
        raise ConfigError(f"exam.peer: {unknown('robot', name, PEERS, 'legged_mw/eval/peers.py')}")
    return name


def best_of(peers: list[Peer]) -> dict[str, Any]:
    """The best value of each figure over all ``peers``. One policy rarely has all of them."""

    def best(values: list[Any]) -> Any:
        if isinstance(values[0], list):
            return [min(column) for column in zip(*values, strict=True)]
        if isinstance(values[0], dict):
            return {key: max(value[key] for value in values) for key in values[0]}  # shares of pushes
        return min(values)

    return {name: best([peer.figures[name] for peer in peers]) for name in (peers[0].figures if peers else ())}
