"""Normals, materials and their uncertainty, as they grow while a run goes on."""

from __future__ import annotations

import html
import math
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import quote

from nicegui import ui

from coupole.console.screens.parts import Choice, count, link, panel, with_name
from coupole.console.screens.visit import Visit, in_thread
from coupole.pages.palettes import gradient
from coupole.storage.growing_pictures import Growing, PictureShown, ViewPictures, file_so_far
from coupole.storage.processing import Processing, go_on_command
from coupole.storage.so_far import LINK, REPORT

_MISSING = "This picture is missing, or not complete. A new one comes after the next view."
_NO_PICTURES = "There are no pictures yet. The first ones come when all frames of a view are there."
_NO_PAGE = "The page to relight comes with the first result so far."
_NEWEST = ""
"""Choice of the view that was drawn last."""
_SCRIPT = """<script>document.addEventListener('error', ({target}) => {
  const words = target.dataset && target.dataset.missing;
  const sentence = Object.assign(document.createElement('p'), {className: 'hint', textContent: words});
  if (words) target.replaceWith(sentence);
}, true)</script>"""
"""Shows words in place of a picture that does not load."""


@dataclass(frozen=True)
class _Files:
    """Files that are there now."""

    pictures: frozenset[str]
    has_page: bool
    has_report: bool


class GrowingPanel:
    """The panel. It is hidden while there is no processing beside the run."""

    def __init__(self, visit: Visit, run: str) -> None:
        """`run` is the name of a run that is not acquired now; empty for the run that is acquired."""
        self._is_acquired = not run
        self._visit, self._run = visit, run
        self._now: tuple[Processing, Growing] | None = None
        self._shown: object = None
        ui.add_body_html(_SCRIPT)
        self._panel = with_name(panel("Normals and materials so far"), "growing")
        with self._panel:
            self._state = with_name(ui.label().classes("words").props("role=status"), "beside")
            self._detail = with_name(ui.label().classes("hint"), "beside-detail")
            self._undrawn = with_name(ui.label().classes("small warm"), "undrawn")
            self._view = Choice("view", {_NEWEST: "the newest"}, self._choose, name="growing-view")
            self._basis = with_name(ui.label().classes("hint"), "basis")
            self._pictures = with_name(ui.html("", sanitize=False).style("width:100%"), "growing-pictures")
            self._remark = with_name(ui.label().classes("hint"), "growing-remark")
            self._links = with_name(ui.row().classes("links"), "growing-links")
        self._panel.set_visibility(False)

    def hide(self) -> None:
        """Hide the panel: there is no run."""
        self._panel.set_visibility(False)

    async def show(self, run: str, processing: Processing | None, growing: Growing) -> None:
        """Show the present state. Pictures are loaded again only if they have changed."""
        self._run = run
        self._now = None if processing is None else (processing, growing)
        await self._choose()

    async def _choose(self) -> None:
        self._panel.set_visibility(self._now is not None)
        if self._now is None:
            return
        processing, growing = self._now
        words, kind = state_in_words(
            self._visit.service.runs.folder / self._run, processing, is_acquired=self._is_acquired
        )
        self._state.set_text(words)
        self._state.classes(add=kind, remove=" ".join({"bad", "warm", "good"} - {kind}))
        self._detail.set_text(processing.detail if processing.is_at_work else "")
        self._undrawn.set_text(f"Not drawn: {processing.undrawn}")
        self._undrawn.set_visibility(bool(processing.undrawn))
        names = {view.view: view.view for view in growing.of_views}
        if list(names) != list(self._view.options)[1:]:
            choice = self._view.value if self._view.value in names else _NEWEST
            self._view.set_options({_NEWEST: "the newest", **names}, choice)
        self._view.set_visibility(len(names) > 1)
        view_pictures = next(
            (view for view in growing.of_views if view.view == self._view.value),
            growing.of_views[-1] if growing.of_views else None,
        )
        files = await in_thread(_find, Path(processing.result), growing, view_pictures)
        self._draw(processing, growing, view_pictures, files)

    def _draw(
        self, processing: Processing, growing: Growing, view_pictures: ViewPictures | None, files: _Files
    ) -> None:
        state_key = (
            self._run,
            view_pictures,
            files,
            growing.page,
            processing.undrawn,
            processing.is_at_work,
            processing.fitted_views,
            processing.state == "done",
        )
        if state_key == self._shown:
            return
        self._shown = state_key
        if view_pictures is None:
            self._basis.set_text("" if processing.state == "done" else _NO_PICTURES)
            self._pictures.set_content("")
        else:
            self._basis.set_text(basis_in_words(view_pictures, is_simulated=growing.is_simulated))
            figures = "".join(
                _figure(self._run, view_pictures.view, picture, is_there=picture.file in files.pictures)
                for picture in view_pictures.pictures
            )
            self._pictures.set_content(f'<div class="value-pictures">{figures}</div>')
        self._remark.set_text(view_pictures.remark if view_pictures else "")
        self._links.clear()
        with self._links:
            address = f"/api/v1/runs/{quote(self._run)}"
            if growing.page is not None and files.has_page:
                of = f"{growing.page.fitted_views} of {growing.page.views} views"
                link(f"Open the page to relight ({of})", f"{address}/relight-so-far", name="relight-so-far")
            elif processing.is_at_work and self._is_acquired and not processing.undrawn:
                ui.label(_NO_PAGE).classes("hint")
            if files.has_report:
                of = f" ({processing.fitted_views} of {processing.views} views)" if processing.fitted_views else ""
                link(f"Report of the result so far{of}", f"{address}/so-far", name="so-far")


def state_in_words(run: Path, processing: Processing, *, is_acquired: bool) -> tuple[str, str]:
    """Return the state of the process beside the run in a sentence, and the kind of this message. `is_acquired` is
    True while frames come."""
    views = f"{processing.views_done} of {count(processing.views, 'view')} extracted"
    if processing.is_at_work and processing.why:
        return f"The processing stands still: {processing.why}. {views}.", "warm"
    match processing.state:
        case "waiting":
            if not processing.views:
                return "The processing begins.", ""
            return f"The processing waits for the next complete view; {views}.", ""
        case "extracting":
            return f"The processing takes the samples of a complete view; {views}.", ""
        case "growing":
            return f"The processing fits the views so far; {views}.", ""
        case "fitting":
            return "All frames are there. The processing makes the final result.", ""
        case "done":
            return f"The result is complete: {processing.result}", "good"
        case "failed" | "ended":
            outcome = "has ended" if processing.state == "ended" else "failed"
            sentence = f"The processing {outcome}: {processing.why}. {views}."
            if processing.remedy:
                return f"{sentence} This continues: {processing.remedy}", "bad"
            if not is_acquired:
                return f"{sentence} Resume the run: it continues with these views.", "warm"
            command = go_on_command(run, Path(processing.result))
            return (
                f"{sentence} No frame is lost by this, and the run goes on without it. When all frames are there, "
                f"this continues: {command}"
            ), "bad"


def basis_in_words(view_pictures: ViewPictures, *, is_simulated: bool) -> str:
    """Say on which data pictures rest, and when they were drawn."""
    of_arrived = (
        f" of the {view_pictures.arrived_frames} that have arrived" if view_pictures.arrived_frames else ""
    )
    frames = (
        f"{count(view_pictures.frames, 'frame')}{of_arrived}; "
        f"{count(view_pictures.triangles, 'triangle')} in this view"
    )
    how = (
        f"first look by a quick fit to this view alone ({frames}); light from other surfaces is still in it"
        if view_pictures.kind == "first-look"
        else f"result of {view_pictures.fitted_views} of {count(view_pictures.views, 'view')} so far ({frames})"
    )
    words = f"View {view_pictures.view}: {how}. Drawn at {view_pictures.t[11:19]} UTC."
    return f"{words} The data are simulated." if is_simulated else words


def _find(result: Path, growing: Growing, view_pictures: ViewPictures | None) -> _Files:
    pictures = view_pictures.pictures if view_pictures else ()
    return _Files(
        frozenset(picture.file for picture in pictures if file_so_far(result, picture.file)),
        growing.page is not None and file_so_far(result, growing.page.file) is not None,
        (result / LINK / REPORT).is_file(),
    )


def _figure(run: str, view: str, picture: PictureShown, *, is_there: bool) -> str:
    title, scale = html.escape(picture.title), html.escape(_scale_in_words(picture))
    image = f'<p class="hint">{_MISSING}</p>'
    if is_there:
        address = f"/api/v1/runs/{quote(run)}/pictures-so-far/{picture.file}"
        image = (
            f'<img src="{address}" width="{picture.width_px}" height="{picture.height_px}" '
            f'data-missing="{_MISSING}" alt="{title} in view {html.escape(view)}: {scale}">'
        )
    bar = f'<p class="small">{scale}</p>'
    if picture.palette:
        median = "" if picture.median is None else f'<p class="small">median {_number(picture)}</p>'
        ends = f"{picture.low:g}", f"{picture.high:g} {picture.unit}{' or more' if picture.is_cut else ''}"
        bar = (
            f'<div class="scale" aria-hidden="true"><span>{ends[0]}</span>'
            f'<i style="background:{gradient(picture.palette)}"></i>'
            f"<span>{html.escape(ends[1].strip())}</span></div>{median}"
        )
    return f"<figure><figcaption>{title}</figcaption>{image}{bar}</figure>"


def _scale_in_words(picture: PictureShown) -> str:
    unit = f" {picture.unit}" if picture.unit else ""
    if picture.palette:
        median = "" if picture.median is None else f", median {_number(picture)}"
        return f"colours from {picture.low:g} to {picture.high:g}{unit}{median}"
    if picture.names == ("red", "green", "blue"):
        share = f", a reflectance of {math.pi * picture.high:.0%}" if picture.unit == "1/sr" else ""
        return f"white is {picture.high:.3g}{unit}{share}; shades follow a power of {picture.gamma:g}"
    names = ", ".join(picture.names)
    return f"red, green, blue are {names} from {picture.low:g} to {picture.high:g}{unit}; z is up from the support"


def _number(picture: PictureShown) -> str:
    return f"{picture.median:.2g} {picture.unit}".strip()
