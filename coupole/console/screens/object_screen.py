"""The object: its identity, its position on the support, and all light that it has received."""

from __future__ import annotations

import html
import math
import secrets
from urllib.parse import quote

from nicegui import ui

from coupole.console.plans.drafts import Draft
from coupole.console.screens.parts import Choice, button, facts_html, panel, table_html, with_name
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError, InputError
from coupole.storage.ledger_lines import History

_SEND = """async event => {
  const file = event.target.files[0];
  if (!file) return;
  const {token} = await (await fetch("/api/v1/token")).json();
  const reply = await fetch(ADDRESS, {method: "PUT", body: file,
    headers: {"X-Coupole-Token": token, "Content-Type": "application/octet-stream"}});
  emit(reply.ok ? "" : ((await reply.json()).detail || "refused"));
}"""


def build(visit: Visit) -> None:
    """Build the screen."""
    ui.timer(0.0, _Screen(visit).open_first, once=True)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit, self._objects = visit, visit.service.objects
        with ui.row().classes("bar"):
            self._chooser = Choice("Object", {}, self._show, name="object")
        with ui.element("div").classes("columns"):
            with panel("Is this your object?"):
                self._photograph = ui.column().classes("cell")
                self._lies = with_name(ui.html("", sanitize=False), "lies").style("width:100%")
                self._plans = Choice("As in this plan", {}, self._draw, name="by-plan")
            with panel("Light on it"):
                self._sums = with_name(ui.html("", sanitize=False), "light").style("width:100%")
                self._bar = ui.linear_progress(0.0, show_value=False).props('aria-label="light of its budget"')
                self._runs = ui.html("", sanitize=False).style("width:100%")
                self._by_hand()
                self._budget()

    async def open_first(self) -> None:
        """Open the object of the present run, or else the first one."""
        ids = await in_thread(self._objects.ids)
        if not ids:
            self._sums.set_content("<p>No plan, run or ledger names an object yet.</p>")
            return
        here = self._visit.now.object
        self._chooser.set_options({object_id: object_id for object_id in ids}, here if here in ids else "")
        await self._show()

    async def _show(self) -> None:
        object_id = self._chooser.value
        try:
            history = await in_thread(self._objects.history, object_id)
            plans = await in_thread(self._objects.plans_of, object_id)
            similar = await in_thread(self._objects.similar, object_id)
            runs = await in_thread(self._objects.runs_of, object_id)
            photograph = await in_thread(self._objects.photograph, object_id)
        except CoupoleError as error:
            self._visit.say(str(error), bad=True)
            return
        strictest = min(
            (named_by.budget_lux_h for named_by in plans if named_by.budget_lux_h is not None), default=None
        )
        self._show_light(history, strictest, similar)
        operators = {row.name: row.operator for row in runs}
        self._runs.set_content(_light_table(history, operators))
        self._show_photograph(object_id, there=photograph is not None)
        with_mesh = [named_by.plan for named_by in plans if named_by.mesh]
        self._plans.set_options({name: name for name in with_mesh})
        await self._draw()

    def _show_light(self, history: History, plans_budget: float | None, similar: list[str]) -> None:
        total, budget = history.total_lux_h, history.budget_lux_h
        figures = {"in its life": f"{total:.3f} lux h"}
        for newest_budget in history.budgets[-1:]:
            because = f" ({newest_budget.reason})" if newest_budget.reason else ""
            figures["it may receive"] = f"{newest_budget.dose_lux_h:g} lux h, by {newest_budget.name}{because}"
        if plans_budget is not None and (budget is None or plans_budget < budget):
            budget = plans_budget
            figures["by the strictest of its plans"] = f"{budget:g} lux h"
        if budget is not None:
            figures["left"] = f"{max(0.0, budget - total):.3f} lux h"
        if history.unsettled_lux_h:
            figures["of which at most"] = f"{history.unsettled_lux_h:.3f} lux h: the end of a burst is not known"
        if history.of_unknown_spectrum_lux_h < total:
            figures["damaging, 300 to 780 nm"] = f"{1e3 * history.damage_wh_m2:.4f} mW h/m2 weighted"
        light_html = facts_html(figures)
        if self._visit.now.simulated:
            light_html += '<p class="hint">Light of a simulated cell is none: its runs enter nothing here.</p>'
        for other_id in similar:
            light_html += f'<p class="warm">There is also an object {html.escape(other_id)}: is it the same?</p>'
        if history.unreadable:
            light_html += f'<p class="bad">{history.unreadable_words}.</p>'
        self._sums.set_content(light_html)
        self._bar.set_visibility(budget is not None)
        self._bar.set_value(min(1.0, total / budget) if budget else 0.0)

    def _by_hand(self) -> None:
        with ui.row().classes("bar"):
            amount = with_name(ui.number("Light given elsewhere, lux h", min=0).classes("field"), "amount")
            note = with_name(
                ui.input("What it was", placeholder="photographed, 20 min at 500 lux").classes("field"), "note"
            )

            async def enter() -> None:
                object_id, account = self._chooser.value, self._visit.account
                note_text = f"{note.value or ''}".strip()
                by = f" (entered by {account.name})" if account else ""
                dose = float(amount.value) if amount.value else math.nan

                def do() -> bool:
                    if not note_text:
                        raise InputError("expected a note about the light")
                    self._objects.enter_light(object_id, dose, note_text + by)
                    return True

                if await self._visit.act(
                    f"dose {object_id}: {dose:g} lux h, {note_text}", do, acts=False, done_text="entered"
                ):
                    amount.set_value(None)
                    note.set_value("")
                    await self._show()

            button("Enter", enter, name="enter-light").set_enabled(self._visit.may_act)

    def _budget(self) -> None:
        with ui.row().classes("bar"):
            amount = with_name(ui.number("Budget of light over its life, lux h", min=0).classes("field"), "budget")
            reason = with_name(ui.input("Why", placeholder="by the conservator, 12 May").classes("field"), "why")

            async def enter() -> None:
                object_id, account = self._chooser.value, self._visit.account
                reason_text, budget = f"{reason.value or ''}".strip(), amount.value

                def do() -> bool:
                    if account is None or budget is None:
                        raise InputError("expected a number of lux hours")
                    self._objects.set_budget(object_id, float(budget), account.name, reason_text)
                    return True

                if await self._visit.act(
                    f"budget {object_id}: {budget} lux h, {reason_text}",
                    do,
                    acts=False,
                    done_text="the budget is set",
                ):
                    amount.set_value(None)
                    reason.set_value("")
                    await self._show()

            button("Set its budget", enter, name="set-budget").set_enabled(self._visit.may_act)

    def _show_photograph(self, object_id: str, *, there: bool) -> None:
        self._photograph.clear()
        address = f"/api/v1/objects/{quote(object_id)}/photograph"
        with self._photograph:
            if there:
                fresh = f"{address}?{secrets.token_hex(4)}"
                ui.html(
                    f'<img class="frame-picture" src="{fresh}" alt="photograph of {html.escape(object_id)}">',
                    sanitize=False,
                ).style("width:100%")
            if self._visit.may_act:
                with ui.element("label").classes("choice"):
                    ui.label("Another photograph" if there else "A photograph of it: JPEG, PNG or TIFF")
                    chooser = with_name(ui.element("input").props('type=file accept="image/*"'), "photograph")
                    chooser.on("change", self._on_sent, js_handler=_SEND.replace("ADDRESS", f'"{address}"'))

    async def _on_sent(self, event: object) -> None:
        if refusal := str(getattr(event, "args", "")):
            self._visit.say(refusal, bad=True)
        await self._show()

    async def _draw(self) -> None:
        name, service = self._plans.value, self._visit.service
        if not name:
            self._lies.set_content('<p class="hint">No plan names a mesh of it.</p>')
            return
        self._lies.set_content('<p class="hint">drawing</p>')
        path = service.plan_files.new_drawing() / "object.png"
        try:
            text = await in_thread(service.plan_files.read_text, name)
            await service.desk.draw_object(Draft(service.plan_files.path(name), text), path)
        except CoupoleError as error:
            self._lies.set_content(f'<p class="bad">{html.escape(str(error))}</p>')
            return
        self._lies.set_content(
            f'<img class="frame-picture" src="/drawings/{path.parent.name}/object.png" alt="the mesh of '
            f'{html.escape(self._chooser.value)} on the support, from above and from the front">'
        )


def _light_table(history: History, operators: dict[str, str]) -> str:
    rows = []
    for run in history.runs:
        part = history.of_run(run)
        notes = "; ".join(entry.note for entry in part.entries if entry.note)
        first = part.entries[0].t[:16].replace("T", " ")
        rows.append((first, run or "by hand", operators.get(run, ""), f"{part.total_lux_h:.3f}", notes))
    return table_html(("UTC", "run", "by", "lux h", "remark"), rows) if rows else "<p>None is recorded.</p>"
