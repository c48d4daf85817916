"""The heat exam: temperature, limits and power of an export's motors, as figures, verdict and text. Numpy only.

``legged_mw.deploy.heat_exam`` records the motions. ``legged_mw.utils.motor_heat`` has the model and the shapes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from legged_mw.utils.motor_heat import (
    BATTERY,
    HOT,
    TABLES,
    Floats,
    Ratings,
    at_limit,
    power,
    rms,
    seconds_until_hot,
    settled,
)

AMBIENTS = (20.0, 40.0)  # [deg C] ambient temperatures, which the windings have at the start
LOADED = 6  # rows of the text table, for the motors with the largest load
THERMAL = ("motor_constant", "thermal_resistance", "thermal_time")

# ---- figures of an export -------------------------------------------------------------------------------------------


class Motion(NamedTuple):
    """The record of N robots that stand, walk or perform their skill, sampled at each physics step."""

    torque: Floats  # (T, N, D) [N m]
    speed: Floats  # (T, N, D) [rad/s]


class Switch(NamedTuple):
    """The switch to the policy from a stand in the default pose with the policy's gains."""

    step: float  # [s] physics step
    jump: Floats  # (D,) [rad] from the pose to the policy's first target, before clipping
    before: Floats  # (D,) [N m] last torque of the stand
    after: Motion  # of one robot; it begins at the policy's first target
    period: float  # [s] control step


def phase(motion: Motion, ratings: Ratings, limit: Floats) -> dict[str, Any]:
    """The figures of a motion, as lists (D,) in the order of the motors; None if unknown."""
    load, taken = rms(motion.torque), power(*motion, ratings)
    minutes = {f"{each:g}": seconds_until_hot(load, ratings, each) / 60.0 for each in AMBIENTS}
    return {
        "rms": _plain(load),
        "of_limit": _plain(load / limit),
        "of_rating": _plain(load / ratings.continuous_torque),
        "at_limit": _plain(at_limit(*motion, ratings, limit)),
        "settles": {f"{each:g}": _plain(settled(load, ratings, each)) for each in AMBIENTS},  # [deg C]
        "minutes": {each: _plain(values) for each, values in minutes.items()},  # None also if never reached
        "mean_power": round(float(taken.mean()), 1),
        "peak_power": round(float(taken.max()), 1),
    }


def switched(switch: Switch, ratings: Ratings, joints: Sequence[str]) -> dict[str, Any]:
    """The jumps of target and torque in the first control step, the peak power, and the time above half of it."""
    first = switch.after.torque[: max(1, round(switch.period / switch.step)), 0]
    change = np.abs(first - switch.before).max(axis=0)
    taken = power(*switch.after, ratings)[:, 0]
    peak = float(taken.max())
    return {
        "target_jump": round(float(np.abs(switch.jump).max()), 4),
        "target_joint": joints[int(np.abs(switch.jump).argmax())],
        "torque_jump": round(float(change.max()), 3),
        "torque_joint": joints[int(change.argmax())],
        "peak_power": round(peak, 1),
        "seconds": round(float((taken >= 0.5 * peak).sum()) * switch.step, 4) if peak > 0.0 else 0.0,
    }


def finish(
    joints: Sequence[str],
    ratings: Ratings,
    limit: Floats,
    motions: Mapping[str, Motion | None],
    switch: Switch | None,
    switches: bool = False,
) -> dict[str, Any]:
    """The result, for JSON. ``motions``: "standing", "walking" ...; None: the robot fell. ``limit``: (D,) [N m].

    ``switches``: true if the switch was tested; then ``switch`` None means that the robot fell.
    """
    result: dict[str, Any] = {
        "joints": list(joints),
        "ratings": {name: texts for name in TABLES if any(map(bool, texts := _plain(getattr(ratings, name))))},
        BATTERY: None if math.isnan(ratings.battery_power) else ratings.battery_power,
        "unknown": unknown(ratings),
        "phases": {name: phase(each, ratings, limit) if each else None for name, each in motions.items()},
        "switch": switched(switch, ratings, joints) if switch else None,
        "switches": switches,
    }
    return {**result, "reasons": (texts := reasons(result)), "trips": True if texts else _verdict(result)}


def unknown(ratings: Ratings) -> list[str]:
    """The names of the ratings that the verdict needs and that are unknown for a motor or the battery."""
    heat = [name for name in ("continuous_torque", *THERMAL) if np.isnan(getattr(ratings, name)).any()]
    return [*heat, *([BATTERY] if math.isnan(ratings.battery_power) else [])]


def reasons(result: Mapping[str, Any]) -> list[str]:
    """The reasons in words why the robot may switch off; empty if the known ratings give none."""
    texts, limit = [], result[BATTERY]
    for name, each in result["phases"].items():
        if not each:
            continue
        cool = f"{AMBIENTS[0]:g}"
        if (hot := _least(each["minutes"][cool])) is not None:
            later = [each["minutes"][f"{room:g}"][hot] for room in AMBIENTS[1:]]
            others = ", ".join(f"{m:.0f} min at {room:g} C" for m, room in zip(later, AMBIENTS[1:], strict=True))
            time = f"{each['minutes'][cool][hot]:.0f} min {name} at {cool} C"
            texts.append(f"{_short(result, hot)} reaches {HOT:g} C after {time}, {others}")
        over = _most(each["of_rating"])
        if over is not None and each["of_rating"][over] > 1.0:
            share = f"{each['rms'][over]:.1f} N m RMS {name}, {each['of_rating'][over]:.2f} of its continuous rating"
            texts.append(f"{_short(result, over)} carries {share}: it overheats")
        if limit is not None and each["peak_power"] > limit:
            texts.append(
                f"{_watts(each['peak_power'])} {name}, and the battery gives {_watts(limit)}: it may cut power"
            )
    switch = result["switch"]
    if switch and limit is not None and switch["peak_power"] > limit:
        burst = f"{_watts(switch['peak_power'])} for {1000 * switch['seconds']:.0f} ms at the switch"
        texts.append(f"{burst}, and the battery gives {_watts(limit)}: this robot may cut power")
    return texts


def _verdict(result: Mapping[str, Any]) -> bool | None:
    """False if all ratings are known and the robot stayed up, else None. For heat either THERMAL or the continuous torque is enough."""
    lacking = set(result["unknown"])
    heat = "continuous_torque" in lacking and bool(lacking & set(THERMAL))
    fell = None in result["phases"].values() or (result["switches"] and result["switch"] is None)
    return None if heat or BATTERY in lacking or fell else False


# ---- text -----------------------------------------------------------------------------------------------------------


_UNKNOWN = "unknown"
LEAD = (
    f"the {{count}} most loaded of {{motors}} motors, with minutes until a winding has {HOT:g} C where they are known"
)


def lines(result: Mapping[str, Any]) -> list[str]:
    """Lines on heat, torque-speed limit, power, switch and verdict."""
    texts, names = [], result["joints"]
    for name, each in result["phases"].items():
        if not each:
            texts.append(f"{name}: it fell, so nothing is known")
            continue
        texts += [f"{name}: {_heat_words(result, each)}", f"{name}: {_limit_words(result, each)}"]
        texts.append(f"{name}: {_power_words(result, each)}")
    if result["switch"] is None and result["switches"]:
        texts.append("switch from stand to policy: it falls at once")
    if switch := result["switch"]:
        jump = f"{switch['target_jump']:.2f} rad ({_bare(switch['target_joint'])})"
        torque = f"{switch['torque_jump']:.1f} N m ({_bare(switch['torque_joint'])})"
        burst = f"{_watts(switch['peak_power'])} at most, for {1000 * switch['seconds']:.0f} ms above half of that"
        texts.append(f"switch from stand to policy: targets jump by {jump}, torque by {torque}; {burst}")
    if result["unknown"]:
        texts.append(f"unknown of {len(names)} motors and the battery: {', '.join(result['unknown'])}")
    return [*texts, f"will it trip: {verdict(result)}"]


def verdict(result: Mapping[str, Any]) -> str:
    """The verdict in words: yes with the reasons, no, or unknown."""
    if result["trips"]:
        return f"yes: {'; '.join(result['reasons'])}"
    return _UNKNOWN if result["trips"] is None else "no"


def _heat_words(result: Mapping[str, Any], each: Mapping[str, Any]) -> str:
    """Text on the first motor at HOT, else on the warmest winding, else on the motor nearest to its rating or limit."""
    cool = f"{AMBIENTS[0]:g}"
    if (hot := _least(each["minutes"][cool])) is not None:
        return f"{_short(result, hot)} reaches {HOT:g} C after {each['minutes'][cool][hot]:.0f} min at {cool} C"
    if (warm := _most(each["settles"][cool])) is not None:
        return (
            f"the warmest winding, {_short(result, warm)}, settles at {each['settles'][cool][warm]:.0f} C at {cool} C"
        )
    if (near := _most(each["of_rating"])) is not None:
        share = f"{each['rms'][near]:.1f} N m RMS, {each['of_rating'][near]:.2f} of its continuous rating"
        return f"{_short(result, near)} carries {share}; minutes until {HOT:g} C are unknown"
    near = _most(each["of_limit"])
    near = int(np.argmax(each["rms"])) if near is None else near
    share = "" if each["of_limit"][near] is None else f", {each['of_limit'][near]:.2f} of its torque limit"
    words = f"{_short(result, near)} carries {each['rms'][near]:.1f} N m RMS{share}"
    return f"{words}; its continuous rating and minutes until {HOT:g} C are unknown"


def _limit_words(result: Mapping[str, Any], each: Mapping[str, Any]) -> str:
    near = _most(each["at_limit"])
    if near is None:
        return "the motors' torque-speed limits are unknown"
    if each["at_limit"][near] < 0.0005:
        return "no motor is at its torque-speed limit for 0.1% of the time"
    return f"{_short(result, near)} is at its torque-speed limit {each['at_limit'][near]:.1%} of the time"


def _power_words(result: Mapping[str, Any], each: Mapping[str, Any]) -> str:
    most, losses = result[BATTERY], "motor_constant" not in result["unknown"]
    gives = "what the battery gives is unknown" if most is None else f"the battery gives {_watts(most)}"
    what = "" if losses else " without the windings' losses, which are unknown"
    return f"{_watts(each['mean_power'])} mean, {_watts(each['peak_power'])} at most{what}; {gives}"


def rows(result: Mapping[str, Any], most: int | None = None) -> list[list[str]]:
    """A heading, and a row per motor. ``most``: only this many motors with the largest load. No unknown columns."""
    phases = {name: each for name, each in result["phases"].items() if each}
    order = range(len(result["joints"]))
    if most is not None and phases:
        load = np.max([[share or 0.0 for share in each["of_limit"]] for each in phases.values()], axis=0)
        order = np.argsort(-load, kind="stable")[:most].tolist()
    columns = [["", *(_short(result, i) for i in order)]]
    for name, each in phases.items():
        columns.append([f"{name}: RMS [N m]", *(f"{each['rms'][i]:.1f}" for i in order)])
        for key, title, digits in (("of_limit", "of limit", ".2f"), ("of_rating", "of rating", ".2f")):
            columns.append([title, *(_cell(each[key][i], digits) for i in order)])
        columns.append(["at limit", *(_cell(each["at_limit"][i], ".1%") for i in order)])
        columns += [[f"min at {room:g} C", *(_minutes(each, f"{room:g}", i) for i in order)] for room in AMBIENTS]
    return [list(row) for row in zip(*(each for each in columns if {*each[1:]} != {_UNKNOWN}), strict=True)]


def table(result: Mapping[str, Any]) -> str:
    """The result as text."""
    cell_rows = rows(result, LOADED)
    widths = [max(map(len, column)) for column in zip(*cell_rows, strict=True)]
    texts = [f"heat and power: {LEAD.format(count=len(cell_rows) - 1, motors=len(result['joints']))}"]
    for name, *cells in cell_rows:
        padded = [f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True)]
        texts.append("   ".join([f"{name:<{widths[0]}}", *padded]).rstrip())
    return "\n".join([*texts, *lines(result)])


def _minutes(each: Mapping[str, Any], room: str, i: int) -> str:
    if each["minutes"][room][i] is not None:
        return f"{each['minutes'][room][i]:.0f}"
    return _UNKNOWN if each["settles"][room][i] is None else "never"


def _cell(value: float | None, digits: str) -> str:
    return _UNKNOWN if value is None else format(value, digits)


def _watts(value: float) -> str:
    return f"{value / 1000.0:.1f} kW" if value >= 1000.0 else f"{value:.0f} W"


def _short(result: Mapping[str, Any], i: int) -> str:
    return _bare(result["joints"][i])


def _bare(joint: str) -> str:
    return joint.removesuffix("_joint")


def _most(values: Sequence[float | None]) -> int | None:
    """Index of the largest value; None if all are unknown."""
    known = [(value, -i) for i, value in enumerate(values) if value is not None]
    return -max(known)[1] if known else None


def _least(values: Sequence[float | None]) -> int | None:
    known = [(value, i) for i, value in enumerate(values) if value is not None]
    return min(known)[1] if known else None


def _plain(values: Floats) -> list[float | None]:
    """Numbers for JSON; None for NaN and infinity."""
    return [round(float(value), 5) if math.isfinite(value) else None for value in values]
