"""The cell's devices while no run is acquired: their identities, their states, and commands for them."""

from __future__ import annotations

from typing import Any

from nicegui import ui

from coupole.console.screens.arm_panel import ArmPanel
from coupole.console.screens.bench_bar import BenchBar
from coupole.console.screens.parts import button, facts_html, panel, with_name
from coupole.console.screens.visit import Visit

_CARDS = {"ledbox": "LED box", "camera": "Camera", "robot": "Arm"}


def build(visit: Visit) -> None:
    """Build the screen."""
    _Screen(visit)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit, self._bench = visit, visit.service.bench
        self._bar = ui.column().classes("cell")
        with ui.column().classes("screen-part") as self._parts:
            with ui.element("div").classes("cards three"):
                self._cards = {kind: _Card(self, kind) for kind in _CARDS}
            self._arm = ArmPanel(visit)
        with self._bar:
            BenchBar(visit, self._show)

    def _show(self, state: dict[str, Any] | None) -> None:
        self._parts.set_visibility(state is not None)
        if state is None:
            return
        for kind, card in self._cards.items():
            card.show(state["devices"].get(kind))
        self._arm.show(state)

    async def test(self, kind: str) -> None:
        """Run the self-test of a device."""
        card = self._cards[kind]
        card.busy(True)
        test_report = await self._visit.act(
            f"self-test of {kind}", lambda: self._bench.ask("self_test", device=kind)
        )
        card.busy(False)
        if test_report is not None:
            words = "has passed its test" if test_report["passed"] else "has failed its test"
            self._visit.say(f"{_CARDS[kind]} {words}", bad=not test_report["passed"])


class _Card:
    """One device."""

    def __init__(self, screen: _Screen, kind: str) -> None:
        self._visit, self._busy = screen._visit, False
        with panel(_CARDS[kind]):
            self._facts = with_name(ui.html("", sanitize=False), f"device-{kind}").style("width:100%")
            self._error = ui.label().classes("bad small").props("role=status")
            self._test = button(
                "Test itself",
                lambda: screen.test(kind),
                icon="fact_check",
                name=f"test-{kind}",
            )
            self._report = with_name(ui.html("", sanitize=False), f"report-{kind}").style("width:100%")

    def busy(self, busy: bool) -> None:
        self._busy = busy
        self._test.set_text("Testing" if busy else "Test itself")
        self._test.set_enabled(not busy and self._visit.may_act)

    def show(self, device: dict[str, Any] | None) -> None:
        if device is None:
            self._facts.set_content("<p>The rig has none.</p>")
            return
        identity, heard_s = device["identity"], device["heard_s_ago"]
        rows = {
            "is": f"{identity['vendor']} {identity['model']}",
            "serial number": identity["serial"] or "not told",
            "firmware": identity["firmware"] or "not told",
            "link": device["link"] or "not told",
            "last heard": "just now" if heard_s < 5 else f"{heard_s:.0f} s ago",
        }
        if device["temperature_c"] is not None:
            rows["warmest board"] = f"{device['temperature_c']:.1f} °C"
        self._facts.set_content(facts_html(rows))
        error = device["last_error"]
        self._error.text = f"{error['t'][11:19]} UTC: {error['message']}" if error else ""
        self._error.set_visibility(bool(error))
        self._test.set_enabled(not self._busy and self._visit.may_act)
        self._show_test(device["self_test"])

    def _show_test(self, test: dict[str, Any] | None) -> None:
        if test is None:
            self._report.set_content('<p class="hint">Not tested since the devices were opened.</p>')
            return
        kind, words = ("good", "passed") if test["passed"] else ("bad", "failed")
        report = facts_html({name.replace("_", " "): words for name, words in test["report"].items()})
        self._report.set_content(f'<p class="{kind}">Test {words} at {test["t"][11:19]} UTC</p>{report}')
