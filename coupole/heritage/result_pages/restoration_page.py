"""`report.html` of a restoration: hypotheses side by side, their sources, materials and differences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from coupole.pages.page_parts import Cited, Code, Inline, Link, Page, Picture, Section, Table, anchor
from coupole.pages.page_rendering import render

REPORT = "report.html"
_MOST_VIEWS = 4
"""Largest number of embedded views; for further views the files are named."""


def write(result: Mapping[str, Any], folder: Path) -> None:
    """Write the page of a `result.json` beside it; the page contains its pictures. Raises OSError."""
    views = result["views"][:_MOST_VIEWS]
    title = f"{result['restoration']}: {len(result['hypotheses'])} hypotheses"
    page = Page(
        title=title,
        pictures=_hypotheses(views[0], result, folder) if views else [],
        summary="Each picture shows a hypothesis: what this object may have looked like if its sources are right. "
        "All are "
        "computed; none is a photograph.",
        quality=_quality(views),
        next_step=[
            "Weigh the ",
            Link(f"#{_name(result['hypotheses'][0])}", "sources"),
            ", not at the pictures: the sources decide.",
        ],
        sections=[
            *(_view(view, result, folder, is_first=view is views[0]) for view in views),
            *map(_hypothesis, result["hypotheses"]),
            _parts(result),
            _files(result),
        ],
    )
    (folder / REPORT).write_text(render(page), encoding="utf-8")


def _quality(views: Sequence[Mapping[str, Any]]) -> str:
    """Return a sentence about the largest difference between the hypotheses."""
    apart = [
        (of["de00_of_means"], part, entry["hypotheses"])
        for view in views
        for entry in view["differences"]
        for part, of in entry["parts"].items()
    ]
    if not apart:
        return "There is one hypothesis, and nothing to compare it with."
    most, part, names = max(apart, key=lambda difference: float(difference[0]))
    apart_words = f"the mean colours of {' and '.join(names)} differ by dE00 {most:.1f}"
    return f"They differ most in the part {part}: {apart_words}."


def _hypotheses(view: Mapping[str, Any], result: Mapping[str, Any], folder: Path) -> list[Picture]:
    titles = {entry["name"]: entry["title"] for entry in result["hypotheses"]}
    return [
        _picture(folder / entry["png"], f"Hypothesis {name}: {titles[name]}")
        for name, entry in view["pictures"].items()
    ]


def _picture(path: Path, title: str) -> Picture:
    return Picture(title, path.read_bytes())


def _view(view: Mapping[str, Any], result: Mapping[str, Any], folder: Path, *, is_first: bool) -> Section:
    """Return the pictures of a view and the differences between hypotheses in it. The pictures of the first view
    are at the top of the page."""
    name = anchor(f"view-{view['view']}")
    head = ("part", "mean dE00", "dE00 of mean colours", "pixels")
    pairs = []
    for number, entry in enumerate(view["differences"]):
        names = " and ".join(entry["hypotheses"])
        rows = [
            (part, f"{of['mean_de00']:.1f}", f"{of['de00_of_means']:.1f}", f"{of['pixels']:,}")
            for part, of in entry["parts"].items()
        ]
        pairs.append(
            Section(
                f"{name}-{number}",
                names,
                figures=[_picture(folder / entry["png"], f"Colour difference of hypotheses {names}, CIEDE2000")],
                tables=[Table(f"How far {names} are apart in this view", head, rows)],
            )
        )
    figures = [] if is_first else _hypotheses(view, result, folder)
    return Section(name, f"View {view['view']}", figures=figures, sections=pairs)


def _name(hypothesis: Mapping[str, Any]) -> str:
    return anchor(f"hypothesis-{hypothesis['name']}")


def _hypothesis(hypothesis: Mapping[str, Any]) -> Section:
    sources: list[Inline] = [
        [f"{source['says']} ", Cited(source["reference"])] for source in hypothesis["sources"]
    ]
    rows = [(part, Code(flat(material))) for part, material in hypothesis["materials"].items()]
    return Section(
        _name(hypothesis),
        f"Hypothesis {hypothesis['name']}",
        words=[hypothesis["title"]],
        items=sources,
        tables=[Table("Materials", ("part", "material"), rows)],
    )


def flat(material: Any) -> str:
    """Return a material as readable text: `kind` first, then its given values, with `{...}` around parts."""
    if isinstance(material, Mapping):
        kind = [str(material["kind"])] if "kind" in material else []
        rest = [f"{key} {flat(value)}" for key, value in material.items() if key != "kind" and value is not None]
        return ", ".join(kind + rest) if kind and not rest else "{" + ", ".join(kind + rest) + "}"
    if isinstance(material, Sequence) and not isinstance(material, str):
        return "[" + ", ".join(flat(part) for part in material) + "]"
    return f"{material:g}" if isinstance(material, float) else str(material)


def _parts(result: Mapping[str, Any]) -> Section:
    rows = [(name, f"{count:,}") for name, count in result["parts"].items()]
    remarks = [f"{remark}." for remark in result["remarks"]]
    return Section("parts", "Parts", items=remarks, tables=[Table("Triangles", ("part", "triangles"), rows)])


def _lights(result: Mapping[str, Any]) -> str:
    return f"Lights: {result['lights']}. " if result["lights"] else ""


def scene_uses(result: Mapping[str, Any]) -> str:
    """Return the commands that take a hypothesis as a scene. A page has no near lights, such as candles."""
    if result["lights"] is None:
        return "coupole show and coupole render"
    return "coupole render, and for coupole show if its lights are far away"


def _files(result: Mapping[str, Any]) -> Section:
    rows: list[Sequence[Inline]] = [(Link("result.json"), "all figures")]
    for hypothesis in result["hypotheses"]:
        scene = f"{hypothesis['name']}/scene.yaml"
        rows.append((Link(scene), f"hypothesis {hypothesis['name']} as a scene, for {scene_uses(result)}"))
    for view in result["views"]:
        if view["side_by_side"]:
            rows.append((Link(view["side_by_side"]), f"view {view['view']}, all hypotheses"))
        for name, paths in view["pictures"].items():
            words = f"hypothesis {name}, view {view['view']}: for the eye, and radiance by band"
            rows.append(([Link(paths["png"]), ", ", Link(paths["exr"])], words))
    note = (
        f"{_lights(result)}{result['bands']} bands, {result['observer']}; "
        f"white is {result['white_cd_m2']:.4g} cd/m2 in all "
        "pictures. "
        "Mean dE00 is over the pixels of a part, and includes the noise of the pictures; dE00 of mean colours "
        "does not include it."
    )
    return Section("files", "Files", tables=[Table("Files", ("file", "holds"), rows)], notes=[note])
