"""Make the tutorial's notebooks from its pages, docs/tutorial.md and docs/zh/tutorial.md. With --run, run the cells.

    python examples/make_tutorial.py          # notebooks from pages; both pages have the code of the English one
    python examples/make_tutorial.py --run    # also run the cells, and write their outputs into both pages
    python examples/make_tutorial.py --quick  # the same, but cells that train keep their outputs

In a page a block of ```python is a cell. A block of ```text after it is the printed output, and a picture after that is
the drawn output. Notebooks have no outputs. Needs nbclient and ipykernel, of the extra `dev`.
"""

from __future__ import annotations

import argparse
import base64
import io
import json
import os
import re
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
PAGES = {
    ROOT / "docs/tutorial.md": "joystick_explained.ipynb",
    ROOT / "docs/zh/tutorial.md": "joystick_explained.zh.ipynb",
}
CELL = re.compile(
    r"```python\n(.*?)```\n(?:\n```text\n(.*?)```\n)?(?:\n!\[[^\]]*\]\((?:\.\./)?(images/tutorial/[^)]*)\)\n)?",
    re.DOTALL,
)
COLORS, QUALITY = 16, 75  # colours of a plot; quality of a photo


def notebook(page: str) -> dict[str, Any]:
    """The notebook of a page, without outputs."""
    cells, end = [], 0
    for cell in CELL.finditer(page):
        cells += [_markdown(page[end : cell.start()]), _cell("code", cell[1])]
        end = cell.end()
    cells = [cell for cell in [*cells, _markdown(page[end:])] if cell["source"]]
    named = [{"id": f"cell{i}", **cell} for i, cell in enumerate(cells)]
    kernel = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    return {"cells": named, "metadata": kernel, "nbformat": 4, "nbformat_minor": 5}


def _markdown(text: str) -> dict[str, Any]:
    """A text cell. Links to other pages start in examples/."""
    return _cell(
        "markdown", re.sub(r"\]\((?:\.\./)*([\w/.]+\.(?:md|ipynb))", lambda link: f"]({_from_examples(link[1])}", text)
    )


def _from_examples(path: str) -> str:
    return (
        path.removeprefix("examples/")
        if path.startswith("examples/")
        else f"../{'' if (ROOT / path).exists() else 'docs/'}{path}"
    )


def _cell(kind: str, text: str) -> dict[str, Any]:
    extra: dict[str, Any] = {"execution_count": None, "outputs": []} if kind == "code" else {}
    return {"cell_type": kind, "metadata": {}, **extra, "source": text.strip("\n")}


def as_json(cells: dict[str, Any]) -> str:
    return json.dumps(cells, ensure_ascii=False, indent=0) + "\n"


def translated(page: str, original: str) -> str:
    """``page`` with the code and the outputs of ``original``."""
    theirs = iter(list(CELL.finditer(original)))
    if len(CELL.findall(page)) != len(CELL.findall(original)):
        raise SystemExit("the two pages have different numbers of ```python blocks")
    return CELL.sub(lambda cell: _written(cell, (own := next(theirs))[1], own[2] or ""), page)


def _written(cell: re.Match[str], code: str, printed: str) -> str:
    """A cell as page text, with new code and output. The line of its picture stays."""
    picture = re.search(r"\n!\[.*\n", cell[0])
    return (
        f"```python\n{code}```\n" + (f"\n```text\n{printed}```\n" if printed else "") + (picture[0] if picture else "")
    )


def run(cells: dict[str, Any], folder: Path = ROOT / "examples") -> list[dict[str, Any]]:
    """Run a notebook in ``folder``. Returns its code cells with outputs. Raises the error of the first that fails."""
    import nbformat
    from nbclient import NotebookClient

    node = nbformat.reads(as_json(cells), as_version=4)
    with TemporaryDirectory() as path:
        # this checkout's modules, but not configs/, which a reader's kernel does not have
        (Path(path) / "legged_mw").symlink_to(ROOT / "legged_mw")
        kernel = {**os.environ, "PYTHONPATH": path, "PYDEVD_DISABLE_FILE_VALIDATION": "1"}
        NotebookClient(node, timeout=3600, resources={"metadata": {"path": str(folder)}}).execute(env=kernel)
    return [cell for cell in node["cells"] if cell["cell_type"] == "code"]


def printed(cell: dict[str, Any]) -> str:
    """The printed output of a cell."""
    return "".join(
        output["text"] for output in cell["outputs"] if output["output_type"] == "stream" and output["name"] == "stdout"
    )


def _with_outputs(page: str, ran: list[dict[str, Any]], quick: bool) -> str:
    """The page with outputs of the cells ``ran``, and save pictures. ``quick``: cells that train keep their outputs."""
    cells = iter(ran)

    def write(cell: re.Match[str]) -> str:
        done = next(cells)
        if quick and "train(" in cell[1]:
            return cell[0]
        drawn = [output["data"]["image/png"] for output in done["outputs"] if "image/png" in output.get("data", {})]
        if len(drawn) != bool(cell[3]):
            raise SystemExit(f"a cell drew {len(drawn)} pictures, the page has {int(bool(cell[3]))}: {cell[1][:60]}")
        for png in drawn:
            _save(base64.b64decode(png), ROOT / "docs" / cell[3])
        text = re.sub(r"[ \t]+\n", "\n", printed(done)).strip("\n")
        return _written(cell, cell[1], f"{text}\n" if text else "")

    return CELL.sub(write, page)


def _save(png: bytes, path: Path) -> None:
    """Save a small WebP file. A plot is mostly white, so it gets few colours and no loss."""
    from PIL import Image

    picture = Image.open(io.BytesIO(png)).convert("RGB")
    photo = picture.convert("L").histogram()[255] < 0.5 * picture.width * picture.height
    path.parent.mkdir(parents=True, exist_ok=True)
    if not photo:
        picture = picture.quantize(COLORS, dither=Image.Dither.NONE).convert("RGB")
    picture.save(path, lossless=not photo, quality=QUALITY if photo else 100, method=6)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--run", action="store_true", help="run the code; write its outputs and pictures")
    parser.add_argument(
        "--quick", action="store_true", help="likewise, with two iterations of training, whose outputs stay as they are"
    )
    args = parser.parse_args()
    english, *others = PAGES
    text = english.read_text(encoding="utf-8")
    if args.quick:
        os.environ["ITERATIONS"] = "2"
    if args.run or args.quick:
        text = _with_outputs(text, run(notebook(text)), args.quick)
        english.write_text(text, encoding="utf-8")
    for page in others:
        page.write_text(translated(page.read_text(encoding="utf-8"), text), encoding="utf-8")
    for page, name in PAGES.items():
        (ROOT / "examples" / name).write_text(as_json(notebook(page.read_text(encoding="utf-8"))), encoding="utf-8")


if __name__ == "__main__":
    main()
