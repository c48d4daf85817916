"""The hard exam: conditions of a real robot, figures of the walk, and the marks of "ready for a robot". Numpy only.

``legged_mw.deploy.hard_exam`` runs it on an export. Shapes: T physics steps, P control steps, D joints, F feet.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from legged_mw.eval.figures import stride_frequency
from legged_mw.eval.walking import AXES, COMMON, LOADS, PEERS, ExamRules, Figure, Velocity

Array = NDArray[Any]

# ---- conditions -----------------------------------------------------------------------------------------------------


SECONDS, SETTLING = 6.0, 2.0  # [s] duration of a command; time at its start that is not measured
# Push k of 32 is at PUSH_AT [s] + k control steps. It is survived if the robot stands at the end, 3 s later at 50 Hz.
PUSH_AT, PUSH_DIRECTIONS = 2.3, 32
PUSH_BIPED, PUSH_OTHERS = 2.0, 3.0  # [m/s] jump of the base's horizontal velocity
LOAD = 0.175  # [share of the robot's mass] load, if the load of published policies is unknown
# Half ranges of uniform noise on the policy's measurements [ours: about twice a good sensor's]
NOISE = {"ang_vel": 0.2, "gravity": 0.05, "joint_pos": 0.01, "joint_vel": 1.5}


class Condition(NamedTuple):
    """The differences from the nominal robot."""

    name: str
    delay: float = 0.0  # [ms] from the measurement to the servos' target
    gains: float = 1.0  # factor of stiffness and damping; of the torque for motors without gains
    loaded: bool = False  # true: load on the trunk
    friction: float | None = None  # [-] of all contacts; None: the scene's
    noisy: bool = False  # true: NOISE


ALL = "all"
CONDITIONS = (
    Condition("none"),
    Condition("delay 10 ms", delay=10.0),
    Condition("delay 20 ms", delay=20.0),
    Condition("gains x 0.8", gains=0.8),
    Condition("gains x 1.2", gains=1.2),
    Condition("load", loaded=True),
    Condition("friction 0.3", friction=0.3),
    Condition("noise", noisy=True),
    Condition(ALL, delay=10.0, gains=0.9, loaded=True, friction=0.5, noisy=True),
)


def commands(rules: ExamRules) -> list[Velocity]:
    """The twelve commands (vx, vy, yaw rate); the first is to stand. Duplicates of a one-sided range are left out."""
    (x0, x1), (y0, y1), (w0, w1) = rules.ranges
    alone = [(x1 / 2, 0.0, 0.0), (x1, 0.0, 0.0), (x0, 0.0, 0.0)]
    alone += [(0.0, y, 0.0) for y in (y1, y0)] + [(0.0, 0.0, w) for w in (w1, w0)]
    corners = [(2 * x1 / 3, y / 2, w / 2) for y in (y1, y0) for w in (w1, w0)]
    every = [(0.0, 0.0, 0.0), *alone, *corners]
    return list(dict.fromkeys((round(vx, 4), round(vy, 4), round(yaw, 4)) for vx, vy, yaw in every))


def half_speed(rules: ExamRules) -> float:
    """vx [m/s] during pushes and for the figures of the walk: half of the largest vx."""
    return round(rules.ranges[0][1] / 2, 4)


def push_speed(feet: int) -> float:
    """Jump of the base velocity [m/s] at a push, for a robot with ``feet`` feet."""
    return PUSH_BIPED if feet == 2 else PUSH_OTHERS


def load_of(rules: ExamRules, mass: float) -> float:
    """The load [kg] of a robot of ``mass`` [kg]: the load of its published policies, else LOAD * mass."""
    return LOADS.get(rules.peer, round(LOAD * mass, 2))


def grade_condition(rules: ExamRules, velocity: Array, position: Array, fell_at: Array, dt: float) -> dict[str, Any]:
    """Falls, tracking errors, drift and survived pushes under one condition.

    The first worlds have ``commands``, the others have pushes. ``velocity`` (P, N, 3) [m/s, m/s, rad/s] and
    ``position`` (P, N, 2) [m] are sampled before each of P control steps of ``dt`` [s]. ``fell_at`` (N,): control step
    of the first fall, or inf. If the robot falls, the error of the command is that of standing still.
    """
    targets = np.array(commands(rules))
    count, settled = len(targets), round(SETTLING / dt)
    stood = np.isinf(fell_at)
    error = np.abs(velocity[settled:, :count] - targets).mean(axis=0, dtype=float)
    error = np.where(stood[:count, None], error, np.abs(targets))
    drift = float(np.linalg.norm(position[-1, 0] - position[settled, 0]))
    return {
        "falls": int((~stood[:count]).sum()),
        "error": [round(float(value), 5) for value in error.mean(axis=0)],
        "drift": round(drift, 5) if stood[0] else None,
        "pushes": round(float(stood[count:].mean()), 4),
    }


# ---- figures of a walk ----------------------------------------------------------------------------------------------


AT_LIMIT = 0.02  # [share of a joint's range] a smaller distance to the end counts as at the limit
DOWN = 0.02  # [body weights] a foot with less force is in the air [ours: 0.3 kg of a Go2]
SHORT = 0.04  # [s] a shorter time in the air is contact chatter
TOUCHDOWN = 0.06  # [s] time after a touchdown in which the impact force is measured
FAST = 10.0  # [Hz] a motor cannot follow faster targets; they are noise and heat


class Walk(NamedTuple):
    """The record of a robot that walks straight ahead, sampled at each physics step, without the settling time."""

    dt: float  # [s] physics step
    period: float  # [s] control step
    weight: float  # [N]
    tilt: Array  # (T, 2) [rad] roll and pitch of the trunk
    sideways: Array  # (T, F) [m] position of each foot, to the left of the root
    height: Array  # (T, F) [m] height of each foot's lowest point above the ground
    sole: Array | None  # (T, F) [rad] tilt of each sole; None: point feet
    force: Array  # (T, F) [N] on each foot
    angle: Array  # (T, D) [rad]
    target: Array  # (P, D) [rad] the policy's targets before clipping
    torque: Array  # (T, D) [N m]
    speed: Array  # (T, D) [rad/s]
    low: Array  # (D,) [rad] ends of the joints' ranges; infinite without a range
    high: Array  # (D,) [rad]
    limit: Array  # (D,) [N m] torque limits; infinite if unknown
    joints: Sequence[str]
    clock: float | None  # [1/s] stride frequency of the policy's gait clock
    of_angles: bool = True  # as of Action: the targets are angles, not torques or speeds, which have no range here


def looks(walk: Walk) -> dict[str, Any]:
    """All figures of the walk: angles [deg], lengths [m], forces [body weights]."""
    down = on_ground(walk.force / walk.weight, walk.dt)
    every = round(walk.period / walk.dt)
    left = walk.sideways.mean(axis=0) > 0.0
    duty = down.mean(axis=0)
    tilt = np.degrees(walk.tilt)
    hit, swing = hits(walk.force / walk.weight, down, walk.dt), clearances(walk.height, down)
    angle, target = (_worst(at_limit(values, walk), walk.joints) for values in (walk.angle, walk.target))
    rms = np.sqrt((walk.torque**2).mean(axis=0, dtype=float))
    soles = np.degrees(walk.sole) if walk.sole is not None else None
    return {
        "roll": _sway(tilt[:, 0]),
        "pitch": _sway(tilt[:, 1]),
        "feet_apart": _number(walk.sideways[:, left].mean() - walk.sideways[:, ~left].mean()) if _both(left) else None,
        "sole_tilt": _worst_mean(soles, down),
        "strides": _number(stride_frequency(down[::every], walk.period)),
        "clock": walk.clock,
        "clearance": _number(np.mean(swing)) if swing else None,
        "duty": [_number(share) for share in duty],
        "duty_left_right": _number(duty[left].mean() - duty[~left].mean()) if _both(left) else None,
        "all_down": _number(down.all(axis=1).mean()),
        "none_down": _number(1.0 - down.any(axis=1).mean()),
        "angle_at_limit": angle,
        "target_at_limit": target if walk.of_angles else {"worst": 0.0, "joint": ""},
        "hit": {"mean": _number(np.mean(hit)), "most": _number(max(hit))} if hit else None,
        "torque_over_limit": _worst(rms / walk.limit, walk.joints) if np.isfinite(walk.limit).any() else None,
        "torque_by_joint": dict(zip(walk.joints, [_number(each) for each in rms / walk.limit], strict=True)),
        "target_step": _number(np.abs(np.diff(walk.target, axis=0)).mean()) if walk.of_angles else None,
        "fast_share": fast_share(walk.target, walk.period),
        "peak_power": _number(np.abs(walk.torque * walk.speed).sum(axis=1).max()),
    }


def on_ground(force: Array, dt: float) -> NDArray[np.bool_]:
    """(T, F) true for a foot on the ground; ``force`` (T, F) [body weights]. Contact chatter is removed."""
    down = force > DOWN
    for foot in range(down.shape[1]):
        for start, end in spans(~down[:, foot]):
            if start > 0 and end < len(down) and (end - start) * dt < SHORT - 1e-9:
                down[start:end, foot] = True
    return down


def spans(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """The first index and the index after the last of each run of true values in ``mask`` (T,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def hits(force: Array, down: NDArray[np.bool_], dt: float) -> list[float]:
    """The largest force within TOUCHDOWN after each touchdown of each foot. Touchdowns near the end are left out."""
    length, forces = round(TOUCHDOWN / dt), []
    for foot in range(force.shape[1]):
        starts = [start for start, _ in spans(down[:, foot]) if 0 < start <= len(force) - length]
        forces += [float(force[start : start + length, foot].max()) for start in starts]
    return forces


def clearances(height: Array, down: NDArray[np.bool_]) -> list[float]:
    """The largest height [m] of each foot in each complete swing, above its mean height in stance."""
    heights = []
    for foot in range(height.shape[1]):
        if not down[:, foot].any():
            continue
        ground = float(height[down[:, foot], foot].mean())
        swings = [(start, end) for start, end in spans(~down[:, foot]) if start > 0 and end < len(height)]
        heights += [float(height[start:end, foot].max()) - ground for start, end in swings]
    return heights


def at_limit(values: Array, walk: Walk) -> Array:
    """(D,) share of time in which ``values`` (T, D) are within AT_LIMIT of an end of the range, or beyond it."""
    known = np.isfinite(walk.low) & np.isfinite(walk.high)
    margin = np.where(known, AT_LIMIT * (np.where(known, walk.high, 0.0) - np.where(known, walk.low, 0.0)), 0.0)
    return ((values <= walk.low + margin) | (values >= walk.high - margin)).mean(axis=0)


def fast_share(target: Array, period: float) -> float | None:
    """Share of the spectral power of ``target`` (P, D) above FAST, without the mean, with a Hann window.

    None if the target is constant.
    """
    moving = (target - target.mean(axis=0)) * np.hanning(len(target))[:, None]
    power = np.abs(np.fft.rfft(moving, axis=0)) ** 2
    above = np.fft.rfftfreq(len(target), period) > FAST
    total = power.sum()
    return _number(power[above].sum() / total) if total > 1e-12 else None


def _sway(angle: Array) -> dict[str, float | None]:
    """The mean, and half of the difference between the largest and the smallest value."""
    return {"mean": _number(angle.mean()), "amplitude": _number((angle.max() - angle.min()) / 2)}


def _worst(share: Array, joints: Sequence[str]) -> dict[str, Any]:
    worst = int(np.argmax(share))
    return {"worst": _number(share[worst]), "joint": joints[worst] if share[worst] > 0.0 else ""}


def _worst_mean(angle: Array | None, down: NDArray[np.bool_]) -> float | None:
    """The largest of the feet's mean angles in stance; None without soles or stance."""
    if angle is None or not down.any():
        return None
    return _number(max(angle[down[:, foot], foot].mean() for foot in range(angle.shape[1]) if down[:, foot].any()))


def _both(left: NDArray[np.bool_]) -> bool:
    return bool(left.any() and not left.all())


def _number(value: Any) -> float | None:
    return round(float(value), 5) if math.isfinite(value) else None


# ---- published policies with the same measurements -----------------------------------------------------------------


BETTER = ("target_step", "fast_share", "hit", "hardest_hit", "torque_over_limit")  # figures for which less is better


def beside(rules: ExamRules) -> dict[str, Any]:
    """The names of this robot's published policies with a hard exam, and their best value of each figure.

    ``errors`` needs equal command ranges; ``pushes`` and ``looks`` need an equal speed. Empty without such policies.
    """
    measured = {peer.name: peer.hard for peer in PEERS.get(rules.peer, []) if peer.hard}
    common = COMMON.get(rules.peer)
    if not measured or not common or common[0][1] != rules.ranges[0][1]:
        return {}
    every = list(measured.values())
    conditions = [each.name for each in CONDITIONS]
    errors = {name: [each["errors"][name] for each in every if name in each["errors"]] for name in conditions}
    pushes = {name: [each["pushes"][name] for each in every if name in each["pushes"]] for name in conditions}
    alike = common == rules.ranges
    return {
        "policies": list(measured),
        "errors": {name: [min(axis) for axis in zip(*values, strict=True)] for name, values in errors.items() if alike},
        "pushes": {name: max(values) for name, values in pushes.items() if values},
        "looks": {name: min(each["looks"][name] for each in every) for name in BETTER},
    }


# ---- marks ----------------------------------------------------------------------------------------------------------


# PUSHES: smallest share; LIMITS, TORQUE: largest share; TRUNK, SOLES: largest tilt [deg]
PUSHES, LIMITS, TORQUE, TRUNK, SOLES = 0.9, 0.01, 0.4, 5.0, 3.0


def trunk(walk: Mapping[str, Any]) -> float:
    """[deg] largest tilt of the trunk: |mean| + amplitude, the larger of roll and pitch."""
    return max(abs(walk[axis]["mean"]) + walk[axis]["amplitude"] for axis in ("roll", "pitch"))


def finish(
    rules: ExamRules,
    walks: bool,
    conditions: Mapping[str, Any],
    found: Mapping[str, Any] | None,
    feet: int,
    load: float,
) -> dict[str, Any]:
    """The result of the hard exam. ``found``: the return value of ``looks``; None if the robot fell in that walk."""
    result: dict[str, Any] = {
        "ready": False,
        "misses": [],
        "walks": walks,
        "conditions": dict(conditions),
        "looks": dict(found) if found else None,
        "commands": [list(command) for command in commands(rules)],
        "vx": half_speed(rules),
        "push_speed": push_speed(feet),
        "load": load,
    }
    if published := beside(rules):
        result["peers"] = published
    result["misses"] = misses(result)
    return {**result, "ready": not result["misses"]}


def misses(result: Mapping[str, Any]) -> list[str]:
    """The missed marks in words; empty if the policy is ready for a robot."""
    conditions, walk = result["conditions"], result["looks"]
    texts = [] if result["walks"] else ["does not walk by the walking exam"]
    fallen = ["nominal conditions" if name == "none" else name for name, each in conditions.items() if each["falls"]]
    texts += [f"falls under {', '.join(fallen)}"] if fallen else []
    survived = conditions[ALL]["pushes"]
    texts += [f"survives {survived:.0%} of the pushes under all, not {PUSHES:.0%}"] if survived < PUSHES else []
    if not walk:
        return [*texts, "falls in the gait measurement"]
    for name in ("angle", "target"):
        share, joint = walk[f"{name}_at_limit"]["worst"], walk[f"{name}_at_limit"]["joint"]
        texts += [f"{name} of {joint} at its limit {share:.0%} of the time"] if share > LIMITS else []
    load = walk["torque_over_limit"]
    if load and load["worst"] > TORQUE:
        texts.append(f"torque of {load['joint']} is {load['worst']:.2f} of its limit (RMS), not {TORQUE}")
    texts += [f"trunk tilts by {trunk(walk):.1f} degrees, not {TRUNK:g}"] if trunk(walk) > TRUNK else []
    tilt = walk["sole_tilt"]
    return texts + ([f"soles tilt by {tilt:.1f} degrees, not {SOLES:g}"] if tilt is not None and tilt > SOLES else [])


def figures(result: Mapping[str, Any]) -> list[Figure]:
    """The figures of the walk with their marks, as table rows."""
    walk = result["looks"]
    if not walk:
        return []
    hit, torque = (walk[key] or {} for key in ("hit", "torque_over_limit"))
    best = result.get("peers", {}).get("looks", {})
    rows = [
        Figure("trunk's largest tilt [deg]", trunk(walk), 1, TRUNK),
        Figure("  roll, mean", walk["roll"]["mean"], 1),
        Figure("  roll, amplitude", walk["roll"]["amplitude"], 1),
        Figure("  pitch, mean", walk["pitch"]["mean"], 1),
        Figure("  pitch, amplitude", walk["pitch"]["amplitude"], 1),
        Figure("feet apart sideways [m]", walk["feet_apart"], 3),
    ]
    if walk["sole_tilt"] is not None:
        rows.append(Figure("soles' tilt at stance [deg]", walk["sole_tilt"], 1, SOLES))
    rows.append(Figure("strides of a foot [1/s]", walk["strides"], 2))
    if walk["clock"] is not None:
        rows.append(Figure("  its gait clock", walk["clock"], 2))
    return [
        *rows,
        Figure("swing clearance [m]", walk["clearance"], 3, without="none"),
        Figure("duty, left minus right", walk["duty_left_right"], 3, without="none"),
        Figure("share of all feet down", walk["all_down"], 2),
        Figure("share of no foot down", walk["none_down"], 2),
        Figure("angle at a limit, worst joint", walk["angle_at_limit"]["worst"], 3, LIMITS),
        Figure("target at a limit, worst joint", walk["target_at_limit"]["worst"], 3, LIMITS),
        Figure("hit at touchdown [weights]", hit.get("mean"), 2, None, best.get("hit"), without="none"),
        Figure("  the hardest", hit.get("most"), 2, None, best.get("hardest_hit"), without="none"),
        Figure(
            "torque RMS / limit, worst joint",
            torque.get("worst"),
            2,
            TORQUE,
            best.get("torque_over_limit"),
            without="none",
        ),
        Figure("target's mean step [rad]", walk["target_step"], 3, None, best.get("target_step"), without="none"),
        Figure("target's power above 10 Hz", walk["fast_share"], 3, None, best.get("fast_share"), without="none"),
        Figure("peak power [W]", walk["peak_power"], 0),
    ]


def peer_label(result: Mapping[str, Any]) -> str:
    """The heading of the published policies' figures; empty without such policies."""
    count = len(result.get("peers", {}).get("policies", ()))
    return f"best of {count}" if count else ""


def condition_rows(result: Mapping[str, Any]) -> list[list[str]]:
    """A heading, and a row per condition: name, falls, errors, drift, pushes, best errors and pushes of peers."""
    names = ", ".join(name.removesuffix(" rate") for name, _ in AXES)
    rows = [["", "falls", f"error {names}", "drift [m]", f"pushes of {result['push_speed']:g} m/s"]]
    published = result.get("peers")
    rows[0] += [f"error, {peer_label(result)}", f"pushes, {peer_label(result)}"] if published else []
    for name, each in result["conditions"].items():
        drift = "fell" if each["drift"] is None else f"{each['drift']:.3f}"
        title = f"{name} of {result['load']:g} kg" if name == "load" else name
        rows.append([title, str(each["falls"]), _errors(each["error"], 3), drift, f"{each['pushes']:.2f}"])
        if published:
            share = published["pushes"].get(name)
            rows[-1] += [_errors(published["errors"].get(name, ()), 2), "" if share is None else f"{share:.2f}"]
    return rows


def _errors(errors: Sequence[float], digits: int) -> str:
    return ", ".join(f"{value:.{digits}f}" for value in errors)


def table(result: Mapping[str, Any]) -> str:
    """The result as text."""
    lines = [f"hard exam: {len(result['commands'])} commands and {PUSH_DIRECTIONS} pushes under each condition"]
    rows, label = condition_rows(result), peer_label(result)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for name, *cells in rows:
        padded = [f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=True)]
        lines.append("   ".join([f"{name:<{widths[0]}}", *padded]).rstrip())
    at = f"walking at {result['vx']:g} m/s"
    lines += ["", f"{at:<34}{'this policy':>12}{'ready at':>10}{label:>12}".rstrip()]
    for row in figures(result):
        lines.append(f"{row.name:<34}{row.text(row.value):>12}{row.mark_text():>10}{row.peer_text():>12}".rstrip())
    ready = "yes" if result["ready"] else f"no: {'; '.join(result['misses'])}"
    return "\n".join([*lines, f"ready for a robot: {ready}"])
