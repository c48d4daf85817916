"""The table of commands for training, contract, viewer and deploy: names, ranges, units, defaults.

It imports neither torch nor a simulator.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

HEADING = "heading"  # a range but not a command: commands.heading_command computes the yaw rate from it


class Command(NamedTuple):
    """One command: a column of ``env.commands``."""

    name: str
    low: float  # [unit]
    high: float  # [unit]
    unit: str = ""
    mirror: float | None = None  # sign in the left-right mirror image: 1 or -1; None: unknown
    default: float = 0.0  # [unit] value without a user's command, from low to high

    @property
    def label(self) -> str:
        """Short name for display."""
        return LABELS.get(self.name, self.name.replace("_", " "))


LABELS = {"lin_vel_x": "vx", "lin_vel_y": "vy", "ang_vel_yaw": "yaw rate"}
VELOCITY = tuple(LABELS)  # body frame, at the IMU
_KNOWN = {"lin_vel_x": ("m/s", 1.0), "lin_vel_y": ("m/s", -1.0), "ang_vel_yaw": ("rad/s", -1.0)}  # unit, mirror sign


def command_table(cfg: Any) -> tuple[Command, ...]:
    """The commands of an environment's config, in the order of ``commands.ranges``; () without that section.

    Raises ConfigError for a unit, a mirror sign or a default of a command that is not in ``commands.ranges``, and for
    a default outside of its range.
    """
    section = getattr(cfg, "commands", None)
    if section is None:
        return ()
    ranges = {name: span for name, span in vars(section.ranges).items() if name != HEADING}
    for field in ("units", "mirror", "default"):
        for name in getattr(section, field):
            if name not in ranges:
                raise ConfigError(f"commands.{field}: {unknown('command', name, ranges, 'commands.ranges')}")
    table = []
    for name, (low, high) in ranges.items():
        unit, sign = _KNOWN.get(name, ("", None))
        default = section.default.get(name, min(max(0.0, low), high))
        if not low <= default <= high:
            raise ConfigError(f"commands.default: {name} is {default:g}; commands.ranges.{name} is [{low:g}, {high:g}]")
        table.append(Command(name, low, high, section.units.get(name, unit), section.mirror.get(name, sign), default))
    return tuple(table)


def with_units(table: Sequence[Command]) -> str:
    """Labels with units, as ``vx [m/s], vy [m/s], yaw rate [rad/s]``."""
    return ", ".join(f"{c.label} [{c.unit}]" if c.unit else c.label for c in table)
