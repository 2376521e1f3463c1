"""LEDs to be lit: by their ids, or on a small picture of the dome."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping

from nicegui import events, ui

from coupole.console.frame_sheets import LedPlace
from coupole.console.screens.parts import named
from coupole.errors import InputError

_EMIT = """(e) => {
  const one = e.target.closest('[data-led]');
  if (one) emit(Number(one.dataset.led));
}"""
_MARK = """for (const one of document.querySelectorAll('.led-chooser [data-led]'))
  one.classList.toggle('lit', %s.includes(Number(one.dataset.led)));"""


class LedChooser:
    """A field of ids and the dome from above say the same."""

    def __init__(self, places: Mapping[int, LedPlace], on_change: Callable[[], object]) -> None:
        self._places, self._on_change = places, on_change
        first = max(places, key=lambda led: places[led].elevation_deg) if places else None
        words = "" if first is None else str(first)
        self._field = named(ui.input("LEDs, by their ids", value=words, on_change=self._typed), "leds")
        self._field.classes("field")
        self._dome = ui.html(_svg(places), sanitize=False).classes("led-chooser")
        self._dome.on("click", self._clicked, js_handler=_EMIT)
        ui.timer(0.0, self._mark, once=True)

    @property
    def leds(self) -> list[int]:
        """Raises InputError: not numbers."""
        return numbers(str(self._field.value or ""), "LEDs")

    def _clicked(self, event: events.GenericEventArguments) -> None:
        try:
            leds = self.leds
        except InputError:
            leds = []
        led = int(event.args)
        chosen = [one for one in leds if one != led] if led in leds else [*leds, led]
        self._field.set_value(", ".join(map(str, chosen)))

    def _typed(self) -> None:
        self._mark()
        self._on_change()

    def _mark(self) -> None:
        try:
            ui.run_javascript(_MARK % json.dumps(self.leds))
        except InputError:
            return


def numbers(text: str, what: str) -> list[int]:
    """Whole numbers with commas or blanks between them. Raises InputError."""
    words = [word for word in re.split(r"[,;\s]+", text) if word]
    if strange := [word for word in words if not re.fullmatch(r"\d{1,9}", word)]:
        raise InputError(f"{what}: expected whole numbers, as in 3, 17; found {strange[0]!r}")
    return list(dict.fromkeys(map(int, words)))


def _svg(places: Mapping[int, LedPlace]) -> str:
    radius = min(0.06, 0.6 / math.sqrt(max(1, len(places))))
    leds = []
    for led, place in places.items():
        far, angle = 1 - place.elevation_deg / 90, math.radians(place.azimuth_deg)
        at = f'cx="{far * math.cos(angle):.3f}" cy="{-far * math.sin(angle):.3f}" r="{radius:.3f}"'
        leds.append(f'<circle {at} data-led="{led}"><title>LED {led}</title></circle>')
    return (
        '<svg viewBox="-1.1 -1.1 2.2 2.2" role="img" aria-label="the dome from above; a click lights an LED or '
        f'takes it out">{"".join(leds)}</svg>'
    )
