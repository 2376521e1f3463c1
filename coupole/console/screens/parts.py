"""Small pieces that several screens are made of."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, TypeVar
from urllib.parse import quote

from nicegui import events, ui

from coupole.viewing.raw_preview import BINS

E = TypeVar("E", bound=ui.element)
_INKS = {"R": "#d0342c", "G1": "#2c8a3d", "G2": "#7ab648", "B": "#2f6fd0", "Y": "#777777"}


def button(
    words: str,
    on_click: Callable[..., object],
    *,
    name: str,
    icon: str | None = None,
    kind: Literal["main", "quiet", "flat", "stop"] = "quiet",
) -> ui.button:
    """Of one of the four looks; `name` is its `data-name` in the page."""
    made = ui.button(words, icon=icon, on_click=on_click, color=None)
    return made.classes(f"b-{kind}").props(f"unelevated no-caps data-name={name}")


def named(element: E, name: str) -> E:
    """The element, with a `data-name` in the page."""
    return element.props(f"data-name={name}")


class Choice:
    """One of several, as a list to choose from: the browser's own, which keyboards and screen readers know."""

    def __init__(self, label: str, name: str, on_change: Callable[[], object] = lambda: None) -> None:
        self.value = ""
        self._options: dict[str, str] = {}
        self._on_change = on_change
        with ui.element("label").classes("choice"):
            ui.label(label)
            self._select = named(ui.html("", sanitize=False, tag="select"), name)
        self._select.on("change", self._changed, js_handler="event => emit(event.target.value)")

    def offer(self, options: Mapping[str, str], value: str) -> None:
        """Values with their words; `value` is chosen (nobody is told)."""
        self._options, self.value = dict(options), value
        self._draw()

    def choose(self, value: str) -> None:
        """Nobody is told."""
        self.value = value
        self._draw()

    def _draw(self) -> None:
        self._select.set_content(
            "".join(
                f'<option value="{html.escape(value)}"{" selected" * (value == self.value)}>{html.escape(words)}'
                "</option>"
                for value, words in self._options.items()
            )
        )

    def _changed(self, event: events.GenericEventArguments) -> object:
        self.value = str(event.args)
        self._draw()
        return self._on_change()


def panel(title: str = "") -> ui.column:
    """A box for one thing."""
    box = ui.column().classes("panel")
    if title:
        with box:
            heading(title)
    return box


def heading(words: str) -> None:
    ui.html(f"<h2>{html.escape(words)}</h2>", sanitize=False)


def facts(rows: Mapping[str, str]) -> ui.html:
    """Names and values."""
    return ui.html(facts_html(rows), sanitize=False).style("width:100%")


def facts_html(rows: Mapping[str, str]) -> str:
    inner = "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in rows.items())
    return f'<dl class="facts">{inner}</dl>'


def table_html(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A plain table of text; a cell may be of a class: `bad|words`."""

    def cell(words: str) -> str:
        kind, mark, rest = words.partition("|")
        if mark and kind in ("bad", "good", "warm"):
            return f'<td class="{kind}">{html.escape(rest)}</td>'
        return f"<td>{html.escape(words)}</td>"

    heads = "".join(f'<th scope="col">{html.escape(one)}</th>' for one in head)
    body = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return (
        '<div class="wide" tabindex="0" role="region" aria-label="table"><table class="plain">'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def picture_address(run: str, shot: str, width_px: int, *, saturation: bool = False) -> str:
    """Where the interface serves a shot's picture."""
    marked = "&saturation=true" if saturation else ""
    return f"/api/v1/runs/{quote(run)}/picture?shot={quote(shot, safe='')}&width={width_px}{marked}"


def histogram_svg(histograms: Mapping[str, Sequence[int]]) -> str:
    """Lines by channel over `BINS` steps from 0 to full scale; counts by their logarithm."""
    import math

    most = math.log1p(max((max(counts) for counts in histograms.values()), default=1) or 1)
    lines = []
    for name, counts in histograms.items():
        points = " ".join(
            f"{100 * k / (BINS - 1):.1f},{40 * (1 - math.log1p(count) / most):.1f}"
            for k, count in enumerate(counts)
        )
        lines.append(
            f'<polyline points="{points}" fill="none" stroke="{_INKS.get(name, "#777")}" stroke-width="1" '
            'vector-effect="non-scaling-stroke"/>'
        )
    return (
        '<svg viewBox="0 0 100 40" preserveAspectRatio="none" role="img" style="width:100%;height:110px" '
        f'aria-label="histogram of {", ".join(histograms)} from black to full scale, logarithmic">'
        '<line x1="0" y1="40" x2="100" y2="40" stroke="currentColor" stroke-width=".3"/>'
        f"{''.join(lines)}</svg>"
    )


def clipping_words(saturated: Mapping[str, float]) -> dict[str, str]:
    """Share of pixels at full scale by channel."""
    return {f"{name} clipped": f"{share:.3%}" if share else "none" for name, share in saturated.items()}
