"""Draw the report's figures with matplotlib, each panel as an inline SVG. This module computes no figures.

Every panel is a function of an Axes. The colours become CSS variables, which the page sets for light and dark mode.
The palette of Okabe and Ito is safe for colour-blind readers.
"""

from __future__ import annotations

import io
import math
import re
from collections.abc import Callable
from functools import partial
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps, rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from legged_mw.eval.walking import AXES, ExamRules, best_of

Figures = dict[str, Any]
Columns = list[tuple[str, Figures]]  # (name, figures) of one or two policies

INK, MUTED, FAINT, PAPER = "#1b1f27", "#68707d", "#e3e6eb", "#fdfdfe"
PAIR, GREEN = ("#0072b2", "#d55e00"), "#009e73"
VARIABLES = {
    INK: "ink",
    MUTED: "muted",
    FAINT: "faint",
    PAPER: "paper",
    PAIR[0]: "first",
    PAIR[1]: "second",
    GREEN: "peer",
}
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 7.5,
    "svg.fonttype": "none",
    "text.color": INK,
    "axes.labelcolor": MUTED,
    "axes.edgecolor": FAINT,
    "axes.linewidth": 0.8,
    "axes.titlesize": 8.0,
    "axes.titlelocation": "left",
    "axes.titlepad": 7.0,
    "axes.labelpad": 2.0,
    "axes.titlecolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": FAINT,
    "grid.linewidth": 0.6,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.major.size": 0.0,
    "ytick.major.size": 0.0,
    "xtick.major.pad": 4.0,
    "ytick.major.pad": 4.0,
    "legend.frameon": False,
    "legend.fontsize": 7.0,
    "lines.linewidth": 1.4,
    "figure.facecolor": "none",
    "axes.facecolor": "none",
    "savefig.facecolor": "none",
}
HEAT = "viridis"  # perceptually uniform
GAITS = (1, 2, 3, 5, 7, 11)  # indices of the drawn commands: three speeds ahead, one back, one left, one turn left


class PlotPanel(NamedTuple):
    """One plot: a title and a function that draws on an Axes."""

    draw: Callable[[Any], None]
    width: float = 3.5  # [inch]
    height: float = 2.5
    polar: bool = False


class Section(NamedTuple):
    """A group of panels: one section of the page."""

    name: str
    title: str
    panels: list[PlotPanel]
    across: int = 3  # panels per row


def sections(columns: Columns, rules: ExamRules) -> list[Section]:
    """All sections for one or two policies. ``rules`` of the first give the pass marks and the peer."""
    pushes = [PlotPanel(partial(_push_curve, columns, rules), height=2.9)]
    for which in ("walking", "standing"):
        for i, (name, figures) in enumerate(columns):
            title = f"{which}{_of(name, columns)}"
            pushes.append(
                PlotPanel(partial(_push_wheel, figures["pushes"], which, PAIR[i], title), height=2.9, polar=True)
            )
    responses = [PlotPanel(partial(_response, columns, i)) for i in range(3)]
    strides = [PlotPanel(partial(_gait, columns, i), height=1.75 + 0.25 * len(columns)) for i in GAITS]
    energy = [PlotPanel(partial(_against_speed, columns, rules, key)) for key in ("power", "cost_of_transport")]
    terms = len(columns[0][1]["reward"])
    rough, believed = _crossing_maps(columns), _estimates(columns)
    return [
        *([Section("crossing", "Rough ground", rough, across=len(rough))] if rough else []),
        Section("tracking", "Following the command", _heat_maps(columns, rules)),
        Section("steps", "Steps of the command", responses),
        *([Section("estimate", "What it believes of its velocity", believed, across=1)] if believed else []),
        Section("gait", "Gait", strides),
        Section("joints", "Joints against their limits", _joint_panels(columns)),
        *([Section("motors", "Torque against speed", motors)] if (motors := _motor_panels(columns)) else []),
        Section("pushes", "Pushes", pushes),
        Section("energy", "Energy", energy, across=2),
        Section(
            "reward", "Reward", [PlotPanel(partial(_reward, columns), width=7.2, height=0.9 + 0.21 * terms)], across=1
        ),
    ]


def svgs(section: Section) -> list[str]:
    """The section's panels as inline SVG, without ids and links, with colours as CSS variables."""
    drawn = []
    for i, panel in enumerate(section.panels):
        with rc_context({**STYLE, "svg.hashsalt": f"{section.name}{i}"}):
            figure = Figure((panel.width, panel.height), layout="constrained")
            panel.draw(figure.add_subplot(projection="polar" if panel.polar else None))
            buffer = io.StringIO()
            FigureCanvasSVG(figure).print_svg(buffer, metadata={"Date": None})
            drawn.append(_inline(buffer.getvalue()))
    return drawn


def _inline(svg: str) -> str:
    """Turn the content of an SVG file into inline SVG."""
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r'(<(?:g|svg)\b[^>]*?) id="[^"]*"', r"\1", svg)
    svg = re.sub(r'\s+xmlns(:\w+)?="[^"]*"', "", svg)
    svg = re.sub(r'<svg\b[^>]*?viewBox="([^"]*)"[^>]*>', r'<svg viewBox="\1" role="img">', svg, count=1)
    svg = re.sub(r"'DejaVu Sans'(, [^;\"]*)?", "var(--font)", svg)
    for colour, name in VARIABLES.items():
        svg = svg.replace(colour, f"var(--{name})")
    return re.sub(r"(\.\d\d)\d+", r"\1", svg)  # round coordinates to a hundredth of a point


def _of(name: str, columns: Columns) -> str:
    """The policy's name for a title; empty if there is only one policy."""
    return f", {name}" if len(columns) > 1 else ""


def _array(values: Any) -> np.ndarray:
    """Convert nested lists to an array, None to NaN."""
    return np.array(values, dtype=float)


# ---- rough ground


def _crossing_maps(columns: Columns) -> list[PlotPanel]:
    """One map per policy that was graded on rough terrain."""
    graded = [(_of(name, columns), figures["crossing"]) for name, figures in columns if "crossing" in figures]
    kinds = max((len(result["kinds"]) for _, result in graded), default=0)
    width, height = 6.2 if len(graded) == 1 else 5.2, 0.75 + 0.43 * kinds
    return [PlotPanel(partial(_crossing, result["kinds"], suffix), width, height) for suffix, result in graded]


def _crossing(kinds: dict[str, Figures], suffix: str, ax: Axes) -> None:
    """Plot one row per kind of terrain and one cell per level, with the shares that crossed and that fell.

    The text below a cell is the terrain's size at this level, such as the height of a step.
    """
    for row, kind in enumerate(kinds.values()):
        shares = _array([kind["crossed"], kind["fell"]])
        levels = shares.shape[1]
        means = (levels + 0.3, *shares.mean(axis=1))
        for x, crossed, fell in [*zip(range(levels), *shares, strict=True), means]:
            ax.bar(x, 0.66, 0.94, row, color=colormaps[HEAT](1.0 - crossed), linewidth=0)
            ink: dict[str, Any] = {"color": "#ffffff" if crossed > 0.45 else "#101318", "ha": "center", "va": "center"}
            ax.text(x, row + (0.24 if fell else 0.33), _percent(crossed), fontsize=7.5, **ink)
            if fell:
                ax.text(x, row + 0.5, f"{_percent(fell)} fell", fontsize=5.7, **ink)
        for x, value in enumerate(kind["values"] or []):
            ax.text(x, row + 0.8, f"{value:.3g}", fontsize=6.2, color=MUTED, ha="center", va="center")
    ax.set_yticks(np.arange(len(kinds)) + 0.33, [kind.replace("_", " ") for kind in kinds])
    ax.set_yticks(np.arange(len(kinds)) + 0.8, [kind["measure"] or "" for kind in kinds.values()], minor=True)
    ax.tick_params(axis="y", which="minor", length=0.0, labelsize=6.2, labelcolor=MUTED)
    ax.tick_params(axis="y", labelcolor=INK)
    ax.set_xticks([*range(levels), levels + 0.3], [*map(str, range(levels)), "mean"])
    ax.set(xlabel="level", xlim=(-0.5, levels + 0.8), ylim=(len(kinds) - 0.05, 0.0))
    ax.grid(False)
    ax.spines[["left", "bottom"]].set_visible(False)
    crossed, fell = (float(np.mean([kind[which] for kind in kinds.values()])) for which in ("crossed", "fell"))
    ax.set_title(f"share that crossed [%]{suffix}")
    ax.set_title(f"all: {_percent(crossed)}, {_percent(fell)} fell", loc="right", color=MUTED, fontsize=7.0)


def _percent(share: float) -> str:
    """Whole percent. Only a share of 1 gives 100, and only a share of 0 gives 0."""
    return "<1" if 0.0 < share < 0.01 else f"{min(round(100 * share), 99) if share < 1.0 else 100}"


# ---- velocity tracking


def _heat_maps(columns: Columns, rules: ExamRules) -> list[PlotPanel]:
    """Heat maps of three errors over two grids. A scale ends at the largest error, but at most at three times its mark.

    If the marks apply to offsets, the errors have no mark: the scale has no line and can be longer.
    """
    panels, strict = [], rules.marks_of == "error"
    marks = rules.marks if strict else [3 * mark for mark in rules.marks]
    for grid, across in (("vx_yaw", "yaw"), ("vx_vy", "vy")):
        for name, figures in columns:
            for k, mark in enumerate(marks):
                every = np.concatenate(
                    [_array(f["tracking"][g][k]).ravel() for _, f in columns for g in ("vx_yaw", "vx_vy")]
                )
                top = max(1.25 * mark, min(3 * mark, float(np.nanmax(every)) if np.isfinite(every).any() else mark))
                stroke = mark if strict else None
                panels.append(
                    PlotPanel(
                        partial(_heat, figures["tracking"], grid, across, k, stroke, top, _of(name, columns)),
                        height=2.45,
                    )
                )
    return panels


def _heat(
    tracking: Figures, grid: str, down: str, k: int, mark: float | None, top: float, suffix: str, ax: Axes
) -> None:
    x, y, values = _array(tracking["axes"]["vx"]), _array(tracking["axes"][down]), _array(tracking[grid][k])
    scale = Normalize(0.0, top)
    ax.pcolormesh(_edges(x), _edges(y), values, cmap=HEAT, norm=scale, edgecolors=PAPER, linewidth=0.8)
    for row, column in np.argwhere(~np.isfinite(values)):
        ax.plot(x[column], y[row], marker="x", color=PAIR[1], markersize=4.5, markeredgewidth=1.2)
    ax.grid(False)
    ax.spines[["left", "bottom"]].set_visible(False)
    for axis, centres in ((ax.xaxis, x), (ax.yaxis, y)):
        ticks = centres[:: max(1, len(centres) // 4)]
        axis.set_ticks(ticks, [f"{tick:g}" for tick in ticks])
    name, unit = AXES[k]
    beside = "yaw rate [rad/s]" if down == "yaw" else "vy [m/s]"
    ax.set(title=f"error of {name} [{unit}]{suffix}", xlabel="commanded vx [m/s]", ylabel=beside)
    shape: dict[str, Any] = {
        "aspect": 18,
        "pad": 0.03,
        "extend": "max" if (values > top).any() else "neither",
        "format": "%.2f",
    }
    ticks = [0.0, *([mark] if mark else []), *([top] if not mark or top > 1.4 * mark else [])]
    bar = ax.figure.colorbar(
        ScalarMappable(scale, HEAT), ax=ax, boundaries=np.linspace(0.0, top, 33), ticks=ticks, **shape
    )
    bar.solids.set_edgecolor("face")  # type: ignore[union-attr]
    bar.outline.set_visible(False)  # type: ignore[operator]
    if mark:
        bar.ax.axhline(mark, color=PAPER, linewidth=1.2)
    bar.ax.grid(False)


def _edges(centres: np.ndarray) -> np.ndarray:
    """The edges of cells from their centres."""
    half = np.diff(centres) / 2 if len(centres) > 1 else np.array([0.5])
    return np.concatenate([[centres[0] - half[0]], centres[:-1] + half[: len(centres) - 1], [centres[-1] + half[-1]]])


def _response(columns: Columns, k: int, ax: Axes) -> None:
    name, unit = AXES[k]
    for i, (label, figures) in enumerate(columns):
        step = figures["steps"][("vx", "vy", "yaw")[k]]
        time, low, high = (_array(step[key]) for key in ("time", "low", "high"))
        ax.fill_between(time, low, high, color=PAIR[i], alpha=0.18, linewidth=0)
        ax.plot(time, _array(step["mean"]), color=PAIR[i], label=label if len(columns) > 1 else "measured")
        if i == 0:
            ax.step(
                time,
                _array(step["commanded"]),
                where="post",
                color=INK,
                linestyle=(0, (4, 2)),
                linewidth=1.0,
                label="commanded",
            )
    ax.set(title=f"{name} [{unit}]", xlabel="time [s]")
    if any(fell := [figures["steps"][("vx", "vy", "yaw")[k]]["fell"] for _, figures in columns]):
        ax.set_title(f"{' / '.join(map(str, fell))} fell", loc="right", color=MUTED, fontsize=7.0)
    ax.margins(x=0)
    if k == 0:
        ax.legend(loc="lower right", handlelength=1.6)


def _estimates(columns: Columns) -> list[PlotPanel]:
    """One panel per axis for each policy with a velocity estimator."""
    panels = []
    for i, (name, figures) in enumerate(columns):
        for k in range(2 if "estimate" in figures else 0):
            draw = partial(_estimate, figures["estimate"], k, PAIR[i], _of(name, columns))
            panels.append(PlotPanel(draw, width=7.2, height=2.1))
    return panels


def _estimate(estimate: Figures, k: int, colour: str, suffix: str, ax: Axes) -> None:
    """Plot axis ``k`` of ``figures.estimates``, one command after the other."""
    commands, seconds = estimate["commands"], estimate["seconds"]
    for key, tone, label in (("truth", INK, "true"), ("estimate", colour, "estimated")):
        values = np.array(estimate[key][k], dtype=float).reshape(len(commands), -1)
        time = np.linspace(0.0, seconds, values.shape[1]) + seconds * np.arange(len(commands))[:, None]
        apart = ((0, 0), (0, 1))  # NaN: no line from one command to the next
        lines = (np.pad(rows, apart, constant_values=np.nan).ravel() for rows in (time, values))
        ax.plot(*lines, color=tone, linewidth=1.0, label=label)
    for i in range(1, len(commands)):
        ax.axvline(i * seconds, color=FAINT, linewidth=0.8)
    places = (np.arange(len(commands)) + 0.5) * seconds
    ax.set_xticks(
        places, [", ".join(f"{value:.2g}" for value in command) for command in commands], rotation=90, fontsize=5.5
    )
    name, unit = AXES[k]
    ax.set(title=f"{name} [{unit}]{suffix}", xlabel="command: vx, vy, yaw rate", xlim=(0.0, seconds * len(commands)))
    ax.grid(False, axis="x")
    ax.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.0, ncols=2, handlelength=1.6)


# ---- gait


def _gait(columns: Columns, world: int, ax: Axes) -> None:
    """Plot a bar for each stance of a foot. Two policies share the row of each foot."""
    feet, count = columns[0][1]["foot_names"], len(columns)
    rows, height = [figures["gait"][world] for _, figures in columns], 0.62 / count
    for i, row in enumerate(rows):
        for foot, down in enumerate(row["contact"] or []):
            # start and end of each stance
            edges = np.flatnonzero(np.diff([0, *down, 0])).reshape(-1, 2) * columns[i][1]["dt"]
            bars = [(begin, end - begin) for begin, end in edges]
            ax.broken_barh(bars, (foot - 0.31 + i * height, height * 0.94), facecolors=PAIR[i], linewidth=0)
    command = zip(AXES, rows[0]["command"], strict=True)
    ax.set_title(", ".join(f"{name} {value:g} {unit}" for (name, unit), value in command if value) or "stand")
    ax.set_title("\n".join(map(_stride, rows)), loc="right", color=MUTED, fontsize=7.0)
    ax.set_yticks(range(len(feet)), feet)
    ax.set(xlim=(0.0, None), ylim=(len(feet) - 0.5, -0.5), xlabel="time [s]")
    ax.grid(False, axis="y")
    ax.spines["left"].set_visible(False)


def _stride(gait: Figures) -> str:
    """Stride frequency and mean duty factor of one command."""
    if gait["contact"] is None:
        return "fell"
    return f"{gait['stride_frequency']:.1f} Hz, duty {np.mean(gait['duty_factor']):.2f}"


# ---- joints


def _joint_panels(columns: Columns) -> list[PlotPanel]:
    height = 0.9 + 0.29 * len(columns[0][1]["joint_names"])
    quantities = (("dof_pos", "position [rad]"), ("dof_vel", "velocity [rad/s]"), ("torque", "torque [N m]"))
    return [PlotPanel(partial(_joints, columns, key, label), height=height) for key, label in quantities]


def _joints(columns: Columns, key: str, label: str, ax: Axes) -> None:
    """Plot one histogram per joint, all of equal height. Vertical lines are limits. The text is the saturated share."""
    names = [name.removesuffix("_joint") for name in columns[0][1]["joint_names"]]
    for i, (_, figures) in enumerate(columns):
        histograms = figures["joints"][key]
        for joint, (edges, density) in enumerate(zip(histograms["edges"], histograms["density"], strict=True)):
            curve = joint - 0.78 * np.array([*density, density[-1]]) / (max(density) or 1.0)
            if i == 0:
                ax.fill_between(edges, joint, curve, step="post", color=PAIR[i], alpha=0.55, linewidth=0)
            else:
                ax.step(edges, curve, where="post", color=PAIR[i], linewidth=1.0)
            for end in (histograms["low"][joint], histograms["high"][joint]):
                if end is not None and i == 0:
                    ax.plot([end, end], [joint, joint - 0.72], color=INK, linewidth=1.2)
            if share := histograms["saturated"][joint]:
                text = f"{share:.1%}" if share >= 0.001 else "<0.1%"
                ax.annotate(
                    text, (1.01, joint - 0.1 - 0.4 * i), xycoords=("axes fraction", "data"), color=PAIR[i], fontsize=6.2
                )
    ax.set_yticks(range(len(names)), names)
    ax.set(title=label, ylim=(len(names) - 0.6, -1.05))
    ax.spines["left"].set_visible(False)
    ax.margins(x=0.04)


def _motor_panels(columns: Columns) -> list[PlotPanel]:
    """One panel per kind of joint and policy. Older reports do not have these figures."""
    rows = zip_longest(
        *([(_of(name, columns), motor) for motor in figures.get("motors", [])] for name, figures in columns)
    )
    return [PlotPanel(partial(_motor, motor, suffix)) for row in rows for suffix, motor in filter(None, row)]


def _motor(motor: Figures, suffix: str, ax: Axes) -> None:
    """Plot the torque against the speed of one kind of joint."""
    counts, speeds, torques = (np.array(motor[key], dtype=float) for key in ("counts", "speeds", "torques"))
    # only cells with samples; a full mesh would make the page too large
    rows, columns = np.nonzero(counts)
    density = np.log1p(counts[rows, columns]) / np.log1p(counts.max(initial=1.0))
    ax.bar(
        speeds[columns],
        np.diff(torques)[0],
        np.diff(speeds)[0],
        torques[rows],
        align="edge",
        color=colormaps[HEAT](1.0 - density),
        linewidth=0,
    )
    if motor["envelope"]:
        for side in ("low", "high"):
            ax.plot(motor["envelope"]["speed"], motor["envelope"][side], color=INK, linewidth=1.2)
    share = motor["at_limit"]
    ax.set(title=f"{motor['kind'].replace('_', ' ')}{suffix}", xlabel="speed [rad/s]", ylabel="torque [N m]")
    ax.set_title(
        "no limit known" if share is None else f"{share:.1%} at the limit", loc="right", color=MUTED, fontsize=7.0
    )


# ---- pushes


def _push_curve(columns: Columns, rules: ExamRules, ax: Axes) -> None:
    speeds = rules.push_speeds
    if rules.peers:
        shares = list(best_of(rules.peers)["pushes"].values())
        ax.plot(
            speeds, shares, color=GREEN, marker="D", markersize=3.2, linewidth=1.0, label=f"{rules.peer_label}, walking"
        )
    for i, (name, figures) in enumerate(columns):
        for which, line in (("walking", "-"), ("standing", (0, (2, 1.5)))):
            share, label = np.mean(figures["pushes"][which], axis=1), f"{which}{_of(name, columns)}"
            ax.plot(speeds, share, color=PAIR[i], linestyle=line, marker="o", markersize=3.2, label=label)
    ax.set(title="share of 16 directions survived", xlabel="jump of the velocity [m/s]", ylim=(-0.03, 1.04))
    ax.legend(loc="best", handlelength=2.2)


def _push_wheel(pushes: Figures, which: str, colour: str, title: str, ax: Any) -> None:
    """Plot one tile per push, coloured if survived. Rings are speeds. Sectors are directions in the base frame."""
    survived = np.array(pushes[which])
    width = 2 * math.pi / survived.shape[1]
    rings, sectors = np.indices(survived.shape).reshape(2, -1)
    ax.bar(sectors * width, 0.9, width * 0.95, rings + 1, color=np.where(survived, colour, FAINT).ravel(), linewidth=0)
    ax.set_theta_zero_location("N")
    ax.set_xticks(np.arange(4) * math.pi / 2, ["ahead", "left", "behind", "right"])
    ax.set(title=title, yticks=[], ylim=(0, len(survived) + 1))
    ax.grid(False)
    ax.spines["polar"].set_visible(False)


# ---- energy, reward


def _against_speed(columns: Columns, rules: ExamRules, key: str, ax: Axes) -> None:
    for i, (name, figures) in enumerate(columns):
        ax.plot(
            figures["transport"]["vx"],
            _array(figures["transport"][key]),
            color=PAIR[i],
            marker="o",
            markersize=3.2,
            label=name,
        )
    if key == "cost_of_transport" and rules.peers:
        cost = best_of(rules.peers)[key]
        ax.plot(
            [rules.transport_vx],
            [cost],
            color=GREEN,
            marker="D",
            markersize=4.5,
            linestyle="none",
            label=rules.peer_label,
        )
    ax.set(
        title="mean power [W]" if key == "power" else "cost of transport [-]",
        xlabel="commanded vx [m/s]",
        ylim=(0.0, None),
    )
    if key == "cost_of_transport" or len(columns) > 1:
        ax.legend(loc="best", handlelength=1.6)


def _reward(columns: Columns, ax: Axes) -> None:
    """Plot one bar per reward term, the largest at the top."""
    # the terms of both policies
    shares = {term: share or 0.0 for _, figures in reversed(columns) for term, share in figures["reward"].items()}
    terms = sorted(shares, key=lambda term: -abs(shares[term]))
    height = 0.7 / len(columns)
    for i, (name, figures) in enumerate(columns):
        values = [figures["reward"].get(term) or 0.0 for term in terms]
        at = np.arange(len(terms)) - 0.35 + height * (i + 0.5)
        ax.barh(at, values, height * 0.92, color=PAIR[i], label=name)
        for y, value in zip(at, values, strict=True):
            side, align = (3, "left") if value >= 0 else (-3, "right")
            text = {"textcoords": "offset points", "va": "center", "ha": align, "fontsize": 6.2, "color": MUTED}
            ax.annotate(f"{value:.3g}" if abs(value) >= 5e-5 else "0", (value, y), (side, 0), **text)
    ax.set_yticks(range(len(terms)), terms)
    ax.set(title="scale times term, a second", ylim=(len(terms) - 0.4, -0.6))
    ax.axvline(0.0, color=MUTED, linewidth=0.8)
    ax.grid(False, axis="y")
    ax.spines["left"].set_visible(False)
    ax.margins(x=0.09)
    if len(columns) > 1:
        ax.legend(loc="lower right")
