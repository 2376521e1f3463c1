"""Plans in their order: begin and end of each, its light and disk space, and where the queue waits for a
person."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from nicegui import ui

from coupole.console.routes.messages import EntryNow, NewEntry, StateNow
from coupole.console.screens.parts import Choice, button, panel, with_label, with_name
from coupole.console.screens.visit import Visit, enter, in_thread
from coupole.viewing.terminal import bytes_text, duration_text

_ENDED_SHOWN = 20
_KINDS = {"done": "good", "failed": "bad", "stopped": "warm"}


def build(visit: Visit) -> None:
    """Build the screen."""
    ui.timer(0.0, _Screen(visit).offer_plans, once=True)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit, self._queue = visit, visit.service.queue
        self._shown: object = None
        with panel():
            with ui.row().classes("bar"):
                self._plan = Choice("Plan", {}, name="plan")
                self._reflectance = with_name(
                    ui.checkbox("With normals and materials, beside the run"), "reflectance"
                )
                button("Put in the queue", self._enter, icon="playlist_add", name="enter", kind="main")
                self._hold = with_name(
                    ui.input("Or the task for a person", placeholder="change the object"), "hold"
                )
                self._hold.classes("field")
                button("Hold there", self._enter_hold, icon="pan_tool", name="enter-hold")
            with ui.row().classes("bar") as self._checking:
                self._checked = with_name(ui.label(), "checking").props("role=status")
                button("Give it up", self._give_up, name="give-up", kind="flat")
            with ui.row().classes("bar") as self._halted:
                self._why = with_name(ui.label(), "halted").classes("warm")
                button("Go on with the queue", self._go_on, icon="play_arrow", name="go-on", kind="main")
        with panel("Waiting and running"):
            self._rows = with_name(ui.column().classes("rows"), "waiting").props("role=list")
            self._sum = with_name(ui.label().classes("hint"), "sum")
        with panel("Ended"):
            self._ended = with_name(ui.column().classes("rows"), "ended").props("role=list")
        visit.follow(self._show)

    async def offer_plans(self) -> None:
        """Offer the plans of the folder."""
        names = await in_thread(self._visit.service.plan_files.names)
        self._plan.set_options({name: name for name in names})

    async def _enter(self) -> None:
        if self._plan.value:
            entry = NewEntry(plan=self._plan.value, reflectance=bool(self._reflectance.value))
            await enter(self._visit, entry, self._plan.value)

    async def _enter_hold(self) -> None:
        words = str(self._hold.value or "").strip()
        if words and await enter(self._visit, NewEntry(hold=words), words):
            self._hold.set_value("")

    async def _go_on(self) -> None:
        await self._visit.act("go on with the queue", self._queue.go_on)

    async def _give_up(self) -> None:
        preflight = self._visit.service.entering.preflight
        await self._visit.act(f"give up preflight of {preflight.words}", preflight.give_up, acts=False)

    async def _take_out(self, entry: EntryNow) -> None:
        await self._visit.act(f"take out {entry.words}", lambda: self._queue.remove(entry.id))

    async def _move(self, entry: EntryNow, before: str) -> None:
        entering = self._visit.service.entering
        async with entering.one_at_a_time:
            await self._visit.act(f"move {entry.words}", lambda: entering.move(entry.id, before))

    def _show(self, now: StateNow) -> None:
        self._why.text = now.halted
        self._halted.set_visibility(bool(now.halted))
        self._checked.text = f"Preflight of {now.checking}"
        self._checking.set_visibility(bool(now.checking))
        state = (now.halted, tuple(now.queue), self._visit.may_act)
        if state == self._shown:
            return
        self._shown = state
        waiting = [entry for entry in now.queue if entry.state == "waiting"]
        self._rows.clear()
        with self._rows:
            for entry in (entry for entry in now.queue if entry.state == "running"):
                self._row(entry, "runs")
            for number, entry in enumerate(waiting):
                self._row(entry, "waits", waiting, number)
            if not now.queue or not (waiting or any(entry.state == "running" for entry in now.queue)):
                ui.label("Nothing waits.").classes("hint").props("role=listitem")
        self._sum.text = _sum_of(waiting)
        self._ended.clear()
        with self._ended:
            ended_entries = [ended_entry for ended_entry in reversed(now.queue) if ended_entry.state in _KINDS]
            for entry in ended_entries[:_ENDED_SHOWN]:
                self._row(entry, entry.state)
            if not ended_entries:
                ui.label("None yet.").classes("hint").props("role=listitem")

    def _row(self, entry: EntryNow, state: str, waiting: list[EntryNow] | None = None, number: int = 0) -> None:
        with ui.row().classes("entry").props("role=listitem"):
            ui.icon("pan_tool" if entry.hold else "camera").props("aria-hidden=true")
            with ui.column().classes("entry-words"):
                ui.label(f"hold: {entry.hold}" if entry.hold else _entry_name(entry)).classes("entry-name")
                ui.label(f"{state}{_times(entry)}, by {entry.by}").classes(f"small {_KINDS.get(state, '')}")
                if entry.needs is not None:
                    ui.label(_needs(entry)).classes("small")
                    for warning in entry.needs.warnings[:3]:
                        ui.label(warning).classes("small warm")
                if entry.said:
                    ui.label(entry.said).classes("small bad")
            if entry.run:
                ui.link("look at the run", f"/runs/{Path(entry.run).name}").classes("small")
            if waiting is not None and self._visit.may_act:
                self._moves(entry, waiting, number)

    def _moves(self, entry: EntryNow, waiting: list[EntryNow], number: int) -> None:
        def up() -> object:
            return self._move(entry, waiting[number - 1].id)

        def down() -> object:
            return self._move(entry, waiting[number + 2].id if number + 2 < len(waiting) else "")

        for icon, words, do, possible in (
            ("arrow_upward", "earlier", up, number > 0),
            ("arrow_downward", "later", down, number + 1 < len(waiting)),
            ("delete_outline", "take out", lambda: self._take_out(entry), True),
        ):
            move_button = button("", do, icon=icon, name=words.replace(" ", "-"), kind="flat")
            with_label(move_button, f"{words}: {entry.words[:80]}").props("dense").set_enabled(possible)


def _entry_name(entry: EntryNow) -> str:
    name = Path(entry.plan).name if entry.plan else ""
    return f"resume {Path(entry.resume).name}" if entry.resume else name


def _times(entry: EntryNow) -> str:
    if entry.ended:
        return f" {_clock(entry.ended)} UTC"
    if entry.expected_begin is None:
        return ", its time is not known" if entry.state == "waiting" else ""
    end = f" to {_clock(entry.expected_end)}" if entry.expected_end else ""
    return f", expected {_clock(entry.expected_begin)}{end} UTC"


def _clock(text: str) -> str:
    return datetime.fromisoformat(text).strftime("%b %d %H:%M")


def _needs(entry: EntryNow) -> str:
    assert entry.needs is not None
    needs = entry.needs
    on = f" on {needs.object}" if needs.object else ""
    return (
        f"{duration_text(needs.duration_s)}, {needs.frames} frames, {bytes_text(needs.bytes)}, "
        f"{needs.dose_lux_h:.3f} lux h{on}"
    )


def _sum_of(waiting: list[EntryNow]) -> str:
    needs = [entry.needs for entry in waiting if entry.needs is not None]
    if not needs:
        return ""
    seconds = sum(entry_needs.preparation_s + entry_needs.duration_s for entry_needs in needs)
    light = sum(entry_needs.dose_lux_h for entry_needs in needs)
    size = sum(entry_needs.bytes for entry_needs in needs)
    return f"all waiting entries: {duration_text(seconds)}, {bytes_text(size)}, {light:.3f} lux h"
