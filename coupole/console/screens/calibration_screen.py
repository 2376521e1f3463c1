"""Calibrations: the records in force and their margins, the plans that they refuse, and the making of new
records."""

from __future__ import annotations

import html
from pathlib import Path

from nicegui import ui

from coupole.console.cell.calibration_status import PlanRow, RecordRow, StepNow
from coupole.console.people.accounts import Role
from coupole.console.screens.calibration_pictures import support_svg
from coupole.console.screens.parts import button, count, moment, panel, sure, table_html, with_name
from coupole.console.screens.task_list import TaskList
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError

_LOOK_EVERY_S, _SOON_DAYS, _NARROW = 5.0, 14.0, 0.1
"""Interval of updates; days before its end at which a record expires soon; margin that counts as narrow."""
WORDS_OF = "calibrate"
"""First word of a calibrating command."""


def build(visit: Visit) -> None:
    """Build the screen."""
    _InForce(visit)
    _Campaign(visit)


class _InForce:
    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        with panel("In force for this rig"):
            self._records = with_name(ui.html("", sanitize=False), "records").style("width:100%")
        with panel("Plans"):
            self._words = ui.label("Reading the plans …").classes("hint")
            self._plans = with_name(ui.html("", sanitize=False), "plans").style("width:100%")
            button("Look again", self._look, name="look-again", icon="refresh")
        ui.timer(0.01, self._look, once=True)

    async def _look(self) -> None:
        status = self._visit.service.calibrations
        try:
            rows = await in_thread(status.records)
            self._records.set_content(table_html(_HEADS, [_record_cells(row) for row in rows]))
            plans = await in_thread(status.plans)
        except CoupoleError as error:
            self._words.set_text(str(error))
            return
        refused_count = sum(bool(row.against) for row in plans)
        self._words.set_text(
            f"{count(len(plans), 'plan')} of this rig in the folder of plans. "
            + (
                f"{refused_count} would be refused now."
                if refused_count
                else "No plan is refused because of its records."
            )
        )
        self._plans.set_content(table_html(("plan", "by its records"), [_plan_cells(row) for row in plans]))


_HEADS = ("record", "state", "made (UTC)", "age", "expires", "margin", "nearest limit")


def _record_cells(row: RecordRow) -> list[str]:
    if row.path is None:
        why = "bad|none; plans with calibrations need one" if row.is_needed else "none in force"
        return [row.kind, why, "", "", "", "", ""]
    if not row.kind:
        return [row.path.name, f"bad|{' '.join(row.against)}", "", "", "", "", ""]
    expiry = f"in {count(round(row.left_days), 'day')}" if row.left_days > 0 else "bad|expired"
    if 0 < row.left_days < _SOON_DAYS:
        expiry = f"warm|{expiry}"
    margin = "" if row.margin is None else f"{row.margin:{'.1%' if abs(row.margin) < _NARROW else '.0%'}}"
    if row.margin is not None and row.margin < _NARROW:
        margin = f"{'bad' if row.margin < 0 else 'warm'}|{margin}"
    state = f"bad|{'; '.join(row.against)}" if row.against else "good|holds"
    return [
        row.kind,
        state,
        moment(row.created_at),
        count(round(row.age_days), "day"),
        expiry,
        margin,
        row.tightest,
    ]


def _plan_cells(row: PlanRow) -> list[str]:
    if not row.wants:
        return [row.plan, "wants none"]
    return [row.plan, f"bad|{'; '.join(row.against)}" if row.against else "good|may run"]


class _Campaign:
    """`calibrate all`, step by step."""

    def __init__(self, visit: Visit) -> None:
        self._visit, self._shown = visit, ""
        with panel("New records"):
            ui.label(
                "There are six steps, in this order. Place what the picture shows, go out of the arm's reach, "
                "and begin. "
                "Each step takes its frames and makes its records; existing records are not made again. "
                "An object's place is calibrated by `coupole calibrate mesh`."
            )
            self._where = ui.label("").classes("hint")
            with ui.row().classes("bar"):
                self._new = button("Begin anew", self._begin_anew, name="new-campaign", icon="add")
            self._steps = ui.element("div").classes("cards").props("data-name=steps")
            TaskList(visit, lambda task: task.command[0] == WORDS_OF, most=6)
            self._lines = ui.column().style("width:100%")
        ui.timer(0.01, self._look, once=True)
        ui.timer(_LOOK_EVERY_S, self._look)

    async def _look(self) -> None:
        status = self._visit.service.calibrations
        folder = await in_thread(status.campaign)
        steps = await in_thread(status.steps, folder or Path())
        under_way = any(
            task.running for task in self._visit.service.tasks.newest_first if task.command[0] == WORDS_OF
        )
        self._new.set_enabled(self._visit.is_engineer and not under_way)
        self._where.set_text(
            f"Plans, runs and records are in {folder}." if folder else "Nothing is begun. An engineer begins."
        )
        state = f"{folder} {steps} {under_way}"
        if state == self._shown:
            return
        self._shown = state
        self._steps.clear()
        with self._steps:
            following = next((step.step.name for step in steps if not step.is_done), "")
            for number, step in enumerate(steps, 1):
                self._card(number, step, folder, may=step.step.name == following and not under_way)
        self._lines.clear()
        if folder is not None and any(step.accepted_kinds for step in steps):
            with self._lines:
                ui.label(f"To put them in force for all plans, write in {status.rig_path}:").classes("hint")
                ui.html(html.escape(status.lines_for_the_rig(folder)), sanitize=False).classes("mono")

    def _card(self, number: int, now: StepNow, folder: Path | None, *, may: bool) -> None:
        step = now.step
        with ui.column().classes("step"):
            ui.html(f"<h3>{number}. {html.escape(step.name)}</h3>", sanitize=False)
            ui.html(support_svg(step.name), sanitize=False).style("width:100%")
            ui.label(f"On the support: {step.stands}.")
            ui.label(f"Makes: {', '.join(step.records)}.").classes("hint")
            if now.missed_limits:
                ui.label("not accepted: " + "; ".join(now.missed_limits)).classes("bad")
            elif now.is_done:
                ui.label("done, accepted").classes("good")
            elif folder is not None:
                begin = button("It is placed: begin", lambda: self._begin(now, folder), name=f"begin-{step.name}")
                begin.set_enabled(may and self._visit.is_engineer)

    async def _begin_anew(self) -> None:
        status = self._visit.service.calibrations
        if await sure(
            "Begin anew?",
            "This makes a new folder. All steps must then be done again. Records in force stay in force until "
            "you change "
            "the rig.",
            "Begin anew",
        ):
            await self._visit.act(
                "new campaign of calibrations", status.new_campaign, role=Role.ENGINEER, acts=False
            )
            await self._look()

    async def _begin(self, now: StepNow, folder: Path) -> None:
        account, words = self._visit.account, f"calibrate {now.step.name}"
        rig = str(self._visit.service.cell.document.path)
        command = [WORDS_OF, "all", "--rig", rig, "--out", str(folder), "--only", now.step.name, "--yes"]
        await self._visit.act(
            words,
            lambda: self._visit.service.tasks.begin(words, command, account.name if account else ""),
            role=Role.ENGINEER,
            done_text=f"{words}: begun",
        )
        await self._look()
