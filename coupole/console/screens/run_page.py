"""One run: its facts, its frames on a contact sheet and on the dome, one large frame, and the events."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nicegui import events, ui

from coupole.console.routes.messages import NewEntry
from coupole.console.runs.event_words import words_of
from coupole.console.runs.frame_sheets import LedPlace, SheetFrame, led_places
from coupole.console.runs.run_files import RunRow
from coupole.console.screens.contact_sheet import ContactSheet
from coupole.console.screens.dome_picture import DomePicture
from coupole.console.screens.frame_viewer import FrameViewer
from coupole.console.screens.growing_panel import GrowingPanel
from coupole.console.screens.parts import (
    Choice,
    button,
    count,
    facts,
    facts_html,
    heading,
    moment,
    panel,
    table_html,
    with_name,
)
from coupole.console.screens.run_actions import RunActions
from coupole.console.screens.runs_screen import STATE_KINDS
from coupole.console.screens.task_list import TaskList
from coupole.console.screens.visit import Visit, enter, in_long_thread, in_thread
from coupole.console.service_parts import Service
from coupole.errors import CoupoleError
from coupole.storage import journal
from coupole.storage.growing_pictures import Growing, read_growing
from coupole.storage.run import Run
from coupole.storage.run_status import PAUSED, RUNNING, Status
from coupole.viewing.terminal import bytes_text, duration_text

_EVENTS_SHOWN, _LOOK_EVERY_S = 200, 2.0
_READ_UNASKED_BYTES = 2_000_000_000
"""Greatest total size of frames whose means are read without a request."""


@dataclass(frozen=True)
class _Known:
    """Data of a run that are read before it is shown."""

    run: Run
    row: RunRow
    status: Status
    places: dict[int, LedPlace]
    events: list[tuple[str, str]]
    growing: Growing
    """Pictures of a result that is not complete."""


def build(visit: Visit, name: str) -> None:
    """Build the page."""
    ui.link("← All runs", "/runs")
    waiting = ui.label("Reading the run …").classes("hint")
    box = ui.column().classes("gap").style("width:100%")

    async def fill() -> None:
        try:
            run_facts = await in_thread(_read_run, visit.service, name)
        except CoupoleError as error:
            waiting.set_text(str(error))
            return
        waiting.delete()
        with box:
            page = _Page(visit, run_facts)
        await page.choose()
        await page.show_growing()

    ui.timer(0.01, fill, once=True)


def _read_run(service: Service, name: str) -> _Known:
    run = service.runs.run(name)
    events = [(event.t, words) for event in journal.read_events(run.journal_path) if (words := words_of(event))]
    row = service.runs.row(name)
    run_status = service.runs.status(name)
    processing = run_status.processing
    growing = read_growing(Path(processing.result)) if processing else Growing()
    return _Known(run, row, run_status, led_places(service.sheets, name), events[::-1], growing)


class _Page:
    def __init__(self, visit: Visit, known_run: _Known) -> None:
        self._visit, self._known, self._name = visit, known_run, known_run.row.name
        self._row = known_run.row
        self._frames: list[SheetFrame] = []
        self._current = ""
        self._of_view: dict[str, list[SheetFrame]] = {}
        self._head()
        self._growing = GrowingPanel(visit, self._name)
        with panel():
            self._choosers()
        with ui.element("div").classes("columns"):
            with panel("Frame"):
                self._viewer = FrameViewer(visit, self._name, self._step)
            with panel("The dome, by mean signal"):
                self._dome = DomePicture(self._pick)
                self._means_words = ui.label("").classes("hint").props("role=status data-name=means")
                self._read_means = button("Read them", self._fill_means, name="read-means")
                self._read_means.set_visibility(False)
        with panel("Contact sheet"):
            self._sheet = ContactSheet(self._name, self._pick)
        self._foot()
        ui.keyboard(self._key, ignore=["input", "select", "textarea"])

    def _head(self) -> None:
        row, status = self._known.row, self._known.status
        with panel():
            with ui.row().classes("bar"):
                heading(row.name)
                ui.label(status.state).classes(f"chip {STATE_KINDS.get(status.state, '')}")
                if row.simulated:
                    ui.label("simulated").classes("chip simulated")
            self._facts = ui.html(facts_html(self._run_facts(row)), sanitize=False).classes("two-columns")
            self._facts.style("width:100%")
            ui.timer(_LOOK_EVERY_S, self._renew)
            RunActions(self._visit, row.name, can_resume=status.has_left, frames=row.proven)
            TaskList(self._visit, lambda task: task.words.endswith(f" {self._name}"), empty="", most=4)

    async def show_growing(self) -> None:
        """Show the pictures that the processing beside a stopped or killed run has made. While the run goes on,
        the screen of the run shows it.
        """
        if self._known.growing.of_views and self._known.status.state not in (RUNNING, PAUSED):
            await self._growing.show(self._name, self._known.status.processing, self._known.growing)

    async def _renew(self) -> None:
        """Show the changes that commands have made."""
        row = await in_thread(self._visit.service.runs.row, self._name)
        if row != self._row:
            self._row = row
            self._facts.set_content(facts_html(self._run_facts(row)))

    def _run_facts(self, row: RunRow) -> dict[str, str]:
        status = self._known.status
        missing_count, duration_s = row.frames - row.proven, sum(session.duration_s for session in status.sessions)
        return {
            "object": row.object or "not named",
            "begun": f"{moment(row.created)} UTC by {row.operator or 'nobody named'}",
            "took": f"{duration_text(duration_s)} in {count(len(status.sessions), 'session')}",
            "frames": f"{row.proven} of {row.frames} proven"
            + (f", {missing_count} are missing" if missing_count else ""),
            **({"views": status.views_in_words} if status.most_views is not None else {}),
            "taken again": f"{status.reshot} shots",
            "light on the object": f"{status.dose_lux_h:.3f} lux h",
            "size": bytes_text(row.bytes) + (", archived" if row.archived else ""),
            "verified": f"{moment(row.verified)} UTC" if row.verified else "not since the last change",
            **({"reflectance": status.processing.words} if status.processing else {}),
            **({"why it ended": status.reason} if status.reason and status.state != "done" else {}),
        }

    def _choosers(self) -> None:
        views = list(self._known.run.views)
        with ui.row().classes("bar"):
            self._view = Choice("view", {view: view for view in views}, self.choose, name="view")
            self._exposure = Choice("exposure", {"0": "-"}, self._choose_exposure, name="exposure")
            if self._visit.may_act:
                button("Take this view again", self._retake, icon="replay", name="retake")

    async def _retake(self) -> None:
        """Make a plan that takes only this view again, as before, and enter it in the queue."""
        service, view, run = self._visit.service, self._view.value, self._known.run
        plan_name = await self._visit.act(
            f"plan for {view} again", lambda: service.plan_files.retake(run, view), acts=False
        )
        if plan_name is not None:
            await enter(self._visit, NewEntry(plan=plan_name), plan_name)

    def _foot(self) -> None:
        run, status, events = self._known.run, self._known.status, self._known.events
        with panel("What happened"):
            lines = [(moment(t) + t[16:19], words) for t, words in events[:_EVENTS_SHOWN]]
            with_name(ui.html(table_html(("UTC", "what"), lines), sanitize=False), "events").style("width:100%")
            if len(events) > _EVENTS_SHOWN:
                ui.label(f"The newest {_EVENTS_SHOWN} of {len(events)}; all are in the report.").classes("hint")
            with ui.expansion("Numbers").classes("printed"):
                facts(_numbers(run.about, status, str(run.folder)))

    async def choose(self) -> None:
        """Show the chosen view, at its first exposure."""
        view = self._view.value
        if not view:
            return
        try:
            if view not in self._of_view:
                self._of_view[view] = await in_thread(self._visit.service.sheets.frames, self._name, view)
        except CoupoleError as error:
            self._means_words.set_text(str(error))
            return
        exposures = {frame.exposure: frame.exposure_us for frame in reversed(self._of_view[view])}
        options = {str(number): f"{exposure_us / 1000:g} ms" for number, exposure_us in sorted(exposures.items())}
        self._exposure.set_options(options or {"0": "-"})
        await self._choose_exposure()

    async def _choose_exposure(self) -> None:
        of_view = self._of_view.get(self._view.value, [])
        self._frames = [frame for frame in of_view if str(frame.exposure) == self._exposure.value]
        self._sheet.show(self._frames)
        lit = self._lit()
        means = await in_thread(self._visit.service.sheets.known_means, self._name, lit)
        self._dome.show(self._known.places, self._frames, means)
        if self._frames:
            await self._pick(self._frames[len(lit) // 2].shot)
        unread = len(lit) - len(means)
        bytes_unread = unread * self._known.row.bytes / max(1, self._known.row.proven)
        asks = bytes_unread > _READ_UNASKED_BYTES
        self._read_means.set_visibility(asks)
        self._means_words.set_text(f"{unread} frames are to be read: {bytes_text(bytes_unread)}." if asks else "")
        if unread and not asks:
            await self._fill_means()

    def _lit(self) -> list[str]:
        return [frame.shot for frame in self._frames if frame.led is not None]

    async def _fill_means(self) -> None:
        """Read the missing means, and colour the dome."""
        lit, frames, progress = self._lit(), self._frames, [0, 0]
        self._read_means.set_visibility(False)

        def count() -> None:
            self._means_words.set_text(f"reading: {progress[0]} of {progress[1]} frames" if progress[1] else "")

        counting = ui.timer(0.5, count)
        try:
            means = await in_long_thread(
                self._visit.service.sheets.means,
                self._name,
                lit,
                lambda *now: progress.__setitem__(slice(None), now),
            )
        except CoupoleError as error:
            counting.cancel()
            self._means_words.set_text(str(error))
            return
        counting.cancel()
        self._means_words.set_text("")
        if frames is self._frames:
            self._dome.show(self._known.places, frames, means)
            self._dome.mark(self._current)

    async def _pick(self, shot: str) -> None:
        frame = next((frame for frame in self._frames if frame.shot == shot), None)
        if frame is None:
            return
        self._current = shot
        self._sheet.mark(shot)
        self._dome.mark(shot)
        await self._viewer.show(shot, frame.light)

    async def _step(self, by: int) -> None:
        place = next((k for k, frame in enumerate(self._frames) if frame.shot == self._current), 0) + by
        if 0 <= place < len(self._frames):
            await self._pick(self._frames[place].shot)

    async def _key(self, event: events.KeyEventArguments) -> None:
        plain = not (event.modifiers.alt or event.modifiers.ctrl or event.modifiers.meta or event.modifiers.shift)
        if event.action.keydown and plain and event.key.name in ("ArrowLeft", "ArrowRight"):
            await self._step(1 if event.key.name == "ArrowRight" else -1)


def _numbers(about: dict[str, Any], status: Status, folder: str) -> dict[str, str]:
    devices = {
        kind: " ".join(str(device.get(key, "")) for key in ("vendor", "model", "serial", "firmware"))
        for kind, device in about.get("devices", {}).items()
    }
    records = about.get("calibrations")
    records = records if isinstance(records, dict) else {}
    return {
        "folder": folder,
        "software": " ".join(map(str, about.get("software", {}).values())),
        "machine": str(about.get("host", "")),
        "proof of the frames' identity": status.proof,
        **devices,
        **(
            {f"record {kind}": str(digest)[:16] for kind, digest in records.items()}
            if isinstance(records, dict)
            else {}
        ),
        "licence": str(about.get("licence") or "not stated"),
        "faults": "; ".join(status.faults) or "none",
    }
