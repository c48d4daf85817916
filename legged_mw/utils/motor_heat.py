"""A motor's heat, torque-speed limit and power, from its torques and speeds and from what is known of it.

Shapes: T physics steps, N robots, D motors. A motor is what turns a joint: its torque and speed are the joint's. A
rating that nobody published is NaN, and what needs it is NaN too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

HOT = 85.0  # [deg C] of a winding [as the limit in deploy/safety.py: drives switch themselves off at 90]
AT_LIMIT = 0.98  # share of the torque-speed limit: a larger torque counts as at the limit [as in eval/skills.py]


class Ratings(NamedTuple):
    """What the motors and the battery bear: (D,) each at the joint, NaN where unknown."""

    continuous_torque: Floats  # [N m] RMS, for ever
    motor_constant: Floats  # [N m/W^0.5] torque per root of the heat in the winding: Kt * gear / sqrt(resistance)
    thermal_resistance: Floats  # [K/W] from the winding to the room
    thermal_time: Floats  # [s] time constant of the winding
    peak_torque: Floats  # [N m] up to knee_speed; unknown: the simulation's limit
    knee_speed: Floats  # [rad/s] from here on the torque falls; unknown: only at top_speed
    top_speed: Floats  # [rad/s] without load
    battery_power: float  # [W] the most that the battery gives


BATTERY = "battery_power"
TABLES = tuple(name for name in Ratings._fields if name != BATTERY)  # those with a value a motor


def rms(torque: Floats) -> Floats:
    """(D,) [N m] root of the mean square of ``torque`` (T, N, D)."""
    return np.sqrt((torque**2).mean(axis=(0, 1), dtype=float))


def settled(torque: Floats, ratings: Ratings, ambient: float) -> Floats:
    """(D,) [deg C] that windings reach in the end at the RMS ``torque`` (D,) in a room of ``ambient`` [deg C]."""
    return ambient + (torque / ratings.motor_constant) ** 2 * ratings.thermal_resistance


def seconds_until_hot(torque: Floats, ratings: Ratings, ambient: float) -> Floats:
    """(D,) [s] until a winding that begins at ``ambient`` has HOT; infinite if it never does, NaN if unknown.

    First order: thermal_time * dT/dt = settled - T. Its strides must be short beside ``thermal_time``, as they are.
    """
    rise, room = settled(torque, ratings, ambient) - ambient, HOT - ambient
    share = room / np.maximum(rise, 1e-9)
    time = -ratings.thermal_time * np.log1p(-np.minimum(share, 1.0 - 1e-12))
    return np.where(np.isnan(rise) | np.isnan(time), np.nan, np.where(share < 1.0, time, np.inf))


def highest_torque(speed: Floats, ratings: Ratings, limit: Floats) -> Floats:
    """(T, N, D) [N m] that a motor can push with at ``speed`` along its motion: flat to the knee, then a line to 0.

    ``limit`` (D,): the simulation's torque limits, where no peak torque is known.
    """
    peak = np.where(np.isnan(ratings.peak_torque), limit, ratings.peak_torque)
    top = np.where(np.isnan(ratings.top_speed), np.inf, ratings.top_speed)
    knee = np.minimum(np.where(np.isnan(ratings.knee_speed), top, ratings.knee_speed), top)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(np.abs(speed) <= knee, 1.0, (top - np.abs(speed)) / (top - knee))
    return peak * np.clip(np.nan_to_num(left, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)


def at_limit(torque: Floats, speed: Floats, ratings: Ratings, limit: Floats) -> Floats:
    """(D,) Share of time at the torque-speed limit or beyond; NaN for a motor without any limit.

    A motor that brakes has ``limit`` (D,) at any speed.
    """
    most = np.where(torque * speed > 0.0, highest_torque(speed, ratings, limit), limit)
    share = (np.abs(torque) >= AT_LIMIT * most).mean(axis=(0, 1))
    known = np.isfinite(limit) | ~np.isnan(ratings.peak_torque)
    return np.where(known, share, np.nan)


def power(torque: Floats, speed: Floats, ratings: Ratings) -> Floats:
    """(T, N) [W] from the battery: motion and the windings' heat, where a motor constant is known.

    Motors that brake feed the others; what is left over does not count as given back.
    """
    heat = np.nan_to_num((torque / ratings.motor_constant) ** 2)
    return np.maximum((torque * speed + heat).sum(axis=2), 0.0)
