"""mkdocs hooks: links that leave docs/ lead to pages of the site, and `<!-- made: policy_NAME -->` becomes a chapter of the gallery."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files, InclusionLevel

ROOT = Path(__file__).resolve().parent.parent

MARK = re.compile(r"<!-- made: policy_(\w+) -->")
LINK = re.compile(r"(\]\()([^)\s]+)(\))")
ARCHIVED = re.compile(r"\[([^\]]+)\]\(archive/[^)\s]+\)")  # in the repository alone: the link's text is the path
FENCE = re.compile(r"(^```.*?^```$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
LANGUAGES = {".py": "python", ".yaml": "yaml", ".xml": "xml", ".csv": "text", ".yml": "yaml", ".cpp": "cpp"}
PICTURES = (".png", ".jpg", ".gif", ".svg", ".webp", ".mp4", ".html", ".ipynb")


def outside(text: str) -> bool:
    return text.startswith(("http:", "https:", "mailto:", "#"))


def targets(path: Path) -> list[Path]:
    """Files and folders that a page links to, its code left out."""
    parts = FENCE.split(path.read_text())
    links = [link for part in parts[::2] for _, link, _ in LINK.findall(part) if not outside(link)]
    curves = [f"../resources/policies/{name}/curve.webp" for name in MARK.findall(path.read_text())]
    return [(path.parent / link.partition("#")[0]).resolve() for link in [*links, *curves]]


def readable(path: Path) -> Path:
    """What stands for a folder: its README, if it has one."""
    return path / "README.md" if (path / "README.md").exists() else path


def page_of(path: Path) -> str:
    """Where a file of the repository is on the site."""
    path = readable(path)
    if path.is_relative_to(ROOT / "docs"):
        return str(path.relative_to(ROOT / "docs"))
    name = f"source/{path.relative_to(ROOT)}"
    return name if path.suffix in (*PICTURES, ".md") else f"{name}.md"


def _shown(path: Path) -> str:
    """A file or folder that is no page, as one."""
    title = f"# {path.relative_to(ROOT)}\n\n"
    if path.is_dir():
        return title + "\n".join(
            f"- `{each.name}`" for each in sorted(path.iterdir()) if not each.name.startswith(("_", "."))
        )
    return f"{title}```{LANGUAGES.get(path.suffix, 'text')}\n{path.read_text()}\n```\n"


def on_files(files: Files, config: Any) -> Files:
    """Add what the pages link to outside of docs/, and what those link to."""
    seen: set[Path] = set()
    todo = [Path(file.abs_src_path) for file in files if file.is_documentation_page() and file.abs_src_path]
    while todo:
        for path in map(readable, targets(todo.pop())):
            if path in seen or path.is_relative_to(ROOT / "docs") or not path.exists() or not path.is_relative_to(ROOT):
                continue
            seen.add(path)
            text = path.suffix not in PICTURES
            content = (
                {"content": path.read_text() if path.suffix == ".md" else _shown(path)}
                if text
                else {"abs_src_path": str(path)}
            )
            files.append(File.generated(config, page_of(path), inclusion=InclusionLevel.NOT_IN_NAV, **content))
            if path.suffix == ".md":
                todo.append(path)
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links by the place of the page on the site; tables where they are asked for."""
    here = page.file.src_uri
    source = ROOT / (here.removeprefix("source/") if here.startswith("source/") else f"docs/{here}")

    def relinked(found: re.Match[str]) -> str:
        before, link, after = found.groups()
        if outside(link):
            return found.group(0)
        name, mark, anchor = link.partition("#")
        there = page_of((source.parent / name).resolve())
        return f"{before}{os.path.relpath(there, os.path.dirname(here) or '.')}{mark}{anchor}{after}"

    markdown = MARK.sub(lambda found: chapter(found[1]), markdown)
    if source.suffix == ".md" and source.exists():
        parts = FENCE.split(ARCHIVED.sub(r"`\1`", markdown))
        markdown = "".join(part if i % 2 else LINK.sub(relinked, part) for i, part in enumerate(parts))
    return twin(here) + markdown


def on_post_page(output: str, page: Any, **_: Any) -> str:
    """A Chinese page says that it is one."""
    chinese = page.file.src_uri.startswith("zh/") or page.file.src_uri.endswith(".zh-CN.md")
    return output.replace('<html lang="en"', '<html lang="zh"', 1) if chinese else output


def twin(here: str) -> str:
    """A line that leads to the same page in the other language, where there is one."""
    chinese = here.startswith("zh/")
    name = here.removeprefix("zh/")
    if "/" in name or not all((ROOT / "docs" / folder / name).exists() for folder in ("", "zh")):
        return ""
    return f"[{'English' if chinese else '中文'}]({'../' if chinese else 'zh/'}{name}){{ .language }}\n\n"


def chapter(name: str) -> str:
    """The gallery's chapter on a policy."""
    sys.path.insert(0, str(ROOT))  # mkdocs loads this file by its path
    from website import gallery

    return gallery.chapter(name)
