"""Motor use in the report: torque against speed for each kind of joint, inside the motor's torque-speed envelope.

Numpy arrays in, plain numbers out. ``draw`` plots them on the given axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from legged_mw.eval.rollout import Record

Array = NDArray[Any]
BINS = (40, 32)  # of speed and torque
NEAR = 0.02  # share of the highest torque: a sample this close to the envelope counts as at the limit
MARGIN = 1.08  # size of the plot relative to samples and envelope


class MotorLimits(NamedTuple):
    """The motors' limits, each (D,); infinite where unknown."""

    low: Array  # [N m]
    high: Array  # [N m]
    stall_torque: Array  # [N m]
    no_load_speed: Array  # [rad/s]

    def at(self, speed: Array) -> tuple[Array, Array]:
        """Lowest and highest torque at ``speed`` (..., D)."""
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
    found = []
    for kind in dict.fromkeys(kinds):
        joints = [i for i, name in enumerate(kinds) if name == kind]
        drawn = {
            "kind": kind,
            **_picture(torque[..., joints].ravel(), speed[..., joints].ravel(), limits.of(joints[0])),
        }
        known = bool(np.isfinite(most[joints]).all()) and stood.any()
        found.append({**drawn, "at_limit": float(at_limit[..., joints].mean()) if known else None})
    return found


def _picture(torque: Array, speed: Array, limits: MotorLimits) -> dict[str, Any]:
    """The counts of samples on a grid of speed and torque, and the envelope over the same speeds."""
    free = float(limits.no_load_speed[0])
    widest = max(float(np.abs(speed).max(initial=1.0)), min(free, 1e3) if np.isfinite(free) else 0.0) * MARGIN
    strong = float(np.minimum(limits.high, limits.stall_torque)[0])
    highest = max(float(np.abs(torque).max(initial=1.0)), strong if np.isfinite(strong) else 0.0) * MARGIN
    counts, speeds, torques = np.histogram2d(speed, torque, BINS, [[-widest, widest], [-highest, highest]])
    line = np.linspace(-widest, widest, 97)
    low, high = (np.clip(side, -highest, highest).round(4).tolist() for side in limits.at(line))
    bounded = bool(np.isfinite(strong))
    return {
        "speeds": speeds.round(4).tolist(),
        "torques": torques.round(4).tolist(),
        "counts": counts.T.astype(int).tolist(),  # (torque, speed)
        "envelope": {"speed": line.round(4).tolist(), "low": low, "high": high} if bounded else None,
    }


def draw(motor: dict[str, Any], heat: Any, ink: tuple[str, str], suffix: str, ax: Any) -> None:
    """Plot one kind of joint. ``heat``: colour map of the counts. ``ink``: colours of the envelope and of the notes."""
    counts, speeds, torques = (np.array(motor[key], dtype=float) for key in ("counts", "speeds", "torques"))
    # only cells with samples: a full mesh would make a page of megabytes
    rows, columns = np.nonzero(counts)
    often = np.log1p(counts[rows, columns]) / np.log1p(counts.max(initial=1.0))
    ax.bar(
        speeds[columns],
        np.diff(torques)[0],
        np.diff(speeds)[0],
        torques[rows],
        align="edge",
        color=heat(1.0 - often),
        linewidth=0,
    )
    if motor["envelope"]:
        for side in ("low", "high"):
            ax.plot(motor["envelope"]["speed"], motor["envelope"][side], color=ink[0], linewidth=1.2)
    share = motor["at_limit"]
    ax.set(title=f"{motor['kind'].replace('_', ' ')}{suffix}", xlabel="speed [rad/s]", ylabel="torque [N m]")
    ax.set_title(
        "no limit known" if share is None else f"{share:.1%} at the limit", loc="right", color=ink[1], fontsize=7.0
    )
