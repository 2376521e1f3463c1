"""The site's source, made from `docs/` at each build.

The pages are the only source, and can be read on a forge. This module makes the differences of the site: an index
page gets a hidden list of contents in the order of its links; a link to a file outside `docs/` becomes a download;
a link to a folder becomes the folder's name; and large pictures become WebP.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

REPO = Path(__file__).resolve().parent.parent
DOCS = REPO / "docs"
CHANGELOG = "changelog.md"
NOTEBOOKS = "notebooks"
INDEX_PAGES = {
    "index.md": (
        "tutorial/index.md",
        "how-to/index.md",
        "reference/index.md",
        "explanations.md",
        "gallery.md",
        CHANGELOG,
    ),
    "tutorial/index.md": ("tutorial/", "notebooks/"),
    "how-to/index.md": ("how-to/",),
    "reference/index.md": ("reference/",),
    "explanations.md": ("decisions/", "architecture.md", "contributing.md", "neighbours.md"),
    "reference/commands.md": ("reference/commands/",),
}
"""Pages or folders that belong to each index page. The index page's links to them are its contents."""
LARGE_BYTES = 150_000
WIDEST_PX = 1100
_FENCE = re.compile(r"^([ ]*)(```+|~~~+).*?^\1\2[ ]*$\n?", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^()\s]+)\)")


@dataclass
class Source:
    """The folder for Sphinx, and the broken links."""

    folder: Path
    broken_links: list[str] = field(default_factory=list)
    """Links without a target: file, line and target."""


def prose(text: str) -> Iterator[tuple[bool, str]]:
    """Return the parts of a page in their order: True with text outside of blocks of code, False with a block."""
    end = 0
    for block in _FENCE.finditer(text):
        yield True, text[end : block.start()]
        yield False, block[0]
        end = block.end()
    yield True, text[end:]


def links(text: str) -> list[str]:
    """Return the targets of a page's links, in their order, without links to other hosts and into the page
    itself."""
    targets = [match[3] for is_prose, part in prose(text) if is_prose for match in _LINK.finditer(part)]
    return [target for target in targets if not is_elsewhere(target)]


def is_elsewhere(target: str) -> bool:
    """True for a target on another host, or on the same page."""
    return target.startswith(("http:", "https:", "mailto:", "#"))


def with_links(text: str, change: Callable[[str, str, str], str]) -> str:
    """Return the page with `change(mark, words, target)` in place of each link (its mark is "!" for a picture)."""
    parts = []
    for is_prose, part in prose(text):
        parts.append(_LINK.sub(lambda match: change(match[1], match[2], match[3]), part) if is_prose else part)
    return "".join(parts)


def stage(to: Path, *, made_pages: dict[str, str], made_files: Path) -> Source:
    """Write the site's source into the folder `to`, which is made anew.

    `made_pages` are pages that are not files of `docs/`, or differ from them, by their path there. The folder
    `made_files` has the figures of the notebooks.
    """
    shutil.rmtree(to, ignore_errors=True)
    source = Source(to)
    pages = {str(path.relative_to(DOCS)): path.read_text(encoding="utf-8") for path in sorted(DOCS.rglob("*.md"))}
    pages[CHANGELOG] = (REPO / "CHANGELOG.md").read_text(encoding="utf-8")
    pages |= made_pages
    for path in sorted(DOCS.rglob("*")):
        if path.is_file() and path.suffix not in (".md", ".py"):
            _place(path, to / path.relative_to(DOCS))
    shutil.copytree(made_files, to / NOTEBOOKS, dirs_exist_ok=True)
    for name, text in pages.items():
        place = to / name
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text(_page(source, name, text, pages), encoding="utf-8")
    return source


def contents(name: str, text: str) -> list[str]:
    """Return the pages that an index page lists, relative to it, in the order of its links."""
    folder = os.path.dirname(name)  # noqa: PTH120  a path of the site, not of the disk
    children: list[str] = []
    for target in links(text):
        page = os.path.normpath(os.path.join(folder, target.partition("#")[0]))  # noqa: PTH118
        page = _as_page(page)
        if page != name and page.endswith(".md") and page.startswith(INDEX_PAGES[name]) and page not in children:
            children.append(page)
    return [os.path.relpath(page, folder or ".") for page in children]


# ---- helpers ----


def _page(source: Source, name: str, text: str, pages: dict[str, str]) -> str:
    at = REPO / "CHANGELOG.md" if name == CHANGELOG else DOCS / name

    def change(mark: str, words: str, target: str) -> str:
        if is_elsewhere(target):
            return f"{mark}[{words}]({target})"
        file, _, place = target.partition("#")
        path = Path(os.path.normpath(at.parent / file))
        on_site = os.path.relpath(path, DOCS)
        if not (path.exists() or (source.folder / on_site).exists() or _as_page(on_site) in pages):
            line = text[: text.find(f"]({target})")].count("\n") + 1
            source.broken_links.append(f"{at.relative_to(REPO)}:{line}: {target} is not there")
            return words
        if path.is_dir():
            return f"`{path.relative_to(REPO)}/`" if words.strip("`").rstrip("/") in str(path) else words
        if DOCS not in path.parents and _as_page(on_site) not in pages:
            on_site = f"files/{path.relative_to(REPO)}"
            _place(path, source.folder / on_site)
        here = os.path.relpath(_picture_name(source, _as_page(on_site)), Path(name).parent)
        return f"{mark}[{words}]({here}{'#' + place if place else ''})"

    text_on_site = with_links(text, change)
    if name in INDEX_PAGES:
        children = contents(name, text)
        text_on_site += "\n".join(["", "```{toctree}", ":hidden:", "", *children, "```", ""])
    return text_on_site


def _as_page(name: str) -> str:
    """Return the page of a notebook or of the changelog on the site; other paths are unchanged."""
    if name == "../CHANGELOG.md":
        return CHANGELOG
    is_notebook = name.startswith(f"{NOTEBOOKS}/") and name.endswith(".py")
    return f"{name.removesuffix('.py')}.md" if is_notebook else name


def _picture_name(source: Source, name: str) -> str:
    """Return the name of the picture that replaces a large one."""
    small = Path(name).with_suffix(".webp")
    return str(small) if (source.folder / small).exists() else name


def _place(path: Path, to: Path) -> None:
    """Copy a file; a large picture as WebP, at most `WIDEST_PX` wide."""
    to.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix != ".png" or path.stat().st_size < LARGE_BYTES:
        shutil.copyfile(path, to)
        return
    from PIL import Image

    with Image.open(path) as picture:
        picture.thumbnail((WIDEST_PX, 10 * WIDEST_PX))
        picture.save(to.with_suffix(".webp"), quality=82)
