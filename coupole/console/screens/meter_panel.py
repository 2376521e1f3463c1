"""Metering of the plan's exposure, and writing it into the plan."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import Any

from nicegui import ui

from coupole.console.plans.plan_fields import fields_of, text_with
from coupole.console.screens.parts import button, facts_html, panel, sure, with_name
from coupole.console.screens.visit import Visit


class MeterPanel:
    """Panel for `coupole meter` with the devices that are open."""

    def __init__(self, visit: Visit) -> None:
        self._visit, self._bench = visit, visit.service.bench
        self._exposures_us: tuple[int, ...] = ()
        self._shown: object = None
        with panel("Meter the plan"):
            self._words = with_name(ui.label().classes("hint"), "metering").props("role=status")
            self._result = with_name(ui.html("", sanitize=False), "advice").style("width:100%")
            with ui.row().classes("bar"):
                self._meter = button("Meter", self._begin, icon="exposure", name="meter")
                self._put = button("Put this exposure into the plan", self._keep, icon="edit_note", name="put")

    def show(self, work: dict[str, Any]) -> None:
        """Show the bench's last work."""
        plan, may = self._bench.plan, self._visit.may_act
        state = work, plan, may
        if state == self._shown:
            return
        self._shown = state
        metering = work.get("kind") == "meter"
        runs, is_done = work.get("state") == "running", metering and work.get("state") == "done"
        self._exposures_us = _exposures_us(work["exposure"]) if is_done else ()
        self._words.text = self._words_of(work) if metering else _IDLE if plan else _NO_PLAN
        self._result.set_content(_advice(work) if is_done else "")
        self._meter.set_enabled(may and bool(plan) and not runs)
        self._put.set_visibility(is_done and bool(plan))
        self._put.set_enabled(may)

    def _words_of(self, work: dict[str, Any]) -> str:
        match work["state"]:
            case "running":
                return "The arm goes to the plan's views, and pictures are taken at several exposures."
            case "done":
                return f"Metered for {self._bench.plan or work['plan']}."
        return f"Metering has ended: {work['why']}"

    async def _begin(self) -> None:
        if not await sure("Meter the plan", _ASKED, "Move the arm and meter"):
            return
        await self._visit.act(
            f"meter {self._bench.plan}", lambda: self._bench.ask("meter", plan=self._bench.plan_path())
        )

    async def _keep(self) -> None:
        name, plans, exposures_us = self._bench.plan, self._visit.service.plan_files, self._exposures_us

        def keep() -> str:
            text, path = plans.read_text(name), plans.path(name)
            fields = replace(fields_of(path, text), exposures_us=exposures_us)
            return plans.write(name, text_with(path, text, fields), text)

        exposure_words = ", ".join(f"{exposure_us / 1000:g} ms" for exposure_us in exposures_us)
        await self._visit.act(
            f"exposure of {name}: {exposure_words}", keep, acts=False, done_text=f"{name} has {exposure_words} now"
        )


_IDLE = (
    "Metering finds the exposure at which nothing is clipped and the object is above the noise, "
    "in all views of the plan."
)
_NO_PLAN = "It needs devices that were opened with a plan."
_ASKED = (
    "The arm drives to each view of the plan, with light at several exposures. This light counts "
    "as light on the object."
)


def _exposures_us(exposure: dict[str, Any]) -> tuple[int, ...]:
    return tuple(exposure["exposures_us"]) if exposure["kind"] == "bracket" else (exposure["exposure_us"],)


def _advice(work: dict[str, Any]) -> str:
    exposure_words = ", ".join(f"{exposure_us / 1000:g} ms" for exposure_us in _exposures_us(work["exposure"]))
    rows = {"exposure": exposure_words}
    for name, view in work["views"].items():
        rows[f"view {name}"] = (
            f"at least {view['shortest_us'] / 1000:.2f} ms, at most {view['longest_us'] / 1000:.2f} ms; object on "
            f"{view['object_share']:.0%} of the picture"
        )
    remarks = "".join(f'<p class="warm small">{html.escape(remark)}</p>' for remark in work["remarks"])
    return facts_html(rows) + remarks
