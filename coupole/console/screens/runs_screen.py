"""The cell's runs: a table with search, and the actions for each run."""

from __future__ import annotations

import html
from urllib.parse import quote

from nicegui import events, ui

from coupole.console.runs.run_files import RunRow
from coupole.console.screens.parts import button, heading, link, moment, panel, picture_address, with_label
from coupole.console.screens.run_actions import RunActions
from coupole.console.screens.task_list import TaskList
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError
from coupole.viewing.terminal import bytes_text

_LOOK_EVERY_S, _SHOWN_AT_ONCE = 2.0, 50
OF_RUNS = ("verify", "report", "archive", "export", "reflectance", "show")
"""Commands on runs."""
STATE_KINDS = {"done": "good", "failed": "bad", "damaged": "bad", "interrupted": "warm", "paused": "warm"}
EMIT_NAMED = "(e) => { const one = e.target.closest('[data-%s]'); if (one) emit(one.dataset.%s) }"
"""JavaScript handler of a click on a part of HTML with an attribute `data-...`."""
_HEADS = ("", "run", "state", "frames", "size", "verified", "archived", "")


def build(visit: Visit) -> None:
    """Build the screen."""
    _Screen(visit)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit, self._rows, self._shown, self._most = visit, list[RunRow](), "", _SHOWN_AT_ONCE
        with panel():
            with ui.row().classes("bar"):
                self._search = ui.input("Search", on_change=self._show).props(
                    "outlined dense clearable type=search data-name=search"
                )
                self._count = ui.label("Reading the runs …").props("role=status data-name=count").classes("hint")
            self._table = ui.html("", sanitize=False).style("width:100%").props("data-name=runs")
            self._table.on("click", self._actions_of, js_handler=EMIT_NAMED % ("run", "run"))
            self._more = button("Show more", self._show_more, name="more")
            self._more.set_visibility(False)
        with panel("Commands"):
            TaskList(visit, lambda task: task.command[0] in OF_RUNS)
        ui.timer(_LOOK_EVERY_S, self._look, immediate=True)

    async def _look(self) -> None:
        self._rows = await in_thread(self._visit.service.runs.rows)
        self._show()

    def _show_more(self) -> None:
        self._most += _SHOWN_AT_ONCE
        self._show()

    def _show(self) -> None:
        words = (self._search.value or "").lower().split()
        rows = [row for row in self._rows if all(word in _searchable_text(row) for word in words)]
        self._count.text = f"{len(rows)} of {len(self._rows)} runs" if words else f"{len(rows)} runs"
        self._more.set_visibility(len(rows) > self._most)
        text = _table(rows[: self._most]) if rows else '<p class="hint">No run is found.</p>'
        if text != self._shown:
            self._shown = text
            self._table.set_content(text)

    def _actions_of(self, event: events.GenericEventArguments) -> None:
        row = next((row for row in self._rows if row.name == event.args), None)
        if row is None:
            return
        title = f"Actions of {row.name}"
        with with_label(ui.dialog(value=True), title) as dialog, ui.column().classes("panel ask"):
            heading(row.name)
            link("Open the run", f"/runs/{quote(row.name)}", name="open-run", new_tab=False)
            try:
                RunActions(self._visit, row.name, can_resume=row.proven < row.frames, frames=row.proven)
            except CoupoleError as error:
                ui.label(str(error)).classes("bad")
            button("Close", dialog.close, name="close")
        dialog.on("hide", dialog.delete)


def _searchable_text(row: RunRow) -> str:
    return " ".join((row.name, row.state, row.object, row.operator, row.created[:10])).lower()


def _table(rows: list[RunRow]) -> str:
    heads = "".join(
        f'<th scope="col">{head or "<span class=unseen>picture and actions</span>"}</th>' for head in _HEADS
    )
    body = "".join(map(_row, rows))
    return f'<table class="plain runs"><thead><tr>{heads}</tr></thead><tbody>{body}</tbody></table>'


def _row(row: RunRow) -> str:
    name, page = html.escape(row.name), f"/runs/{quote(row.name)}"
    picture = (
        f'<img loading="lazy" src="{picture_address(row.name, row.thumbnail, 160)}" alt="">'
        if row.thumbnail
        else ""
    )
    about = " · ".join(html.escape(words) for words in (row.object, moment(row.created), row.operator) if words)
    share = f"{row.proven} of {row.frames}" if row.proven != row.frames else str(row.frames)
    verified_at = moment(row.verified) if row.verified else "no"
    return (
        f'<tr><td class="thumbnail">{picture}</td><td class="run"><a href="{page}">{name}</a>'
        f'<div class="hint">{about}</div></td>'
        f'<td><span class="{STATE_KINDS.get(row.state, "")}">{html.escape(row.state)}</span>'
        f"{'' if not row.simulated else ' <span class=hint>simulated</span>'}</td>"
        f'<td data-head="frames">{share}</td><td data-head="size">{bytes_text(row.bytes)}</td>'
        f'<td data-head="verified">{verified_at}</td>'
        f'<td data-head="archived">{"yes" if row.archived else "no"}</td>'
        f'<td><button type="button" class="small-button" data-run="{name}" aria-label="actions of {name}">Actions'
        "</button></td></tr>"
    )
