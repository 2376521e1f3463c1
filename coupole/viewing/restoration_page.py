"""`report.html` of a restoration: hypotheses side by side, sources, materials, and how they differ."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coupole.viewing.page_parts import anchor, facts, link, page, picture, section, table, text

REPORT = "report.html"
_MOST_VIEWS = 4
"""Embedded; of more the files are named."""


def write(result: Mapping[str, Any], folder: Path) -> None:
    """Write the page of a `result.json` beside it; its pictures are inside. Raises OSError."""
    title = f"{result['restoration']}: {len(result['hypotheses'])} hypotheses"
    note = (
        "<p>Each picture shows a <strong>hypothesis</strong>: what this object may have looked like if its "
        "sources are right. All are computed; none is a photograph.</p>"
    )
    body = f"<h1>{text(title)}</h1>{note}"
    for view in result["views"][:_MOST_VIEWS]:
        body += section(anchor(f"view-{view['view']}"), f"View {text(view['view'])}", _view(view, result, folder))
    for hypothesis in result["hypotheses"]:
        name = anchor(f"hypothesis-{hypothesis['name']}")
        body += section(name, f"Hypothesis {text(hypothesis['name'])}", _hypothesis(hypothesis))
    body += section("parts", "Parts", _parts(result))
    body += section("files", "Files", _files(result))
    (folder / REPORT).write_text(page(title, body), encoding="utf-8")


def _view(view: Mapping[str, Any], result: Mapping[str, Any], folder: Path) -> str:
    titles = {entry["name"]: entry["title"] for entry in result["hypotheses"]}
    figures = [
        _figure(folder / entry["png"], f"Hypothesis {name}: {titles[name]}")
        for name, entry in view["pictures"].items()
    ]
    body = f'<div class="beside">{"".join(figures)}</div>'
    for entry in view["differences"]:
        names = " and ".join(entry["hypotheses"])
        body += f"<h3>{text(names)}</h3>"
        body += _figure(folder / entry["png"], f"Colour difference of hypotheses {names}, CIEDE2000")
        rows = [
            (text(part), f"{of['mean_de00']:.1f}", f"{of['de00_of_means']:.1f}", f"{of['pixels']:,}")
            for part, of in entry["parts"].items()
        ]
        head = ("part", "mean dE00", "dE00 of mean colours", "pixels")
        body += table(f"How far {names} are apart in this view", head, rows)
    return body


def _figure(path: Path, caption: str) -> str:
    image = picture("png", path.read_bytes(), caption)
    return f"<figure>{image}<figcaption>{text(caption)}.</figcaption></figure>"


def _hypothesis(hypothesis: Mapping[str, Any]) -> str:
    sources = "".join(
        f"<li>{text(source['says'])} <cite>{text(source['reference'])}</cite></li>"
        for source in hypothesis["sources"]
    )
    rows = [
        (text(part), f"<code>{text(flat(material))}</code>") for part, material in hypothesis["materials"].items()
    ]
    body = f"<p>{text(hypothesis['title'])}</p><h3>Sources</h3><ul>{sources}</ul>"
    return body + table("Materials", ("part", "material"), rows)


def flat(material: Any) -> str:
    """A material as one reads it: `kind` first, then what it is given, `{...}` around parts."""
    if isinstance(material, Mapping):
        kind = [str(material["kind"])] if "kind" in material else []
        rest = [f"{key} {flat(value)}" for key, value in material.items() if key != "kind" and value is not None]
        return ", ".join(kind + rest) if kind and not rest else "{" + ", ".join(kind + rest) + "}"
    if isinstance(material, Sequence) and not isinstance(material, str):
        return "[" + ", ".join(flat(part) for part in material) + "]"
    return f"{material:g}" if isinstance(material, float) else str(material)


def _parts(result: Mapping[str, Any]) -> str:
    rows = [(text(name), f"{count:,}") for name, count in result["parts"].items()]
    remarks = "".join(f"<li>{text(remark)}.</li>" for remark in result["remarks"])
    return table("Triangles", ("part", "triangles"), rows) + (f"<ul>{remarks}</ul>" if remarks else "")


def _files(result: Mapping[str, Any]) -> str:
    rows = {link("result.json"): "all figures"}
    for view in result["views"]:
        if view["side_by_side"]:
            rows[link(view["side_by_side"])] = f"view {text(view['view'])}, all hypotheses"
        for name, paths in view["pictures"].items():
            rows[f"{link(paths['png'])}, {link(paths['exr'])}"] = (
                f"hypothesis {text(name)}, view {text(view['view'])}: for the eye, and radiance by band"
            )
    return facts(rows) + (
        f'<p class="note">{result["bands"]} bands, {text(result["observer"])}; white is '
        f"{result['white_cd_m2']:.4g} cd/m2 in all pictures. Mean dE00 is over the pixels of a part, to which "
        "noise of the pictures adds; that of mean colours has no such noise.</p>"
    )
