"""The gallery: a page of all policies that ship, from their folders: film, still, exam, curve, how each was made.

MUJOCO_GL=egl python -m website.gallery                # films, stills and docs/gallery.md
MUJOCO_GL=egl python -m website.gallery g1_rough       # the films of these, and the page
python -m website.gallery --page                       # the page alone
"""

from __future__ import annotations

import argparse
import os
import re
from collections.abc import Sequence
from pathlib import Path

from legged_mw import ROOT

POLICIES, PAGE, IMAGES = ROOT / "resources/policies", ROOT / "docs/gallery.md", ROOT / "docs/images/gallery"
ORDER = (  # then all others by name
    *("go1_flat", "go1_flat_dr", "go1_rough", "go1_rough_scan", "go1_rough_student"),
    *("go2_flat", "go2_rough", "go2_rough_scan", "g1_flat", "g1_12dof_flat", "g1_rough"),
)
FIRST = f"\n## {ORDER[0]}\n"  # what stands before it in docs/gallery.md is written by hand


def policies() -> list[str]:
    """Those that ship, in the order of the page."""
    names = {path.parent.name for path in POLICIES.glob("*/README.md")}
    return [*(name for name in ORDER if name in names), *sorted(names - {*ORDER})]


def page() -> str:
    """The whole of docs/gallery.md; the site writes what the policy's README says where the marks are."""
    head = PAGE.read_text().partition(FIRST)[0]
    return "\n".join([head, *map(_entry, policies())])


def _entry(name: str) -> str:
    film = f"![{name}](images/gallery/{name}.webp)"
    return f"## {name}\n\n{film}\n\n<!-- made: policy_{name} -->\n\nAll of it: [{name}](../resources/policies/{name}/README.md).\n"


def chapter(name: str) -> str:
    """What there is to say of a policy, in the words of its README: how it was made, its exam, its curve."""
    folder = POLICIES / name
    text = _relinked((folder / "README.md").read_text(), folder)
    made = re.findall(r"^```bash\n.*?^```$", text, re.MULTILINE | re.DOTALL)[:1]
    tables = [
        part
        for part in text.split("\n\n")
        if part.startswith("|") and re.search("falls in|stands within|holds|finishes", part)
    ]
    exam = "\n".join(line for line in "\n".join(tables).splitlines() if line.startswith("|"))
    curve = [f"![learning curve](../resources/policies/{name}/curve.webp)"] if (folder / "curve.webp").exists() else []
    return "\n\n".join([text.split("\n\n")[1].replace("\n", " "), *made, exam, *curve])


def _relinked(text: str, folder: Path) -> str:
    """``text`` of a page in ``folder``, for docs/."""

    def moved(found: re.Match[str]) -> str:
        name, mark, anchor = found.group(1).partition("#")
        return f"]({os.path.relpath(folder / name, PAGE.parent)}{mark}{anchor})"

    return re.sub(r"\]\((?!http|#)([^)\s]+)\)", moved, text)


def films(names: Sequence[str]) -> None:
    """A film and a still of each."""
    from PIL import Image

    from website.film import BY_NAME, record, save_webp

    IMAGES.mkdir(parents=True, exist_ok=True)
    for name in names:
        shot = BY_NAME.get(name, BY_NAME["go1_flat"]._replace(policy=name))
        frames = record(shot._replace(seconds=min(shot.seconds, 2.4)), 256, 160)
        save_webp(IMAGES / f"{name}.webp", frames)
        Image.fromarray(frames[len(frames) // 2]).save(IMAGES / f"{name}.jpg", quality=70, optimize=True)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m website.gallery", description=str(__doc__).splitlines()[0])
    parser.add_argument("--page", action="store_true", help="write the page alone")
    parser.add_argument("names", nargs="*", metavar="NAME", help="policies to film (default: all)")
    args = parser.parse_args()
    if not args.page:
        films(args.names or policies())
    PAGE.write_text(page())


if __name__ == "__main__":
    main()
