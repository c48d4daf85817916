"""Write the report of an exam: a self-contained HTML page, JSON and pictures."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping, Sequence
from html import escape
from itertools import zip_longest
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, NamedTuple

from legged_mw.eval import hard, heat
from legged_mw.eval.walking import AXES, LEVELS, PUSH_DIRECTIONS, ExamRules, Figure, best_of, verdicts

if TYPE_CHECKING:
    from legged_mw.eval.plots import Section
    from legged_mw.eval.skills import Skill

CSS = Path(__file__).with_name("report.css").read_text(encoding="utf-8")
TEXTS = {
    "hard": "The robot follows {count} commands of 6 s and is pushed in {pushes} directions, under each condition alone, then under all: "
    "10 ms delay, gains x 0.9, load, friction 0.5, noise. The second table measures the gait at {vx:g} m/s.",
    "heat": "One robot in MuJoCo's C engine holds its default pose, then the policy stands, then it walks at half of the highest speed. A "
    "skill runs as in its exam. Unpublished values of the motors and the battery are unknown (docs/heat.md).",
    "crossing": "The command is 0.6 m/s ahead, from the middle of a tile, with a random heading. The first number is the share of ten "
    "robots on two tiles that reached the edge of their tile within 15 s. The number below is the share that fell. The others did not "
    "reach the edge. A row is a kind of ground, with its measure of difficulty for each level. Dark is good.",
    "tracking": "Mean absolute error of the base velocity at the IMU, body frame, over the last 8 of 10 seconds, for commands over the "
    "trained range. Dark is good. {stroke}A cross is a fall.",
    "steps": "The command is two thirds of the trained range, then the same backwards, then zero, then ahead again. The line is the mean "
    "of eight robots, whose gait phases differ at the step. The band is their range. Robots that fell are left out.",
    "estimate": "The velocity estimate of the policy and the true velocity, body frame at the IMU, in the last two seconds of each "
    "command. The exam's table has the root mean square of the difference over the last 8 of 10 seconds.",
    "gait": "A bar is a foot in contact, in the last two seconds of each command. The numbers above are the stride frequency [1/s] and the "
    "duty factor: the share of time in contact, mean over the feet.",
    "joints": "Joint positions, velocities and torques over all commands without a fall. Vertical lines are limits: soft "
    "position limits, the motors' speed limits, the servos' torque limits. The number at the right is the share of samples beyond a limit "
    "(of a torque: at 98 % of the limit or more), if there are any.",
    "motors": "Torque and speed of each kind of joint over all commands without a fall. Darker points are more frequent. The lines are the "
    "motor's envelope: its force limit, and its torque-speed curve if control.actuator has one. The number above is the share of samples "
    "at the envelope, to within 2 % of the highest torque.",
    "pushes": "A push changes the base's horizontal velocity at once. The robot survives it if it does not fall within three seconds. "
    "Rings are push speeds, {speeds} m/s from the inside; sectors are push directions. Coloured tiles were survived. The exam counts "
    "the pushes while walking at {vx:g} m/s.",
    "energy": "Walking ahead and backwards. Power is the sum of |torque x speed| over the joints. Cost of transport is energy / (weight x "
    "distance).",
    "reward": "The reward of each term per second, before the clip at zero, mean over the commands without a fall.",
}
EXAM_NOTE = (
    "22 commands of 10 s and {pushes} pushes, all from rest on flat ground, without noise; {asked}. If the robot falls, the error of this "
    "command is that of a robot that stands still. A policy walks if it passes every row that has a mark. {peer}"
)
STROKE = "The mark on each scale is the largest mean error that the exam allows. "


class Column(NamedTuple):
    """The result of one policy in one physics engine: a column of the tables."""

    name: str
    about: dict[str, Any]  # policy, engine, device, overrides; a warning if the contact buffers overflowed
    exam: dict[str, Any]  # the result of ``ExamRules.grade``
    figures: dict[str, Any] | None = None  # None: only the exam's result, as on another physics engine
    strip: bytes = b""  # PNG of one stride, or empty

    def plain(self) -> dict[str, Any]:
        """All fields except the picture, for JSON."""
        return {name: value for name, value in self._asdict().items() if name != "strip"}


def walking_page(
    task: str, rules: ExamRules, columns: Sequence[Column], drawn: Sequence[tuple[Section, list[str]]]
) -> str:
    """The HTML page of the walking exam. ``rules``: the rules of the first column."""
    words: dict[str, Any] = {
        "speeds": " to ".join(f"{end(rules.push_speeds):g}" for end in (min, max)),
        "vx": rules.push_vx,
    }
    words["stroke"] = STROKE if rules.marks_of == "error" else ""
    chapters = [
        _chapter(section, panels, TEXTS[section.name].format(**words), _extra(section.name, columns))
        for section, panels in drawn
    ]
    note = EXAM_NOTE.format(
        pushes=len(rules.push_speeds) * PUSH_DIRECTIONS, asked=rules.asked_words(), peer=escape(rules.peer_words())
    )
    results = [column.exam for column in columns]
    figures = [rules.figures(result, others=results) for result in results]
    header = f"""{_names(columns, rules)}{_cards(figures[0])}</header>
<section><h2>Exam</h2><p class="lead">{note}</p>{exam_table(columns, figures, rules.peer_label)}</section>"""
    published = _published(rules, columns) if len(rules.peers) > 1 else ""
    harder = "".join(_hard(column) for column in columns if "hard" in column.exam) + _heats(columns)
    return _page(task, "walking exam", "Walking exam", f"{header}\n{harder}{''.join(chapters)}{published}", columns)


def _page(task: str, exam: str, above: str, body: str, columns: Sequence[Column]) -> str:
    """The HTML document. ``body`` starts inside the header element, below the task's name, and must close it."""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><title>{escape(task)}: {escape(exam)}</title><style>{CSS}</style></head>
<body><main>
<header><p class="above">{escape(above)}</p><h1>{escape(task)}</h1>{body}
<footer>{about(columns)}</footer>
</main></body></html>
"""


def _hard(column: Column) -> str:
    """The section of the hard exam: results by condition, gait figures, pictures of one stride."""
    result = column.exam["hard"]
    heads, *rows = hard.condition_rows(result)
    gait = exam_table([column], [hard.figures(result)], hard.peer_label(result), "ready at") if result["looks"] else ""
    misses = f"<p>Not ready: {escape('; '.join(result['misses']))}.</p>" if result["misses"] else ""
    lead = TEXTS["hard"].format(count=len(result["commands"]), pushes=hard.PUSH_DIRECTIONS, vx=result["vx"])
    strip = picture(column.strip, "one stride, from the side and from the front") if column.strip else ""
    summary = f'<p class="lead">{lead}</p>{pill("ready for a robot", "not ready for a robot", result["ready"])}{misses}'
    return f"<section><h2>Hard exam</h2>{summary}{table(heads, rows)}{gait}{strip}</section>"


def _heats(columns: Sequence[Column]) -> str:
    """The section of heat and power for each column: the verdict, one line per result, one row per motor."""
    chapters = []
    for result in (column.exam["heat"] for column in columns if "heat" in column.exam):
        *findings, _ = (f"<li>{escape(line)}</li>" for line in heat.lines(result))
        heads, *rows = heat.rows(result)
        verdict = f"<p><b>Will it trip?</b> {escape(heat.verdict(result))}</p>"
        lead = f'<p class="lead">{TEXTS["heat"]}</p>'
        body = f"{lead}{verdict}<ul>{''.join(findings)}</ul>{table(heads, rows, 'Motor by motor')}"
        chapters.append(f"<section><h2>Heat and power</h2>{body}</section>")
    return "".join(chapters)


def _names(columns: Sequence[Column], rules: ExamRules) -> str:
    """The list of policies with their verdicts and the colours of their curves."""
    items, plotted = [], [column.name for column in columns if column.figures]
    for column in columns:
        swatch = f'<i class="swatch c{plotted.index(column.name)}"></i>' if column.figures and len(plotted) > 1 else ""
        engine = escape(str(column.about.get("engine", "")))
        pills = [pill(*_verdict_texts(words), yes) for words, yes in verdicts(rules, column.exam)]
        items.append(
            f"<li>{swatch}<b>{escape(column.name)}</b> <span class='muted'>{engine}</span> {' '.join(pills)}</li>"
        )
    return f'<ul class="names">{"".join(items)}</ul>'


def _verdict_texts(words: str) -> tuple[str, str]:
    """The texts of a verdict such as ``walks``, if true and if false."""
    verb, _, rest = words.partition(" ")
    return words, f"does not {verb.removesuffix('s')} {rest}".strip()


def pill(good: str, bad: str, yes: bool) -> str:
    return (
        f'<span class="pill {"yes" if yes else "no"}">{"&#10003;" if yes else "&#10007;"} {good if yes else bad}</span>'
    )


def _cards(figures: Sequence[Figure]) -> str:
    """Cards with the most important figures."""
    cards = []
    for figure in figures:
        if figure.card:
            title, unit = figure.card
            value = (
                f"{figure.value:.0%}"
                if figure.more_is_better and figure.value is not None
                else figure.text(figure.value)
            )
            cards.append(
                f'<div class="card{_css(figure)}"><span>{title}</span><b>{value}</b><small>{unit}</small></div>'
            )
    return f'<div class="cards">{"".join(cards)}</div>'


def _css(figure: Figure) -> str:
    return {True: " pass", False: " fail", None: ""}[figure.passes()]


def exam_table(
    columns: Sequence[Column], figures: Sequence[Sequence[Figure]], peer: str, asks: str = "walks at"
) -> str:
    """A table with one row per figure. Each column after the first also shows its difference to the first."""
    lines = []
    for first, *others in zip(*figures, strict=True):
        cells = [f'<td><span class="value{_css(first)}">{first.text(first.value)}</span></td>']
        for other in others:
            gap = "" if other.value is None or first.value is None else f"{other.value - first.value:+.{first.digits}f}"
            gap = gap if gap.strip("+-0.") else ""
            cells.append(
                f'<td><span class="value{_css(other)}">{other.text(other.value)}</span> <small>{gap}</small></td>'
            )
        cells.append(f"<td>{first.mark_text()}</td>")
        if peer:
            cells.append(f"<td>{first.peer_text()}</td>")
        sub = ' class="sub"' if first.name.startswith(" ") else ""
        lines.append(f"<tr{sub}><th>{escape(first.name.strip())}</th>{''.join(cells)}</tr>")
    heads = "".join(
        f"<th>{escape(name)}</th>" for name in [*(column.name for column in columns), asks, *([peer] if peer else [])]
    )
    head = f"<thead><tr><th></th>{heads}</tr></thead>"
    return f'<div class="scroll"><table class="exam">{head}<tbody>{"".join(lines)}</tbody></table></div>'


def _published(rules: ExamRules, columns: Sequence[Column]) -> str:
    """A table with one row per policy: the graded policies, then the published policies."""
    peers = [(peer.name, peer.figures, f"{peer.asked['push_vx']:g}") for peer in rules.peers]
    rows = [(column.name, column.exam, f"{rules.push_vx:g}") for column in columns]
    heads = [
        "",
        "falls",
        "error vx, vy, yaw rate",
        "worst",
        "offset",
        "drift [m]",
        "cost of transport",
        "pushes survived [%]",
        "at vx [m/s]",
    ]
    cells = []
    for name, result, vx in [*rows, *peers]:
        digits = {"error": 3, "worst": 2, "offset": 3}
        triples = [", ".join(f"{value:.{each}f}" for value in result[key]) for key, each in digits.items()]
        drift = "fell" if result["drift"] is None else f"{result['drift']:.3f}"
        cost = "none" if result["cost_of_transport"] is None else f"{result['cost_of_transport']:.2f}"
        shares = ", ".join(f"{100 * share:.0f}" for share in result["pushes"].values())
        cells.append([name, str(result["falls"]), *triples, drift, cost, shares, vx])
    pushes = ", ".join(f"{speed:g}" for speed in rules.push_speeds)
    lead = f"All policies had the same commands. Cost of transport, and pushes of {pushes} m/s: at the vx of the last column [m/s]."
    return (
        f'<section class="peers"><h2>Published policies</h2><p class="lead">{lead}</p>{table(heads, cells)}</section>'
    )


def _chapter(section: Section, panels: list[str], lead: str, extra: str) -> str:
    figures = "".join(f"<figure>{svg}</figure>" for svg in panels)
    kind = "wide" if section.across == 1 else "half" if section.panels[0].width > 4.0 else f"by{section.across}"
    text = f'<h2>{section.title}</h2><p class="lead">{lead}</p>'
    return f'<section>{text}<div class="panels {kind}">{figures}</div>{extra}</section>'


def _extra(name: str, columns: Sequence[Column]) -> str:
    """The table below a section's plots. The rows of two policies alternate."""
    plotted = [column for column in columns if column.figures]
    figures: dict[str, Any] = plotted[0].figures or {}
    tables = {
        "crossing": (_crossing_rows, ["", *(f"level {i}" for i in range(LEVELS)), "mean"], "Every share"),
        "steps": (_step_rows, ["", "from", "to", "10 to 90 % in [s]", "overshoot", "left at the end"], ""),
        "gait": (
            _gait_rows,
            ["vx, vy, yaw rate", "strides [1/s]", *(f"{foot} down" for foot in figures["foot_names"])],
            "All commands",
        ),
        "joints": (_joint_rows, ["", "position", "velocity", "torque"], "Share beyond the limit, joint by joint"),
    }
    if name not in tables:
        return ""
    make, heads, folded = tables[name]
    # zip_longest: the policies' command ranges may differ
    paired = zip_longest(*(make(column, f", {column.name}" if len(plotted) > 1 else "") for column in plotted))
    return table(heads, [row for rows in paired for row in rows if row], folded)


def _crossing_rows(column: Column, suffix: str) -> list[list[str]]:
    rows = []
    for name, kind in (column.figures or {}).get("crossing", {"kinds": {}})["kinds"].items():
        for which in ("crossed", "fell"):
            shares = [*kind[which], fmean(kind[which])]
            rows.append([f"{name.replace('_', ' ')}, {which}{suffix}", *(f"{share:.1%}" for share in shares)])
    return rows


def _step_rows(column: Column, suffix: str) -> list[list[str]]:
    rows = []
    for name, unit in AXES:
        for number in (column.figures or {})["steps"][name.removesuffix(" rate")]["numbers"]:
            rise, over, left = number["rise_time"], number["overshoot"], number["left"]
            reached = "not reached" if rise is None else f"{rise:.2f}"
            rest = ["" if over is None else f"{over:.0%}", "" if left is None else f"{left:+.3f}"]
            rows.append([f"{name} [{unit}]{suffix}", f"{number['from']:g}", f"{number['to']:g}", reached, *rest])
    return rows


def _gait_rows(column: Column, suffix: str) -> list[list[str]]:
    rows = []
    for gait in (column.figures or {})["gait"]:
        name = ", ".join(f"{v:g}" for v in gait["command"]) + suffix
        strides, duty = gait["stride_frequency"], gait["duty_factor"]
        rows.append([name, "fell"] if duty is None else [name, f"{strides:.2f}", *(f"{share:.0%}" for share in duty)])
    return rows


def _joint_rows(column: Column, suffix: str) -> list[list[str]]:
    rows = []
    for i, joint in enumerate((column.figures or {})["joint_names"]):
        shares = [(column.figures or {})["joints"][key]["saturated"] for key in ("dof_pos", "dof_vel", "torque")]
        cells = ["" if not each else "no limit known" if each[i] is None else f"{each[i]:.2%}" for each in shares]
        rows.append([joint.removesuffix("_joint") + suffix, *cells])
    return rows


def table(heads: list[str], rows: list[list[str]], folded: str = "") -> str:
    """An HTML table. If ``folded`` is a title, the table is collapsed below it."""
    head = "".join(f"<th>{escape(text)}</th>" for text in heads)
    body = "".join(
        f"<tr><th>{escape(row[0])}</th>{''.join(f'<td>{escape(text)}</td>' for text in row[1:])}</tr>" for row in rows
    )
    html = f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>'
    return f"<details><summary>{folded}</summary>{html}</details>" if folded else html


def about(columns: Sequence[Column]) -> str:
    """The policies with their physics engines, devices and overrides, as HTML."""
    parts = []
    for column in columns:
        about: dict[str, Any] = column.about
        changed = about.get("overrides") or {}
        listed = "".join(
            f"<li><code>{escape(path)}</code> {escape(str(value))}</li>" for path, value in sorted(changed.items())
        )
        where = ", ".join(str(about[key]) for key in ("policy", "engine", "device") if about.get(key))
        fields = (
            f"<details><summary>Config fields that differ from training</summary><ul>{listed}</ul></details>"
            if listed
            else ""
        )
        warning = f"<p><b>{escape(str(about['warning']))}</b></p>" if about.get("warning") else ""
        parts.append(f"<p><b>{escape(column.name)}</b> {escape(where)}</p>{warning}{fields}")
    return "".join(parts)


# ---- the page of a skill exam


def skill_page(task: str, skill: Skill, columns: Sequence[Column], strips: Mapping[str, bytes]) -> str:
    """The HTML page of a skill exam. ``strips``: part -> PNG of a robot that failed, else of the slowest robot."""
    passed = [f"<li><b>{escape(c.name)}</b> {pill('passes', 'does not pass', c.exam['passed'])}</li>" for c in columns]
    sections = []
    for part in skill.grounds:
        figures = [skill.figures(column.exam["parts"], part) for column in columns]
        strip = picture(strips[part], part) if part in strips else ""
        sections.append(f"<section><h2>{escape(part)}</h2>{exam_table(columns, figures, '', 'asks')}{strip}</section>")
    header = f'<ul class="names">{"".join(passed)}</ul></header>\n<p class="lead">{escape(skill.asks)}</p>'
    return _page(task, skill.kind, f"Exam: {skill.kind}", header + "".join(sections) + _heats(columns), columns)


def picture(png: bytes, name: str) -> str:
    """One picture strip as HTML."""
    return f'<p><img src="data:image/png;base64,{base64.b64encode(png).decode()}" alt="{escape(name)}" style="max-width:100%"></p>'


# ---- files


def write(folder: Path, task: str, columns: Sequence[Column]) -> None:
    """Write ``report.json`` and the self-contained ``report.html``.

    All columns are compared with the first column, by its rules. At most two columns have figures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    rules = ExamRules.from_mapping(columns[0].exam["rules"])
    content = {"task": task, "columns": [column.plain() for column in columns]}
    for column in columns:
        if column.strip:
            (folder / "stride.png").write_bytes(column.strip)
    if rules.peers:
        content |= {"peer": best_of(rules.peers), "peers": [peer._asdict() for peer in rules.peers]}
    (folder / "report.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    from legged_mw.eval import plots  # imports matplotlib, which takes a second, or is missing: the figures are kept

    sections = plots.sections([(column.name, column.figures) for column in columns if column.figures], rules)
    page = walking_page(task, rules, columns, [(section, plots.svgs(section)) for section in sections])
    (folder / "report.html").write_text(page, encoding="utf-8")
