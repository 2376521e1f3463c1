"""Settings of the bench's next picture: its light, exposure, region, marks and white point."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from coupole.console.runs.frame_sheets import places_in
from coupole.console.screens.led_chooser import LedChooser, numbers
from coupole.console.screens.parts import button, panel, with_name
from coupole.errors import InputError
from coupole.plan.cell import Cell

_SHORTEST_MS, _PICTURE_WIDTH_PX = 0.01, 1280
_NEUTRAL = [1.0, 1.0, 1.0]
_SIDES = ("x", "y", "width", "height")


class PictureSettings:
    """Fields of the screen; `request()` returns their values."""

    def __init__(self, on_change: Callable[[], object]) -> None:
        self._on_change = on_change
        self.gains = list(_NEUTRAL)
        self._marks: dict[str, ui.checkbox] = {}

    # -- their places -------------------------------------------------------------------------------------------

    def build_light(self, cell: Cell) -> None:
        with panel("Light and exposure"):
            with ui.element("div").classes("fields"):
                self._exposure = with_name(
                    ui.number("Exposure, ms", value=8.0, min=_SHORTEST_MS, step=1), "exposure"
                )
                self._gain = with_name(ui.number("Gain, dB", value=0.0, min=0, step=1), "gain")
                self._panels = with_name(ui.input("Panels, by their numbers", placeholder="none"), "panels")
            for field in (self._exposure, self._gain, self._panels):
                field.on_value_change(self._on_change)
            self._leds = LedChooser(places_in(cell), self._on_change)
            ui.label("One picture is taken under each light, and they are added up.").classes("small")

    def build_marks(self, set_grid: Callable[[bool], object]) -> None:
        grid = ui.checkbox("gridlines", value=True, on_change=lambda event: set_grid(bool(event.value)))
        with_name(grid, "gridlines")
        for mark, words in (("saturation", "clipped in red"), ("focus", "sharp in green")):
            self._marks[mark] = with_name(ui.checkbox(words, value=mark == "saturation"), f"mark-{mark}")
            self._marks[mark].on_value_change(self._on_change)

    def build_region(self, show: Callable[[list[int] | None], object]) -> None:
        self._show_region = show
        with ui.element("div").classes("fields four"):
            self._region = {
                side: with_name(ui.number(f"{side}, px", min=0, step=1, precision=0), f"region-{side}")
                for side in _SIDES
            }
        for field in self._region.values():
            field.on_value_change(self._region_changed)
        button("The whole picture", lambda: self.set_region(None), icon="crop_free", name="no-region", kind="flat")

    # -- what they say ------------------------------------------------------------------------------------------

    def set_region(self, region: list[int] | None) -> None:
        for number, side in enumerate(_SIDES):
            self._region[side].set_value(region[number] if region else None)

    def set_exposure(self, exposure_us: int) -> None:
        self._exposure.set_value(exposure_us / 1000)

    @property
    def region(self) -> list[int] | None:
        """x, y, width, height of the region; None if not all four are given."""
        values = [self._region[side].value for side in _SIDES]
        return None if None in values else [int(value) for value in values]

    @property
    def light_words(self) -> str:
        """Return light and exposure in words, for the log and for people."""
        request = self.request()
        lights = [*(f"LED {led}" for led in request["lights"]), *(f"panel {panel}" for panel in request["panels"])]
        return f"{', '.join(lights) or 'no light'}, {request['exposure_us'] / 1000:g} ms"

    @property
    def comparison_key(self) -> object:
        """Return a key of the settings. Sharpness is comparable while it stays the same."""
        request = self.request()
        return request["lights"], request["panels"], request["region"]

    def request(self) -> dict[str, Any]:
        """Return the fields of a `frame` command. Raises InputError."""
        exposure_ms = self._exposure.value
        if not exposure_ms or exposure_ms < _SHORTEST_MS:
            raise InputError(f"Exposure: expected at least {_SHORTEST_MS} ms")
        return {
            "lights": self._leds.leds,
            "panels": numbers(str(self._panels.value or ""), "Panels"),
            "exposure_us": round(1000 * float(exposure_ms)),
            "gain_db": float(self._gain.value or 0.0),
            "region": self.region,
            "width_px": _PICTURE_WIDTH_PX,
            "marks": [mark for mark, box in self._marks.items() if box.value],
            "gains": self.gains,
        }

    def set_white(self, gains: list[float] | None = None) -> None:
        """Set the white point to the colour of a region; None for the sensor's own colours."""
        self.gains = list(gains or _NEUTRAL)
        self._on_change()

    def _region_changed(self) -> None:
        self._show_region(self.region)
        self._on_change()
