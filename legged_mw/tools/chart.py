"""A line chart as SVG for the inside of a page: numbers in, text out. Its colours are the page's."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

WIDTH, HEIGHT = 340, 210  # of the drawing, in its own units
LEFT, RIGHT, TOP, BOTTOM = 46, 10, 24, 34
POINTS = 120  # of a curve at most: neighbours are averaged

Line = tuple[str, Sequence[float], Sequence[float]]  # colour, x, y


def chart(title: str, over: str, lines: Sequence[Line]) -> str:
    """The lines on common axes; "" if none has a point."""
    thinned = [(colour, thin(list(zip(x, y, strict=True)))) for colour, x, y in lines]
    points = [point for _, line in thinned for point in line]
    if not points:
        return ""
    across = ticks(min(0.0, *(x for x, _ in points)), max(x for x, _ in points), 5)
    up = ticks(min(y for _, y in points), max(y for _, y in points), 4)

    def place(x: float, y: float) -> tuple[float, float]:
        right, above = (x - across[0]) / (across[-1] - across[0]), (y - up[0]) / (up[-1] - up[0])
        return LEFT + right * (WIDTH - LEFT - RIGHT), HEIGHT - BOTTOM - above * (HEIGHT - TOP - BOTTOM)

    parts = [f'<text class="name" x="0" y="13">{escape(title)}</text>']
    for y in up:
        _, at = place(across[0], y)
        parts.append(f'<line x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{at:.1f}" y2="{at:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{at + 4:.1f}" text-anchor="end">{short(y)}</text>')
    for x in across:
        parts.append(
            f'<text x="{place(x, up[0])[0]:.1f}" y="{HEIGHT - BOTTOM + 15}" text-anchor="middle">{short(x)}</text>'
        )
    parts.append(f'<text x="{WIDTH - RIGHT}" y="{HEIGHT - 2}" text-anchor="end">{escape(over)}</text>')
    for colour, line in thinned:
        path = "L".join("{:.1f} {:.1f}".format(*place(*point)) for point in line)
        parts.append(
            f'<path style="stroke:{colour}" d="M{path}"/>'
            if len(line) > 1
            else _dot(colour, place(*line[0]))
            if line
            else ""
        )
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(title)}">{"".join(parts)}</svg>'


def _dot(colour: str, at: tuple[float, float]) -> str:
    return f'<circle cx="{at[0]:.1f}" cy="{at[1]:.1f}" r="3" style="fill:{colour}"/>'


def thin(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """At most ``POINTS`` means of neighbouring points; those that are not finite are left out."""
    points = [point for point in points if all(map(math.isfinite, point))]
    size = math.ceil(len(points) / POINTS) or 1
    groups = [points[i : i + size] for i in range(0, len(points), size)]
    return [(sum(x for x, _ in group) / len(group), sum(y for _, y in group) / len(group)) for group in groups]


def ticks(low: float, high: float, count: int) -> list[float]:
    """Round numbers around ``low`` to ``high``, about so many."""
    if high - low < 1e-12 * max(abs(low), abs(high), 1e-300):
        room = abs(high) / 2 or 1.0
        low, high = low - room, high + room
    raw = (high - low) / count
    scale = 10.0 ** math.floor(math.log10(raw))
    step = next(each * scale for each in (1, 2, 2.5, 5, 10) if each * scale >= raw * 0.999)
    return [i * step for i in range(math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9) + 1)]


def short(value: float) -> str:
    """A number for an axis: 12000 as 12k."""
    for size, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= size * 0.9999 and (size > 1e3 or abs(value) >= 1e4):
            return f"{value / size:g}{letter}"
    return f"{value:.6g}"
