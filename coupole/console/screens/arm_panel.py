"""The arm at the console: its posture, paths that are shown before the arm moves, motion by hand."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Any

from nicegui import ui

from coupole.console.screens.arm_picture import ArmPicture
from coupole.console.screens.frame import NO_EMERGENCY_STOP, stop_bench
from coupole.console.screens.parts import Choice, button, facts_html, panel, with_name
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError
from coupole.viewing.terminal import duration_text

_AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
_ALONG = {"x": "along x", "y": "along y", "z": "along z", "rx": "about x", "ry": "about y", "rz": "about z"}
_SHARES = {"0.1": "10 % of 250 mm/s", "0.4": "40 % of 250 mm/s", "1": "250 mm/s at most"}
_ENABLING = {
    None: "",
    True: "The arm moves only while a person at the cell holds the enabling switch there.",
    False: "The console sees no enabling switch at this cell, and cannot know whether anybody is there.",
}
_HOLD = Path(__file__).parent / "hold.js"


class ArmPanel:
    """All controls of the arm."""

    def __init__(self, visit: Visit) -> None:
        self._visit, self._bench = visit, visit.service.bench
        self._path: dict[str, Any] | None = None
        self._driven = ""
        self._arm: dict[str, Any] = {}
        self._plan: str | None = None
        with ui.element("div").classes("columns"):
            with panel("Posture"):
                self._picture = ArmPicture(visit.service.cell)
            with ui.column().classes("gap"):
                with panel("The arm"):
                    self._facts = with_name(ui.html("", sanitize=False), "arm").style("width:100%")
                    self._joints = with_name(ui.html("", sanitize=False), "joints").style("width:100%")
                with panel("Drive to"):
                    self._driving()
        with panel("Move by hand"):
            self._hand = _Hand(visit)

    def show(self, state: dict[str, Any]) -> None:
        """Show the bench's state."""
        self._hand.show((state["arm"] or {}).get("enabling_switch"))
        if self._plan != self._bench.plan:
            self._plan = self._bench.plan
            ui.timer(0.0, self._offer_views, once=True)
        arm = state["arm"]
        if arm is None:
            self._facts.set_content('<p class="bad">The arm does not answer.</p>')
            return
        self._arm = arm
        self._picture.show(arm["links_mm"], arm["base_from_camera"])
        self._facts.set_content(facts_html(_condition(arm)))
        self._joints.set_content(_joints_table(arm["joints_deg"], arm["limits_deg"]))
        self._enable()
        self._show_work(state["work"] or {})

    # -- driving ------------------------------------------------------------------------------------------------

    def _driving(self) -> None:
        with ui.row().classes("bar"):
            self._to = Choice("Where to", {"home": "home", "park": "park"}, self._forget, name="to")
            self._show_path = button("Show the path", self._plan_path, icon="route", name="show-path")
            self._drive = button("Drive", self._drive_path, icon="play_arrow", name="drive", kind="main")
            stop = button("Stop", lambda: stop_bench(self._visit), icon="stop", name="stop-arm", kind="stop")
            stop.set_enabled(self._visit.may_act)
        self._words = with_name(ui.label("First look at the path, then drive.").classes("hint"), "path")
        self._words.props("role=status")
        ui.label(NO_EMERGENCY_STOP).classes("small")

    async def _offer_views(self) -> None:
        try:
            views = await in_thread(self._bench.views)
        except CoupoleError as error:
            self._visit.say(str(error), bad=True)
            views = []
        self._to.set_options(
            {"home": "home", "park": "park"} | {f"view {name}": f"view {name}" for name in views}, self._to.value
        )

    def _goal(self) -> Any:
        kind, _, name = self._to.value.partition(" ")
        return {"view": name, "plan": self._bench.plan_path()} if kind == "view" else kind

    async def _plan_path(self) -> None:
        self._forget()
        self._words.text = "The path is planned."
        self._show_path.set_enabled(False)
        path = await self._visit.act(
            f"path to {self._to.value}", lambda: self._bench.ask("plan_path", to=self._goal()), acts=False
        )
        self._path = path
        self._enable()
        if path is None:
            self._words.text = "There is no path."
            return
        corners = len(path["waypoints_deg"]) - 1
        self._picture.show_way(path["camera_mm"], path["links_mm"][-1])
        motions = "one straight motion" if corners == 1 else f"{corners} straight motions"
        self._words.text = (
            f"To {path['to']}: {motions} in joint space, {duration_text(path['duration_s'])}. The blue line is "
            "the path of the camera, violet is the arm at its end."
        )

    async def _drive_path(self) -> None:
        path = self._path
        if path is None:
            return
        self._path, self._driven = None, path["path"]
        self._enable()
        self._words.text = f"The arm drives to {path['to']}."
        account = self._visit.account
        person = account.name if account else ""
        work = await self._visit.act(f"drive to {path['to']}", lambda: self._bench.drive(path["path"], person))
        if work is None:
            self._words.text = "Not driven: show the path again."

    def _forget(self) -> None:
        self._path = None
        self._picture.show_way()
        self._words.text = "First look at the path, then drive."
        self._enable()

    def _enable(self) -> None:
        may, moving = self._visit.may_act, bool(self._arm.get("moving"))
        self._show_path.set_enabled(may and not moving and bool(self._arm))
        self._drive.set_enabled(may and not moving and self._path is not None)

    def _show_work(self, work: dict[str, Any]) -> None:
        if work.get("kind") != "drive" or work["path"] != self._driven or work["state"] == "running":
            return
        self._driven = ""
        self._picture.show_way()
        arrival_words = f"The arm is at {work['to']}."
        self._words.text = arrival_words if work["state"] == "done" else f"The arm has stopped: {work['why']}"


def _condition(arm: dict[str, Any]) -> dict[str, str]:
    def flag_text(value: bool | None, yes: str, no: str) -> str:
        return "not reported by this controller" if value is None else yes if value else no

    rows = {
        "mode": str(arm["mode"] or "not reported by this controller"),
        "emergency stop": flag_text(arm["emergency_stop"], "PRESSED", "not pressed"),
        "protective stop": flag_text(arm["protective_stop"], "STOPPED", "no"),
        "brakes": flag_text(arm["brakes_released"], "released", "closed"),
        "moves": "yes" if arm["moving"] else "no",
    }
    if arm["fault"]:
        rows["fault"] = str(arm["fault"])
    for message in arm["faults_to_confirm"]:
        rows["to be confirmed"] = f"{message} (coupole confirm)"
    return rows


def _joints_table(joints_deg: list[float], limits_deg: list[list[float]]) -> str:
    rows = []
    for name, angle, (low, high) in zip(_AXES, joints_deg, limits_deg, strict=True):
        share = min(1.0, max(0.0, (angle - low) / (high - low)))
        near = ' class="warm"' if min(angle - low, high - angle) < 5 else ""
        rows.append(
            f"<tr><th scope=row>{name}</th><td{near}>{angle:.1f}°</td><td>{low:g}°</td>"
            f'<td class="track"><i style="left:{share:.1%}"></i></td><td>{high:g}°</td></tr>'
        )
    return (
        '<table class="plain joints"><thead><tr><th scope="col">joint</th><th scope="col">now</th>'
        '<th scope="col">from</th><td></td><th scope="col">to</th></tr></thead>'
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


class _Hand:
    """Buttons that move the arm while they are held (hold.js)."""

    def __init__(self, visit: Visit) -> None:
        self._visit = visit
        self._may: bool | None = None
        ui.add_body_html(f"<script>{_HOLD.read_text(encoding='utf-8')}</script>")
        with ui.row().classes("bar"):
            Choice("Speed of the fastest point", _SHARES, name="share", value="0.4")
            self._words = ui.label().classes("hint hand-words")
        self._buttons = ui.html("", sanitize=False).style("width:100%")
        self._switch = with_name(ui.label().classes("small"), "enabling-switch")
        self._said = with_name(ui.label("No button is held."), "hand-said").props("role=status")
        ui.label(
            "Hold a button with pointer, Space or Enter. The arm stops when you release it, when the page is "
            "hidden, and 300 ms after the last signal of the button. Watch the arm, with your hand at the "
            "emergency stop."
        ).classes("small")

    def show(self, enabling_switch: bool | None) -> None:
        """`enabling_switch`: True if the cell has one; None if this is not known."""
        visit = self._visit
        self._switch.text = _ENABLING[enabling_switch]
        here = visit.address in visit.service.cell.rig.console.at_the_cell
        may = visit.may_act and here
        if may == self._may:
            return
        self._may = may
        self._words.text = "" if may else _why_not(here=here)
        self._buttons.set_content(
            '<div class="jogs">'
            + _pads("Joints", {axis: axis for axis in _AXES}, may)
            + _pads("Camera, in the axes of the arm's base", _ALONG, may)
            + "</div>"
        )


def _why_not(*, here: bool) -> str:
    if here:
        return "Only operators may move the arm."
    return (
        "The arm is moved only from a console at the cell: this browser's address is not in `console: "
        "at_the_cell:` of the rig."
    )


def _pads(title: str, axes: dict[str, str], may: bool) -> str:
    off = "" if may else " disabled"
    rows = "".join(
        f'<button class="jog" data-axis="{axis}" data-direction="-1" '
        f'aria-label="hold: {words} minus"{off}>{words} &minus;</button><button class="jog" data-axis="{axis}" '
        f'data-direction="1" aria-label="hold: {words} plus"{off}>{words} +</button>'
        for axis, words in axes.items()
    )
    words = html.escape(title)
    return f'<div role="group" aria-label="{words}"><h3>{words}</h3><div class="pads">{rows}</div></div>'
