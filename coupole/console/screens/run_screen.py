"""The present run: its newest frame and the frame's exposure, progress by view, and the events."""

from __future__ import annotations

import html
from pathlib import Path

from nicegui import ui

from coupole.console.routes.messages import EntryNow, NewEntry, StateNow
from coupole.console.runs.run_files import Frame
from coupole.console.runs.run_watch import Watched
from coupole.console.screens.fault_of_arm import FaultOfArm
from coupole.console.screens.growing_panel import GrowingPanel
from coupole.console.screens.parts import (
    button,
    clipping_words,
    facts_html,
    histogram_svg,
    panel,
    picture_address,
    table_html,
    with_name,
)
from coupole.console.screens.visit import Visit, enter, in_thread
from coupole.errors import CoupoleError
from coupole.viewing.terminal import duration_text

_LOOK_EVERY_S = 0.5


def build(visit: Visit) -> None:
    """Build the screen."""
    _Screen(visit)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        self._shown = ""
        self._idle = panel()
        with self._idle:
            self._idle_words = ui.label()
            self._after = with_name(ui.column(), "after").style("width:100%")
            self._said = ""
        self._fault = FaultOfArm(visit)
        with ui.element("div").classes("columns") as self._work:
            with panel("Newest frame"):
                self._picture = ui.html("", sanitize=False).style("width:100%")
                self._histogram = ui.html("", sanitize=False).style("width:100%")
                self._exposure = ui.html("", sanitize=False).style("width:100%")
            with ui.column().classes("gap"):
                with panel("Progress"):
                    self._facts = ui.html("", sanitize=False).style("width:100%")
                    self._views = ui.html("", sanitize=False).style("width:100%")
                with panel("What happened"):
                    self._events = ui.html("", sanitize=False).style("width:100%").props("data-name=events")
        self._growing = GrowingPanel(visit, "")
        visit.follow(self._state)
        ui.timer(_LOOK_EVERY_S, self._look)

    def _state(self, now: StateNow) -> None:
        at_work = now.run is not None
        self._work.set_visibility(at_work)
        if not at_work:
            self._growing.hide()
        self._idle.set_visibility(not at_work)
        waiting = sum(entry.state == "waiting" for entry in now.queue)
        self._idle_words.text = (
            f"{'A plan is checked and devices are opened' if now.state == 'starting' else 'No run is at work'}. "
            f"{waiting} plans wait in the queue."
        )
        self._fault.show(now.arm_fault)
        ended_entries = [
            ended_entry
            for ended_entry in now.queue
            if ended_entry.state in ("done", "failed", "stopped") and not ended_entry.hold
        ]
        last = ended_entries[-1] if ended_entries else None
        state_text = last.model_dump_json() if last else ""
        if state_text != self._said:
            self._said = state_text
            self._show_last(last)

    def _show_last(self, last: EntryNow | None) -> None:
        """Show how the last entry ended, and the possible actions."""
        self._after.clear()
        if last is None:
            return
        run, visit = Path(last.run).name, self._visit

        async def resume() -> None:
            halt_reason = visit.now.halted
            resuming.set_enabled(False)
            first = next((entry.id for entry in visit.now.queue if entry.state == "waiting"), "")
            if await enter(visit, NewEntry(resume=run, before=first), f"the rest of {run}"):
                await visit.act("go on with the queue", lambda: visit.service.queue.go_on(halt_reason))
            resuming.set_enabled(True)

        with self._after:
            outcome = {"done": "is complete", "failed": "failed", "stopped": "was stopped"}[last.state]
            ui.label(f"{run or last.words} {outcome}" + (f": {last.said}" if last.said else "."))
            with ui.row().classes("bar"):
                if last.state != "done" and run and visit.may_act:
                    resuming = button("Resume it", resume, icon="play_arrow", name="resume", kind="main")
                if run:
                    ui.link("look at it", f"/runs/{run}")

    async def _look(self) -> None:
        now = self._visit.now
        if now.run is None:
            return
        service, name = self._visit.service, now.run
        try:
            watched_run = await in_thread(service.watch.of, name)
            self._show(now, watched_run)
            await self._growing.show(name, watched_run.processing, watched_run.growing)
            if watched_run.newest is not None and str(watched_run.newest.shot) != self._shown:
                shot = str(watched_run.newest.shot)
                frame = await in_thread(service.runs.frame, name, shot)
                self._show_frame(name, frame)
                self._shown = shot
        except CoupoleError as error:
            self._events.set_content(f'<p class="bad">{html.escape(str(error))}</p>')

    def _show(self, now: StateNow, run_progress: Watched) -> None:
        processing = run_progress.processing
        hot = "-" if run_progress.hottest_board_c is None else f"{run_progress.hottest_board_c:.1f} C"
        self._facts.set_content(
            facts_html(
                {
                    "run": run_progress.run,
                    "frames proven": f"{now.proven} of {now.frames}",
                    "time left": "-" if now.left_s is None else duration_text(now.left_s),
                    "light on the object": f"{now.dose:.3f} lux h in this run",
                    "taken again": f"{run_progress.reshot} shots",
                    "hottest LED board": hot,
                    "reflectance": "not requested for this run" if processing is None else processing.words,
                }
            )
        )
        self._views.set_content(_bars(run_progress, now.view))
        self._events.set_content(
            table_html(("UTC", "what"), [(t[11:19], words) for t, words in run_progress.events[:40]])
        )

    def _show_frame(self, name: str, frame: Frame) -> None:
        address = picture_address(name, frame.shot, 1280, saturation=True)
        self._picture.set_content(
            f'<img class="frame-picture" src="{address}" alt="{html.escape(frame.shot)}; clipped pixels are red">'
        )
        self._histogram.set_content(histogram_svg(frame.figures.histograms))
        self._exposure.set_content(
            facts_html(
                {
                    "shot": frame.shot,
                    "exposure": f"{frame.exposure_us / 1000:g} ms",
                    "brightest": f"{frame.figures.brightest:.0%} of full scale",
                    **clipping_words(frame.figures.saturated),
                }
            )
        )


def _bars(run_progress: Watched, current: str | None) -> str:
    rows = []
    for view, proven, frame_count in run_progress.views:
        share = proven / frame_count if frame_count else 1.0
        mark = ' style="font-weight:650"' if view == current else ""
        rows.append(
            f'<tr><td{mark}>{html.escape(view)}</td><td style="width:60%"><progress max="1" value="{share:.4f}" '
            f'aria-label="{html.escape(view)}" style="width:100%"></progress></td>'
            f"<td>{proven} of {frame_count}</td></tr>"
        )
    return f'<table class="plain"><tbody>{"".join(rows)}</tbody></table>'
