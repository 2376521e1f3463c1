"""Choice of the LEDs to be lit: by their ids, or on a small picture of the dome."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping

from nicegui import events, ui

from coupole.console.runs.frame_sheets import LedPlace
from coupole.console.screens.parts import with_name
from coupole.errors import InputError

_EMIT = """(e) => {
  const svg = e.currentTarget.querySelector('svg');
  const at = new DOMPoint(e.clientX, e.clientY).matrixTransform(svg.getScreenCTM().inverse());
  emit([at.x, at.y]);
}"""
_NEAR = 0.06
"""Greatest distance at which a click chooses an LED, as a share of the dome's radius."""


class LedChooser:
    """A field of ids, and the dome from above; both always show the same LEDs."""

    def __init__(self, places: Mapping[int, LedPlace], on_change: Callable[[], object]) -> None:
        self._places, self._on_change = places, on_change
        first = max(places, key=lambda led: places[led].elevation_deg) if places else None
        words = "" if first is None else str(first)
        self._field = with_name(ui.input("LEDs, by their ids", value=words, on_change=self._on_typing), "leds")
        self._field.classes("field")
        self._at = {led: _at(place) for led, place in places.items()}
        self._still = "".join(f"M{x:.3f} {y:.3f}h0" for x, y in self._at.values())
        self._dome = ui.html("", sanitize=False).classes("led-chooser").props("data-name=led-dome")
        self._dome.on("click", self._toggle_nearest, js_handler=_EMIT)
        self._draw()

    @property
    def leds(self) -> list[int]:
        """Ids of the chosen LEDs. Raises InputError if they are not numbers."""
        return numbers(str(self._field.value or ""), "LEDs")

    def _toggle_nearest(self, event: events.GenericEventArguments) -> None:
        x, y = (float(value) for value in event.args)
        led = min(self._at, key=lambda candidate: math.dist(self._at[candidate], (x, y)), default=None)
        if led is None or math.dist(self._at[led], (x, y)) > _NEAR:
            return
        try:
            leds = self.leds
        except InputError:
            leds = []
        chosen_leds = [other_led for other_led in leds if other_led != led] if led in leds else [*leds, led]
        self._field.set_value(", ".join(map(str, chosen_leds)))

    def _on_typing(self) -> None:
        self._draw()
        self._on_change()

    def _draw(self) -> None:
        try:
            lit = [led for led in self.leds if led in self._at]
        except InputError:
            return
        marks = "".join(
            f'<circle cx="{x:.3f}" cy="{y:.3f}" r="0.035" data-led="{led}"/>'
            for led, (x, y) in ((led, self._at[led]) for led in lit)
        )
        self._dome.set_content(
            '<svg viewBox="-1.1 -1.1 2.2 2.2" role="img" aria-label="the dome from above; a click lights an LED '
            f'or takes it out"><path d="{self._still}"/>{marks}</svg>'
        )


def numbers(text: str, label: str) -> list[int]:
    """Return whole numbers that are separated by commas or blanks. Raises InputError."""
    words = [word for word in re.split(r"[,;\s]+", text) if word]
    if strange := [word for word in words if not re.fullmatch(r"\d{1,9}", word)]:
        raise InputError(f"{label}: expected whole numbers, such as 3, 17; found {strange[0]!r}")
    return list(dict.fromkeys(map(int, words)))


def _at(place: LedPlace) -> tuple[float, float]:
    """Return the LED's position on the picture: the zenith in the middle, elevation 0 at a radius of 1."""
    far, angle = 1 - place.elevation_deg / 90, math.radians(place.azimuth_deg)
    return far * math.cos(angle), -far * math.sin(angle)
