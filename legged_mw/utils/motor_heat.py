"""Heat, torque-speed limit and power of motors, from their torques, speeds and ratings.

Shapes: T physics steps, N robots, D motors. Torque and speed of a motor are those of its joint. An unknown rating is
NaN, and so is every result that needs it.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[Any]

HOT = 85.0  # [deg C] limit of a winding [as in deploy/safety.py: drives switch off at 90]
AT_LIMIT = 0.98  # share of the torque-speed limit from which a torque counts as at the limit [as in eval/skills.py]


class Ratings(NamedTuple):
    """Ratings of the motors, (D,) each at the joint, and of the battery; NaN if unknown."""

    continuous_torque: Floats  # [N m] RMS, without a time limit
    motor_constant: Floats  # [N m/W^0.5] torque per root of the heat in the winding: Kt * gear / sqrt(resistance)
    thermal_resistance: Floats  # [K/W] from the winding to the ambient air
    thermal_time: Floats  # [s] time constant of the winding
    peak_torque: Floats  # [N m] up to knee_speed; unknown: the simulation's limit
    knee_speed: Floats  # [rad/s] speed above which the largest torque decreases; unknown: top_speed
    top_speed: Floats  # [rad/s] no-load speed
    battery_power: float  # [W] largest power of the battery


BATTERY = "battery_power"
TABLES = tuple(name for name in Ratings._fields if name != BATTERY)  # ratings with a value per motor


def rms(torque: Floats) -> Floats:
    """(D,) [N m] root mean square of ``torque`` (T, N, D)."""
    return np.sqrt((torque**2).mean(axis=(0, 1), dtype=float))


def settled(torque: Floats, ratings: Ratings, ambient: float) -> Floats:
    """(D,) [deg C] steady-state winding temperature for the RMS ``torque`` (D,) at ``ambient`` [deg C]."""
    return ambient + (torque / ratings.motor_constant) ** 2 * ratings.thermal_resistance


def seconds_until_hot(torque: Floats, ratings: Ratings, ambient: float) -> Floats:
    """(D,) [s] time for a winding to heat from ``ambient`` to HOT; infinite if it never does, NaN if unknown.

    First-order model: thermal_time * dT/dt = settled - T. It assumes a ``thermal_time`` much longer than a stride.
    """
    rise, room = settled(torque, ratings, ambient) - ambient, HOT - ambient
    share = room / np.maximum(rise, 1e-9)
    time = -ratings.thermal_time * np.log1p(-np.minimum(share, 1.0 - 1e-12))
    return np.where(np.isnan(rise) | np.isnan(time), np.nan, np.where(share < 1.0, time, np.inf))


def highest_torque(speed: Floats, ratings: Ratings, limit: Floats) -> Floats:
    """(T, N, D) [N m] largest driving torque at ``speed``: constant up to knee_speed, then linear to 0 at top_speed.

    ``limit`` (D,): the simulation's torque limits, used if the peak torque is unknown.
    """
    peak = np.where(np.isnan(ratings.peak_torque), limit, ratings.peak_torque)
    top = np.where(np.isnan(ratings.top_speed), np.inf, ratings.top_speed)
    known = ~np.isnan(ratings.knee_speed) & np.isfinite(top)  # without a top speed nothing says how fast it falls
    knee = np.where(known, np.minimum(ratings.knee_speed, top), top)
    with np.errstate(divide="ignore", invalid="ignore"):
        left = np.where(np.abs(speed) <= knee, 1.0, (top - np.abs(speed)) / (top - knee))
    return peak * np.clip(np.nan_to_num(left, nan=0.0, posinf=1.0, neginf=0.0), 0.0, 1.0)


def at_limit(torque: Floats, speed: Floats, ratings: Ratings, limit: Floats) -> Floats:
    """(D,) Share of time at or above the torque-speed limit; NaN for a motor without a limit.

    For a braking motor the limit is ``limit`` (D,) at any speed.
    """
    most = np.where(torque * speed > 0.0, highest_torque(speed, ratings, limit), limit)
    share = (np.abs(torque) >= AT_LIMIT * most).mean(axis=(0, 1))
    known = np.isfinite(limit) | ~np.isnan(ratings.peak_torque)
    return np.where(known, share, np.nan)


def power(torque: Floats, speed: Floats, ratings: Ratings) -> Floats:
    """(T, N) [W] power from the battery: mechanical power, and heat in windings with a known motor constant.

    Braking motors supply the others. A negative sum counts as 0: the battery is not charged.
    """
    heat = np.nan_to_num((torque / ratings.motor_constant) ** 2)
    return np.maximum((torque * speed + heat).sum(axis=2), 0.0)
