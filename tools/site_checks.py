"""Checks of the built site: nothing is loaded from another host, the landing page is small, answers are few clicks
away."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

LANDING = "index.html"
MOST_LANDING_BYTES = 1_000_000
MOST_CLICKS = 3
QUESTIONS = {
    "Which command lights one LED?": r"coupole live sim --led 417",
    "What is the format of frames?": r"uint16 \[slots, height, width\], DN",
    "Can I use my own dome?": r"A dome whose LEDs are switched by a microcontroller",
}
"""Questions of new readers, and a pattern of the answer's text."""
_RESOURCES = {
    "script": ("src",),
    "img": ("src", "srcset"),
    "source": ("src", "srcset"),
    "video": ("src", "poster"),
    "iframe": ("src",),
    "embed": ("src",),
    "object": ("data",),
    "input": ("src",),
    "use": ("href", "xlink:href"),
}
_LINKED = {
    "stylesheet",
    "icon",
    "shortcut",
    "preload",
    "modulepreload",
    "prefetch",
    "preconnect",
    "dns-prefetch",
    "manifest",
}
"""Kinds of `<link>` that a browser loads by itself."""
_HOST = re.compile(r"(?:https?:)?//[a-z0-9][\w.-]*\.[a-z]{2,}", re.IGNORECASE)
_STYLE_FETCHES = re.compile(r"url\(\s*[\"']?([^\"')]+)|@import\s+[\"']([^\"']+)")
_SCRIPT_FETCHES = re.compile(
    r"(?:fetch|import|importScripts|open|Worker|EventSource|WebSocket|sendBeacon)\s*\([^)]{0,80}?[\"'`](?:(?:https?|wss?):)?//"
    r"|\.(?:src|href|action)\s*=\s*[\"'`](?:https?:)?//"
)


@dataclass
class Page(HTMLParser):
    """One page: its resources that a browser loads, and its links."""

    path: Path
    resources: list[str] = field(default_factory=list)
    clicks: list[str] = field(default_factory=list)
    """Targets of links in the article. The sidebar does not count, because it lists all pages."""
    words: list[str] = field(default_factory=list)
    """Text of the article."""
    styles: list[str] = field(default_factory=list)
    _article: int = 0
    _inside: str = ""

    def __post_init__(self) -> None:
        super().__init__()
        self.feed(self.path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in attrs}
        for name in _RESOURCES.get(tag, ()):
            self.resources += [part.split()[0] for part in attributes.get(name, "").split(",") if part.strip()]
        if tag == "link" and _LINKED & set(attributes.get("rel", "").split()):
            self.resources.append(attributes.get("href", ""))
        if "style" in attributes:
            self.styles.append(attributes["style"])
        if tag in ("script", "style"):
            self._inside = tag
        self._article += tag == "article"
        if tag == "a" and self._article:
            self.clicks.append(attributes.get("href", ""))

    def handle_endtag(self, tag: str) -> None:
        self._article -= tag == "article"
        self._inside = ""

    def handle_data(self, data: str) -> None:
        if self._inside == "style":
            self.styles.append(data)
        elif self._article and not self._inside:
            self.words.append(data)

    @property
    def text(self) -> str:
        """Text of the article, with single spaces."""
        return " ".join("".join(self.words).split())


def findings(site: Path) -> list[str]:
    """Return all faults of a built site, one sentence each."""
    pages = {path: Page(path) for path in sorted(site.rglob("*.html"))}
    wrong = foreign_resources(site, pages)
    if (size := landing_bytes(site)) > MOST_LANDING_BYTES:
        wrong.append(f"{LANDING}: {size} bytes at first sight; at most {MOST_LANDING_BYTES} are allowed")
    for question, clicks in answers(site, pages).items():
        if clicks is None:
            wrong.append(f"{question} No page has the answer, or no link leads there")
        elif clicks > MOST_CLICKS:
            wrong.append(f"{question} The answer is {clicks} clicks away; at most {MOST_CLICKS} are allowed")
    return wrong


def foreign_resources(site: Path, pages: dict[Path, Page]) -> list[str]:
    """Return resources that a browser would load from another host, with the file that names each."""
    foreign = []
    for path, page in pages.items():
        targets = [*page.resources, *(target for style in page.styles for target in _style_targets(style))]
        foreign += [(path, target) for target in targets if _HOST.match(target)]
    for path in sorted(site.rglob("*.css")):
        foreign += [(path, target) for target in _style_targets(path.read_text()) if _HOST.match(target)]
    for path in [*pages, *sorted(site.rglob("*.js")), *sorted(site.rglob("*.svg"))]:
        text = path.read_text(encoding="utf-8")
        if path.suffix != ".html":
            foreign += [(path, match[0]) for match in _SCRIPT_FETCHES.finditer(text)]
    return [f"{path.relative_to(site)}: fetches {target} from another host" for path, target in foreign]


def landing_bytes(site: Path) -> int:
    """Return the bytes that a browser loads for the landing page: the page, its scripts, styles and pictures."""
    page = site / LANDING
    files = {page}
    waiting = [_file(page, target) for target in Page(page).resources]
    while waiting:
        path = waiting.pop()
        if path in files or not path.is_file():
            continue
        files.add(path)
        if path.suffix == ".css":
            waiting += [_file(path, target) for target in _style_targets(path.read_text())]
    return sum(path.stat().st_size for path in files)


def answers(site: Path, pages: dict[Path, Page]) -> dict[str, int | None]:
    """Return the number of clicks from the landing page to the answer of each question; None if it cannot be
    reached."""
    away = {site / LANDING: 0}
    waiting = [site / LANDING]
    for path in waiting:
        for target in pages[path].clicks:
            file = _file(path, target)
            if not _HOST.match(target) and file in pages and file not in away:
                away[file] = away[path] + 1
                waiting.append(file)
    return {
        question: min((away[path] for path in away if re.search(answer, pages[path].text)), default=None)
        for question, answer in QUESTIONS.items()
    }


def _style_targets(style: str) -> list[str]:
    return [quoted or bare for quoted, bare in _STYLE_FETCHES.findall(style)]


def _file(page: Path, target: str) -> Path:
    """Return the file on the disk to which a link on a page leads."""
    name = unquote(re.split(r"[?#]", target)[0])
    return Path(os.path.normpath(page.parent / name)) if name else page
