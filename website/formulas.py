"""mkdocs hook: formulas become MathML, which browsers draw without a script; pymdownx.arithmatex with `generic: true` finds them."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

FORMULA = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """The page's HTML with each formula, written in LaTeX, as MathML."""
    return FORMULA.sub(lambda found: _mathml(html.unescape(found[2]), found[1] == "div"), content)


def _mathml(latex: str, block: bool) -> str:
    tag, display = ("div", "block") if block else ("span", "inline")
    return f'<{tag} class="formula">{convert(latex, display=display)}</{tag}>'  # site.css lets it scroll on a phone
