"""The table of commands: names, ranges, units and defaults. Training, contract, viewer and deploy read it. No torch, no simulator."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from legged_mw.utils.config import ConfigError
from legged_mw.utils.errors import unknown

HEADING = "heading"  # in commands.ranges, but no command: commands.heading_command makes the yaw rate from it


class Command(NamedTuple):
    """One command: a column of ``env.commands``."""

    name: str
    low: float  # [unit]
    high: float  # [unit]
    unit: str = ""
    mirror: float | None = None  # its sign in the left-right mirror image: 1 or -1; None: not stated
    default: float = 0.0  # [unit] what it is when nothing is asked, within low and high

    @property
    def label(self) -> str:
        """Short name for people."""
        return LABELS.get(self.name, self.name.replace("_", " "))


LABELS = {"lin_vel_x": "vx", "lin_vel_y": "vy", "ang_vel_yaw": "yaw rate"}
VELOCITY = tuple(LABELS)  # body frame, at the IMU
_KNOWN = {"lin_vel_x": ("m/s", 1.0), "lin_vel_y": ("m/s", -1.0), "ang_vel_yaw": ("rad/s", -1.0)}  # unit, mirror sign


def command_table(cfg: Any) -> tuple[Command, ...]:
    """The commands of an environment's config, in the order of ``commands.ranges``; () if it has no such section.

    Raises ConfigError for a unit, a mirror sign or a default of a command that ``commands.ranges`` does not have.
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
    """``vx, vy [m/s], yaw rate [rad/s]``: labels with units."""
    return ", ".join(f"{c.label} [{c.unit}]" if c.unit else c.label for c in table)


def parse_command(text: str, table: Sequence[Command]) -> list[float]:
    """Values (C,) from ``0.5,0,0`` in the order of the table, or ``base_height=0.3`` by name; what is not named keeps its default.

    Raises ConfigError for a name that does not exist, too many numbers, or a value outside of what was trained.
    """
    names, values = [c.name for c in table], [c.default for c in table]
    for place, item in enumerate(text.split(",")):
        name, equals, number = item.partition("=")
        if equals and name.strip() not in names:
            raise ConfigError(f"--command {text}: {unknown('command', name.strip(), names, 'this task')}")
        if not equals and place >= len(table):
            known = with_units(table) or "none"
            raise ConfigError(
                f"--command {text}: {place + 1} numbers, but this task has {len(table)} commands: {known}"
            )
        try:
            value = float(number if equals else item)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            example = ",".join(f"{c.default:g}" for c in table)
            raise ConfigError(
                f"--command {text}: '{item.strip()}' is no number; write --command={example} ({with_units(table)})"
            )
        values[names.index(name.strip()) if equals else place] = value
    if wrong := outside(values, table):
        raise ConfigError(f"--command {text}: {wrong}")
    return values


def outside(values: Sequence[float], table: Sequence[Command]) -> str:
    """What is wrong with values (C,) that leave the trained ranges, in words; empty if nothing is."""
    for value, command in zip(values, table, strict=True):
        if not command.low - 1e-9 <= value <= command.high + 1e-9:
            unit = f" {command.unit}" if command.unit else ""
            return f"{command.label} = {value:g}{unit} is outside of what was trained, [{command.low:g}, {command.high:g}]{unit}"
    return ""
