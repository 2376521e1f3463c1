"""Parts of the pages that stay: HTML that reads well on a telephone, in the dark and aloud."""

from __future__ import annotations

import base64
import html
from collections.abc import Iterable, Mapping, Sequence
from importlib import resources


def text(value: object) -> str:
    """A value as HTML text."""
    return html.escape(str(value))


def page(title: str, body: str) -> str:
    """A whole page in one file: no script, nothing from elsewhere."""
    style = resources.files("coupole.viewing").joinpath("report.css").read_text(encoding="utf-8")
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width,initial-scale=1">'
        f"<title>{text(title)}</title><style>{style}</style></head>"
        f"<body>{body}</body></html>\n"
    )


def section(name: str, heading: str, body: str) -> str:
    """A part of the page that links may lead to, as `#name`; nothing without a body."""
    return f'<section id="{name}"><h2>{heading}</h2>{body}</section>' if body else ""


def facts(rows: Mapping[str, str]) -> str:
    """A list of names with HTML values; those without a value are left out."""
    return "<dl>" + "".join(f"<dt>{name}</dt><dd>{value}</dd>" for name, value in rows.items() if value) + "</dl>"


def table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table of HTML cells, the first of each row its heading; it scrolls by itself where it is too wide. Nothing
    without rows."""
    lines = "".join(
        f'<tr><th scope="row">{row[0]}</th>{"".join(f"<td>{cell}</td>" for cell in row[1:])}</tr>' for row in rows
    )
    heads = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    if not lines:
        return ""
    return (
        f'<div class="wide" role="region" tabindex="0" aria-label="{text(caption)}"><table>'
        f"<caption>{text(caption)}</caption><thead><tr>{heads}</tr></thead><tbody>{lines}</tbody></table></div>"
    )


def picture(kind: str, data: bytes, alternative: str) -> str:
    """An image of the page itself; `kind` is `png` or `jpeg`."""
    content = base64.b64encode(data).decode()
    return f'<img src="data:image/{kind};base64,{content}" alt="{text(alternative)}">'


def moment(utc: str) -> str:
    """A time of the journal, to the second; the whole of it for programs."""
    if not utc:
        return ""
    return f'<time datetime="{text(utc)}">{text(utc[:19].replace("T", " "))}</time>'


def link(path: str, words: str = "") -> str:
    """Return a link to a file beside the page."""
    return f'<a href="{text(path)}">{text(words or path)}</a>'


def anchor(name: str) -> str:
    """A name for links inside the page, from any text."""
    return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in name)
