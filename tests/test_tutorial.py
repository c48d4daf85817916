"""The tutorial: its notebooks are made of its pages, both languages say the same, and its code runs and prints what the pages show."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from examples.make_tutorial import CELL, PAGES, ROOT, as_json, notebook, printed, run, translated
from legged_mw.utils.task import load_task
from website.formulas import on_page_content

ENGLISH, CHINESE = PAGES
TERM = re.compile(r"^\| `(\w+)` \| (-?[\d.]+) \|", re.MULTILINE)
MENDED = "; run python examples/make_tutorial.py, with --run where code or outputs changed"


def read(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_notebooks_are_made_of_their_pages(page: Path) -> None:
    name = PAGES[page]
    assert read(ROOT / "examples" / name) == as_json(notebook(read(page))), f"{name} is not that of {page.name}{MENDED}"


def test_both_languages_have_the_same_code_and_outputs() -> None:
    assert read(CHINESE) == translated(read(CHINESE), read(ENGLISH)), f"the pages differ in code or outputs{MENDED}"


def test_both_languages_have_the_same_exercises_and_formulas() -> None:
    for same in (r"\*\*(?:\w+ )?(\d+\.\d)", r"^(\$\$.*)"):  # the rest: test_built_site.py
        found = [re.findall(same, CELL.sub("", read(page)), re.MULTILINE) for page in PAGES]
        assert found[0] == found[1] and found[0], same


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_scales_are_the_tasks(page: Path) -> None:
    scales = {name: float(scale) for name, scale in TERM.findall(read(page))}
    assert scales == {
        name: scale for name, scale in load_task("go1_flat").cfg.to_dict()["rewards"]["scales"].items() if scale
    }


@pytest.mark.parametrize("name", PAGES.values())
def test_links_of_notebooks_lead_somewhere(name: str) -> None:
    text = "".join(
        "".join(cell["source"]) for cell in notebook(read(next(page for page in PAGES if PAGES[page] == name)))["cells"]
    )
    links = re.findall(r"\]\(([^)#]+)", text)
    assert links and not [link for link in links if not (ROOT / "examples" / link).exists()]


def test_the_code_runs_and_prints_what_the_page_shows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ITERATIONS", "2")
    page = read(ENGLISH)
    ran = run(notebook(page))
    assert len(ran) == len(CELL.findall(page))
    for cell, (code, shown, picture) in zip(ran, CELL.findall(page), strict=True):
        text = printed(cell)
        drew = sum("image/png" in output.get("data", {}) for output in cell["outputs"])
        assert drew == bool(picture) or "No OpenGL context" in text, code
        if "No OpenGL context" not in text:
            assert words(text) == words(shown), f"{code}{MENDED}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.parent.name)
def test_formulas_stand_apart_as_github_wants_them(page: Path) -> None:
    text = re.sub(r"```.*?```|`[^`\n]*`|^\$\$.*?\$\$$", "", read(page), flags=re.MULTILINE | re.DOTALL)
    found = list(re.finditer(r"(.?)\$[^$\n]+\$(.?)", text))
    assert len(found) > 80 and [each[0] for each in found if each[1].strip() or re.match(r"[A-Za-z0-9]", each[2])] == []


def test_formulas_become_mathml() -> None:
    shown = on_page_content(
        r'<p><span class="arithmatex">\(a &lt; b\)</span></p><div class="arithmatex">\[\sum_k w_k\]</div>'
    )
    assert (
        shown.count("<math ") == 2 and 'display="block"' in shown and "&#x0003C;" in shown and "arithmatex" not in shown
    )


def words(text: str) -> str:
    """Text without its numbers, which differ a little between machines."""
    return " ".join(re.sub(r"-?\d+(?:\.\d*)?", "#", text).split())
