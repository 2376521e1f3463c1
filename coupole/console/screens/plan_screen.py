"""Plans: form and YAML side by side, mistakes at their lines, preflight while the person types, the cell with the
views."""

from __future__ import annotations

import asyncio
import html
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from nicegui import ui

from coupole.console.plans.drafts import Checked, Draft
from coupole.console.plans.plan_fields import PlanFields, fields_of, text_with
from coupole.console.routes.messages import NewEntry, StateNow
from coupole.console.screens.parts import Choice, button, facts_html, heading, panel, with_name
from coupole.console.screens.plan_verdict import figures_of, view_table
from coupole.console.screens.visit import Visit, enter, in_background, in_thread
from coupole.errors import InputError, Problem

_AFTER_TYPING_S = 0.6
_LONG = 6000
"""A text with more characters is not read at every key."""
_UNITS = {"mm": "mm", "m": "m", "um": "um"}
_KINDS = {
    "round": "views all round an object",
    "views": "a view from above and a ring",
    "darks": "dark frames only",
}


def build(visit: Visit) -> None:
    """Build the screen."""
    ui.timer(0.0, _Screen(visit).open_first, once=True)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit, self._plans = visit, visit.service.plan_files
        self._name, self._text, self._saved = "", "", ""
        self._fields = PlanFields()
        self._filling = False
        self._turn = 0
        with ui.row().classes("bar"):
            self._chooser = Choice("Plan", {}, self._open_chosen, name="plan")
            button("New plan", self._ask_new, icon="add", name="new-plan")
            self._save = button("Save", self._save_plan, icon="save", name="save", kind="main")
            self._enter = button("Put in the queue", self._enter_plan, icon="playlist_add", name="enter")
        with ui.element("div").classes("columns"):
            with panel("Form"):
                self._form()
            with panel("YAML"):
                self._editor = with_name(
                    ui.codemirror(language="YAML", on_change=self._take_typing, line_wrapping=True), "yaml"
                ).classes("editor")
                self._problems = with_name(ui.html("", sanitize=False), "problems").props("role=status")
        with ui.element("div").classes("columns"):
            with panel("Preflight"):
                self._verdict = with_name(ui.html("", sanitize=False), "verdict").props("role=status")
            with panel("Views"):
                self._views = ui.html("", sanitize=False).style("width:100%")
        with panel("The cell"):
            with ui.row().classes("bar"):
                self._draw = button("Draw with paths", self._draw_cell, icon="view_in_ar", name="draw")
                self._drawing = ui.label("This plans the arm's paths, and may take a minute.").classes("hint")
            self._cell = ui.column().classes("cell")
        visit.follow(self._state)

    # -- which plan ---------------------------------------------------------------------------------------------

    async def open_first(self) -> None:
        names = await in_thread(self._plans.names)
        if names:
            self._chooser.set_options({name: name for name in names})
            await self._open_chosen()
        else:
            self._show_text("")

    async def _open_chosen(self) -> None:
        name = self._chooser.value
        if not name or name == self._name:
            return
        try:
            text = await in_thread(self._plans.read_text, name)
        except InputError as error:
            self._visit.say(str(error), bad=True)
            return
        self._name, self._saved = name, text
        self._cell.clear()
        self._show_text(text)

    async def _ask_new(self) -> None:
        with ui.dialog() as dialog, ui.card().classes("dialog"):
            heading("New plan")
            name = with_name(ui.input("Name", placeholder="vase-1").classes("field"), "new-name")
            kind = Choice("Begin with", _KINDS, name="kind")
            with ui.row():
                button("Make", lambda: dialog.submit(True), name="make", kind="main")
                button("Cancel", lambda: dialog.submit(False), name="cancel")
        if not await dialog:
            return
        visit, plans = self._visit, self._plans
        new_name = await visit.act(
            f"new plan {name.value}", lambda: plans.create(str(name.value or ""), kind.value), acts=False
        )
        if new_name is not None:
            names = await in_thread(plans.names)
            self._chooser.set_options({name: name for name in names}, new_name)
            await self._open_chosen()

    async def _save_plan(self) -> bool:
        name, text, text_before = self._name, self._text, self._saved
        is_saved = await self._visit.act(
            f"save plan {name}", lambda: self._plans.write(name, text, text_before), acts=False, done_text="saved"
        )
        if is_saved:
            self._saved = text
            self._state(self._visit.now)
        return bool(is_saved)

    async def _enter_plan(self) -> None:
        if self._text != self._saved and not await self._save_plan():
            return
        await enter(self._visit, NewEntry(plan=self._name), self._name)

    def _state(self, _: StateNow) -> None:
        may = self._visit.may_act and bool(self._name)
        self._save.set_enabled(may and self._text != self._saved)
        self._enter.set_enabled(may)
        self._editor.set_enabled(self._visit.may_act)
        self._draw.set_enabled(may)
        self._round.set_enabled(may)

    # -- the form -----------------------------------------------------------------------------------------------

    def _form(self) -> None:
        with ui.element("div").classes("fields"):
            self._object = with_name(ui.input("Object: its accession number").classes("field"), "object")
            self._mesh = with_name(ui.input("Mesh: PLY, STL or OBJ").classes("field"), "mesh")
            self._unit = Choice("Unit of the mesh", _UNITS, self._take_field, name="mesh-unit")
            self._budget = with_name(ui.number("Most light in its life, lux h", min=0).classes("field"), "budget")
            self._distance = ui.number("Distance of the camera, mm", min=1, max=3000).classes("field")
            self._elevations = with_name(ui.input("Elevations, degrees").classes("field"), "elevations")
            self._azimuths = with_name(
                ui.number("Views at each elevation", min=1, max=360, precision=0), "azimuths"
            )
            self._azimuths.classes("field")
            self._exposures = with_name(ui.input("Exposures, us").classes("field"), "exposures")
            self._every = with_name(ui.number("LEDs: every n-th", min=1, precision=0).classes("field"), "every")
            self._darks = ui.number("Dark frames for each view", min=0, precision=0).classes("field")
        inputs = [
            self._object, self._mesh, self._budget, self._distance, self._elevations, self._azimuths,
            self._exposures, self._every, self._darks,
        ]  # fmt: skip
        for field in inputs:
            field.on("blur", self._take_field)
            field.on("keydown.enter", self._take_field)
        self._round = button("Views all round the mesh", self._all_round, icon="360", name="all-round")
        self._form_says = with_name(ui.label().classes("hint"), "form-says")

    def _show_fields(self, fields: PlanFields) -> None:
        self._filling = True
        self._fields = fields
        self._object.set_value(fields.object_id)
        self._mesh.set_value(fields.mesh)
        self._unit.set_options(_UNITS, fields.mesh_unit)
        self._budget.set_value(fields.budget_lux_h)
        self._distance.set_value(fields.distance_mm)
        self._elevations.set_value(_numbers_text(fields.elevations_deg))
        self._azimuths.set_value(fields.azimuths)
        self._exposures.set_value(_numbers_text(fields.exposures_us))
        self._every.set_value(fields.every_led)
        self._darks.set_value(fields.darks_per_view)
        for field in (self._distance, self._elevations, self._azimuths):
            field.set_enabled(not fields.own_views)
        self._every.set_enabled(not fields.own_lights)
        remarks = [
            words
            for is_own, words in (
                (fields.own_views, "the views are as the YAML has them"),
                (fields.own_lights, "the lights are as the YAML has them"),
                (fields.own_exposure, "exposures are chosen in the run, as the YAML has it"),
            )
            if is_own
        ]
        self._form_says.set_text("; ".join(remarks))
        self._filling = False

    def _filled_fields(self) -> PlanFields:
        """Return the values of the form. Raises InputError for fields that are not numbers."""
        return replace(
            self._fields,
            object_id=str(self._object.value or "").strip(),
            mesh=str(self._mesh.value or "").strip(),
            mesh_unit=self._unit.value,
            budget_lux_h=self._budget.value,
            distance_mm=self._distance.value,
            elevations_deg=tuple(map(_tidy, _numbers(self._elevations.value, "Elevations"))),
            azimuths=_whole(self._azimuths.value),
            exposures_us=tuple(int(value) for value in _numbers(self._exposures.value, "Exposures")),
            every_led=_whole(self._every.value),
            darks_per_view=_whole(self._darks.value),
        )

    def _take_field(self) -> None:
        """Write the value of a field into the text when the person has left the field."""
        if self._filling or not self._name:
            return
        try:
            fields = self._filled_fields()
            if fields == self._fields:
                return
            text = text_with(self._plans.path(self._name), self._text, fields)
            self._form_says.set_text("")
            self._show_text(text)
        except InputError as error:
            self._form_says.set_text(str(error))

    async def _all_round(self) -> None:
        """Put views at three elevations into the text: they look at the middle of the mesh, by default from the
        lens's focus distance."""
        if not self._visit.may_act:
            return
        path, rig = self._plans.path(self._name), self._visit.service.cell.rig
        try:
            low, high = await self._visit.service.desk.bounds(Draft(path, self._text))
            fields = replace(
                self._filled_fields(),
                own_views=False,
                distance_mm=self._fields.distance_mm or rig.lens.focus_distance_mm,
                elevations_deg=self._fields.elevations_deg or (35, 55, 75),
                azimuths=self._fields.azimuths or 8,
            )
            middle = tuple((a + b) / 2 for a, b in zip(low, high, strict=True))
            self._show_text(text_with(path, self._text, fields, middle))
        except InputError as error:
            self._form_says.set_text(str(error))

    # -- the text -----------------------------------------------------------------------------------------------

    def _show_text(self, text: str) -> None:
        self._text = text
        self._editor.set_value(text)
        self._read_text()

    def _take_typing(self) -> None:
        if self._editor.value != self._text:
            self._text = self._editor.value
            self._read_text()

    def _read_text(self) -> None:
        """Show the contents of the text; the preflight follows when the person stops typing."""
        self._state(self._visit.now)
        if not self._name:
            return
        self._turn += 1
        turn, long = self._turn, len(self._text) > _LONG

        def show_fields() -> bool:
            try:
                self._show_fields(fields_of(self._plans.path(self._name), self._text))
            except InputError as error:
                self._show_problems(error.problems or [Problem(self._name, 0, 0, "", str(error))])
                return False
            return True

        if not long and not show_fields():
            return

        async def check() -> None:
            await asyncio.sleep(_AFTER_TYPING_S)
            if turn != self._turn or (long and not show_fields()):
                return
            self._verdict.set_content('<p class="hint">checking</p>')
            try:
                verdict = await self._visit.service.desk.check(
                    Draft(self._plans.path(self._name), self._text), lambda: turn == self._turn
                )
            except InputError as error:
                verdict = Checked(problems=(Problem(self._name, 0, 0, "", str(error)),))
            if verdict is not None and turn == self._turn:
                self._show_checked(verdict)

        in_background(check)

    def _show_checked(self, checked_plan: Checked) -> None:
        self._show_problems(checked_plan.problems)
        if checked_plan.problems:
            self._verdict.set_content('<p class="bad">Not checked: the plan has mistakes.</p>')
            self._views.set_content("")
            return
        report = checked_plan.report
        verdict_html = "".join(f'<p class="bad">refused: {html.escape(words)}</p>' for words in report["refusals"])
        verdict_html = (
            verdict_html
            or '<p class="good">The plan can be run (paths and collisions are checked when it is drawn, and '
        )
        verdict_html += "" if report["refusals"] else "before it begins).</p>"
        verdict_html += "".join(f'<p class="warm">{html.escape(words)}</p>' for words in report["warnings"])
        self._verdict.set_content(verdict_html + facts_html(figures_of(checked_plan)))
        self._views.set_content(view_table(checked_plan))

    def _show_problems(self, problems: Sequence[Problem]) -> None:
        lines = self._text.splitlines()
        plan_path = str(self._plans.path(self._name)) if self._name else ""
        rows = []
        for problem in problems:
            here = problem.file == plan_path and 0 < problem.line <= len(lines)
            place = f"line {problem.line}" if here else Path(problem.file).name
            message = f"{problem.key}: {problem.message}" if problem.key else problem.message
            excerpt = f"<code>{html.escape(lines[problem.line - 1].strip())}</code>" if here else ""
            rows.append(f'<li><b class="bad">{html.escape(place)}</b> {html.escape(message)} {excerpt}</li>')
        self._problems.set_content(f'<ul class="problems">{"".join(rows)}</ul>' if rows else "")
        self._editor.line_tooltips = {
            problem.line: problem.message
            for problem in problems
            if problem.file == plan_path and 0 < problem.line <= len(lines)
        }
        self._editor.decorations = [
            {"kind": "line", "line": line, "class": "wrong-line"} for line in self._editor.line_tooltips
        ]

    # -- the cell -----------------------------------------------------------------------------------------------

    async def _draw_cell(self) -> None:
        if not self._visit.may_act:
            return
        service, draft = self._visit.service, Draft(self._plans.path(self._name), self._text)
        self._draw.set_enabled(False)
        self._drawing.set_text("drawing: paths are planned")
        folder = service.plan_files.new_drawing()
        try:
            png, page = await service.desk.draw(draft, folder)
        except InputError as error:
            self._drawing.set_text("")
            self._visit.say(str(error), bad=True)
            return
        finally:
            self._draw.set_enabled(True)
        self._drawing.set_text(
            "The slider shows one view after the other, with its picture, field and hidden LEDs."
        )
        self._cell.clear()
        with self._cell:
            address = f"/drawings/{folder.name}/"
            ui.element("iframe").props(
                f'src="{address}{page.name}" title="the cell with the plan\'s views" sandbox="allow-scripts"'
            ).classes("drawn")
            ui.html(
                f'<img class="frame-picture" src="{address}{png.name}" '
                'alt="the cell from three sides, and what the camera sees">',
                sanitize=False,
            ).style("width:100%")


def _numbers_text(values: Sequence[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _numbers(text: str | None, label: str) -> list[float]:
    """Return the numbers of a field. Raises InputError."""
    try:
        numbers = [float(word) for word in str(text or "").replace(",", " ").split()]
    except ValueError:
        numbers = [math.nan]
    if not all(map(math.isfinite, numbers)):
        raise InputError(f"{label}: expected numbers, with commas between; found {text!r}")
    return numbers


def _tidy(value: float) -> float:
    return int(value) if value == int(value) else value


def _whole(value: float | None) -> int | None:
    return None if value is None else int(value)
