"""The site as it is built: strict, nothing from the net, tables made from the code; both languages say the same; pictures are small."""

from __future__ import annotations

import re
import shutil
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any

import pytest
from mkdocs.commands.build import build
from mkdocs.config import load_config

from legged_mw import ROOT
from legged_mw.envs.legged_robot import LeggedRobot
from website import gallery, reference

DOCS = ROOT / "docs"
TWINS = [
    (ROOT / "README.md", ROOT / "README.zh-CN.md"),
    *((DOCS / path.name, path) for path in sorted((DOCS / "zh").glob("*.md"))),
]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As `make docs` builds it: a warning, such as a link that leads nowhere, is an error."""
    out = tmp_path_factory.mktemp("site")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NO_MKDOCS_2_WARNING", "1")
        build(load_config(str(ROOT / "mkdocs.yml"), site_dir=str(out)))
    return out


def test_nothing_is_loaded_from_the_net(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 40
    loads = re.compile(r"""<(?:script|img|source|iframe|link)\b[^>]*?(?:src|href)=["']?(https?:)?//[^"'> ]+""")
    assert [(page.name, found.group(0)) for page in pages for found in loads.finditer(page.read_text())] == []
    styles = [path for path in site.rglob("*.css") if re.search(r"url\(['\"]?(https?:)?//", path.read_text())]
    assert styles == []


# the elements of a page that reach beyond the screen and do not scroll inside another one
WIDE = """() => [...document.querySelectorAll(".md-content *")].filter(part => {
    for (let box = part.parentElement; box && box !== document.body; box = box.parentElement)
        if (["auto", "scroll", "hidden"].includes(getComputedStyle(box).overflowX)) return false;
    const place = part.getBoundingClientRect();
    return place.width > 0 && place.right > innerWidth + 1;
}).map(part => part.tagName + " " + (part.textContent || "").slice(0, 60))"""


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_: object) -> None:
        """Pages that are asked for are no news."""


@pytest.mark.browser
@pytest.mark.parametrize("width", [390, 1280])
def test_pages_fit_a_phone_and_a_screen(width: int, site: Path) -> None:
    """No page is wider than the screen [px], none writes an error to the console or asks another host."""
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    wrong: list[tuple[str, str]] = []
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(site)))
    Thread(target=server.serve_forever, daemon=True).start()
    home = f"http://127.0.0.1:{server.server_port}/"
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": 800})
        here = ""
        page.on("pageerror", lambda error: wrong.append((here, str(error))))
        page.on("console", lambda said: wrong.append((here, said.text)) if said.type == "error" else None)
        page.on(
            "request",
            lambda asked: None if asked.url.startswith((home, "data:", "blob:")) else wrong.append((here, asked.url)),
        )
        for file in sorted(site.rglob("*.html")):
            here = str(file.relative_to(site))
            page.goto(home + here)
            wrong += [(here, part) for part in page.evaluate(WIDE)]
            if page.evaluate("document.documentElement.scrollWidth") > width:
                wrong.append((here, "wider than the screen"))
        browser.close()
    server.shutdown()
    assert wrong == []


def test_tables_are_made_from_the_code(site: Path) -> None:
    terms, config = (site / "rewards.html").read_text(), (site / "config.html").read_text()
    for name in (
        "lin_vel_z",
        "action_rate",
        "feet_clearance",
        "stand_still",
        "tracking_body_pos",
        "fast_joints",
        "height_scan",
        "kick_force",
        "reference_joint_pos",
    ):
        assert f"<code>{name}</code>" in terms, name
    for name in ("num_envs", "tracking_sigma", "gamma", "pull_fades", "concurrent", "clips"):
        assert f"<code>{name}</code>" in config or name in config, name


def test_the_archive_is_named_by_its_path_in_the_repository(site: Path) -> None:
    assert not (site / "archive").exists() and not list((site / "source").rglob("*archive*"))
    page = (site / "lab.html").read_text()
    assert "<code>docs/archive/speed.md</code>" in page and 'href="archive/' not in page


def test_chinese_pages_say_so_and_lead_to_their_english_ones(site: Path) -> None:
    page = (site / "zh/concepts.html").read_text()
    assert '<html lang="zh"' in page and '<a class="language" href="../concepts.html">English</a>' in page
    assert '<a class="language" href="zh/concepts.html">中文</a>' in (site / "concepts.html").read_text()


# ---- the reference


def test_a_terms_code_is_its_statements() -> None:
    assert reference.body(LeggedRobot._reward_tracking_ang_vel) == (
        "error = (commands[:, 2] - base_ang_vel[:, 2]).square(); return torch.exp(error / -tracking_sigma)"
    )


@pytest.mark.parametrize(
    ("comment", "words", "unit", "source"),
    [
        ("[s], then the episode times out [P]", "then the episode times out", "s", "P"),
        ("mean over pairs [rad^2]. [UL]", "mean over pairs", "rad^2", "UL"),
        ("a height [m] [L 0.5; ours: why] of `x`", "a height of `x`", "m", "L 0.5; ours: why"),
        ("an .npz, as written; {[kept]}", "an .npz, as written; {[kept]}", "", ""),
    ],
)
def test_a_comment_is_read(comment: str, words: str, unit: str, source: str) -> None:
    assert reference.read_comment(comment) == (words, unit, source)


def test_every_term_says_what_it_is_and_whose() -> None:
    said = {
        name: reference.read_comment(str(term.__doc__))
        for _, owner in reference.classes(reference.TERMS, reference.terms_of)
        for name, term in reference.terms_of(owner).items()
    }
    assert len(said) > 45
    assert [name for name, each in said.items() if not (each.words and each.source)] == []


def test_every_field_says_its_bounds() -> None:
    lines = {
        line.split(" | ")[0]: line
        for line in reference.config_fields().splitlines()
        if line.startswith("| `") and "overridden" not in line
    }
    for name, told in (
        ("num_envs", "`int`: 1 or more"),
        ("gamma", "from 0 to 1"),
        ("actuator", "`servo`, `dc_motor`, `torque`, `network`"),
        ("action_scale", "`float \\| dict[str, float]`: another number than 0"),
        ("stall_torque", "each above 0"),
    ):
        assert told in lines[f"| `{name}`"], lines[f"| `{name}`"]


def test_every_row_has_words() -> None:
    lines = [line for line in reference.observations().splitlines() if line.startswith("| `")]
    assert len(lines) > 80 and [line for line in lines if not line.split(" | ")[2].strip()] == []


# ---- two languages


def blocks(text: str) -> list[str]:
    """Code, its comments gone: those are in the page's language."""
    return [re.sub(r"\s*#.*", "", block) for block in re.findall(r"^```\w*\n(.*?)^```", text, re.MULTILINE | re.DOTALL)]


def shape(page: Path) -> dict[str, Any]:
    """What two languages must have in common: levels of headings, commands, tables with what is no word in them, links."""
    text = page.read_text()
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    rows = [line for line in prose.splitlines() if line.startswith("|")]
    known = {
        link.rpartition("/")[2].replace(".zh.", ".")
        for link in re.findall(r"\]\(([^)#\s]+)", text)
        if not link.startswith("http")
    }
    return {
        "headings": [len(mark) for mark in re.findall(r"^(#+) ", prose, re.MULTILINE)],
        "commands": blocks(text),
        "rows": [line.count("|") for line in rows],
        "code in tables": [sorted(re.findall(r"`[^`]+`", line)) for line in rows],
        "figures in tables": [re.findall(r"\d[\d.]*", re.sub(r"`[^`]+`|\]\([^)]*\)", "", line)) for line in rows],
        "links": sorted(known - {"README.md", "README.zh-CN.md", "step.svg", "house.svg"}),
    }


@pytest.mark.parametrize(("english", "chinese"), TWINS, ids=[chinese.name for _, chinese in TWINS])
def test_both_languages_say_the_same(english: Path, chinese: Path) -> None:
    theirs = shape(chinese)
    assert {name: theirs[name] for name in theirs} == shape(english)
    assert len(re.findall(r"[一-鿿]", chinese.read_text())) > 500


def test_which_pages_are_in_chinese() -> None:
    assert {page.stem for _, page in TWINS[1:]} >= {
        "index",
        "concepts",
        "your_own_robot",
        "on_the_robot",
        "coming_from",
        "tutorial",
    }


# ---- the README, pictures


def test_the_readme_is_short() -> None:
    assert all(len(page.read_text().splitlines()) <= 80 for page in TWINS[0])


def test_pictures_are_small() -> None:
    images = DOCS / "images"
    assert (images / "film.webp").stat().st_size < 300_000
    assert all(path.stat().st_size < 80_000 for path in (images / "gallery").iterdir())


def test_the_gallery_has_every_policy(site: Path) -> None:
    assert gallery.PAGE.read_text() == gallery.page(), "python -m website.gallery"
    assert [name for name in gallery.policies() if "| --- |" not in gallery.chapter(name)] == [], "an exam's table"
    page = (site / "gallery.html").read_text()
    assert page.count("falls in 22 commands") >= 6 and page.count("curve.webp") == len(
        list(gallery.POLICIES.glob("*/curve.webp"))
    )
