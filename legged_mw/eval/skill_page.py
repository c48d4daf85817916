"""The report on a skill exam as one HTML page, from tables and picture strips."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

from legged_mw.eval.page import CSS, Column, about, exam_table, pill
from legged_mw.eval.skill import Skill


def html(task: str, skill: Skill, columns: Sequence[Column], strips: Mapping[str, bytes]) -> str:
    """The whole page. ``strips``: part -> PNG of a robot that failed, else of the slowest robot."""
    passed = [f"<li><b>{escape(c.name)}</b> {pill('passes', 'does not pass', c.exam['passed'])}</li>" for c in columns]
    sections = []
    for part in skill.grounds:
        figures = [skill.figures(column.exam["parts"], part) for column in columns]
        strip = picture(strips[part], part) if part in strips else ""
        sections.append(f"<section><h2>{escape(part)}</h2>{exam_table(columns, figures, '', 'asks')}{strip}</section>")
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark"><title>{escape(task)}: {escape(skill.kind)}</title><style>{CSS}</style></head>
<body><main>
<header><p class="above">Exam: {escape(skill.kind)}</p><h1>{escape(task)}</h1><ul class="names">{"".join(passed)}</ul></header>
<p class="lead">{escape(skill.asks)}</p>{"".join(sections)}
<footer>{about(columns)}</footer>
</main></body></html>
"""


def picture(png: bytes, name: str) -> str:
    """The HTML of one picture strip."""
    return f'<p><img src="data:image/png;base64,{base64.b64encode(png).decode()}" alt="{escape(name)}" style="max-width:100%"></p>'
