"""Small parts that several screens use."""

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
    """Build a button with one of the four looks; `name` is its `data-name` in the page."""
    element = ui.button(words, icon=icon, on_click=on_click, color=None)
    return with_name(element.classes(f"b-{kind}").props("unelevated no-caps"), name)


def with_name(element: E, name: str) -> E:
    """Return the element, with a `data-name` in the page."""
    element._props["data-name"] = name
    return element


def with_label(element: E, words: str) -> E:
    """Return the element, with words for a screen reader. Words of people must not go through `props`, which would
    read them as further properties."""
    element._props["aria-label"] = words
    return element


def panel(title: str = "") -> ui.column:
    """Build a box with a title."""
    box = ui.column().classes("panel")
    if title:
        with box:
            heading(title)
    return box


def heading(words: str) -> None:
    ui.html(f"<h2>{html.escape(words)}</h2>", sanitize=False)


def facts(rows: Mapping[str, str]) -> ui.html:
    """Build a list of names and values."""
    return ui.html(facts_html(rows), sanitize=False).style("width:100%")


def facts_html(rows: Mapping[str, str]) -> str:
    inner = "".join(f"<dt>{html.escape(name)}</dt><dd>{html.escape(value)}</dd>" for name, value in rows.items())
    return f'<dl class="facts">{inner}</dl>'


def table_html(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a plain table of text; a cell may have a class: `bad|words`."""

    def cell(words: str) -> str:
        kind, mark, rest = words.partition("|")
        if mark and kind in ("bad", "good", "warm"):
            return f'<td class="{kind}">{html.escape(rest)}</td>'
        return f"<td>{html.escape(words)}</td>"

    heads = "".join(f'<th scope="col">{html.escape(title)}</th>' for title in head)
    body = "".join(f"<tr>{''.join(map(cell, row))}</tr>" for row in rows)
    return (
        '<div class="wide" tabindex="0" role="region" aria-label="table"><table class="plain">'
        f"<thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def picture_address(run: str, shot: str, width_px: int, *, saturation: bool = False) -> str:
    """Return the address of a shot's picture."""
    saturation_query = "&saturation=true" if saturation else ""
    return f"/api/v1/runs/{quote(run)}/picture?shot={quote(shot, safe='')}&width={width_px}{saturation_query}"


def histogram_svg(histograms: Mapping[str, Sequence[int]]) -> str:
    """Return a histogram with a line for each channel, over `BINS` steps from 0 to full scale; counts are
    logarithmic."""
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


def clipping_words(saturated_shares: Mapping[str, float]) -> dict[str, str]:
    """Return the share of pixels at full scale of each channel, in words."""
    return {f"{name} clipped": f"{share:.3%}" if share else "none" for name, share in saturated_shares.items()}


async def sure(title: str, words: str, yes: str) -> bool:
    """Ask for confirmation of an action that cannot be undone or takes long."""
    with with_label(ui.dialog(), title) as dialog, ui.column().classes("panel ask"):
        heading(title)
        ui.label(words)
        with ui.row():
            button(yes, lambda: dialog.submit(True), name="yes", kind="main")
            button("Cancel", lambda: dialog.submit(False), name="cancel")
    answer = await dialog
    dialog.delete()
    return bool(answer)


def link(words: str, target: str, *, name: str, new_tab: bool = True) -> ui.link:
    """Build a link to a page of this console."""
    return with_name(ui.link(words, target, new_tab=new_tab), name)


def moment(t: str) -> str:
    """Return a time (UTC, ISO 8601) for people: `2026-11-23 15:04`."""
    return t[:16].replace("T", " ")


class Choice:
    """Choice of one of several values by the browser's own list, which works by keyboard, finger and screen
    reader."""

    def __init__(
        self,
        words: str,
        options: Mapping[str, str],
        on_change: Callable[[], object] = lambda: None,
        *,
        name: str,
        value: str = "",
    ) -> None:
        """`options` has the words of each value. `value` is chosen, or else the first; `name` is its `data-name`
        in the page."""
        self._words, self._name, self._on_change = words, name, on_change
        self._options, self.value = dict(options), value or next(iter(options), "")
        self._box = ui.html("", sanitize=False).classes("choice")
        self._box.on("change", self._take_change, js_handler="(e) => emit(e.target.value)")
        self.set_options(options, self.value)

    def set_options(self, options: Mapping[str, str], value: str = "") -> None:
        """Set other options without calling `on_change`."""
        self._options, self.value = dict(options), value or next(iter(options), "")
        inner = "".join(
            f'<option value="{html.escape(key)}"{" selected" if key == self.value else ""}>{html.escape(words)}'
            "</option>"
            for key, words in self._options.items()
        )
        words = html.escape(self._words)
        self._box.set_content(
            f'<label><span>{words}</span><select data-name="{self._name}">{inner}</select></label>'
        )

    @property
    def options(self) -> Mapping[str, str]:
        """The words of each value."""
        return self._options

    def set_visibility(self, visible: bool) -> None:
        self._box.set_visibility(visible)

    def _take_change(self, event: events.GenericEventArguments) -> object:
        if event.args not in self._options:
            return None
        self.value = str(event.args)
        return self._on_change()


def count(number: int, noun: str) -> str:
    """Return a number with its noun: `1 day`, `2 days`."""
    return f"{number:,} {noun}" if number == 1 else f"{number:,} {noun}s"
