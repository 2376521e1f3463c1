"""Focus and expose: pictures one after the other, their sharpness and brightness, and their light on the
object."""

from __future__ import annotations

import time
from typing import Any

from nicegui import ui

from coupole.console.people.accounts import Role
from coupole.console.people.permission import NotAllowed, allow
from coupole.console.plans.plan_fields import fields_of
from coupole.console.screens.bench_bar import BenchBar
from coupole.console.screens.look_picture import LookPicture
from coupole.console.screens.meter_panel import MeterPanel
from coupole.console.screens.parts import button, clipping_words, facts_html, histogram_svg, panel, with_name
from coupole.console.screens.picture_settings import PictureSettings
from coupole.console.screens.sharpness import Sharpness
from coupole.console.screens.visit import Visit, in_thread
from coupole.errors import CoupoleError

LIVE_S = 60.0
"""Live pictures end if nobody has touched the page for this time, s, because each picture puts light on the
object."""
_EVERY_S = 0.1


def build(visit: Visit) -> None:
    """Build the screen."""
    _Screen(visit)


class _Screen:
    def __init__(self, visit: Visit) -> None:
        self._visit, self._bench = visit, visit.service.bench
        self._live = self._asking = False
        self._touched_s, self._given_lux_h, self._taken = 0.0, 0.0, 0
        self._ending, self._stops = "", 0
        self._plan: str | None = None
        self._white: list[float] | None = None
        self._settings = PictureSettings(self._touch)
        with ui.column().classes("screen-part") as whole:
            bar = ui.column().classes("cell")
            with ui.element("div").classes("columns focus") as self._parts:
                with ui.column().classes("gap"):
                    self._build_picture()
                    self._build_region()
                with ui.column().classes("gap"):
                    self._settings.build_light(visit.service.cell)
                    self._sharpness = Sharpness()
                    self._build_figures()
                    self._meter = MeterPanel(visit)
            with bar:
                BenchBar(visit, self._show)
        for kind in ("pointermove", "pointerdown", "keydown", "wheel"):
            whole.on(kind, self._touch, args=[], throttle=2.0)
        ui.timer(_EVERY_S, self._tick)

    def _build_picture(self) -> None:
        with panel("Picture"):
            with ui.row().classes("bar"):
                self._live_button = button("Live", self._toggle, icon="videocam", name="live", kind="main")
                self._once = button("One picture", self._take_one, icon="photo_camera", name="expose")
                self._settings.build_marks(self._set_grid)
            self._refused = with_name(ui.label().classes("bad"), "refused").props("role=alert")
            self._picture = LookPicture(self._visit, self._settings.set_region)
            self._words = with_name(ui.label("No picture yet.").classes("hint"), "picture").props("role=status")

    def _set_grid(self, is_shown: bool) -> None:
        self._picture.set_grid(is_shown)

    def _build_region(self) -> None:
        with panel("Region and loupe"):
            ui.label("Drag on the picture to draw a region, or give it here.").classes("small")
            self._settings.build_region(self._picture.set_region)
            self._picture.build_loupe()
            button("Loupe in the middle", self._picture.loupe, icon="zoom_in", name="loupe-middle")

    def _build_figures(self) -> None:
        with panel("Exposure"):
            self._histogram = ui.html("", sanitize=False).style("width:100%")
            self._figures = with_name(ui.html("", sanitize=False), "exposed").style("width:100%")
            with ui.row().classes("bar"):
                self._white_button = button(
                    "White point from the region", self._take_white, icon="colorize", name="white"
                )
                button(
                    "Colours of the sensor", lambda: self._settings.set_white(None), name="no-white", kind="flat"
                )
            self._white_words = with_name(ui.label().classes("small"), "white-words")
        with panel("Light on the object"):
            self._dose = with_name(ui.html("", sanitize=False), "bench-dose").style("width:100%")

    # -- the bench's state --------------------------------------------------------------------------------------

    def _show(self, state: dict[str, Any] | None) -> None:
        self._parts.set_visibility(state is not None)
        if state is None:
            if self._live:
                self._end_live("the devices are closed")
            return
        if self._plan != self._bench.plan:
            self._plan = self._bench.plan
            ui.timer(0.0, self._begin_with_the_plan, once=True)
        work = state["work"] or {}
        if self._live and work.get("kind") == "meter" and work["state"] == "running":
            self._end_live("the plan is metered")
        self._meter.show(work)
        self._show_dose(state["dose"])
        self._enable()

    async def _begin_with_the_plan(self) -> None:
        name, plans = self._bench.plan, self._visit.service.plan_files
        if not name:
            return
        try:
            fields = fields_of(plans.path(name), await in_thread(plans.read_text, name))
        except CoupoleError as error:
            self._visit.say(str(error), bad=True)
            return
        if fields.exposures_us:
            self._settings.set_exposure(max(fields.exposures_us))

    def _enable(self) -> None:
        may = self._visit.may_act
        self._live_button.set_enabled(may)
        self._live_button.set_text("End live pictures" if self._live else "Live")
        self._live_button.props(f"icon={'videocam_off' if self._live else 'videocam'}")
        self._once.set_enabled(may and not self._live and not self._asking)
        self._white_button.set_enabled(self._white is not None)

    # -- pictures -----------------------------------------------------------------------------------------------

    def _touch(self) -> None:
        self._touched_s = time.monotonic()

    async def _toggle(self) -> None:
        if self._live:
            self._ending = "ended"
            return
        self._touch()
        self._ending = ""
        stops = await self._visit.act("live pictures begin", self._stops_so_far)
        if stops is not None:
            self._stops = stops
            self._live, self._taken, self._given_lux_h = True, 0, 0.0
            self._refused.text = ""
        self._enable()

    def _stops_so_far(self) -> int:
        stops: int = self._bench.ask("state")["stops"]
        return stops

    def _end_live(self, why: str) -> None:
        self._live = False
        self._words.text = f"Live is off: {why}. It took {self._taken} pictures, {self._given_lux_h:.4f} lux h."
        visit, account = self._visit, self._visit.account
        words = f"screen: live pictures end: {self._taken} pictures, {self._given_lux_h:.6f} lux h; {why}"
        visit.service.audit.note(account.name if account else "", words, 200, visit.address)
        self._enable()

    async def _tick(self) -> None:
        if not self._live or self._asking:
            return
        why = self._ending or why_live_ends(
            is_watched=self._visit.is_watched,
            untouched_s=time.monotonic() - self._touched_s,
            is_stopped=self._was_stopped,
        )
        if why:
            self._end_live(why)
        else:
            await self._expose(live=True)

    @property
    def _was_stopped(self) -> bool:
        """True if this page knows of a stop since live pictures began; the bench refuses the next picture in any
        case."""
        state = self._bench.state
        return state is not None and state["stops"] > self._stops

    async def _stopped_meanwhile(self) -> bool:
        """The same by the bench's present state."""
        try:
            return await in_thread(self._stops_so_far) > self._stops
        except CoupoleError:  # the devices are closed
            return True

    async def _take_one(self) -> None:
        self._refused.text = ""
        await self._expose(live=False)

    async def _expose(self, *, live: bool) -> None:
        self._asking = True
        picture: dict[str, Any] | None = None
        try:
            request, words = self._settings.request(), self._settings.light_words
            comparison_key = self._settings.comparison_key
            if live:
                picture = await self._taken_live(request)
            else:
                picture = await self._visit.act(f"picture, {words}", lambda: self._bench.ask("frame", **request))
        except (CoupoleError, NotAllowed) as error:
            if live and await self._stopped_meanwhile():
                self._ending = "stopped"
            else:
                self._refused.text, self._ending = str(error), "a picture was refused"
        finally:
            self._asking = False
        if picture is not None:
            self._show_picture(picture, request, words, comparison_key)
        self._enable()

    async def _taken_live(self, request: dict[str, Any]) -> dict[str, Any]:
        account = self._visit.account
        if account is None:
            raise NotAllowed(401, "the session is over: sign in again")
        allow(self._visit.service, account, Role.OPERATOR, "live pictures", acts=True)
        picture = await in_thread(self._bench.ask, "frame", **request, stops=self._stops)
        self._taken += 1
        self._given_lux_h += picture["dose_lux_h"]
        return picture

    def _show_picture(
        self, picture: dict[str, Any], request: dict[str, Any], words: str, comparison_key: object
    ) -> None:
        self._picture.show(picture, request["gains"])
        where = picture["region"] or picture
        of = "of the region" if picture["region"] else "of the whole picture"
        self._sharpness.add(where["sharpness"], comparison_key, of)
        self._histogram.set_content(histogram_svg(where["histograms"]))
        self._figures.set_content(
            facts_html(
                {
                    f"brightest {of}": f"{where['brightest']:.0%} of full scale",
                    **clipping_words(where["saturated"]),
                    "this picture gave": f"{picture['dose_lux_h']:.5f} lux h",
                }
            )
        )
        self._white = picture["region"]["white_point"] if picture["region"] else None
        self._white_words.text = _white_words(request["gains"], picture["region"], self._white)
        self._words.text = f"Picture {picture['number']}: {words}"
        self._show_dose(picture["dose"])

    def _take_white(self) -> None:
        self._settings.set_white(self._white)
        self._white_words.text = "The next pictures are shown with this white point."

    def _show_dose(self, dose: dict[str, Any]) -> None:
        rows = {"since the devices were opened": f"{dose['bench_lux_h']:.4f} lux h"}
        if dose["total_lux_h"] is not None:
            rows["on the object in its life"] = f"{dose['total_lux_h']:.3f} lux h"
            left_lux_h = dose["left_lux_h"]
            rows["left of its budget"] = "no budget is set" if left_lux_h is None else f"{left_lux_h:.4f} lux h"
        else:
            rows["object"] = "none; counted at the support's centre"
        if dose["warning"]:
            rows["warning"] = dose["warning"]
        self._dose.set_content(facts_html(rows))


def why_live_ends(*, is_watched: bool, untouched_s: float, is_stopped: bool) -> str:
    """Return why no further live picture is taken; empty if one is taken."""
    if not is_watched:
        return "the page was closed"
    if untouched_s > LIVE_S:
        return f"nobody has touched this page for {LIVE_S:g} s"
    return "stopped" if is_stopped else ""


def _white_words(gains: list[float], region: dict[str, Any] | None, white: list[float] | None) -> str:
    gain_words = "R, G, B times " + ", ".join(f"{gain:.3f}" for gain in gains)
    if region is None:
        return f"{gain_words}. Draw a region on a neutral surface to set another white point."
    return (
        gain_words
        if white
        else f"{gain_words}. The region gives no white point: it is clipped, too dark or has no colours."
    )
