"""Compute the report's figures from a record, as plain numbers. This module neither simulates nor draws.

N worlds, T control steps, D joints, F feet. A world that fell is None and is excluded from every mean here. The exam's
means in ``walking`` include it. ``settled`` is the first control step after the exam's settling time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legged_mw.eval.walking import GRAVITY, PUSH_DIRECTIONS, SLOW

SATURATED = 0.98  # share of the limit: a larger torque counts as saturated
STRAY = 0.3  # [share of the step] tolerance of the velocity at the start and at the end
SHORT_SWING = 2  # [control steps] shortest swing; a shorter time in the air is contact chatter
BINS = 40  # bins of a joint's histogram

Array = NDArray[Any]


class Record(NamedTuple):
    """N worlds over T control steps. Signals are sampled before each step. The first sample is the start state."""

    dt: float  # [s] control step
    mass: float  # [kg]
    commands: Array  # (T, N, C)
    fell_at: Array  # (N,) control step of the first fall, or inf; later samples belong to another episode
    last_position: Array  # (N, 2) [m] of the base after the last step
    signals: dict[str, Array]  # name -> (T, N, ...)

    def part(self, worlds: slice) -> Record:
        """The record of a range of worlds."""
        signals = {name: values[:, worlds] for name, values in self.signals.items()}
        return Record(
            self.dt, self.mass, self.commands[:, worlds], self.fell_at[worlds], self.last_position[worlds], signals
        )


# ---- velocity tracking


def tracking_errors(record: Record, settled: int, rows: int) -> list[list[list[float | None]]]:
    """Mean absolute error of vx, vy, yaw rate over a grid of worlds: 3 x rows x columns."""
    # mean over time, (N, 3)
    error = np.abs(record.signals["velocity"][settled:] - record.commands[settled:, :, :3]).mean(axis=0, dtype=float)
    error[np.isfinite(record.fell_at)] = np.nan
    return [plain(error[:, k].reshape(rows, -1)) for k in range(3)]


def step_response(time: Array, measured: Array, start: float, target: float) -> dict[str, float | None]:
    """The response of ``measured`` (T,) to a command that steps from ``start`` to ``target`` at time 0.

    ``rise_time``: from 10 to 90 % of the step [s]. ``overshoot``: beyond the target, as a share of the step.
    Both are None if ``measured`` does not begin near ``start`` or does not settle near ``target``.
    ``left``: mean difference to the target in the last half second, in the unit of ``measured``.
    """
    progress = (measured - start) / (target - start)
    after = (time >= 0.0) & np.isfinite(progress)
    time, progress = time[after], progress[after]
    if not len(time):
        return {"rise_time": None, "overshoot": None, "left": None}
    end = progress[time >= time[-1] - 0.5]
    left = float(np.mean(end - 1.0)) * (target - start)
    if abs(progress[0]) > STRAY or abs(np.mean(end) - 1.0) > STRAY:
        return {"rise_time": None, "overshoot": None, "left": left}
    low, high = _first_crossing(time, progress, 0.1), _first_crossing(time, progress, 0.9)
    rise_time = None if low is None or high is None else high - low
    return {"rise_time": rise_time, "overshoot": max(0.0, float(progress.max()) - 1.0), "left": left}


def _first_crossing(time: Array, values: Array, level: float) -> float | None:
    """The time at which ``values`` first reaches ``level``, interpolated between samples."""
    i = int(np.argmax(values >= level))
    if values[i] < level:
        return None
    return float(np.interp(level, values[i - 1 : i + 1], time[i - 1 : i + 1])) if i else float(time[0])


def responses(record: Record, axis: int, begin: int) -> dict[str, Any]:
    """The velocity response along one axis. From step ``begin`` all worlds have the same command.

    Returns the command, and the mean, smallest and largest velocity over time. Worlds that fall are left out.
    """
    commanded, stood = record.commands[begin:, 0, axis], np.isinf(record.fell_at)
    moved = record.signals["velocity"][begin:, stood, axis].astype(float)
    time = np.arange(len(commanded)) * record.dt
    mean, low, high = (
        f(moved, axis=1) if stood.any() else np.full(len(time), np.nan) for f in (np.mean, np.min, np.max)
    )
    curves = {"time": time.round(4), "commanded": commanded, "mean": mean, "low": low, "high": high}
    numbers = _each_step(time, commanded, mean)
    return {**{name: plain(values) for name, values in curves.items()}, "fell": int((~stood).sum()), "numbers": numbers}


def _each_step(time: Array, commanded: Array, mean: Array) -> list[dict[str, Any]]:
    """The response to each change of the command, until the next change."""
    borders = [*(np.flatnonzero(np.diff(commanded)) + 1), len(time)]
    result = []
    for begin, end in zip(borders[:-1], borders[1:], strict=True):
        start, target = float(commanded[begin - 1]), float(commanded[begin])
        result.append(
            {
                "from": start,
                "to": target,
                **step_response(time[begin:end] - time[begin], mean[begin:end], start, target),
            }
        )
    return result


def estimates(record: Record, commands: Sequence[Sequence[float]], seconds: float) -> dict[str, Any]:
    """True and estimated vx, vy [m/s] in the last ``seconds`` of each command, joined in time (2, T).

    None if the world fell.
    """
    last = round(seconds / record.dt)
    result: dict[str, Any] = {"commands": [list(command) for command in commands], "seconds": last * record.dt}
    for name, signal in (("truth", "velocity"), ("estimate", "estimate")):
        values = record.signals[signal][-last:, :, :2].astype(float)
        values[:, np.isfinite(record.fell_at)] = np.nan
        result[name] = plain(values.transpose(2, 1, 0).reshape(2, -1).round(4))
    return result


# ---- gait


def duty_factor(contact: Array) -> list[float]:
    """(F,) share of time in which each foot is in contact; ``contact`` (T, F)."""
    return contact.mean(axis=0, dtype=float).tolist()


def stride_frequency(contact: Array, dt: float) -> float:
    """Strides per second [Hz], mean over the feet that step; 0 if none steps. ``contact`` (T, F).

    A stride lasts from touch-down to touch-down. A touch-down ends a swing of at least ``SHORT_SWING`` samples.
    """
    rates = []
    for down in contact.T.astype(bool):
        falls = np.flatnonzero(down[1:] & ~down[:-1]) + 1
        swings = [i for i in falls if i >= SHORT_SWING and not down[i - SHORT_SWING : i].any()]
        if len(swings) > 1:
            rates.append((len(swings) - 1) / ((swings[-1] - swings[0]) * dt))
    return float(np.mean(rates)) if rates else 0.0


def gaits(record: Record, settled: int, commands: Sequence[Sequence[float]], seconds: float) -> list[dict[str, Any]]:
    """For each command: duty factors, stride frequency, and the contacts (F, T) in the last ``seconds``."""
    result = []
    for world, command in enumerate(commands):
        contact, fell = record.signals["contact"][settled:, world], bool(np.isfinite(record.fell_at[world]))
        last = contact[-round(seconds / record.dt) :].T.astype(int).tolist()
        gait = {
            "duty_factor": duty_factor(contact),
            "stride_frequency": stride_frequency(contact, record.dt),
            "contact": last,
        }
        result.append({"command": list(command), **(dict.fromkeys(gait) if fell else gait)})
    return result


# ---- joints


def distribution(values: Array, low: Array, high: Array, margin: float = 1.0) -> dict[str, Any]:
    """The distribution of ``values`` (S, D) for each joint, and the share of samples beyond the limits.

    ``low``, ``high``: the limits (D,), multiplied by ``margin``. Infinite means no limit, and no share is computed.
    """
    if not len(values):
        return {"low": [], "high": [], "edges": [], "density": [], "saturated": []}
    histograms = [np.histogram(row, BINS, density=True) for row in values.T]
    outside, limited = (
        ((values < low * margin) | (values > high * margin)).mean(axis=0),
        np.isfinite(low) & np.isfinite(high),
    )
    return {
        "low": [float(v) if ok else None for v, ok in zip(low, limited, strict=True)],
        "high": [float(v) if ok else None for v, ok in zip(high, limited, strict=True)],
        "edges": [plain(edges.round(5)) for _, edges in histograms],
        "density": [plain(density.round(5)) for density, _ in histograms],
        "saturated": [float(v) if ok else None for v, ok in zip(outside, limited, strict=True)],
    }


def joints(record: Record, settled: int, limits: dict[str, tuple[Array, Array]]) -> dict[str, Any]:
    """Distributions of joint position, velocity and torque over the worlds that did not fall.

    ``limits``: signal -> (low, high), each (D,).
    """
    stood = np.isinf(record.fell_at)
    result = {}
    for name, (low, high) in limits.items():
        values = record.signals[name][settled:, stood]
        values = values.reshape(-1, values.shape[-1]).astype(float)
        result[name] = distribution(values, low, high, SATURATED if name == "torque" else 1.0)
    return result


# ---- pushes, energy, reward


def survival(fell_at: Array, until: int) -> list[list[bool]]:
    """True for each pushed robot that had not fallen at step ``until``: speeds x directions."""
    return (fell_at > until).reshape(-1, PUSH_DIRECTIONS).tolist()


def transport(record: Record, settled: int) -> dict[str, list[float | None]]:
    """For each world: speed [m/s] along the straight line from start to end, mean power [W], cost of transport [-]."""
    power = record.signals["power"][settled:].mean(axis=0, dtype=float)
    seconds = (len(record.signals["power"]) - settled) * record.dt
    speed = np.linalg.norm(record.last_position - record.signals["position"][settled], axis=1) / seconds
    cost = np.where(speed > SLOW, power / (record.mass * GRAVITY * np.maximum(speed, SLOW)), np.nan)
    stood = np.isinf(record.fell_at)
    each = {"speed": speed, "power": power, "cost_of_transport": cost}
    return {name: plain(np.where(stood, values, np.nan)) for name, values in each.items()}


def reward_shares(record: Record, settled: int, names: Sequence[str]) -> dict[str, float | None]:
    """For each term: scale * term per second, mean over the worlds that did not fall.

    The signal "reward" (T, N, K) is the sum since the start of the episode.
    """
    summed = record.signals["reward"][:, np.isinf(record.fell_at)].astype(float)
    seconds = (len(summed) - 1 - settled) * record.dt
    if not summed.shape[1] or seconds <= 0:
        return dict.fromkeys(names)
    return dict(zip(names, ((summed[-1] - summed[settled]) / seconds).mean(axis=0).tolist(), strict=True))


def plain(values: Array) -> list[Any]:
    """Nested lists for JSON; None for values that are not finite."""
    if values.ndim > 1:
        return [plain(row) for row in values]
    return [float(v) if math.isfinite(v) else None for v in values]


# ---- motors: torque and speed of each kind of joint, and the torque-speed envelope


MOTOR_BINS = (40, 32)  # bins of speed and torque
NEAR = 0.02  # [share of the largest torque] a sample this close to the envelope counts as at the limit
MARGIN = 1.08  # size of the plot relative to samples and envelope


class MotorLimits(NamedTuple):
    """The motors' limits, each (D,); infinite if unknown."""

    low: Array  # [N m]
    high: Array  # [N m]
    stall_torque: Array  # [N m]
    no_load_speed: Array  # [rad/s]

    def at(self, speed: Array) -> tuple[Array, Array]:
        """Smallest and largest torque [N m] at ``speed`` (..., D) [rad/s]."""
        share = speed / self.no_load_speed
        return np.maximum(self.low, -self.stall_torque * (1.0 + share)), np.minimum(
            self.high, self.stall_torque * (1.0 - share)
        )

    def of(self, joint: int) -> MotorLimits:
        """The limits of one joint, each (1,)."""
        return MotorLimits(*(values[joint : joint + 1] for values in self))


def envelopes(record: Record, settled: int, kinds: Sequence[str], limits: MotorLimits) -> list[dict[str, Any]]:
    """For each kind of joint: a histogram of torque and speed, the motor's envelope, and the share of time at it.

    ``kinds`` (D,): joints of the same kind share a plot and must have equal motors. Worlds that fell are left out.
    """
    stood = np.isinf(record.fell_at)
    torque, speed = (record.signals[name][settled:, stood].astype(float) for name in ("torque", "motor_speed"))
    low, high = limits.at(speed)
    most = np.minimum(limits.high, limits.stall_torque)
    near = np.where(np.isfinite(most), NEAR * most, 0.0)
    at_limit = (torque >= high - near) | (torque <= low + near)
    result = []
    for kind in dict.fromkeys(kinds):
        joints = [i for i, name in enumerate(kinds) if name == kind]
        drawn = {
            "kind": kind,
            **_picture(torque[..., joints].ravel(), speed[..., joints].ravel(), limits.of(joints[0])),
        }
        known = bool(np.isfinite(most[joints]).all()) and stood.any()
        result.append({**drawn, "at_limit": float(at_limit[..., joints].mean()) if known else None})
    return result


def _picture(torque: Array, speed: Array, limits: MotorLimits) -> dict[str, Any]:
    """The counts of samples on a grid of speed and torque, and the envelope over the same speeds."""
    free = float(limits.no_load_speed[0])
    widest = max(float(np.abs(speed).max(initial=1.0)), min(free, 1e3) if np.isfinite(free) else 0.0) * MARGIN
    strong = float(np.minimum(limits.high, limits.stall_torque)[0])
    highest = max(float(np.abs(torque).max(initial=1.0)), strong if np.isfinite(strong) else 0.0) * MARGIN
    counts, speeds, torques = np.histogram2d(speed, torque, MOTOR_BINS, [[-widest, widest], [-highest, highest]])
    line = np.linspace(-widest, widest, 97)
    low, high = (np.clip(side, -highest, highest).round(4).tolist() for side in limits.at(line))
    bounded = bool(np.isfinite(strong))
    return {
        "speeds": speeds.round(4).tolist(),
        "torques": torques.round(4).tolist(),
        "counts": counts.T.astype(int).tolist(),  # (torque, speed)
        "envelope": {"speed": line.round(4).tolist(), "low": low, "high": high} if bounded else None,
    }
